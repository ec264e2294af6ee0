"""The midpoint step in the frame of a hand that turns by any angle.

With y = z' + Omega x z on the nodes, the velocity beside that of the rigid motion, and the momentum pi = M y,

    pi' + Omega x pi + f(z) + D z' = -G [A - g; Omega'] - S : (Omega x)^2 =: l,        z' = y - Omega x z,

so that with s = 2/dt, w = z_mid - z_n and the mean turning O = (Omega x) / s of the step

    R(w) = f_alg(z_n, w) + s D w + s^2 M [w + O (2 w + z_n) + O^2 (w + z_n)] - s pi_n - l = 0
    s pi_{n+1} = 2 s^2 M (w + O (z_n + w)) - s pi_n

The mass matrix of the nodes commutes with O, which turns all nodes alike: its products serve all these terms. What the
factor S = K + s D + s^2 M (at finite strain its tangent) lacks, s^2 M (2 O + O^2), is small, dt |Omega| of s^2 M, and
is iterated on until |R| is below the tolerance of the step; S is not factored again as Omega changes. Since y'M O y = 0
the turning does no work: W + y'M y / 2 changes by the work of l, of the damping and of the hand that turns the tissue,

    2 w'l - 2 s w'D w + dt (O s z_mid)'(l - f_alg - s D w),        up to 2 w'R.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.frame.balance import HandBalance, HandPlace, Travel
from softgrasp.fem.frame.integrals import Sums, crossed, row_length, square
from softgrasp.fem.frame.rotation import cross_matrix, spatial
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.finite_strain import FiniteStrainMidpoint
from softgrasp.fem.run.frame.law import FixedPoint, LinearBody
from softgrasp.fem.run.midpoint import Feedback, TissueState
from softgrasp.fem.solve.guess import extrapolated
from softgrasp.fem.strain.newton import Pairs, Root

LINEAR_TOL = 1e-12  # of a step at small strain, over the largest load: what a factor leaves of a solve


class Turn(ABC):
    """The hand in a step, as the tissue feels it."""

    spin: Array  # mean angular velocity in the hand's axes, in space, (3,) [rad/s]

    @abstractmethod
    def load(self, step: TurningStep, w: Array, inertia: Array) -> Array:
        """Load l on the rows here [N] for a trial w and s^2 M w, and ``spin`` with it. Collective."""


class GivenTurn(Turn):
    """A hand that is known before the step: the load does not depend on the tissue."""

    def __init__(self, spin: Array, load: Array) -> None:
        self.spin, self.known = spin, load

    def load(self, step: TurningStep, w: Array, inertia: Array) -> Array:
        """The load that is known."""
        return self.known


class FreeTurn(Turn):
    """A hand that feels the tissue: its velocity follows from the momenta of both, for every trial of the step."""

    def __init__(self, balance: HandBalance, hand: HandPlace, sums: Sums, force: Array, guess: Array) -> None:
        self.balance, self.hand, self.sums, self.force, self.xi = balance, hand, sums, force, guess
        self.spin = guess[3:]

    def load(self, step: TurningStep, w: Array, inertia: Array) -> Array:
        """The load of the hand that balances the momenta for this w. Collective."""
        travel = step.travel(w, inertia)
        self.xi = self.balance.velocity(self.hand, self.sums, travel, self.force, self.xi)
        self.spin = self.xi[3:]
        fall = (np.eye(3) - self.balance.dt / 2 * cross_matrix(self.spin)) @ self.hand.Q.T @ self.balance.g
        return step.inertia_load(self.xi, (2 / self.balance.dt) * (self.xi - self.hand.xi), fall)


class TurningStep(FiniteStrainMidpoint):
    """The step for a system with frame integrals and a law at finite strain.

    Attributes:
        spin: angular velocity of the hand in its own axes at the end of the step, in space, (3,) [rad/s].
        beside: y = z' + Omega x z on the rows here [m/s].
    """

    spin: Array
    beside: Array
    turn: Turn

    def _prepare(self) -> None:
        """Moments beside what finite strain needs. Collective."""
        super()._prepare()
        frame, self.d = self.system.frame, self.system.layout.dimension
        assert frame is not None
        self.moments = self.hold(frame.moments(self.system.materials))
        self.at = self.w.duplicate()
        self.spin, self.beside = np.zeros(3), np.zeros_like(self.w_array)
        self.middle, self.held_inertia = np.zeros_like(self.w_array), np.zeros_like(self.w_array)
        self.turn, self.done = GivenTurn(np.zeros(3), np.zeros_like(self.w_array)), 0.0

    def _small(self, spin: Array) -> Array:
        """The matrix of Omega x in the plane or in space."""
        return cross_matrix(spin)[: self.d, : self.d]

    def _nodewise(self, H: Array, x: Array) -> Array:
        """H times each node of x."""
        return np.asarray((x.reshape(-1, self.d) @ H.T).ravel())

    def _sum(self, numbers: Array) -> Array:
        return numbers if self.operators.whole else total(self.comm, numbers)

    # ---- the state

    def _set_momentum(self, state: TissueState) -> None:
        """Set r = s M y, and low to zero. Collective."""
        self.low.array_w[:] = 0.0  # PETSc does not see that C code writes into it
        self.adopt(state)
        y, x = state.z.duplicate(), state.z.duplicate()
        x.array_w[:] = self._lifted(state)
        self.system.M_ee.mult(x, y)
        self.r.array_w[:] = self.s * self.operators.gather(y.array_r)
        self.c = self.pending = np.zeros_like(self.c)
        for vector in (x, y):
            vector.destroy()

    def _lifted(self, state: TissueState) -> Array:
        """The y = z' + Omega x z of a state, (n_local,) [m/s]."""
        n = self.system.layout.n_local
        return np.asarray(state.array[n:] + self._nodewise(self._small(self.spin), state.array[:n]))

    def adopt(self, state: TissueState) -> None:
        """Continue from a state whose r and ``spin`` are set. Collective."""
        super().adopt(state)
        self.beside = np.array(self.operators.gather(self._lifted(state)))

    def energy(self, state: TissueState) -> float:
        """Energy W(z) + y'M y / 2 [J] of the state just reached. Collective."""
        W = self.over_ranks(self.body.energy(self._held_z(state)))
        return W + self.over_ranks(float(np.dot(self.beside, self.r_array))) / (2 * self.s)

    def pull(self) -> Array:
        """This rank's share of the momenta of the state just reached, and of the work of the step [J]."""
        z, momentum, d = self.at.array_r, self.r_array / self.s, self.d
        n_s = self.G.shape[1]
        parts = [
            self.G.T @ self.beside, self.G[:, :d].T @ z, self.moments.T @ z,
            crossed(z, momentum, d)[2 if d == 2 else 0 :], [self.done],
        ]  # fmt: skip
        row = np.concatenate(parts)
        assert len(row) == row_length(n_s) + 1
        return row

    def work(self, loads: Array, pulls: Array) -> float:
        """Work of load and hand in all of these steps, over the rows here [J]."""
        return float(self.works(loads, pulls).sum())

    def works(self, loads: Array, pulls: Array) -> Array:
        """Work of load and hand in each step, over the rows here, (steps,) [J]."""
        return pulls[:, -1]

    def sums(self) -> Sums:
        """What the tissue contributes to the momenta in the state just reached. Collective."""
        return Sums.of(self._sum(self.pull()), self.G.shape[1])

    def restart_arrays(self) -> dict[str, Array]:
        """As at finite strain, with y in one more row."""
        arrays = super().restart_arrays()
        y = self.operators.leave(self.beside)[None]
        return arrays | {"solver_rows": np.vstack([arrays["solver_rows"], y])}

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what :meth:`restart_arrays` returned, after :meth:`adopt`. Collective."""
        if rows is not None:
            super().restore(rows[:-1], numbers)
            self.beside = np.array(self.operators.enter(rows[-1]))

    # ---- a step

    def travel(self, w: Array, inertia: Array) -> Travel:
        """What the tissue does in a step of w, with s^2 M w. Collective."""
        d, s, n_s = self.d, self.s, self.G.shape[1]
        end = self.at.array_r + 2 * w
        turning = crossed(end, (2 * inertia - self.r_array) / s, d)
        C = end.reshape(-1, d).T @ (self.held_inertia + inertia).reshape(-1, d) / s**2
        numbers = self._sum(np.concatenate([self.G.T @ w, self.moments.T @ w, turning, C.ravel()]))
        work, B, turning, products = np.split(numbers, np.cumsum([n_s, d * d, 3]))
        return Travel(spatial(work), square(B, d), turning, square(products, d))

    def inertia_load(self, xi: Array, rate: Array, fall: Array) -> Array:
        """Load l of a mean velocity xi and its mean rate under free fall, in the hand's axes, on the rows here [N]."""
        d = self.d
        spin = cross_matrix(xi[3:])
        felt = rate.copy()
        felt[:3] += spin @ xi[:3] - fall
        turn = felt[5:] if d == 2 else felt[3:]
        return self.frame_load(np.concatenate([felt[:d], turn]), (spin @ spin)[:d, :d])

    def frame_load(self, acceleration: Array, squared: Array) -> Array:
        """-G [A - g; Omega'] - S : (Omega x)^2 on the rows here [N]."""
        return np.asarray(-(self.G @ acceleration) - self.moments @ squared.ravel())

    def go(self, turn: Turn, feedback: Feedback | None = None) -> None:
        """Solve the step under a turning hand. Collective.

        Args:
            feedback: about how the load of a free hand depends on w, for the corrections; it changes no solution.

        Raises SolverError: no convergence.
        """
        self.turn, self.feedback, self.jump, counts = turn, feedback, None, self.counts
        self.inertia.mult(self.at, self.y)
        self.held_inertia = np.array(self.y_array)
        guess = extrapolated(self.past, self.dot) if self.past else np.zeros_like(self.w_array)
        if counts.first >= 0 and counts.iterations_since_factor >= self.refactor_cost:
            self._renew_about(guess)
        self._residual(guess)
        right = self.r_array + self.load
        counts.scale = max(counts.scale, math.sqrt(self.dot(right, right)))
        root = self._find(guess)
        if root.iterations < 0:
            raise SolverError(
                f"the step does not converge, with |R| at {root.norm / max(counts.scale, 1e-300):.1e} of the loads and "
                f"a turn of {self.dt * float(np.linalg.norm(turn.spin)):.2g} rad; use more time.steps"
            )
        self.trial_array[:] = root.x
        self.trial.stateIncrease()
        self.inertia.mult(self.trial, self.y)
        self.load = turn.load(self, root.x, self.y_array)  # of the root itself
        self.w.array_w[:], self.middle = root.x, self.at.array_r + root.x
        counts.first = root.iterations if counts.first < 0 else counts.first
        counts.iterations_since_factor += max(root.iterations - counts.first, 0)
        counts.iterations, counts.steps = counts.iterations + root.iterations, counts.steps + 1
        counts.most = max(counts.most, root.iterations)

    def _residual(self, w: Array) -> tuple[Array, float]:
        """R(w) and its norm, infinite where the law has no stress. Collective."""
        self.trial.stateIncrease()
        self.trial_array[:] = w
        if not self._all(self.body.step(self.begin, self.trial, self.f)):
            return w, np.inf
        self.inertia.mult(self.trial, self.y)
        moved, held = self.y_array, self.held_inertia
        self.load = self.turn.load(self, w, moved)
        W = self._small(self.turn.spin) / self.s
        R: Array = self.f_array - self.r_array - self.load + moved
        R += self._nodewise(W, 2 * moved + held) + self._nodewise(W @ W, moved + held)
        if self.drag is not None:
            self.drag.mult(self.trial, self.y)
            R += self.y_array
        return R, math.sqrt(self.dot(R, R))

    # ---- the end of a step

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write z_{n+1} and z'_{n+1} of a hand that turns with ``spin`` into ``new``, and carry on. Collective."""
        W = self._small(self.turn.spin)
        self.beside = 2 * (self.s * self.w_array + self._nodewise(W, self.middle)) - self.beside
        super().advance(old, new)
        n = self.system.layout.n_local
        new.v.array_w[:] = self.beside[self.rows] - self._nodewise(self._small(self.spin), new.array[:n])

    def _add_momentum(self) -> None:
        """S pi -> 2 s^2 M (w + O z_mid) - s pi, and the works of load, frame and drag. Collective."""
        W, w = self._small(self.turn.spin) / self.s, self.w_array
        turned = self._nodewise(W, self.middle)
        self.trial_array[:] = w + turned
        self.trial.stateIncrease()
        self.inertia.mult(self.trial, self.y)
        felt = self.y_array - self.r_array + self._nodewise(W, self.y_array)
        self.done = 2 * float(np.dot(w, self.load) + np.dot(turned, felt))
        self.r.axpby(2.0, -1.0, self.y)
        if self.drag is not None:
            self.drag.mult(self.w, self.y)
            self.dissipated += 2 * float(np.dot(w, self.y_array))


class LinearTurningStep(TurningStep):
    """The step for the linear law, of small strain in a frame of any rotation, with one factor for the run."""

    body: Any

    def _make_body(self) -> tuple[Any, float]:
        return LinearBody(self.K2, self.dot), LINEAR_TOL

    def _make_iteration(self, pairs: Pairs) -> Any:
        return FixedPoint(self._residual, self._apply, pairs)

    def _refactor_cost(self) -> float:
        return math.inf

    def _renew(self, z: Array) -> bool:
        """There is one factor."""
        return False

    def _find(self, guess: Array, balanced: bool = True) -> Root:
        target = max(self.tol * self.counts.scale, 8 * self.body.rounding)
        root: Root = self.newton.find(guess, target)
        self.last = root.norm / self.counts.scale if self.counts.scale > 0 else 0.0
        return root
