"""What projections share: products with every layer, the reconstruction, input and result of online assembly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis

Parts = dict[str, Array]
"""Named small matrices; those with a leading axis have one matrix a layer."""


@dataclass(frozen=True)
class Reconstruction:
    """Rows that turn reduced states into tissue states relative to the hand; the only distributed part of a model."""

    layout: BlockLayout  # sizes and ownership
    L_q: Array  # z = L_q x, local rows (n_local, N)
    L_v: Array  # v_z = L_v x / scale [- W_G v_s], local rows (n_local, N)
    # M_ee^-1 G, local rows (n_local, n_s), in canonical coordinates of the absolute frame; else None
    W_G: Array | None = None


def relative_rows(basis: Basis, system: BlockSystem) -> tuple[Array, Array]:
    """Displacement and second row block of every basis vector relative to the hand, local rows."""
    if basis.frame == "relative":
        return basis.V_q, basis.V_p
    return (
        np.asfortranarray(basis.V_q - system.T @ basis.V_sq),
        np.asfortranarray(basis.V_p - system.T @ basis.V_sv),
    )


def layer_products(system: BlockSystem, component: str, Y: Array, *tests: Array) -> list[Array]:
    """X' A_l Y stacked over the layers l, (layers, .., ..), for each X of ``tests``. Collective.

    ``component``: "K_mu", "K_lambda" or "M_1" of :class:`softgrasp.fem.system.LayerBlocks`.
    """
    products: list[list[Array]] = []
    for layer in system.layers:
        A_Y = times_columns(getattr(layer, component).ee, Y)
        products.append([total(system.layout.comm, X.T @ A_Y) for X in tests])
    return [np.stack(each) for each in zip(*products, strict=True)]


def own_loads(system: BlockSystem, W: Array) -> Parts:
    """Loads of own terms at value 1 on the tissue, W'f (rows, N), and on the hand, (rows, n_s). Collective."""
    if all(row.load is None for row in system.layers):
        return {}
    nothing = np.zeros(len(W)), np.zeros(system.layout.n_s)
    loads = [nothing if row.load is None else row.load for row in system.layers]
    return {
        "own_tissue": np.stack([total(system.layout.comm, W.T @ f) for f, _ in loads]),
        "own_hand": np.stack([wrench for _, wrench in loads]),
    }


def symmetric(X: Array) -> Array:
    """(X + X') / 2, of every matrix of a stack."""
    return np.asarray((X + X.swapaxes(-1, -2)) / 2)


@dataclass(frozen=True)
class Parameters:
    """Everything online assembly depends on."""

    materials: tuple[LayerMaterial, ...]  # materials, one per layer
    gravity: Array | None = None  # acceleration of free fall in the hand's degrees of freedom, (n_s,) [m/s^2]
    alpha: float = 0.0  # mass-proportional damping [1/s]
    damped: bool = False  # damping terms exist
    in_space: bool = False  # alpha drags the rigid motion too
    hand_weight: bool = False  # gravity acts on the hand's own mass
    two_way: bool = False  # the hand feels the tissue
    scale: float = 1.0  # rho / rho of the projection, common to all layers (canonical models)

    @property
    def conservative(self) -> bool:
        """Whether nothing damps."""
        return not self.damped or (self.alpha == 0 and all(m.beta == 0 and m.viscous == 0 for m in self.materials))

    def load(self, F: Array) -> Array:
        """F = F g, (N,), of the matrix F (N, n_s) that maps an acceleration of the hand."""
        return np.zeros(len(F)) if self.gravity is None else np.asarray(F @ self.gravity)

    def own_load(self, parts: Parts, key: str) -> Array | float:
        """Load of own terms from one column a row, (rows, ..); 0 where there are none."""
        return self._sum([m.pulls for m in self.materials], parts[key]) if key in parts else 0.0

    def _sum(self, weights: list[float], stack: Array) -> Array:
        # one product of a vector with a reshaped stack: an order of magnitude faster than a loop for small matrices
        return np.asarray((np.array(weights) @ stack.reshape(len(weights), -1)).reshape(stack.shape[1:]))

    def density(self, stack: Array) -> Array:
        """Sum of rho_k X_k."""
        return self._sum([m.dense for m in self.materials], stack)

    def stiffness(self, mu: Array, lam: Array) -> Array:
        """Sum of mu_k X_k + lambda_k Y_k."""
        return self._sum([m.stiff for m in self.materials], mu) + self._sum([m.lam for m in self.materials], lam)

    def viscosity(self, mu: Array, lam: Array) -> Array:
        """Sum of beta_k (mu_k X_k + lambda_k Y_k)."""
        return self._sum([m.viscous for m in self.materials], mu) + self._sum(
            [m.beta * m.lam for m in self.materials], lam
        )
