"""Strain and stress of a displacement at the midpoints of the cells, for pictures.

eps = sym grad u,  sigma = 2 mu eps + lambda tr(eps) I,  von Mises sqrt(3/2 s : s) with s = sigma - tr(sigma)/3 I.

With effects.finite_strain Green's strain (F'F - I)/2 and Cauchy's stress P F' / J of the law, F = I + grad u.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import LAWS

VOIGT = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


class CellStress:
    """Strain and stress in the owned cells of a model; exact for P1, of the midpoint for P2 and P3.

    In 2D the strain is plane: eps_zz = 0, sigma_zz as it must be for that.

    Attributes:
        layer: number of the layer of each owned cell, shape (m,).
    """

    def __init__(self, model: Model) -> None:
        space, d = model.space, model.space.mesh.dimension
        self.gradients = space.gradients(np.full((1, d), 1 / (d + 1)))[:, 0].transpose(0, 2, 1)  # (m, d, k)
        self.dofs = space.V.dofmap.list[: space.mesh.owned]
        self.layer = space.layer.astype(np.int32)
        finite = model.scene.effects.finite_strain
        self.law = None if finite is None else LAWS[finite.law]
        self.lam, self.mu = (np.array([getattr(m, key) for m in model.system.materials]) for key in ("lam", "mu"))

    def __call__(self, u: Array) -> tuple[Array, Array, Array]:
        """Strain [1] (m, 6), stress [Pa] (m, 6), both as xx, yy, zz, xy, yz, xz, and von Mises stress [Pa] (m,).

        ``u``: displacement of the local nodes, ghosts included [m], shape (n, d).
        """
        d = u.shape[1]
        H = np.zeros((len(self.dofs), 3, 3))
        H[:, :d, :d] = (self.gradients @ u[self.dofs]).transpose(0, 2, 1)  # H_ij = d u_i / d x_j
        lam, mu = self.lam[self.layer], self.mu[self.layer]
        eps = (H + H.transpose(0, 2, 1)) / 2
        if self.law is None:
            sigma = 2 * mu[:, None, None] * eps + (lam * np.trace(eps, axis1=1, axis2=2))[:, None, None] * np.eye(3)
        else:
            F = np.eye(3) + H
            with np.errstate(invalid="ignore", divide="ignore"):  # J <= 0 at the midpoint of a cell has no stress
                P = self.law.stress(np.ascontiguousarray(H.transpose(1, 2, 0)), lam, mu).transpose(2, 0, 1)
                sigma = P @ F.transpose(0, 2, 1) / np.linalg.det(F)[:, None, None]
            eps += H.transpose(0, 2, 1) @ H / 2
        shear = sigma - np.trace(sigma, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        mises = np.sqrt(1.5 * np.einsum("cij,cij->c", shear, shear))
        rows, columns = zip(*VOIGT, strict=True)
        return eps[:, rows, columns], sigma[:, rows, columns], mises
