"""Closed-loop abscissa of a large plant: shift-and-invert for what lies near the axis, a bound on everything else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from slepc4py import SLEPc

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc, from_options, total
from softgrasp.fem.shown import Shown
from softgrasp.fem.solve.solvers import factor_on_every_rank, make_solver
from softgrasp.fem.solve.stiffness import shared_factor, static_solver
from softgrasp.fem.system import dynamic_stiffness
from softgrasp.lqr.dense.modal import modes_of_plant
from softgrasp.lqr.lowrank.compress import gram
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import EPS, ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import damp, descriptor
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.tail import TailBound, why_no_bound

PREFIX = "softgrasp_spectrum_"
TOLERANCE = 1e-9  # of 1/(sigma - lambda)
ERROR = 1e-6  # relative residual of an eigenpair that is let pass
GROWTH = (24, 48, 96)  # eigenvalues computed until they cover what the bound leaves open, after a first guess
ITERATIONS = 60  # restarts; eigenvalues that accumulate need any number, those before them few
SAFE = 0.9  # of the small gain, for the radius that is aimed at
ENOUGH = 0.7  # share of the radius aimed at, where the bound is valid already
SHOWN = 10  # modes that the circle should contain, so that the abscissa is that of the slowest of them
GAP = 1e-3  # relative distance of two eigenvalues that the circle may pass between
NEARLY = 1e-3  # share of the abscissa by which an eigenvalue outside may exceed it


@dataclass(frozen=True, repr=False)
class Abscissa(Shown):
    """Largest real part of the closed-loop spectrum."""

    value: float
    """Largest real part of the computed eigenvalues, a lower bound of the abscissa [1/s]."""
    certified: bool
    """Whether the sign is proved: ``value`` >= 0, or no eigenvalue with Re s >= 0 lies outside the radius."""
    radius: float
    """Radius |s| up to which all eigenvalues with Re s >= 0 are computed [1/s]."""
    bound: float
    """Bound of |K (sE - A)^{-1} B| over Re s >= 0, |s| >= radius; below 1 it excludes eigenvalues there."""
    eigenvalues: np.ndarray
    """Computed eigenvalues, nearest to ``shift`` first [1/s], (k,)."""
    reason: str = ""
    """Why the sign is not certified; empty when it is."""
    exact: bool = False
    """Whether the abscissa exceeds ``value`` by at most a thousandth of it."""
    shift: float = 0.0
    """Real centre of the computed eigenvalues [1/s]."""

    @property
    def stable(self) -> bool:
        """Certified and left of the axis."""
        return self.certified and self.value < 0


def abscissa(
    problem: RiccatiProblem, gain: Gain, modes: tuple[Array, Array] | None = None, shift: float | None = None
) -> Abscissa:
    """Largest real part of the spectrum of x' = (A + B K) x [1/s], with a certificate of its sign. Collective.

    Eigenvalues of A + B K in a circle around sigma > 0, and a small-gain bound outside it:
    :class:`softgrasp.lqr.spectrum.tail.TailBound` excludes eigenvalues with Re s >= 0 beyond a radius r; the circle
    |s - sigma| <= d with d^2 = r^2 + sigma^2 contains all others with Re s >= 0. Kelvin-Voigt damping makes infinitely
    many eigenvalues accumulate at -1/beta as the mesh gets finer; sigma is chosen so that the circle leaves them
    outside. One solve with sigma^2 M_ee + sigma D_ee + K_ee a step, factored once; the few inputs enter by
    Sherman-Morrison-Woodbury. Inside `softgrasp.fem.solve.stiffness.sharing_factors` gains of one sigma share the
    factor and what the inputs answer without feedback.

    The Krylov space starts from a vector without symmetry, and only eigenvalues before the first one that has not
    converged count; the circle passes through a gap between two of them.

    Args:
        problem: the plant; damped in every layer for a certificate.
        gain: u = K x.
        modes: see :class:`softgrasp.lqr.spectrum.tail.TailBound`, when they are there already.
        shift: sigma of another gain of the plant, used while the certificate holds with it; None for the own one.

    Raises:
        ControlError: the plant has no hand.
        SolverError: no eigenvalue converges.

    >>> import softgrasp as sg
    >>> problem = sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    >>> sg.abscissa(problem, sg.solve(problem).gain).value < 0
    True
    """
    n_s, K = problem.layout.n_s, gain.block
    if n_s == 0:
        raise ControlError(
            "the certified abscissa belongs to a hand; without one use softgrasp.lqr.spectrum.modal_loop.ModalLoop"
        )
    K_q = K.hand[:n_s].T
    if not np.linalg.svd(K_q, compute_uv=False)[-1] > 100 * EPS * np.linalg.norm(K.hand):
        reason = "the gain on a rigid displacement is singular: the hand is not controlled"
        return Abscissa(0.0, True, 0.0, np.inf, np.zeros(1, dtype=complex), reason)
    why = why_no_bound(problem)
    tail = None if why else TailBound(problem, K, modes)
    # the same bits on every rank: they decide how often all search
    aim, own, guess = problem.layout.comm.bcast(_circle(problem, tail))
    for sigma in dict.fromkeys((own,) if shift is None else (shift, own)):
        result = _searched(problem, K, tail, why, aim, sigma, guess)
        if result.certified or why:
            break
    return result


def centre(problem: RiccatiProblem, gain: Gain, modes: tuple[Array, Array] | None) -> float:
    """The own shift sigma of a gain [1/s], see :func:`abscissa`. Collective."""
    tail = None if why_no_bound(problem) else TailBound(problem, gain.block, modes)
    return float(problem.layout.comm.bcast(_circle(problem, tail)[1]))


def _searched(
    problem: RiccatiProblem, K: Block, tail: TailBound | None, why: str, aim: float, shift: float, guess: int
) -> Abscissa:
    """Result with eigenvalues nearest to a shift, more of them until they cover the radius ``aim``. Collective."""
    with open_loop_of(problem, shift) as plant:
        resolvent = Resolvent(plant, K)
        try:
            for count in (guess, *(more for more in GROWTH if more > guess)):
                number = min(count, problem.layout.states - 2)
                values = resolvent.nearest(number)
                result: Abscissa = problem.layout.comm.bcast(_conclude(values, shift, tail, why))
                short = len(values) < number  # asking for more would not help
                enough = result.certified and (result.exact or result.radius >= ENOUGH * aim)
                if result.value >= 0 or short or enough or why:
                    break
        finally:
            resolvent.shell.destroy()
    return result


@contextmanager
def open_loop_of(problem: RiccatiProblem, shift: float) -> Iterator[OpenLoop]:
    """The plant without feedback at a shift, which gains share. Collective."""
    system = problem.system
    matrices = [A for A in (system.K_ee, system.M_ee, system.damping.matrix) if A is not None]
    key = shift, system.damping.alpha, system.damping.beta, *((A.handle, A.stateGet()) for A in matrices)
    with shared_factor(system, "resolvent", key, partial(OpenLoop, problem, shift)) as plant:
        yield plant


def _circle(problem: RiccatiProblem, tail: TailBound | None) -> tuple[float, float, int]:
    """Radius to cover, centre sigma of the search, and how many eigenvalues lie there if feedback moved none.

    Collective.
    """
    k = min(SHOWN, problem.layout.n_e)
    omega = modes_of_plant(problem, k)[0] if tail is None else tail.omega[:k]
    beta = problem.system.damping.beta if tail is None else tail.beta
    needed = 0.0 if tail is None else tail.radius(SAFE)
    shown = 1.05 * float(omega[-1])
    if beta > 0:  # modes beyond 1 / beta are overdamped and accumulate there
        shown = min(shown, 1 / beta)
    radius = max(needed, shown) if np.isfinite(needed) else shown
    # of all centres beta r^2 keeps the circle farthest from -1/beta, relative to its size
    inside = int(np.sum(omega < radius)) if tail is None else int(np.sum(tail.omega < radius))
    # the poles of the hand, and a pair a mode; one more would be sought among those that accumulate
    return radius, max(radius / 4, beta * radius**2), min(2 * problem.layout.n_s + 2 * inside, GROWTH[-1])


def _conclude(values: np.ndarray, shift: float, tail: TailBound | None, why: str) -> Abscissa:
    """Result of the eigenvalues nearest to the shift."""
    distance = np.abs(values - shift)
    order = np.argsort(distance)
    values, distance = values[order], distance[order]
    wide = np.flatnonzero(np.diff(distance) > GAP * distance[1:])
    last = int(wide[-1]) if len(wide) else len(values) - 1
    d = float(0.1 * distance[last] + 0.9 * distance[min(last + 1, len(distance) - 1)])
    value = float(values.real.max())
    a = max(-value, 0.0) * (1 - NEARLY)
    radius = float(np.sqrt(max(d**2 - shift**2, 0.0)))
    if value >= 0:
        return Abscissa(value, True, radius, np.inf, values, "", True, shift)
    if tail is None:
        return Abscissa(value, False, radius, np.inf, values, why, False, shift)
    bound = tail.bound(radius) if radius > 0 else np.inf
    # |s| <= r, Re s >= -a lies in the circle while r^2 + 2 a sigma + sigma^2 <= d^2
    inner = float(np.sqrt(max(d**2 - shift**2 - 2 * a * shift, 0.0)))
    exact = inner > a and tail.bound(inner, a) < 1
    reason = ""
    if not bound < 1:
        reason = f"the gain reaches modes beyond {radius:.3g}/s: the bound there is {bound:.2g}, not below 1"
    return Abscissa(value, not reason, radius, bound, values, reason, exact, shift)


class OpenLoop:
    """x = (sigma E - A)^{-1} b with one factor of sigma^2 M_ee + sigma D_ee + K_ee, made here. Collective.

    Attributes:
        columns: (sigma E - A)^{-1} B, n_s columns.
    """

    def __init__(self, problem: RiccatiProblem, shift: float) -> None:
        self.problem, self.shift = problem, shift
        self.system, self.layout, self.comm = problem.system, problem.layout, problem.layout.comm
        self.drag = self.system.damping.drag
        name = static_solver(self.system)
        subtrees = not factor_on_every_rank(self.layout, name, "auto", linear=True)
        S = dynamic_stiffness(self.system, shift)
        self.solver = make_solver(S, name, self.layout, PREFIX, rtol=1e-12, subtrees=subtrees)
        try:
            self._couple(shift)
        except Exception:
            self.destroy()
            raise

    def _couple(self, sigma: float) -> None:
        """The hand's part, and the columns. Collective."""
        system, n_s = self.system, self.layout.n_s
        hand = sigma**2 * self.problem.M_s
        if system.two_way:
            self.S_G = self.solver.columns(system.G)
            factor = sigma**2 + sigma * self.drag
            hand = hand + sigma * self.drag * system.M_rigid
            hand = hand - factor**2 * total(self.comm, system.G.T @ self.S_G)
        self.hand = np.linalg.inv(hand)
        loads = Block(np.eye(2 * n_s, n_s, -n_s), np.zeros((2 * self.layout.n_local, n_s)))
        self.columns = Block.join([self.solve(loads[i : i + 1]) for i in range(n_s)])

    def destroy(self) -> None:
        """Free the factor. Collective."""
        self.solver.destroy()

    def solve(self, b: Block) -> Block:
        """(sigma E - A)^{-1} b for one column. Collective."""
        system, sigma, (a_s, b_s, a, f) = self.system, self.shift, b.parts
        # v = sigma q - a: the displacements alone remain
        _, moved_s, _, moved = descriptor(self.problem, Block.of_parts(0 * a_s, a_s, 0 * a, a)).parts
        right = b_s + sigma * moved_s
        force = f + sigma * moved + damp(system, a) + self.drag * (system.G @ a_s)
        if system.two_way and self.drag:
            right = right + self.drag * (system.M_rigid @ a_s + total(self.comm, system.G.T @ a))
        factor = sigma**2 + sigma * self.drag
        if system.two_way:
            z = self.solver.columns(force)
            q_s = self.hand @ (right - factor * total(self.comm, system.G.T @ z))
            z = z - factor * (self.S_G @ q_s)
        else:
            q_s = self.hand @ right
            z = self.solver.columns(force - factor * (system.G @ q_s))
        return Block.of_parts(q_s, sigma * q_s - a_s, z, sigma * z - a)


