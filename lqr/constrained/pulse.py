"""What the reduced tissue leaves out, bounded exactly: the l1 norm of its answer to accelerations held on a grid.

Full and reduced tissue hear the same a, held over Delta, so that the error of node j is

    e_j(t_n + s) = sum_k w_jk(s) a_{n-k},    |e_j| <= sum_k |w_jk(s)| a_max,

which the sequence a_{n-k} = a_max sign w_jk(s) attains. The pulse responses w are sums of exponentials of full minus
reduced modes, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.tissue import ModalTissue
from softgrasp.lqr.plant.checks import ControlError

FORGOTTEN = 1e-13  # of an amplitude: what older pulses leave is bounded by a geometric sum
MOST_PULSES = 100_000  # memory of a tissue that hardly decays
FINE = 256  # instants of an interval where error and acceleration are bounded; what is between them is a few percent


@dataclass(frozen=True)
class PulseError:
    """Full minus reduced tissue under accelerations that are held over intervals of length ``grid``."""

    full: ModalTissue  # all modes
    reduced: ModalTissue  # the plant of the plan
    grid: float  # length of an interval Delta [s]

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray, Array, Array]:
        """Exponents p, scales of S(t) = (1 + sum c e^{pt}) / omega^2, shapes (rows, r) and couplings (r, n_s)."""
        exponents, scales, shapes, couplings = [], [], [], []
        for tissue, sign in ((self.full, 1.0), (self.reduced, -1.0)):
            gap = tissue.delta**2 - tissue.omega**2
            # equal roots are moved apart by less than rounding sees
            gap = np.where(np.abs(gap) < 1e-12 * tissue.omega**2, -1e-12 * tissue.omega**2, gap)
            root = np.sqrt(gap.astype(complex))
            p, m = -tissue.delta + root, -tissue.delta - root
            slow = gap > 0  # two real roots, else a pair of which the real part of one counts twice
            index = np.concatenate([np.arange(len(p)), np.flatnonzero(slow)])
            exponents.append(np.concatenate([p, m[slow]]))
            first = np.where(slow, 1.0, 2.0) * m / (p - m)
            scales.append(np.concatenate([first, -p[slow] / (p - m)[slow]]) / tissue.omega[index] ** 2)
            shapes.append(sign * tissue.seen.reshape(-1, len(p))[:, index])
            couplings.append(-tissue.g[index])
        return np.concatenate(exponents), np.concatenate(scales), np.hstack(shapes), np.vstack(couplings)

    @cached_property
    def pulses(self) -> int:
        """Pulses that are summed; raises ControlError when the tissue remembers too many."""
        tissue = self.full
        slowest = int(np.argmin(np.minimum(tissue.delta, tissue.omega**2 / (2 * tissue.delta + 1e-300))))
        decay = -float(self._parts[0].real.max())
        count = np.inf if decay <= 0 else np.ceil(-np.log(FORGOTTEN) / (decay * self.grid))
        if not count <= MOST_PULSES:
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
        for tissue in (self.full, self.reduced):
            second = int((tissue.delta**2 - tissue.omega**2 > 1e-12 * tissue.omega**2).sum())
            parts += [1 / tissue.omega**2, np.zeros(second)]
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

        At :data:`FINE` instants of an interval exactly. Between two of them a function leaves its chord by an eighth of
        the square of their distance times its second derivative: the error by its acceleration, and the acceleration
        by its own second derivative, which is bounded mode by mode.

        ``largest``: bound on |a_i| [m/s2], (n_s,).
        """
        instants, leaves = self.grid * np.linspace(0, 1, FINE + 1), (self.grid / FINE) ** 2 / 8
        at = np.max([self.level(s) @ largest for s in instants[1:]], axis=0)
        bend = np.max([self.level(s, 2) @ largest for s in instants], axis=0)
        return np.asarray(at + leaves * (bend + leaves * (self.modewise(4) @ largest)))
