"""pyMOR's models are ours at every material, with the names and units of inputs, outputs and parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.pymor import parameter_values
from softgrasp.fem.petsc import to_scipy
from tests.helpers.models import LAYERS

pytest.importorskip("pymor")
pytestmark = pytest.mark.serial
POINTS = (0.7, 2.0 + 1.0j, 9.0j)
SCENES = {
    "undamped": [],
    "viscous": ["effects.damping={kind='rayleigh', beta=0.02, alpha=0.3}"],
    "two-way": ["effects.reaction=true", "effects.damping={kind='rayleigh', beta=0.02, alpha=0.3, drag='space'}"],
}
METHODS = ("craig_bampton", "psd_svd_like", "componentwise_pod")


def change(materials: tuple) -> tuple:
    """Other constants in every layer, densities by one factor."""
    return tuple(
        replace(m, mu=(1.3 + 0.2 * i) * m.mu, lam=0.6 * m.lam, rho=1.5 * m.rho, beta=2 * m.beta)
        for i, m in enumerate(materials)
    )


@pytest.fixture(scope="module", params=SCENES)
def model(request: pytest.FixtureRequest) -> sg.Model:
    damped = request.param != "undamped"
    layers = {name: {k: v for k, v in layer.items() if damped or k != "beta"} for name, layer in LAYERS.items()}
    keys = ["time.steps=60", *SCENES[request.param]]
    return sg.build("paper_forward", keys, tissue={"cells": [3, 6], "layers": layers})


def test_full_model(model: sg.Model) -> None:
    """Against the equations of hand and tissue, dense."""
    theirs = model.to_pymor()
    system = model.system.with_materials(change(model.system.materials))
    values = parameter_values(system.materials)
    mu = theirs.parameters.parse({key: values[key] for key in theirs.parameters})
    assert set(theirs.parameters) == {"mu", "lambda", "rho"} | ({"beta"} if model.system.damping.active else set())
    n_s, n = system.layout.n_s, system.layout.n_e
    assert theirs.order == n_s + n
    M, K = to_scipy(system.M_ee).toarray(), to_scipy(system.K_ee).toarray()
    D = system.damping.alpha * M
    for m, layer in zip(system.materials, system.layers, strict=True):
        D += m.beta * (m.mu * to_scipy(layer.K_mu.ee) + m.lam * to_scipy(layer.K_lambda.ee)).toarray()
    drag, back = system.damping.drag, float(system.two_way)
    C_s, C = np.vstack([o.C_s for o in model.outputs]), model.output_columns.T
    for s in POINTS:
        tissue = s * s * M + s * D + K
        pushed = (s * s + drag * s) * system.G
        hand = s * s * system.M_hand + back * (s * s + drag * s) * system.M_rigid
        matrix = np.block([[hand, back * (s * s + drag * s) * system.G.T], [pushed, tissue]])
        ours = np.hstack([C_s, C]) @ np.linalg.solve(matrix, np.eye(n_s + n)[:, :n_s])
        found = theirs.transfer_function.eval_tf(s, mu=mu)
        np.testing.assert_allclose(found, ours, atol=1e-9 * np.abs(ours).max())  # one solve each
    assert theirs.B.name == "force_x [N], force_y [N]"
    assert theirs.Cp.name == "tip_x [m], tip_y [m]"


def test_reduced_models(model: sg.Model) -> None:
    run = sg.simulate(model)
    for method in METHODS:
        rom = sg.reduce(model, run, method, N=12)
        theirs, materials = rom.to_pymor(), change(rom.materials)
        values = parameter_values(materials)
        if rom.coordinates == "qp":  # contains M_ee^-1
            materials = tuple(replace(m, rho=old.rho) for m, old in zip(materials, rom.materials, strict=True))
        assert ("rho" in theirs.parameters) == (rom.coordinates == "qv")
        mu = theirs.parameters.parse({key: values[key] for key in theirs.parameters})
        small = rom.at(materials)
        for s in POINTS:
            ours = small.transfer([s])[0]
            # one solve each, and parts that are differences of matrices
            np.testing.assert_allclose(theirs.transfer_function.eval_tf(s, mu=mu), ours, atol=1e-8 * abs(ours).max())
        assert (theirs.name, theirs.B.name, theirs.C.name) == (
            rom.name, "force_x [N], force_y [N]", "tip_x [m], tip_y [m]",
        )  # fmt: skip
        assert small.to_pymor().C.name == theirs.C.name


def test_finite_strain_is_refused() -> None:
    model = sg.build("paper_forward", ["tissue.cells=[2,4]", "effects.finite_strain={}"])
    with pytest.raises(SoftgraspError, match=r"leave out effects\.finite_strain"):
        model.to_pymor()
