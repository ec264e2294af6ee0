"""Acceptance of certified runs on the paper's scene: 125 parameters, two dampings, three sizes, and outside them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.residual import ResidualSpace
from softgrasp.reduction.certified.trainer import Trainer, build_certified
from softgrasp.reduction.certified.training import certified_model, scene_drive
from tests.helpers.certified import error_to, full_at
from tests.helpers.models import Array, close

PAPER = Path(__file__).parents[3] / "demos" / "scenes" / "paper_forward.toml"
BOX = ["reduction.lambda_range=[30.0,500.0]", "reduction.mu_range=[20.0,500.0]"]
KV = ["effects.damping.kind='kelvin-voigt'", "effects.damping.beta=0.002"]
ROUNDING = 1e-9  # of the solution
PARTS = 5  # of the 125 parameters, so that none takes minutes
DAMPINGS: dict[str, tuple[Sequence[str], float, int, tuple[tuple[int, int], ...]]] = {
    "kv": (KV, 1e-3, 80, ((16, 48), (20, 20), (40, 80))),
    "undamped": ((), 3e-2, 76, ((12, 48), (16, 48), (20, 20))),
}
"""Changes of the scene, tolerance of the greedy, most modes, sizes k and k2."""
LIMITS = {
    "kv": {(16, 48): (2.0, 3.0), (20, 20): (25.0, 65.0)},
    "undamped": {(12, 48): (6.5, 10.0), (16, 48): (6.5, 10.0), (20, 20): (65.0, np.inf)},
}
"""Effectivity in the median and at most."""


def paper(*changes: str) -> Model:
    return build(load_scene(PAPER, [*BOX, *changes]))


@cache
def trained(damping: str) -> tuple[Model, CertifiedModel]:
    """The scene, and the model that the greedy builds for it; once for all tests."""
    changes, tolerance, most, _ = DAMPINGS[damping]
    model = paper("reduction.certify='proof'", f"reduction.max_N={4 + 2 * most}", *changes)
    trainer = Trainer(model)
    try:
        return model, build_certified(trainer, tolerance)
    finally:
        trainer.destroy()


def first_below(certified: CertifiedModel, bound: float) -> tuple[int, int]:
    """Full runs at different parameters, and modes, of the first round with at most this bound on the grid."""
    rounds = certified.training["rounds"]
    n = next(i for i, r in enumerate(rounds) if r["bound"] <= bound)
    return len({r["at"] for r in rounds[: n + 1]}), rounds[n]["k"]


def parameters(random: int) -> list[tuple[float, float]]:
    """A 5 x 5 grid of the box and random places in it."""
    lam, mu = np.geomspace(30, 500, 5), np.geomspace(20, 500, 5)
    rng = np.random.default_rng(7)
    low, high = np.log([30.0, 20.0]), np.log([500.0, 500.0])
    places = np.exp(low + rng.uniform(size=(random, 2)) * (high - low))
    return [(float(a), float(b)) for a in lam for b in mu] + [(float(a), float(b)) for a, b in places]


@cache
def certified_part(damping: str, part: int) -> dict[tuple[int, int], Array]:
    """True error, proved error and effectivity of the running maximum, both over the solution; asserts the bound."""
    model, whole = trained(damping)
    parts = {size: whole.with_sizes(*size) for size in DAMPINGS[damping][3]}
    found: dict[tuple[int, int], list[Any]] = {size: [] for size in parts}
    for place in parameters(100)[part::PARTS]:
        system, full = full_at(model, whole.materials(*place))
        for size, own in parts.items():
            run = own.run(system.materials, replace(whole.drive, finer=None), allow=True)
            found[size].append(compared(system, full, whole, own, run, (place, size)))
    return {size: np.array(rows) for size, rows in found.items()}


def compared(
    system: BlockSystem, full: Trajectory, whole: CertifiedModel, own: CertifiedModel, run: CertifiedRun, where: object
) -> tuple[float, float, float]:
    """True and proved error over the solution, and their ratio; asserts the bound at every step."""
    on_mesh = replace(own, fine=replace(own.fine, reconstruction=whole.fine.reconstruction))
    error, scale = error_to(system, full, on_mesh, run)
    bound = run.certificate.energy.values
    assert (bound >= error - ROUNDING * scale).all(), where
    assert run.certificate.reduction >= error.max() / scale - ROUNDING, where
    top = bound.max() / error.max()
    assert top <= run.certificate.effectivity_at_most * (1 + 1e-9), where
    return error.max() / scale, bound.max() / scale, top


def show(name: str, found: dict[tuple[int, int], Array]) -> None:
    """Numbers for a run with -s."""
    for size, rows in found.items():
        e, b, t = rows.T
        sys.stdout.write(
            f"{name} k {size}: true median {np.median(e):.1e} max {e.max():.1e}, proved max {b.max():.1e}, "
            f"effectivity median {np.median(t):.2f} max {t.max():.2f} over {len(t)}\n"
        )


@pytest.mark.slow
@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("damping", "bound", "runs", "k"),
    [("kv", 1e-2, 10, 40), ("kv", 1e-3, 20, 80), ("undamped", 1e-1, 7, 32), ("undamped", 3e-2, 19, 76)],
)
def test_greedy(damping: str, bound: float, runs: int, k: int) -> None:
    found = first_below(trained(damping)[1], bound)
    sys.stdout.write(f"{damping} {bound:g}: runs, modes {found}\n")
    assert found[0] <= runs
    assert found[1] <= k


@pytest.mark.slow
@pytest.mark.ranks(2)
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("damping", DAMPINGS)
def test_the_bound_holds_over_the_box(damping: str, part: int) -> None:
    """125 parameters in five parts, three sizes each, every step."""
    show(f"{damping} part {part}", certified_part(damping, part))


@pytest.mark.slow
@pytest.mark.ranks(2)
@pytest.mark.parametrize("damping", DAMPINGS)
def test_effectivity_over_the_box(damping: str) -> None:
    each = [certified_part(damping, part) for part in range(PARTS)]
    found = {size: np.vstack([rows[size] for rows in each]) for size in each[0]}
    show(damping, found)
    assert len(found[20, 20]) == 125
    for size, (median, most) in LIMITS[damping].items():
        top = found[size][:, 2]
        assert np.median(top) <= median
        assert top.max() <= most


@pytest.mark.slow
@pytest.mark.ranks(2)
def test_a_model_of_bound_1e_3_is_far_better_than_it_proves() -> None:
    model, whole = trained("kv")
    for place in parameters(0)[::4]:
        system, full = full_at(model, whole.materials(*place))
        run = whole.run(system.materials, replace(whole.drive, finer=None), allow=True)
        assert compared(system, full, whole, whole, run, place)[0] <= 1e-4


@pytest.mark.slow
@pytest.mark.ranks(2)
@pytest.mark.parametrize("damping", DAMPINGS)
def test_one_rank_and_two_say_the_same(damping: str, mpi_tmp_path: Path) -> None:
    """125 parameters, three sizes: the bound of one basis at every step, built on one rank and on all."""
    model, whole = trained(damping)
    save_certified(whole, mpi_tmp_path / "model.h5")
    alone = build(model.scene, comm=MPI.COMM_SELF)
    hand = 2 * alone.system.layout.n_s
    fine = load_certified(mpi_tmp_path / "model.h5", alone.system.layout).fine
    Phi = fine.reconstruction.L_q[:, hand : hand + whole.k2]
    space = ResidualSpace(alone.system, whole.norms.reference)
    space.extend(Phi)
    own = certified_model(alone, Phi, space=space)
    space.destroy()
    many, drive = [whole.materials(*place) for place in parameters(100)], replace(whole.drive, finer=None)
    worst = 0.0
    for size in DAMPINGS[damping][3]:
        pairs = zip(*(m.with_sizes(*size).run_batch(many, drive) for m in (whole, own)), strict=True)
        for a, b in ((x.certificate.energy, y.certificate.energy) for x, y in pairs):
            assert close(a.values, b.values) <= 1e-10, size
            worst = max(worst, close(a.values, b.values))
    sys.stdout.write(f"{damping}: {worst:.1e}\n")


OTHERS: dict[str, tuple[tuple[str, ...], tuple[float, float, float]]] = {
    "lambda < 0": ((), (-5.0, 50.0, 1.0)),
    "lambda / mu = 100": ((), (5000.0, 50.0, 1.0)),
    "softer than the box": ((), (3.0, 2.0, 1.0)),
    "rho 2": ((), (122.5, 100.0, 2.0)),
    "rho 0.25": ((), (122.5, 100.0, 0.25)),
    "dt / 4": (("time.steps=2400",), (122.5, 100.0, 1.0)),
    "2 dt": (("time.steps=300",), (122.5, 100.0, 1.0)),
    "4 dt": (("time.steps=150",), (122.5, 100.0, 1.0)),
    "other direction": (("motion.target=[3.0,-5.0]",), (122.5, 100.0, 1.0)),
    "in 1 s": (("motion.duration=1.0", "time.end=3.0"), (122.5, 100.0, 1.0)),
    "in 0.2 s": (("motion.duration=0.2", "time.end=3.0"), (122.5, 100.0, 1.0)),
}


@pytest.mark.slow
@pytest.mark.ranks(2)
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("damping", DAMPINGS)
def test_what_was_not_trained(damping: str, name: str) -> None:
    """The bound rules, not the box: it holds for other steps, densities and motions, and is large where it must be."""
    whole, (changes, place) = trained(damping)[1], OTHERS[name]
    model = paper(*DAMPINGS[damping][0], *changes)
    system, full = full_at(model, whole.materials(*place))
    drive = scene_drive(model.scene, model.system.M_hand, 1)
    for size in ((16, 48), (48, 48)):
        own = whole.with_sizes(*size)
        run = own.run(system.materials, drive, allow=True)
        show(f"{damping} {name}", {size: np.array([compared(system, full, whole, own, run, (name, size))])})
