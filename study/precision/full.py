"""Runs of the full model for a study: each gives a trajectory at fixed places and its times, medians of repeats."""

from __future__ import annotations

import gc
import statistics
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from softgrasp.fem.fields.probe import Probe, make_probe
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.points import Cache, Guard, Row, Setting, as_array, variant
from softgrasp.study.precision.probe import Places, run_probed

BURST_SECONDS = 0.05  # of the steps in each repeat after the first, which is the whole run
BUILD_SECONDS = 2.0  # builds are repeated about this long


@dataclass(frozen=True)
class Series:
    """Outputs over time: deformations y - rigid, what the tissue does, and displacements y, side by side.

    Attributes:
        times: (steps + 1,) [s].
        values: (steps + 1, 2 p) [m].
        dimension: d; p is a multiple of it.
    """

    times: Array
    values: Array
    dimension: int

    def at(self, times: Array) -> Array:
        """Values at other times, by cubic splines. Not collective."""
        if len(times) == len(self.times) and np.allclose(times, self.times, rtol=0, atol=1e-12 * self.times[-1]):
            return self.values
        return np.asarray(CubicSpline(self.times, self.values)(times))


def largest(values: Array, d: int) -> tuple[float, float]:
    """Largest length of the vectors in the first half of the columns, and in the second. Not collective."""
    places = values.reshape(len(values), 2, -1, d)
    found = np.linalg.norm(places, axis=3).max(axis=(0, 2))
    return float(found[0]), float(found[1])


def errors_of(found: Series, true: Series) -> tuple[float, float]:
    """Largest error over the largest value: of the deformation, the measure of a study, and of the displacement.

    The rigid motion of the hand is many times the deformation, and hides it in the second. Not collective.
    """
    scale = largest(true.values, true.dimension)
    gap = largest(found.values - true.at(found.times), true.dimension)
    return tuple(g / s if s > 0 else 0.0 for g, s in zip(gap, scale, strict=True))  # type: ignore[return-value]


class FullRuns:
    """Runs of one scene under many settings, cached; the model of the last mesh is kept. Collective.

    Args:
        scene: the study's scene.
        places: of its outputs.
        reference: point that the hand turns about.
        cache: of measured runs.
        guard: asked before each run.
    """

    def __init__(self, scene: Scene, places: Places, reference: Array, cache: Cache, guard: Guard) -> None:
        self.scene, self.places, self.cache, self.guard = scene, places, cache, guard
        self.reference = reference.tolist() if scene.effects.rotation else None
        self.repeats = scene.study.repeats
        self._mesh: tuple[Setting, Model, Probe, Row] | None = None

    def variant(self, setting: Setting, snapshots: str = "none") -> Scene:
        """The scene under a setting."""
        return variant(self.scene, setting, snapshots, self.reference)

    def run(self, setting: Setting, repeats: int | None = None) -> Row:
        """Times, sizes and the trajectory of a setting.

        Keys: n_e, states, steps, dt, mesh, assembly, factor, per_step (seconds, medians), p50, p99, max of a step,
        seconds of the whole run, and times and values of its :class:`Series`.
        """
        count = self.repeats if repeats is None else repeats
        key = {"setting": [setting.cells, setting.order, setting.steps, setting.solver, setting.rtol], "repeats": count}
        self.guard.next(setting.label, self.work(setting))
        return self.cache.get("run", key, lambda: self._measure(setting, count))

    def work(self, setting: Setting) -> float:
        """Expected work of a run, in unknowns times steps. Not collective."""
        d = self.scene.dimension or 3
        n = max(setting.unknowns(d), 300)
        return n * (setting.steps + 100) * (1 if d == 2 else (n / 1000) ** 0.3) + 2e5

    def series(self, row: Row) -> Series:
        """The trajectory of a row."""
        return Series(as_array(row["times"]), as_array(row["values"]), row["dimension"])

    def _built(self, setting: Setting, repeats: int) -> tuple[Model, Probe, Row]:
        """Model and probe of a mesh, with the median seconds of its builds; the first build also compiles."""
        held = self._mesh
        if held is not None and (held[0].cells, held[0].order) == (setting.cells, setting.order):
            return held[1], held[2], held[3]
        self._mesh = None
        comm = self.cache.comm
        seconds: dict[str, list[float]] = {"mesh": [], "assembly": []}
        build(self.variant(setting), comm=comm)
        for _ in range(repeats):
            gc.collect()
            model = build(self.variant(setting), comm=comm)
            for stage, values in seconds.items():
                values.append(model.watch.seconds[stage])
            if comm.bcast(sum(map(sum, seconds.values()))) > BUILD_SECONDS:
                break
        row = {stage: statistics.median(values) for stage, values in seconds.items()}
        probe = make_probe(model.space, self.places.points, self.scene.effects.rotation)
        self._mesh = (setting, model, probe, row)
        return model, probe, row

    def model(self, setting: Setting) -> Model:
        """The model of a setting, with the mesh that was built for it."""
        model, _, _ = self._built(setting, 1)
        return Model(self.variant(setting), model.space, model.system, model.inventory, model.watch)

    def _measure(self, setting: Setting, repeats: int) -> Row:
        _, probe, built = self._built(setting, repeats)
        model = self.model(setting)
        gc.collect()
        first = run_probed(model, probe)
        burst = int(np.clip(BURST_SECONDS / max(float(first.stamps.mean()), 1e-7), 2, setting.steps))
        runs = [first] + [run_probed(model, probe, burst) for _ in range(repeats - 1)]
        later = [r.stamps[1:] if len(r.stamps) > 1 else r.stamps for r in runs]  # the first step sets up the solver
        steps = np.concatenate(later)
        row = {
            **built,
            "n_e": model.system.layout.n_e,
            "states": model.system.layout.states,
            "dimension": model.system.layout.dimension,
            "steps": setting.steps,
            "dt": self.scene.time_end / setting.steps,
            "factor": statistics.median(r.factor for r in runs),
            "per_step": statistics.median(float(s.mean()) for s in later),
            "p50": float(np.quantile(steps, 0.5)),
            "p99": float(np.quantile(steps, 0.99)),
            "max": float(steps.max()),
        }
        row["seconds"] = row["mesh"] + row["assembly"] + row["factor"] + setting.steps * row["per_step"]
        return row | {"times": first.times, "values": np.hstack([first.own, first.y])}
