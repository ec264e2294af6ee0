"""Runs of the full model for a study: each gives a trajectory at fixed places and its times, medians of repeats."""

from __future__ import annotations

import gc
import statistics
import time
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.accuracy.adapt import build_to_tolerance
from softgrasp.fem.fields.probe import Probe, make_probe
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.probe import Places, TimedRun, run_probed
from softgrasp.study.precision.settings import Setting, own_setting, variant
from softgrasp.study.shell.timing import medians

BURST_SECONDS = 0.05  # of the steps in each repeat after the first, which is the whole run
LONG_SECONDS = 5.0  # a run that takes longer is its own average, and is not repeated
BUILD_SECONDS = 2.0  # builds are repeated about this long


@dataclass(frozen=True)
class Pace:
    """Of a run."""

    seconds: float  # of its second step


class FullRuns:
    """Runs of one scene under many settings, cached; the model of the last mesh is kept. Collective."""

    def __init__(self, scene: Scene, places: Places, reference: Array, cache: Cache) -> None:
        self.scene, self.places, self.cache = scene, places, cache
        self.reference = reference.tolist() if scene.effects.rotation else None
        self.repeats, self.dimension = scene.study.repeats, places.dimension
        self._mesh: tuple[Setting, Model, Probe, dict[str, float]] | None = None
        self._compiled: set[tuple[int, object]] = set()  # forms by order and maker; the first build makes them

    def variant(self, setting: Setting, snapshots: str = "none") -> Scene:
        """The scene under a setting."""
        return variant(self.scene, setting, snapshots, self.reference)

    def run(self, setting: Setting, repeats: int | None = None) -> TimedRun:
        """Times, sizes and the trajectory of a setting."""
        count = self.repeats if repeats is None else repeats
        key = {"setting": setting.parameters | {"rtol": setting.rtol}, "repeats": count}
        return self.cache.point(setting.label, "run", key, TimedRun, lambda: [self._measure(setting, count)])[0]

    def expected(self, setting: Setting) -> float:
        """Seconds of the steps of a setting, from its second one; the first sets up the solver."""

        def second_step() -> list[Pace]:
            _, probe, _ = self._built(setting, 1)
            return [Pace(float(run_probed(self.model(setting), probe, 2).stamps[1]))]

        key = {"setting": setting.parameters | {"rtol": setting.rtol}}
        return setting.steps * self.cache.get("pace", key, Pace, second_step)[0].seconds

    def _built(self, setting: Setting, repeats: int) -> tuple[Model, Probe, dict[str, float]]:
        """Model and probe of a mesh, with the median seconds of its builds; the first build also compiles."""
        held = self._mesh
        if held is not None and held[0].group == setting.group:
            return held[1:]
        self._mesh = None
        comm = self.cache.comm
        seconds: dict[str, list[float]] = {"mesh": [], "assembly": []}
        scene = self.variant(setting)
        if setting.refine == "scene":  # one mesh whatever the steps, which its passes depend on a little
            scene = self.variant(own_setting(self.scene))
        make = build_to_tolerance if setting.refine == "scene" else build
        forms = setting.order, make
        if forms not in self._compiled:
            make(scene, comm=comm)
            self._compiled.add(forms)
        for _ in range(repeats):
            gc.collect()
            model = make(scene, comm=comm)
            for stage, values in seconds.items():
                values.append(model.watch.seconds[stage])
            if comm.bcast(sum(map(sum, seconds.values()))) > BUILD_SECONDS:
                break
        probe = make_probe(model.space, self.places.points, self.scene.effects.rotation)
        self._mesh = (setting, model, probe, medians(seconds))
        return self._mesh[1:]

    def model(self, setting: Setting) -> Model:
        """The model of a setting, with the mesh that was built for it."""
        model, _, _ = self._built(setting, 1)
        return Model(self.variant(setting), model.space, model.system, model.inventory, model.watch)

    def _measure(self, setting: Setting, repeats: int) -> TimedRun:
        _, probe, built = self._built(setting, repeats)
        model = self.model(setting)
        gc.collect()
        begin = time.perf_counter()
        first = run_probed(model, probe)
        if self.cache.comm.bcast(time.perf_counter() - begin) > LONG_SECONDS:
            repeats = 1
        burst = int(np.clip(BURST_SECONDS / max(float(first.stamps.mean()), 1e-7), 2, setting.steps))
        runs = [first] + [run_probed(model, probe, burst) for _ in range(repeats - 1)]
        later = [r.stamps[1:] if len(r.stamps) > 1 else r.stamps for r in runs]  # the first step sets up the solver
        steps = np.concatenate(later)
        layout = model.system.layout
        factor = statistics.median(r.factor for r in runs)
        per_step = statistics.median(float(s.mean()) for s in later)
        return TimedRun(
            **built,
            n_e=layout.n_e,
            states=layout.states,
            dimension=layout.dimension,
            steps=setting.steps,
            dt=self.scene.time_end / setting.steps,
            factor=factor,
            per_step=per_step,
            p50=float(np.quantile(steps, 0.5)),
            p99=float(np.quantile(steps, 0.99)),
            max=float(steps.max()),
            seconds=built["mesh"] + built["assembly"] + factor + setting.steps * per_step,
            times=first.times,
            values=np.hstack([first.own, first.y]),
        )
