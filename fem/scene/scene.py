"""The scene: what a user writes in TOML, as frozen and validated models.

Nothing here touches a mesh. Checks that need the space dimension run at once for a structured box, and
through `check_dimension` when the mesh comes from a file.

Reasons given by validators start with the key they are about, relative to the model: the loader puts the file
and the path in front of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PrivateAttr, model_validator

from softgrasp.fem.scene.control import BASES, Control, ControlOutput, Loop, Reduction, Study
from softgrasp.fem.scene.frame import check_frame
from softgrasp.fem.scene.obstacles import Obstacle, check_obstacle_vectors, check_obstacles
from softgrasp.fem.scene.tissue import Contact, Dropped, Label, Layer, Material, NonNegative, Positive, Section, Tissue
from softgrasp.fem.shown import Card, Shown, brief, listed

__all__ = [
    "Contact", "Control", "ControlOutput", "Damping", "Effects", "Gravity", "Hand", "Layer", "Loop", "Material",
    "Motion", "Obstacle", "Output", "Reduction", "Scene", "Study", "Time", "Tissue", "check_dimension", "scene_schema",
]  # fmt: skip


class Hand(Section):
    """The rigid hand."""

    mass: Positive = Field(20.0, description="mass [kg], > 0")
    inertia: Positive | Annotated[list[Positive], Field(min_length=3, max_length=3)] | None = Field(
        None,
        description="moment of inertia about the reference point [kg m2]: a number, in 3D also three (x, y, z)",
    )
    reference: list[float] | None = Field(None, description="reference point of the hand [m]; default: contact centre")


class Gravity(Section):
    """Body force rho g on the tissue."""

    g: list[float] = Field(description="acceleration of gravity, one entry per axis [m/s2]")
    hand_weight: bool = Field(False, description="whether the hand weighs too [no unit]")

    @model_validator(mode="before")
    @classmethod
    def _bare(cls, value: Any) -> Any:
        return {"g": value} if isinstance(value, list) else value  # gravity = [0, -9.81]


class Damping(Section):
    """C = beta K (Kelvin-Voigt) or C = alpha M + beta K (Rayleigh)."""

    kind: Literal["kelvin-voigt", "rayleigh"] = Field(description="damping law [no unit]")
    beta: NonNegative = Field(description="stiffness-proportional time [s], >= 0")
    alpha: NonNegative = Field(0.0, description="mass-proportional rate [1/s], >= 0, rayleigh only")
    drag: Literal["hand", "space"] = Field(
        "hand", description="alpha acts on the velocity against the hand or against space [no unit]"
    )

    @model_validator(mode="after")
    def _check(self) -> Damping:
        if self.alpha and self.kind == "kelvin-voigt":
            raise ValueError(f"alpha is {self.alpha}; Kelvin-Voigt has none, set kind = 'rayleigh' or alpha = 0")
        return self


class FiniteStrain(Section):
    """A hyperelastic law instead of linear elasticity."""

    law: Literal["neo-hooke", "neo-hooke-quadratic", "stvk"] = Field(
        "neo-hooke",
        description="energy of the material [no unit]: neo-Hooke with (ln J)^2 or (J - 1)^2 for the volume, or "
        "St. Venant-Kirchhoff, which is refused where it folds",
    )
    tol: Annotated[float, Field(ge=1e-13, le=1e-3)] = Field(1e-9, description="relative tolerance of each step [1]")


class Effects(Section):
    """Effects; each is switched off unless it is named."""

    gravity: Dropped[Gravity] = Field(None, description="gravity {g [m/s2], hand_weight}; off unless given")
    damping: Dropped[Damping] = Field(None, description="damping {kind, beta [s], alpha [1/s], drag}; off unless given")
    reaction: bool = Field(False, description="the tissue pushes back on the hand [no unit]")
    rotation: bool = Field(False, description="the hand also turns, by small angles unless frame is given [no unit]")
    frame: Dropped[Literal["hand"]] = Field(
        None,
        description="axes of the equations [no unit]: 'hand' for a hand that turns by any angle, with centrifugal, "
        "Coriolis and Euler loads and turned gravity; small angles unless given",
    )
    finite_strain: Dropped[FiniteStrain] = Field(
        None, description="large deformation, finite strain {law, tol [1]}; off unless given"
    )
    obstacles: bool = Field(False, description="the tissue meets the obstacles [no unit]")


class Motion(Section):
    """Motion of the hand, or force on it."""

    target: Dropped[list[float]] = Field(
        None, description="final displacement of the hand [m], then its angles [rad] with effects.rotation"
    )
    duration: Positive = Field(1.0, description="duration of the motion [s], > 0")
    profile: Literal["quintic", "csv", "hold"] = Field(
        "quintic", description="time law [no unit]: rest-to-rest quintic, a csv table, or no motion"
    )
    drive: Literal["motion", "force"] = Field("motion", description="motion or force is prescribed [no unit]")
    csv: str | None = Field(
        None,
        description="table, relative to the scene: t [s], then each hand freedom [m, rad] or, in 3D with "
        "effects.rotation, a pose x, y, z [m] and quaternion w, x, y, z [1], joined by a cubic spline at rest at both "
        "ends; or with drive = 'force' each load [N, N m], joined by straight lines",
    )

    @model_validator(mode="after")
    def _check(self) -> Motion:
        if self.profile == "quintic" and self.target is None:
            raise ValueError("target is missing; the quintic profile needs it (profile = 'hold' for none)")
        if self.profile != "quintic" and self.target is not None:
            raise ValueError(f"target cannot go with profile = '{self.profile}'; only 'quintic' has it")
        if (self.profile == "csv") != (self.csv is not None):
            raise ValueError("csv and profile = 'csv' go together; give both or neither")
        return self


class Time(Section):
    """Time grid and linear solver."""

    steps: Annotated[int, Field(ge=1)] = Field(description="number of equal time steps [1], >= 1")
    end: Positive | None = Field(None, description="end time [s]; default motion.duration")
    start: Literal["rest", "equilibrium"] = Field(
        "rest", description="start undeformed, or in equilibrium under gravity and with obstacles [no unit]"
    )
    solver: Literal["auto", "cholesky", "mumps", "cg", "stars"] = Field("auto", description="linear solver [no unit]")
    rtol: Dropped[Annotated[float, Field(gt=0, lt=1)]] = Field(
        None,
        description="relative residual [1] at which cg or stars ends a step; default 1e-8 with cg, 1e-4 with stars and "
        "at finite strain; energy is exact at any",
    )
    reproducible: Literal["auto"] | bool = Field(
        "auto",
        description="equal bits in every run on the same number of ranks: each stores the whole factor [no unit];  "
        "auto: on up to 4 ranks, in 3D to 20 000 unknowns over the number of ranks; true needs about twice the time of "
        "a spread factor beyond, and the memory of the whole one on each rank",
    )


class Output(Section):
    """Results that are kept of a run."""

    snapshots: Literal["auto", "memory", "hdf5", "none"] = Field(
        "auto", description="where states go; auto: memory, in `simulate` the few that its warnings look at [no unit]"
    )
    every: Annotated[int, Field(ge=1)] = Field(1, description="a snapshot every so many steps [1]")
    fields: Literal["vtu", "vtkhdf", "none"] = Field(
        "vtu", description="field files, a list fields.pvd of .vtu files, one VTKHDF file a field, or none [no unit]"
    )
    frames: Literal["auto"] | Annotated[int, Field(ge=1)] = Field(
        "auto", description="frames in field files and animations [1]; auto: 60 up to 1e5 unknowns, 10 from 6e5 on"
    )
    checkpoint_every: Annotated[int, Field(ge=0)] = Field(
        0, description="steps between restart files [1]; 0: only on interrupt"
    )
    memory: Literal["auto"] | Positive = Field(
        "auto", description="memory that a run may use on each node [GiB]; auto: what is free, and any solver"
    )


class Scene(Shown, Section):
    """A whole scene; relative file names start in `directory`.

    >>> import softgrasp as sg
    >>> sg.load_scene("paper_forward").tissue.cells
    [15, 30]
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    name: Label = Field(min_length=1)
    """short name [no unit]"""
    description: str = Field("")
    """purpose of the scene [no unit]"""
    tissue: Tissue
    """the soft body [m, Pa, kg/m3]"""
    contact: Contact
    """contact zone of hand and tissue [m]"""
    hand: Hand = Field(default_factory=Hand)
    """the rigid hand [kg, kg m2, m]"""
    effects: Effects = Field(default_factory=Effects)
    """effects that are switched on [various]"""
    motion: Motion = Field(default_factory=lambda: Motion(profile="hold"))
    """motion of the hand, or force on it [m, rad, s]"""
    obstacle: Dropped[Annotated[list[Obstacle], Field(min_length=1)]] = Field(None)
    """rigid obstacles, a table each [m]; none unless given"""
    time: Time
    """time grid and solver [s]"""
    control: Dropped[Control] = Field(None)
    """control problem [various]; off unless given"""
    reduction: Reduction = Field(default_factory=Reduction)
    """reduced models to compare [various]"""
    study: Study = Field(default_factory=Study)
    """tolerances and settings of studies [various]"""
    output: Output = Field(default_factory=Output)
    """results that are kept [no unit]"""
    _directory: Path = PrivateAttr(default_factory=Path.cwd)
    _mesh_digest: str = PrivateAttr("")  # of the mesh file, once it was read
    _energy: Any = PrivateAttr(None)  # `OwnEnergy`, once its file was run or where it was given, or None
    _terms: tuple[Any, ...] = PrivateAttr(())  # own terms, `Term` each
    _given: Any = PrivateAttr(None)  # `GivenMesh` in the place of the file, or None

    def card(self) -> Card:
        """Purpose, body, effects, motion and steps."""
        tissue, on = self.tissue, [name for name, value in self.effects if value not in (None, False)]
        body = (
            tissue.mesh
            or f"{listed(f'{x:g} m' for x in tissue.size or ())}, cells {listed(map(str, tissue.cells or ()))}"
        )
        rows = (
            ("purpose", brief(self.description)),
            ("body", f"{body}, P{tissue.order}"),
            ("effects", listed(on)),
            ("motion", f"{self.motion.profile}, {self.time.steps} steps to {self.time_end:g} s"),
        )
        return Card(f"Scene {self.name}", rows)

    @property
    def directory(self) -> Path:
        """Folder of the scene file."""
        return self._directory

    @property
    def dimension(self) -> int | None:
        """2 or 3 for a structured box; None while the mesh file is unread."""
        return None if self.tissue.size is None else len(self.tissue.size)

    @property
    def time_end(self) -> float:
        """End time [s]."""
        return self.motion.duration if self.time.end is None else self.time.end

    def changed(self, edit: Callable[[dict[str, Any]], None]) -> Scene:
        """A copy after ``edit`` changed the table of its keys in place. Raises ValidationError: it is not valid."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        edit(data)
        result = Scene.model_validate(data)
        result._directory = self._directory
        result._given = self._given if result.tissue.mesh == self.tissue.mesh else None
        result._terms = self._terms
        result._energy = self._energy if result.tissue.energy == self.tissue.energy else None
        return result

    def path(self, name: str) -> Path:
        """A file named in the scene, absolute."""
        return (self._directory / name).resolve()

    @property
    def files(self) -> list[Path]:
        """Files that the scene names, absolute."""
        energy = None if self.tissue.energy in (None, "given") else self.tissue.energy.rpartition(":")[0]
        paths = [obstacle.path.csv for obstacle in self.obstacle or [] if obstacle.path is not None]
        return [self.path(name) for name in (self.tissue.mesh, self.motion.csv, energy, *paths) if name is not None]

    def refuse_contact(self, what: str) -> None:
        """Refuse what contact is not part of. Raises SceneError: ``effects.obstacles`` is on."""
        if self.effects.obstacles:
            from softgrasp.fem.errors import SceneError  # imports MPI, which the models do without

            raise SceneError(
                f"scene '{self.name}': {what} cannot go with effects.obstacles yet; use --set effects.obstacles=false "
                "--set obstacle=false for a model without contact"
            )

    def refuse_frame(self, what: str) -> None:
        """Refuse what the frame of the hand is not part of. Raises SceneError: ``effects.frame`` is given."""
        if self.effects.frame is not None:
            from softgrasp.fem.errors import SceneError  # imports MPI, which the models do without

            more = "" if self.effects.finite_strain is None else " --set effects.finite_strain=false"
            raise SceneError(
                f"scene '{self.name}': {what} cannot go with effects.frame = 'hand' yet, whose equations are not "
                f"linear in the hand; use --set effects.frame=false{more} for small angles"
            )

    @model_validator(mode="after")
    def _check(self) -> Scene:
        effects = self.effects
        if effects.rotation and self.hand.inertia is None:
            raise ValueError(
                "hand.inertia is missing; effects.rotation needs it [kg m2], in 3D one number or [x, y, z]"
            )
        if effects.rotation and effects.finite_strain is not None and effects.frame is None:
            raise ValueError(
                "effects.finite_strain cannot go with effects.rotation, whose linearised turns would stretch the "
                "tissue; set one of them to false, or effects.frame to 'hand'"
            )
        if effects.frame is not None:
            check_frame(effects, self.tissue)
        if self.time.start == "equilibrium" and effects.gravity is None and not effects.obstacles:
            raise ValueError("time.start is 'equilibrium' but effects.gravity is off; use 'rest' or give gravity")
        if self.contact.facet_tag is not None and self.tissue.mesh is None:
            raise ValueError("contact.facet_tag needs tissue.mesh; on a structured box give sides or box")
        for name, layer in self.tissue.layers.items():
            if layer.beta is not None and effects.damping is None:
                raise ValueError(f"tissue.layers.{name}.beta needs effects.damping; give it or drop beta")
        planned = self.control is not None and self.control.constraints is not None
        check_obstacles(self.obstacle, used=planned or effects.obstacles)
        if effects.obstacles:
            _check_contact(self)
        elif any(obstacle.friction for obstacle in self.obstacle or []):
            raise ValueError("obstacle has friction, which only effects.obstacles = true uses; drop friction")
        if self.dimension is not None:
            _check_vectors(self, self.dimension)
        return self


def _check_contact(scene: Scene) -> None:
    """ValueError for what contact cannot go with."""
    if scene.obstacle is None:
        raise ValueError("obstacle is missing; effects.obstacles needs at least one [[obstacle]]")
    if scene.tissue.refine is not None and scene.tissue.refine.tolerance is not None:
        raise ValueError(
            "tissue.refine.tolerance cannot go with effects.obstacles, as its estimate leaves them out; drop it"
        )
    if scene.effects.finite_strain is not None:
        _check_finite(scene, scene.obstacle)
    if scene.time.solver in ("cg", "stars"):
        raise ValueError(
            f"time.solver is '{scene.time.solver}'; effects.obstacles needs a factor, use 'auto' or 'cholesky'"
        )


def _check_finite(scene: Scene, obstacles: list[Obstacle]) -> None:
    """ValueError for what contact at finite strain cannot go with."""
    if any(obstacle.friction for obstacle in obstacles):
        raise ValueError("obstacle has friction, which effects.finite_strain does not have yet; drop friction")
    if scene.effects.reaction:
        raise ValueError(
            "effects.reaction cannot go with effects.obstacles at finite strain yet; set one of the three to false"
        )
    if scene.time.start == "equilibrium":
        raise ValueError(
            "time.start is 'equilibrium'; with effects.obstacles and effects.finite_strain a run starts at 'rest'"
        )


def _check_vectors(scene: Scene, d: int) -> None:
    """ValueError for the first vector of the scene that does not fit d dimensions."""
    freedoms = d + (d * (d - 1) // 2 if scene.effects.rotation else 0)
    gravity, control = scene.effects.gravity, scene.control
    vectors: list[tuple[str, list[float] | None, int]] = [
        ("tissue.origin", scene.tissue.origin, d),
        ("hand.reference", scene.hand.reference, d),
        ("effects.gravity.g", None if gravity is None else gravity.g, d),
        ("motion.target", scene.motion.target, freedoms),
    ]
    boxes = [("contact.box", scene.contact.box)]
    boxes += [(f"tissue.layers.{name}.box", layer.box) for name, layer in scene.tissue.layers.items()]
    for i, output in enumerate([] if control is None else control.outputs):
        vectors.append((f"control.outputs.{i}.point", output.point, d))
        boxes.append((f"control.outputs.{i}.box", output.box))
    for key, box in boxes:
        vectors += [(key, corner, d) for corner in box or []]
    for key, vector, length in vectors:
        if vector is not None and len(vector) != length:
            raise ValueError(f"{key} has a vector of {len(vector)} entries; it must have {length} in this {d}D scene")
    check_obstacle_vectors(scene.obstacle, d)
    scene.contact.axes(d)
    if d == 2 and isinstance(scene.hand.inertia, list):
        raise ValueError("hand.inertia is a list; in 2D it must be one number")
    if d == 3 and scene.tissue.thickness != 1.0:
        raise ValueError(f"tissue.thickness is {scene.tissue.thickness}; in 3D it has no meaning, drop it")
    if control is not None and isinstance(control.R, list) and len(control.R) != freedoms:
        raise ValueError(f"control.R has {len(control.R)} rows; it must have {freedoms}, one per hand freedom")


def check_dimension(scene: Scene, d: int) -> None:
    """Check every vector of the scene against the dimension d of its mesh.

    Raises SceneError: the first vector, side or value that does not fit.
    """
    from softgrasp.fem.errors import SceneError  # imports MPI, which the models do without

    try:
        _check_vectors(scene, d)
    except ValueError as error:
        raise SceneError(f"scene '{scene.name}': {error}") from error


def scene_schema() -> dict[str, Any]:
    """JSON schema of a scene file, draft 2020-12."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | Scene.model_json_schema(by_alias=True)
    reduction = schema["$defs"]["Reduction"]
    own = {"type": "string", "description": "a basis of reduction.plugins"}
    reduction["properties"]["methods"]["items"] = {"anyOf": [{"enum": list(BASES)}, own]}
    reduction["if"] = {"properties": {"plugins": {"maxItems": 0}}}
    reduction["then"] = {"properties": {"methods": {"items": {"enum": list(BASES)}}}}
    return schema
