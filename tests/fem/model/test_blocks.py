"""The blocks of hand and tissue against scikit-fem on the same mesh."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from mpi4py import MPI

from softgrasp.fem import petsc
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import PETSc, times_columns
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from tests.helpers.models import (
    CUBE,
    LAYERS,
    close,
    gather_matrix,
    gather_rows,
    held_by_paper,
    held_on_top,
    make_scene,
    reference,
    same_everywhere,
)  # fmt: skip

SCENES: dict[str, tuple[list[dict[str, Any]], Any]] = {
    "2d-p1": ([], held_by_paper),
    "2d-p2": ([{"tissue": {"order": 2}}], held_by_paper),
    "2d-layers-thick": ([{"tissue": {"layers": LAYERS, "thickness": 0.3}, "effects": {"damping": {
        "kind": "kelvin-voigt", "beta": 0.01}}}], held_by_paper),
    "2d-layers-p2": ([{"tissue": {"layers": LAYERS, "order": 2}, "effects": {"damping": {
        "kind": "kelvin-voigt", "beta": 0.01}}}], held_by_paper),
    "3d-p1": ([CUBE], held_on_top),
    "3d-p2": ([CUBE, {"tissue": {"order": 2}}], held_on_top),
}  # fmt: skip
MATERIAL = {"lambda": 50.0, "mu": 50.0, "rho": 1.0}
TURNING = {"effects": {"rotation": True}}
EXACT = 1e-12  # sums of about 50 products of order one, each rounded to 1e-16


@pytest.mark.parametrize(("cells", "states"), [([15, 30], 1916), ([10, 20], 880)])
def test_the_paper_has_these_sizes(comm: MPI.Intracomm, cells: list[int], states: int) -> None:
    scene = load_scene(shipped_scenes()["paper_forward"], [f"tissue.cells={cells}"])
    assert build(scene, comm=comm).system.layout.states == states


@pytest.mark.ranks(columns=(1, 8))
@pytest.mark.parametrize("entries", [1, 10**6])
@pytest.mark.parametrize("storage", ["C", "F"])
@pytest.mark.parametrize("columns", [1, 2, 3, 7, 8, 21])
def test_products_with_columns_equal_scipy(
    comm: MPI.Intracomm, columns: int, storage: Any, entries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By vectors, in one block, in two, by SciPy and by the rows of each rank; also after the matrix changed."""
    monkeypatch.setattr(petsc, "BLOCK_ENTRIES", entries)
    monkeypatch.setattr(petsc, "FEW_ENTRIES", entries)
    monkeypatch.setattr(petsc, "COPIED_ENTRIES", entries)
    system = build(make_scene({}), comm=comm).system
    layout, start = system.layout, system.layout.start
    X = np.random.default_rng(1).standard_normal((layout.n_e, columns))
    local = np.array(X[start : start + layout.n_local], order=storage)
    for factor in (1.0, 2.0):
        system.K_ee.scale(factor)
        rows, indices, values = system.K_ee.getValuesCSR()
        whole = scipy.sparse.csr_matrix((values, indices, rows), shape=(layout.n_local, layout.n_e)) @ X
        product = times_columns(system.K_ee, local)
        np.testing.assert_allclose(product, whole, rtol=0, atol=EXACT * np.abs(whole).max())


@pytest.mark.ranks
def test_products_of_more_rows_than_columns_equal_numpy(comm: MPI.Intracomm) -> None:
    """As gradients at quadrature points; rank r has 11 + r rows and 4 + r columns."""
    rng, rank, size = np.random.default_rng(5), comm.rank, comm.size
    rows, columns = [11 + r for r in range(size)], [4 + r for r in range(size)]
    whole, X = rng.standard_normal((sum(rows), sum(columns))), rng.standard_normal((sum(columns), 30))
    row, column = sum(rows[:rank]), sum(columns[:rank])
    A = PETSc.Mat().createAIJ(((rows[rank], None), (columns[rank], None)), nnz=whole.shape[1], comm=comm)
    mine = np.arange(row, row + rows[rank], dtype=PETSc.IntType)
    A.setValues(mine, np.arange(whole.shape[1], dtype=PETSc.IntType), whole[mine])
    A.assemble()
    product = times_columns(A, X[column : column + columns[rank]])
    np.testing.assert_allclose(product, whole[mine] @ X, rtol=0, atol=EXACT * np.abs(whole @ X).max())
    A.destroy()


@pytest.mark.ranks
@pytest.mark.parametrize("name", SCENES)
def test_blocks_equal_scikit_fem(comm: MPI.Intracomm, name: str) -> None:
    changes, held = SCENES[name]
    model = build(make_scene(*changes, TURNING), comm=comm)
    system, layout, ref = model.system, model.system.layout, reference(model, held)
    free, contact, R = ~ref.held, ref.held, ref.R

    np.testing.assert_allclose(layout.reference, ref.centre, atol=1e-14)  # a mean of coordinates of order one
    assert layout.n_e == free.sum()
    assert layout.n_s == R.shape[1]
    for A, A_es, full in ((system.M_ee, system.M_es, ref.M), (system.K_ee, system.K_es, ref.K)):
        assert close(gather_matrix(layout, A), full[np.ix_(free, free)]) < EXACT
        assert close(gather_rows(layout, A_es), full[np.ix_(free, contact)] @ R[contact]) < EXACT
    assert close(gather_rows(layout, system.T), R[free]) < EXACT
    assert close(gather_rows(layout, system.G), ref.M[free] @ R) < EXACT
    assert close(system.M_rigid, R.T @ ref.M @ R) < EXACT
    assert close(system.M_hand, ref.M_hand) == 0
    assert same_everywhere(comm, system.M_rigid)
    layers = list(zip(system.layers, system.materials, strict=True))
    M_ss = sum(m.rho * b.M_1.ss for b, m in layers)
    K_ss = sum(m.mu * b.K_mu.ss + m.lam * b.K_lambda.ss for b, m in layers)
    assert close(M_ss, R[contact].T @ ref.M[np.ix_(contact, contact)] @ R[contact]) < EXACT
    assert close(K_ss, R[contact].T @ ref.K[np.ix_(contact, contact)] @ R[contact]) < EXACT


