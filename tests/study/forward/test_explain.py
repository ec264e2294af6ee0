"""explain tells exactly the terms of the scene, its sizes, and what deserves a look."""

from __future__ import annotations

import io
import json
import math
import re
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.effects.gate import SMALL_SHARE
from softgrasp.fem.model.build import build
from softgrasp.fem.model.memory import factor_bytes
from softgrasp.fem.model.scales import gradient, slowest
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.solvers import choose_solver, make_solver
from softgrasp.study.forward.cautions import inexact, run_warnings
from softgrasp.study.forward.copies import build_seconds
from softgrasp.study.forward.explain import Explanation, explain
from softgrasp.study.forward.explain_page import run_explain, sections
from softgrasp.study.report.document import show_sections
from softgrasp.study.report.equation import equation
from softgrasp.study.shell.ending import console
from tests.helpers.models import make_scene

FORCE = {"target": [1.0, 0.0], "drive": "force"}
RAYLEIGH = {"kind": "rayleigh", "alpha": 0.1, "beta": 0.01}


def scene_of(order: int = 1, material: dict[str, float] | None = None, **parts: Any) -> Scene:
    data: dict[str, Any] = {
        "name": "told",
        "tissue": {
            "size": [1.0, 2.0],
            "cells": [4, 8],
            "order": order,
            "material": material or {"lambda": 50.0, "mu": 50.0, "rho": 1.0},
        },
        "contact": {"sides": ["left", "right"], "box": [[0.0, 1.5], [1.0, 2.0]]},
        "motion": {"target": [1.0, 0.0], "duration": 2.0},
        "time": {"steps": 100},
    }
    return Scene.model_validate(data | parts)


def stepped(scene: Scene) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    return {name: (left, right) for name, left, right in equation(scene).plain().stepped}


def blocks(scene: Scene) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    return {name: (left, right) for name, left, right in equation(scene).plain().blocks}


def test_bare_scene() -> None:
    scene = scene_of()
    rows = stepped(scene)
    assert rows["tissue"] == (("M_ee z''", "K_ee z"), ("-G q_s''",))
    assert rows["hand"][0] == ("q_s",)
    assert blocks(scene) == {
        "hand": (("M_ss q_s''",), ("u",)),
        "tissue": (("M_es q_s''", "M_ee q_e''", "K_es q_s", "K_ee q_e"), ("0",)),
    }
    text = " ".join(equation(scene).where)
    assert "one-way" in text
    assert not any(word in text for word in ("D_ee", "f_e", "angles", "layers", "two-way"))


def test_gravity_and_damping_add_their_terms_only() -> None:
    gravity = scene_of(effects={"gravity": {"g": [0.0, -1.0]}})
    assert stepped(gravity)["tissue"] == (("M_ee z''", "K_ee z"), ("-G (q_s'' - g)",))
    assert blocks(gravity)["tissue"][1] == ("f_e",)
    damped = scene_of(effects={"damping": RAYLEIGH})
    assert stepped(damped)["tissue"] == (("M_ee z''", "D_ee z'", "K_ee z"), ("-G q_s''",))
    dragged = scene_of(effects={"damping": RAYLEIGH | {"drag": "space"}})
    assert stepped(dragged)["tissue"][1] == ("-G q_s''", "- alpha G q_s'")


def test_force_and_two_way() -> None:
    free = scene_of(motion=FORCE, effects={"gravity": {"g": [0.0, -1.0], "hand_weight": True}})
    assert stepped(free)["hand"] == (("M_hand q_s''",), ("u(t)", "M_hand g"))
    two_way = scene_of(motion=FORCE, effects={"reaction": True})
    assert stepped(two_way)["hand"] == (("M_hand q_s''", "M_r q_s''", "G' z''"), ("u(t)",))
    assert blocks(two_way)["hand"] == (("M_ss q_s''", "M_se q_e''", "K_ss q_s", "K_se q_e"), ("u",))
    assert "two-way" in " ".join(equation(two_way).where)
    dragged = scene_of(
        motion=FORCE,
        effects={"reaction": True, "gravity": {"g": [0.0, -1.0]}, "damping": RAYLEIGH | {"drag": "space"}},
    )
    assert stepped(dragged)["hand"][0] == (
        "M_hand q_s''", "M_r (q_s'' - g)", "G' z''", "alpha M_r q_s'", "alpha G' z'",
    )  # fmt: skip
    held = stepped(scene_of(effects={"reaction": True}))
    assert held["required force"][0] == ("u",), "a prescribed motion leaves the force to be found"


