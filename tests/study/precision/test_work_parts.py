"""Parts of the study that need no study: meshes, steps, probes, shares of an error, options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.fields.probe import make_probe
from softgrasp.fem.model.build import build
from softgrasp.study.precision import full as wp_full
from softgrasp.study.precision import reference as wp_reference
from softgrasp.study.precision.answer import advice, parse_budget
from softgrasp.study.precision.fit import interpolate, pareto
from softgrasp.study.precision.forward import step_counts
from softgrasp.study.precision.full import find_places, largest
from softgrasp.study.precision.points import Request, WorkPoint
from softgrasp.study.precision.predict import with_shares
from softgrasp.study.precision.result import Source
from softgrasp.study.precision.run import study_scene
from softgrasp.study.precision.settings import (
    FASTEST,
    SLOWEST,
    Setting,
    contraction,
    least_steps,
    variant,
)
from softgrasp.study.shell.options import parse_tolerance
from softgrasp.study.shell.timing import power_law
from tests.helpers.models import make_scene
from tests.helpers.small_study import SMALL


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ({"space": 0.4, "time": 1e-4}, "smaller tissue.refine.tolerance"),
        ({"space": 0.01, "time": 0.2, "reduction": 0.1}, "more time.steps"),
        ({"space": 0.01, "time": 0.02, "reduction": 0.1}, "a larger N"),
    ],
)
def test_advice_names_what_carries_the_largest_share(shares: dict[str, float], words: str) -> None:
    text = advice(shares)
    assert words in text
    assert text.startswith(f"Of its error, {max(shares, key=lambda name: shares[name])} carries the largest share")


def test_wasted_digits_are_those_below_a_tenth_of_the_largest_part() -> None:
    budget = with_shares("x", [Source("a", 1e-5), Source("b", 0.03), Source("c", 0.004), Source("d", 0.0)])
    assert [(p.name, p.wasted) for p in budget.parts] == [("b", 0), ("c", 0), ("a", 2), ("d", 13)]
    assert budget.parts[0].share == pytest.approx(0.03 / 0.03401)
    assert budget.sentence == "Of the error of x, b carries 88 %. Wasted digits: 2 of a, 13 of d."


def test_steps_too_long_for_the_move_are_not_tried() -> None:
    scene = make_scene(SMALL, {"time": {"steps": 64, "end": 48.0}})
    assert least_steps(scene) == 32  # two over the three seconds of the move
    assert step_counts(64, least_steps(scene)) == [128, 64, 32]
    assert least_steps(make_scene(SMALL)) == 4


# --- files


def test_a_scene_that_sees_its_hand_only_is_measured_at_the_farthest_node(comm: MPI.Intracomm) -> None:
    scene = make_scene(SMALL, {"control": {"outputs": [{"kind": "hand", "name": "hand"}]}})
    places = find_places(scene, build(scene, comm=comm))
    assert [p.shape for p in places.points] == [(1, 2)]
    assert places.points[0][0, 1] == 0.0  # the lower edge; the hand holds the upper part


@pytest.mark.parametrize("order", [1, 2, 3])
def test_probe_is_exact_for_polynomials_of_its_order(comm: MPI.Intracomm, order: int) -> None:
    model = build(variant(make_scene(SMALL), Setting((3, 7), order, 4)), comm=comm)
    point = np.array([0.437, 0.519])  # no node, far from the contact zone
    probe = make_probe(model.space, (point[None, :],), False)
    x, y = model.system.layout.nodes.T

    def f(x: Any, y: Any) -> Any:
        linear = 0.3 + 1.7 * x - 0.6 * y
        return linear if order == 1 else linear + 2.1 * x * y - 0.9 * y**2 + x**2

    field = np.column_stack([f(x, y), -f(x, y)]).ravel()
    value = probe.of_rows(comm, field[:, None])[:, 0]
    # rounding of a dozen terms
    np.testing.assert_allclose(value, [f(*point), -f(*point)], rtol=0, atol=1e-12)


def test_outputs_that_move_with_the_hand_have_no_error(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    held = {"outputs": [{"kind": "node", "point": [0.0, 1.75], "name": "held"}]}
    with pytest.raises(SceneError, match=r"^control\.outputs: no output moves against the hand"):
        study_scene(make_scene(SMALL, {"control": held}), comm, mpi_tmp_path, Request(names=("forward",)))


@pytest.mark.parametrize("fall", [0.3, 0.5])
def test_reference_counts_what_its_finest_mesh_leaves(fall: float) -> None:
    """Errors c q^k with the contraction q: what is left of the last is d q / (1 - q)."""
    scene = make_scene(SMALL)
    exact, shape = np.array([[0.0] * 4, [1.0, -2.0, 0.5, 0.25]]), np.array([[0.0] * 4, [1.0, 0.3, 1.0, 0.3]])
    names = ("mesh", "assembly", "factor", "per_step", "p50", "p99", "max", "seconds")
    run = dict.fromkeys(names, 0.0) | {"dt": 3.0, "times": np.array([0.0, 3.0])}
    run |= {"n_e": 1, "states": 2, "dimension": 2, "steps": 1}
    runs = [wp_full.TimedRun(**run, values=exact + 1e-2 * fall**k * shape) for k in range(3)]
    settings = [Setting(None, 3, 32, refine=10.0**-k) for k in range(3)]
    truth = wp_reference.combine(scene, dict(zip(settings, runs, strict=True)), settings[0], runs[0], runs[0])
    left = 1e-2 * fall**2 * largest(shape, 2)[0] / largest(truth.series.values, 2)[0]
    assert truth.space[0] == pytest.approx(left, rel=1e-9)
    assert truth.time[0] == 0.0


def test_one_change_alone_falls_like_the_unknowns_grow() -> None:
    """And never faster or slower than graded meshes were seen to."""
    assert contraction([1e-2], 2.5) == pytest.approx(0.4)
    assert (contraction([1e-2], 100.0), contraction([1e-2], 1.0)) == (FASTEST, SLOWEST)
    assert contraction([1.0, 0.3], 100.0) == pytest.approx(0.3)


def test_pareto_and_power_law() -> None:
    points = [
        WorkPoint("a", str(k), s, e, ok)
        for k, (s, e, ok) in enumerate(
            [(1, 1, True), (2, 0.5, True), (3, 0.6, True), (0.5, 0.1, False), (4, 0.1, True)]
        )
    ]
    assert [p.label for p in pareto(points)] == ["0", "1", "4"]
    assert power_law([1, 2, 4], [1, 0.25, 0.0625]) == pytest.approx(-2)
    assert power_law([1, 1], [1, 2]) is None
    assert interpolate(8, [1, 2, 4], [1, 0.25, 0.0625]) == pytest.approx(1 / 64)
    assert interpolate(8, [4], [1.0], -2.0) == pytest.approx(0.25)


@pytest.mark.parametrize(("text", "seconds"), [("1ms", 1e-3), ("500us", 5e-4), ("0.01 s", 0.01), ("2e-3s", 2e-3)])
def test_budget_is_read_with_its_unit(text: str, seconds: float) -> None:
    assert parse_budget(text) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["1", "ms", "-1ms", "1 parsec", "0s", "1.2.3ms", ""])
def test_budget_without_sense_is_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(SceneError, match=r"^--budget .*such as 1ms, 500us or 0\.01s$"):
        parse_budget(text)


@pytest.mark.parametrize("text", ["0", "1", "-1e-3", "nan", "small"])
def test_tolerance_without_sense_is_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(SceneError, match=r"^--tolerance .*such as 1e-3$"):
        parse_tolerance(text)
