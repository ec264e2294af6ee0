"""Estimates of the error of the mesh against runs on much finer meshes, and meshes that reach a tolerance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import skfem
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.accuracy import adapt
from softgrasp.fem.accuracy.adapt import estimated
from softgrasp.fem.accuracy.estimate import cell_products, difference, estimate, indicators, next_order
from softgrasp.fem.accuracy.krylov import krylov_model
from softgrasp.fem.accuracy.surplus import prolong
from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.run.simulate import Trajectory, simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.modes import lowest_modes
from tests.fem.mesh.test_refined import fingerprint, l_scene
from tests.helpers.models import CUBE, LAYERS, _k_lambda, _k_mu, _mass, held_by_paper, make_scene

TIP = {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0], "name": "tip"}]}}
DAMPED = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}}
WEIGHT = {"effects": {"gravity": {"g": [0.0, -9.81]}}, "time": {"start": "equilibrium"}}
FORCED = {
    "effects": {
        "reaction": True, "rotation": True, "gravity": {"g": [0.0, -1.0], "hand_weight": True},
        "damping": {"kind": "rayleigh", "alpha": 0.2, "beta": 0.01, "drag": "space"},
    },
    "motion": {"drive": "force"},
}  # fmt: skip
LAYERED = {"tissue": {"layers": LAYERS}, **DAMPED}


def with_refine(scene: Scene, order: int, tolerance: float) -> Scene:
    data = scene.model_dump(by_alias=True, exclude_none=True)
    data["tissue"] |= {"order": order, "refine": {"tolerance": tolerance, "method": "bisect"}}
    return Scene.model_validate(data)


def deformation(run: Trajectory) -> np.ndarray:
    return run.outputs - run.outputs_rigid


def error(y: np.ndarray, fine: np.ndarray) -> float:
    return float(np.linalg.norm(y - fine, axis=1).max() / np.linalg.norm(fine, axis=1).max())


@pytest.mark.parametrize(
    "change",
    [{}, DAMPED, WEIGHT, FORCED, LAYERED, {**CUBE, "effects": {"rotation": True}}],
    ids=["undamped", "damped", "weight", "forced", "layered", "3D"],
)
def test_small_model_follows_the_run(comm: MPI.Intracomm, change: Any) -> None:
    model = build(make_scene(change), comm=comm)
    small, run = krylov_model(model).run, simulate(model)
    # what modes beyond the moments answer to the jumps of the jerk
    assert error(small.deformation + small.rigid - run.outputs_rigid, deformation(run)) < 2e-3
    assert np.abs(small.rigid - run.outputs_rigid).max() < 1e-4


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("change", [{}, WEIGHT, LAYERED, FORCED], ids=["plain", "weight", "layers", "forced"])
def test_estimate_tells_the_error_of_an_even_mesh(comm: MPI.Intracomm, change: Any, order: int) -> None:
    scene = make_scene(change, TIP, {"tissue": {"order": order}})
    model = build(scene, comm=comm)
    run, fine = simulate(model), simulate(build(with_refine(scene, 2, 3e-3), comm=comm))
    true, result = error(deformation(run), deformation(fine)), estimate(model)
    assert true > 0.05
    assert 0.8 <= result.estimate / true <= 1.1  # both meshes to compare with leave about a percent
    assert result.bound >= true
    corrected = result.corrected(run.outputs) - fine.outputs_rigid
    assert error(corrected, deformation(fine)) < 0.6 * true
    assert result.shift == 0.0  # lines of 4 x 8 cells meet y = 1.5, but for rounding


def test_shift_of_the_zone_is_part_of_the_error(comm: MPI.Intracomm) -> None:
    model = build(make_scene(TIP, {"tissue": {"cells": [5, 11]}}), comm=comm)
    result = estimate(model)
    assert result.shift == pytest.approx(1.5 - 16 / 11)
    fine = simulate(build(with_refine(model.scene, 2, 3e-3), comm=comm))
    assert result.estimate / error(deformation(simulate(model)), deformation(fine)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("tolerance", [3e-2, 3e-3])
def test_tolerance_is_reached_and_estimated(comm: MPI.Intracomm, tolerance: float) -> None:
    steps = {"time": {"steps": 300}}
    fine = simulate(build(with_refine(make_scene(TIP, steps), 3, 2e-4), comm=comm))
    model = adapt.build(with_refine(make_scene(TIP, steps), 2, tolerance), comm=comm)
    result, run = model.accuracy, simulate(model)
    assert result is not None
    assert result.obstacle == ""
    true = error(deformation(run), deformation(fine))
    assert true <= tolerance
    assert 0.4 <= result.estimate / true <= 1.1
    assert true <= result.bound
    assert error(result.corrected(run.outputs) - fine.outputs_rigid, deformation(fine)) <= 0.6 * true
    assert run.energy_drift < 1e-12


@pytest.mark.parametrize("order", [1, 2])
def test_the_library_builds_to_the_tolerance(comm: MPI.Intracomm, order: int) -> None:
    changes = [f"tissue.order={order}", "tissue.refine={tolerance=1e-2}", "time.steps=300"]
    model = sg.build("paper_forward", changes, comm)
    finest = ["tissue.order=3", "tissue.refine={tolerance=2e-4}", "time.steps=300"]
    fine = sg.build("paper_forward", finest, comm, steps=False)
    assert error(deformation(simulate(model)), deformation(simulate(fine))) <= 1e-2
    assert model.accuracy is not None
    mesh = model.space.mesh
    assert sg.build(model.scene, comm=comm, mesh=mesh).accuracy is None  # a mesh that is given is taken as it is


def test_cubic_elements_are_estimated_by_those_of_order_four(comm: MPI.Intracomm) -> None:
    fine = simulate(build(with_refine(make_scene(TIP), 3, 1e-4), comm=comm))
    model = build(with_refine(make_scene(TIP), 3, 0.03), comm=comm)
    true, result = error(deformation(simulate(model)), deformation(fine)), estimate(model)
    assert 0.4 <= result.estimate / true <= 1.1
    assert result.bound >= true


def test_mesh_file_reaches_its_tolerance(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    steps = {"steps": 150}
    scenes = [l_scene(mpi_tmp_path, comm, order=o, refine={"tolerance": t}) for o, t in ((2, 2e-2), (3, 1e-3))]
    scenes = [s.model_copy(update={"time": s.time.model_copy(update=steps)}) for s in scenes]
    model, fine = adapt.build(scenes[0], comm=comm), simulate(build(scenes[1], comm=comm))
    run = simulate(model)
    true = error(deformation(run), deformation(fine))
    assert model.accuracy is not None
    assert true <= 2e-2
    assert error(model.accuracy.corrected(run.outputs) - fine.outputs_rigid, deformation(fine)) <= 0.6 * true
    assert 0.4 <= model.accuracy.estimate / true <= 1.1
    assert true <= model.accuracy.bound


def test_passes_end_at_most_and_say_so(comm: MPI.Intracomm) -> None:
    data = make_scene(TIP, {"time": {"steps": 300}}).model_dump(by_alias=True, exclude_none=True)
    data["tissue"] |= {"order": 1, "refine": {"tolerance": 1e-2, "most": 1500}}
    model = adapt.build(Scene.model_validate(data), comm=comm)
    assert model.system.layout.n_e <= 1500
    assert model.accuracy is not None
    assert model.accuracy.obstacle == "tissue.refine.most = 1500 unknowns allow no finer mesh"
    data["tissue"]["refine"] = {"tolerance": 1e-2, "passes": 1}
    model = adapt.build(Scene.model_validate(data), comm=comm)
    assert model.accuracy is not None
    assert model.accuracy.obstacle == "tissue.refine.passes = 1 are used up"
    data["tissue"]["refine"] = {"tolerance": 1e-2, "passes": 0}
    model = adapt.build(Scene.model_validate(data), comm=comm)
    assert model.accuracy is None  # the a-priori mesh
    result = estimated(model)
    assert (result.tolerance, result.obstacle) == (1e-2, "")  # about met, which is no failure
    data["tissue"] |= {"refine": {"tolerance": 1e-2, "passes": 0, "most": 500}}
    result = estimated(build(Scene.model_validate(data), comm=comm))
    assert result.obstacle == "tissue.refine.passes = 0 allow no better mesh"
    data["tissue"]["refine"] = {"tolerance": 1e-2, "most": 500}
    result = estimated(build(Scene.model_validate(data), comm=comm))
    assert result.obstacle == "its mesh is not one that was refined for this model"  # passes have nothing to do with it


def test_tolerance_below_the_steps_is_refused(comm: MPI.Intracomm) -> None:
    with pytest.raises(SceneError, match=r"is below the error .* that time.steps = 60 leave on any mesh: use at least"):
        adapt.build(with_refine(make_scene(TIP), 2, 1e-3), comm=comm)
    # feedback has steps of its own
    model = adapt.build(with_refine(make_scene(TIP), 2, 1e-2), comm=comm, steps=False)
    assert model.accuracy is not None
    assert model.accuracy.time_error > 1e-2


def test_time_error_is_that_of_the_steps(comm: MPI.Intracomm) -> None:
    """Against sixteen times as many steps on the same mesh."""
    coarse, fine = (build(make_scene(TIP, {"time": {"steps": n}}), comm=comm) for n in (60, 960))
    true = error(deformation(simulate(coarse)), deformation(simulate(fine))[::16])
    assert estimate(coarse).time_error == pytest.approx(true, rel=0.15)


@pytest.mark.ranks
def test_cells_share_the_difference_of_the_energies(comm: MPI.Intracomm) -> None:
    """sum_T k_T(e_i, e_j) = x'_i K' x'_j - x_i K x_j for static solutions on nested spaces."""
    model = build(make_scene(LAYERED, TIP), comm=comm)
    up, small = krylov_model(next_order(model)), krylov_model(model)
    e = up.X - prolong(model, up.model, small.X)
    E = total(comm, cell_products(up.model, e).sum(axis=0))
    energies = [total(comm, s.X.T @ times_columns(s.model.system.K_ee, s.X)) for s in (up, small)]
    difference = energies[0] - energies[1]
    assert np.abs(E - difference).max() < 1e-9 * np.abs(energies[0]).max()  # solves to 1e-12, one digit cancels
    assert (indicators(small, up) >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "cells", "tolerances", "least", "largest"),
    [
        (1, (16, 32, 64), (3e-2, 1e-2, 3e-3), 1.8, 2.2),
        (2, (8, 16, 32), (3e-3, 1e-3, 3e-4, 1e-4), 3.5, 5.0),
        # between 1e-2 and 3e-4 one more bisection at the ends halves the error, for a few cells: only the whole tells
        (3, (8, 16), (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4), 5.0, 7.0),
    ],
)
def test_orders_of_adaptive_and_even_meshes(
    comm: MPI.Intracomm, order: int, cells: tuple[int, ...], tolerances: tuple[float, ...], least: float, largest: float
) -> None:
    """Even meshes converge with 2 alpha = 1 whatever the order, adaptive ones with twice that of the elements."""
    steps = {"time": {"steps": 300}}
    graded = [adapt.build(with_refine(make_scene(TIP, steps), order, t), comm=comm, steps=False) for t in tolerances]
    sizes = [{"tissue": {"cells": [n, 2 * n], "order": order}} for n in cells]
    even = [build(make_scene(TIP, steps, size), comm=comm) for size in sizes]
    fine = deformation(simulate(build(with_refine(make_scene(TIP, steps), 3, 3e-6), comm=comm)))  # 2e-6 off

    def slope(models: list[Model]) -> float:
        """Against n_e^(1/2)."""
        n, e = np.log([(m.system.layout.n_e, error(deformation(simulate(m)), fine)) for m in models]).T
        return float(-np.polyfit(n / 2, e, 1)[0])

    assert slope(even) == pytest.approx(1.0, abs=0.05)
    assert least <= slope(graded) <= largest


