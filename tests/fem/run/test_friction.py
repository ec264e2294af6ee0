"""Friction: the small problem against its conditions, onset of sliding, dissipation, balance, restarts, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softgrasp.fem.errors import Paused, SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.coulomb import Coulomb
from softgrasp.fem.run.contact.friction import FrictionContact
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.scene.file import load_scene

SMALL = [
    "tissue.cells=[4, 8]",
    "effects.gravity={g=[0, -5]}",
    "time.steps=120",
    "time.end=1.2",
    "effects.obstacles=true",
]
BETA = "effects.damping={kind='kelvin-voigt', beta=0.01}"
SIDE = "motion={target=[0.4, -0.05], duration=1.0}"
TWO = ["effects.reaction=true", "hand={mass=2.0}", "effects.gravity={g=[0, -1], hand_weight=true}"]
DRIVEN = [*TWO, "motion={profile='hold', drive='force'}"]


def table(friction: float) -> str:
    return f"obstacle=[{{kind='halfspace', normal=[0.02, 1], offset=-0.03, friction={friction}}}]"


DISC = "obstacle=[{kind='disc', center=[0.4, -0.53], radius=0.5, friction=0.4}]"
CARRIED = (
    "obstacle=[{kind='box', lo=[-1, -0.53], hi=[3, -0.01], friction=0.3, path={velocity=[0.1, 0]}}, "
    "{kind='halfspace', normal=[0, 1], offset=-0.02, friction=0}]"
)


def run(*overrides: str, **options: Any) -> Any:
    return simulate(build("paper_forward", [*SMALL, *overrides]), **options)


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.6])
def test_forces_of_random_problems_meet_coulombs_conditions(mu: float) -> None:
    rng, coulomb = np.random.default_rng(5), Coulomb()
    for k in (1, 3, 12, 12, 30):
        A = rng.standard_normal((2 * k + 2, 2 * k))
        W, q, share = A.T @ A / k + 0.5 * np.eye(2 * k), rng.standard_normal(2 * k), np.full(k, mu)
        x, kind = coulomb.solve(W, q, share, np.zeros(k, np.int8), 1e-13)
        y = W @ x + q
        n, t, slip = x[:k], x[k:], y[k:]
        small = 1e-11 * max(1.0, np.abs(x).max())  # condition numbers up to 1e2
        assert n.min() >= 0
        assert y[:k].min() > -small
        assert np.abs(n * y[:k]).max() < small
        assert (np.abs(t) - mu * n).max() < small
        assert np.abs(t + np.sign(slip) * mu * n)[np.abs(slip) > small].max(initial=0.0) < small
        again, same = coulomb.solve(W, q, share, kind, 1e-13)
        assert np.array_equal(again, x)
        assert np.array_equal(same, kind)


def test_sliding_starts_at_mu_times_the_weight() -> None:
    """A force on the hand grows until the block slides: first at mu N, then with mu N against it."""
    mu, steps, settle, ramp = 0.5, 600, 2.0, 4.0
    model = build("paper_forward", [
        *SMALL, *DRIVEN, "tissue.material={lambda=500.0, mu=500.0, rho=1.0}", f"time.steps={steps}", "time.end=6",
        "effects.damping={kind='kelvin-voigt', beta=0.05}",
        f"obstacle=[{{kind='halfspace', normal=[0, 1], offset=0, friction={mu}}}]",
    ])  # fmt: skip
    weight = float(model.system.M_hand[1, 1] + model.system.M_rigid[1, 1])

    def push(t: float) -> float:
        return 1.15 * mu * weight * max(0.0, t - settle) / ramp

    result = simulate(model, force=lambda n, t, q, v: np.array([push(t), 0.0]))
    across, normal = result.contact.force[:, 0].T
    sliding = np.abs(across) > mu * normal * (1 - 1e-9)
    first = int(np.argmax(sliding & (np.arange(steps) > settle / 6 * steps)))
    onset = push((first + 0.5) * 0.01)
    assert onset == pytest.approx(mu * weight, rel=1e-2)  # that of the issue; the ramp has steps of 3e-3
    assert sliding[first + 20 :].all()
    assert across[-1] < 0 < result.v_s[-1, 0]
    assert abs(result.v_s[first - 20, 0]) < 0.3 * result.v_s[-1, 0]  # it gave way, as tissue does
    assert normal[-1] == pytest.approx(weight, rel=1e-2)  # what is left of the motion
    assert result.energy_drift < 1e-13
    assert result.contact.rubbed > 0


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    "overrides", [[table(0.4), SIDE], [table(5.0), SIDE], [DISC, SIDE], [table(0.3), *DRIVEN], [CARRIED, SIDE]]
)
def test_balance_closes_and_friction_dissipates(overrides: list[str]) -> None:
    result = run(BETA, *overrides)
    assert result.contact.touching.max() > 0
    assert result.energy_drift < 1e-13  # rounding
    assert result.contact.penetration < 1e-12  # curved obstacles iterate to 64 rounding units of the coordinates
    assert result.contact.rubbed > (1e-6 if "5.0" not in overrides[0] and overrides[1] == SIDE else -1e-15)
    assert result.contact.stopped >= 0


def test_no_friction_is_the_run_without_the_key_bit_for_bit() -> None:
    none = run(BETA, SIDE, table(0.0))
    without = run(BETA, SIDE, table(0.0).replace(", friction=0.0", ""))
    assert none.contact.touching.max() > 0
    assert np.array_equal(none.final, without.final)
    assert np.array_equal(none.contact.force, without.contact.force)
    assert none.contact.rubbed == 0.0
    little = run(BETA, SIDE, table(1e-9))  # another way through the step, so that its limit is the step without
    assert np.abs(little.final - none.final).max() < 1e-6 * np.abs(none.final).max()


def test_every_step_of_friction_takes_energy(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, press = [0.0], FrictionContact.press

    def note(contact: FrictionContact, *arguments: Any) -> None:
        press(contact, *arguments)
        taken.append(float(contact.table.energy[3]))

    monkeypatch.setattr(FrictionContact, "press", note)
    run(BETA, SIDE, table(0.4))
    assert np.diff(taken).min() > -1e-15 * taken[-1]  # rounding of slips of sticking nodes
    assert taken[-1] > 1e-4


def test_restart_in_friction_repeats_the_bits(mpi_tmp_path: Path) -> None:
    overrides = [*SMALL, BETA, SIDE, table(0.4)]
    whole = simulate(build("paper_forward", overrides))
    with pytest.raises(Paused):
        simulate(build("paper_forward", overrides), RunOptions(mpi_tmp_path, until=70))
    again = simulate(build("paper_forward", overrides), RunOptions(mpi_tmp_path, resume=True))
    assert whole.contact.touching[:70].max() > 0
    assert np.array_equal(again.final, whole.final)
    assert np.array_equal(again.contact.force, whole.contact.force)
    assert again.contact.rubbed == whole.contact.rubbed
    assert again.contact.rounds == whole.contact.rounds


REFUSED = [
    ("block_3d", ["effects.obstacles=true", "obstacle=[{kind='ball', center=[0, 0, -1], radius=0.1, friction=0.2}]"],
     "friction is there in 2D only"),
    ("paper_obstacle", ["obstacle=[{kind='disc', center=[9, 9], radius=0.1, friction=0.2}]"],
     "which only effects.obstacles = true uses"),
    ("paper_forward", [*SMALL, table(-1.0)], "friction"),
]  # fmt: skip


@pytest.mark.parametrize(("scene", "overrides", "words"), REFUSED)
def test_what_friction_cannot_do_is_refused(scene: str, overrides: list[str], words: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene(scene, overrides)
    assert words in str(error.value)
