"""What a work-precision study collects: settings, points, the cache that lets it resume, and how it is stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp import package_version
from softgrasp.fem.errors import Interrupted, SceneError, agree
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.switch import changed
from softgrasp.study.report.files import plain

FORMAT = 2  # of the cached files
LEAST_STEPS = 4  # of a run
QUESTIONS = ("forward", "reduced", "bases", "riccati", "reduced_riccati", "loop")
CONTROL = ("riccati", "reduced_riccati", "loop")  # of these, the ones about feedback
TITLES = {
    "forward": "Full model: mesh, order, time step, solver",
    "reduced": "Reduced models: basis and N",
    "bases": "Bases: engine and tolerance",
    "riccati": "Riccati equation: method and tolerance",
    "reduced_riccati": "Reduced Riccati equation: basis and N",
    "loop": "Closed loop: controller and step",
}

Row = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """How the full model is solved.

    Attributes:
        cells: of the structured box; None on a mesh file.
        order: of the displacement, 1 or 2.
        steps: equal time steps.
        solver: linear solver.
        rtol: tolerance of an iterative one.
    """

    cells: tuple[int, ...] | None
    order: int
    steps: int
    solver: str = "auto"
    rtol: float = 1e-10

    @property
    def mesh(self) -> str:
        """Mesh and order in words."""
        shape = "mesh file" if self.cells is None else " x ".join(map(str, self.cells))
        return f"{shape}, P{self.order}"

    @property
    def label(self) -> str:
        """All in words."""
        tail = "" if self.solver == "auto" else f", {self.solver}" + (f" {self.rtol:g}" if self.solver == "cg" else "")
        return f"{self.mesh}, {self.steps} steps{tail}"

    @property
    def overrides(self) -> list[str]:
        """Arguments of ``--set`` that give this setting."""
        found = [] if self.cells is None else [f"tissue.cells={list(self.cells)}"]
        found += [f"tissue.order={self.order}", f"time.steps={self.steps}", f"time.solver={self.solver}"]
        return found + ([f"time.rtol={self.rtol:g}"] if self.solver == "cg" else [])

    def unknowns(self, d: int) -> int:
        """About how many tissue unknowns a structured mesh has. Not collective."""
        return 0 if self.cells is None else d * int(np.prod([self.order * n + 1 for n in self.cells]))


def scene_setting(scene: Scene) -> Setting:
    """The scene's own setting. Not collective."""
    cells = None if scene.tissue.cells is None else tuple(scene.tissue.cells)
    return Setting(cells, scene.tissue.order, scene.time.steps, scene.time.solver, scene.time.rtol)


def least_steps(scene: Scene) -> int:
    """Fewest steps of a run: a prescribed move needs two over its duration. Not collective."""
    motion = scene.motion
    if motion.drive == "motion" and motion.profile == "quintic":
        return max(LEAST_STEPS, ceil(2 * scene.time_end / motion.duration))
    return LEAST_STEPS


def variant(scene: Scene, setting: Setting, snapshots: str = "none", reference: Sequence[float] | None = None) -> Scene:
    """The scene under another setting. Not collective.

    Args:
        scene: the scene.
        setting: mesh, order, steps and solver.
        snapshots: where they go.
        reference: point that the hand turns about, which by default moves a little with the mesh.
    """

    def edit(table: dict[str, Any]) -> None:
        if setting.cells is not None:
            table["tissue"]["cells"] = list(setting.cells)
        table["tissue"]["order"] = setting.order
        table["time"] |= {"steps": setting.steps, "solver": setting.solver, "rtol": setting.rtol}
        table["output"] = table.get("output", {}) | {"snapshots": snapshots, "every": 1}
        if reference is not None:
            table["hand"]["reference"] = list(reference)

    return changed(scene, edit)


@dataclass(frozen=True)
class WorkPoint:
    """One point of one diagram.

    Attributes:
        question: one of :data:`QUESTIONS`.
        series: points that are one line.
        label: the setting in words.
        seconds: what it costs.
        error: relative, of what the question is about.
        ok: a setting that may be used; unstable models may not.
        details: everything else that was measured.
    """

    question: str
    series: str
    label: str
    seconds: float
    error: float
    ok: bool = True
    details: Row = field(default_factory=dict)

    def to_row(self) -> Row:
        """A flat table row; numbers that are not finite become None. Not collective."""
        row = asdict(self)
        return {k: plain(v) for k, v in (row | row.pop("details")).items()}


