"""Many runs: sweeps agree with single runs and go on where they stopped, comparisons name what differs."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
from pathlib import Path
from typing import Any

import jsonschema
import meshio
import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.owned import LIST
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.fem.scene.scene import scene_schema
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.report.document import show_sections
from softgrasp.study.runs import sweep as sweep_module
from softgrasp.study.runs.listing import apart, compare, run_compare, runs_below
from softgrasp.study.runs.run import run_sweep, short_table
from softgrasp.study.runs.start import SCHEMA, materials_table, new_scene
from softgrasp.study.runs.sweep import SweepPoint, axis_label, parse_axes, parse_axis

SMALL = ["tissue.cells=[3,6]", "time.steps=60"]
SCENE = shipped_scenes()["paper_forward"]
QUIET = Console(quiet=True)


def test_a_sweep_says_its_values_or_its_form() -> None:
    assert parse_axis("time.steps=100:300:3").values == (100, 200, 300)
    assert parse_axis("a.b=1e1:1e3:3:log").values == pytest.approx((10, 100, 1000), rel=1e-15)
    assert parse_axis("a.b=20,0.5").values == (20.0, 0.5)
    with pytest.raises(SceneError, match=r"a\.b is swept twice; give all its values at once"):
        parse_axes(["a.b=1,2", "c.d=1", "a.b=5,6"])
    for much in (["a.b=1:2:1000000000"], ["a.b=1:2:1000", "c.d=1:2:1000"]):
        with pytest.raises(SceneError, match="at most 100000"):
            parse_axes(much)
    with pytest.raises(SceneError) as long:
        parse_axis("a.b=1:2:" + "9" * 4000)
    assert len(str(long.value)) < 300  # what was typed is not repeated whole
    for wrong in ("a.b=1:2", "a.b=1:2:3:4", "a.b=x", "=1,2", "a.b", "a.b=-1:2:3:log"):
        with pytest.raises(SceneError, match=r"no sweep; write KEY=FIRST:LAST:COUNT"):
            parse_axis(wrong)


@pytest.mark.ranks(2)
def test_a_sweep_agrees_with_single_runs_and_resumes(mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axes = ["tissue.material.mu=20:500:3", "time.steps=60,80"]
    result = run_sweep(SCENE, mpi_tmp_path, SMALL[:1], QUIET, axes=axes, quiet=True, pictures=False)
    assert len(result["points"]) == 6
    for row in result["points"]:
        mu, steps = row["tissue.material.mu"], row["time.steps"]
        model = sg.build(
            "paper_forward", [*SMALL[:1], f"tissue.material.mu={mu}", f"time.steps={steps}"], MPI.COMM_SELF
        )
        run = sg.simulate(model)
        # with_materials adds matrices in another order than assembly: rounding, carried by the steps
        assert row["tip_x end [m]"] == pytest.approx(run.outputs[-1, 0], rel=1e-9)
        assert row["tip_x lag [m]"] == pytest.approx(np.abs(run.outputs - run.outputs_rigid)[:, 0].max(), rel=1e-9)
    together = run_sweep(
        SCENE, mpi_tmp_path / "each", [*SMALL[:1], "time.steps=60"], QUIET, axes=axes[:1],
        each=MPI.COMM_WORLD.size, quiet=True, pictures=False,
    )  # fmt: skip
    for alone, row in zip(result["points"][::2], together["points"], strict=True):
        assert row["tip_x lag [m]"] == pytest.approx(alone["tip_x lag [m]"], rel=1e-9)  # rounding, as above
    monkeypatch.setattr(sweep_module.Runner, "numbers", lambda *_: pytest.fail("it was there already"))
    assert (
        run_sweep(SCENE, mpi_tmp_path, SMALL[:1], QUIET, axes=axes, quiet=True, pictures=False)["points"]
        == result["points"]
    )


@pytest.mark.serial
def test_a_reduced_sweep_tells_its_error_and_a_failed_point_its_reason(tmp_path: Path) -> None:
    axes = ["tissue.material.mu=40,-1,60"]
    with pytest.raises(SceneError, match="must be > 0"):
        run_sweep(SCENE, tmp_path, SMALL, QUIET, axes=axes, quiet=True, reduced=20)
    axes = ["tissue.material.mu=40:60:3"]
    result = run_sweep(SCENE, tmp_path, SMALL, QUIET, axes=axes, quiet=True, reduced=20)
    first, middle, last = result["points"]
    assert middle["error_deformation"] is None
    for row in (first, last):
        full = sg.simulate(sg.build("paper_forward", [*SMALL, f"tissue.material.mu={row['tissue.material.mu']}"]))
        assert 0 < row["error_deformation"] < 0.05
        assert row["tip_x end [m]"] == pytest.approx(full.outputs[-1, 0], abs=0.05 * np.abs(full.outputs[:, 0]).max())
    assert (tmp_path / "sweep.png").stat().st_size > 5000
    failed = run_sweep(SCENE, tmp_path / "b", SMALL, QUIET, axes=["output.memory=1e3,1e-9"], quiet=True, pictures=False)
    assert "reason" not in failed["points"][0]
    assert "reason" in failed["points"][1]


def test_the_table_of_a_sweep_fits_into_a_terminal_and_has_units() -> None:
    outputs = {f"tip_{x} {what} [m]": 0.123456 for what in ("lag", "end") for x in "xyz"}
    rows = [SweepPoint({"tissue.material.mu": 20.0}, {**outputs, "energy_drift": 1.2e-15, "seconds": 1.1e-3})] * 2
    table = short_table(rows)
    assert table.header == ("mu [Pa]", "tip_x lag [m]", "tip_y lag [m]", "tip_z lag [m]")
    for width, left in ((80, 0), (20, 1)):
        console = Console(width=width, file=io.StringIO())
        show_sections(console, [table.section(terminal=True)])
        assert "…" not in console.file.getvalue()
        assert (f"... and {left} more" in console.file.getvalue()) == bool(left)


def test_an_axis_has_its_unit_and_listed_decades_are_logarithmic() -> None:
    assert axis_label("tissue.material.mu") == axis_label("tissue.layers.skin.material.mu") == "mu [Pa]"
    assert axis_label("time.steps") == "steps"
    assert [parse_axis(f"a.b={right}").log for right in ("20,50,200", "20,50,100", "1:100:9", "0,1,100")] == [
        True, False, False, False,
    ]  # fmt: skip


@pytest.mark.serial
def test_a_run_removes_what_the_run_before_left(tmp_path: Path) -> None:
    first = run_simulate(SCENE, tmp_path, SMALL, QUIET, quiet=True, pictures=False)
    assert {"result.json", "fields.pvd", "report.html"} <= set(first["files"])
    for name in ("old.csv", "mine.txt", "../outside.txt"):
        (tmp_path / name).write_text("x")
    named = first | {"files": [*first["files"], "old.csv", "../outside.txt"]}
    (tmp_path / "result.json").write_text(json.dumps(named))
    again = run_simulate(SCENE, tmp_path, [*SMALL, "output.fields='none'"], QUIET, quiet=True, pictures=False)
    there = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert there == {*again["files"], LIST, "old.csv", "mine.txt"}  # no run has written old.csv
    assert (tmp_path / "../outside.txt").exists()
    assert again["time"]["pictures_cpu"] < again["time"]["total_cpu"]


@pytest.mark.serial
def test_two_runs_are_listed_and_compared(tmp_path: Path) -> None:
    for name, mu in (("a", 50.0), ("b", 30.0)):
        changes = [*SMALL, f"tissue.material.mu={mu}"]
        run_simulate(SCENE, tmp_path / name, changes, QUIET, quiet=True, pictures=False)
    listed = [(Path(row[0]).name, row[3]) for row in runs_below(tmp_path)[0].rows]
    assert listed == [("a", "material.mu = 50.0"), ("b", "material.mu = 30.0")]
    comparison = compare(tmp_path / "a", tmp_path / "b")
    assert comparison.keys.rows == [("tissue.material.mu", "50.0", "30.0")]
    numbers = {row[0]: row[1:] for row in comparison.numbers.rows}
    results = [json.loads((tmp_path / name / "result.json").read_text()) for name in "ab"]
    assert numbers["output_final[0]"][:2] == tuple(r["output_final"][0] for r in results)
    assert "n_e" not in numbers
    assert not compare(tmp_path / "a", tmp_path / "a").numbers.rows
    same = apart(compare(tmp_path / "a", tmp_path / "a").traces)
    assert same == "The trajectories differ by at most 0 m, 0 N and 0 J."
    assert apart((["t [s]", "x [m]", "turn [rad]"], np.eye(3), np.diag([1.0, 3.0, -1.0]))) == (
        "The trajectories differ by at most 2 m and 2 rad."
    )
    run_compare(tmp_path / "a", tmp_path / "b", tmp_path / "c", QUIET)
    assert (tmp_path / "c" / "compare.png").stat().st_size > 5000
    with (tmp_path / "c" / "compare.csv").open(newline="") as file:
        assert len(list(csv.reader(file))) == 1 + len(numbers)
    with pytest.raises(SceneError, match=r"result\.json is not there; name folders"):
        compare(tmp_path, tmp_path / "b")
    with pytest.raises(SceneError, match="no such folder"):
        runs_below(tmp_path / "none")


@pytest.mark.serial
@pytest.mark.parametrize("kind", ["2d", "3d", "mesh"])
def test_a_new_scene_runs_and_fits_its_schema(tmp_path: Path, kind: str) -> None:
    mesh = SCENE.parent / "meshes" / "pillow_small.msh" if kind == "mesh" else None
    file, schema = new_scene(tmp_path / "my.toml", solid=kind == "3d", mesh=mesh)
    assert file.read_text().startswith(f"#:schema ./{SCHEMA}\n")
    scene = sg.load_scene(file)
    jsonschema.validate(scene.model_dump(mode="json", by_alias=True, exclude_none=True), json.loads(schema.read_text()))
    run = sg.simulate(
        sg.build(
            file,
            [
                "time.steps=40",
                *([] if mesh else ["tissue.cells=" + "[2,4]" * (kind == "2d") + "[2,2,4]" * (kind == "3d")]),
            ],
        )
    )
    assert np.isfinite(run.outputs).all()
    with pytest.raises(SceneError, match="exists"):
        new_scene(file)
    with pytest.raises(SceneError, match=r"name it my\.toml"):
        new_scene(tmp_path / "my.txt")


@pytest.mark.serial
def test_a_new_scene_turns_inverted_cells_round(tmp_path: Path) -> None:
    """The mesh alone is refused, and there is no scene yet in which `tissue.repair` could be set."""
    points = np.array([[0.0, 0.0], [0.04, 0.0], [0.04, 0.08], [0.0, 0.08]])
    meshio.write(tmp_path / "strip.vtu", meshio.Mesh(points, [("triangle", [[0, 2, 1], [0, 2, 3]])]))
    scene = sg.load_scene(new_scene(tmp_path / "my.toml", mesh=tmp_path / "strip.vtu")[0])
    assert scene.tissue.repair
    mass = sg.build(scene).system.M_rigid[0, 0]  # of the whole strip, as if no cell had been inverted
    assert mass == pytest.approx(1060.0 * 0.04 * 0.08)  # rho of muscle [kg/m3] and 1 m of thickness
    meshio.write(tmp_path / "flat.vtu", meshio.Mesh(points, [("triangle", [[0, 2, 1], [0, 1, 1]])]))
    with pytest.raises(MeshError, match="zero volume"):
        new_scene(tmp_path / "other.toml", mesh=tmp_path / "flat.vtu")


@pytest.mark.serial
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_new_scene_reads_the_groups_of_a_mesh(tmp_path: Path, unit: float) -> None:
    """A strip of 4 cm by 8 cm: muscle or rubber below, tissue above, a grip on top and a floor; in m or mm."""
    below, order = ("muscle", 1) if unit == 1.0 else ("ecoflex-00-30", 2)  # nu = 0.49, where linear elements lock
    x, y = np.meshgrid(np.linspace(0, 0.04, 5), np.linspace(0, 0.08, 9))
    corner = np.arange(40).reshape(8, 5)[:, :4].ravel()
    cells = np.vstack([np.c_[corner, corner + 1, corner + 6], np.c_[corner, corner + 6, corner + 5]])
    tags = np.where(y.ravel()[cells].mean(axis=1) > 0.04, 2, 1)
    low, numbers = np.c_[np.arange(4), np.arange(1, 5)], [np.full(n, i + 1) for i, n in enumerate((32, 32, 4, 4))]
    mesh = meshio.Mesh(
        unit * np.c_[x.ravel(), y.ravel(), 0 * x.ravel()],
        [("triangle", cells[tags == 1]), ("triangle", cells[tags == 2]), ("line", low), ("line", low + 40)],
        cell_data={"gmsh:physical": numbers, "gmsh:geometrical": numbers},
        field_data={below: np.array([1, 2]), "tissue": np.array([2, 2])}
        | {"floor": np.array([3, 1]), "grip": np.array([4, 1])},
    )
    (tmp_path / "meshes").mkdir()
    meshio.write(tmp_path / "meshes" / "strip.msh", mesh, file_format="gmsh22", binary=False)
    (tmp_path / "scenes").mkdir()
    file, _ = new_scene(tmp_path / "scenes" / "my.toml", mesh=tmp_path / "meshes" / "strip.msh")
    scene = sg.load_scene(file)
    assert scene.tissue.mesh == "../meshes/strip.msh"  # both folders may move together
    assert scene.contact.facet_tag == "grip"
    assert '# other groups: "floor"; or sides and box' in file.read_text()
    layers = {name: layer.tag for name, layer in scene.tissue.layers.items()}
    assert layers == {below: below, "tissue_group": "tissue"}  # a layer may not be called tissue
    assert scene.tissue.scale == (1.0 if unit == 1.0 else 1e-3)
    assert scene.tissue.order == order
    model = sg.build(scene)
    held = model.system.layout.held
    assert held.shape == (4 * order + 1, 2)
    assert np.allclose(held[:, 1], 0.08, atol=1e-9)  # in metres, whatever the file's unit; numbers of text
    assert len(model.system.layers) == 2  # nothing is outside of both


def test_materials_have_sources() -> None:
    assert all(row[-1] for row in materials_table().rows)


def test_the_schema_beside_the_shipped_scenes_is_current() -> None:
    shipped = json.loads((SCENE.parent / SCHEMA).read_text())
    assert shipped == scene_schema(), f"write it again: softgrasp schema > demos/scenes/{SCHEMA}"
    assert all(path.read_text().startswith(f"#:schema ./{SCHEMA}\n") for path in shipped_scenes().values())


@pytest.mark.serial
def test_a_foreign_result_does_not_end_the_list(tmp_path: Path) -> None:
    """Whatever lies below a folder by that name, the runs of softgrasp are listed and the others named."""
    good = {"command": "simulate", "scene": "strip", "time": {"total": 1.5}, "n_e": 10}
    texts = (
        json.dumps(good),
        "[1]",
        "{",
        "\xff",
        '{"command": 5}',
        json.dumps({**good, "time": 3, "warnings": 7, "n_e": []}),
    )
    for i, text in enumerate(texts):
        (tmp_path / str(i)).mkdir()
        (tmp_path / str(i) / "result.json").write_text(text, encoding="latin-1")
    (tmp_path / "6").mkdir()
    (tmp_path / "6" / "result.json").symlink_to(tmp_path / "gone")
    os.mkfifo(tmp_path / "6" / "pipe")
    runs, foreign = runs_below(tmp_path)
    assert {Path(row[0]).name for row in runs.rows} == {"0", "5"}
    assert {file.parent.name for file in foreign} == {"1", "2", "3", "4", "6"}
    with pytest.raises(SceneError, match=r"2/result\.json contains no result of softgrasp"):
        compare(tmp_path / "0", tmp_path / "2")


@pytest.mark.serial
def test_a_new_scene_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_text

    def full(path: Path, text: str, **how: Any) -> int:
        if "schema" not in path.name:
            return write(path, text, **how)
        write(path, text[:100])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        new_scene(tmp_path / "my.toml")
    assert list(tmp_path.iterdir()) == []
