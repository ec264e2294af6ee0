"""Answers out of a work-precision study: the cheapest setting within a tolerance, the most accurate within a budget."""

from __future__ import annotations

import re
from collections.abc import Sequence

from softgrasp.fem import SceneError
from softgrasp.study.precision.fit import series_of, usable
from softgrasp.study.precision.forward import to_point
from softgrasp.study.precision.full import FullRuns
from softgrasp.study.precision.points import ForwardPoint, ReducedPoint, RunPoint
from softgrasp.study.precision.predict import SAFETY, Prediction, Predictor
from softgrasp.study.precision.reduced import ReducedRuns
from softgrasp.study.precision.result import Answer, Choice, ReferenceSolution
from softgrasp.study.precision.settings import Setting
from softgrasp.study.report import percent, seconds_text

TRIES = 4  # settings that are run to check a prediction
LUCK = 1.5  # times the tolerance: where more is predicted, errors of mesh and steps only cancel each other
MARGIN = 0.75  # of the tolerance that the full run behind a reduced model may use
SNAPSHOTS = 1.5e8  # entries of the snapshots behind a reduced model
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
MORE = 3  # reduced dimensions tried beyond the predicted one


def parse_budget(text: str) -> float:
    """Seconds of a time such as ``1ms``, ``500us`` or ``0.01s``.

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


def advice(shares: dict[str, float]) -> str:
    """What to refine first: that of space, time and maybe reduction which carries the largest share of an error."""
    largest = max(shares, key=lambda name: shares[name])
    better = {
        "space": "a smaller tissue.refine.tolerance",
        "time": "more time.steps",
        "reduction": "a larger N, reduction.N",
    }[largest]
    parts = ", ".join(f"{name} {percent(value)}" for name, value in shares.items())
    return f"Of its error, {largest} carries the largest share ({parts}): {better} would help first."


class Answers:
    """Answers for one study; ``measured`` are the points that were made for them. Its methods are collective."""

    def __init__(
        self, runs: FullRuns, truth: ReferenceSolution, forward: Sequence[ForwardPoint], reduced: Sequence[ReducedPoint]
    ) -> None:
        self.scene, self.runs, self.truth = runs.scene, runs, truth
        self.forward, self.reduced = forward, reduced
        self.predictor = Predictor(runs.scene, forward, runs.dimension)
        self.measured: list[RunPoint] = []

    def meets(self, point: RunPoint, tolerance: float) -> bool:
        """Whether a measured error holds with the error of the reference on top."""
        return point.ok and self.truth.range_of(point.error)[1] <= tolerance

    def measure(self, setting: Setting) -> ForwardPoint:
        """Run a setting that the diagram does not hold."""
        point = to_point(setting, self.runs.run(setting), self.truth)
        self.measured.append(point)
        self.predictor.learn(point)
        return point

    def cheapest(self, tolerance: float) -> tuple[Prediction, ForwardPoint] | None:
        """The cheapest full run within a tolerance, predicted and then measured; None when nothing meets it.

        Settings are run in the order of their predicted time, and predicted anew after each, until one meets it.
        """
        room = SAFETY * (tolerance - self.truth.error)
        for runs in range(TRIES + 1):
            predictions = sorted(self.predictor.candidates(), key=lambda p: (p.seconds, p.error))
            held = [(p, p.point) for p in predictions if p.point is not None and self.meets(p.point, tolerance)]
            held = [(p, point) for p, point in held if p.error <= LUCK * tolerance]
            best = min(held, key=lambda pair: pair[1].seconds, default=None)
            untried = (p for p in predictions if p.point is None and p.error <= room and self.predictor.affordable(p))
            first = next(untried, None)
            if first is None or runs == TRIES or (best is not None and best[1].seconds <= first.seconds):
                return best
            point = self.measure(first.setting)
            if self.meets(point, tolerance):  # cheap as predicted, or the prediction was too large
                return (first, point) if best is None or point.seconds <= best[1].seconds else best
        return None

    def too_large(self, tolerance: float) -> Prediction | None:
        """The cheapest setting that is predicted to meet a tolerance but too large to be tried."""
        room = SAFETY * (tolerance - self.truth.error)
        large = [p for p in self.predictor.candidates() if p.error <= room and not self.predictor.affordable(p)]
        return min(large, key=lambda p: p.seconds, default=None)

    # --- reduced models

    def fastest_model(self, tolerance: float) -> Choice | None:
        """The fastest reduced model within a tolerance; None when nothing tried meets it."""
        held = [self.choice(p, (p.error, p.seconds)) for p in self.reduced if self.meets(p, tolerance)]
        if not held:
            full = self.cheapest(MARGIN * tolerance) or self.cheapest(tolerance)
            if full is not None and _fits(full[1]):
                held = self._models_on(full[0].setting, full[1], tolerance)
        return min(held, key=lambda choice: choice.point.seconds) if held else None

    def _models_on(self, setting: Setting, full: ForwardPoint, tolerance: float) -> list[Choice]:
        """Reduced models of the fastest basis on another mesh, or the second; N as the scene's own mesh predicts it."""
        room = tolerance - self.truth.error - full.error
        fit = [p for p in usable(self.reduced) if p.error_outputs_full <= SAFETY * room]
        choices: list[Choice] = []
        reduced = ReducedRuns(setting, self.runs, self.truth)
        for own in _two_bases(fit, "seconds"):
            sizes = [n for n in sorted(self.scene.reduction.N) if n >= own.N][: MORE + 1]
            points = reduced.points(own.series, sizes)
            self.measured += points
            predicted = full.error + own.error_outputs_full, own.seconds
            choices += [self.choice(p, predicted) for p in points if self.meets(p, tolerance)]
            if choices:  # on a large mesh a second basis takes longer than its model can save
                break
        return choices

    def _models_on_the_best_mesh(self, budget: float) -> list[ReducedPoint]:
        """The two bases nearest to the full run within a budget, on the most accurate mesh of the diagram."""
        full = min((p for p in usable(self.forward) if _fits(p)), key=lambda p: p.error, default=None)
        fit = [p for p in usable(self.reduced) if p.p99 <= budget]
        if full is None or not fit or full.error >= min(p.error for p in fit):
            return []
        reduced = ReducedRuns(full.setting, self.runs, self.truth)
        points = [q for p in _two_bases(fit, "error_outputs_full") for q in reduced.points(p.series, [p.N])]
        self.measured += points
        return points

    # --- answers

    def tolerance(self, tolerance: float) -> Answer:
        """The cheapest setting within a relative tolerance of the outputs."""
        words: list[str] = []
        pair = self.cheapest(tolerance)
        full = None if pair is None else self.choice(pair[1], (pair[0].error, pair[0].seconds))
        reduced = self.fastest_model(tolerance) if self.reduced else None
        closest = None
        if full is not None:
            words.append(
                f"The cheapest full run within {percent(tolerance)} is {full.point.label}: by its own measured error, "
                f"{percent(full.point.error)} of the deformation ({percent(full.point.error_displacement)} of the "
                f"displacement), in {seconds_text(full.point.seconds)}; {_prediction(full)}."
            )
        if reduced is not None and isinstance(reduced.point, ReducedPoint):
            point = reduced.point
            words.append(
                f"The fastest model for many runs is {point.label}: measured {percent(point.error)} in "
                f"{seconds_text(point.seconds)} a run; {_prediction(reduced)}. From nothing, with the full run behind "
                f"it, it takes {seconds_text(point.scratch)}."
            )
        if full is None and reduced is None:
            closest, more = self._missed(tolerance)
            words += more
        elif self.reduced and reduced is None:
            words.append("No reduced model that was tried meets it.")
        words.append(
            f"Errors are those of the deformation, the outputs against the hand, over the largest such output. The "
            f"reference's own error, {percent(self.truth.error)}, is added to every measured one before comparing."
        )
        words += self._against_own_mesh(tolerance)
        return Answer("tolerance", tolerance, tuple(words), full, reduced, closest)

    def _missed(self, tolerance: float) -> tuple[Choice, list[str]]:
        """What came closest, and what would be needed."""
        every: list[RunPoint] = [*usable(self.forward), *usable(self.reduced), *usable(self.measured)]
        best = min(every, key=lambda p: p.error)
        words = [
            f"Nothing tried meets {percent(tolerance)}; closest is {best.label} with an error of "
            f"{percent(best.error)}, known to within {percent(self.truth.error)}, in {seconds_text(best.seconds)}."
        ]
        words.append(advice(self.shares(best)))
        large = self.too_large(tolerance)
        if self.truth.error >= tolerance:
            part = self.truth.largest_part
            words.append(
                "The reference itself is not known that well, so that nothing is known to meet it: most of its "
                f"own error is the {part} part, and would need {self.truth.need}."
            )
        elif large is not None:
            words.append(
                f"Predicted to meet it, but too large to be tried here: {large.setting.label}, error "
                f"{percent(large.error)} in {seconds_text(large.seconds)}."
            )
        return self.choice(best), words

    def shares(self, point: RunPoint) -> dict[str, float]:
        """About how much of a point's error space, the time step and the reduced model carry.

        What the reference does not know about space counts with space.
        """
        predict = self.predictor
        space = predict.space_error(point.setting) + self.truth.space[0]
        parts = {"space": space, "time": predict.time_error(point.steps)}
        return parts | ({"reduction": point.error_outputs_full} if isinstance(point, ReducedPoint) else {})

    def choice(self, point: RunPoint, predicted: tuple[float, float] | None = None) -> Choice:
        """A setting with its predicted error and seconds, and the ``--set`` that repeat it."""
        sets = point.setting.overrides(self.scene)
        if self.runs.reference is not None:
            sets.append(f"hand.reference={self.runs.reference}")  # the default moves a little with the mesh
        if isinstance(point, ReducedPoint):
            sets += [f'reduction.methods=["{point.method}"]', f"reduction.N=[{point.N}]"]
        return Choice(point, self.shares(point), tuple(sets), predicted)

    def _against_own_mesh(self, tolerance: float) -> list[str]:
        """The paper's question: the fastest reduced model of the scene's own mesh against its own full run."""
        good = [p for p in usable(self.reduced) if p.error_outputs_full <= tolerance]
        if not good:
            return []
        p = min(good, key=lambda p: p.seconds)
        return [
            f"Against the full run on the scene's own mesh alone, whose error is not counted then, {p.label} has the "
            f"error {percent(p.error_outputs_full)} in {seconds_text(p.seconds)} a run."
        ]

    def budget(self, seconds: float) -> Answer:
        """The most accurate setting whose steps fit a budget: 99 % of them have to.

        Reduced models of the most accurate mesh are tried as well, since their steps do not get slower with the mesh.
        """
        words: list[str] = []
        choices: dict[str, Choice] = {}
        models = [*self.reduced, *self._models_on_the_best_mesh(seconds)]
        groups: dict[str, tuple[str, Sequence[RunPoint]]] = {
            "full": ("full run", self.forward), "reduced": ("reduced model", models),
        }  # fmt: skip
        for kind, (name, points) in groups.items():
            timed = usable(points)
            fit = [p for p in timed if p.p99 <= seconds]
            if fit:
                best = min(fit, key=lambda p: (p.error, p.p99))
                choices[kind] = self.choice(best)
                words.append(
                    f"{name.capitalize()} within {seconds_text(seconds)} a step: {best.label}: {_step_words(best)}."
                )
            elif timed:
                best = min(timed, key=lambda p: p.p99)
                words.append(f"No {name} fits {seconds_text(seconds)}; nearest is {best.label}: {_step_words(best)}.")
        fastest = min((*self.forward, *self.reduced), key=lambda p: p.p99, default=None)
        closest = None if choices or fastest is None else self.choice(fastest)
        over = [kind for kind, choice in choices.items() if choice.point.max > seconds]
        if over:
            words.append(
                f"Single steps of the {' and '.join(over)} model took longer than the budget; on a robot, give the "
                "loop a core of its own."
            )
        return Answer("budget", seconds, tuple(words), choices.get("full"), choices.get("reduced"), closest)


def _fits(full: ForwardPoint) -> bool:
    return 2 * full.n_e * full.steps <= SNAPSHOTS


def _two_bases(points: Sequence[ReducedPoint], attribute: str) -> list[ReducedPoint]:
    """The points with the least of an attribute, of the two bases where it is least."""
    lines = series_of(sorted(points, key=lambda p: getattr(p, attribute)))
    return [line[0] for line in lines.values()][:2]


def _prediction(choice: Choice) -> str:
    error, seconds = choice.predicted or (0.0, 0.0)
    return f"before the run, {percent(error)} in {seconds_text(seconds)} was predicted"


def _step_words(point: RunPoint) -> str:
    times = ", ".join(f"{name} {seconds_text(getattr(point, name))}" for name in ("p50", "p99", "max"))
    return f"error {percent(point.error)}, step {times}"
