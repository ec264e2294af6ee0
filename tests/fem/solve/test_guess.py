"""Extrapolated sequences: polynomials exactly, and what alternates by the lowest degree."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.solve.guess import STEPS, extrapolated


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_polynomial_is_continued_exactly(degree: int) -> None:
    powers = np.arange(STEPS + 1.0)[:, None] ** np.arange(degree + 1)
    x = powers @ np.random.default_rng(degree).standard_normal((degree + 1, 7))
    assert np.abs(extrapolated(x[-2::-1], np.dot) - x[-1]).max() < 1e-12 * np.abs(x).max()  # sums of five numbers


def test_few_members_are_continued_by_what_they_allow() -> None:
    x = np.array([[1.0, 5.0], [3.0, 4.0], [4.0, 0.0]])
    assert np.array_equal(extrapolated(x[:1], np.dot), x[0])
    assert np.array_equal(extrapolated(x[:2], np.dot), 2 * x[0] - x[1])
    assert np.array_equal(extrapolated(x, np.dot), 2 * x[0] - x[1])


def test_alternating_members_are_continued_by_the_line_which_magnifies_them_least() -> None:
    x = [np.full(3, (-1.0) ** n) for n in range(STEPS)]
    assert np.array_equal(extrapolated(x, np.dot), 3 * x[0])
