"""``softgrasp query``: answers against the model itself and the full run, refusals, batches, one sentence a mistake."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console
from typer.testing import CliRunner

from softgrasp.fem.accuracy import adapt
from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, resolved_toml
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.archive import write_checksums
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.training import certified_model
from softgrasp.study.cli import app
from softgrasp.study.query.request import drive_of, materials_of, parse_settings, read_batch
from softgrasp.study.query.run import run_query
from softgrasp.study.shell.folder import claim

KV = ["tissue.cells=[4, 8]", "time.steps=100", "effects.damping={kind='kelvin-voigt',beta=0.002}"]
SCENES = Path(__file__).parents[3] / "demos" / "scenes"


@cache
def made(*overrides: str) -> tuple[Model, CertifiedModel]:
    model = build(load_scene(SCENES / "paper_forward.toml", [*KV, *overrides]), comm=MPI.COMM_WORLD)
    Phi = lowest_modes(model.system, 40)[1]
    return model, certified_model(model, Phi, k=20, tolerance=0.5, box=ParameterDomain((30.0, 500.0), (20.0, 500.0)))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certified model in models/ beside the scene, as ``reduce`` leaves them."""
    folder = Path(MPI.COMM_WORLD.bcast(str(tmp_path_factory.mktemp("query"))))
    model, certified = made()
    if MPI.COMM_WORLD.rank == 0:
        (folder / "models").mkdir(exist_ok=True)
        (folder / "scene.toml").write_text(resolved_toml(model.scene))
    MPI.COMM_WORLD.Barrier()
    save_certified(certified, folder / "models" / "certified.h5")
    MPI.COMM_WORLD.Barrier()
    return folder / "models" / "certified.h5"


def ask(file: Path, *settings: str, **keys: object) -> tuple[int, str]:
    text = io.StringIO()
    status = run_query(file, Console(file=text, width=200), settings=settings, **keys)  # type: ignore[arg-type]
    return status, MPI.COMM_WORLD.bcast(text.getvalue())  # rank 0 speaks for all


def columns(path: Path) -> dict[str, list[str]]:
    rows = list(csv.reader(path.open()))
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])}


@pytest.mark.ranks(2)
def test_an_answer_is_the_run_of_the_model_with_its_bound(file: Path) -> None:
    """The CSV file holds the reduced run, and the full run lies within its bounds at every step."""
    out = file.parent / "one.csv"
    status, text = ask(file, "lambda=300", "mu=200", out=out)
    assert status == 0
    assert "reduced model, 100 steps of 30 ms" in text
    assert "(proved)" in text
    assert "time step" in text
    assert "mesh not known" in text
    MPI.COMM_WORLD.Barrier()
    table, (model, certified) = columns(out), made()
    materials = certified.materials(300.0, 200.0)
    run = certified.run(materials)

    full = simulate(replace(model, system=model.system.with_materials(materials)))
    for i, name in enumerate(("tip_x", "tip_y")):
        values, bound = np.array(table[f"{name} [m]"], float), np.array(table[f"error of {name} at most [m]"], float)
        assert (values == run.trajectory.outputs[:, i]).all()
        assert (np.abs(values - full.outputs[:, i]) <= bound + 1e-12).all()  # rounding at rest


def test_above_the_tolerance_an_answer_is_refused(file: Path) -> None:
    out = file.parent / "refused.csv"
    status, text = ask(file, "lambda=77", "mu=60", tolerance=1e-6, out=out)
    assert status == 3
    assert "refuses to answer" in text
    assert "above the tolerance 0.0001 %" in text
    assert not out.exists()
    status, text = ask(file, "lambda=77", "mu=60", tolerance=1e-6, allow=True)
    assert status == 0
    assert "it is shown because --allow was given" in text


@pytest.mark.ranks(2)
def test_the_full_model_answers_instead_and_says_so(file: Path) -> None:
    out = file.parent / "full.csv"
    status, text = ask(file, "lambda=77", "mu=60", tolerance=1e-6, fallback="full", out=out)
    assert status == 0
    assert "answered by" in text
    assert "full model, 100 steps" in text
    assert "the full model ran instead" in text

    model, certified = made()
    system = model.system.with_materials(certified.materials(77.0, 60.0))
    full = simulate(replace(model, system=system))
    MPI.COMM_WORLD.Barrier()
    tip = np.array(columns(out)["tip_x [m]"], float)
    assert np.abs(tip - full.outputs[:, 0]).max() < 1e-9 * np.abs(full.outputs).max()  # the scene read from its file


def test_outside_the_box_is_a_warning_alone(file: Path) -> None:
    status, text = ask(file, "lambda=700", "mu=700")
    assert status == 0
    assert "outside the box" in text


