"""The page of ``softgrasp identify --suggest-markers``: markers, motions, and the errors that each would give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem import PictureMesh, note
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.reduction.identify.suggest import MotionPlan, SuggestedMarkers, place
from softgrasp.study.report import Section, Share, Table, captioned, in_words
from softgrasp.study.shell import Session
from softgrasp.study.shell.session import Page

CAPTIONS = {
    "markers.png": "Candidates on the boundary by the size of the errors that each would give alone (mean semi-axis "
    "of their ellipsoid), and the chosen markers in the order of what they add.",
}
MOST_ROWS = 10  # candidates on the page
BARS = "Standard deviations by the noise, of all parameters fitted together, with the markers up to that line."


def compose(answer: SuggestedMarkers, picture: PictureMesh | None, session: Session, options: str) -> Page:
    """Draw the picture and compose the page."""
    drawn: list[Path] = []
    if session.pictures and picture is not None:
        from softgrasp.study.identify.suggest.plots import draw  # brings Matplotlib

        drawn += draw(answer, picture, session.out)
    scene = session.out / "markers.toml"
    note(scene)
    scene.write_text(resolved_toml(answer.scene))
    sections = [
        Section("", figures=captioned(drawn, CAPTIONS)),
        marker_table(answer).section(BARS, terminal=True),
        motion_table(answer).section(
            "Ranked by the size of the errors with the motion's own markers, the mean semi-axis of their ellipsoid; "
            "beside it what the outputs of the scene would give.",
            terminal=True,
        ),
        candidate_table(answer, MOST_ROWS).section(
            "The best candidates, each as the only marker, by the size of the errors; candidates.csv has all."
        ),
    ]
    return Page(
        f"{answer.scene.name}: where to put markers", summary(answer), sections,
        {"markers.csv": marker_table(answer), "candidates.csv": candidate_table(answer)}, [*drawn, scene], options,
    )  # fmt: skip


def _finite(x: float) -> Share | str:
    return Share(x) if np.isfinite(x) else "not seen"


def _bars(deviation: Any) -> list[Share | str]:
    return [_finite(float(s)) for s in deviation]


def axes(answer: SuggestedMarkers) -> list[str]:
    """Headings of coordinates."""
    return [f"{axis} [m]" for axis in "xyz"[: answer.points.shape[1]]]


def marker_table(answer: SuggestedMarkers) -> Table:
    """The chosen markers with the errors so far."""
    rows = [
        (f"m{j + 1}", *(float(c) for c in x), *_bars(deviation))
        for j, (x, deviation) in enumerate(zip(answer.best, answer.motions[0].deviations, strict=True))
    ]
    return Table(("marker", *axes(answer), *(u.name for u in answer.unknowns)), rows, "Markers")


def motion_table(answer: SuggestedMarkers) -> Table:
    """The motions, the best first, each with its own best markers."""
    rows = [
        (
            motion_words(plan),
            "not seen" if plan.hidden else Share(plan.size),
            *_bars(plan.deviations[-1]),
            *_bars(plan.own),
            " ".join(place(answer.points[i]) for i in plan.chosen),
        )
        for plan in answer.motions
    ]
    names = [u.name for u in answer.unknowns]
    header = ("motion", "size", *names, *(f"{name}, scene's outputs" for name in names), "markers [m]")
    return Table(header, rows, "Motions")


def motion_words(plan: MotionPlan) -> str:
    """What a motion changes in the scene's."""
    return ", ".join(f"{key} = {value}" for key, value in plan.motion.items()) or "the scene's"


def candidate_table(answer: SuggestedMarkers, most: int | None = None) -> Table:
    """The candidates, the best first, with the errors that each gives alone; ``most``: no more of them."""
    plan = answer.motions[0]
    seen = np.isfinite(plan.by_one).all(axis=1)
    order = np.lexsort((np.where(seen, plan.alone, np.inf), ~seen))[:most]
    rows = [
        (
            *(float(c) for c in answer.points[i]),
            Share(float(plan.alone[i])) if seen[i] else "not seen",
            *_bars(plan.by_one[i]),
        )
        for i in order
    ]
    return Table((*axes(answer), "size", *(u.name for u in answer.unknowns)), rows, "Candidates")


def summary(answer: SuggestedMarkers) -> list[str]:
    """What to do, in some sentences."""
    best, own = answer.motions[0], answer.motions[0].own
    if best.hidden:
        return [
            f"No motion lets these markers determine {in_words(best.hidden)}: fit fewer parameters, or move otherwise."
        ]
    ratio = float(np.exp(np.log(own / best.deviations[-1]).mean())) if np.isfinite(own).all() else np.inf
    moved = f" under the motion {motion_words(best)}" if len(answer.motions) > 1 else ""
    gain = f", {ratio:.2g} times smaller than those of the scene's outputs" if np.isfinite(ratio) else ""
    return [
        f"{len(best.chosen)} markers{moved} would give errors by the noise of "
        f"{answer.words(best.deviations[-1])}{gain}.",
        "markers.toml is the scene with these outputs. The errors hold near the scene's material; mesh, time step and "
        "reduction come on top, which a fit reports.",
    ]


def result_of(answer: SuggestedMarkers) -> dict[str, Any]:
    """The keys of ``result.json``."""
    names = [u.name for u in answer.unknowns]

    def bars(deviation: Any) -> dict[str, float | None]:
        return {n: float(s) if np.isfinite(s) else None for n, s in zip(names, deviation, strict=True)}

    return {
        "values": dict(zip(names, answer.values.tolist(), strict=True)),
        "motions": [
            {
                "motion": plan.motion,
                "markers": [
                    {"point": answer.points[i].tolist(), "deviations": bars(s)}
                    for i, s in zip(plan.chosen, plan.deviations, strict=True)
                ],
                "outputs": bars(plan.own),
                "size": None if plan.hidden else plan.size,
            }
            for plan in answer.motions
        ],
        "candidates": len(answer.points),
        "unseen": list(answer.motions[0].hidden),
    }