def test_paper_sizes(comm: MPI.Intracomm) -> None:
    data = scene_of().model_dump(by_alias=True)
    tissue = {"size": [1.0, 2.0], "cells": [15, 30], "material": data["tissue"]["material"]}
    scene = scene_of().model_validate(data | {"tissue": tissue})
    result = explain(scene, comm)
    assert (result.sizes.n_s, result.sizes.n_e, result.sizes.states) == (2, 956, 1916)
    assert (result.sizes.cells, result.sizes.nodes) == (2 * 15 * 30, 16 * 31)
    assert result.snapshot_bytes == 25 * 2 * 956 * 8  # of 101, those that the warnings take
    assert result.time.dt == 0.02
    omega = np.array(result.time.omega)
    np.testing.assert_array_equal(result.time.omega_dt, omega * 0.02)
    np.testing.assert_array_equal(result.time.periods, 2 * np.pi / omega)
    assert result.effects["reaction"].gate.number == pytest.approx(0.1, rel=1e-13)  # mass of 900 cells, summed


@pytest.mark.parametrize(("order", "locks"), [(1, True), (2, False)])
def test_locking(comm: MPI.Intracomm, order: int, locks: bool) -> None:
    material = {"young": 100.0, "poisson": 0.499, "rho": 1.0}
    result = explain(scene_of(order, material), comm)
    assert result.poisson["tissue"] == pytest.approx(0.499, rel=1e-12)  # 1 - 2 nu loses three digits
    assert any("P1 locks" in w and "tissue.order = 2" in w for w in result.warnings) == locks


@pytest.mark.parametrize(("nu", "ratio"), [(0.44, None), (0.45, 9), (0.49, 49)])
def test_locking_is_warned_of_with_a_number_from_045_on(comm: MPI.Intracomm, nu: float, ratio: int | None) -> None:
    result = explain(scene_of(1, {"young": 100.0, "poisson": nu, "rho": 1.0}), comm)
    assert any("locks" in w for w in result.warnings) == (ratio is not None)
    assert any(f"P1 locks, its error grows with lambda / mu = {ratio};" in w for w in result.warnings) == bool(ratio)


def test_singular_ends_and_the_error_they_leave(comm: MPI.Intracomm) -> None:
    """The paper's block has 1/2 at the lower ends of the zone and 0.745 at its corners; more cells, less error."""
    coarse, fine = (explain(make_scene({"tissue": {"cells": [n, 2 * n]}}), comm).mesh for n in (4, 16))
    assert [(e.kind, e.count, e.alpha) for e in coarse.ends] == [("contact end", 2, 0.5), ("contact end", 2, 0.745)]
    assert coarse.order == pytest.approx(1.0)
    assert not coarse.graded
    ratio = coarse.estimate / fine.estimate
    assert 2.5 < ratio < 4.5  # order one, from a mesh that is too coarse to show it exactly
    graded = explain(make_scene({"tissue": {"order": 2, "refine": {"tolerance": 0.03}}}), comm).mesh
    assert graded.order == pytest.approx(4.0)
    assert graded.estimate < fine.estimate / 2
    assert [e.count for e in graded.ends] == [2, 2]


def test_missing_idle_and_coarse(comm: MPI.Intracomm) -> None:
    scene = scene_of(
        hand={"mass": 1e6},
        effects={"gravity": {"g": [0.0, -1e-6]}, "reaction": True},
        control={"outputs": [{"kind": "hand"}]},
        time={"steps": 2},
    )
    result = explain(scene, comm)
    assert result.missing == ("damping", "finite_strain")
    assert result.idle == ("gravity", "reaction")
    assert any("steps" in w and "coarse" in w for w in result.warnings)


