"""Factors made ahead by other threads: the right ones, freed where they were made, the same solution."""

from __future__ import annotations

import sys
import threading
import weakref
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.lqr.lowrank import shifted
from softgrasp.lqr.lowrank.ahead import FactorsAhead
from softgrasp.lqr.lowrank.shifted import GatheredTissue
from tests.helpers.models import make_scene

pytestmark = pytest.mark.serial

SHIFTS = [-0.5 + 5j, -1.0, -0.7 + 9j, -0.2 + 2j, -3.0 + 40j]


class Factor:
    """What stands for a factor: it notes the threads in which it is made and freed."""

    def __init__(self, p: complex, thread: int, log: list[tuple[complex, int, int]]) -> None:
        self.p = p
        made = threading.get_ident()
        weakref.finalize(self, lambda: log.append((p, made, threading.get_ident())))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_every_factor_is_the_wanted_one_and_goes_back_to_its_thread(threads: int) -> None:
    """Also when shifts come that were not announced, and when announced ones never come."""
    log: list[tuple[complex, int, int]] = []
    made: list[complex] = []

    def make(p: complex, thread: int) -> Any:
        made.append(p)
        return Factor(p, thread, log)

    ahead = FactorsAhead(make, threads)
    asked = [[1, 2, 3, 4], [2, 3, 4], [3, 4, 5], [9, 3], [4, 5, 6, 7], [8], [6, 7]]
    often = [[q + 10 * i for q in shifts] for i in range(1, 200) for shifts in asked]  # threads meet in every way
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for shifts in asked + often:
            box = [ahead.take([complex(p) for p in shifts])]
            assert box[0].p == shifts[0]  # type: ignore[attr-defined]
            assert len(ahead.coming) <= threads
            ahead.free(box)
        ahead.close()
    finally:
        sys.setswitchinterval(interval)
    assert sorted((p.real for p, _, _ in log)) == sorted(p.real for p in made)  # all are freed
    assert all(begin == end for _, begin, end in log)
    assert made.count(2) == 1  # announced and used


def test_a_factor_that_fails_ahead_says_so_when_it_is_wanted() -> None:
    def make(p: complex, thread: int) -> Any:
        if p == 2:
            raise SolverError("the factorisation of S(p) failed")
        return Factor(p, thread, [])

    ahead = FactorsAhead(make, 2)
    ahead.free([ahead.take([1, 2, 3])])
    with pytest.raises(SolverError, match="failed"):
        ahead.take([2, 3])
    assert ahead.take([3]).p == 3  # type: ignore[attr-defined]
    ahead.close()


@pytest.mark.serial
@pytest.mark.parametrize("announced", [0, 1, 4])
def test_solutions_do_not_depend_on_the_threads(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, announced: int
) -> None:
    system = build(make_scene(effects={"damping": {"kind": "kelvin-voigt", "beta": 0.01}}), comm=comm).system
    F = np.random.default_rng(0).standard_normal((system.layout.n_local, 3))
    alone = GatheredTissue(system)
    assert alone.ahead is None
    monkeypatch.setattr(shifted, "AHEAD_FROM", 0)
    monkeypatch.setattr(shifted, "cores", lambda: 2)
    helped = GatheredTissue(system)
    assert helped.ahead is not None
    assert len(helped.shells) == len(helped.ahead.threads) == 2
    for i, p in enumerate(SHIFTS + SHIFTS[::-1]):
        wrong = [-7.0 + 1j] if i == 3 else []  # never asked for
        coming = [*wrong, *(SHIFTS + SHIFTS[::-1])[i + 1 : i + 1 + announced]]
        assert np.array_equal(helped.solve(p, F, coming), alone.solve(p, F))  # the same factorisation
    assert helped.factors == alone.factors
    helped.destroy()
    alone.destroy()
