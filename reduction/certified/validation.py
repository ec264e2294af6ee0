"""Errors of certified runs against full runs at the same materials and under the same motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.errors import full_energy
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.replay import FullRun


@dataclass(frozen=True)
class TestError:
    """An answer at one parameter; errors relative to the largest energy norm of the full run."""

    lam: float  # first Lamé constant of the first layer [Pa]
    mu: float  # shear modulus of the first layer [Pa]
    truth: float  # error against the full run
    bound: float  # proved bound on the error
    estimate: float  # difference of the runs of the two bases; nan with one basis

    @property
    def effectivity(self) -> float:
        """Bound over true error; nan where there is no error."""
        return self.bound / self.truth if self.truth > 0 else float("nan")


def energy_norm(system: BlockSystem, Z: Array, v_s: Array | None = None) -> Array:
    """|u|_E = (z'Kz + v'Mv)^(1/2) of columns [z; v], local rows, with v_s (n_s, m) that of tissue and hand, (m,).

    Collective.
    """
    square = 2 * full_energy(system, Z)
    if v_s is not None:
        pull = total(system.layout.comm, system.G.T @ Z[system.layout.n_local :])
        square += (v_s * (2 * pull + (system.M_hand + system.M_rigid) @ v_s)).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def true_error(full: FullRun, answer: ReducedTrajectory, Phi: Array, coupled: bool = False) -> Array:
    """|u - u_k|_E of an answer u_k = Phi a at the snapshots of a full run u, (m,). Collective.

    Args:
        full: the full run.
        answer: at the same materials and steps, in second-order modes.
        Phi: the modes, local rows (n_local, k).
        coupled: the hand's own motion has an error too, which |.|_E counts.
    """
    system, s = full.model.system, full.snapshots
    a, b = np.split(answer.x[s.steps, 2 * system.layout.n_s :].T, 2)
    v_s = s.v_s - answer.v_s[s.steps].T if coupled else None
    return energy_norm(system, s.Z - np.vstack([Phi @ a, Phi @ b]), v_s)


def measured_error(full: FullRun, run: CertifiedRun, Phi: Array) -> TestError:
    """Error of a certified run, with the modes Phi of its answer, against the full run. Collective."""
    first, certificate = full.model.system.materials[0], run.certificate
    size = float(np.sqrt(2 * full.energy.max()))
    errors = [float(true_error(full, run.trajectory, Phi).max()), float(certificate.energy.largest)]
    errors.append(float("nan") if certificate.estimate is None else float(certificate.estimate.largest))
    truth, bound, estimate = (error / size for error in errors)
    return TestError(first.lam, first.mu, truth, bound, estimate)
