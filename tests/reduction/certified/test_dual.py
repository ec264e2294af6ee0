"""Duals of outputs: what is computed and what is left against full runs, at every step, on any rank count."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.dual import corrected
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.training import certified_model
from softgrasp.reduction.parameters import materials_at
from tests.helpers.certified import EQUILIBRIUM, KELVIN_VOIGT, full_at
from tests.helpers.models import LAYERS, make_scene

RAYLEIGH = {"effects": {"damping": {"kind": "rayleigh", "beta": 0.004, "alpha": 0.4, "drag": "space"}}}
SCENES: dict[str, tuple[dict[str, Any], ...]] = {
    "undamped": (),
    "kelvin-voigt": (KELVIN_VOIGT,),
    "rayleigh from equilibrium": (RAYLEIGH, EQUILIBRIUM),
    "layers": (KELVIN_VOIGT, {"tissue": {"layers": LAYERS}}),
    "pushed": (KELVIN_VOIGT, {"motion": {"drive": "force"}}),
}
ROUNDING = 1e-9  # of the largest output


def made(comm: MPI.Intracomm, *changes: dict[str, Any], k: int = 10, k2: int = 20) -> tuple[Model, CertifiedModel]:
    model = build(make_scene(*changes), comm=comm)
    own = model.system.materials[0]
    places = [materials_at(model, a * own.lam, b * own.mu) for a in (0.6, 2.0) for b in (0.6, 2.0)]
    return model, certified_model(model, lowest_modes(model.system, k2)[1], k=k, places=places)


@pytest.mark.parametrize("name", list(SCENES))
def test_the_bound_of_outputs_holds_at_every_step(comm: MPI.Intracomm, name: str) -> None:
    model, certified = made(comm, *SCENES[name])
    own = model.system.materials[0]
    for a, b in ((1.0, 1.0), (0.6, 1.8), (1.9, 0.5), (5.0, 3.0)):  # the last outside of what the duals are made for
        materials = materials_at(model, a * own.lam, b * own.mu)
        _, full = full_at(model, materials)
        run = certified.run(materials, allow=True)
        plain = replace(certified, duals=None).run(materials, allow=True)
        off, size = np.abs(run.trajectory.outputs - full.outputs), np.abs(full.outputs).max()
        assert (run.certificate.outputs.values >= off - ROUNDING * size).all()
        assert (run.certificate.outputs.values <= plain.certificate.outputs.values).all()


@pytest.mark.parametrize("name", ["kelvin-voigt", "rayleigh from equilibrium"])
def test_damped_outputs_are_bounded_sharply(comm: MPI.Intracomm, name: str) -> None:
    """Each within four times the truth in the median, where the bound of the energy norm is several times that."""
    model, certified = made(comm, *SCENES[name])
    own, ratios = model.system.materials[0], []
    for a, b in np.random.default_rng(2).uniform(0.6, 2.0, (8, 2)):
        materials = materials_at(model, a * own.lam, b * own.mu)
        _, full = full_at(model, materials)
        pair = [m.run(materials, allow=True) for m in (certified, replace(certified, duals=None))]
        truth = np.abs(pair[0].trajectory.outputs - full.outputs).max(axis=0)
        ratios.append([run.certificate.outputs.largest / truth for run in pair])
    sharp, plain = np.median(ratios, axis=(0, 2))
    assert sharp <= 4.0
    assert plain > 2 * sharp


def test_the_computed_part_is_most_of_the_error(comm: MPI.Intracomm) -> None:
    """Of the larger basis itself, whose outputs it corrects; the rest stays within its own bound."""
    model, certified = made(comm, KELVIN_VOIGT, k=20)
    assert certified.duals is not None
    assert certified.drive is not None
    materials = model.system.materials
    _, full = full_at(model, materials)
    g, drive = np.zeros(2), certified.drive
    (motion,) = certified._motions(20, [materials], drive, g, False)
    compliance = certified.norms.static_factor(materials) * certified.compliance
    arguments = certified.fine, certified.norms, motion, materials, drive, g, compliance, np.full(2, np.inf)
    found = corrected(certified.duals, *arguments)
    assert found is not None
    change, rest = found
    off, left = full.outputs - motion.outputs, full.outputs - motion.outputs - change
    assert (np.abs(left) <= rest + ROUNDING * np.abs(full.outputs).max()).all()
    assert np.abs(left).max() < 0.3 * np.abs(off).max()


@pytest.mark.ranks(2)
def test_one_rank_and_all_say_the_same(comm: MPI.Intracomm) -> None:
    (_, mine), (_, theirs) = made(comm, KELVIN_VOIGT), made(MPI.COMM_SELF, KELVIN_VOIGT)
    a, b = (m.run(allow=True).certificate.outputs.values for m in (mine, theirs))
    assert np.abs(a - b).max() < 1e-4 * b.max()  # POD of nearly dependent modes: the basis turns with rounding


@pytest.mark.serial
def test_a_file_keeps_the_duals(comm: MPI.Intracomm, mpi_tmp_path: Any) -> None:
    _, certified = made(comm, KELVIN_VOIGT)
    save_certified(certified, mpi_tmp_path / "duals.h5")
    again = load_certified(mpi_tmp_path / "duals.h5")
    one, two = (m.run(allow=True) for m in (certified, again))
    assert two.certificate.sentence() in repr(two)
    assert len(repr(certified)) < 1000
    assert "<tr>" in certified._repr_html_()
    assert len(repr(two.certificate)) < 300
    assert all(value in repr(two.certificate) for value in re.findall(r"[\d.]+ %", two.certificate.sentence()))
    a, b = one.certificate.outputs.values, two.certificate.outputs.values
    assert np.array_equal(a, b)
    assert again.with_sizes(5, 10).duals is None


@pytest.mark.serial
def test_modes_are_those_of_the_matrices_at_hand() -> None:
    """Kept factors belong to the object and its densities, not to what is replaced or came before [pairs of SciPy]."""
    rng, one = np.random.default_rng(1), np.zeros((1, 4, 2))
    X = rng.standard_normal((3, 1, 4, 4))
    K_mu, K_lambda, M = X @ X.transpose(0, 1, 3, 2) + np.eye(4)
    blocks = SecondOrder(K_mu, K_lambda, M, one)
    for dense in (1.0, 2.0):
        for each in (blocks, replace(blocks, K_mu=5 * K_mu), replace(blocks, M=3 * M), blocks):
            p: Any = SimpleNamespace(
                materials=[SimpleNamespace(dense=dense, beta=0.0)],
                stiffness=lambda a, b: a[0] + 2 * b[0],
                density=lambda a, dense=dense: dense * a[0],
                damped=False,
            )
            modes, pencil = each.modes(p), (each.K_mu[0] + 2 * each.K_lambda[0], dense * each.M[0])
            np.testing.assert_allclose(modes.omega**2, scipy.linalg.eigh(*pencil, eigvals_only=True), rtol=1e-10)
            np.testing.assert_allclose(modes.X.T @ pencil[1] @ modes.X, np.eye(4), atol=1e-10)  # of condition 1e3
