"""Which modes of the tissue the markers see.

A free swing eta = a e^{-delta t} cos(omega t) of mode m moves sample s by c_sm a. Samples every h with the standard
deviation sd show it beside their noise where

    sum_s c_sm^2 a^2 / (4 delta h sd_s^2) >= 1,

its entry of the observability Gramian over the noise. In metres of the node that moves most it is hidden below

    max_j |phi_m(j)| a,   a = (sum_s c_sm^2 / (4 delta h sd_s^2))^{-1/2}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array, total
from softgrasp.lqr.dense.modal import ModalPlant
from softgrasp.lqr.observer.sensors import Sensors
from softgrasp.lqr.plant.problem import RiccatiProblem

STILL = 0.01  # of the largest motion in a mode: a marker that moves less does not see it


@dataclass(frozen=True)
class Seen:
    """Modes of the tissue as the markers see them."""

    modes: NDArray[np.int64]  # their numbers, from 0, (k,)
    frequency: Array  # natural frequency [Hz], (k,)
    share: Array  # motion of a marker along an axis over that of the node that moves most, (markers' samples, k)
    hidden: Array  # largest swing of that node that all markers' noise hides [m], infinite where all rest, (k,)
    names: tuple[str, ...]  # of the markers' samples

    def blind(self, i: int) -> list[str]:
        """Samples that do not see mode ``i`` of these."""
        return [name for name, share in zip(self.names, self.share[:, i], strict=True) if share < STILL]


def seen_modes(
    problem: RiccatiProblem, plant: ModalPlant, sensors: Sensors, kept: NDArray[np.int64], period: float
) -> Seen:
    """What markers sampled every ``period`` [s] see of some modes of a plant. Collective."""
    comm, d = problem.layout.comm, problem.layout.dimension
    kept, rows = np.sort(kept), sensors.markers
    Phi = plant.Phi[:, kept]
    nodes = np.linalg.norm(Phi.reshape(-1, d, len(kept)), axis=1)
    largest = np.max(comm.allgather(nodes.max(axis=0, initial=0.0)), axis=0)
    c = np.abs(total(comm, sensors.of(Phi)[0])[rows])
    rate = np.diag(plant.D)[kept]  # 2 delta
    with np.errstate(divide="ignore"):
        a = np.sqrt(2 * rate * period / np.sum((c / sensors.sd[rows, None]) ** 2, axis=0))
    return Seen(kept, plant.omega[kept] / (2 * np.pi), c / largest, largest * a, sensors.names[rows])
