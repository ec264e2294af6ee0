"""Answers out of a work-precision study: the cheapest setting within a tolerance, the most accurate within a budget."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.fit import usable
from softgrasp.study.precision.forward import SAFETY, Prediction, Predictor, setting_of, to_point
from softgrasp.study.precision.full import FullRuns
from softgrasp.study.precision.points import Row, Setting, WorkPoint
from softgrasp.study.precision.reduced import ReducedRuns
from softgrasp.study.precision.reference import Reference
from softgrasp.study.report.files import plain

TRIES = 4  # settings that are run to check a prediction
MARGIN = 0.75  # of the tolerance that the full run behind a reduced model may use
SNAPSHOTS = 1.5e8  # entries of the snapshots behind a reduced model
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
MORE = 3  # reduced dimensions tried beyond the predicted one


def parse_budget(text: str) -> float:
    """Seconds of a time such as ``1ms``, ``500us`` or ``0.01s``. Not collective.

    Raises:
        SceneError: anything else.
    """
    match = re.fullmatch(r"([0-9.]+(?:e[+-]?[0-9]+)?)\s*([a-zµμ]+)", text.strip())
    try:
        value = float(match[1]) * UNITS[match[2]] if match is not None else 0.0
    except (ValueError, KeyError):
        value = 0.0
    if not 0 < value < float("inf"):
        raise SceneError(f"--budget {text}: it must be a time > 0 with its unit, such as 1ms, 500us or 0.01s")
    return value


def parse_tolerance(text: str | float) -> float:
    """A relative tolerance such as ``1e-3``. Not collective.

    Raises:
        SceneError: it is no number between 0 and 1.
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise SceneError(f"--tolerance {text}: it must be a number between 0 and 1, such as 1e-3")
    return value


@dataclass(frozen=True)
class Answer:
    """What was asked and found.

    Attributes:
        kind: "tolerance" or "budget".
        asked: the tolerance [1] or the budget [s].
        met: something meets it.
        sentences: the answer in words.
        found: by kind of model, "full" and "reduced": setting, predicted and measured numbers.
        closest: when nothing meets it.
    """

    kind: str
    asked: float
    met: bool
    sentences: tuple[str, ...]
    found: dict[str, Row] = field(default_factory=dict)
    closest: Row | None = None

    def to_dict(self) -> Row:
        """For JSON. Not collective."""
        return {
            "kind": self.kind, "asked": self.asked, "met": self.met, "sentences": list(self.sentences),
            **self.found, "closest": self.closest,
        }  # fmt: skip


def seconds_text(value: float | None) -> str:
    """A time with a fitting unit. Not collective."""
    if value is None:
        return "-"
    for unit, factor in (("s", 1.0), ("ms", 1e-3)):
        if value >= 0.9995 * factor:
            return f"{value / factor:.3g} {unit}"
    return f"{value / 1e-6:.3g} us"


def advice(shares: Row, details: Row) -> str:
    """What to refine first: that which carries the largest share of an error. Not collective.

    Args:
        shares: of space, time and maybe reduction.
        details: cells and order of the mesh.
    """
    largest = max(shares, key=lambda name: float(shares[name]))
    better = {
        "space": ("a finer mesh, tissue.cells" if details["cells"] else "a finer mesh file")
        + (", or tissue.order = 2" if details["order"] == 1 else ""),
        "time": "more time.steps",
        "reduction": "a larger N, reduction.N",
    }[largest]
    parts = ", ".join(f"{name} {value:.1e}" for name, value in shares.items())
    return f"Of its error, {largest} carries the largest share ({parts}): {better} would help first."


