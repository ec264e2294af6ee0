"""Closed-loop abscissa of a large plant: shift-and-invert at 0, and a bound on everything farther out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from slepc4py import SLEPc

from fem.errors import SolverError
from fem.petsc import Array, PETSc, times_columns, total
from fem.solvers import TissueSolver, choose_solver, make_solver
from lqr.checks import EPS
from lqr.dense import some_modes
from lqr.modal_start import plant_modes
from lqr.operators import damp, descriptor
from lqr.plant import Block, Plant
from lqr.problem import RiccatiProblem
from reduction.inner import solve_columns

PREFIX = "softgrasp_spectrum_"
TOLERANCE = 1e-9  # of 1/lambda
ERROR = 1e-6  # relative residual of an eigenpair that is let pass
GROWTH = (24, 48, 96)  # eigenvalues asked for until the bound holds


@dataclass(frozen=True)
class Abscissa:
    """Largest real part of the closed-loop spectrum.

    Attributes:
        value: over all eigenvalues with |s| <= radius [1/s]; a lower bound when it is >= 0.
        certified: no eigenvalue with Re s >= 0 lies outside the radius.
        radius: [1/s].
        bound: of |K (sE - A)^{-1} B| over Re s >= 0, |s| >= radius; below 1 it excludes eigenvalues there.
        eigenvalues: those inside, (k,).
        reason: why it is not certified; empty when it is.
    """

    value: float
    certified: bool
    radius: float
    bound: float
    eigenvalues: np.ndarray
    reason: str = ""

    @property
    def stable(self) -> bool:
        """Certified and left of the axis."""
        return self.certified and self.value < 0


def certified_abscissa(problem: RiccatiProblem, K: Block) -> Abscissa:
    """Eigenvalues of A + B K nearest 0, then a small-gain bound outside their circle. Collective.

    (A + B K)^{-1} E takes one solve with K_ee, because K_ee alone is what A holds besides the hand; the few inputs are
    back substitution. An eigenvalue s with Re s >= 0 outside needs |h(s)| >= 1, h(s) = K (sE - A)^{-1} B; h is analytic
    there, so that its bound on the boundary of the region holds inside too:

        |h| <= |K_q M_s^{-1}| / r^2 + |K_v M_s^{-1}| / r + sum_k (|K_zk| / r + |K_vk|) |g_k M_s^{-1}| b_k(r),
        b_k = min(1 / (2 delta_k), r / (r - omega_k)^2),

    over the lowest modes, the rest by Cauchy-Schwarz with 2 delta_k >= max(alpha, beta omega_k^2). Two-way the same
    holds in the modes of the tissue with the hand floating, where q_s = M_s^{-1}(u / s^2 - G'z) adds to the gain on z.

    Args:
        problem: the plant; damped in all layers alike for a certificate.
        K: gain, transposed, hand-relative.

    Raises:
        SolverError: the eigenvalue iteration does not converge.
    """
    n_s = problem.layout.n_s
    K_q = K.hand[:n_s].T
    if not np.linalg.svd(K_q, compute_uv=False)[-1] > 100 * EPS * np.linalg.norm(K.hand):
        reason = "the gain on a rigid displacement is singular: the hand is not held"
        return Abscissa(0.0, True, 0.0, np.inf, np.zeros(1, dtype=complex), reason)
    inverse = _Inverse(problem, K)
    tail = None
    result: Abscissa | None = None
    try:
        for count in GROWTH:
            count = min(count, problem.layout.states - 2)
            values = inverse.nearest(count)
            radius = float(np.abs(values).max()) * (1 - 1e-6)
            value = float(values.real.max())
            reason = _why_not(problem)
            bound = np.inf
            if not reason and value < 0:
                tail = tail or _Tail(problem, K, inverse.solver)
                bound = tail.bound(radius)
                if bound >= 1:
                    reason = (
                        f"the gain reaches modes beyond {radius:.3g}/s: the bound there is {bound:.2g}, not below 1"
                    )
            certified = value >= 0 or not reason
            result = Abscissa(value, certified, radius, bound, values, "" if certified else reason)
            if certified or _why_not(problem):
                break
    finally:
        inverse.free()
    if result is None:
        raise SolverError("the closed-loop spectrum was not computed; the plant has no tissue")
    return result


def _why_not(problem: RiccatiProblem) -> str:
    damping = problem.system.damping
    if problem.system.two_way and damping.alpha > 0:
        return "two-way coupling with alpha > 0: only the eigenvalues inside the radius are known"
    if not damping.active:
        return "no damping: modes beyond the radius stay on the axis"
    if damping.matrix is not None:
        return "layers with different damping: only the eigenvalues inside the radius are known"
    return ""


class _Inverse:
    """y = (A + B K)^{-1} E x as a PETSc shell; local rows [hand on rank 0; z; v]."""

    def __init__(self, problem: RiccatiProblem, K: Block) -> None:
        self.problem, self.K = problem, K
        self.system, self.layout, self.comm = problem.system, problem.layout, problem.layout.comm
        self.n_s, self.n = self.layout.n_s, self.layout.n_local
        self.inverse = np.linalg.inv(K.hand[: self.n_s].T)
        name = choose_solver(self.layout)[0]
        self.solver: TissueSolver = make_solver(
            self.system.K_ee.copy(), name, self.layout, "softgrasp_spectrum_", rtol=1e-12
        )
        self.r, self.w = self.system.K_ee.createVecs()
        self.extra = 2 * self.n_s if self.comm.rank == 0 else 0
        local = 2 * self.n + self.extra
        self.shell = PETSc.Mat().createPython(((local, self.layout.states),) * 2, self, comm=self.comm)
        self.shell.setUp()

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply y = (A + B K)^{-1} E x. Collective."""
        hand, tall = self._split(x.array_r)
        e = descriptor(self.problem, Block(hand[:, None], tall[:, None]))
        a, b, n, s = e.hand[:, 0], e.tall[:, 0], self.n, self.n_s
        v_s, v = a[:s], b[:n]
        force = b[n:] + damp(self.system, v[:, None])[:, 0]
        drag = self.system.damping.alpha if self.system.damping.in_space else 0.0
        if drag:
            force = force + drag * (self.system.G @ v_s)
        z = -self._solve(force)
        felt = total(self.comm, self.K.tall[:n].T @ z + self.K.tall[n:].T @ v)
        right = a[s:] - self.K.hand[s:].T @ v_s - felt
        if drag and self.system.two_way:
            right = right + drag * (self.system.M_rigid @ v_s + total(self.comm, self.system.G.T @ v))
        out = y.array_w
        if self.extra:
            out[: 2 * s] = np.concatenate([self.inverse @ right, v_s])
        out[self.extra : self.extra + n] = z
        out[self.extra + n :] = v

    def _split(self, local: Array) -> tuple[Array, Array]:
        hand = np.array(local[: self.extra]) if self.extra else np.empty(2 * self.n_s)
        self.comm.Bcast(hand)
        return hand, np.array(local[self.extra :])

    def _solve(self, right: Array) -> Array:
        self.r.array_w[:] = right
        self.solver.solve(self.r, self.w)
        return np.array(self.w.array_r)

    def nearest(self, count: int) -> np.ndarray:
        """The ``count`` eigenvalues nearest 0 (one more when a pair would be cut). Collective."""
        eps = SLEPc.EPS().create(self.comm)
        eps.setOptionsPrefix(PREFIX)
        eps.setOperators(self.shell)
        eps.setProblemType(SLEPc.EPS.ProblemType.NHEP)
        eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_MAGNITUDE)
        eps.setDimensions(nev=count, ncv=min(2 * count + 16, self.layout.states))
        eps.setTolerances(TOLERANCE, 300)
        start = self.shell.createVecRight()
        nodes = self.layout.nodes.ravel()
        start.array_w[: self.extra] = 1.0
        start.array_w[self.extra :] = np.concatenate([np.cos(1 + 3 * nodes), np.sin(2 + 5 * nodes)])
        eps.setInitialSpace(start)
        try:
            eps.solve()
            found = eps.getConverged()
            if found < count:
                raise SolverError(
                    f"closed-loop spectrum: {found} of {count} eigenvalues converged in "
                    f"{eps.getIterationNumber()} iterations; judge the gain by a time simulation or a smaller scene"
                )
            theta = np.array([eps.getEigenvalue(i) for i in range(found)])
            worst = max(eps.computeError(i) for i in range(0, count, max(1, count // 6)))
            if not worst <= ERROR:
                raise SolverError(
                    f"closed-loop spectrum: an eigenpair has the residual {worst:.1e}, allowed {ERROR:.0e}"
                )
        finally:
            eps.destroy()
            start.destroy()
        return np.asarray(self.comm.bcast(1 / theta))

    def free(self) -> None:
        """Free all PETSc objects. Collective."""
        self.shell.destroy()
        self.solver.destroy()
        for vector in (self.r, self.w):
            vector.destroy()


class _Tail:
    """Bound of |K (sE - A)^{-1} B| for Re s >= 0, |s| >= r."""

    def __init__(self, problem: RiccatiProblem, K: Block, solver: TissueSolver) -> None:
        system, n, n_s = problem.system, problem.layout.n_local, problem.layout.n_s
        comm = problem.layout.comm
        inverse = np.linalg.inv(problem.M_s)
        hand_q, hand_v = K.hand[:n_s], K.hand[n_s:]
        self.K_q, self.K_v = (float(np.linalg.norm(k.T @ inverse, 2)) for k in (hand_q, hand_v))
        self.alpha, self.beta = system.damping.alpha, system.damping.beta
        self.drag = self.alpha if system.damping.in_space else 0.0
        force = system.G @ inverse
        gain_z, gain_v = K.tall[:n], K.tall[n:]
        if system.two_way:  # the hand gives way: q_s = M_s^{-1} (u / s^2 - G'z)
            gain_z, gain_v = gain_z - force @ hand_q, gain_v - force @ hand_v
        k = min(60, problem.layout.n_e)
        omega, Phi = plant_modes(Plant(problem), k) if system.two_way else some_modes(problem, k)[:2]
        size = total(comm, np.stack([Phi.T @ gain_z, Phi.T @ gain_v, Phi.T @ force]))
        self.omega, self.modes = omega, np.linalg.norm(size, axis=2)
        static = np.empty_like(force)
        r, w = system.K_ee.createVecs()
        for j in range(n_s):
            r.array_w[:] = force[:, j]
            solver.solve(r, w)
            static[:, j] = w.array_r
        for vector in (r, w):
            vector.destroy()
        products = _inverse_mass(problem, np.hstack([gain_z, gain_v, force]))
        self.rest_z, self.rest_v, self.rest_force = (
            self._rest(total(comm, X.T @ products[:, i * n_s : (i + 1) * n_s]), self.modes[i])
            for i, X in enumerate((gain_z, gain_v, force))
        )
        moved = times_columns(system.M_ee, static)
        if system.two_way:
            moved -= force @ total(comm, system.G.T @ static)
        self.rest_static = self._rest(total(comm, static.T @ moved), self.modes[2] / omega**2)

    @staticmethod
    def _rest(gram: Array, part: Array) -> float:
        """Frobenius norm of what the modes leave over; rounding counts as left over."""
        whole = float(np.trace(gram))
        return float(np.sqrt(max(whole - float(np.sum(part**2)), 100 * EPS * whole)))

    def bound(self, r: float) -> float:
        """The bound at radius r."""
        twice = self.alpha + self.beta * self.omega**2
        gap = np.maximum(r - self.omega, 1e-9 * r)  # modes beyond r: the other bound is the smaller one
        # |s - p| |s - p'| >= (|s| - omega)^2 for a pair of complex poles
        near = np.where(twice < 2 * self.omega, r / gap**2, np.inf)
        each = np.minimum(near, 1 / twice)
        K_z, K_v, force = self.modes
        modes = float(np.sum((K_z / r + K_v) * force * each))
        # 1 / (2 delta_k) <= 1 / (beta omega_k^2) or <= 1 / alpha
        by_beta = self.rest_static / self.beta if self.beta > 0 else np.inf
        by_alpha = self.rest_force / self.alpha if self.alpha > 0 else np.inf
        rest = (self.rest_z / r + self.rest_v) * min(by_beta, by_alpha)
        return self.K_q / r**2 + self.K_v / r + (modes + rest) * (1 + self.drag / r)


def _inverse_mass(problem: RiccatiProblem, X: Array) -> Array:
    """M_ee^{-1} X, two-way (M_ee - G M_s^{-1} G')^{-1} X, local rows. Collective."""
    system, comm = problem.system, problem.layout.comm
    if not system.two_way:
        return solve_columns(system.M_ee, problem.layout, X)
    both = solve_columns(system.M_ee, problem.layout, np.hstack([X, system.G]))
    result, light = both[:, : X.shape[1]], both[:, X.shape[1] :]
    small = problem.M_s - total(comm, system.G.T @ light)
    return np.asarray(result + light @ np.linalg.solve(small, total(comm, system.G.T @ result)))
