"""Friction under bodies that touch with all nodes of a wide side, whose sets are far from those of the step before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.coulomb import Coulomb
from softgrasp.fem.obstacles.interior import interior_sets
from softgrasp.fem.obstacles.lemke import pyramid_forces
from softgrasp.fem.obstacles.newton import SLIP, STICK
from softgrasp.fem.run.simulate import simulate


def set_down(cells: list[int]) -> Any:
    """The block of `set_down`, of 60 steps, at a friction of 0.5."""
    return simulate(build("set_down", [f"tissue.cells={cells}", "obstacle.0.friction=0.5", "time.steps=60"]))


def test_a_strip_of_four_layers_lands_with_four_hundred_nodes() -> None:
    """Newton's method alone moves the borders of its sets node by node there: 3000 sweeps and 40 rounds refused it."""
    result = set_down([400, 4])
    assert result.contact.touching.max() > 390
    assert result.contact.penetration < 1e-12 * 0.06
    assert result.contact.rubbed > 0
    assert result.energy_drift < 1e-13  # of issue 28; measured 1e-15


def test_interior_points_and_pivots_find_the_same_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the steps of a run with most sticking and most slipping nodes, from no forces at all."""
    problems, solve = list[tuple[Any, ...]](), Coulomb.solve

    def note(self: Coulomb, k: int, W: Any, q: Any, mu: Any, tol: float, *more: Any, **others: Any) -> Any:
        x = solve(self, k, W, q, mu, tol, *more, **others)
        if k > 30 and not self.f.based:  # a step, not its impulses
            counts = np.bincount(self.kind, minlength=3)
            problems.append((W[: 2 * k, : 2 * k].copy(), q.copy(), mu.copy(), tol, x.copy(), counts))
        return x

    monkeypatch.setattr(Coulomb, "solve", note)
    set_down([40, 4])
    for kind in STICK, SLIP:
        W, q, mu, tol, x, counts = max(problems, key=lambda problem: problem[-1][kind])
        assert counts[kind] > 15
        most = np.abs(x).max()
        pivots = pyramid_forces(W, q, mu, 1)
        assert pivots is not None
        assert np.abs(pivots - x).max() < 1e-8 * most  # of pivots in a tableau, condition number 1e4
        coulomb = Coulomb(1)
        coulomb.fit(len(mu))
        found = interior_sets(W, q, mu)
        assert found is not None
        assert np.abs(found[0] - x).max() < 1e-3 * most  # the path ends at products of 1e-12
        assert coulomb._go_inside(W, q, mu, tol)
        assert coulomb.rounds <= 3  # the sets are right but for a few nodes
        assert np.abs(coulomb.x - x).max() < 1e-9 * most  # tolerance of gaps and slips over W
