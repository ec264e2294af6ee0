"""Parameters that can be fitted, by name, and a model or a scene at other values of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from softgrasp.fem.errors import SceneError, shortened
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene

KINDS = {"lambda": "lam", "mu": "mu", "rho": "rho", "beta": "beta"}
UNITS = {"lambda": "Pa", "mu": "Pa", "rho": "kg/m3", "beta": "s"}


@dataclass(frozen=True)
class Unknown:
    """One parameter that is fitted."""

    name: str  # as it was asked for: "mu", "skin.mu"
    kind: str  # "lambda", "mu", "rho" or "beta"
    layers: tuple[int, ...]  # numbers of the layers of the model that have it

    @property
    def layer(self) -> str:
        """Name of the layer, empty for the rest of the tissue."""
        return self.name.rpartition(".")[0]

    @property
    def unit(self) -> str:
        """Unit of its values."""
        return UNITS[self.kind]


def parse_unknowns(names: Sequence[str], model: Model) -> tuple[Unknown, ...]:
    """Unknowns of ("mu", "lambda", "skin.mu"); without a layer the tissue that no layer claims.

    Raises SceneError: a name is none, is given twice, or the scene has no such part or no positive value to start from.
    """
    found = []
    scene, inside = model.scene, [blocks.name for blocks in model.system.layers]
    for word in names:
        layer, _, kind = word.rpartition(".")
        if kind not in KINDS:
            raise SceneError(
                f"--fit {shortened(word)}: the parameters are {', '.join(KINDS)}, of a layer as in skin.mu"
            )
        if layer and layer not in scene.tissue.layers:
            has = ", ".join(scene.tissue.layers) or "none"
            raise SceneError(f"--fit {shortened(word)}: the scene has no layer '{layer}'; it has {has}")
        if kind == "beta" and scene.effects.damping is None:
            raise SceneError(f"--fit {word}: beta needs effects.damping; name it in the scene")
        own = scene.tissue.layers
        rest = [n not in own or (kind == "beta" and own[n].beta is None) for n in inside]
        places = tuple(i for i, n in enumerate(inside) if (n == layer if layer else rest[i]))
        if not places:
            raise SceneError(
                f"--fit {word}: all cells are in layers; name one of {', '.join(own)}, as in {inside[0]}.{kind}"
            )
        value = getattr(model.system.materials[places[0]], KINDS[kind])
        if not value > 0:
            raise SceneError(f"--fit {word}: the scene's value is {value:g}; the fit starts there and needs one > 0")
        found.append(Unknown(word, kind, places))
    claimed = [(u.kind, i) for u in found for i in u.layers]
    if not found or len(set(claimed)) < len(claimed):
        raise SceneError(f"--fit {shortened(','.join(names))}: give each parameter once, and at least one")
    return tuple(found)


def assumed(model: Model, unknowns: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Parameters of the scene that are not fitted: what the values rest on."""
    taken = {(u.kind, i) for u in unknowns for i in u.layers}
    found = []
    for i, blocks in enumerate(model.system.layers):
        for kind, key in KINDS.items():
            if (kind, i) not in taken and getattr(model.system.materials[i], key) > 0:
                found.append(Unknown(kind if blocks.name == "tissue" else f"{blocks.name}.{kind}", kind, (i,)))
    return tuple(found)


def value_of(materials: Sequence[LayerMaterial], unknown: Unknown) -> float:
    """The value of an unknown."""
    return float(getattr(materials[unknown.layers[0]], KINDS[unknown.kind]))


def materials_at(
    materials: Sequence[LayerMaterial], unknowns: Sequence[Unknown], values: Array
) -> tuple[LayerMaterial, ...]:
    """Materials with other values of the unknowns."""
    result = list(materials)
    for u, value in zip(unknowns, values, strict=True):
        for i in u.layers:
            result[i] = replace(result[i], **dict[str, Any]({KINDS[u.kind]: float(value)}))
    return tuple(result)


def scene_at(scene: Scene, unknowns: Sequence[Unknown], values: Array) -> Scene:
    """The scene with other values of the unknowns. Raises ValidationError: they are no material."""

    def edit(data: dict[str, Any]) -> None:
        for u, value in zip(unknowns, values, strict=True):
            table = data["tissue"]["layers"][u.layer] if u.layer else data["tissue"]
            if u.kind == "beta":
                (table if u.layer else data["effects"]["damping"])["beta"] = float(value)
            else:
                table["material"].pop("name", None)
                table["material"][u.kind] = float(value)

    return scene.changed(edit)