def number(value: float | None) -> float:
    """A number out of JSON, where None stands for one that is not finite. Not collective."""
    return float("inf") if value is None else float(value)


class Cache:
    """Measured points as JSON files by hash, so that an interrupted study goes on where it stopped.

    The hash is of the scene (without name, description and what the point does not depend on), the setting, the number
    of ranks and the version. Collective.

    Args:
        folder: where the files are.
        comm: ranks.
        scene: the study's scene.
    """

    def __init__(self, folder: Path, comm: MPI.Intracomm, scene: Scene) -> None:
        self.folder, self.comm = folder, comm
        self.scene = ""  # rank 0 looks for the files
        with agree(comm):
            if comm.rank == 0:
                self.scene = scene_hash(scene, ("name", "description", "reduction", "output"))
        self.hits = self.misses = 0

    def path(self, kind: str, key: Row) -> Path:
        """File of a point."""
        whole = {"scene": self.scene, "ranks": self.comm.size, "version": package_version(), "format": FORMAT} | key
        return (
            self.folder / f"{kind}-{hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:20]}.json"
        )

    def get(self, kind: str, key: Row, measure: Callable[[], Row]) -> Row:
        """The cached value, or the measured one, which is then kept; both as they come out of JSON."""
        found: Row | None = None
        if self.comm.rank == 0:
            try:
                found = json.loads(self.path(kind, key).read_text())["value"]
            except (OSError, ValueError, KeyError):
                found = None
        found = self.comm.bcast(found)
        if found is not None:
            self.hits += 1
            return found
        self.misses += 1
        value = json.loads(json.dumps(plain(measure())))
        with agree(self.comm):
            if self.comm.rank == 0:
                self._write(self.path(kind, key), {"kind": kind, "key": key, "value": value})
        return dict(self.comm.bcast(value))

    def _write(self, path: Path, data: Row) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(data))
        os.replace(part, path)  # a file is there whole or not at all


def as_array(rows: Any) -> Array:
    """An array out of JSON."""
    return np.array(rows, dtype=float)


@dataclass
class Guard:
    """Says between two points whether to go on, and how far the study is.

    Attributes:
        comm: ranks.
        progress: called with the name of the point that comes and the share of work done.
        work: expected work in all, any unit.
        done: of it.
        stop: filled by the first Ctrl-C.
    """

    comm: MPI.Intracomm
    progress: Callable[[str, float], None] | None = None
    work: float = 1.0
    done: float = 0.0
    stop: list[bool] = field(default_factory=list)

    def next(self, label: str, work: float = 0.0) -> None:
        """Before a point. Collective.

        Raises:
            Interrupted: somebody asked to stop.
        """
        if self.comm.allreduce(bool(self.stop), MPI.LOR):
            raise Interrupted(
                f"stopped before '{label}' with {100 * min(self.done / self.work, 1):.0f} % done; the same command "
                "goes on from there"
            )
        if self.progress is not None:
            self.progress(label, min(self.done / self.work, 1.0))
        self.done += work


@dataclass(frozen=True)
class Asked:
    """What is asked of a study.

    Attributes:
        tolerance: relative error of the deformation to answer for, or None.
        budget: seconds of a step to answer for, or None.
        names: arguments of ``--question``, each one or several with commas; empty asks all questions.
    """

    tolerance: float | None = None
    budget: float | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        split = tuple(part.strip() for name in self.names for part in name.split(","))
        object.__setattr__(self, "names", split)
        unknown = [name for name in split if name not in QUESTIONS]
        if unknown:
            raise SceneError(f"--question {unknown[0]}: it must be one of {', '.join(QUESTIONS)}")
        if split and not (self.tolerance is None and self.budget is None) and not {"forward", "reduced"} <= set(split):
            raise SceneError("--tolerance and --budget need the questions forward and reduced; name both, or none")

    @property
    def questions(self) -> tuple[str, ...]:
        """In the order of :data:`QUESTIONS`."""
        return tuple(q for q in QUESTIONS if q in self.names or not self.names)