def test_large_strain_and_angle(comm: MPI.Intracomm) -> None:
    scene = scene_of(
        hand={"inertia": 1.0},
        effects={"gravity": {"g": [0.0, -20.0]}, "rotation": True},
        motion={"target": [0.0, 0.0, -0.5]},
    )
    result = explain(scene, comm)
    assert any("small strains" in w for w in result.warnings)
    assert any("0.5 rad" in w and "12 %" in w for w in result.warnings)


def test_a_run_that_stores_nothing_warns_of_a_strain_seen_on_the_way(comm: MPI.Intracomm) -> None:
    still = scene_of(motion={"target": [1e-3, 0.0]}, output={"snapshots": "none"})
    model = build(still, comm=comm)
    run = simulate(model)
    assert run.snapshots is None
    assert run_warnings(model, run) == []
    z = np.zeros(model.system.layout.n_local)
    z[::2] = model.space.layout.nodes[:, 1] / 2  # sheared by a half
    (found,) = run_warnings(model, run, (0.25, z))
    assert "at t = 0.25 s, and at most" in found


def test_a_run_warns_of_what_explain_warns_of(comm: MPI.Intracomm) -> None:
    few = scene_of(1, {"young": 100.0, "poisson": 0.499, "rho": 1.0}, time={"steps": 6})
    model = build(few, comm=comm)
    found = run_warnings(model, simulate(model))
    told = explain(few, comm).warnings
    assert told[0] in found  # locking, word by word
    coarse, strained = (next(w for w in found if word in w) for word in ("coarse in time", "small strains"))
    assert coarse.split(": use")[1] == next(w for w in told if "coarse" in w).split(": use")[1]  # as many steps
    assert "of the body at t =" in strained
    gentle = {"motion": {"target": [1e-3, 0.0], "duration": 2.0}, "time": {"steps": 400}}
    model = build(scene_of(2, {"young": 100.0, "poisson": 0.499, "rho": 1.0}, **gentle), comm=comm)
    assert run_warnings(model, simulate(model)) == []


def test_slowest_period_and_gradient(comm: MPI.Intracomm) -> None:
    model = build(scene_of(2, contact={"sides": ["top"]}), comm=comm)
    layout = model.system.layout
    omega, Phi = lowest_modes(model.system, 3)
    moving = Phi @ np.array([[1.0, 0.0, 0.0, -1.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0]])
    # three directions are left of four columns without their mean: all three modes; rounding in the eigenvalues
    assert slowest(model.system, moving) == pytest.approx(omega[0], rel=1e-8)
    assert slowest(model.system, np.repeat(Phi[:, :1], 4, axis=1)) == 0.0  # a deformation that does not move
    z = 0.3 * (layout.nodes - [0.0, 2.0]) @ np.array([[0.0, 0.0], [1.0, 0.0]])  # shear, zero at the hand
    steep = gradient(model, z.ravel())
    assert steep.largest == pytest.approx(0.3, rel=1e-12)  # linear, so exact but for rounding
    assert steep.typical == pytest.approx(0.3, rel=1e-12)  # as above
    assert steep.share == 1.0
    assert gradient(model, z.ravel() / 4).share == 0.0


