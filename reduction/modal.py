"""Conservative small models mode by mode: the midpoint rule turns every pair of coordinates by one angle.

In coordinates w where the energy is |w|^2 / 2 a conservative model is w' = S w + g with a skew S, and S has blocks
[0, -omega; omega, 0]. With c = w_1 + i w_2 the midpoint rule reads

    c_{n+1} = e^{i a} c_n + dt (g_1 + i g_2) / (1 - i omega dt / 2),   a = 2 arctan(omega dt / 2)

so that c_n = e^{i a n} (c_0 + sum_m e^{-i a m} ...): a whole run is a sum, without any matrix of the steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array

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
    """x = X w, with what is known of a step in w."""

    X: Array  # X, X_inverse: x = X w and w = X_inverse x
    X_inverse: Array
    omega: Array  # frequencies of the pairs of modes that follow each other from ``first`` on
    first: int = 0  # number of the first mode
    # number of coordinates after the modes that nothing moves; the modes then move each other alone. None when other
    # coordinates may move the modes.
    still: int | None = None

    def fix(self, P: Array, angle: Array, often: bool) -> None:
        """Overwrite the modes by plane rotations, well rounded ones if applied again and again."""
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

    angle: Array  # of a step, one a pair (m,)
    # of the inputs and of a constant 1 to dt g / (1 - i omega dt / 2), real and imaginary rows by turns, (2 m, i + 1)
    # for i inputs
    load: Array
    rest: Array  # the same to dt g of all other coordinates, (still + free, i + 1)
    # what pairs and still ones do to the free ones in a step, w_f += pull (w_n + w_{n+1}), (free, 2 m + still)
    pull: Array

    def march(self, inputs: Array, start: Array) -> Array:
        """States w of all steps, (steps + 1, k), for inputs (steps, i) and a start (k,)."""
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
