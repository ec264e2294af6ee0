"""The observer of a scene: sensors, the filter that runs, and its judgement on the full plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.scene import control_of
from softgrasp.lqr.loop.controller import Controller, layout_hash
from softgrasp.lqr.observer.full import FullFilter, full_filter
from softgrasp.lqr.observer.judge import Judged, Ticks, abscissa_without, judge, make_ticks, slowest_mode
from softgrasp.lqr.observer.reduced import ReducedFilter, reduced_filter
from softgrasp.lqr.observer.seen import Seen, seen_modes
from softgrasp.lqr.observer.sensors import Noise, Sensors, make_disturbance, make_sensors
from softgrasp.lqr.observer.tail import rest_of, why_no_rest
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, FEW, ModalLoop
from softgrasp.lqr.spectrum.sampled import SAFE

WEIGHTS = (1.0, 10.0, 100.0)  # of the noise that stands for what the filter leaves out, until the full loop is stable
SWAPS = 3  # of modes, where the filter slows the loop
LESS = 0.3  # of that noise, where its modes were chosen on the full loop
ONE_BY_ONE = 8  # markers up to which the loop without each is examined, a spectrum of the full plant


@dataclass(frozen=True)
class ObservedControl:
    """What a scene's ``[control.observer]`` asks for."""

    controller: Controller
    """Optimal gain on the estimate, with its filter."""
    sensors: Sensors
    """Samples of a tick."""
    reduced: ReducedFilter
    """The filter with the plant and the noise that it was made for."""
    weight: float
    """Factor of the noise that stands for what the filter leaves out, the least with which the full loop is stable."""
    judged: Judged
    """Full plant, filter and gain."""
    without: dict[str, float]
    """Abscissa of the whole loop where a marker, or all samples but those of the hand, never arrive [1/s]."""
    seen: Seen | None
    """Modes of the filter as the markers see them; None without markers."""
    full: FullFilter | None
    """Kalman filter of the full tissue from the markers; None without markers, or where it was not found."""
    missing: str
    """Why there is no filter of the full tissue; empty where there is one, or no marker."""
    sd_full: Array | None
    """Standard deviation of the outputs, relative to the hand, by the full filter [m, rad], (o,)."""
    loop: ModalLoop
    """All modes of the plant; the lowest above :data:`softgrasp.lqr.spectrum.modal_loop.DENSE_LIMIT` unknowns."""
    ticks: Ticks
    """The full plant in them, from tick to tick."""


def require_observable(model: Model) -> None:
    """Raises ControlError: the scene has no observer, whatever its gain."""
    layout, control = model.system.layout, control_of(model)
    needed = why_no_rest(model.system) if layout.n_e > DENSE_LIMIT else ""
    if needed:
        raise ControlError(
            f"above {DENSE_LIMIT} unknowns an observer is checked for {needed}; this scene has {layout.n_e}: use a "
            "coarser mesh"
        )
    if layout.n_e > DENSE_LIMIT and control.constraints is not None:
        raise ControlError(
            f"a plan with control.observer knows all modes of the plant, at most {DENSE_LIMIT}; this scene has "
            f"{layout.n_e}: use a coarser mesh, or leave out control.observer or control.constraints"
        )
    if control.method == "modal":
        raise ControlError("an observer needs the optimal gain of the whole plant; leave out control.method = 'modal'")
    if control.loop.delay:
        raise ControlError("control.loop.delay and an observer exclude each other; give control.observer.delay instead")


