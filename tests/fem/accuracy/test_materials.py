"""Estimates of a model at materials, or with a damping, that its scene does not name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from mpi4py import MPI

from softgrasp.fem.accuracy.estimate import estimate
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from tests.fem.accuracy.test_accuracy import TIP, deformation, error, with_refine
from tests.helpers.models import LAYERS, make_scene

SOFT, HARD = ({"lambda": lam, "mu": mu, "rho": rho} for lam, mu, rho in ((50.0, 50.0, 1.0), (400.0, 9000.0, 3.0)))
KINDS: dict[str, Any] = {
    "linear": {},
    "finite strain": {"effects": {"finite_strain": {"law": "neo-hooke"}}},
    "next order": {"tissue": {"refine": {}}},
    "damped layers": {
        "tissue": {"layers": LAYERS},
        "effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.01}},
    },
}  # fmt: skip


def at(model: Model, to: dict[str, float]) -> Model:
    return model.with_materials(to["lambda"], to["mu"], to["rho"])


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_estimate_takes_the_materials_of_the_model(comm: MPI.Intracomm, kind: Any) -> None:
    """The model of a soft scene made hard, and that of the hard scene, have one estimate."""
    layers = {name: layer | {"material": HARD} for name, layer in LAYERS.items()}
    hard = {"tissue": {"material": HARD} | ({"layers": layers} if "layers" in kind.get("tissue", {}) else {})}
    moved, built = at(build(make_scene(kind, TIP), comm=comm), HARD), build(make_scene(kind, hard, TIP), comm=comm)
    result, same = estimate(moved), estimate(built)
    assert result.estimate == pytest.approx(same.estimate, rel=1e-8)  # sums of the same matrices, rounded otherwise
    assert result.bound == pytest.approx(same.bound, rel=1e-8)
    assert result.estimate != pytest.approx(estimate(at(built, SOFT)).estimate, rel=0.05)


def test_estimate_at_another_material_is_the_error_there(comm: MPI.Intracomm) -> None:
    """Against the run of a fine graded mesh of that material."""
    moved = at(build(make_scene(TIP), comm=comm), HARD)
    fine = build(with_refine(make_scene(TIP, {"tissue": {"material": HARD}}), 2, 3e-3), comm=comm)
    true = error(deformation(simulate(moved)), deformation(simulate(fine)))
    assert 0.8 <= estimate(moved).estimate / true <= 1.1  # as for the scene's own material


def test_estimate_takes_the_damping_of_the_model(comm: MPI.Intracomm) -> None:
    plain = build(make_scene(TIP), comm=comm)
    damping = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.5, "beta": 0.05, "drag": "space"}}}
    damped = build(make_scene(TIP, damping), comm=comm)
    changed = replace(plain, system=replace(plain.system, damping=damped.system.damping))
    assert estimate(changed).estimate == pytest.approx(estimate(damped).estimate, rel=1e-8)
    assert estimate(plain).estimate != pytest.approx(estimate(damped).estimate, rel=0.01)


def test_other_materials_drop_the_estimate_of_the_mesh(comm: MPI.Intracomm) -> None:
    model = build(make_scene(TIP), comm=comm)
    assert at(replace(model, accuracy=estimate(model)), HARD).accuracy is None
