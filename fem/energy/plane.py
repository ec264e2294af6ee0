"""Stress across the plane of an energy in plane strain: that of the same W(F, p) in 3D, with F_zz = 1.

W may be written for 2D alone, or differ in 3D by more than a constant; then nothing says what sigma_zz is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.energy.law import EnergyLaw
from softgrasp.fem.energy.own import energy_of
from softgrasp.fem.energy.program import Program
from softgrasp.fem.energy.translate import PLACE, entries
from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

SAME = 1e-9  # largest difference of the stresses in the plane in 2D and 3D, over the largest [1]
TRIED = 0.05  # size of the displacement gradient at which they are compared [1]


class AcrossPlane:
    """The stress P_zz of an energy in plane strain.

    Args:
        scene: with the energy.
        law: the energy in 2D.
        moduli: its inputs in every point, (Q,) each.

    Attributes:
        known: whether W has a meaning in 3D that agrees with 2D in the plane and has no stress at rest.
    """

    def __init__(self, scene: Scene, law: EnergyLaw, moduli: tuple[Array, ...]) -> None:
        self.values: dict[str, Array] = {"X.2": np.zeros(()), **dict(zip(law.inputs, moduli, strict=True))}
        self.Q = len(moduli[0]) if moduli else 1
        self.known = False
        own = energy_of(scene)
        assert own is not None
        try:
            self.law = own.law(scene, 3)
        except SceneError:  # the shapes of 2D, a parameter of one dimension alone
            return
        if not set(self.law.inputs) <= {*self.values, *PLACE}:
            return
        self.P = tuple(self.law.graph.reverse(self.law.W, entries(3)))
        flat = tuple(law.graph.reverse(law.W, entries(2)))
        H = TRIED * np.array([[0.7, -0.4], [0.9, 0.5]])[:, :, None]
        plane = Program(law.graph, flat).run(self._inputs(H, 2), (self.Q,))
        space = Program(self.law.graph, self.P).run(self._inputs(H, 3), (self.Q,))
        rest = Program(self.law.graph, self.P).run(self._inputs(0 * H, 3), (self.Q,))
        size = np.abs(space).max(initial=0.0)
        apart = np.abs(space[[0, 1, 3, 4]] - plane).max(initial=0.0)
        self.known = bool(max(apart, np.abs(rest).max(initial=0.0)) <= SAME * size)

    def _inputs(self, H: Array, d: int) -> Mapping[str, Array]:
        values: dict[str, Array] = dict(self.values)
        for i in range(d):
            for j in range(d):
                values[f"F.{i}{j}"] = np.asarray(float(i == j) + (H[i, j] if max(i, j) < 2 else 0.0))
        return values

    def stress(self, H: Array) -> Array:
        """P_zz (Q,) [Pa] at H (2, 2, Q); NaN where it is not known."""
        if not self.known:
            return np.full(H.shape[2], np.nan)
        return np.asarray(Program(self.law.graph, self.P[8:]).run(self._inputs(H, 3), H.shape[2:])[0])

    def linear(self, H: Array) -> Array:
        """Sigma_zz (Q,) [Pa] of small H (2, 2, Q): A_zzkl H_kl; NaN where it is not known."""
        if not self.known:
            return np.full(H.shape[2], np.nan)
        result, rest = np.zeros(H.shape[2]), self._inputs(np.zeros_like(H), 3)
        for k in range(2):
            for m in range(2):
                A = self.law.graph.forward(self.P[8:], f"F.{k}{m}")
                result += Program(self.law.graph, tuple(A)).run(rest, H.shape[2:])[0] * H[k, m]
        return result