def observe(design: Design, watch: Stopwatch) -> ObservedControl:
    """Filter, controller and judgement of a scene. Collective.

    The gain is the optimal one on states of the filter's form. Where the full loop is not stable, the filter trusts the
    markers less, see :data:`WEIGHTS`.

    Args:
        design: the optimal feedback of the scene.
        watch: records the seconds of "full filter" and "observer".

    Raises ControlError: the plant has no observer, or none that leaves the full plant stable.
    """
    problem, given, loop_of = design.problem, control_of(design.model).observer, control_of(design.model).loop
    assert given is not None
    require_observable(design.model)
    noise = Noise(given.noise.pose, given.noise.speed, given.noise.marker, given.noise.force)
    sensors = make_sensors(problem, given.markers, noise)
    acting = given.disturbance
    disturbance = make_disturbance(problem, acting.hand, acting.load, acting.box)
    period = 1 / loop_of.rate
    full, sd_full, missing = None, None, ""
    if given.markers:
        with watch.stage("full filter"):
            try:
                full = full_filter(problem, sensors, disturbance, period)
                sd_full = full.sd_of(problem, problem.C_z)
            except (ControlError, SolverError) as error:  # the filter that runs does without it
                missing = str(error)
    with watch.stage("observer"):
        whole = problem.layout.n_e <= DENSE_LIMIT
        loop = ModalLoop(problem, DENSE_LIMIT if whole else FEW)
        rest = None if whole else rest_of(problem, loop, sensors, period)
        ticks = make_ticks(problem, loop, sensors, disturbance, period)

        def candidate(weight: float, kept: NDArray[np.int64] | None = None) -> _Candidate:
            reduced = reduced_filter(
                problem, loop.plant, sensors, disturbance, given.N, period, given.delay, weight, kept
            )
            controller = _controller(design, reduced, period)
            judged = judge(problem, design.solution, loop, ticks, disturbance, controller, rest)
            return _Candidate(weight, reduced, controller, judged)

        for weight in WEIGHTS:
            found = candidate(weight)
            if found.judged.stable:
                break
        else:
            small = found.judged.small_gain
            why = f"abscissa {found.judged.abscissa:.3g}/s"
            if found.judged.abscissa < 0:
                why = f"small gain {small:.2g}, not below {SAFE:g}, with the modes that were left out"
            raise ControlError(
                f"no observer of {given.N} states leaves the full plant stable, the last one has the {why}; raise "
                "control.observer.N, or lower control.Q for a slower loop"
            )
        if not found.judged.fast:
            found = _with_other_modes(problem, found, candidate, ticks)
        controller = found.controller
        without = on_root(problem.layout.comm, lambda: _without(ticks, controller, sensors))
        seen = seen_modes(problem, loop.plant, sensors, found.reduced.kept, period) if given.markers else None
    return ObservedControl(
        controller, sensors, found.reduced, found.weight, found.judged, without, seen, full, missing, sd_full, loop,
        ticks,
    )  # fmt: skip


@dataclass(frozen=True)
class _Candidate:
    """A filter, judged on the full plant."""

    weight: float  # factor of the noise that stands for what the filter leaves out
    reduced: ReducedFilter  # the filter on its own plant
    controller: Controller  # gain and filter
    judged: Judged  # their loop with the full plant


def _with_other_modes(
    problem: RiccatiProblem, found: _Candidate, candidate: Callable[..., _Candidate], ticks: Ticks
) -> _Candidate:
    """With the slowest mode of the full loop in the place of another, until it is as fast as with the state known.

    Then with less noise for what is left out, where that is cheaper and as fast. Collective.
    """
    for _ in range(SWAPS):
        kept, controller = found.reduced.kept, found.controller
        slow = on_root(problem.layout.comm, partial(slowest_mode, ticks, controller))
        if found.judged.fast or slow in kept:
            break
        every = [candidate(found.weight, np.append(np.delete(kept, i), slow)) for i in range(len(kept))]
        best = min(every, key=lambda other: other.judged.abscissa)
        if not best.judged.stable or best.judged.abscissa >= found.judged.abscissa:
            break
        found = best
    less = candidate(LESS * found.weight, found.reduced.kept)
    return less if less.judged.fast and less.judged.cost < found.judged.cost else found


def _controller(design: Design, reduced: ReducedFilter, period: float) -> Controller:
    """The optimal gain on the states of a filter. Collective."""
    problem, scene, plant = design.problem, design.model.scene, reduced.plant
    x_bar, u_bar = plant.rest_at(design.target.state.q_s)
    return Controller(
        reduced.shapes.reduce_gain(problem, design.gain), x_bar, u_bar, plant, period,
        design.actuation.bound(problem.layout.n_s), scene_hash(scene), layout_hash(problem.layout),
        {"scene": scene.name, "method": "optimal gain on an estimate", "N": plant.N}, reduced.filter,
    )  # fmt: skip


def _without(ticks: Ticks, controller: Controller, sensors: Sensors) -> dict[str, float]:
    """Abscissa where one marker, or all samples but those of the hand, never come. Not collective."""
    index, count = np.arange(len(sensors.sd)), len(sensors.nodes)
    groups = {"all but the hand": index >= sensors.markers.start}
    if 1 < count <= ONE_BY_ONE:
        each = np.split(index[sensors.markers], count)
        groups |= {f"marker {i + 1}": np.isin(index, rows) for i, rows in enumerate(each)}
    return {name: abscissa_without(ticks, controller, lost) for name, lost in groups.items()}
