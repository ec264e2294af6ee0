"""Parameters and operators of a small model: what online assembly takes and what it gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.system import LayerMaterial

Parts = dict[str, Array]
"""Named small matrices; those with a leading axis hold one matrix a layer."""


@dataclass(frozen=True)
class Parameters:
    """Everything online assembly depends on."""

    materials: tuple[LayerMaterial, ...]  # one per layer
    alpha: float = 0.0  # mass-proportional damping [1/s]
    damped: bool = False  # damping terms exist
    in_space: bool = False  # alpha drags the rigid motion too
    hand_weight: bool = False  # gravity acts on the hand's own mass
    two_way: bool = False  # the hand feels the tissue
    scale: float = 1.0  # rho / rho of the projection, common to all layers (canonical models)

    def _sum(self, weights: list[float], stack: Array) -> Array:
        # one product of a vector with a reshaped stack: an order of magnitude faster than a loop for small matrices
        return np.asarray((np.array(weights) @ stack.reshape(len(weights), -1)).reshape(stack.shape[1:]))

    def density(self, stack: Array) -> Array:
        """Sum of rho_k X_k."""
        return self._sum([m.rho for m in self.materials], stack)

    def stiffness(self, mu: Array, lam: Array) -> Array:
        """Sum of mu_k X_k + lambda_k Y_k."""
        return self._sum([m.mu for m in self.materials], mu) + self._sum([m.lam for m in self.materials], lam)

    def viscosity(self, mu: Array, lam: Array) -> Array:
        """Sum of beta_k (mu_k X_k + lambda_k Y_k)."""
        return self._sum([m.beta * m.mu for m in self.materials], mu) + self._sum(
            [m.beta * m.lam for m in self.materials], lam
        )


@dataclass(frozen=True)
class Operators:
    """E x' = A x + B u + F g of dimension N, its hand and its energies."""

    E: Array  # E, A: (N, N)
    A: Array
    B: Array  # input of the force u on the hand, (N, n_s)
    F: Array  # input of the acceleration of free fall g, (N, n_s)
    S_q: Array  # S_q, S_v: q_s = S_q x and v_s = S_v x, (n_s, N)
    S_v: Array
    energy: Array  # x' energy x / 2 is the tissue's energy (z' K z + v_z' M v_z) / 2 [J]
    # the same with the kinetic energy of the hand; two-way also that of the tissue's rigid motion, which makes it the
    # Hamiltonian
    total: Array