def test_typical_gradient_leaves_out_a_hundredth_of_the_body(comm: MPI.Intracomm) -> None:
    """z_x = y^2 / 2 has the slope of the middle of each row of cells; a row is one in 200 of the body."""
    rows = 200
    tissue = {"size": [0.02, 2.0], "cells": [1, rows], "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}}
    model = build(scene_of(tissue=tissue, contact={"sides": ["bottom"]}), comm=comm)
    z = np.zeros(model.system.layout.n_local)
    z[::2] = model.system.layout.nodes[:, 1] ** 2 / 2
    steep = gradient(model, z)
    slopes = 2.0 * (np.arange(rows) + 0.5) / rows
    assert steep.largest == pytest.approx(slopes[-1], rel=1e-10)  # differences of nodes lose a few digits
    assert steep.typical == pytest.approx(slopes[-1 - int(SMALL_SHARE * rows)], rel=1e-10)  # as above
    assert steep.share == pytest.approx(np.mean(slopes > 0.1), rel=1e-12)  # sums of volumes


def test_digits_that_are_left() -> None:
    assert inexact(1e-12, 1e-14, "cholesky", 0.3) == []
    assert inexact(1e-12, 1e-4, "cg", 0.3) == []  # the tolerance of a step
    assert "5 digits" in inexact(1e-5, 1e-4, "stars", 0.3)[0]  # energy is exact at any tolerance
    assert "about 5 digits, because nu = 0.5 - 2.0e-11" in inexact(5.7e-6, 1e-14, "cholesky", 0.5 - 2e-11)[0]
    assert "badly conditioned" in inexact(1e-12, 1e-7, "mumps", 0.3)[0]
    assert "time.rtol" in inexact(1e-12, 1e-2, "cg", 0.3)[0]
    assert "about 2 digits, because time.rtol" in inexact(1e-12, 1e-5, "stars", 0.3, solves=2e-3)[0]


@pytest.mark.serial
@pytest.mark.parametrize("cells", [[15, 30], [60, 120], [4, 4, 8]])
def test_factor_estimate(comm: MPI.Intracomm, cells: list[int]) -> None:
    d = len(cells)
    tissue = {"size": [1.0, 2.0, 2.0][:d], "cells": cells, "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}}
    scene = scene_of(tissue=tissue, contact={"sides": ["left"]}, motion={"profile": "hold"})
    system = build(scene, comm=comm).system
    name, _ = choose_solver(system.layout)
    solver = make_solver(midpoint_matrix(system, 0.01), name, system.layout, "softgrasp_test_")
    factor = solver.ksp.getPC().getFactorMatrix()
    entry = 8 + 4 / (factor.getBlockSize() ** 2 if name == "cholesky" else 1)
    used = entry * factor.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
    solver.destroy()
    ratio = factor_bytes(name, system.layout.n_e, d, 1) / used
    assert 1 / 2 < ratio < 2, f"{name}: estimate over truth is {ratio}"  # an estimate of the right size


def text_of(result: Explanation, width: int) -> str:
    terminal = Console(file=io.StringIO(), width=width, color_system=None)
    show_sections(terminal, sections(result))
    return terminal.file.getvalue()  # type: ignore[attr-defined]


def test_text_and_json(comm: MPI.Intracomm) -> None:
    result = explain(scene_of(effects={"gravity": {"g": [0.0, -1.0]}}), comm)
    text = text_of(result, 200)
    assert "tissue: M_ee z'' + K_ee z = -G (q_s'' - g)" in text
    assert "|grad z| of its sag = " in text
    assert re.search(rf"largest \|z\| +{result.sag.largest:.4g} m", text)
    assert f"n_e = {result.sizes.n_e}" in text
    assert max(map(len, text_of(result, 40).splitlines())) <= 40
    data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert data["sizes"]["n_e"] == result.sizes.n_e
    assert data["effects"]["gravity"]["on"] is True
    assert data["effects"]["gravity"]["gate"]["matters"] is True


@pytest.mark.ranks
def test_only_rank_zero_writes(comm: MPI.Intracomm, capsys: pytest.CaptureFixture[str]) -> None:
    run_explain(shipped_scenes()["paper_forward"], None, ["tissue.cells=[3,6]"], console())
    assert ("n_e =" in capsys.readouterr().out) == (comm.rank == 0)


@pytest.mark.parametrize(
    ("name", "changes", "cells"),
    [
        ("paper_forward", [], "tissue.cells=[80,160]"),
        ("block_3d", ["tissue.order=1", "tissue.refine=false"], "tissue.cells=[12,12,24]"),
    ],
)
def test_a_large_scene_is_explained_by_coarser_cells(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, name: str, changes: list[str], cells: str
) -> None:
    """Modes and sag of the copy against those of the mesh itself, and the page says whose they are."""
    scene = load_scene(name, [*changes, cells])
    monkeypatch.setattr("softgrasp.study.forward.explain.BUILT_SECONDS", math.inf)
    copied = explain(scene, comm)
    monkeypatch.setattr("softgrasp.study.forward.copies.MOST_LOOKED_AT", {2: 10**7, 3: 10**7})
    own = explain(scene, comm)
    assert (own.coarser, copied.sizes.n_e) == (0, own.sizes.n_e)
    assert 0 < copied.coarser <= {2: 8_000, 3: 6_000}[own.dimension]
    if own.dimension == 2:  # against the estimate of the mesh itself, whose zone ends on lines as that of the copy does
        monkeypatch.setattr("softgrasp.study.forward.explain.ESTIMATE_SECONDS", math.inf)
        assert copied.mesh.estimate == pytest.approx(explain(scene, comm).mesh.estimate, rel=0.1)  # two digits at most
    off = {2: 0.05, 3: 0.35}[own.dimension]  # linear cells at nu = 0.49 lock: the mesh itself is a third off
    assert copied.time.omega[0] == pytest.approx(own.time.omega[0], rel=off)
    assert copied.sag.largest == pytest.approx(own.sag.largest, rel=2 * off)
    said = io.StringIO()
    show_sections(Console(file=said, width=300), sections(copied))
    assert f"on coarser cells, n_e = {copied.coarser}" in said.getvalue()


@pytest.mark.parametrize(
    ("name", "changes", "cells"),
    [
        ("paper_forward", ["tissue.order=2"], "tissue.cells=[40,80]"),
        ("block_3d", ["tissue.order=1", "tissue.refine=false"], "tissue.cells=[10,9,17]"),
        ("block_3d", ["tissue.order=1"], "tissue.cells=[10,9,17]"),  # lines that crowd
        ("push_disc", ["obstacle.0.friction=0.3", "obstacle.0.radius=1e-4"], "tissue.cells=[40,80]"),
    ],
)
def test_a_box_too_large_to_build_is_explained_by_computed_sizes(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, name: str, changes: list[str], cells: str
) -> None:
    """Sizes against those of the mesh itself, the rest against the copy that a smaller mesh is explained by."""
    scene = load_scene(name, [*changes, cells])
    monkeypatch.setattr("softgrasp.study.forward.copies.MOST_LOOKED_AT", {2: 4_000, 3: 2_000})
    monkeypatch.setattr("softgrasp.study.forward.explain.BUILT_SECONDS", math.inf)
    own = explain(scene, comm)
    monkeypatch.setattr("softgrasp.study.forward.explain.BUILT_SECONDS", 1e-3)
    computed = explain(scene, comm)
    assert (own.built, computed.built, computed.coarser) == (True, False, own.coarser)
    assert (computed.sizes.nodes, computed.sizes.cells) == (own.sizes.nodes, own.sizes.cells)
    assert computed.sizes.n_e == pytest.approx(own.sizes.n_e, rel=0.02)  # a zone of whole facets of few cells
    assert computed.sizes.nonzeros == pytest.approx(own.sizes.nonzeros, rel=0.02)  # as above, in two digits
    assert (computed.time, computed.sag, computed.effects) == (own.time, own.sag, own.effects)
    assert computed.mesh.shift is None
    assert computed.warnings == own.warnings
    said = io.StringIO()
    show_sections(Console(file=said, width=300), sections(computed))
    assert f"n_e = about {computed.sizes.n_e}" in said.getvalue()
    assert "is not assembled" in said.getvalue()
    assert "computed from that copy, to 1 % of the unknowns and 10 % of the non-zeros" in said.getvalue()


def test_scenes_that_need_their_own_mesh_are_built() -> None:
    """Cells that are bisected, and more unknowns than are allowed."""
    cells = "tissue.cells=[400,800]"
    lines = "tissue.refine={most=700000}"
    assert build_seconds(load_scene("paper_forward", [cells])) == pytest.approx(2.2, abs=0.1)  # 3.5e-6 s a triangle
    assert build_seconds(load_scene("paper_forward", [cells, lines])) == pytest.approx(2.2, abs=0.1)
    assert build_seconds(load_scene("paper_forward", [cells, "tissue.refine={}"])) == 0
    assert build_seconds(load_scene("paper_forward", [cells, "tissue.refine={most=700000,tolerance=0.01}"])) == 0
    assert build_seconds(load_scene("paper_forward", [cells, "tissue.refine={most=700000,method='bisect'}"])) == 0
    assert build_seconds(load_scene("paper_obstacle", [cells])) == pytest.approx(2.2, abs=0.1)
    assert build_seconds(load_scene("set_down_3d")) == 0  # its copy would have the same cells