@pytest.mark.ranks
def test_passes_refine_the_same_cells_on_any_ranks(comm: MPI.Intracomm) -> None:
    scene = with_refine(make_scene(TIP, {"time": {"steps": 300}}), 1, 5e-2)
    model, alone = (adapt.build(scene, comm=c) for c in (comm, MPI.COMM_SELF))
    assert alone.accuracy is not None
    assert alone.accuracy.passes > 0
    assert fingerprint(model.space.mesh) == fingerprint(alone.space.mesh)


@pytest.mark.serial
def test_cubic_elements_are_those_of_scikit_fem() -> None:
    """Frequencies on one mesh: the same space, whatever its nodes."""
    scene = make_scene({"tissue": {"order": 3, "cells": [2, 4]}})
    omega, _ = lowest_modes(build(scene, comm=MPI.COMM_SELF).system, 6)
    mesh = skfem.MeshTri.init_tensor(np.linspace(0, 1, 3), np.linspace(0, 2, 5))
    # the diagonals of DOLFINx, from the lower left to the upper right
    corners = np.array([[i, j] for i in range(2) for j in range(4)])
    nodes = {(x, y): k for k, (x, y) in enumerate(np.round(mesh.p.T * 2).astype(int).tolist())}
    cells = []
    for i, j in corners.tolist():
        a, b, c, e = (nodes[p] for p in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
        cells += [[a, b, c], [a, e, c]]
    mesh = skfem.MeshTri(mesh.p, np.array(cells).T)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP3()))
    K = 50.0 * _k_mu.assemble(basis) + 50.0 * _k_lambda.assemble(basis)
    held = basis.get_dofs(mesh.facets_satisfying(held_by_paper, boundaries_only=True)).flatten()
    free = np.setdiff1d(np.arange(basis.N), held)
    squares = scipy.linalg.eigh(
        K.toarray()[np.ix_(free, free)], _mass.assemble(basis).toarray()[np.ix_(free, free)], eigvals_only=True
    )
    np.testing.assert_allclose(omega, np.sqrt(squares[:6]), rtol=1e-8)  # tolerance of the modes


