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
    """Everything online assembly depends on.

    Attributes:
        materials: one per layer.
        alpha: mass-proportional damping [1/s].
        damped: damping terms exist.
        in_space: alpha drags the rigid motion too.
        hand_weight: gravity acts on the hand's own mass.
        two_way: the hand feels the tissue.
        scale: rho / rho of the projection, common to all layers (canonical models).
    """

    materials: tuple[LayerMaterial, ...]
    alpha: float = 0.0
    damped: bool = False
    in_space: bool = False
    hand_weight: bool = False
    two_way: bool = False
    scale: float = 1.0

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
    """E x' = A x + B u + F g of dimension N, its hand and its energies.

    Attributes:
        E, A: (N, N).
        B: input of the force u on the hand, (N, n_s).
        F: input of the acceleration of free fall g, (N, n_s).
        S_q, S_v: q_s = S_q x and v_s = S_v x, (n_s, N).
        energy: x' energy x / 2 is the tissue's energy (z' K z + v_z' M v_z) / 2 [J].
        total: the same with the kinetic energy of the hand; two-way also that of the tissue's rigid motion, which
            makes it the Hamiltonian.
    """

    E: Array
    A: Array
    B: Array
    F: Array
    S_q: Array
    S_v: Array
    energy: Array
    total: Array
