"""An own energy with the values of its parameters in every layer of a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.energy.law import EnergyLaw
from softgrasp.fem.energy.rest import Affine
from softgrasp.fem.energy.translate import PLACE
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.points import QuadraturePoints

if TYPE_CHECKING:
    from softgrasp.fem.scene.tissue import Tissue

MODULI = ("mu", "lam")  # parameters that are those of a layer's material


@dataclass(frozen=True)
class LayerEnergy:
    """The energy of a model, layer by layer.

    K = sum over the layers of mu K_mu + lambda K_lambda and, a row of blocks and materials each, of p_i K_i over the
    other affine parameters, and of the rest that no parameter multiplies.
    """

    law: EnergyLaw  # the energy
    names: tuple[str, ...]  # names of the layers
    values: tuple[dict[str, float], ...]  # values of its parameters in each layer at which the model was built
    affine: Affine  # parameters that the stiffness is affine in, and the others
    rows: dict[tuple[int, str], int] = field(default_factory=dict)  # row of each parameter with one of its own
    certifiable: str = ""  # why certificates do not hold, in words; empty where they do

    def value(self, layer: int, key: str, materials: tuple[LayerMaterial, ...]) -> float:
        """A parameter of a layer at these materials."""
        if key in MODULI:
            return float(getattr(materials[layer], key))
        row = self.rows.get((layer, key))
        return self.values[layer][key] if row is None else materials[row].mu

    def __call__(self, points: QuadraturePoints, materials: tuple[LayerMaterial, ...]) -> tuple[Array, ...]:
        """Inputs of the law in every point, (Q,) each."""
        return self.moduli(materials, points.layer, points.X)

    def moduli(self, materials: tuple[LayerMaterial, ...], layer: Any, X: Array) -> tuple[Array, ...]:
        """Inputs of the law at places X (Q, d) of these layers (Q,)."""
        result = []
        for key in self.law.inputs:
            if key in PLACE:
                result.append(np.ascontiguousarray(X[:, PLACE.index(key)]))
            else:
                result.append(np.array([self.value(i, key, materials) for i in range(len(self.values))])[layer])
        return tuple(result)

    def at_rest(self, materials: tuple[LayerMaterial, ...], layer: Any, X: Array) -> Array:
        """Moduli (d, d, d, d, Q) at rest [Pa] at places X (Q, d) of these layers (Q,)."""
        moduli = self.moduli(materials, layer, X)
        A = self.law.at_rest(dict(zip(self.law.inputs, moduli, strict=True)))
        return np.broadcast_to(A if A.ndim > 4 else A[..., None], (*A.shape[:4], len(X)))

    def tables(self, tissue: Tissue, materials: tuple[LayerMaterial, ...]) -> dict[str, Any]:
        """``parameters`` and ``layers`` of a scene's tissue with the values of these materials."""
        places = {name: i for i, name in enumerate(self.names)}
        last = len(self.names) - 1

        def at(i: int) -> dict[str, float]:
            return {key: self.value(i, key, materials) for key in tissue.parameters}

        layers = {key: layer.model_copy(update={"parameters": at(places[key])}) for key, layer in tissue.layers.items()}
        return {"parameters": at(places.get("tissue", last)), "layers": layers}

    def why_not(self, key: str) -> str:
        """Why a parameter has no row of its own, as a sentence; empty where the energy does not have it."""
        if key in self.affine.other:
            return (
                f"the tangent of the energy {self.law.name} is not affine in {key}, {self.affine.other[key]}; build "
                f"the scene with another tissue.parameters.{key}"
            )
        if key in self.affine.inert:
            return (
                f"{key} does not enter the tangent of the energy {self.law.name}, finite strain alone sees it; build "
                f"the scene with another tissue.parameters.{key}"
            )
        return ""

    def in_words(self) -> str:
        """The energy, and what its parameters are to the stiffness."""
        text = self.law.name
        if self.affine.parameters:
            text += f"; stiffness affine in {', '.join(self.affine.parameters)}"
        if self.affine.inert:
            text += f"; not dependent on {', '.join(self.affine.inert)}"
        return text + "".join(f"; not affine in {key}, {why}" for key, why in self.affine.other.items())
