"""Bases, reduced models and trajectories by pyMOR; on one rank, because pyMOR sends all others into its event loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.petsc import Array
from softgrasp.reduction.bases.registry import METHODS, make_basis
from softgrasp.reduction.online import run
from tests.helpers.models import close, first_order, gather_matrix, gather_rows, reference
from tests.helpers.reduced import DAMPED, KINDS, dense_columns, model_of, reduced, small_of, symplectic_basis, wiggle
from tests.helpers.snapshots import basis_halves, case, gap, halves

pytestmark = pytest.mark.serial


@pytest.fixture(autouse=True)
def _quiet() -> None:
    pytest.importorskip("pymor")
    from pymor.core.logger import set_log_levels

    set_log_levels({"pymor": "ERROR"})


# --- bases


def pymor_basis(name: str, q: Array, p: Array, modes: int) -> Array:
    """V by pyMOR, rows (q; p)."""
    from pymor.algorithms import symplectic
    from pymor.vectorarrays.block import BlockVectorSpace
    from pymor.vectorarrays.numpy import NumpyVectorSpace

    space = NumpyVectorSpace(len(q))
    blocks = [space.from_numpy(np.ascontiguousarray(x)) for x in (q, p)]
    V = getattr(symplectic, name)(BlockVectorSpace([space, space]).make_array(blocks), modes).to_array()
    return np.vstack([block.to_numpy() for block in V.blocks])


@pytest.mark.parametrize(
    ("stem", "theirs"),
    [
        ("psd", "psd_complex_svd"),
        ("psd_cotangent_lift", "psd_cotangent_lift"),
        ("psd_svd_like", "psd_svd_like_decomp"),
    ],
)
@pytest.mark.parametrize("tail", ["", "_fixed", "_fixed_relative", "_fixed_qv"])
def test_same_subspaces_as_pymor(stem: str, theirs: str, tail: str) -> None:
    c = case()
    key = stem + tail
    k = 4
    q, p = halves(c, key)
    basis = make_basis(key, c.states, k + (2 * c.model.system.layout.n_s if METHODS[key].fixed else 0), "euclidean")
    V = np.vstack(basis_halves(basis))
    if stem == "psd_svd_like":
        # pyMOR takes pairs in the order of LAPACK: take all that it resolves and look for ours in there
        found = pymor_basis(theirs, q, p, 12)
        sizes = np.linalg.norm(found, axis=0)
        best = np.linalg.lstsq(found / sizes, V, rcond=None)[1]
        assert np.sqrt(best.max()) < 1e-5 * np.linalg.norm(V)  # their Gram matrix loses half the digits
    else:
        # pyMOR's method of snapshots: eps (s_1 / s_2)^2 over the gap
        assert gap(V, pymor_basis(theirs, q, p, k)) < 1e-6


# --- models and trajectories


def solved(model: Any, steps: int, **given: Any) -> Array:
    """States (steps + 1, N) of a pyMOR model."""
    U = model.solve(**given)
    states = np.asarray((U if hasattr(U, "to_numpy") else U.to_array()).to_numpy())
    return states if states.shape[0] == steps + 1 else states.T


FORCE = "[40 * cos(1.5 * t[0]), 20 * cos(2.2 * t[0] + 0.4)]"  # tests.reduced.wiggle in pyMOR's words


def test_same_trajectory_as_pymor_from_the_same_small_matrices(comm: MPI.Intracomm) -> None:
    from pymor.algorithms.timestepping import ImplicitMidpointTimeStepper
    from pymor.models.iosys import LTIModel

    model = model_of(comm, DAMPED)
    dt, steps = 0.01, 40
    for kind in KINDS:
        small = small_of(model, kind)
        stepper = ImplicitMidpointTimeStepper(steps)
        lti = LTIModel.from_matrices(small.A, small.B, small.C, E=small.E, T=dt * steps, time_stepper=stepper)
        theirs = solved(lti, steps, input=FORCE)
        own = run(small, dt, wiggle(steps, dt), allow_unstable=True)
        # rounding of 40 steps; E of canonical models has condition 1e4
        assert close(own.x, theirs) < 1e-10, kind
        assert close(own.outputs, theirs @ small.C.T) < 1e-10, kind  # as above


@pytest.mark.parametrize("fixed", [True, False])
def test_same_trajectory_as_pymors_galerkin_projection(comm: MPI.Intracomm, fixed: bool) -> None:
    """E, A, B by scikit-fem, projected on our basis by pyMOR."""
    from pymor.algorithms.timestepping import ImplicitMidpointTimeStepper
    from pymor.models.iosys import LTIModel
    from pymor.reductors.basic import LTIPGReductor

    model = model_of(comm, DAMPED)
    dt, steps = 0.01, 40
    basis = symplectic_basis(model.system.layout, 4, "absolute", fixed, "qv")
    full = first_order(reference(model))
    stepper = ImplicitMidpointTimeStepper(steps)
    fom = LTIModel.from_matrices(full.A, full.B, full.B.T, E=full.E, T=dt * steps, time_stepper=stepper)
    V = fom.solution_space.from_numpy(dense_columns(model, basis))
    theirs = solved(LTIPGReductor(fom, V, V).reduce(), steps, input=FORCE)
    own = run(reduced(model, basis).at(), dt, wiggle(steps, dt), allow_unstable=True)
    assert close(own.x, theirs) < 1e-9  # two assemblies, 40 steps


def test_same_trajectory_as_pymors_symplectic_projection(comm: MPI.Intracomm) -> None:
    """Free vibration: H = (z' K z + p' M^-1 p) / 2, projected on our symplectic basis by pyMOR."""
    from pymor.algorithms.symplectic import SymplecticBasis
    from pymor.models.symplectic import QuadraticHamiltonianModel
    from pymor.operators.block import BlockDiagonalOperator
    from pymor.operators.numpy import NumpyMatrixOperator
    from pymor.reductors.symplectic import QuadraticHamiltonianRBReductor

    model = model_of(comm)
    layout, k = model.system.layout, 2 * model.system.layout.n_s
    dt, steps = 0.01, 40
    basis = symplectic_basis(layout, 4, "relative", True)
    M, K = (gather_matrix(layout, A).toarray() for A in (model.system.M_ee, model.system.K_ee))
    H = BlockDiagonalOperator([NumpyMatrixOperator(K), NumpyMatrixOperator(np.linalg.inv(M))])
    space = H.source
    blocks = [gather_rows(layout, X)[:, k:] for X in (basis.V_q, basis.V_p)]
    y = np.cos(np.arange(blocks[0].shape[1]))

    def columns(pick: slice, weight: Array | None = None) -> Any:
        parts = [X[:, pick] if weight is None else X @ weight[:, None] for X in blocks]
        return space.make_array([s.from_numpy(part) for s, part in zip(space.subspaces, parts, strict=True)])

    half = len(y) // 2
    fom = QuadraticHamiltonianModel(dt * steps, columns(slice(0), y), H, nt=steps)
    pairs = SymplecticBasis(columns(slice(half)), columns(slice(half, None)))
    theirs = solved(QuadraticHamiltonianRBReductor(fom, pairs).reduce(), steps)
    start = np.concatenate([np.zeros(k), y])
    own = run(reduced(model, basis).at(), dt, np.zeros((steps, layout.n_s)), x0=start)
    assert close(own.x[:, k:], theirs) < 1e-10  # mass solves of condition 20, 40 steps
