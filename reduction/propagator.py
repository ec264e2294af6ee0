"""The midpoint rule of small models as one small matrix, w_{n+1} = P w_n + Q u_n, several steps in one product.

The implicit midpoint rule of the full model, (E - dt/2 A) x_{n+1} = (E + dt/2 A) x_n + dt (B u_n + f), in coordinates
in which the energy of the tissue is |w|^2 / 2: rounding in a step then is small against the energy, and P of a damped
model is a contraction. An undamped structured model, or its tissue beside a hand of its own, is turned into plane
rotations [HLW06] whose c^2 + s^2 = 1 to far below eps, so that the energy neither grows nor decays systematically
over any number of steps.

A conservative model is w' = S w + g with a skew S of blocks [0, -omega; omega, 0]. With c = w_1 + i w_2 the rule reads

    c_{n+1} = e^{i a} c_n + dt (g_1 + i g_2) / (1 - i omega dt / 2),   a = 2 arctan(omega dt / 2)

so that c_n = e^{i a n} (c_0 + sum_m e^{-i a m} ...): a whole run is a sum, without any matrix of the steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import MidpointSteps
from softgrasp.reduction.spectrum import NULL_TOLERANCE, balanced, energy_factor, is_skew, skew_modes
from softgrasp.reduction.system import EnergySystem, ModelError

SLOW = 0.01  # sine or cosine below which one unit in the last place of the other turns by 1e-12 of the angle
TURNS = 32  # angles whose sine and cosine are computed; the others are products of two of them


def rotation(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine whose squares add up to 1 to about 1e-18, at worst (near 45 degrees) 1e-16.

    Plain rounding leaves |c^2 + s^2 - 1| ~ 1e-16, a systematic growth of 1e-11 over 1e5 steps. Here the larger of the
    two moves by units in the last place and the smaller one follows on the circle; the angle changes by less than
    1e-12 of itself. Below :data:`SLOW` that cannot be had, and the angle stays as it is.
    """
    wide = np.longdouble  # 64 bits of mantissa or more; where it is a plain double the growth stays at rounding
    c, s = np.cos(angle), np.sin(angle)
    large, small = np.where(np.abs(c) > np.abs(s), c, s), np.where(np.abs(c) > np.abs(s), s, c)
    moves = np.array(sorted(range(-200, 201), key=abs), dtype=float)
    larges = large[:, None] + moves * np.spacing(np.abs(large))[:, None]
    squares = np.maximum(1 - larges.astype(wide) ** 2, 0)
    smalls = np.copysign(np.sqrt(squares), small[:, None]).astype(float)
    defects = np.abs(squares - smalls.astype(wide) ** 2)
    # the smallest move that does, else the best one
    best = np.where((defects < 1e-18).any(axis=1), (defects < 1e-18).argmax(axis=1), defects.argmin(axis=1))
    rows, fast = np.arange(len(c)), np.abs(small) > SLOW
    large, small = np.where(fast, larges[rows, best], large), np.where(fast, smalls[rows, best], small)
    swap = np.abs(c) > np.abs(s)
    return np.where(swap, large, small), np.where(swap, small, large)


@dataclass(frozen=True)
class StepCoordinates:
    """Coordinates w of a state, x = X w, in which the step of every pair of modes is a plane rotation."""

    X: Array  # columns of the coordinates, x = X w, (N, k)
    X_inverse: Array  # coordinates of a state, w = X_inverse x, (k, N)
    omega: Array  # angular frequencies of the pairs of modes, w[first : first + 2 m] pair by pair, (m,) [1/s]
    first: int = 0  # index in w of the first mode
    # number of constant coordinates after the modes; None where other coordinates may enter the rates of the modes
    still: int | None = None

    def fix(self, P: Array, angle: Array, often: bool) -> None:
        """Overwrite the rows of the modes in P (k, k) by plane rotations, in place.

        Args:
            angle: angle of each rotation, (m,) [rad].
            often: whether P is applied again and again: then c^2 + s^2 = 1 as :func:`rotation` makes it.
        """
        if not len(angle):
            return
        c, s = rotation(angle) if often else (np.cos(angle), np.sin(angle))
        i, end = self.first + 2 * np.arange(len(angle)), self.first + 2 * len(angle)
        if self.still is None:
            P[self.first : end, self.first : end] = 0.0
        else:
            P[: end + self.still] = 0.0
            P[end : end + self.still, end : end + self.still] = np.eye(self.still)
        P[i, i], P[i, i + 1], P[i + 1, i], P[i + 1, i + 1] = c, -s, s, c