def test_a_batch_is_many_queries(file: Path) -> None:
    table, out = file.parent / "many.csv", file.parent / "answers.csv"
    table.write_text("lambda [Pa], mu [Pa]\n300,200\n77,60\n600,600\n30,20\n")
    status, text = ask(file, batch=table, out=out, tolerance=0.2)
    found = columns(out)
    errors = [float(x) for x in found["error at most"]]
    assert found["answered by"] == ["reduced model" if e <= 0.2 else "refused" for e in errors]
    assert "refused" in found["answered by"]
    assert found["inside the box"] == ["True", "True", "False", "True"]
    assert status == 3
    assert "of 4 materials, in" in text
    _, certified = made()
    for i, (lam, mu) in enumerate(((300.0, 200.0), (77.0, 60.0), (600.0, 600.0), (30.0, 20.0))):
        run = certified.run(certified.materials(lam, mu), allow=True)
        assert errors[i] == pytest.approx(run.certificate.reduction, rel=1e-9)  # the same modes in one product
        shown = found["tip_x at the end [m]"][i]
        if found["answered by"][i] == "refused":
            assert shown == ""
        else:
            assert float(shown) == pytest.approx(run.trajectory.outputs[-1, 0], rel=1e-12)
    status, _ = ask(file, batch=table, out=out, tolerance=0.2, fallback="full")
    assert status == 0
    assert set(columns(out)["answered by"]) == {"reduced model", "full model"}


def test_a_motion_from_a_file_is_that_of_the_scene(file: Path) -> None:
    """The scene's own motion, written as a table, gives the same run, also at half the step."""
    _, certified = made()
    assert certified.drive is not None
    assert certified.drive.finer is not None
    fine = certified.drive.finer
    assert fine.hand is not None
    path = file.parent / "motion.csv"
    t = fine.dt * np.arange(fine.steps + 1)
    np.savetxt(path, np.column_stack([t, fine.hand[0]]), delimiter=",", header="t,x,y", comments="")
    own = drive_of(certified)
    read = drive_of(certified, path)
    assert own is certified.drive
    assert read.steps == own.steps
    assert own.hand is not None
    assert read.hand is not None
    size = np.abs(own.hand[0]).max()
    assert np.abs(read.hand[0] - own.hand[0]).max() < 1e-7 * size  # cubic spline of 800 pieces, fourth order
    half, both = drive_of(certified, None, own.dt / 2), drive_of(certified, path, own.dt / 2)
    assert half.steps == both.steps == 2 * own.steps
    assert half.hand is not None
    assert both.hand is not None
    assert np.abs(half.hand[0] - both.hand[0]).max() < 1e-7 * size  # as above
    status, text = ask(file, "lambda=300", "mu=200", motion=path, dt=own.dt / 2)
    assert status == 0
    assert "200 steps of 15 ms" in text


