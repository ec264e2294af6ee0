"""``softgrasp serve``: the protocol by its own client and by plain HTTP, derivatives, and refusals."""

from __future__ import annotations

import http.client
import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.certified.archive import save_certified
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.training import certified_model
from softgrasp.study.cli import app
from softgrasp.study.serve.protocol import Served
from softgrasp.study.serve.run import is_local, make_server, served_model

pytestmark = pytest.mark.serial
SCENES = Path(__file__).parents[2] / "demos" / "scenes"
SCENE = ["tissue.cells=[4, 8]", "time.steps=60", "effects.damping={kind='kelvin-voigt', beta=0.002}"]
THETA = [77.0, 60.0]


@pytest.fixture(scope="module")
def certified() -> CertifiedModel:
    model = build(load_scene(SCENES / "paper_forward.toml", SCENE))
    box = ParameterDomain((30.0, 500.0), (20.0, 500.0))
    return certified_model(model, lowest_modes(model.system, 40)[1], k=20, tolerance=0.5, box=box)


@pytest.fixture(scope="module")
def url(certified: CertifiedModel, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    file = tmp_path_factory.mktemp("serve") / "certified.h5"
    save_certified(certified, file)
    server = make_server(served_model(file, "lambda,mu"), "127.0.0.1", 0)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def ask(url: str, path: str, body: Any = None, raw: bytes | None = None) -> tuple[int, Any]:
    data = raw if raw is not None else None if body is None else json.dumps(body).encode()
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(urllib.request.Request(url + path, data), timeout=60) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_outputs_and_bounds_are_those_of_the_model(url: str, certified: CertifiedModel) -> None:
    found = certified.run(certified.materials(*THETA))
    assert ask(url, "/Info")[1] == {"protocolVersion": 1.0, "models": ["forward", "bound"]}
    for name, exact in (("forward", found.trajectory.outputs), ("bound", found.certificate.outputs.values)):
        body = {"name": name, "input": [THETA], "config": {}}
        (values,) = ask(url, "/Evaluate", body)[1]["output"]
        assert ask(url, "/OutputSizes", body)[1] == {"outputSizes": [len(values)]}
        np.testing.assert_array_equal(np.array(values).reshape(61, -1), exact)


def test_an_estimate_is_not_called_a_proof(certified: CertifiedModel) -> None:
    body = {"name": "bound", "input": [THETA], "config": {}}
    for certify, kind, words in (("two", "proof", "proved errors"), ("estimate", "estimate", "not proofs")):
        model = replace(certified, certify=certify)  # type: ignore[arg-type]
        assert model.drive is not None
        served = Served(model, model.drive)
        assert words in served.bounds_are
        answer = served.answer("POST", "/Evaluate", body)[1]
        assert answer["bound"] == kind
        assert answer["output"] == [model.run(model.materials(*THETA)).certificate.outputs.values.ravel().tolist()]


def test_derivatives_are_differences(url: str) -> None:
    def outputs(theta: Any) -> Any:
        body = {"name": "forward", "input": [list(theta)], "config": {"allow": True}}
        return np.array(ask(url, "/Evaluate", body)[1]["output"][0])

    rng = np.random.default_rng(0)
    sens, vec = rng.standard_normal(len(outputs(THETA))), rng.standard_normal(2)
    body = {"name": "forward", "input": [THETA], "outWrt": 0, "inWrt": 0, "config": {}}
    gradient = ask(url, "/Gradient", {**body, "sens": sens.tolist()})[1]["output"]
    along = ask(url, "/ApplyJacobian", {**body, "vec": vec.tolist()})[1]["output"]
    step = 1e-3 * np.eye(2)
    J = np.stack([(outputs(THETA + s) - outputs(THETA - s)) / 2e-3 for s in step])
    # the square of the step over that of the parameters, 1e-9, and rounding over the step
    np.testing.assert_allclose(gradient, J @ sens, rtol=1e-6)
    np.testing.assert_allclose(along, vec @ J, rtol=0, atol=1e-6 * np.abs(along).max())


def test_the_protocols_own_client_agrees(url: str, certified: CertifiedModel) -> None:
    umbridge = pytest.importorskip("umbridge", reason="the client of the protocol is no dependency")
    client = umbridge.HTTPModel(url, "forward")
    assert client.get_input_sizes() == [2]
    assert client.supports_gradient()
    assert client.supports_apply_jacobian()
    assert not client.supports_apply_hessian()
    exact = certified.run(certified.materials(*THETA)).trajectory.outputs.ravel()
    np.testing.assert_array_equal(client([THETA])[0], exact)
    unit = [0.0] * len(exact)
    unit[-1] = 1.0
    assert len(client.gradient(0, 0, [THETA], unit)) == 2
    with pytest.raises(Exception, match="above the tolerance"):
        client([THETA], {"tolerance": 1e-12})


BASE = {"name": "forward", "input": [THETA]}


@pytest.mark.parametrize(
    ("path", "body", "kind", "sentence"),
    [
        ("/Evaluate", {"name": "other"}, "ModelNotFound", "forward and bound"),
        ("/Evaluate", {"name": "forward", "input": [[1.0]]}, "InvalidInput", "input must have 2 finite numbers"),
        ("/Evaluate", {"name": "forward", "input": [[1.0, "x"]]}, "InvalidInput", "2 finite numbers"),
        ("/Evaluate", {"name": "forward", "input": [[10**400, 1.0]]}, "InvalidInput", "2 finite numbers"),
        (
            "/Evaluate",
            {"name": "bound", "input": [[1e-320] * 2], "config": {"allow": True}},
            "InvalidInput",
            "no finite",
        ),
        ("/Evaluate", {"name": "forward", "input": THETA}, "InvalidInput", "a list of one list"),
        ("/Evaluate", {"name": "forward", "input": [[77.0, -1.0]]}, "InvalidInput", "is no material"),
        ("/Evaluate", {**BASE, "config": {"tolerance": 1e-12}}, "InvalidInput", "above the tolerance 1e-12"),
        ("/Evaluate", {**BASE, "config": {"tol": 1}}, "InvalidInput", "tolerance and allow alone"),
        ("/Evaluate", {**BASE, "config": {"tolerance": -1}}, "InvalidInput", "a relative error > 0"),
        ("/Gradient", {"name": "bound", "input": [THETA]}, "UnsupportedFeature", "bound has no Gradient"),
        ("/Gradient", {**BASE, "sens": [1.0]}, "InvalidInput", "sens must have 122"),
        ("/Gradient", {**BASE, "outWrt": 1, "sens": []}, "InvalidInput", "outWrt must be 0"),
        ("/ApplyHessian", BASE, "UnsupportedFeature", "no ApplyHessian"),
        ("/Shutdown", BASE, "UnsupportedFeature", "not part of the protocol"),
        ("/Evaluate", [1], "ModelNotFound", "not None"),
    ],
)
def test_refusals_are_one_sentence(url: str, path: str, body: Any, kind: str, sentence: str) -> None:
    status, answer = ask(url, path, body)
    assert status in (400, 404)
    assert answer["error"]["type"] == kind
    assert sentence in answer["error"]["message"]


def test_what_is_no_request_is_refused_and_the_server_goes_on(url: str) -> None:
    assert ask(url, "/Evaluate", raw=b"{")[1]["error"]["message"] == "the request is no JSON"
    assert ask(url, "/Evaluate", raw=b"NaN")[0] == 400
    assert ask(url, "/ModelInfo", {"name": "bound"})[1]["support"]["Evaluate"]


@pytest.mark.parametrize(
    ("method", "path", "status", "allow"),
    [
        ("GET", "/Evaluate", 405, "POST"),
        ("PUT", "/Evaluate", 405, "POST"),
        ("DELETE", "/Info", 405, "GET, POST"),
        ("HEAD", "/Info", 405, "GET, POST"),
        ("OPTIONS", "/ModelInfo", 405, "POST"),
        ("GET", "/", 404, None),
        ("BREW", "/Info", 501, None),
    ],
)
def test_other_methods_get_their_status_and_what_is_allowed(
    url: str, method: str, path: str, status: int, allow: str | None
) -> None:
    connection = http.client.HTTPConnection(url.removeprefix("http://"), timeout=60)
    connection.request(method, path)
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    assert (answer.status, answer.headers["Allow"]) == (status, allow)
    assert not text if method == "HEAD" else json.loads(text)["error"]["message"]


def test_files_names_and_addresses_that_do_not_fit(url: str, tmp_path: Path) -> None:
    assert is_local("127.0.0.1")
    assert is_local("::1")
    assert not is_local("0.0.0.0")
    with pytest.raises(SceneError, match="name the certified model"):
        served_model(tmp_path / "none.h5", "lambda,mu")
    with pytest.raises(SceneError, match="--inputs nu"):
        served_model(tmp_path / "none.h5", "nu")
    taken = int(url.rpartition(":")[2])
    with pytest.raises(SceneError, match=f"--port {taken}: .*choose another"):
        make_server(None, "127.0.0.1", taken)  # type: ignore[arg-type]
    result = CliRunner().invoke(app, ["serve", str(tmp_path / "none.h5")])
    assert isinstance(result.exception, SceneError)
