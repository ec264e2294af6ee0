"""Fits with a certified model: one basis for its box, and a proof as the part of the reduction."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.certified.archive import save_certified
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.training import certified_model
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.system import ModelError

pytestmark = pytest.mark.serial
KEYS = [
    "tissue.cells=[6,12]", "tissue.order=2", "time.steps=100", "effects.damping={kind='kelvin-voigt',beta=0.01}",
    "output.snapshots='none'",
]  # fmt: skip
NOISE = 1e-2


@cache
def model(*keys: str) -> Any:
    return sg.build("paper_forward", [*KEYS, *keys])


@cache
def certified(most: float = 120.0) -> CertifiedModel:
    """Twelve modes, checked by 40, for materials in a box."""
    own = model()
    Phi = lowest_modes(own.system, 40)[1]
    box = ParameterDomain((30.0, 90.0), (40.0, most))
    return certified_model(own, Phi, k=12, places=[own.system.materials], box=box)


def data() -> Measurements:
    run = sg.simulate(model("tissue.material.mu=70", "effects.damping.beta=0.012"))
    return Measurements("tip", run.times, run.outputs + np.random.default_rng(0).normal(0, NOISE, run.outputs.shape))


def test_the_part_of_the_reduction_is_a_proof() -> None:
    found = sg.identify(model(), data(), "mu,beta", NOISE, certified=certified(), law="linear")
    assert found.kinds["reduction"] == "proved, at most"
    assert len(found.history) == 2  # one round: no other basis is made
    assert found.N == 2 * (2 + 12)
    near = sg.identify(model(), data(), "mu,beta", NOISE, N=60, law="linear")
    moved = np.log(found.values / near.values) - near.parts["reduction"]
    # to first order, the curvature of what it moves by is far below it
    assert (np.abs(moved) <= 1.01 * found.parts["reduction"]).all()
    assert found.parts["reduction"][0] < 10 * abs(moved[0])  # and no wild overestimate of what it moves most
    assert found.values == pytest.approx(near.values, rel=0.05)


def test_files_serve_and_other_scenes_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "certified.h5"
    save_certified(certified(), file)
    found = sg.identify(model(), data(), "mu", NOISE, certified=file, law="linear")
    own = sg.identify(model(), data(), "mu", NOISE, certified=certified(), law="linear")
    assert found.values == pytest.approx(own.values, rel=1e-9)  # the same numbers, the fit ends at 1e-9
    with pytest.raises(ModelError, match="was built"):
        sg.identify(model("effects.gravity={g=[0.0,-1.0]}"), data(), "mu", NOISE, certified=certified())
    with pytest.raises(SceneError, match="its bound is of linear elasticity"):
        sg.identify(model(), data(), "mu", NOISE, certified=certified(), law="neo-hooke")
    with pytest.raises(ModelError, match="cannot be read as a reduced model"):
        sg.identify(model(), data(), "mu", NOISE, certified=tmp_path / "none.h5")


def test_a_value_at_the_end_of_the_box_is_refused() -> None:
    found = sg.identify(model(), data(), "mu", NOISE, certified=certified(60.0), law="linear")
    assert found.values[0] == pytest.approx(60, rel=1e-5)
    assert any(reason.startswith("mu ends at the end of the box of the certified model") for reason in found.reasons)
