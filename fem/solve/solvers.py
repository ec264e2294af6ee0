"""One linear solver for S w = r, chosen by size, factored once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, from_options, petsc_options, total, user_options, whole_copy
from softgrasp.fem.solve.cholesky import (
    AskedSolver,
    NodeOrder,
    OrderedFactor,
    block_solves,
    direct_solves,
    dissect,
    factor_blocks,
    is_factor,
    make_factor,
    make_ksp,
    package_of,
    solve_checked,
)
from softgrasp.fem.solve.costs import FEW_SOLVES, UNKNOWN, Work
from softgrasp.fem.solve.costs import ITERATIVE as ITERATIVE
from softgrasp.fem.solve.costs import Reproducible as Reproducible
from softgrasp.fem.solve.costs import SolverName as SolverName
from softgrasp.fem.solve.stars import Stars, factored
from softgrasp.fem.solve.subtrees import SplitFactor, split_factor

# Largest problem whose single entries PETSc's own Cholesky factors faster than MUMPS, where blocks lose digits.
FEW_LIMIT = {1: 200_000, 2: 200_000, 3: 4_000}  # 1: systems without a mesh
DIRECT_LIMIT = {1: 4_000_000, 2: 4_000_000, 3: 300_000}  # above, the factor itself does not fit
# Below 1e-8 the residual needs no second look. Above, it proves little: a backward stable solve has eps |S| |w| / |r|,
# which grows with the condition though w may be right. One step of refinement measures the error of w itself.
DIRECT_RESIDUAL = 1e-8
DIRECT_ERROR = 1e-6
OUT_OF_MEMORY = 3  # PC_FACTOR_OUTMEMORY
# Percent beyond the estimate that MUMPS reserves on each rank. With PETSc's 20 one of four set-ups on two ranks of a
# busy machine failed, for a cause that was not found; pages that are not touched need no memory.
WORKSPACE = 100


class SolverUsed(NamedTuple):
    """Linear solver of a run."""

    name: SolverName  # name in time.solver
    reason: str  # reason of the choice, in words
    package: str  # package that factored or preconditioned the matrix, as PETSc reports it


def choose_solver(
    layout: BlockLayout,
    requested: str = "auto",
    few: bool = False,
    contrast: float = UNKNOWN,
    steps: int = 200,
    memory: float = np.inf,
    direct: bool = False,
) -> tuple[SolverName, str]:
    """The solver of the least modelled time (`softgrasp.fem.solve.costs`) that fits, with the reason in words.

    Args:
        few: some static solves with one factor, not the steps of a run.
        contrast: largest lambda / mu, which iterations grow with; not known: a factor while one is a candidate.
        steps: of the run.
        memory: that set-up and factor may use, over all ranks [byte].
        direct: a factor while one is a candidate.
    """
    work = replace(work_of(layout, FEW_SOLVES if few else steps, few, contrast), direct=direct)
    return work.solver(requested, memory), work.reason(requested, memory)


def work_of(layout: BlockLayout, solves: int, few: bool, contrast: float, reproducible: Reproducible = "auto") -> Work:
    """So many solves with a matrix of a layout, on its ranks."""
    return Work(layout.n_e, layout.dimension, layout.order, layout.comm.size, solves, few, contrast, reproducible)


def factor_on_every_rank(
    layout: BlockLayout, solver: SolverName, reproducible: Reproducible, linear: bool = False
) -> bool:
    """Whether every rank factors by itself, see :meth:`softgrasp.fem.solve.costs.Work.repeated`.

    ``linear``: for linear steps without contact, which a subtree on each rank serves too.
    """
    return replace(work_of(layout, 1, False, 1.0, reproducible), linear=linear).repeated(solver)


@dataclass(frozen=True)
class TissueSolver:
    """A factored (or preconditioned) symmetric positive definite matrix of the tissue block."""

    name: SolverName  # name in time.solver
    ksp: PETSc.KSP  # PETSc's solver; its vectors are those of S with mumps and cg only, so call `solve`
    S: PETSc.Mat  # symmetric positive definite matrix, (rows, rows) [N/m]
    tolerance: float  # largest relative residual that ``check`` accepts [1]
    # factor that solves without ``ksp``: whole on every rank, perhaps in an order of its own
    # (softgrasp.fem.solve.cholesky), a subtree on each, or that of one rank; None: spread by MUMPS, or none
    factor: PETSc.Mat | AskedSolver | OrderedFactor | SplitFactor | None = None
    stars: Stars | None = None  # preconditioner of solver "stars", which owns S; else None

    @property
    def package(self) -> str:
        """Package of the factor, as PETSc reports it, or of the preconditioner."""
        if self.stars is not None and self.stars.package:
            return f"stars, {self.stars.package}"
        return package_of(self.ksp.getPC())

    @property
    def entries(self) -> float | None:
        """Nonzero entries of the factor, as PETSc counts them; None where there is none. Collective."""
        pc = self.ksp.getPC()
        return float(pc.getFactorMatrix().getInfo()["nz_used"]) if is_factor(pc) else None

    def used(self, reason: str) -> SolverUsed:
        """This solver with the reason of its choice; to it are added the user's options, or single entries (slower)."""
        if asked := user_options(self.ksp.getOptionsPrefix()):
            reason += f"; with the PETSc options -{', -'.join(asked)}"
        elif self.name == "cholesky" and "sbaij" not in self.ksp.getOperators()[0].getType():
            reason += f"; in single entries by {self.package}, since blocks would lose digits here"
        return SolverUsed(self.name, reason, self.package)

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r.

        Collective. Raises :class:`SolverError` when the iteration does not converge.
        """
        if self.factor is not None:
            self.factor.solve(r, w)
            return
        solve_checked(self.ksp, r, w, self.name)

    def columns(self, X: Array, where: str = "", room: tuple[PETSc.Vec, PETSc.Vec] | None = None) -> Array:
        """S^-1 X of local rows (n_local, k), Fortran order; checked as :meth:`check` does if ``where`` is given.

        Columns of zeros are not solved. ``room``: vectors for single columns; None: they are made. Collective.
        """
        r, w = room or self.S.createVecs()
        result = np.zeros(X.shape, order="F")
        some = np.flatnonzero(total(self.S.comm.tompi4py(), np.abs(X).sum(axis=0)) != 0)
        block = None
        at_once = self.name == "mumps" and not user_options(self.ksp.getOptionsPrefix())
        if isinstance(self.factor, OrderedFactor) and len(some) > 1:  # each rank has the whole factor for some of them
            block = partial(self.factor.columns, at_once=at_once)
        elif at_once and len(some) > 1:
            block = partial(block_solves, self.ksp.getPC().getFactorMatrix())
        if block is not None and len(some):
            result[:, some] = block(X[:, some])
        try:
            for j in some:
                r.array_w[:] = X[:, j]
                w.array_w[:] = result[:, j]
                if block is None:
                    self.solve(r, w)
                    result[:, j] = w.array_r
                if where:
                    self.check(r, w, where)
        finally:
            for vector in () if room else (r, w):
                vector.destroy()
        return result

    def residual(self, r: PETSc.Vec, w: PETSc.Vec, size: float = 0.0) -> float:
        """Residual |S w - r| / max(|r|, size); ``size`` is that of the terms of r, which may cancel. Collective."""
        y = self.S.createVecLeft()
        self.S.mult(w, y)
        y.axpy(-1.0, r)
        scale = max(r.norm(), size)
        value = y.norm() / scale if scale > 0 else y.norm()
        y.destroy()
        return float(value)

    def check(self, r: PETSc.Vec, w: PETSc.Vec, where: str, size: float = 0.0) -> float:
        """Raise unless S w = r is solved to the tolerance: direct solvers do not report it. Collective.

        A direct solve with a larger residual passes when the correction of one refinement step, which is about its
        error, is small against w. Returns the relative residual. Raises SolverError: the iteration stopped early, or
        the matrix is singular, indefinite or badly scaled.
        """
        value = self.residual(r, w, size)
        if value <= self.tolerance:
            return value
        if not np.isfinite(r.norm()):
            raise SolverError(
                f"{self.name}: the right-hand side is not finite at {where}; check material, dt and force"
            )
        text = f"relative residual {value:.1e} at {where} exceeds {self.tolerance:.0e}"
        if self.name not in ITERATIVE and np.isfinite(value):
            error = self.error(r, w)
            if error <= DIRECT_ERROR:
                return value
            text = f"estimated error {error:.1e} at {where} exceeds {DIRECT_ERROR:.0e} (relative residual {value:.1e})"
        raise SolverError(
            f"{self.name}: {text}; the matrix is singular, indefinite or badly scaled: check material, mesh and "
            "contact zone"
        )

    def error(self, r: PETSc.Vec, w: PETSc.Vec) -> float:
        """Estimate |w - S^{-1} r| / |w| by the correction S^{-1} (r - S w) of one refinement step. Collective."""
        y, e = self.S.createVecs()
        self.S.mult(w, y)
        y.aypx(-1.0, r)
        self.solve(y, e)
        size = w.norm()
        value = float(e.norm() / size) if size > 0 else np.inf
        y.destroy()
        e.destroy()
        return value

    def renew(self, A: PETSc.Mat) -> bool:
        """Factor A, of the pattern and the rows of S, in the place of S; whether that worked. Collective.

        ``S`` itself keeps its numbers where blocks are factored, and :meth:`check` is of no use afterwards.
        """
        if self.stars is not None:
            try:
                self.stars.renew(A)
            except np.linalg.LinAlgError:
                return False
            return True
        P = self.ksp.getOperators()[0]
        if "sbaij" in P.getType():
            A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            A.convert("sbaij", P)
        else:
            A.copy(P, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self.ksp.setOperators(P)  # else PETSc does not see that the numbers changed
        return make_factor(self.ksp, tangent=True)

    def destroy(self) -> None:
        """Free solver and matrix. Collective."""
        if isinstance(self.factor, OrderedFactor | SplitFactor):
            self.factor.destroy()
        self.ksp.destroy()
        if self.stars is not None:
            self.stars.destroy()
        else:
            self.S.destroy()


def make_solver(
    S: PETSc.Mat,
    name: SolverName,
    layout: BlockLayout,
    prefix: str,
    rtol: float = 1e-10,
    reproducible: Reproducible = "auto",
    ordered: bool = False,
    subtrees: bool = False,
    tangent: bool = False,
) -> TissueSolver:
    """Factor S (or set up CG with GAMG). Collective.

    Args:
        S: symmetric positive definite, owned by the solver from here on.
        name: cholesky (PETSc, every rank by itself), mumps (see ``reproducible``) cg (GAMG [VMB96]) or stars.
        rtol: relative tolerance of cg and stars.
        reproducible: see :func:`factor_on_every_rank`.
        ordered: cholesky, S on one rank: its rows are in the order of elimination already, in blocks (BAIJ).
        subtrees: cholesky: a subtree on each rank, if blocks keep the digits and the user gave no options.
        tangent: cholesky: S may be indefinite, as on the way of Newton's method.

    Raises SolverError: the factorisation fails.
    """
    S.setOption(PETSc.Mat.Option.SPD, True)
    tolerance = max(DIRECT_RESIDUAL, 10 * rtol)
    if name == "cholesky":
        if subtrees and (split := split_factor(S, prefix, layout.dimension)) is not None:
            return TissueSolver(name, split.ksp, S, tolerance, split)
        return _cholesky(S, layout, prefix, tolerance, ordered, tangent)
    if name == "stars":
        return _stars(S, layout, prefix, rtol, tolerance)
    if name == "mumps" and S.comm.size > 1 and factor_on_every_rank(layout, name, reproducible):
        return _repeated(S, layout, prefix, tolerance)
    ksp = PETSc.KSP().create(S.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(S)
    if name == "cg":
        _set_up_cg(ksp, S, layout, prefix, rtol)
    else:
        ksp.setType("preonly")
        ksp.getPC().setType("cholesky")
        ksp.getPC().setFactorSolverType("mumps")
        from_options(ksp)
    try:
        with petsc_options(prefix, {"mat_mumps_icntl_14": WORKSPACE} if name == "mumps" and S.comm.size > 1 else {}):
            _factor(ksp, S, name)
    except SolverError:
        ksp.destroy()
        S.destroy()
        raise
    factor = direct_solves(ksp) if name != "cg" and ksp.comm.size == 1 else None
    return TissueSolver(name, ksp, S, tolerance, factor)


def _repeated(S: PETSc.Mat, layout: BlockLayout, prefix: str, tolerance: float) -> TissueSolver:
    """MUMPS factors the whole matrix on every rank; one gather a solve. Collective."""
    nodes = np.arange(layout.n_e // layout.dimension)
    ksp = make_ksp(whole_copy(S), prefix, "mumps")
    try:
        with raise_on_all_ranks(S.comm.tompi4py()):
            _factor(ksp, S, "mumps")
    except SolverError:
        ksp.destroy()
        S.destroy()
        raise
    return TissueSolver("mumps", ksp, S, tolerance, _gathered(ksp, NodeOrder(nodes, nodes, layout.dimension), S))


def _gathered(ksp: PETSc.KSP, order: NodeOrder, S: PETSc.Mat) -> OrderedFactor:
    """The factor of one rank alone for vectors distributed as those of S. Collective."""
    like = S.createVecLeft()
    factor = OrderedFactor(direct_solves(ksp), order, like)
    like.destroy()
    return factor


def _cholesky(
    S: PETSc.Mat, layout: BlockLayout, prefix: str, tolerance: float, ordered: bool, tangent: bool
) -> TissueSolver:
    """Every rank factors the whole matrix. Collective."""
    P, order = S, None
    if not ordered:
        every = whole_copy(S)
        dissection = dissect(every, layout.dimension)
        order, P = dissection.order, dissection.matrix(every)
        every.destroy()
    try:
        with raise_on_all_ranks(S.comm.tompi4py()):
            by: Literal["petsc", "mumps"] = "petsc" if layout.n_e <= FEW_LIMIT[layout.dimension] else "mumps"
            ksp = factor_blocks(P, prefix, by, tangent)
    except SolverError:
        S.destroy()
        raise
    finally:
        if P is not S:
            P.destroy()  # the ksp owns what it needs
    factor = direct_solves(ksp) if order is None else _gathered(ksp, order, S)
    return TissueSolver("cholesky", ksp, S, tolerance, factor)


def _factor(ksp: PETSc.KSP, S: PETSc.Mat, name: SolverName) -> None:
    """The set-up. Collective where ksp is."""
    try:
        ksp.setUp()
    except PETSc.Error as error:
        raise SolverError(
            f"{name}: the factorisation of the tissue matrix (n_e = {S.getSize()[0]}) failed (PETSc error "
            f"{error.ierr}); check material and mesh"
        ) from error
    reason = ksp.getPC().getFailedReason()
    if reason:
        why = "out of memory or workspace; use more ranks" if reason == OUT_OF_MEMORY else "the matrix is not definite"
        raise SolverError(f"{name}: set-up failed (reason {reason}); {why}")


def _stars(S: PETSc.Mat, layout: BlockLayout, prefix: str, rtol: float, tolerance: float) -> TissueSolver:
    """CG with multigrid over vertex stars; flexible where the linear elements are iterated upon. Collective."""
    if layout.patches is None:
        S.destroy()
        raise SolverError("stars: linear elements have no stars to smooth over; use tissue.order = 2 or another solver")
    ksp = PETSc.KSP().create(S.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setType("cg" if factored(layout) else "fcg")
    _set_tolerance(ksp, rtol)
    try:
        stars = Stars(ksp, S, layout)
    except (PETSc.Error, np.linalg.LinAlgError) as error:
        ksp.destroy()
        raise SolverError(f"stars: the set-up failed ({error}); check material and mesh") from error
    finally:
        S.destroy()
    return TissueSolver("stars", ksp, stars.matrices[0], tolerance, None, stars)


def _set_tolerance(ksp: PETSc.KSP, rtol: float) -> None:
    # the preconditioned norm would stop at a true residual 1e3 times larger
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=rtol, atol=1e-300, max_it=500)


def _set_up_cg(ksp: PETSc.KSP, S: PETSc.Mat, layout: BlockLayout, prefix: str, rtol: float) -> None:
    d = layout.dimension
    coordinates = PETSc.Vec().createWithArray(
        layout.nodes.ravel().copy(), size=(layout.n_local, layout.n_e), bsize=d, comm=layout.comm
    )
    # the submatrix does not inherit it, and without rigid modes GAMG needs twice the iterations
    near = PETSc.NullSpace().createRigidBody(coordinates)
    S.setNearNullSpace(near)
    near.destroy()
    ksp.setType("cg")
    _set_tolerance(ksp, rtol)
    ksp.getPC().setType("gamg")
    with petsc_options(prefix, {"pc_gamg_threshold": 0.01, "mg_levels_ksp_type": "chebyshev"}):
        ksp.setFromOptions()
