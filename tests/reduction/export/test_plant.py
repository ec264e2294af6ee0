"""The C of a reduced model against our own steps, against steps in extended precision, and under the sanitizers."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl

import softgrasp as sg
from softgrasp.fem.errors import ResourceError
from softgrasp.reduction.export import write_c
from softgrasp.reduction.export.affine import affine_plant
from softgrasp.reduction.system import ModelError, UnstableModelError
from tests.helpers.exported import MODELS, of_kind, state_matrices, with_terms
from tests.helpers.models import LAYERS
from tests.helpers.reduced import DAMPED, KINDS

pytestmark = [
    pytest.mark.serial,
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler cc here"),
]


def make(folder: Path, *targets: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "-C", str(folder), *targets], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("kind", KINDS)
def test_sums_are_the_model_at_any_material(kind: tuple[Any, Any, bool]) -> None:
    """Both kinds of coordinates and frames, two layers, a material three times as stiff and half as viscous."""
    model = of_kind(kind, DAMPED, {"tissue": {"layers": LAYERS}})
    materials = tuple(replace(m, mu=3.0 * m.mu, lam=0.5 * m.lam, beta=0.5 * m.beta) for m in model.materials)
    plant = affine_plant(model, 1e-3)
    E, A = state_matrices(plant, np.array([[m.mu, m.lam, m.beta] for m in materials]))
    system = model.at(materials)
    ours, theirs = np.linalg.solve(E, A), np.linalg.solve(system.E * plant.d, system.A * plant.d)
    assert abs(ours - theirs).max() < 1e-11 * abs(theirs).max()  # two inverses of matrices of condition 1e4


@pytest.mark.parametrize("name", MODELS)
def test_c_takes_our_own_steps(name: str, tmp_path: Path) -> None:
    """Silent with all warnings as errors, and with the sanitizers; two materials; bad inputs change nothing."""
    write_c(MODELS[name](), tmp_path)
    done = make(tmp_path, "test")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    found = re.findall(r"400 ticks: .* output (\S+), allowed (\S+); bad inputs refused", done.stdout)
    assert len(found) == 2
    # our own steps of an undamped model are rotations, rounded to a length of 1 and not to the nearest angle
    least = 1e-11 if name == "undamped" else 1e-13
    assert all(least <= float(allowed) <= 10 * least for _, allowed in found)  # these bases are well-conditioned
    assert all(0 < float(value) <= float(allowed) for value, allowed in found)


@pytest.mark.parametrize("method", ["craig_bampton", "psd"])
def test_own_terms_are_called_by_their_names_and_masses_and_loads_stay(method: str) -> None:
    """Also in canonical coordinates, where own damping is part of E."""
    model = with_terms(method)
    plant = affine_plant(model, 1e-3)
    names = [label.name for label, able in zip(plant.constants(), plant.tunable(), strict=True) if able]
    assert names == ["mu", "lambda", "beta", "bed", "beta_bed", "air"]
    rows = {m.part: i for i, m in enumerate(model.materials)}
    changed = list(model.materials)
    theta = plant.theta.copy()
    for part, value in (("bed", 55.0), ("air", 0.9)):
        changed[rows[part]] = replace(changed[rows[part]], mu=value)
        theta[rows[part], 0] = value
    E, A = state_matrices(plant, theta)
    system = model.at(tuple(changed))
    ours, theirs = np.linalg.solve(E, A), np.linalg.solve(system.E * plant.d, system.A * plant.d)
    assert abs(ours - theirs).max() < 1e-10 * abs(theirs).max()  # two inverses of matrices of condition 1e4
    assert plant.f.any()


def test_parameters_of_an_energy_have_its_names_in_every_layer() -> None:
    def W(F: Any, p: Any) -> Any:
        log, stretch = ufl.ln(ufl.det(F)), ufl.dot(F[:, 0], F[:, 0]) - 1
        return p.mu / 2 * (ufl.inner(F, F) - 2) - p.mu * log + p.lam / 2 * log**2 + p.k1 / 4 * stretch**2

    tissue = {"cells": [4, 8], "energy": "given", "parameters": {"k1": 20.0}, "layers": LAYERS}
    model = sg.build("paper_lqr", tissue=tissue, energy=W)
    plant = affine_plant(sg.reduce(model, sg.simulate(model), "craig_bampton", N=14), 1e-3)
    names = [label.name for label, able in zip(plant.constants(), plant.tunable(), strict=True) if able]
    assert len(set(names)) == len(names)
    assert {"mu_1", "mu_2", "k1_1", "k1_2", "beta_k1_2"} <= set(names)


def test_the_tolerance_is_what_rounding_of_the_model_changes(tmp_path: Path) -> None:
    """An ill-conditioned basis: fixed digits refused 9 of 21 saved models, whose C was right."""
    model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    rom = sg.reduce(model, sg.simulate(model), "psd_svd_like", N=20)
    write_c(rom, tmp_path)
    done = make(tmp_path, "test")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_test_finds_a_wrong_digit(tmp_path: Path) -> None:
    """A number that is off by 1e-9 of itself, and a log without its end."""
    write_c(MODELS["gravity"](), tmp_path)
    data, log = tmp_path / "plant_data.h", tmp_path / "golden.log"

    def replayed() -> int:
        assert make(tmp_path, "test_plant", "CFLAGS=-std=c99").returncode == 0
        return subprocess.run(["./test_plant", log.name], cwd=tmp_path, capture_output=True).returncode

    assert replayed() == 0
    text, golden = data.read_text(), log.read_text()
    number = next(word for word in re.findall(r"-?0x[\w.]+p[-+]\d+", text.split("LOAD")[1]) if float.fromhex(word))
    data.write_text(text.replace(number, (float.fromhex(number) * (1 + 1e-9)).hex()))
    assert replayed() == 1
    data.write_text(text)
    log.write_text(golden[:-200])
    assert replayed() == 2


def test_nothing_is_called(tmp_path: Path) -> None:
    """No allocation, no output, no mathematical library: the object needs memcpy and its like at most."""
    write_c(MODELS["gravity"](), tmp_path)
    subprocess.run(["cc", "-std=c99", "-O3", "-c", "plant.c"], cwd=tmp_path, check=True)
    names = subprocess.run(["nm", "-u", "plant.o"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert set(names.split()) <= {"U", "memcpy", "memset", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}


def test_what_cannot_be_exported_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = MODELS["gravity"]()
    with pytest.raises(ModelError, match=r"tick = 0 s: the time step must be a positive number"):
        write_c(model, tmp_path / "plant", 0.0)
    with pytest.raises(UnstableModelError, match="unstable"):
        write_c(replace(model, alpha=-50.0), tmp_path / "plant")
    (tmp_path / "file").write_text("kept")
    with pytest.raises(ResourceError, match="file cannot be written"):
        write_c(model, tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
