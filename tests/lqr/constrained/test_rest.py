"""Bounds of large plants: pulse responses by runs against all modes, their proved error, one-way and two-way."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained import rest as rest_module
from softgrasp.lqr.constrained.pulse import PulseError
from softgrasp.lqr.constrained.rest import Rest, known_tissue, run_rest
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface, make_surface, modal_tissue
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.problem import RiccatiProblem

GRID = 1.0
LARGEST = np.array([0.4, 0.3])
TWO_WAY = ("tissue.cells=[5, 10]", "effects.reaction=true", "hand.mass=2.0")
TURNING = ("tissue.cells=[5, 10]", "effects.rotation=true", "hand.inertia=5.0", "motion.target=[5.0, 3.0, 0.1]")


@cache
def runs(*overrides: str, grid: float = GRID) -> tuple[RiccatiProblem, Surface, ModalTissue, Rest]:
    model = build(load_scene("paper_lqr", list(overrides)))
    problem = make_problem(model)
    surface = make_surface(problem.layout, *model.space.surface())
    known, V = known_tissue(problem, surface)
    return problem, surface, known, run_rest(problem, surface, known, V, grid)


@pytest.mark.serial
@pytest.mark.parametrize("overrides", [("tissue.cells=[5, 10]",), TWO_WAY, TURNING])
def test_runs_give_the_bound_of_all_modes(overrides: tuple[str, ...]) -> None:
    problem, surface, known, rest = runs(*overrides)
    full, largest = modal_tissue(problem, surface), np.append(LARGEST, 0.2)[: problem.layout.n_s]
    assert np.allclose(known.omega[: known.lowest], full.omega[: known.lowest], rtol=1e-7)  # tolerance of SLEPc
    by_runs = PulseError(known, known.reduced(7, GRID), GRID, rest)
    by_modes = PulseError(full, full.reduced(7, GRID), GRID)
    for i in range(1, len(rest.instants), 40):
        exact = by_modes.level(float(rest.instants[i])) @ largest
        off = np.abs(by_runs.level_at(i) @ largest - exact)
        # the first 60 modes have an error of their own, the residual of SLEPc
        assert (off <= 2 * rest.error(i) @ largest + 1e-6 * exact.max()).all()
    bound, exact = by_runs.bound(largest), by_modes.bound(largest)
    assert (bound > (1 - 1e-3) * exact - 1e-12).all()  # what bounds between instants differ
    assert bound.max() < 1.1 * exact.max()


@pytest.mark.ranks(2)
def test_ranks_share_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rest_module, "STEPS", 16)  # messages are dear where ranks share a processor
    monkeypatch.setattr(rest_module, "HALVINGS", 2)
    monkeypatch.setattr(rest_module, "TOGETHER", 5)
    problem, surface, known, rest = runs("tissue.cells=[4, 9]")
    full = modal_tissue(problem, surface)
    by_runs = PulseError(known, known.reduced(7, GRID), GRID, rest)
    by_modes = PulseError(full, full.reduced(7, GRID), GRID)
    for i in range(1, len(rest.instants), 5):
        exact = by_modes.level(float(rest.instants[i])) @ LARGEST
        off = np.abs(by_runs.level_at(i) @ LARGEST - exact)
        assert (off <= 2 * rest.error(i) @ LARGEST + 1e-6 * exact.max()).all()  # residual of the modes


@pytest.mark.serial
def test_the_error_of_a_run_is_below_its_bound() -> None:
    problem, surface, known, rest = runs("tissue.cells=[5, 10]")
    full, lowest = modal_tissue(problem, surface), known.lowest
    beyond = ModalTissue(full.omega[lowest:], 0.0, full.beta, full.g[lowest:], full.seen[:, :, lowest:], full.c)
    # zeta = static answer + answer to a step from rest, with the sign of -g
    static = np.einsum("jdm,ms->jds", beyond.seen, beyond.g / beyond.omega[:, None] ** 2)
    worst = 0.0
    for i in range(1, len(rest.instants), 8):
        t = float(rest.instants[i])
        step = np.stack([beyond.answer(a[None], t, 1)[0, -1] for a in np.eye(2)], axis=-1)
        exact = static + np.einsum("jdm,ms->jds", beyond.seen, step)
        off = np.abs(rest.moved[0, i] - exact)
        assert (off <= rest.size * rest.steps[i] + 1e-7 * np.abs(static).max()).all()  # residual of the modes
        worst = max(worst, float(off.max()))
    assert 0 < worst < 1e-4 * np.abs(static).max()


@pytest.mark.serial
def test_bounded_runs_keep_the_bound_and_the_worst_one_attains_it() -> None:
    problem, surface, known, rest = runs("tissue.cells=[5, 10]")
    full, rng = modal_tissue(problem, surface), np.random.default_rng(1)
    pulses = PulseError(known, known.reduced(5, GRID), GRID, rest)
    bound, parts = pulses.bound(LARGEST), 4

    def errors(a: np.ndarray) -> np.ndarray:
        both = ((full, full.seen), (pulses.reduced, pulses.reduced.seen))
        first, second = (np.einsum("jdm,kim->kijd", seen, t.answer(a, GRID, parts)) for t, seen in both)
        return first - second

    one = np.zeros((12, 2, 2))
    one[0] = np.eye(2)
    answers = np.stack([errors(one[..., i]) for i in range(2)], axis=-1)[::-1]
    a = LARGEST * rng.choice([-1, 1], (1000, 12, 2)) * rng.uniform(0.5, 1, (1000, 12, 2))
    assert (np.abs(np.einsum("kijds,rks->rijd", answers, a, optimize=True)).max(axis=(0, 1)) <= bound).all()
    i = int(np.flatnonzero(np.isclose(rest.instants, GRID / 2))[0])
    level = pulses.level_at(i) @ LARGEST
    j, d = np.unravel_index(np.argmax(level), level.shape)
    worst = LARGEST * np.sign(pulses.kernel_at(i)[j, d]).T[::-1]
    reached = errors(worst)[-1, 2, j, d]
    assert abs(reached / level[j, d] - 1) < 1e-6


@pytest.mark.serial
def test_modes_that_are_slow_are_run_for_more_intervals() -> None:
    grid = 0.4
    problem, surface, known, rest = runs("tissue.cells=[5, 10]", grid=grid)
    assert len(rest.moved) > 1
    full = modal_tissue(problem, surface)
    by_runs = PulseError(known, known.reduced(7, grid), grid, rest)
    by_modes = PulseError(full, full.reduced(7, grid), grid)
    bound, exact = by_runs.bound(LARGEST).max(), by_modes.bound(LARGEST).max()
    assert 1 - 1e-3 < bound / exact < 1.1
