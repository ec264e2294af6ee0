"""Forces on the boundary nodes that a run keeps for a film, and the pressure that the film gets of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.study import notebook

FALL = [
    "tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "effects.obstacles=true",
    "time={steps=100, end=1.0}",
]  # fmt: skip
TABLE = "kind='halfspace', normal=[0, 1], offset=-0.03"
DISC = "kind='disc', center=[0.4, -0.53], radius=0.5"
EVERY = 3


@pytest.mark.ranks(2)
@pytest.mark.parametrize("shape", [TABLE, f"{TABLE}, friction=0.3", DISC])
def test_their_sum_is_the_force_of_the_obstacle_without_impulses(shape: str) -> None:
    run = simulate(build("paper_forward", [*FALL, f"obstacle=[{{{shape}}}]", f"output.every={EVERY}"]))
    contact = run.contact
    assert contact is not None
    assert run.snapshots is not None
    assert contact.instants.tolist() == run.snapshots.steps.tolist()  # 34 stored states, and a film has 60 at most
    steps, dt = contact.instants[1:] - 1, run.times[1]
    expected = contact.force[steps, 0] - contact.impulse[steps, 0] / dt
    assert not contact.pressing[0].any()
    assert contact.impulse[steps].any()
    # impulses over dt, up to 100 times the force, are taken off again
    assert np.abs(contact.pressing[1:].sum(axis=1) - expected).max() < 1e-11 * np.abs(contact.force).max()


@pytest.mark.ranks(2)
def test_a_film_gets_the_pressure_at_its_instants(monkeypatch: pytest.MonkeyPatch) -> None:
    films: list[tuple[Any, ...]] = []

    def watched(*args: Any) -> bytes:
        films.append(args)
        return b"film"

    monkeypatch.setattr(notebook, "move_bytes", watched)
    model = build("paper_forward", [*FALL, f"obstacle=[{{{TABLE}}}]"])
    run = simulate(model)
    assert run.contact is not None
    film = run.animate(model)
    assert bool(film.gif) == (model.system.layout.comm.rank == 0) == bool(films)
    if not films:
        return
    picture, states, times, *_, tractions = films[0]
    assert tractions.shape == states.shape
    assert len(times) == 60
    assert times.tolist() == run.times[run.contact.instants].tolist()
    low = np.flatnonzero(np.isclose(picture.points[:, 1], 0.0))
    low = low[np.argsort(picture.points[low, 0])]
    hats = np.full(len(low), 0.25)  # integrals of the shape functions on edges of 0.25 m, of a body of 1 m in depth
    hats[[0, -1]] /= 2
    up = run.contact.pressing[:, :, 1].sum(axis=1)
    assert up.max() > 0
    assert np.abs(tractions[:, low, 1] @ hats - up).max() < 1e-12 * up.max()  # rounding