@pytest.mark.ranks
@pytest.mark.parametrize(("cells", "order"), [([4, 3, 6], 2), ([4, 3, 6], 3), ([5, 4, 5], 1)])
def test_the_hand_turns_about_one_point_on_every_mesh(comm: MPI.Intracomm, cells: list[int], order: int) -> None:
    """Three cells across crowd at one side: the mean of the nodes is 6 mm beside the centre of the zone."""
    keys = [f"tissue.cells={cells}", f"tissue.order={order}"]
    layout = build(load_scene(shipped_scenes()["block_3d"], keys), comm=comm).system.layout
    np.testing.assert_allclose(layout.reference, [0.025, 0.025, 0.0875], atol=1e-15)  # rounding of sums of about 0.1


@pytest.mark.ranks
@pytest.mark.parametrize("name", [n for n in SCENES if "layers" in n])
def test_layered_viscosity_equals_scikit_fem(comm: MPI.Intracomm, name: str) -> None:
    model = build(make_scene(*SCENES[name][0]), comm=comm)
    system, ref = model.system, reference(model)
    D = sum(b * K for b, K in zip(ref.betas, ref.K_layers, strict=True))[np.ix_(~ref.held, ~ref.held)]
    assert system.damping.beta == 0
    assert close(gather_matrix(system.layout, system.damping.matrix), D) < EXACT


@pytest.mark.parametrize("name", SCENES)
def test_stiffness_annihilates_rigid_motions(comm: MPI.Intracomm, name: str) -> None:
    system = build(make_scene(*SCENES[name][0], TURNING), comm=comm).system
    K = gather_matrix(system.layout, system.K_ee)
    force = K @ gather_rows(system.layout, system.T) + gather_rows(system.layout, system.K_es)
    assert system.layout.n_s == {2: 3, 3: 6}[system.layout.dimension]
    assert np.abs(force).max() < EXACT * np.abs(K).max()


def test_mass_of_the_body_is_rho_times_volume(comm: MPI.Intracomm) -> None:
    system = build(make_scene(CUBE, tissue={"order": 2, "material": {"rho": 3.0}}), comm=comm).system
    np.testing.assert_allclose(system.M_rigid, 3.0 * 0.48 * np.eye(3), rtol=0, atol=EXACT)


def test_matrices_are_symmetric_and_positive(comm: MPI.Intracomm) -> None:
    system = build(make_scene(TURNING), comm=comm).system
    for A in (system.M_ee, system.K_ee):
        dense = gather_matrix(system.layout, A).toarray()
        assert close(dense, dense.T) < EXACT
        assert np.linalg.eigvalsh(dense)[0] > 0


def test_new_materials_equal_a_fresh_build(comm: MPI.Intracomm) -> None:
    damped = {"damping": {"kind": "rayleigh", "alpha": 0.2, "beta": 0.01}, "rotation": True}
    other = {
        "low": {"material": {"lambda": 7.0, "mu": 8.0, "rho": 9.0}, "beta": 0.07},
        "core": {"material": {"lambda": 1.0, "mu": 2.0, "rho": 3.0}},
    }
    base = {"tissue": {"layers": LAYERS}, "effects": damped}
    fresh = build(make_scene(base, {"tissue": {"layers": other, "material": {"lambda": 4.0}}}), comm=comm).system
    system = build(make_scene(base), comm=comm).system
    changed = system.with_materials(fresh.materials)
    layout = system.layout
    for name in ("M_ee", "K_ee"):
        new, old, was = (gather_matrix(layout, getattr(s, name)) for s in (changed, fresh, system))
        assert close(new, old) < EXACT
        assert close(was, old) > 0.1  # other materials: 0.7 and 1.4 measured
    assert changed.damping.matrix is not None
    D = gather_matrix(layout, fresh.damping.matrix)
    assert close(gather_matrix(layout, changed.damping.matrix), D) < EXACT
    assert close(gather_rows(layout, changed.G), gather_rows(layout, fresh.G)) < EXACT
    assert close(changed.M_rigid, fresh.M_rigid) < EXACT
    assert (changed.damping.alpha, changed.damping.beta) == (fresh.damping.alpha, fresh.damping.beta)


@pytest.mark.parametrize("betas", [(0.0, 0.0), (0.05, 0.05), (0.02, 0.03)])
def test_new_viscosity_follows_the_materials(comm: MPI.Intracomm, betas: tuple[float, float]) -> None:
    layers = {"low": {"box": [[0.0, 0.0], [1.0, 0.5]], "material": MATERIAL, "beta": 0.01}}
    damping = {"damping": {"kind": "kelvin-voigt", "beta": 0.02}}
    system = build(make_scene({"tissue": {"layers": layers}, "effects": damping}), comm=comm).system
    low, rest = (replace(m, beta=b) for m, b in zip(system.materials, betas, strict=True))
    changed = system.with_materials((low, rest)).damping
    if betas[0] == betas[1]:
        assert changed.matrix is None
        assert changed.beta == betas[0]
    else:
        assert changed.matrix is not None
        assert changed.beta == 0
