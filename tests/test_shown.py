"""What users meet in a notebook: objects that show themselves, labelled data, names, keyword tables."""

from __future__ import annotations

import html
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import softgrasp as sg
from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.shown import Shown, amount, digits, percent
from softgrasp.lqr.loop.full import LoopOptions
from softgrasp.lqr.loop.margins import loop_margins

pytestmark = pytest.mark.serial
SMALL: dict[str, Any] = {"tissue": {"cells": [4, 8]}}
LONGEST = 1000  # letters of what an object prints


@pytest.fixture(scope="module")
def objects() -> dict[str, Any]:
    """One of each class that `import softgrasp` returns, of a small scene."""
    model = sg.build("paper_lqr", **SMALL, time={"steps": 300})
    run = sg.simulate(model)
    rom = sg.reduce(model, run, "psd_fixed", N=14)
    design = sg.design(model)
    controller = sg.make_controller(design, order=8)
    kept = LoopOptions(snapshots="memory", every=3)
    loop = sg.ClosedLoop(design.problem, dt=0.5).run(design.gain, target=[5.0, 3.0], steps=60, options=kept)
    table = sg.compare_bases(model, run, ["psd_fixed", "craig_bampton"], N=[14, 3, 20])
    strained = sg.build("paper_forward", **SMALL, time={"steps": 100}, effects={"finite_strain": {}})
    strained_run = sg.simulate(strained)
    strain_model = sg.reduce(strained, strained_run, N=14)
    return {
        "scene": model.scene, "model": model, "run": run, "rom": rom, "system": rom.at(),
        "replay": sg.replay(rom, model, run), "design": design, "controller": controller,
        "margins": loop_margins(controller), "problem": design.problem, "solution": design.solution, "loop": loop,
        "table": table, "strained_run": strained_run, "strain_model": strain_model,
        "abscissa": sg.abscissa(design.problem, design.gain),
        "strain_replay": sg.replay(strain_model, strained, strained_run),
    }  # fmt: skip


def inside(value: Any, depth: int = 2) -> list[Any]:
    """An object and the data classes that it holds, which users print next."""
    if not is_dataclass(value) or depth == 0:
        return []
    return [value, *(part for f in fields(value) for part in inside(getattr(value, f.name), depth - 1))]


def test_no_object_prints_more_than_a_screen(objects: dict[str, Any]) -> None:
    shown = [part for value in objects.values() for part in (inside(value) or [value]) if isinstance(part, Shown)]
    assert {type(value).__name__ for value in objects.values()} <= {type(part).__name__ for part in shown}
    longest = max(shown, key=lambda part: len(repr(part)))
    assert len(repr(longest)) <= LONGEST, repr(longest)
    for part in shown:
        assert part._repr_html_().count("<tr>") == len(part.card().rows)


def test_cards_hold_the_numbers_of_the_objects(objects: dict[str, Any]) -> None:
    rows = dict(objects["model"].card().rows)
    assert rows["unknowns"] == f"hand 2, tissue {objects['model'].system.layout.n_e}, {objects['model'].states} states"
    assert rows["effects"] == "damping"
    assert "2D, P1, 64 cells" in repr(objects["model"])  # 4 x 8 boxes of two triangles
    poles = np.linalg.eigvals(
        np.linalg.solve(objects["system"].E, objects["system"].A)[4:, 4:]
    )  # without the free hand
    assert f"spectral abscissa {poles.real.max():.3g} 1/s" in repr(objects["system"])
    assert dict(objects["controller"].card().rows)["hand at rest"] == "5 m, 3 m"
    error = sg.errors(objects["rom"], objects["replay"], objects["model"], objects["run"])
    assert dict(error.card().rows)["deformation and its rate"] == percent(error.error_deformation)  # type: ignore[union-attr]


