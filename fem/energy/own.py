"""The energy of a scene: a callable that `softgrasp.build` was given, or one of a Python file that the scene names."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from softgrasp.fem.energy.law import EnergyLaw
from softgrasp.fem.energy.translate import translate
from softgrasp.fem.errors import SceneError, shortened

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

GIVEN = "given"  # tissue.energy of a scene whose energy is a callable


@dataclass(frozen=True)
class OwnEnergy:
    """An energy W(F, p) with the name that messages have for it."""

    W: Callable[[Any, Any], Any]  # energy per volume of the rest state [J/m^3] in UFL
    name: str  # "file.py:W", or the name of the callable
    # laws made so far, by names of parameters and dimension
    laws: dict[tuple[Any, ...], EnergyLaw] = field(default_factory=dict, repr=False, compare=False)

    def law(self, scene: Scene, d: int) -> EnergyLaw:
        """The law of a scene in d dimensions. Raises SceneError: W is no energy."""
        names = ("mu", "lam", *scene.tissue.parameters)
        if (names, d) not in self.laws:
            self.laws[names, d] = EnergyLaw(self.name, *translate(self.W, self.name, names, d), d)
        law = self.laws[names, d]
        unused = [key for key in scene.tissue.parameters if key not in law.parameters]
        if unused:
            raise SceneError(f"tissue.parameters has '{unused[0]}', which the energy {self.name} does not use; drop it")
        return law


def energy_of(scene: Scene) -> OwnEnergy | None:
    """The energy of a scene, None where its law is a built-in one; a file is run once.

    A file is a Python program of the user: it may do what its user may do.

    Raises SceneError: the file is missing, fails, or does not have the function.
    """
    key = scene.tissue.energy
    if key is None or scene._energy is not None:
        energy: OwnEnergy | None = scene._energy
        return energy
    if key == GIVEN:
        raise SceneError(
            "tissue.energy is 'given': the energy was a Python function; build the scene with energy=..., or name its "
            'file as in tissue.energy = "law.py:W"'
        )
    place, _, name = key.rpartition(":")
    file = scene.path(place)
    if not file.is_file():
        raise SceneError(f"tissue.energy = '{key}': there is no file {file}; write \"file.py:function\"")
    try:
        W = runpy.run_path(str(file), run_name=f"softgrasp_energy_{file.stem}").get(name)
    except Exception as error:
        raise SceneError(f"{file}: it ended with {type(error).__name__}: {shortened(str(error))}") from error
    if not callable(W):
        raise SceneError(f"{file}: it has no function '{name}', which tissue.energy = '{key}' names")
    result = OwnEnergy(W, f"{file.name}:{name}")
    scene._energy = result
    return result


def with_energy(scene: Scene, W: object) -> Scene:
    """The scene with a callable as its energy. Raises SceneError: it is none."""
    if not callable(W):
        raise SceneError(f"energy is {shortened(repr(W))}; give a function W(F, p) that returns an energy in UFL")

    def edit(keys: dict[str, Any]) -> None:
        keys["tissue"]["energy"] = GIVEN

    result = scene.changed(edit)
    result._energy = OwnEnergy(W, getattr(W, "__name__", type(W).__name__))
    return result
