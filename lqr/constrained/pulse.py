"""What the reduced tissue leaves out, bounded exactly: the l1 norm of its answer to accelerations held on a grid.

Full and reduced tissue hear the same a, held over Delta, so that the error of node j is

    e_j(t_n + s) = sum_k w_jk(s) a_{n-k},    |e_j| <= sum_k |w_jk(s)| a_max,

which the sequence a_{n-k} = a_max sign w_jk(s) attains. The pulse responses w are sums of exponentials of full minus
reduced modes, in closed form; what is beyond the known modes of a large plant is run, see
:mod:`softgrasp.lqr.constrained.rest`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.rest import Rest
from softgrasp.lqr.constrained.tissue import ModalTissue, poles
from softgrasp.lqr.plant.checks import ControlError

FORGOTTEN = 1e-13  # of an amplitude: what older pulses leave is bounded by a geometric sum
MOST_PULSES = 100_000  # memory of a tissue that hardly decays
FINE = 256  # instants of an interval where error and acceleration are bounded; what is between them is a percent


@dataclass(frozen=True)
class PulseError:
    """Full minus reduced tissue under accelerations that are held over intervals of length ``grid``."""

    full: ModalTissue  # all modes
    reduced: ModalTissue  # the plant of the plan
    grid: float  # length of an interval Delta [s]
    rest: Rest | None = None  # what modes beyond the known ones answer, where ``full`` has not all

    @cached_property
    def _sides(self) -> tuple[tuple[ModalTissue, NDArray[np.int64], float], ...]:
        """Both tissues with the modes of each that the other one has not, and their signs."""
        same = self.reduced.same
        assert same is not None
        known = np.arange(len(self.full.omega))[: self.full.lowest]
        return (
            (self.full, np.setdiff1d(known, same), 1.0),
            (self.reduced, np.flatnonzero(same < 0), -1.0),
        )

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray, Array, Array]:
        """Exponents p, scales of S(t) = (1 + sum c e^{pt}) / omega^2, shapes (rows, r) and couplings (r, n_s)."""
        exponents, scales, shapes, couplings = [], [], [], []
        for tissue, modes, sign in self._sides:
            p, m, slow = poles(tissue.omega[modes], tissue.delta[modes])
            index = np.concatenate([np.arange(len(p)), np.flatnonzero(slow)])
            exponents.append(np.concatenate([p, m[slow]]))
            first = np.where(slow, 1.0, 2.0) * m / (p - m)
            scales.append(np.concatenate([first, -p[slow] / (p - m)[slow]]) / tissue.omega[modes][index] ** 2)
            shapes.append(sign * tissue.seen[:, :, modes].reshape(-1, len(p))[:, index])
            couplings.append(-tissue.g[modes][index])
        return np.concatenate(exponents), np.concatenate(scales), np.hstack(shapes), np.vstack(couplings)

    @cached_property
    def pulses(self) -> int:
        """Number of pulses that are summed; raises ControlError when the tissue decays too slowly."""
        decay = -float(self._parts[0].real.max())
        count = np.inf if decay <= 0 else np.ceil(-np.log(FORGOTTEN) / (decay * self.grid))
        if not count <= MOST_PULSES:
            tissue, left, _ = self._sides[0]
            slowest = left[int(np.argmax(poles(tissue.omega[left], tissue.delta[left])[0].real))]
            raise ControlError(
                f"mode {slowest + 1} of the tissue (omega = {tissue.omega[slowest]:.4g}/s) hardly decays, so what the "
                "reduced plant leaves out has no useful bound; set effects.damping.beta"
            )
        return int(count) + 1

    def kernel(self, s: float, derivative: int = 0) -> Array:
        """w(s) of pulses 0, 1, .. intervals ago, or its second derivative; (nodes, d, n_s, pulses).

        ``s``: instant of the interval [s], 0 <= s <= Delta; ``derivative``: 0 or 2.
        """
        p, scale, shape, coupling = self._parts
        scale = scale * p**derivative
        rows, n_s = len(shape), coupling.shape[1]
        result = np.empty((rows, n_s, self.pulses))
        now = (scale * np.exp(p * s)).real
        if derivative == 0:
            now = now + self._static
        result[:, :, 0] = shape @ (now[:, None] * coupling)
        begin, width = 1, 8
        while begin < self.pulses:  # fast modes are forgotten soon
            last = min(begin + width, self.pulses)
            alive = p.real * self.grid * (begin - 1) > np.log(FORGOTTEN) - 20
            ages = np.exp(np.outer(p[alive], self.grid * np.arange(begin - 1, last - 1)))
            passed = scale[alive] * np.exp(p[alive] * s) * (np.exp(p[alive] * self.grid) - 1)
            for j in range(n_s):
                amount = passed * coupling[alive, j]
                result[:, j, begin:last] = shape[:, alive] @ (amount[:, None] * ages).real
            begin, width = last, 2 * width
        return np.asarray(result.reshape(*self.full.seen.shape[:2], n_s, self.pulses))

    @cached_property
    def _static(self) -> Array:
        """1 / omega^2 once for every mode."""
        parts = []
        for tissue, modes, _ in self._sides:
            second = int(poles(tissue.omega[modes], tissue.delta[modes])[2].sum())
            parts += [1 / tissue.omega[modes] ** 2, np.zeros(second)]
        return np.concatenate(parts)

    def forgotten(self, derivative: int = 0) -> Array:
        """Bound on the sum of |w| over all older pulses, (nodes, d, n_s)."""
        p, scale, shape, coupling = self._parts
        decay = np.exp(p.real * self.grid)
        left = np.abs(scale * p**derivative * (np.exp(p * self.grid) - 1)) * decay ** (self.pulses - 1) / (1 - decay)
        size = np.abs(shape) @ (left[:, None] * np.abs(coupling))
        return np.asarray(size.reshape(*self.full.seen.shape[:2], -1))

    def modewise(self, derivative: int) -> Array:
        """Bound on sum_k |w_k| at every instant, each mode by its size: coarse, but proved; (nodes, d, n_s)."""
        p, scale, shape, coupling = self._parts
        passed = np.abs(np.exp(p * self.grid) - 1) / (1 - np.exp(p.real * self.grid))  # of all pulses but the newest
        size = np.abs(shape) @ ((np.abs(scale * p**derivative) * (1 + passed))[:, None] * np.abs(coupling))
        return np.asarray(size.reshape(*self.full.seen.shape[:2], -1))

    def level(self, s: float, derivative: int = 0) -> Array:
        """sum_k |w_k(s)| of a unit of each acceleration, (nodes, d, n_s)."""
        return np.asarray(np.abs(self.kernel(s, derivative)).sum(axis=-1) + self.forgotten(derivative))

    def bound(self, largest: Array) -> Array:
        """Bound on |e_j| at every time, (nodes, d) [m].

        At instants of an interval exactly. Between two of them a function leaves its chord by an eighth of the square
        of their distance times its second derivative: the error by its acceleration, and the acceleration by its own
        second derivative, which is bounded mode by mode.

        ``largest``: bound on |a_i| [m/s2], (n_s,).
        """
        rest = self.rest
        instants = self.grid * np.linspace(0, 1, FINE + 1) if rest is None else rest.instants
        before = self._at(0, instants[0], largest)  # refuses modes that hardly decay
        fourth, most = self.modewise(4) @ largest, np.zeros(self.full.seen.shape[:2])
        for i, (s, now) in enumerate(pairwise(instants.tolist())):
            at = self._at(i + 1, now, largest)
            leaves = (now - s) ** 2 / 8
            between = leaves * (np.maximum(before[1], at[1]) + leaves * fourth)
            if rest is not None:
                between = between + rest.between(i) @ largest
            most = np.maximum(most, np.maximum(before[0], at[0]) + between)
            before = at
        return most

    def kernel_at(self, i: int) -> Array:
        """Responses w of pulses 0, 1, .. intervals ago at instant i of the runs, (nodes, d, n_s, pulses)."""
        assert self.rest is not None
        kernel, rest = self.kernel(float(self.rest.instants[i])), self.rest.kernel(i)
        count = max(kernel.shape[-1], rest.shape[-1])
        both = (np.pad(part, ((0, 0),) * 3 + ((0, count - part.shape[-1]),)) for part in (kernel, rest))
        return np.add(*both)

    def level_at(self, i: int) -> Array:
        """sum_k |w_k| at instant i of the runs, with what they err at most, (nodes, d, n_s)."""
        assert self.rest is not None
        return np.asarray(np.abs(self.kernel_at(i)).sum(axis=-1) + self.forgotten() + self.rest.error(i))

    def _at(self, i: int, s: float, largest: Array) -> tuple[Array, Array]:
        """Bounds on |e_j| and on |e_j''| of the modes at an instant, (nodes, d)."""
        level = self.level(s) if self.rest is None else self.level_at(i)
        return level @ largest, self.level(s, 2) @ largest
