"""Lowest natural modes of the tissue clamped in the hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from slepc4py import SLEPc

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc, from_options
from softgrasp.fem.solve.solvers import ITERATIVE, TissueSolver
from softgrasp.fem.solve.stiffness import factored_stiffness, static_solver
from softgrasp.fem.system import BlockSystem

PREFIX = "softgrasp_modes_"
TOLERANCE = 1e-11  # of 1/omega^2 in the iteration; rounding in M-products is about 1e-15 n^(1/2)
RESIDUAL = 1e-8  # largest bound on the relative error of omega^2 that is accepted
KEPT_ENTRIES = 50_000_000  # of modes that stay with the system: 400 MB over all ranks
SPARE = 4  # further columns of a block, which converge last [1]
ROUGH = 1e-3  # tolerance of the search for missed copies [1]: enough where others lie ten times as far away


def lowest_modes(system: BlockSystem, k: int) -> tuple[Array, Array]:
    """Solve K_ee phi = omega^2 M_ee phi for the k smallest omega, with Phi' M_ee Phi = I.

    Krylov-Schur on K_ee^-1 M_ee (shift-and-invert at 0, one Cholesky factor). A second run in the M-orthogonal
    complement catches copies of multiple eigenvalues that one Krylov space cannot see. Where no factor fits, LOBPCG
    [K01] for all k at once, with a V-cycle of the iterative solver. The sign of a mode does not depend on the rank
    count. Modes stay with the system: a later call for fewer returns the first of them. Collective.

    ``k``: number of modes, 1 <= k <= n_e.

    Returns:
        omega [1/s], ascending, (k,), on every rank; Phi, local rows (n_local, k), no ghosts.

    Raises SolverError: k is out of range, the factorisation fails, or a mode does not converge.
    """
    n_e = system.layout.n_e
    if not 1 <= k <= n_e:
        raise SolverError(f"{k} modes are requested; it must be between 1 and n_e = {n_e}")
    key = (system.K_ee.handle, system.K_ee.stateGet(), system.M_ee.handle, system.M_ee.stateGet())
    kept = system.kept.get("modes")
    if kept is None or kept[0] != key or len(kept[1]) < k:
        name = static_solver(system)  # whose factor this is
        with factored_stiffness(system, name) as solver:
            kept = key, *_lowest(system, solver, k), system.K_ee, system.M_ee  # no other can get their handles
        if system.M_ee.getType() != PETSc.Mat.Type.PYTHON and k * n_e <= KEPT_ENTRIES:
            system.kept["modes"] = kept
    return kept[1][:k].copy(), kept[2][:, :k].copy(order="F")


def _lowest(system: BlockSystem, solver: TissueSolver, k: int) -> tuple[Array, Array]:
    """Compute omega [1/s], (k,), and Phi, local rows (n_local, k). Collective."""
    n_e, iterated = system.layout.n_e, solver.name in ITERATIVE
    eps = _make_block_eps(system, solver, k) if iterated else _make_eps(system, solver)
    vectors: list[PETSc.Vec] = []
    squares: list[float] = []
    try:
        if iterated:
            _collect(eps, system, k, vectors, squares)
        else:
            _solve(eps, system, k, vectors, squares)
        while len(vectors) < n_e and not iterated:  # a block sees all copies
            last = sorted(squares)[k - 1]
            _solve(eps, system, 1, vectors, squares, ROUGH)
            if squares[-1] >= last * (1 + 10 * ROUGH):
                break
            vectors.pop().destroy()
            squares.pop()
            _solve(eps, system, 1, vectors, squares)
            if squares[-1] >= last * (1 - RESIDUAL):
                break
        order = np.argsort(squares)[:k]
        return _finish(solver, system, [vectors[i] for i in order])
    finally:
        eps.destroy()
        for vector in vectors:
            vector.destroy()


def _generic(system: BlockSystem, number: int) -> Array:
    """Local values of a function of the coordinates without symmetry, the same for every rank count."""
    layout = system.layout
    nodes, d = layout.nodes - layout.reference, layout.dimension
    scale = layout.comm.allreduce(float(np.abs(nodes).max(initial=0.0)), op=MPI.MAX)
    phase = nodes / (scale or 1.0) @ np.array([2.3, 5.1, 3.7])[:d] * (1 + number)
    return np.column_stack([np.cos(phase * (1 + 0.3 * c) + 1 + c) for c in range(d)]).ravel()


class _Preconditioner:
    """A solve, or one V-cycle, as the preconditioner of SLEPc."""

    def __init__(self, solve: Callable[[PETSc.Vec, PETSc.Vec], None]) -> None:
        self.solve = solve

    def apply(self, pc: PETSc.PC, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Set w = K_ee^-1 r, or about that. Collective."""
        self.solve(r, w)


def _make_eps(system: BlockSystem, solver: TissueSolver) -> SLEPc.EPS:
    """Krylov-Schur on K_ee^-1 M_ee, with the factor of ``solver``. Collective."""
    eps = _eps(system, solver.solve, SLEPc.EPS.Type.KRYLOVSCHUR, SLEPc.ST.Type.SINVERT)
    eps.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    eps.setTarget(0.0)
    eps.setPurify(False)  # for singular M_ee; needs one solve a mode
    from_options(eps)
    return eps