def test_a_fast_motion_is_refused_and_the_full_model_follows_it(file: Path) -> None:
    path, out = file.parent / "fast.csv", file.parent / "fast-full.csv"
    t = np.linspace(0, 0.3, 31)
    s = np.clip(t / 0.2, 0, 1)
    path.write_text("\n".join(f"{a},{5 * b**3 * (10 - 15 * b + 6 * b * b)},0" for a, b in zip(t, s, strict=True)))
    status, text = ask(file, "lambda=30", "mu=20", motion=path, dt=0.005, tolerance=0.1)
    assert status == 3
    assert "refuses to answer" in text
    status, text = ask(file, "lambda=30", "mu=20", motion=path, dt=0.005, tolerance=0.1, fallback="full", out=out)
    assert status == 0
    assert "full model, 60 steps of 5 ms" in text
    assert float(columns(out)["hand_x [m]"][-1]) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["lamda=77"], "did you mean lambda"),
        (["E=77"], "lambda, mu or rho"),
        (["mu"], "did you mean mu"),
        (["mu=much"], "'much' is not a number"),
        (["mu=inf"], "finite"),
        (["mu=1", "mu=2"], "set twice"),
    ],
)
def test_settings_that_make_no_sense(settings: list[str], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        parse_settings(settings)


@pytest.mark.parametrize(
    ("setting", "words"), [({"mu": -1.0}, "positive"), ({"rho": 0.0}, "positive"), ({"lambda": -60.0}, "collapses")]
)
def test_materials_that_make_no_sense(setting: dict[str, float], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        materials_of(made()[1], setting)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "first line"),
        ("1,2\n3,4\n", "first line"),
        ("lambda,nu\n3,4\n", "first line"),
        ("lambda,mu\n", "no row"),
        ("lambda,mu\n3\n", "row 1 has 1 entries"),
        ("lambda,mu\n3,4\n3,x\n", "row 2: 'x' is not a number"),
    ],
)
def test_tables_that_make_no_sense(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(SceneError, match=words):
        read_batch(path)
    with pytest.raises(SceneError, match="cannot be read"):
        read_batch(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,0\n1,1\n", "3 columns"),
        ("0,0,0\n", "at least two"),
        ("0,0,0\n0,1,1\n", "increase"),
        ("1,0,0\n2,1,1\n", "begin at 0"),
        ("0,0,0\nsoon,1,1\n", "not a number"),
    ],
)
def test_motions_that_make_no_sense(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(SceneError, match=rf"--motion.*{words}"):
        drive_of(made()[1], path)
    with pytest.raises(SceneError, match="--dt"):
        drive_of(made()[1], None, 0.0)


def test_files_that_make_no_sense(file: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="is not there"):
        ask(tmp_path / "none.h5")
    other = tmp_path / "table.h5"
    other.write_text("lambda,mu\n")
    with pytest.raises(SceneError, match="no HDF5 file"):
        ask(other)
    flipped = bytearray(file.read_bytes())
    at = len(flipped) // 2
    flipped[at : at + 64] = bytes(64 * [255])
    other.write_bytes(flipped)
    with pytest.raises(SoftgraspError):
        ask(other)
    with pytest.raises(SceneError, match="--fallback"):
        ask(file, fallback="none")
    for out, words in ((tmp_path / "no" / "answer.csv", "there is no folder"), (tmp_path, "it is a folder")):
        with pytest.raises(SceneError, match=f"--csv .*{words}"):
            ask(tmp_path / "none.h5", out=out)  # before the model is looked at
    alone = tmp_path / "a" / "b" / "certified.h5"
    alone.parent.mkdir(parents=True)
    alone.write_bytes(file.read_bytes())
    with pytest.raises(SceneError, match=r"no scene\.toml"):
        ask(alone, tolerance=1e-9, fallback="full")
    with pytest.raises(SoftgraspError, match=r"tissue\.cells = \[4, 8\], and the scene has \[15, 30\]"):
        ask(file, tolerance=1e-9, fallback="full", scene=SCENES / "paper_forward.toml")


def test_a_step_that_no_memory_holds_is_refused(tmp_path: Path) -> None:
    for dt in (1e-300, 1e-9):
        with pytest.raises(SceneError, match=r"--dt .*: a run of 3 s .* GiB is free; use .* steps or fewer"):
            drive_of(made()[1], dt=dt)
    long = tmp_path / "long.csv"
    long.write_text("0,0,0\n1e8,1,1\n")
    with pytest.raises(SceneError, match=r"--motion .*long\.csv: a run of 1e\+08 s .* by a larger --dt"):
        drive_of(made()[1], long)
    assert drive_of(made()[1], long, 1e6).steps == 100
    with pytest.raises(SceneError, match=r"--batch: 1000000000 runs of 3 s"):
        drive_of(made()[1], runs=1_000_000_000)
    with pytest.raises(SceneError, match=r"--dt 1e\+09: the step is longer than the whole move of 3 s"):
        drive_of(made()[1], dt=1e9)
    with pytest.raises(SceneError, match=r"--dt 3: the step is too long for the move; give 1\.5 s or less"):
        drive_of(made()[1], dt=3.0)
    assert drive_of(made()[1], dt=1.5).steps == 2


@pytest.mark.parametrize("steps", [7, 40, 250])
def test_another_step_moves_the_hand_as_a_full_run_of_that_step_does(file: Path, steps: int) -> None:
    """Bit for bit, through the file; the error is that of the reduction alone."""
    model, _ = made()
    time = model.scene.time.model_copy(update={"steps": steps})
    full = simulate(replace(model, scene=model.scene.model_copy(update={"time": time})))
    drive = drive_of(load_certified(file), dt=3.0 / steps)
    assert drive.hand is not None
    assert drive.finer is not None
    assert np.array_equal(drive.hand[0], full.q_s)
    assert np.array_equal(drive.hand[1], full.v_s)
    assert drive.finer.steps == 8 * steps


def test_a_file_of_an_earlier_version_takes_no_other_step(file: Path, tmp_path: Path) -> None:
    old = tmp_path / "old.h5"
    old.write_bytes(file.read_bytes())
    with h5py.File(old, "r+") as data:
        del data["certificate/drive/profile"]
        write_checksums(data)
    status, _ = ask(old, "lambda=300", "mu=200")
    assert status == 0
    with pytest.raises(SceneError, match="earlier version and contains its motion at one step alone"):
        ask(old, "lambda=300", "mu=200", dt=0.01)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("effects.gravity={g=[0.0, -5.0]}", r"without effects\.gravity\.g, and the scene has \[0\.0, -5\.0\]"),
        ("hand.mass=5.0", r"hand\.mass = 20\.0, and the scene has 5\.0"),
        ("time.steps=50", r"time\.steps = 100, and the scene has 50"),
        ("motion.target=[1.0, 3.0]", r"motion\.target"),
        ("effects.reaction=true", r"effects\.reaction"),
    ],
)
def test_the_full_model_of_another_scene_is_no_fallback(file: Path, tmp_path: Path, override: str, key: str) -> None:
    other = tmp_path / "other.toml"
    other.write_text(resolved_toml(load_scene(SCENES / "paper_forward.toml", [*KV, override])))
    with pytest.raises(SceneError, match=f"--fallback full: the certified model was built .*{key}"):
        ask(file, tolerance=1e-9, fallback="full", scene=other)
    soft = tmp_path / "soft.toml"  # a query sets the materials itself
    soft.write_text(
        resolved_toml(
            load_scene(SCENES / "paper_forward.toml", [*KV, "tissue.material={lambda=40.0, mu=40.0, rho=1.0}"])
        )
    )
    assert ask(file, tolerance=1e-9, fallback="full", scene=soft)[0] == 0


