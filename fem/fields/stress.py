"""Strain and stress of a displacement at the midpoints of the cells, for pictures.

eps = sym grad u,  sigma = 2 mu eps + lambda tr(eps) I,  von Mises sqrt(3/2 s : s) with s = sigma - tr(sigma)/3 I.

With effects.finite_strain Green's strain (F'F - I)/2 and Cauchy's stress P F' / J of the law, F = I + grad u.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import LAWS, volume_change

VOIGT = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


class CellStress:
    """Strain and stress in the owned cells of a model; exact for P1, of the midpoint for P2 and P3.

    In 2D the strain is plane: eps_zz = 0, sigma_zz as it must be for that. An own energy says it if
    its W holds in 3D too; else sigma_zz and the von Mises stress are NaN.

    Attributes:
        layer: number of the layer of each owned cell, shape (m,).
    """

    def __init__(self, model: Model) -> None:
        space, d = model.space, model.space.mesh.dimension
        self.d = d
        gradients = space.gradients(np.full((1, d), 1 / (d + 1)))[:, 0]  # (m, k, d)
        self.gradients = np.ascontiguousarray(gradients.transpose(1, 2, 0))  # a row of cells for each component
        self.dofs = np.ascontiguousarray(space.V.dofmap.list[: space.mesh.owned].T)  # (k, m)
        self.layer = space.layer.astype(np.int32)
        finite = model.scene.effects.finite_strain
        self.law = None if finite is None else LAWS[finite.law]
        materials, self.own = model.system.materials, model.system.energy
        if self.own is not None:
            X = space.mesh.vertices[:, 0] + np.full(d, 1 / (d + 1)) @ space.mesh.edges
            inputs = self.own.moduli(materials, self.layer, X)
            self.moduli = inputs if finite is not None else self.own.at_rest(materials, self.layer, X)
            if d == 2:
                from softgrasp.fem.energy.plane import AcrossPlane  # only scenes with an energy of their own pay for it

                self.across = AcrossPlane(model.scene, self.own.law, inputs)
        self.lam, self.mu = (np.array([getattr(m, key) for m in materials])[self.layer] for key in ("lam", "mu"))

    def __call__(self, u: Array) -> tuple[Array, Array, Array]:
        """Strain [1] (m, 6), stress [Pa] (m, 6), both as xx, yy, zz, xy, yz, xz, and von Mises stress [Pa] (m,).

        ``u``: displacement of the local nodes, ghosts included [m], shape (n, d).
        """
        d, lam, mu = self.d, self.lam, self.mu
        H = np.zeros((3, 3, self.dofs.shape[1]))  # H_ij = d u_i / d x_j, a row of cells each
        for i in range(d):
            at = np.ascontiguousarray(u[:, i])[self.dofs]
            for j in range(d):
                np.einsum("km,km->m", self.gradients[:, j], at, out=H[i, j])
        own = [c for c, (i, j) in enumerate(VOIGT) if max(i, j) < d]  # the others are zero
        eps, sigma = np.zeros((6, len(lam))), np.zeros((6, len(lam)))
        for c in own:
            i, j = VOIGT[c]
            eps[c] = H[i, j] if i == j else (H[i, j] + H[j, i]) / 2
        if self.own is not None:
            self._own_stress(H, sigma)
            if self.law is not None:
                for c in own:
                    i, j = VOIGT[c]
                    eps[c] += (H[:, i] * H[:, j]).sum(axis=0) / 2
        elif self.law is None:
            for c in own:
                sigma[c] = 2 * mu * eps[c]
            sigma[:3] += lam * (eps[0] + eps[1] + eps[2])
        else:
            F = np.eye(3)[:, :, None] + H
            with np.errstate(invalid="ignore", divide="ignore"):  # J <= 0 at the midpoint of a cell has no stress
                P, J = self.law.stress(H, lam, mu), 1 + volume_change(H)
                for c, (i, j) in enumerate(VOIGT):
                    sigma[c] = (P[i] * F[j]).sum(axis=0) / J
            for c in own:
                i, j = VOIGT[c]
                eps[c] += (H[:, i] * H[:, j]).sum(axis=0) / 2
        shear = sigma[:3] - (sigma[0] + sigma[1] + sigma[2]) / 3
        squares = shear[0] ** 2 + shear[1] ** 2 + shear[2] ** 2
        for c in own[d:]:
            squares += 2 * sigma[c] ** 2
        mises = np.sqrt(1.5 * squares)
        return eps.T, sigma.T, mises

    def _own_stress(self, H: Array, sigma: Array) -> None:
        """Write the stress of an own energy."""
        d, h = self.d, H[: self.d, : self.d]
        if self.law is None:
            P, J = np.einsum("ijklm,klm->ijm", self.moduli, h), np.ones(h.shape[2])
            F = np.broadcast_to(np.eye(d)[:, :, None], h.shape)
        else:
            assert self.own is not None
            F, J = np.eye(d)[:, :, None] + h, 1 + volume_change(h)
            P = self.own.law.stress(h, *self.moduli)
        with np.errstate(invalid="ignore", divide="ignore"):  # J <= 0 at the midpoint of a cell has no stress
            for c, (i, j) in enumerate(VOIGT):
                if max(i, j) < d:
                    sigma[c] = (P[i] * F[j]).sum(axis=0) / J
            if d == 2:
                sigma[2] = self.across.linear(h) if self.law is None else self.across.stress(h) / J