class Asker:
    """Answers for one study; ``tried`` are the points that were measured for them. Its methods are collective.

    Args:
        scene: the study's scene.
        runs: of the full model.
        truth: reference solution.
        forward, reduced: points of the diagrams.
    """

    def __init__(
        self, scene: Scene, runs: FullRuns, truth: Reference, forward: list[WorkPoint], reduced: list[WorkPoint]
    ) -> None:
        self.scene, self.runs, self.truth = scene, runs, truth
        self.forward, self.reduced = forward, reduced
        self.predictor = Predictor(scene, forward)
        self.tried: list[WorkPoint] = []

    def meets(self, point: WorkPoint, tolerance: float) -> bool:
        """Whether a measured error holds with the error of the reference on top."""
        return point.ok and self.truth.range_of(point.error)[1] <= tolerance

    def measure(self, setting: Setting) -> WorkPoint:
        """Run a setting that the diagram does not hold."""
        point = to_point(setting, self.runs.run(setting), self.runs, self.truth)
        self.tried.append(point)
        return point

    def cheapest(self, tolerance: float) -> tuple[Prediction, WorkPoint] | None:
        """The cheapest full run within a tolerance, predicted and then measured; None when nothing meets it."""
        held: list[tuple[Prediction, WorkPoint]] = []
        runs = 0
        room = tolerance - self.truth.error
        for found in sorted(self.predictor.candidates(), key=lambda p: (p.seconds, p.error)):
            if held and found.seconds > min(point.seconds for _, point in held):
                break
            if found.point is not None:
                if self.meets(found.point, tolerance):
                    held.append((found, found.point))
            elif found.error <= SAFETY * room and runs < TRIES and self.predictor.affordable(found):
                runs += 1
                point = self.measure(found.setting)
                if self.meets(point, tolerance):
                    held.append((found, point))
        return min(held, key=lambda pair: pair[1].seconds) if held else None

    def beyond(self, tolerance: float) -> Prediction | None:
        """The cheapest setting that is predicted to meet a tolerance but too large to be tried."""
        room = SAFETY * (tolerance - self.truth.error)
        large = [p for p in self.predictor.candidates() if p.error <= room and not self.predictor.affordable(p)]
        return min(large, key=lambda p: p.seconds, default=None)

    # --- reduced models

    def small(self, tolerance: float) -> tuple[Row, WorkPoint] | None:
        """The fastest reduced model within a tolerance, prediction and point; None when nothing tried meets it."""
        held = [({"error": p.error, "seconds": p.seconds}, p) for p in self.reduced if self.meets(p, tolerance)]
        if not held:
            full = self.cheapest(MARGIN * tolerance) or self.cheapest(tolerance)
            if full is not None and self._fits(full[1]):
                held = self._on(full[0].setting, full[1], tolerance)
        return min(held, key=lambda pair: pair[1].seconds) if held else None

    def _fits(self, full: WorkPoint) -> bool:
        return bool(2 * full.details["n_e"] * full.details["steps"] <= SNAPSHOTS)

    def _on(self, setting: Setting, full: WorkPoint, tolerance: float) -> list[tuple[Row, WorkPoint]]:
        """Reduced models of the two fastest bases on another mesh; N as the scene's own mesh predicts it."""
        room = tolerance - self.truth.error - full.error
        wanted: dict[str, WorkPoint] = {}
        for p in sorted(usable(self.reduced), key=lambda p: p.seconds):
            if p.details["error_outputs_full"] <= SAFETY * room and p.series not in wanted:
                wanted[p.series] = p
        found = []
        reduced = ReducedRuns(self.scene, setting, self.runs, self.truth)
        row = self.runs.run(setting)
        for name, expected in sorted(wanted.items(), key=lambda pair: pair[1].seconds)[:2]:
            N = expected.details["N"]
            sizes = [n for n in sorted(self.scene.reduction.N) if n >= N][: MORE + 1]
            points = reduced.points(name, sizes, row)
            self.tried += points
            predicted = {"error": full.error + expected.details["error_outputs_full"], "seconds": expected.seconds}
            found += [(predicted, p) for p in points if self.meets(p, tolerance)]
        return found

    def _finer(self, budget: float) -> list[WorkPoint]:
        """The two bases nearest to the full run within a budget, on the most accurate mesh of the diagram."""
        full = min((p for p in usable(self.forward) if self._fits(p)), key=lambda p: p.error, default=None)
        fit = [p for p in usable(self.reduced) if p.details["p99"] is not None and p.details["p99"] <= budget]
        if full is None or not fit or full.error >= min(p.error for p in fit):
            return []
        best: dict[str, WorkPoint] = {}
        for p in sorted(fit, key=lambda p: p.details["error_outputs_full"]):
            best.setdefault(p.series, p)
        setting = setting_of(full)
        reduced, row = ReducedRuns(self.scene, setting, self.runs, self.truth), self.runs.run(setting)
        points = [q for name, p in list(best.items())[:2] for q in reduced.points(name, [p.details["N"]], row)]
        self.tried += points
        return points

    # --- answers

    def tolerance(self, tolerance: float) -> Answer:
        """The cheapest setting within a relative tolerance of the outputs.

        Raises:
            SolverError: a run failed.
        """
        words, found = [], {}
        full = self.cheapest(tolerance)
        small = self.small(tolerance) if self.reduced else None
        if full is not None:
            found["full"] = self.row(full[1], full[0].error, full[0].seconds)
            words.append(
                f"Cheapest full run within {tolerance:g}: {full[1].label}: predicted error {full[0].error:.1e} in "
                f"{seconds_text(full[0].seconds)}, measured {full[1].error:.1e} of the deformation "
                f"({full[1].details['error_displacement']:.1e} of the displacement) in {seconds_text(full[1].seconds)}."
            )
        if small is not None:
            predicted, point = small
            found["reduced"] = self.row(point, predicted["error"], predicted["seconds"])
            words.append(
                f"For many runs: {point.label}: predicted error {predicted['error']:.1e} in "
                f"{seconds_text(predicted['seconds'])} a run, measured {point.error:.1e} in "
                f"{seconds_text(point.seconds)}; from nothing, with the full run behind it, "
                f"{seconds_text(point.details['scratch'])}."
            )
        closest = None
        if not found:
            closest, more = self._missed(tolerance)
            words += more
        elif self.reduced and small is None:
            words.append("No reduced model that was tried meets it.")
        words.append(
            f"Errors are those of the deformation, the outputs against the hand, over the largest such output. The "
            f"reference's own error, {self.truth.error:.1e}, is added to every measured one before comparing."
        )
        words += self._against_own_mesh(tolerance)
        return Answer("tolerance", tolerance, bool(found), tuple(words), found, closest)

    def _missed(self, tolerance: float) -> tuple[Row, list[str]]:
        """What came closest, and what would be needed."""
        every = [*usable(self.forward), *usable(self.reduced), *usable(self.tried)]
        best = min(every, key=lambda p: p.error)
        words = [
            f"Nothing tried meets {tolerance:g}; closest is {best.label} with the error {best.error:.1e}, give or take "
            f"{self.truth.error:.1e}, in {seconds_text(best.seconds)}."
        ]
        words.append(advice(self.shares(best), best.details))
        if self.truth.error >= tolerance:
            part = self.truth.largest_part
            words.append(
                "The reference itself is not known that well, so that nothing can be shown to meet it: most of its "
                f"own error is the {part} part, and would need {self.truth.need}."
            )
        else:
            large = self.beyond(tolerance)
            if large is not None:
                words.append(
                    f"Predicted to meet it, but too large to be tried here: {large.setting.label}, error "
                    f"{large.error:.1e} in {seconds_text(large.seconds)}."
                )
        return self.row(best), words

    def shares(self, point: WorkPoint) -> Row:
        """About how much of a point's error space, the time step and the reduced model carry. Not collective.

        What the reference does not know about space counts with space.
        """
        d = point.details
        cells = None if d["cells"] is None else tuple(d["cells"])
        predict = self.predictor
        space = predict.space_error((cells, d["order"])) + self.truth.space[0]
        parts = {"space": space, "time": predict.time_error(d["steps"])}
        return parts | ({"reduction": d["error_outputs_full"]} if point.question == "reduced" else {})

    def row(self, point: WorkPoint, error: float | None = None, seconds: float | None = None) -> Row:
        """A setting with its predicted and measured numbers, and the ``--set`` that repeat it. Not collective."""
        d: dict[str, Any] = point.details
        names = ("cells", "order", "steps", "solver", "method", "N")
        measured = ("error_deformation", "error_displacement", "error_range", "p50", "p99", "max", "scratch",
                    "per_step", "error_outputs_full", "error_full")  # fmt: skip
        sets = setting_of(point).overrides
        if self.runs.reference is not None:
            sets.append(f"hand.reference={self.runs.reference}")  # the default moves a little with the mesh
        if point.question == "reduced":
            sets += [f"reduction.methods=['{d['method']}']", f"reduction.N=[{d['N']}]"]
        row: Row = plain(
            {
                "label": point.label,
                "command": "reduce" if point.question == "reduced" else "simulate",
                "setting": {k: d[k] for k in names if d.get(k) is not None},
                "set": sets,
                "predicted": None if error is None else {"error": error, "seconds": seconds},
                "measured": {"error": point.error, "seconds": point.seconds, **{k: d[k] for k in measured if k in d}},
                "shares": self.shares(point),
            }
        )
        return row

    def _against_own_mesh(self, tolerance: float) -> list[str]:
        """The paper's question: the fastest reduced model of the scene's own mesh against its own full run."""
        good = [p for p in usable(self.reduced) if p.details["error_outputs_full"] <= tolerance]
        if not good:
            return []
        p = min(good, key=lambda p: p.seconds)
        return [
            f"Against the full run on the scene's own mesh alone, whose error is not counted then, {p.label} has the "
            f"error {p.details['error_outputs_full']:.1e} in {seconds_text(p.seconds)} a run."
        ]

    def budget(self, seconds: float) -> Answer:
        """The most accurate setting whose steps fit a budget: 99 % of them have to.

        Reduced models of the most accurate mesh are tried as well, since their steps do not get slower with the mesh.

        Raises:
            SolverError: a run failed.
        """
        words, found = [], {}
        for kind, points in (("full", self.forward), ("reduced", [*self.reduced, *self._finer(seconds)])):
            timed = [p for p in usable(points) if p.details.get("p99") is not None]
            fit = [p for p in timed if p.details["p99"] <= seconds]
            if fit:
                best = min(fit, key=lambda p: (p.error, p.details["p99"]))
                found[kind] = self.row(best)
                words.append(f"{_name(kind)} within {seconds_text(seconds)} a step: {best.label}: {_step_words(best)}.")
            elif timed:
                best = min(timed, key=lambda p: p.details["p99"])
                words.append(
                    f"No {_name(kind).lower()} fits {seconds_text(seconds)}; "
                    f"nearest is {best.label}: {_step_words(best)}."
                )
        timed = [p for p in [*self.forward, *self.reduced] if p.details.get("p99") is not None]
        closest = None if found or not timed else self.row(min(timed, key=lambda p: p.details["p99"]))
        over = [k for k, row in found.items() if row["measured"]["max"] > seconds]
        if over:
            words.append(
                f"Single steps of the {' and '.join(over)} model took longer than the line; on a robot, give the "
                "loop a core of its own."
            )
        return Answer("budget", seconds, bool(found), tuple(words), found, closest)


def _name(kind: str) -> str:
    return "Full run" if kind == "full" else "Reduced model"


def _step_words(point: WorkPoint) -> str:
    d = point.details
    times = ", ".join(f"{name} {seconds_text(d[name])}" for name in ("p50", "p99", "max"))
    return f"error {point.error:.1e}, step {times}"