@pytest.mark.slow
def test_lines_of_a_box_against_even_ones(comm: MPI.Intracomm) -> None:
    """Static outputs C K^-1 G of block_3d at nu = 0.3 on 6 x 6 x 12 quadratic cells, against 9 x 9 x 18 graded ones."""
    base = ["tissue.order=2", "tissue.material={young=1e5,poisson=0.3,rho=1070.0}"]

    def statics(*changes: str) -> np.ndarray:
        small = krylov_model(build(load_scene("block_3d", [*base, *changes]), comm=comm))
        return (small.C @ small.G)[:3]  # the tip, against translations and rotations; V' K V = 1

    fine = statics("tissue.cells=[9,9,18]", "tissue.refine={}")
    even, lines = (statics("tissue.cells=[6,6,12]", *more) for more in (["tissue.refine=false"], ["tissue.refine={}"]))
    errors = [float(np.linalg.norm(part - fine) / np.linalg.norm(fine)) for part in (even, lines)]
    assert errors[0] > 0.03
    assert errors[1] <= 0.02, errors


EVEN = ["tissue.refine=false", "tissue.order=1"]
FINEST = ["tissue.order=3", "tissue.refine={tolerance=1e-5}"]
STRIP = [  # a muscle that sags
    "tissue.size=[0.2,0.04]", "tissue.cells=[20,4]", "contact={sides=['left']}",
    "control.outputs=[{kind='node',point=[0.2,0.0]}]",
]  # fmt: skip
FINE = {"block_3d": ["tissue.cells=[10,6,14]"], "pillow_3d": ["tissue.refine={tolerance=5e-3,passes=0}"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "most"),
    [
        ("paper_forward", [], 0.45),
        ("paper_forward", ["tissue.order=2", "tissue.refine={tolerance=1e-2}"], 1e-2),
        ("paper_accurate", [], 1e-3),
        ("franka_muscle", [], 7e-3),
        ("franka_muscle", EVEN, 0.2),
        ("franka_muscle", STRIP, 6e-3),
        ("franka_muscle", [*EVEN, *STRIP], 0.5),
        ("layers_2d", [], 2e-3),
        ("layers_2d", EVEN, 0.05),
        ("block_3d", [], 6e-3),
        ("block_3d", [*EVEN, "tissue.cells=[8,8,16]"], 0.5),
        ("block_3d", ["tissue.refine=false", "tissue.order=2"], 0.3),
        ("pillow_3d", [], 5e-3),
        ("pillow_3d", EVEN, 0.2),
        ("pillow_3d", ["tissue.refine=false", "tissue.order=2"], 0.04),
        ("pillow_3d", ["tissue.refine=false"], 5e-3),
    ],
    ids=lambda value: "-".join(v.split("=")[0] for v in value) if isinstance(value, list) else str(value),
)
def test_estimates_of_scenes(comm: MPI.Intracomm, name: str, changes: list[str], most: float) -> None:
    """As they ship and with even linear cells, against finer graded meshes; no error is larger than ``most``."""
    fine = [*(STRIP if STRIP[0] in changes else []), *FINE.get(name, FINEST)]
    small, other = (krylov_model(build(load_scene(name, c), comm=comm)) for c in (changes, fine))
    true, _ = difference(small, other)
    result = estimate(small.model, small)
    assert true <= most
    assert 0.4 <= result.estimate / true <= 1.1
    assert result.bound >= true
    tissue = np.abs(small.C).max(axis=1) > 0
    y, exact = ((s.run.deformation + s.run.rigid)[:, tissue] for s in (small, other))
    assert error(y + result.delta[:, tissue], exact) <= 0.6 * error(y, exact)