def test_units_and_labels_of_a_run(objects: dict[str, Any]) -> None:
    pytest.importorskip("xarray")
    run, loop = objects["run"], objects["loop"]
    data = run.to_xarray()
    assert dict(data.sizes) == {"time": 301, "output": 2, "hand": 2, "midpoint": 300}
    assert data.outputs.attrs["units"] == "m"
    assert data.force.attrs["units"] == "N"
    np.testing.assert_array_equal(data.outputs.sel(output="tip_y"), run.outputs[:, 1])
    np.testing.assert_array_equal(data.midpoint, run.times[:-1] + run.times[1] / 2)
    assert (data.energy.dims, data.energy.attrs["units"]) == (("time",), "J")
    np.testing.assert_array_equal(run.to_pandas()["energy [J]"], run.energy)
    table = loop.to_pandas()
    np.testing.assert_array_equal(table["dissipated [J]"], loop.dissipated)
    np.testing.assert_array_equal(table["inputs y [N]"][1:], loop.inputs[:, 1])
    assert np.isnan(table["inputs y [N]"].iloc[0])
    small = objects["replay"].to_xarray()
    assert small.outputs.shape == (301, 2)
    # Craig-Bampton's model has its share of the tissue's energy, as of the motion
    assert abs(small.energy - data.energy).max() < 0.1 * data.energy.max()
    strained = objects["strain_replay"]
    np.testing.assert_array_equal(strained.to_pandas()["energy [J]"], strained.energy)


def test_figures_show_what_the_objects_hold(objects: dict[str, Any], tmp_path: Path) -> None:
    run, rom, loop = objects["run"], objects["rom"], objects["loop"]
    outputs, relative = run.plot().axes
    np.testing.assert_array_equal(outputs.lines[0].get_ydata(), run.outputs[:, 0])
    np.testing.assert_array_equal(relative.lines[1].get_ydata(), (run.outputs - run.outputs_rigid)[:, 1])
    np.testing.assert_array_equal(
        objects["replay"].plot().axes[0].lines[1].get_ydata(), objects["replay"].outputs[:, 1]
    )
    np.testing.assert_array_equal(loop.plot().axes[0].lines[0].get_ydata(), loop.outputs[:, 0])
    assert len(objects["margins"].plot().axes) == 2
    gain = objects["system"].bode().axes[0].lines[0]
    omega = gain.get_xdata()[100]
    E, A, B, C = (getattr(objects["system"], name) for name in "EABC")
    exact = abs(C @ np.linalg.solve(1j * omega * E - A, B))[0, 0]
    assert gain.get_ydata()[100] == pytest.approx(exact, rel=1e-9)  # two orders of the same sums
    # of a free hand rounding leaves the poles +-1e-4i, where only +-4i of the tissue is to see
    turn, zero = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.zeros((2, 2))
    free = ReducedSystem(
        np.eye(4), np.block([[1e-4 * turn, zero], [zero, 4 * turn]]), np.ones((4, 1)), np.ones((1, 4)), np.zeros(4),
        np.zeros((1, 4)), np.zeros((1, 4)),
    )  # fmt: skip
    assert free.bode().axes[0].lines[0].get_xdata()[0] == pytest.approx(0.4)  # a decade below the pole
    _, error = rom.plot_errors(objects["model"], run).axes
    change = objects["replay"].outputs - run.outputs
    scale = np.linalg.norm(run.outputs - run.outputs_rigid, axis=1).max()
    np.testing.assert_allclose(
        error.lines[0].get_ydata(), np.linalg.norm(change, axis=1)[1:] / scale, atol=1e-12
    )  # rounding
    film = run.animate(objects["model"])
    with Image.open(film.save(tmp_path / "move.gif")) as picture:
        assert picture.n_frames > 10
    for move, cure in ((run, "set output.snapshots = 'memory'"), (loop, "give its LoopOptions snapshots = 'memory'")):
        with pytest.raises(SoftgraspError, match=f"kept no snapshots in memory; {cure}"):
            replace(move, snapshots=None).animate(objects["model"])
    with Image.open(loop.animate(objects["model"]).save(tmp_path / "loop.gif")) as picture:
        assert picture.n_frames > 10
    assert '<canvas id="c"' in loop.view3d(objects["model"]).html
    view = run.view3d(objects["model"])
    assert view.save(tmp_path / "move.html").read_text() == view.html
    assert '<canvas id="c"' in view.html
    assert re.search(r"relative to the hand \[m?m\]", view.html)
    assert re.fullmatch(r"View of \d+ kB; .*", repr(view))
    for empty in (replace(view, html=""), replace(film, gif=b"")):  # of a rank above 0
        assert empty.save(tmp_path / "move.html").read_text() == view.html
    assert html.unescape(view._repr_html_().split('srcdoc="')[1].split('">')[0]) == view.html


