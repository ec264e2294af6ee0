"""Derivatives of J by the materials, summed over blocks of steps.

    dJ/dmu = -sum_n eta_n' K_mu (z + beta z')_n,   dJ/dlambda the same with K_lambda,   dJ/dbeta = -sum_n eta_n' K z'_n,
    dJ/drho = -sum_n eta_n' (M_1 (z'' + alpha z')_n - G_1 c_n) [- xi_n' (G_1'(z'' + alpha z')_n - M_1,rigid c_n)],
    dJ/dalpha = -sum_n eta_n' (M z' + G v_s)_n [- xi_n' (G'z' + M_rigid v_s)_n]

at the midpoint of each step, of every layer ([...] where the tissue acts on the hand; v_s, and z' beside xi, where
alpha drags in space).
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.adjoint.backward import Backward
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.fem.system import BlockSystem, LayerBlocks

KINDS = ("lam", "mu", "beta", "rho")


def dot(A: Array, B: Array) -> float:
    """Sum of the products of all entries, in the order in which the first lies in memory."""
    return float(np.vdot(A.T, B.T) if A.flags.f_contiguous else np.vdot(A, B))


class MaterialSums:
    """Sums of the steps that went by, by layer and kind, and by alpha.

    ``damped``: derivatives by beta and alpha are asked for.

    Attributes:
        local: this rank's share, (layers, 4) in the order of `KINDS`.
        same: what every rank computes alike, dJ/drho by the rigid inertia, (layers,).
        alpha: dJ/dalpha, this rank's share; ``alpha_same``: what every rank computes alike.
    """

    def __init__(self, system: BlockSystem, back: Backward, damped: bool) -> None:
        self.system, self.back, self.damped = system, back, damped or system.damping.active
        layers = system.layers
        self.local, self.same = np.zeros((len(layers), len(KINDS))), np.zeros(len(layers))
        self.alpha = self.alpha_same = 0.0
        self.G = [layer.M_1.es + times_columns(layer.M_1.ee, system.T) for layer in layers]
        self.rigid = [self._rigid(layer, G) for layer, G in zip(layers, self.G, strict=True)]

    def _rigid(self, layer: LayerBlocks, G: Array) -> Array:
        """Inertia of a layer moved rigidly at rho = 1, (n_s, n_s). Collective."""
        T = self.system.T
        rigid = layer.M_1.ss + total(self.system.layout.comm, T.T @ G + layer.M_1.es.T @ T)
        return np.asarray((rigid + rigid.T) / 2)

    def add(self, first: int, states: Array, eta: Array) -> None:
        """Add some steps, see :meth:`Backward.blocks`. Collective."""
        run, system, damping = self.back.run, self.system, self.system.damping
        n, steps = system.layout.n_local, slice(first, first + eta.shape[1])
        z, v = states[:n], states[n:]
        middle, force = (z[:, 1:] + z[:, :-1]) / 2, np.diff(v, axis=1) / run.dt
        rate = (v[:, 1:] + v[:, :-1]) / 2 if self.damped else None
        pulled = force  # z'' + alpha z', which the hand feels where alpha drags in space
        if rate is not None:
            pulled, force = force + damping.drag * rate, force + damping.alpha * rate
        c, xi = run.drive.c[steps], self.back.xi[steps] if self.back.felt else None
        for i, (layer, m) in enumerate(zip(system.layers, system.materials, strict=True)):
            K_lam, K_mu, M = (times_columns(A.ee, eta) for A in (layer.K_lambda, layer.K_mu, layer.M_1))
            sums = self.local[i]
            sums[0] -= dot(K_lam, middle)
            sums[1] -= dot(K_mu, middle)
            sums[3] -= dot(M, force) - dot(eta.T @ self.G[i], c)
            if xi is not None:
                sums[3] -= dot(pulled.T @ self.G[i], xi)
                self.same[i] += dot(c @ self.rigid[i], xi)
            if rate is not None:
                by_lam, by_mu = dot(K_lam, rate), dot(K_mu, rate)
                sums[:3] -= m.beta * by_lam, m.beta * by_mu, m.lam * by_lam + m.mu * by_mu
                self.alpha -= m.rho * dot(M, rate)
        if damping.in_space and rate is not None:
            v_s = (run.drive.v[first + 1 : steps.stop + 1] + run.drive.v[steps]) / 2
            self.alpha -= dot(eta.T @ system.G, v_s)
            if xi is not None:
                self.alpha -= dot(rate.T @ system.G, xi)
                self.alpha_same -= dot(v_s @ system.M_rigid, xi)

    def add_equilibrium(self, z: Array, Z: Array) -> None:
        """Add dJ by the start z = K^-1 G g, which moves with the materials; local rows. Collective.

        Raises SolverError: the solve fails.
        """
        zeta = static_columns(self.system, Z[:, None])
        for i, layer in enumerate(self.system.layers):
            self.local[i, 0] -= np.vdot(times_columns(layer.K_lambda.ee, zeta)[:, 0], z)
            self.local[i, 1] -= np.vdot(times_columns(layer.K_mu.ee, zeta)[:, 0], z)
            self.local[i, 3] += np.vdot(zeta[:, 0] @ self.G[i], self.system.fall)

    def finish(self) -> tuple[dict[str, Array], float]:
        """Derivatives by layer of each kind, and by alpha, over all ranks. Collective."""
        table = total(self.system.layout.comm, np.append(self.local.ravel(), self.alpha))
        by_layer = table[:-1].reshape(self.local.shape)
        by_layer[:, 3] += self.same
        return {kind: by_layer[:, j].copy() for j, kind in enumerate(KINDS)}, float(table[-1] + self.alpha_same)
