"""Chatter: nodes whose touching changes in one step and changes back in the next, against the forces of every step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import CheckpointError, Paused
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.flat import FlatContact
from softgrasp.fem.run.contact.touching import Touching
from softgrasp.fem.run.midpoint import TissueState
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.states import checkpoint

FALL = [
    "tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "effects.obstacles=true",
    "time.steps=120", "time.end=1.2",
]  # fmt: skip
TABLE = "{kind='halfspace', name='table', normal=[0, 1], offset=-0.03}"
WALL = "{kind='halfspace', name='wall', normal=[1, 0], offset=-1e-4}"
DISC = "{kind='disc', center=[0.4, -0.53], radius=0.5}"
LONG = ["time.steps=300", "time.end=3"]
LOW = TABLE.replace("0.03", "0.025")
STRAIN = "effects.finite_strain={}"


def obstacles(*entries: str) -> str:
    return f"obstacle=[{', '.join(entries)}]"


def run(overrides: list[str], comm: MPI.Intracomm = MPI.COMM_WORLD, **options: Any) -> Any:
    return simulate(build("paper_forward", [*FALL, *overrides], comm), **options)


@pytest.fixture
def pressing(monkeypatch: pytest.MonkeyPatch) -> list[Array]:
    """Forces on the boundary nodes in every step of the runs to come, (p, d)."""
    forces: list[Array] = []
    advance = Touching.advance

    def watched(midpoint: Touching, *states: Any) -> None:
        advance(midpoint, *states)
        assert midpoint.contact is not None
        forces.append(midpoint.contact.pressing())

    monkeypatch.setattr(Touching, "advance", watched)
    return forces


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("compiled", "axes", "overrides"),
    [  # axes along which the obstacles press
        (True, [1], [obstacles(TABLE)]),
        (True, [1, 0], [obstacles(TABLE, WALL)]),
        (True, [1], [obstacles(TABLE.replace("name", "friction=0.3, name"))]),
        (False, [1, 0], [obstacles(TABLE, WALL)]),
        (False, [1], [obstacles(TABLE.replace("name", "friction=0.3, name"))]),
        (True, [1], [obstacles(DISC), *LONG]),
        (True, [1], [obstacles(LOW), STRAIN]),
    ],
)
def test_it_is_that_of_the_forces_of_every_step(
    compiled: bool, axes: list[int], overrides: list[str], pressing: list[Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled:
        monkeypatch.setattr("softgrasp.fem.run.contact.step.contact_library", lambda: None)
    contact = run(overrides).contact
    free = np.zeros((2, *pressing[0].shape))  # nothing touches before the run
    on = np.concatenate([free, pressing])[:, :, axes] > 0
    single = (on[1:-1] != on[2:]) & (on[:-2] == on[2:])  # another state than before and after, for one step
    assert np.array_equal(single.sum(axis=1), contact.chattering)
    assert 0 < contact.chatter == single.sum() < (on[1:] != on[:-1]).sum()
    assert contact.chatter_end == 1 + np.flatnonzero(single.any(axis=(1, 2))).max()


REST = ["time={steps=400, end=2}"]  # it rests after 1 s
UPRIGHT = [
    "tissue.cells=[3, 3, 3]", "tissue.order=1", "effects.reaction=false", "motion={profile='hold'}",
    "effects.gravity={g=[0, 0, -9.81]}", "time.end=0.25", "time.steps=400",
]  # fmt: skip


@pytest.mark.parametrize(
    ("scene", "overrides", "rests"),
    [
        ("paper_forward", [*FALL, *REST, obstacles(TABLE), "effects.damping={kind='kelvin-voigt', beta=0.02}"], True),
        (
            "paper_forward",
            [*FALL, *REST, obstacles(TABLE), "effects.damping={kind='rayleigh', alpha=9, beta=0.01}"],
            True,
        ),
        ("paper_forward", [*FALL, obstacles(TABLE)], False),
        ("set_down_3d", [*UPRIGHT, "obstacle=[{kind='halfspace', normal=[0, 0, 1], offset=-3e-5}]"], True),
    ],
)
def test_pressed_nodes_stand_still_at_the_end_of_every_step(
    scene: str, overrides: list[str], rests: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without impulses each of them moves up and down in turn as long as it is pressed, which no damping sees."""
    speeds, advance = [], Touching.advance

    def watched(midpoint: Touching, old: TissueState, new: TissueState) -> None:
        advance(midpoint, old, new)
        contact = midpoint.contact
        assert contact is not None
        v = contact.surface.gather(new.v.array_r).reshape(contact.p, contact.d)[:, -1]
        speeds.append(np.where(contact.pressing()[:, -1] > 0, v, np.nan))

    def moves() -> tuple[Any, Array, Array]:
        speeds.clear()
        contact = simulate(build(scene, overrides)).contact
        v = np.array(speeds)
        both = ~np.isnan(v[1:] + v[:-1])
        return contact, v, (v[1:] * v[:-1] < 0)[both]

    monkeypatch.setattr(Touching, "advance", watched)
    contact, v, _ = moves()
    monkeypatch.setattr(FlatContact, "_halt_flat", lambda *_: None)
    _, free, turns = moves()
    assert turns.mean() > 0.99
    assert np.nanmax(np.abs(v)) < 1e-10 * np.nanmax(np.abs(free))  # rounding of the impulse
    if rests:
        assert contact.touching[-1].sum() > 3
        assert contact.chatter_end < len(v) / 2


@pytest.mark.ranks(3)
def test_ranks_and_engines_count_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = [obstacles(TABLE, WALL), "effects.damping={kind='kelvin-voigt', beta=0.01}"]
    here, alone = run(overrides).contact, run(overrides, MPI.COMM_SELF).contact
    monkeypatch.setattr("softgrasp.fem.run.contact.step.contact_library", lambda: None)
    general = run(overrides).contact
    assert here.chatter > 0
    assert np.array_equal(here.chattering, alone.chattering)
    assert np.array_equal(here.chattering, general.chattering)


@pytest.mark.ranks(2)
@pytest.mark.parametrize("shape", [TABLE, DISC])
def test_a_restart_between_a_change_and_its_return_counts_both(shape: str, mpi_tmp_path: Path) -> None:
    scene = [obstacles(shape), *LONG]
    whole = run(scene).contact
    until = int(whole.chattering.any(axis=1).argmax())
    assert whole.chattering[until] > 0
    with pytest.raises(Paused):
        run(scene, options=RunOptions(mpi_tmp_path, until=until))
    again = run(scene, options=RunOptions(mpi_tmp_path, resume=True)).contact
    assert np.array_equal(again.chattering, whole.chattering)


def test_restart_files_that_do_not_have_it_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr(checkpoint, "CONTACT", 4)
        with pytest.raises(Paused):
            run([obstacles(TABLE)], options=RunOptions(tmp_path, until=5))
    with pytest.raises(CheckpointError, match="another version of softgrasp, which continues contact in another form"):
        run([obstacles(TABLE)], options=RunOptions(tmp_path, resume=True))
