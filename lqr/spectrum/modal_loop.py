"""Spectrum and quadratic cost of the full plant under any gain, in energy-scaled modal coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.fem.shown import Shown
from softgrasp.lqr.dense.care import block_eigenvalues, lyapunov
from softgrasp.lqr.dense.modal import ModalPlant, TissueMatrices, dense_modes, gather_tissue, lowest_plant
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem

DENSE_LIMIT = 1300  # largest number of modes that can all be kept; the dense order is twice that
FEW = 150  # modes up to which a plant keeps them all: its spectrum is exact, a tenth of a second a gain
LOWEST_MODES = 60  # of a larger one: a hundredth


@dataclass(frozen=True)
class SampledRadius:
    """Spectral radius of a loop from tick to tick, see :mod:`softgrasp.lqr.spectrum.sampled`."""

    value: float  # largest modulus of an eigenvalue; of the modes kept where not ``exact``
    certified: bool = True  # whether the radius of the whole plant is proved to lie on the same side of 1
    exact: bool = True  # whether all modes are kept
    reason: str = ""  # why it is not certified; empty when it is

    @property
    def stable(self) -> bool:
        """Certified and below 1."""
        return self.certified and self.value < 1


@dataclass(frozen=True, repr=False)
class LoopQuality(Shown):
    """The full plant under one gain."""

    abscissa: float
    """Largest real part of the closed-loop spectrum, or a lower bound where not ``exact`` [1/s]."""
    cost_excess: float
    """Excess cost J(K_hat) / J(K) - 1 from the start given; infinite when the loop is not stable."""
    certified: bool = True
    """Whether the sign of ``abscissa`` is proved, by the whole spectrum or
    :func:`softgrasp.lqr.spectrum.certificate.abscissa`."""
    exact: bool = True
    """Whether the abscissa of the whole spectrum exceeds ``abscissa`` by at most a thousandth of it."""
    poles: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Computed eigenvalues [1/s], (k,)."""
    sampled: SampledRadius | None = None
    """Radius from tick to tick; None where the instants are unknown."""

    @property
    def stable(self) -> bool:
        """Whether every eigenvalue is known to lie left of the axis, and in the unit circle where it is sampled."""
        return self.certified and self.abscissa < 0 and (self.sampled is None or self.sampled.stable)


class ModalLoop:
    """xi' = (A + B K) xi, xi = [q_s, v_s, omega eta, eta'], all modes of a small scene or the lowest of a large one.

    With all modes the spectrum is that of the full plant. With some, the modes left out are not in it: use
    :func:`softgrasp.lqr.spectrum.certificate.abscissa` for large scenes.

    Args:
        modes: how many; all where the plant has no more of them, up to :data:`DENSE_LIMIT`. None keeps all up to
            :data:`FEW`, or :data:`LOWEST_MODES`.
    """

    def __init__(self, problem: RiccatiProblem, modes: int | None = None) -> None:
        self.problem, self.comm = problem, problem.layout.comm
        n_e = problem.layout.n_e
        if modes is None:
            modes = FEW if n_e <= FEW else LOWEST_MODES
        self.complete = n_e <= min(modes, DENSE_LIMIT)
        self.plant = _all(problem) if self.complete else lowest_plant(problem, min(modes, n_e))
        space = self.plant.space
        solved = np.linalg.solve(space.E, np.hstack([space.A, space.B]))
        self.A, self.B = solved[:, : len(space.A)], solved[:, len(space.A) :]

    def gain(self, K: Block) -> Array:
        """K on modal states from a transposed gain in hand-relative coordinates, (n_s, 2 n_s + 2 k). Collective."""
        z, v = total(self.comm, np.stack([self.plant.Phi.T @ part for part in K.parts[2:]]))
        return np.asarray(np.vstack([K.hand, z / self.plant.omega[:, None], v]).T)

    def state(self, x: Block) -> Array:
        """Modal states of full ones. Collective."""
        z, v = total(self.comm, np.stack([self.plant.massed.T @ part for part in x.parts[2:]]))
        return np.asarray(np.vstack([x.hand, z * self.plant.omega[:, None], v]))

    def poles(self, K: Block) -> np.ndarray:
        """Eigenvalues of the closed loop. Collective."""
        k = self.gain(K)
        return on_root(self.comm, lambda: np.asarray(scipy.linalg.eigvals(self.A + self.B @ k)))

    def quality(self, K: Block, best: Block, x: Block, optimal: float) -> LoopQuality:
        """Abscissa and cost of a gain against the optimal one. Collective.

        With d = K_hat - K:  J(K_hat) - J(K) = x' Y x,  F'Y + Y F + d'R d = 0,  F = A + B K_hat, which has none of
        the cancellation of J(K_hat) - J(K).

        Args:
            K: the gain to check, transposed, hand-relative.
            best: the optimal gain.
            x: start minus target, one column.
            optimal: J(K) from there.
        """
        k, difference, xi = self.gain(K), self.gain(K) - self.gain(best), self.state(x)

        def evaluate() -> LoopQuality:
            F = self.A + self.B @ k
            if not np.isfinite(F).all():
                return LoopQuality(np.inf, np.inf, poles=np.array([np.inf + 0j]))
            T, U = scipy.linalg.schur(F, output="real")
            poles = block_eigenvalues(T)
            abscissa = float(poles.real.max())
            if not abscissa < 0:
                return LoopQuality(abscissa, np.inf, poles=poles)
            Y = lyapunov(T, U, difference.T @ self.problem.R @ difference)
            return LoopQuality(abscissa, max(float(xi[:, 0] @ Y @ xi[:, 0]), 0.0) / optimal, poles=poles)

        return on_root(self.comm, evaluate)


def _all(problem: RiccatiProblem) -> ModalPlant:
    """All modes, of Phi and massed the local rows. Collective."""
    layout, tissue = problem.layout, gather_tissue(problem)
    plant: ModalPlant = on_root(layout.comm, lambda: dense_modes(problem, cast(TissueMatrices, tissue)))
    rows = slice(layout.start, layout.start + layout.n_local)
    return replace(plant, Phi=plant.Phi[rows], massed=plant.massed[rows])
