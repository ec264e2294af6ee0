"""Runs of a reduced model of tissue at finite strain: Broyden's method on an inverse kept from step to step.

    S w + f_alg(a_n, w) = h,   h = s v_n + l_n,   S = s^2 I + s D,   s = 2 / dt
    a_{n+1} = a_n + 2 w,   v_{n+1} = 2 s w - v_n

solved by Broyden's method [Broyden65] on a k x k inverse, with the discrete gradient f_alg, 2 w' f_alg =
W_r(a_{n+1}) - W_r(a_n), so that |v|^2 / 2 + W_r changes by the work 2 w'l less the loss 2 s w'D w, to the tolerance of
the solve. `stepper.c` runs all steps; without a compiler NumPy runs the same steps, about thirty times slower, and
warns.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.compiled import library
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import LAWS
from softgrasp.reduction.strain.cells import Potential

SOURCE = Path(__file__).with_name("stepper.c")
DECLARATION = """int softgrasp_march(int law, int d, int k, int p, const double *B, const double *weight,
  const double *lam, const double *mu, const double *S, double s, const double *load, int steps, double tol,
  double rounding, double *J, double *A, double *V, double *past, long *counts);"""
MOST, HALVINGS, RENEWALS = 15, 10, 3  # iterations before a fresh tangent, halvings of a correction, fresh tangents
GROWTH = 4.0  # of the residual, above which a correction is refused


@dataclass(frozen=True)
class StrainProblem:
    """One reduced model at one parameter and one step."""

    potential: Potential  # W_r and its discrete gradient
    D: Array  # damping, (k, k) [1/s]
    K: Array  # tangent at rest, (k, k) [1/s^2]: the first inverse is (S + K)^-1
    dt: float  # step [s]

    @property
    def S(self) -> Array:
        """s^2 I + s D."""
        s = 2 / self.dt
        return np.asarray(s * s * np.eye(len(self.K)) + s * self.D)


@dataclass(frozen=True)
class March:
    """What a run of the stepper returns."""

    a: Array  # coordinates, (steps + 1, k)
    v: Array  # rates of the coordinates, (steps + 1, k) [1/s]
    evaluations: float  # mean number of evaluations of the force in a step
    restarts: int  # fresh tangents
    engine: str  # "C" or "NumPy"


def march_strain(problem: StrainProblem, load: Array, a0: Array, v0: Array, tol: float, engine: str = "") -> March:
    """All steps from a0, v0 (k,) under loads l (steps, k) at their midpoints. Collective if the potential is.

    Args:
        tol: |residual| over the largest |h| seen; rounding of the force is enough in any case.
        engine: "C" or "NumPy"; empty: C where there is a compiler, NumPy with a warning where not.

    Raises:
        SolverError: a step did not converge; names step, time, cell and law.
    """
    steps, k = load.shape
    A, V = np.zeros((steps + 1, k)), np.zeros((steps + 1, k))
    A[0], V[0] = a0, v0
    library, J = _chosen(problem, engine), np.linalg.inv(problem.S + problem.K)
    if library is not None:
        failed, counts = _march_c(library, problem, problem.S, load, tol, J, A, V, np.zeros(2 * k + 1))
    else:
        failed, counts = _March(problem, tol, J).run(load, A, V)
    if failed:
        raise SolverError(_sentence(problem, failed - 1, counts[2]))
    return March(A, V, counts[0] / max(steps, 1), counts[1], "NumPy" if library is None else "C")


class StepSolver:
    """Single steps S w + f_alg(a, w) = h whose S changes, with all that the next one starts from.

    Attributes:
        engine: "C" or "NumPy".
        evaluations: of the force so far.
        restarts: fresh tangents so far.
    """

    def __init__(self, problem: StrainProblem, tol: float, engine: str = "") -> None:
        self.problem, self.tol, self.library = problem, tol, _chosen(problem, engine)
        self.engine = "NumPy" if self.library is None else "C"
        self.J, k = np.linalg.inv(problem.S + problem.K), len(problem.K)
        self.past, self.steps, self.evaluations, self.restarts = np.zeros(2 * k + 1), 0, 0, 0
        self._numpy = _March(problem, tol, self.J)

    def solve(self, a: Array, S: Array, h: Array) -> Array:
        """The w of a step from a (k,), S (k, k) and h (k,). Collective if the potential is.

        Raises SolverError: no convergence; names step, time, cell and law.
        """
        k, past = len(a), self.past
        if self.library is not None:
            A, V = np.vstack([a, np.zeros(k)]), np.zeros((2, k))
            failed, counts = _march_c(self.library, self.problem, S, h[None], self.tol, self.J, A, V, past)
            self.evaluations, self.restarts = self.evaluations + counts[0], self.restarts + counts[1]
        else:
            march = self._numpy
            march.potential.begin(a)
            march.S, march.h = S, h
            w = march.solve(2 * past[1 : k + 1] - past[k + 1 :])
            failed, counts = w is None, march.counts
            self.evaluations, self.restarts = counts[:2]
            if w is not None:
                past[1:] = np.concatenate([w, past[1 : k + 1]])
        if failed:
            raise SolverError(_sentence(self.problem, self.steps, counts[2]))
        self.steps += 1
        return past[1 : k + 1].copy()


def _chosen(problem: StrainProblem, engine: str) -> Any:
    """The compiled stepper, or None for NumPy. Raises SolverError: it is asked for and not available."""
    library = None if engine == "NumPy" or problem.potential.comm is not None else compiled()
    if engine == "C" and library is None:
        raise SolverError("the compiled stepper is not available here; leave the engine out")
    return library


def _sentence(problem: StrainProblem, step: int, point: int) -> str:
    cells = problem.potential.cells
    where = ""
    if 0 <= point < len(cells.weight):
        place = ", ".join(f"{x:.3g}" for x in cells.centre[point])
        where = f"; the last trial with J <= 0 was in the cell at ({place})"
    return (
        f"the reduced model ({cells.law}) did not converge in step {step} (t = {step * problem.dt:.4g} s){where}; "
        "use a smaller step, a stiffer material or a slower motion"
    )


def _march_c(
    library: Any, problem: StrainProblem, S: Array, load: Array, tol: float, J: Array, A: Array, V: Array, past: Array
) -> Any:
    ffi, lib = library
    potential = problem.potential
    counts = ffi.new("long[3]")

    def pointer(x: Array) -> Any:
        return ffi.cast("double *", x.ctypes.data)

    arrays = [*potential.packed, np.ascontiguousarray(S)]
    load = np.ascontiguousarray(load)
    failed = lib.softgrasp_march(
        list(LAWS).index(potential.cells.law), potential.d, load.shape[1], len(potential.packed[1]),
        *map(pointer, arrays), 2 / problem.dt, pointer(load), len(load), tol, potential.rounding, pointer(J),
        pointer(A), pointer(V), pointer(past), counts,
    )  # fmt: skip
    if failed < 0:
        raise MemoryError("the reduced run does not fit into memory")
    return failed, list(counts)


class _March:
    """The steps of `stepper.c` in NumPy, line by line."""

    def __init__(self, problem: StrainProblem, tol: float, J: Array) -> None:
        self.potential, self.S, self.s, self.tol, self.J = problem.potential, problem.S, 2 / problem.dt, tol, J
        self.h = np.zeros(len(J))
        self.scale, self.rounding, self.counts = 0.0, problem.potential.rounding, [0, 0, -1]

    def run(self, load: Array, A: Array, V: Array) -> tuple[int, list[int]]:
        old = older = np.zeros(len(self.J))
        for n, now in enumerate(load):
            self.potential.begin(A[n])
            self.h = self.s * V[n] + now
            w = self.solve(2 * old - older)
            if w is None:
                return n + 1, self.counts
            A[n + 1], V[n + 1] = A[n] + 2 * w, 2 * self.s * w - V[n]
            old, older = w, old
        return 0, self.counts

    def _residual(self, w: Array) -> Array | None:
        self.counts[0] += 1
        f, bad = self.potential.discrete(w)
        if f is None:
            self.counts[2] = bad
            return None
        return np.asarray(self.S @ w + f - self.h)

    def solve(self, w: Array) -> Array | None:
        """The w of one step from a guess; None without convergence."""
        R = self._residual(w)
        if R is None:
            w = np.zeros_like(w)
            R = self._residual(w)
            if R is None:
                return None
        size, h = np.linalg.norm(R), np.linalg.norm(self.h)
        self.scale = max(self.scale, h if self.scale > 0 else max(h, size))  # at rest h is zero
        iteration, renewed = 0, 0
        while not size <= max(self.tol * self.scale, self.rounding):
            iteration += 1
            correction = None if iteration % MOST == 0 else self._correct(w, R, -(self.J @ R), renewed > 0)
            if correction is None:
                if renewed == RENEWALS or not self._renew(w, R):
                    return None
                renewed += 1
                self.counts[1] += 1
                continue
            p, rest = correction
            J_y, y = self.J @ (rest - R), p @ self.J
            den = p @ J_y
            if abs(den) > 0.1 * (p @ p):
                self.J += np.outer((p - J_y) / den, y)
            w, R, size = w + p, rest, np.linalg.norm(rest)
        return w

    def _correct(self, w: Array, R: Array, p: Array, halve: bool) -> tuple[Array, Array] | None:
        """The accepted correction, and the residual after it; an old inverse is renewed before any is halved."""
        for _ in range(HALVINGS if halve else 1):
            rest = self._residual(w + p)
            if rest is not None and np.linalg.norm(rest) < GROWTH * np.linalg.norm(R):
                return p, rest
            p = p / 2
        return None

    def _renew(self, w: Array, R: Array) -> bool:
        """Inverse of the tangent at w by differences of the residual."""
        step = 1e-7 * (np.linalg.norm(w) + 1e-3)
        columns = [self._residual(w + step * e) for e in np.eye(len(w))]
        good = [c for c in columns if c is not None]
        if len(good) < len(columns):
            return False
        self.J = np.linalg.inv((np.array(good).T - R[:, None]) / step)
        return True


def compiled() -> Any:
    """(ffi, library) of `stepper.c`, or None with a warning where it cannot be compiled."""
    return library(SOURCE, DECLARATION, "reduced runs at finite strain step in NumPy, about thirty times slower")