def test_a_table_of_bases_has_the_errors_of_its_models(objects: dict[str, Any]) -> None:
    pytest.importorskip("xarray")
    model, run, table = objects["model"], objects["run"], objects["table"]
    own = sg.errors(objects["rom"], objects["replay"], model, run)  # made without the table
    data, rows = table.to_xarray(), table.to_pandas()
    at = data.sel(basis="psd_fixed", N=14)
    # rounding of snapshots factored for 20 columns; the energy cancels more
    assert at.error_deformation.item() == pytest.approx(own.error_deformation, rel=1e-6)
    assert at.error.item() == pytest.approx(own.error, rel=1e-6)
    assert (data.time_online.attrs["units"], data.error.attrs["units"]) == ("s", "1")
    assert np.isnan(data.error.sel(N=3)).all()
    assert not data.stable.sel(N=3).any()  # fewer columns than the hand has
    assert dict(rows.groupby("basis").size()) == {"psd_fixed": 2, "craig_bampton": 2}
    assert set(rows["spectral_abscissa [1/s]"]) == {p.spectral_abscissa for s in table.sweeps for p in s.points}
    drawn = {tuple(line.get_ydata()) for line in table.plot().axes[0].lines}
    assert tuple(p.error_deformation for p in table.sweeps[1].points) in drawn
    least = rows.loc[rows.error_deformation.idxmin()]
    assert f"{percent(least.error_deformation)} of the deformation, {least.basis} at N = {least.N}" in repr(table)


def test_a_table_of_bases_refuses_what_it_cannot_compare(objects: dict[str, Any]) -> None:
    model, run = objects["model"], objects["run"]
    for wrong in (14, [], [2.5], [0]):
        with pytest.raises(SceneError, match=r"N = .* must be a list of positive whole numbers, as in \[14, 30\]"):
            sg.compare_bases(model, run, N=wrong)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match=r"methods = 'psd' must be a list, as in \['psd'\]"):
        sg.compare_bases(model, run, "psd")
    with pytest.raises(SoftgraspError, match="basis 'pssd' is unknown"):
        sg.compare_bases(model, run, ["pssd"])
    strained = sg.build("paper_forward", **SMALL, effects={"finite_strain": {}})
    with pytest.raises(SceneError, match=r"has effects\.finite_strain, whose models have one basis"):
        sg.compare_bases(strained, objects["strained_run"])