@dataclass(frozen=True)
class Modal:
    """Steps of w = [pairs; still; free], mode by mode."""

    angle: Array  # angle of a step, one for each pair [rad], (m,)
    # matrix from p inputs and a constant 1 to dt g / (1 - i omega dt / 2), real and imaginary rows in turn, (2m, p + 1)
    load: Array
    rest: Array  # matrix from p inputs and a constant 1 to dt g of all other coordinates, (still + free, p + 1)
    # action of pairs and still ones w_m on the free ones in a step, w_f += pull (w_m,n + w_m,n+1), (free, 2 m + still)
    pull: Array

    def march(self, inputs: Array, start: Array) -> Array:
        """States w of all steps, (steps + 1, k), for inputs (steps, p) and a start (k,)."""
        steps, pairs, moved = len(inputs), 2 * len(self.angle), self.pull.shape[1]
        w = np.empty((steps + 1, len(start)))
        turn = turns(self.angle, steps)
        c = np.empty((steps + 1, pairs))
        c[0], c[1:] = start[:pairs], inputs @ self.load[:, :-1].T + self.load[:, -1]
        z = c.view(complex)
        # the rule, turned back by e^{-i a n}, only adds up
        z *= turn.conj()
        np.cumsum(z, axis=0, out=z)
        z *= turn
        w[:, :pairs] = c
        if len(start) > pairs:
            w[0, pairs:] = start[pairs:]
            w[1:, pairs:] = inputs @ self.rest[:, :-1].T + self.rest[:, -1]
            np.cumsum(w[:, pairs:moved], axis=0, out=w[:, pairs:moved])
            w[1:, moved:] += (w[1:, :moved] + w[:-1, :moved]) @ self.pull.T
            np.cumsum(w[:, moved:], axis=0, out=w[:, moved:])
        return w


