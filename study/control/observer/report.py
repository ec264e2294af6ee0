"""The part of a page about an observer: what it measures, what the loop with it does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from softgrasp.fem.shown import counted, percent
from softgrasp.lqr.observer.seen import STILL, Seen
from softgrasp.lqr.spectrum.sampled import SAFE
from softgrasp.study.control.observer.result import ObservedStudy
from softgrasp.study.report.document import Section, in_words

SAMPLES = ("sample", "standard deviation", "with what the filter leaves out")
MODES = ("mode", "frequency [Hz]", "largest motion of a marker [%]", "hidden by the noise below [mm]")
SEEN = (
    f"A marker sees a mode where it moves by {percent(STILL)} of the node that moves most, or more. Free swings of "
    "that node below the last column are hidden by the noise of all markers together."
)
OUTPUTS = ("output", "estimate [m, rad]", "by the full filter [m, rad]", "from the target [m, rad]")


def observer_sections(study: ObservedStudy) -> list[Section]:
    """Loop, samples and outputs."""
    found = study.observed
    own = np.sqrt(np.diag(found.reduced.V))
    samples = list(zip(found.sensors.names, found.sensors.sd.tolist(), own.tolist(), strict=True))
    full = [None] * len(study.names) if found.sd_full is None else found.sd_full.tolist()
    outputs = list(
        zip(study.names, found.judged.sd_error.tolist(), full, found.judged.sd_outputs.tolist(), strict=True)
    )
    text = (
        "Standard deviations under the disturbances of the scene, for ever: of the estimate in the loop, of the best "
        "estimate from the markers alone of a tissue whose hand is known, and of the output from its target."
    )
    seen = [] if found.seen is None else [modes_section(found.seen)]
    return [
        Section("Observer", sentence(study), rows=list(facts(study)), terminal=True),
        *seen,
        Section("Outputs under disturbances", text, header=OUTPUTS, rows=outputs),
        Section("Samples", "Standard deviation of one sample.", header=SAMPLES, rows=samples),
    ]


def modes_section(seen: Seen) -> Section:
    """Which modes of the filter the markers see."""
    words: list[str] = []
    rows: list[tuple[int, float, float, float | None]] = []
    for i, mode in enumerate(seen.modes.tolist()):
        blind, hidden = seen.blind(i), float(seen.hidden[i])
        by = "any marker" if len(blind) == len(seen.names) else in_words(blind)
        if blind:
            words.append(f"Mode {mode + 1} ({seen.frequency[i]:.3g} Hz) is not seen by {by}.")
        share = 100 * float(seen.share[:, i].max())
        rows.append((mode + 1, float(seen.frequency[i]), share, 1e3 * hidden if np.isfinite(hidden) else None))
    text = " ".join(words) or "Every marker sees every mode of the filter along every axis."
    return Section("Modes that the markers see", f"{text} {SEEN}", header=MODES, rows=rows, terminal=bool(words))


def sentence(study: ObservedStudy) -> str:
    """What came out."""
    judged, N, loop = study.observed.judged, study.observed.reduced.plant.N, study.observed.loop
    of = "" if loop.complete else f" of the lowest {len(loop.plant.omega)} modes"
    proof = ""
    if not loop.complete:
        proof = f" The other modes leave it stable: their small gain, {judged.small_gain:.2g}, is below {SAFE:g}."
    return (
        f"The full plant under the observer of {N} states is stable: its abscissa{of} is {judged.abscissa:.4g} 1/s, "
        f"with the state known {judged.abscissa_known:.4g} 1/s.{proof} With the disturbances the cost is "
        f"{percent(judged.excess)} above the least."
    )


def facts(study: ObservedStudy) -> Iterator[tuple[str, str]]:
    """Label and text."""
    found, filter_ = study.observed, study.observed.reduced.filter
    markers, late = len(found.sensors.nodes), filter_.delay
    kinds = [counted(markers, "marker")] * (markers > 0) + ["the force on the hand"] * (
        len(found.sensors.sd) > found.sensors.markers.stop
    )
    yield "measured", in_words(["the hand's velocity and pose" if filter_.speed else "the hand's pose", *kinds])
    yield (
        "samples",
        f"{len(filter_.names)} a tick of {1e3 * found.controller.period:g} ms"
        + (f", {counted(late, 'tick')} late" if late else ""),
    )
    if found.weight > 1:
        yield "noise of what is left out", f"{found.weight:g} times the estimate: with less the full loop is not stable"
    for name, value in found.without.items():
        kept = "with the hand's samples alone" if name == "all but the hand" else f"without {name}"
        of = "" if found.loop.complete else " of the lowest modes, no bound on the others"
        yield f"abscissa {kept}", f"{value:.4g} 1/s{of}" + ("" if value < 0 else ": not stable")
    if found.full is not None and study.sd_nodes is not None:
        solution, (low, middle, high) = found.full.solution, study.sd_nodes
        yield (
            "full Kalman filter",
            (f"rank {solution.rank}, {solution.counts['solves']} solves, true residual {solution.residual:.1e}"),
        )
        yield "its deviation at a node", f"{low:.2g} to {high:.2g} m, median {middle:.2g} m"
    if found.missing:
        yield "full Kalman filter", f"none: {found.missing}"
    yield "time of a tick", f"{1e6 * study.tick:.2g} us in Python"