def test_sliders_show_the_reduced_model_at_their_material(
    objects: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ipywidgets")
    shown: list[Any] = []
    monkeypatch.setattr("softgrasp.study.notebook.reduced", shown.append)
    rom, model, run = (objects[key] for key in ("rom", "model", "run"))
    lam, mu, _ = rom.explore(model, run).children
    assert (lam.description, mu.description) == ("lambda [Pa]", "mu [Pa]")
    mu.value = 2 * mu.value
    other = model.with_materials(mu=mu.value)
    for answer, at in zip(shown, (model, other), strict=True):
        expected = sg.replay(rom, at, run).outputs
        np.testing.assert_allclose(answer.outputs, expected, rtol=0, atol=1e-9)  # of 5 m, rounding of K(mu)
    assert np.abs(shown[1].outputs - shown[0].outputs).max() > 0.01  # a stiffer body lags less
    with pytest.raises(SoftgraspError, match=r"span = 1 must be a ratio above 1"):
        rom.explore(model, run, span=1)
    capsys.readouterr()  # what a display without a notebook prints


def test_a_sweep_from_python_is_the_runs_one_by_one() -> None:
    values = {"tissue.material.mu": [20.0, 500.0], "tissue.cells": [[4, 8]]}
    table = sg.sweep("paper_forward", values)
    for point, mu in zip(table.points, values["tissue.material.mu"], strict=True):
        run = sg.simulate(sg.build("paper_forward", tissue={"cells": [4, 8], "material": {"mu": mu}}))
        lag = abs(run.outputs - run.outputs_rigid).max(axis=0)[0]
        assert point.numbers["tip_x lag [m]"] == pytest.approx(lag, rel=1e-12)  # matrices summed, not assembled
    assert list(table.to_pandas()["tissue.material.mu"]) == [20.0, 500.0]
    data = table.to_xarray()["tip_x lag"]
    assert data.sel({"tissue.material.mu": 500.0}).item() == table.points[1].numbers["tip_x lag [m]"]
    assert (data.attrs["units"], data["tissue.material.mu"].attrs["units"]) == ("m", "Pa")
    assert "2, of them 0 refused" in repr(table)
    with pytest.raises(SceneError, match=r"tissue\.material\.nu is not a key"):
        sg.sweep("paper_forward", {"tissue.material.nu": [0.3]})
    with pytest.raises(SceneError, match=r"tissue\.material\.mu needs a list of values"):
        sg.sweep("paper_forward", {"tissue.material.mu": 20.0})  # type: ignore[dict-item]
    with pytest.raises(SceneError, match="has 0 points"):
        sg.sweep("paper_forward", {"tissue.material.mu": []})


def test_tables_of_keys_are_overrides() -> None:
    kept = {"tissue": {"cells": (4, 8), "material": {"young": 1e3}}, "effects": {"finite_strain": {}}}
    given = ["tissue.cells=[4, 8]", "tissue.material={young=1e3, poisson=0.3, rho=1}", "effects.finite_strain={}"]
    kept["tissue"]["material"] |= {"poisson": 0.3, "rho": 1}  # type: ignore[operator]
    with pytest.raises(SceneError, match="young and poisson exclude lambda and mu"):  # the scene's own stay
        sg.load_scene("paper_forward", **kept)
    scene = sg.load_scene("paper_forward", given[:2], effects={"finite_strain": {}})
    assert scene == sg.load_scene("paper_forward", given)
    with pytest.raises(SceneError, match=r"tissue\.cels is not a key"):
        sg.load_scene("paper_forward", tissue={"cels": [4, 8]})


def test_young_and_poisson_are_lambda_and_mu(objects: dict[str, Any]) -> None:
    model = objects["model"]
    (material,) = model.with_materials(young=130.0, poisson=0.3).system.materials
    assert material.lam == pytest.approx(75.0, rel=1e-14)  # E nu / ((1 + nu) (1 - 2 nu)), rounding
    assert material.mu == pytest.approx(50.0, rel=1e-14)  # E / (2 (1 + nu)), rounding
    for wrong in ({"young": 1.0}, {"young": 1.0, "poisson": 0.3, "mu": 2.0}, {"young": 1.0, "poisson": 0.5}):
        with pytest.raises(SceneError, match="young"):
            model.with_materials(**wrong)


@pytest.mark.parametrize("call", [sg.simulate, sg.problem, sg.design])
def test_a_name_where_a_model_is_needed_says_what_to_write(call: Any) -> None:
    with pytest.raises(SceneError, match=r'give softgrasp\.build\("paper_forward"\)'):
        call("paper_forward")


def test_the_names_of_the_package_are_the_public_ones() -> None:
    assert set(dir(sg)) == {*sg.__all__, "__version__"}
    with pytest.raises(AttributeError, match=r"module 'softgrasp' has no attribute 'build_model'; it has ClosedLoop, "):
        sg.build_model  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(AttributeError, match=r"module 'softgrasp\.fem' has no attribute 'build_model'"):
        sg.fem.build_model  # noqa: B018


def test_a_missing_package_is_named(objects: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    with pytest.raises(SoftgraspError, match=r"xarray is not installed; `pip install 'softgrasp\[data\]'`"):
        objects["run"].to_xarray()


def test_percentages_have_two_digits_and_a_sign_on_request() -> None:
    assert [percent(x) for x in (0.0037, -0.054, 0.999, -1.55, 200.0, -200.0, float("nan"))] == [
        "0.37 %", "-5.4 %", "100 %", "-155 %", "> 9999 %", "< -9999 %", "> 9999 %",
    ]  # fmt: skip
    assert [percent(x, "+") for x in (0.0037, -0.054, 5.3, 9e-7)] == ["+0.37 %", "-5.4 %", "+530 %", "+9e-05 %"]


def test_moduli_are_written_out_below_ten_million() -> None:
    assert [digits(x) for x in (3e4, -45678.9, 0.00301, 9.9996e6, 2.1e11)] == [
        "30000", "-45680", "0.00301", "10000000", "2.1e+11",
    ]  # fmt: skip
    assert amount(3e4, "Pa") == "30000 Pa"