class Resolvent:
    """y = (sigma E - A - B K)^{-1} E x as a PETSc shell; local rows [hand on rank 0; z; v]."""

    def __init__(self, plant: OpenLoop, K: Block) -> None:
        self.plant, self.K = plant, K
        self.layout, self.comm, self.n_s = plant.layout, plant.comm, plant.layout.n_s
        self.extra = 2 * self.n_s if self.comm.rank == 0 else 0
        local = 2 * self.layout.n_local + self.extra
        self.shell = PETSc.Mat().createPython(((local, self.layout.states),) * 2, self, comm=self.comm)
        self.shell.setUp()
        self.small = np.linalg.inv(np.eye(self.n_s) - gram(self.comm, K, plant.columns))

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply y = (sigma E - A - B K)^{-1} E x. Collective."""
        local = x.array_r
        hand = np.array(local[: self.extra]) if self.extra else np.empty(2 * self.n_s)
        self.comm.Bcast(hand)
        state = Block(hand[:, None], np.array(local[self.extra :])[:, None])
        answer, columns = self.plant.solve(descriptor(self.plant.problem, state)), self.plant.columns
        input_ = self.small @ gram(self.comm, self.K, answer)
        out = y.array_w
        out[: self.extra] = (answer.hand + columns.hand @ input_)[: self.extra, 0]
        out[self.extra :] = (answer.tall + columns.tall @ input_)[:, 0]

    def nearest(self, count: int) -> np.ndarray:
        """The ``count`` eigenvalues nearest to the shift, or as many as converge before the first that does not.

        Collective.

        Raises SolverError: none converges, or an eigenpair has a large residual.
        """
        eps = SLEPc.EPS().create(self.comm)
        eps.setOptionsPrefix(PREFIX)
        eps.setOperators(self.shell)
        eps.setProblemType(SLEPc.EPS.ProblemType.NHEP)
        eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_MAGNITUDE)
        eps.setDimensions(nev=count, ncv=min(2 * count + 16, self.layout.states))
        eps.setTolerances(TOLERANCE, ITERATIONS)
        from_options(eps)
        start = self.shell.createVecRight()
        nodes = self.layout.nodes.ravel()
        start.array_w[: self.extra] = 1.0
        start.array_w[self.extra :] = np.concatenate([np.cos(1 + 3 * nodes), np.sin(2 + 5 * nodes)])
        eps.setInitialSpace(start)
        try:
            eps.solve()
            converged = eps.getConverged()
            if converged == 0:
                raise SolverError(
                    f"closed-loop spectrum: none of {count} eigenvalues converged in {eps.getIterationNumber()} "
                    "iterations; judge the gain by a time simulation or a smaller scene"
                )
            theta = np.array([eps.getEigenvalue(i) for i in range(converged)])
            worst = max(eps.computeError(i) for i in range(0, converged, max(1, converged // 6)))
            if not worst <= ERROR:
                raise SolverError(
                    f"closed-loop spectrum: an eigenpair has the residual {worst:.1e}, allowed {ERROR:.0e}"
                )
        finally:
            eps.destroy()
            start.destroy()
        return np.asarray(self.comm.bcast(self.plant.shift - 1 / theta))