def test_quotes_in_the_name_of_a_motion(file: Path, tmp_path: Path) -> None:
    path = tmp_path / 'it\'s "mine".csv'
    path.write_text("0,0,0\n1,1,1\n")
    status, text = ask(file, motion=path, dt=0.05, tolerance=1e-9, fallback="full")
    assert status == 0
    assert "full model, 20 steps" in text


def test_the_command_line(file: Path) -> None:
    runner = CliRunner()
    assert runner.invoke(app, ["query", str(file), "--set", "lambda=300", "--set", "mu=200"]).exit_code == 0
    assert runner.invoke(app, ["query", str(file), "--tolerance", "1e-9"]).exit_code == 3
    text = runner.invoke(app, ["query", "--help"]).output
    for word in ("--set", "--motion", "--dt", "--allow", "--fallback", "--batch", "--csv", "exit status 3"):
        assert word in text


@pytest.mark.parametrize("kind", ["answer", "refused", "full", "batch"])
def test_a_page_says_what_came_out_and_how_far_it_is_off(file: Path, tmp_path: Path, kind: str) -> None:
    keys: dict[str, object] = {"folder": tmp_path / "page"}
    if kind != "answer":
        keys["tolerance"] = 0.2 if kind == "batch" else 1e-6
    if kind == "full":
        keys["fallback"] = "full"
    if kind == "batch":
        (tmp_path / "many.csv").write_text("lambda, mu\n300,200\n77,60\n600,600\n30,20\n")
        keys["batch"] = tmp_path / "many.csv"
    status, _ = ask(file, *(() if kind == "batch" else ("lambda=77", "mu=60")), **keys)
    assert status == (3 if kind in ("refused", "batch") else 0)
    result = json.loads((tmp_path / "page" / "result.json").read_text())
    page = (tmp_path / "page" / "report.html").read_text()
    certified = made()[1]
    for row in result["answers"]:
        run = certified.run(certified.materials(row["lambda [Pa]"], row["mu [Pa]"]), allow=True)
        assert row["error at most"] == pytest.approx(run.certificate.reduction, rel=1e-9)
    assert ('class="warning"' in page) == bool(result["warnings"])
    for name in ("result.json", "data:image/png", f"softgrasp query {file}"):
        assert name in page, name
    if kind == "batch":
        assert "The reduced model answers 2 of 4 materials" in page
        assert len(columns(tmp_path / "page" / "answers.csv")["mesh"]) == 4
    else:
        said = {
            "answer": "the reduced model ends with",
            "refused": "refuses to answer",
            "full": "the full model ends with",
        }
        assert said[kind] in page
        assert (tmp_path / "page" / "answer.csv").exists() == (kind != "refused")
    with pytest.raises(SceneError, match="it contains the results of query"):
        claim(tmp_path / "page", "simulate", "certified")


def test_the_full_model_is_on_the_mesh_that_a_tolerance_led_to(tmp_path: Path) -> None:
    """For other steps too, whose own estimate would ask for another mesh."""
    scene = load_scene(SCENES / "paper_forward.toml", [*KV, "tissue.refine={tolerance=0.05}"])
    model = adapt.build(scene, comm=MPI.COMM_WORLD)
    assert model.system.layout.n_e != build(scene, comm=MPI.COMM_WORLD).system.layout.n_e  # what was built before
    (tmp_path / "scene.toml").write_text(resolved_toml(scene))
    path = tmp_path / "certified.h5"
    save_certified(certified_model(model, lowest_modes(model.system, 16)[1], k=8, tolerance=0.5), path)
    status, text = ask(path, tolerance=1e-9, fallback="full", dt=0.05)
    assert status == 0
    assert "full model, 60 steps" in text
