"""What the reduced tissue leaves out: closed forms against matrix exponentials, a bound that runs keep and attain."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.linalg

from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained.pulse import PulseError
from softgrasp.lqr.constrained.tissue import ModalTissue, make_surface, modal_tissue
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.checks import ControlError

GRID = 0.5


@cache
def tissue() -> ModalTissue:
    model = build(load_scene("paper_lqr", ["tissue.cells=[4, 8]", "effects.damping.beta=0.05"]))
    problem = make_problem(model)
    return modal_tissue(problem, make_surface(problem.layout, *model.space.surface()))


def errors(full: ModalTissue, reduced: ModalTissue, a: np.ndarray, parts: int) -> np.ndarray:
    return np.einsum("jdm,kim->kijd", full.seen, full.answer(a, GRID, parts)) - np.einsum(
        "jdm,kim->kijd", reduced.seen, reduced.answer(a, GRID, parts)
    )


def test_answer_is_that_of_the_matrix_exponential() -> None:
    full = tissue().reduced(12, GRID)
    a = np.random.default_rng(0).standard_normal((6, 2))
    k = len(full.omega)
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-np.diag(full.omega**2), -2 * np.diag(full.delta)]])
    B = np.vstack([np.zeros((k, 2)), -full.g])
    assert (full.delta > full.omega).any()  # some modes are overdamped
    x, found = np.zeros(2 * k), full.answer(a, GRID, 3)
    for n, held in enumerate(a):
        for i in range(4):
            E = scipy.linalg.expm(np.block([[A, B @ held[:, None]], [np.zeros((1, 2 * k + 1))]]) * GRID * i / 3)
            now = E[:-1, :-1] @ x + E[:-1, -1]
            assert np.abs(found[n, i] - now[:k]).max() < 1e-12 * np.abs(full.g).max()  # rounding
        x = now


def test_static_shapes_make_a_constant_acceleration_exact() -> None:
    full = tissue()
    still = np.ones((4000, 2))
    assert np.abs(errors(full, full.reduced(4, GRID), still, 1)[-1]).max() < 1e-12  # the answer is 0.1 m
    assert np.abs(errors(full, full.reduced(len(full.omega), GRID), still[:5], 4)).max() < 1e-12  # all modes


def test_bound_holds_and_is_attained() -> None:
    full, rng = tissue(), np.random.default_rng(2)
    pulses = PulseError(full, full.reduced(5, GRID), GRID)
    largest = np.array([0.4, 0.2])
    bound, parts = pulses.bound(largest), 7
    one = np.zeros((40, 2, 2))  # a unit pulse of each acceleration in the first of 40 intervals
    one[0] = np.eye(2)
    answers = np.stack([errors(full, pulses.reduced, one[..., i], parts) for i in range(2)], axis=-1)[::-1]
    a = largest * rng.choice([-1, 1], (1000, 40, 2)) * rng.uniform(0.5, 1, (1000, 40, 2))
    ends = np.einsum("kijds,rks->rijd", answers, a, optimize=True)  # of 1000 runs, in their last interval
    assert np.abs(ends[3] - errors(full, pulses.reduced, a[3], parts)[-1]).max() < 1e-15  # rounding of 1e-3
    assert (np.abs(ends).max(axis=(0, 1)) <= bound).all()
    s = GRID * 3 / parts
    level = pulses.level(s) @ largest
    j, d = np.unravel_index(np.argmax(level), level.shape)
    worst = largest * np.sign(pulses.kernel(s)[j, d]).T[::-1]
    reached = errors(full, pulses.reduced, worst, parts)[-1, 3, j, d]
    assert abs(reached / level[j, d] - 1) < 1e-6
    assert level[j, d] <= bound[j, d]
    between = [pulses.level(s, 4) for s in GRID * rng.uniform(0, 1, 20)]
    assert (np.max(between, axis=0) <= pulses.modewise(4)).all()
    reached = max((pulses.level(s) @ largest).max() for s in GRID * np.linspace(0, 1, 65))
    assert bound.max() < 1.1 * reached  # what is between the instants is a few percent


@pytest.mark.filterwarnings("error")  # undamped, the bound of a mode by its size would divide by zero
def test_refusals_name_the_mode_and_the_number_of_shapes() -> None:
    full = tissue()
    still = ModalTissue(full.omega, 0.0, 0.0, full.g, full.seen, full.c)
    with pytest.raises(ControlError, match=r"mode \d+ of the tissue \(omega = .*effects.damping.beta"):
        PulseError(still, still.reduced(5, GRID), GRID).bound(np.ones(2))
    with pytest.raises(ControlError, match=r"needs 3 to \d+ shapes of the tissue, not 2"):
        full.reduced(2, GRID)