def _make_block_eps(system: BlockSystem, solver: TissueSolver, k: int) -> SLEPc.EPS:
    """LOBPCG for k modes at once with the V-cycle of ``solver``, from generic columns. Collective."""
    eps, size = _eps(system, solver.ksp.getPC().apply, SLEPc.EPS.Type.LOBPCG, SLEPc.ST.Type.PRECOND), k + SPARE
    eps.setWhichEigenpairs(SLEPc.EPS.Which.SMALLEST_REAL)
    eps.setLOBPCGBlockSize(size)
    eps.setDimensions(nev=k, ncv=3 * size)
    starts = [system.K_ee.createVecRight() for _ in range(size)]
    for i, start in enumerate(starts):
        start.array_w[:] = _generic(system, i)
    eps.setInitialSpace(starts)
    product = starts[0].duplicate()
    system.M_ee.mult(starts[0], product)
    # SLEPc compares |K phi - omega^2 M phi| with omega^2 for phi'M phi = 1, where |M phi| is about this root [kg^(1/2)]
    root = product.norm() / np.sqrt(product.dot(starts[0]))
    eps.setTolerances(RESIDUAL / 10 * root, 500)
    for vector in (*starts, product):
        vector.destroy()
    from_options(eps)
    return eps


def _eps(system: BlockSystem, solve: Callable[[PETSc.Vec, PETSc.Vec], None], kind: str, transform: str) -> SLEPc.EPS:
    """An eigensolver of a type with a spectral transformation that solves by ``solve``. Collective."""
    eps = SLEPc.EPS().create(system.layout.comm)
    eps.setOptionsPrefix(PREFIX)
    eps.setOperators(system.K_ee, system.M_ee)
    eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    eps.setType(kind)
    st = eps.getST()
    st.setType(transform)
    ksp = st.getKSP()
    ksp.setType("preonly")
    pc = ksp.getPC()
    pc.setType("python")
    pc.setPythonContext(_Preconditioner(solve))
    return eps


def _solve(
    eps: SLEPc.EPS,
    system: BlockSystem,
    k: int,
    vectors: list[PETSc.Vec],
    squares: list[float],
    tolerance: float = TOLERANCE,
) -> None:
    """Append the k lowest modes M-orthogonal to ``vectors``: phi there, omega^2 [1/s2] to ``squares``. Collective."""
    eps.setDimensions(nev=k, ncv=min(max(2 * k, k + 15), system.layout.n_e))
    eps.setTolerances(tolerance, 500)
    if vectors:
        eps.setDeflationSpace(vectors)
    start = system.K_ee.createVecRight()
    start.array_w[:] = _generic(system, len(vectors))
    eps.setInitialSpace(start)
    start.destroy()
    _collect(eps, system, k, vectors, squares)


def _collect(eps: SLEPc.EPS, system: BlockSystem, k: int, vectors: list[PETSc.Vec], squares: list[float]) -> None:
    """Iterate, and append k modes. Collective."""
    try:
        eps.solve()
    except (PETSc.Error, SystemError) as error:
        raise SolverError(
            f"modes: the iteration with the {system.layout.n_e} x {system.layout.n_e} stiffness failed ({error}); "
            "check material, mesh and contact zone"
        ) from error
    if eps.getConverged() < k:
        raise SolverError(
            f"modes: {eps.getConverged()} of {k} converged in {eps.getIterationNumber()} iterations "
            f"(SLEPc reason {int(eps.getConvergedReason())}); request fewer modes or check the mesh"
        )
    for i in range(k):
        vector = system.K_ee.createVecRight()
        squares.append(float(eps.getEigenpair(i, vector).real))
        vectors.append(vector)


def _finish(solver: TissueSolver, system: BlockSystem, modes: list[PETSc.Vec]) -> tuple[Array, Array]:
    """Normalise, fix the signs and check the residuals |K phi - omega^2 M phi|_(K^-1) / omega. Collective."""
    rtol = solver.ksp.getTolerances()[0]
    if solver.name in ITERATIVE:  # a number to one digit
        solver.ksp.setTolerances(rtol=0.1)
    try:
        return _checked(solver, system, modes)
    finally:  # others share the solver
        solver.ksp.setTolerances(rtol=rtol)


def _checked(solver: TissueSolver, system: BlockSystem, modes: list[PETSc.Vec]) -> tuple[Array, Array]:
    """See :func:`_finish`; the tolerance of the solver is set. Collective."""
    comm = system.layout.comm
    omega, Phi = np.empty(len(modes)), np.empty((system.layout.n_local, len(modes)), order="F")
    y, r = system.K_ee.createVecs()
    compass = _generic(system, 0)
    for i, phi in enumerate(modes):
        system.M_ee.mult(phi, y)
        side = comm.allreduce(float(np.dot(compass, y.array_r)))
        phi.scale((-1.0 if side < 0 else 1.0) / np.sqrt(phi.dot(y)))
        system.M_ee.mult(phi, y)
        system.K_ee.mult(phi, r)
        square = float(phi.dot(r))
        r.axpy(-square, y)
        solver.solve(r, y)
        error = np.sqrt(abs(r.dot(y)) / square) if square > 0 else np.inf
        if not error <= RESIDUAL:
            raise SolverError(
                f"modes: mode {i + 1} has the relative residual {error:.1e}, allowed is {RESIDUAL:.0e}; "
                "the stiffness is singular or badly scaled: check material, mesh and contact zone"
            )
        omega[i] = np.sqrt(square)
        Phi[:, i] = phi.array_r
    y.destroy()
    r.destroy()
    return omega, Phi