def turns(angle: Array, steps: int) -> Array:
    """e^{i a n} for n = 0 .. steps, (steps + 1, m), of modulus 1 to a few roundings whatever n is."""
    coarse = np.exp(1j * np.outer(TURNS * np.arange(steps // TURNS + 1), angle))
    fine = np.exp(1j * np.outer(np.arange(TURNS), angle))
    return np.asarray((coarse[:, None] * fine).reshape(-1, len(angle))[: steps + 1])


def modal_of(at: StepCoordinates, E: Array, A: Array, loads: Array, dt: float) -> Modal | None:
    """The steps of E x' = A x + loads [u; 1] mode by mode; None where the modes do not move by themselves."""
    if at.still is None or at.first:
        return None
    pairs = 2 * len(at.omega)
    moved, k = pairs + at.still, loads.shape[1]
    rates = at.X_inverse @ np.linalg.solve(E, np.hstack([loads, A @ at.X[:, :moved]]) if moved < len(A) else loads)
    pull = dt / 2 * rates[moved:, k:]
    g = dt * (rates[:pairs:2, :k] + 1j * rates[1:pairs:2, :k]) / (1 - 0.5j * dt * at.omega)[:, None]
    load = np.stack([g.real, g.imag], axis=1).reshape(pairs, k)
    rest = dt * rates[pairs:, :k]
    return Modal(2 * np.arctan(at.omega * dt / 2), load, rest, pull if len(pull) else np.zeros((0, moved)))


@dataclass(frozen=True)
class Propagator(MidpointSteps):
    """Steps of a reduced model in energy coordinates x = X w; the matrices E and A have the columns of X.

    A conservative model also has ``modal``, which runs without a matrix of the steps.
    """

    model: EnergySystem  # system that it steps
    at: StepCoordinates  # coordinates, x = X w
    driven: bool = False  # the hand is prescribed: w has the tissue only, and the inputs are the hand's in a step
    modal: Modal | None = None  # the step mode by mode, for conservative models

    @property
    def stable(self) -> bool:
        """Whether no free motion grows: by structure where the modes are known, else by the model's eigenvalues."""
        return self.modal is not None or self.model.stable

    def march(self, inputs: Array, start: Array) -> Array:
        """States w of all steps, (steps + 1, k), for inputs (steps, m) and a start (k,)."""
        return super().march(inputs, start) if self.modal is None else self.modal.march(inputs, start)

    def exact(self, P: Array, steps: int) -> Array:
        """``P``, a computed power P^steps, with its known entries set in place: rotations, and the free hand."""
        self.at.fix(P, steps * 2 * np.arctan(self.at.omega * self.dt / 2), steps in (1, self.steps))
        if self.model.hand_first and not (self.model.two_way or self.driven):
            k = 2 * self.model.n_s
            P[:k] = 0.0
            P[:k, :k] = np.eye(k) + np.diag(np.full(self.model.n_s, steps * self.dt), self.model.n_s)
        return P


def _coordinates(model: EnergySystem, driven: bool) -> StepCoordinates:
    """Energy coordinates: of the tissue alone where the hand is driven, else of the whole state."""
    apart, k, N = model.hand_first and (driven or not model.two_way), 2 * model.n_s, model.N
    whole = None if apart or not model.structured else _whole(model)
    if whole is not None:
        return whole
    tissue = _tissue(model, apart) if model.hand_first else None
    if driven and tissue is not None:
        return tissue
    X, X_inverse = np.eye(N), np.eye(N)
    if tissue is None:
        return StepCoordinates(X, X_inverse, np.zeros(0))
    X[k:, k:], X_inverse[k:, k:] = tissue.X, tissue.X_inverse
    return StepCoordinates(X, X_inverse, tissue.omega, k)


def _tissue(model: EnergySystem, apart: bool) -> StepCoordinates:
    """Coordinates of the tissue beside the hand's own; ``apart`` if no hand moves with it, so that it has modes."""
    block = slice(2 * model.n_s, model.N)
    E, A, L = model.E[block, block], model.A[block, block], energy_factor(model.H_tissue[block, block])
    if L is None:
        return StepCoordinates(np.eye(len(A)), np.eye(len(A)), np.zeros(0))
    U, omega = np.eye(len(L)), np.zeros(0)
    still = None
    if model.structured and apart:
        S = balanced(E, A, L)
        if is_skew(S):
            U, omega = skew_modes((S - S.T) / 2)
            still = len(L) - 2 * len(omega)
    return StepCoordinates(np.linalg.solve(L.T, U), U.T @ L.T, omega, 0, still)


def _whole(model: EnergySystem) -> StepCoordinates | None:
    """Coordinates w = [modes; still; free] of a conservative model with its hand inside, H = |modes, still|^2 / 2.

    H is semidefinite: displacements of the free hand have no energy. With H = y'y / 2, y = R x and y' = R E^-1 A R^+ y,
    a skew matrix, whose null vectors are constant (a hand that coasts). The null space of H is moved but moves nothing.
    None when the numbers do not have the structure.
    """
    H = model.H
    D = np.sqrt(np.abs(np.diag(H)))
    D = np.where(D > 0, D, 1.0)
    values, V = np.linalg.eigh(H / np.outer(D, D))
    keep = values > NULL_TOLERANCE * values.max(initial=0.0)
    root, V_r, V_0 = np.sqrt(values[keep]), V[:, keep], V[:, ~keep]
    R, R_plus = root[:, None] * V_r.T * D, V_r / D[:, None] / root
    # A = R'R of a canonical model: A R^+ = R', without the rounding of A over a small root
    S = R @ np.linalg.solve(model.E, R.T if np.array_equal(model.A, H) else model.A @ R_plus)
    if not is_skew(S):
        return None
    U, omega = skew_modes((S - S.T) / 2)
    X, X_inverse = np.hstack([R_plus @ U, V_0 / D[:, None]]), np.vstack([U.T @ R, V_0.T * D])
    return StepCoordinates(X, X_inverse, omega, 0, len(root) - 2 * len(omega))


def propagator(model: EnergySystem, dt: float, driven: bool = False) -> Propagator:
    """Precompute a step of size dt. Online; not collective.

    Args:
        dt: step [s].
        driven: the hand follows a table instead of a force; needs fixed solid modes. The inputs of a step are then
            [mean q_s, mean v_s, mean a_s].

    Raises:
        ModelError: E or the midpoint matrix is singular, or ``driven`` without fixed solid modes.
    """
    k = 2 * model.n_s
    if driven and not model.hand_first:
        raise ModelError("the hand is inside the basis, so it cannot be prescribed; give a force", model.name)
    model.check_independent()
    at, tissue = _coordinates(model, driven), slice(k, model.N)
    E, A, n_s = model.E, model.A, model.n_s
    if driven:
        # E_yq q_s' with q_s' = mean v_s, E_yv v_s' with v_s' = mean a_s
        inputs = np.hstack([A[tissue, :n_s], A[tissue, n_s:k] - E[tissue, :n_s], -E[tissue, n_s:k]])
        f, E, A = model.f[tissue], E[tissue, tissue], A[tissue, tissue]
    else:
        inputs, f = model.B, model.f
    loads = np.hstack([inputs, f[:, None]])
    modal = modal_of(at, E, A, loads, dt)
    step = Propagator(dt, E @ at.X, A @ at.X, loads, model, at, driven, modal)
    if modal is None:
        try:
            _ = step.block  # needed by every run, and its matrix may be refused
        except SolverError as error:
            raise ModelError(str(error), model.name) from error
    return step
