"""How far a sampled loop is from instability: frequency response and margins, one input at a time.

The plant between two ticks of length h with a held load is x_{k+1} = A_d x_k + B_d u_k, the feedback breaks open at u:

    L(z) = -K (z I - A_d)^{-1} B_d z^{-delay},  z = exp(i w h),  S = (I + L)^{-1}.

With all inputs but the i-th closed the loop seen there is l_i = 1 / S_ii - 1; its gain may grow or shrink by the gain
margins and its phase lag by the phase margin before the loop loses stability. The smallest singular value a of I + L
bounds what all inputs withstand at once: every gain in [1/(1+a), 1/(1-a)], every phase within 2 arcsin(a/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.shown import Card, Shown, drawn
from softgrasp.lqr.loop.controller import Controller

POINTS = 4000  # frequencies, spaced evenly in log w: 0.3 % apart over five decades
NEAR = 60  # more around each resonance, where the phase turns at once


@dataclass(frozen=True, repr=False)
class AxisMargins(Shown):
    """Margins of the loop seen at one input; nan where it has no such crossing."""

    name: str  # label of the input, with unit
    gain_up: float  # upper gain margin, factor > 1; inf without a limit
    gain_down: float  # lower gain margin, factor < 1; 0 without a limit
    phase: float  # phase margin [deg]
    crossover: float  # frequency of the phase margin [rad/s]
    delay: float  # delay margin [s]


@dataclass(frozen=True, repr=False)
class LoopMargins(Shown):
    """Frequency response of a loop and its margins."""

    omega: Array  # frequencies up to the Nyquist frequency of the ticks [rad/s], (F,)
    response: np.ndarray  # frequency response l_i of the loop at each input, (F, n_s)
    axes: tuple[AxisMargins, ...]  # margins at each input, n_s
    distance: float  # smallest singular value of I + L over all frequencies, at most 1 of use

    def card(self) -> Card:
        """Gain, phase and delay that each input withstands, and all at once."""
        low, high, phase = self.together
        rows = [
            (a.name, f"gain {a.gain_down:.3g} to {a.gain_up:.3g}, phase {a.phase:.3g} deg, delay {a.delay:.3g} s")
            for a in self.axes
        ]
        return Card("LoopMargins", (*rows, ("all at once", f"gain {low:.3g} to {high:.3g}, phase {phase:.3g} deg")))

    def plot(self) -> Any:
        """Gain and phase of the loop at each input, as ``matplotlib`` figure."""
        return drawn("loop_bode", self)

    @property
    def together(self) -> tuple[float, float, float]:
        """Gains [low, high] and phase [deg] that all inputs withstand at once."""
        a = min(self.distance, 1.0)
        return 1 / (1 + a), 1 / (1 - a) if a < 1 else np.inf, float(np.degrees(2 * np.arcsin(a / 2)))


def sampled(plant: ReducedSystem, period: float) -> tuple[Array, Array]:
    """A_d (N, N) and B_d (N, n_s) of the plant under a load that is held for a period [s]."""
    N, m = plant.B.shape
    solved = np.linalg.solve(plant.E, np.hstack([plant.A, plant.B]))
    whole = scipy.linalg.expm(period * np.vstack([solved, np.zeros((m, N + m))]))
    return whole[:N, :N], whole[:N, N:]


def loop_margins(controller: Controller, delay: int = 0) -> LoopMargins:
    """Margins of a controller with the plant that it was made for. Not collective.

    Args:
        controller: gain, plant and period; its limits are left out.
        delay: ticks between a sample and its load.
    """
    plant, h, K = controller.plant, controller.period, controller.K
    A, B = sampled(plant, h)
    poles = np.concatenate([scipy.linalg.eigvals(M, plant.E) for M in (plant.A, plant.under(K).A)])
    omega = _grid(poles, np.pi / h)
    z = np.exp(1j * omega * h)[:, None, None]
    L = -K @ np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(B, (len(omega), *B.shape))) / z**delay
    returned = np.eye(len(K)) + L
    response = 1 / np.einsum("fii->fi", np.linalg.inv(returned)) - 1
    axes = tuple(_axis(name, omega, response[:, i]) for i, name in enumerate(plant.inputs))
    return LoopMargins(omega, response, axes, float(np.linalg.svd(returned, compute_uv=False)[:, -1].min()))


def _grid(poles: np.ndarray, highest: float) -> Array:
    """Frequencies up to the highest: even in log w, and denser by each resonance, down to its width."""
    sizes = np.abs(poles)
    slowest = float(sizes[sizes > 1e-6 * sizes.max()].min())
    grid = [np.geomspace(min(1e-2 * slowest, 1e-3 * highest), highest, POINTS)]
    for pole in poles[(poles.imag > 0) & (poles.imag < highest)]:
        width = max(abs(pole.real), 1e-9 * pole.imag)
        near = np.geomspace(1e-2 * width, pole.imag / 2, NEAR)
        grid += [pole.imag + near, pole.imag - near]
    omega = np.unique(np.concatenate(grid))
    return np.asarray(omega[(omega > 0) & (omega <= highest)])


def _axis(name: str, omega: Array, loop: np.ndarray) -> AxisMargins:
    """Margins from the crossings of |l| = 1 and of arg l = -180 degrees, interpolated in log w."""
    gain, phase, log_w = np.log(np.abs(loop)), np.unwrap(np.angle(-loop)), np.log(omega)  # phase 0: l is negative
    # at the highest frequency, z = -1, the loop is real: a crossing if it is negative
    factors = [float(1 / abs(loop[-1]))] if loop[-1].real < 0 else []
    turns = np.floor((phase + np.pi) / (2 * np.pi))  # of the nearest multiple of 360 degrees
    rest = phase - 2 * np.pi * turns
    for i in np.flatnonzero((rest[:-1] * rest[1:] <= 0) & (np.abs(np.diff(rest)) < np.pi)):
        share = rest[i] / (rest[i] - rest[i + 1]) if rest[i] != rest[i + 1] else 0.0
        factors.append(float(np.exp(-(gain[i] + share * (gain[i + 1] - gain[i])))))
    up, down = min([f for f in factors if f > 1], default=np.inf), max([f for f in factors if f < 1], default=0.0)
    best, crossover, delay = np.nan, np.nan, np.inf
    for i in np.flatnonzero(gain[:-1] * gain[1:] < 0):
        share = gain[i] / (gain[i] - gain[i + 1])
        w = float(np.exp(log_w[i] + share * (log_w[i + 1] - log_w[i])))
        lag = float(phase[i] + share * (phase[i + 1] - phase[i])) % (2 * np.pi)
        margin = float(np.degrees(min(lag, 2 * np.pi - lag)))
        delay = min(delay, lag / w)
        if not margin >= best:
            best, crossover = margin, w
    return AxisMargins(name, up, down, best, crossover, float(delay))
