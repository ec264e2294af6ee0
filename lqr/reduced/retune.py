"""New lambda, mu with the basis of one parameter: affine reduced components, one small Riccati equation a setting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, on_root, times_columns, total
from softgrasp.lqr.dense.care import WeightedSystem, solve_reduced
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.reduced.bases import RiccatiBasis, energy_scaled
from softgrasp.lqr.reduced.riccati import NAN, GainCheck, GainQuality, full_gain, project_plant

Materials = tuple[LayerMaterial, ...]


class Retuner:
    """A_N = A_0 + sum_layers sum_{mu, lambda} theta (A_j + beta A'_j), A_j = -W_v'K_j U_z, A'_j = -W_v'K_j U_v.

    K_ee and D_ee are affine in the Lame constants; E, B, C and the rigid extension T do not depend on them. Nothing of
    the size of the tissue is touched in :meth:`solve`. Collective to make, not collective to use.

    ``problem``: the plant at the reference materials; ``basis``: the basis built there.
    """

    def __init__(self, problem: RiccatiProblem, basis: RiccatiBasis) -> None:
        self.problem = problem
        self.basis = basis = energy_scaled(problem, basis)
        self.reference: Materials = problem.system.materials
        self.matrices = project_plant(problem, basis)
        comm, n = problem.layout.comm, problem.layout.n_local
        W_v, U_z, U_v = basis.W.tall[n:], basis.U.tall[:n], basis.U.tall[n:]
        self.parts: list[tuple[tuple[Array, Array], tuple[Array, Array]]] = []
        for layer in problem.system.layers:
            pairs = []
            for component in (layer.K_mu, layer.K_lambda):
                elastic, viscous = (total(comm, W_v.T @ times_columns(component.ee, U)) for U in (U_z, U_v))
                pairs.append((-elastic, -viscous))
            self.parts.append((pairs[0], pairs[1]))
        self.A_0 = self.matrices.A - self._stiffness(self.reference)

    def _stiffness(self, materials: Materials) -> Array:
        result = np.zeros_like(self.matrices.A)
        for (mu, lam), m in zip(self.parts, materials, strict=True):
            result += m.stiff * mu[0] + m.viscous * mu[1] + m.lam * (lam[0] + m.beta * lam[1])
        return result

    def at(self, materials: Materials) -> WeightedSystem:
        """The reduced equation for other Lame constants and viscosities.

        Raises ControlError: the number of layers or a density differs from the reference.
        """
        if len(materials) != len(self.reference):
            raise ControlError(f"{len(materials)} materials are given; the body has {len(self.reference)} layers")
        for old, new in zip(self.reference, materials, strict=True):
            if new.dense != old.dense:
                raise ControlError(f"rho = {new.rho:g} differs from {old.rho:g}; re-tuning covers lambda, mu and beta")
        return replace(self.matrices, A=self.A_0 + self._stiffness(materials))

    def solve(self, materials: Materials) -> Array:
        """Riccati solution P_N at one setting of the materials in the scaled basis, (N, N).

        Raises ControlError: the setting is refused, or its reduced equation has no stabilising solution.
        """
        return solve_reduced(self.at(materials))


@dataclass(frozen=True)
class RetunedGain(GainQuality):
    """The gain at one setting of the box, against the full Riccati solution there."""

    materials: Materials  # materials of all layers
    seconds: float = NAN  # time of the re-tuning, nan unless the caller measures it [s]


def retuned_gain(retuner: Retuner, materials: Materials, gain_check: Callable[[], GainCheck]) -> RetunedGain:
    """Error of the re-tuned gain at one setting of the box. Collective.

    ``gain_check``: with the full solution at this setting; called where the re-tuned equation has one.
    """
    try:
        P_N = on_root(retuner.problem.layout.comm, lambda: retuner.solve(materials))
    except ControlError as error:
        return RetunedGain(materials, reason=str(error))
    return gain_check().with_quality(RetunedGain(materials), full_gain(retuner.problem, retuner.basis, P_N))