@pytest.mark.parametrize("order", [1, 2])
def test_mesh_file_is_compared_with_what_is_finer_everywhere(comm: MPI.Intracomm, order: int) -> None:
    """The bisected edges of the pillow leave its error, which is inside."""
    changes = ["time.steps=100", "tissue.refine=false"]
    fine = krylov_model(build(load_scene("pillow_3d", ["time.steps=100"]), comm=comm))
    small = krylov_model(build(load_scene("pillow_3d", [*changes, f"tissue.order={order}"]), comm=comm))
    true, result = difference(small, fine)[0], estimate(small.model, small)
    assert 0.4 <= result.estimate / true <= 1.1
    assert true <= result.bound


def test_too_large_a_comparison_is_told(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.fem.accuracy.estimate.MOST_COMPARED", 1500)
    with pytest.raises(SceneError, match="would have about 5913 unknowns, more than the 1500 of an estimate"):
        estimate(build(load_scene("pillow_3d", ["tissue.refine=false", "tissue.order=2"]), comm=comm))


def test_body_at_rest_has_no_error(comm: MPI.Intracomm) -> None:
    hold = {"motion": {"profile": "hold", "target": None}}
    result = estimate(build(make_scene(hold), comm=comm))
    assert (result.estimate, result.bound, result.time_error) == (0.0, 0.0, 0.0)
