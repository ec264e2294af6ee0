"""Linear elasticity and finite strain: which of them the data get, and what the answer says of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.model.scales import gradient
from softgrasp.reduction.identify.beyond import linear_range
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.fit import Misfit, Nuisances
from softgrasp.reduction.identify.near import Near, experiment
from softgrasp.reduction.identify.unknowns import parse_unknowns, scene_at, value_of

pytestmark = pytest.mark.serial
TRUTH = {"mu": 70.0, "beta": 0.025}
SQUARE = [
    "tissue.size=[1.0,1.0]", "contact.sides=['top']", "contact.box=[[0.0,0.9],[1.0,1.0]]", "motion.target=[3.0,0.0]",
    "motion.duration=1.5", "time.end=3.0", "output.snapshots='none'", "tissue.order=2",
]  # fmt: skip
FIT = [*SQUARE, "tissue.refine={tolerance=1e-2}", "time.steps=300", "effects.damping={kind='kelvin-voigt',beta=0.02}"]
NEO = "effects.finite_strain={law='neo-hooke'}"


@cache
def data(noise: float, law: str = NEO, every: int = 2) -> Measurements:
    """Measurements of a run on a mesh and with steps finer than those of every fit."""
    keys = [
        *SQUARE, "tissue.refine={tolerance=3e-3}", "time.steps=600", "tissue.material.mu=70",
        "effects.damping={kind='kelvin-voigt',beta=0.025}", *filter(None, [law]),
    ]  # fmt: skip
    run = sg.simulate(sg.build("paper_forward", keys))
    y = run.outputs[::every]
    return Measurements("tip", run.times[::every], y + np.random.default_rng(0).normal(0, noise, y.shape))


@cache
def model(*keys: str) -> Any:
    return sg.build("paper_forward", [*FIT, *keys])


@cache
def automatic() -> Any:
    return sg.identify(model(), data(1e-2), "mu,beta", 1e-2)


def errors(found: Any) -> Any:
    """Values over the truth, less one."""
    return found.values / [TRUTH[u.name] for u in found.unknowns] - 1


def test_data_of_large_strain_get_a_fit_at_finite_strain() -> None:
    found = automatic()
    assert found.law == "neo-hooke"
    assert found.warnings[0].startswith("Linear elasticity is beyond its range: it changes beta by about")
    assert "finite strain with the law neo-hooke" in found.warnings[0]
    assert found.reasons == ()
    assert (np.abs(errors(found)) < 2 * found.total).all()
    # the model is exact at the values of its round, so that what is left is of second order in the last move
    assert (np.abs(found.parts["reduction"]) < 0.1 * found.noise).all()
    assert found.kinds["mesh"] == "estimated by linear elasticity at the values"
    assert found.scene.effects.finite_strain.law == "neo-hooke"
    assert found.model.system.points is not None
    # without gravity and drag a motion depends on stiffness over density alone, at finite strain too, and on beta
    assert found.assumed["rho"] + found.assumed["lambda"] == pytest.approx([1, 0], abs=1e-3)  # differences of 2e-5


@pytest.mark.parametrize("noise", [1e-2, 3e-3])
def test_a_linear_fit_of_neo_hookean_data_does_not_pass_in_silence(noise: float) -> None:
    found = sg.identify(model(), data(noise), "mu,beta", noise, law="linear")
    assert (np.abs(errors(found)) > found.total).any()
    misfit = any(reason.startswith("The misfit is") for reason in found.reasons)
    assert misfit == (noise < 1e-2)  # it speaks only where the noise is small,
    assert any("Linear elasticity has an error of about" in text for text in found.warnings)  # the strain always does


@pytest.mark.slow  # the quick one is below, without a reduced model
def test_linear_data_keep_linear_values_whatever_the_strain() -> None:
    found = sg.identify(model(), data(1e-2, ""), "mu,beta", 1e-2)
    assert found.law == "linear"
    assert found.warnings[-1].startswith("Finite strain (neo-hooke) matters at these strains, and fits worse")
    assert "linear elasticity" not in found.parts
    assert (np.abs(errors(found)) < 2 * found.total).all()


@pytest.mark.parametrize("law", [NEO, ""])
def test_laws_that_explain_the_data_alike_leave_linear_values_and_their_difference_as_a_part(
    law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data of either law, with noise that hides which of them it was: 2 cm of 20 cm."""
    sure, noise = automatic(), 2e-2
    monkeypatch.setattr("softgrasp.reduction.identify.strained.Strained._around", fails)  # full runs are quicker
    found = sg.identify(model(), data(noise, law), "mu,beta", noise)
    assert (found.law, found.reasons) == ("linear", ())
    assert found.warnings[-1].startswith("Finite strain (neo-hooke) changes beta by about 4.")
    assert "the data do not decide between it and linear elasticity" in found.warnings[-1]
    part = found.parts["linear elasticity"]
    without = replace(found, parts={name: x for name, x in found.parts.items() if name != "linear elasticity"})
    assert found.kinds["linear elasticity"] == "difference to the fit with the law neo-hooke"
    assert np.abs(part[1]) > found.noise[1]  # else one run at finite strain is the part, without a second fit
    # what linear fits differ by from those at finite strain where the noise is half as large, up to their misfit
    linear = sg.identify(model(), data(1e-2), "mu,beta", 1e-2, law="linear")
    assert part == pytest.approx(np.log(linear.values / sure.values), abs=0.02)  # 4 % of beta is the largest
    assert found.total - without.total == pytest.approx(np.abs(part))
    assert (np.abs(np.log(found.values / list(TRUTH.values()))) < 2 * found.total).all()


@pytest.mark.slow  # two layers, whose values are three times as far as the noise from each other: 30 s
def test_two_layers_under_linear_data_have_the_truth_within_their_errors() -> None:
    layers, fine = (
        sg.build("layers_2d", ["output.snapshots='none'", *keys])
        for keys in ([], ["tissue.order=3", "time.steps=1600"])
    )
    unknowns = parse_unknowns(["mu", "fat.mu"], layers)
    truth = np.array([1.3, 1.5]) * [value_of(layers.system.materials, u) for u in unknowns]
    run = sg.simulate(sg.build(scene_at(fine.scene, unknowns, truth)))
    y = run.outputs[::8]
    noisy = Measurements("skin", run.times[::8], y + np.random.default_rng(0).normal(0, 3e-5, y.shape))
    found = sg.identify(layers, noisy, "mu,fat.mu", 3e-5)
    assert (found.law, found.reasons) == ("linear", ())
    assert (np.abs(np.log(found.values / truth)) < found.total).all()


def test_finite_strain_that_the_noise_hides_is_a_part_of_the_error() -> None:
    found = sg.identify(model(), data(3e-2), "mu,beta", 3e-2)
    assert (found.law, found.reasons) == ("linear", ())
    part, truth = found.parts["linear elasticity"], automatic()
    assert (np.abs(part) < found.noise).all()
    # what the linear fit of little noise differs by from that at finite strain, up to its own misfit
    linear = sg.identify(model(), data(1e-2), "mu,beta", 1e-2, law="linear")
    assert part == pytest.approx(np.log(linear.values / truth.values), abs=0.02)  # 4 % of beta is the largest


def test_small_strain_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.reduction.identify.beyond.strain_part", None)
    small = model("motion.target=[0.003,0.0]")
    run = sg.simulate(small)
    y = run.outputs + np.random.default_rng(0).normal(0, 1e-5, run.outputs.shape)
    found = sg.identify(small, Measurements("tip", run.times, y), "mu", 1e-5)
    assert (found.law, found.warnings, set(found.parts)) == ("linear", (), {"mesh", "time step", "reduction"})


def fails(*_: Any) -> None:
    raise SolverError("the body folds")


def test_without_a_reduced_model_full_runs_and_linear_slopes_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.reduction.identify.strained.Strained._around", fails)
    found = sg.identify(model(), data(1e-2), "mu,beta", 1e-2)
    assert (found.law, found.reasons) == ("neo-hooke", ())
    assert found.warnings[0].endswith("for no reduced model runs there: the body folds")
    # other slopes weigh the noise in another way, by less than it is
    assert (np.abs(np.log(found.values / automatic().values)) < found.noise).all()
    assert (np.abs(errors(found)) < 2 * found.total).all()
    # rounds settle where a value moves by 5 %, and the small model is exact to second order in that
    assert (np.abs(found.parts["reduction"]) < found.noise).all()
    linear = sg.identify(model(), data(1e-2, ""), "mu,beta", 1e-2)
    assert (linear.law, linear.reasons) == ("linear", ())
    assert linear.warnings[-1].startswith("Finite strain (neo-hooke) matters at these strains, and fits worse")


def test_a_fit_at_finite_strain_that_fails_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("Strained._around", "Corrected.__init__"):
        monkeypatch.setattr(f"softgrasp.reduction.identify.strained.{name}", fails)
    found = sg.identify(model(), data(1e-2), "mu,beta", 1e-2)
    assert found.law == "linear"
    assert found.reasons[-1].endswith("and the fit at finite strain fails: the body folds")


def test_the_range_of_linear_elasticity_does_not_depend_on_the_mesh() -> None:
    """The mean of |grad z|^2 converges beside the singular ends of the hand, where the largest does not."""
    found, largest = [], []
    for tolerance in (3e-2, 1e-2, 3e-3):
        at = sg.build("paper_forward", [*FIT, f"tissue.refine.tolerance={tolerance}"])
        experiments = [experiment(at, data(1e-2), Path())]
        near = Near(at, parse_unknowns(["mu"], at), np.array([50.0]), 36, experiments)
        misfit = Misfit(near, experiments, np.array([1e-2, 1e-2]), Nuisances((), ()))
        found.append(linear_range(misfit, np.log([50.0])).error)
        Z = near.displacements(np.array([50.0]), misfit.answers(np.log([50.0]))[1][0], 20)
        assert Z is not None
        largest.append(gradient(at, Z[:, -1]).largest)
    assert max(found) / min(found) < 1.03  # the meshes differ by their errors, 3 % and less
    assert largest[-1] / largest[0] > 1.3


def test_a_scene_at_finite_strain_is_fitted_with_its_law_gravity_and_two_motions() -> None:
    keys = [
        "effects.gravity={g=[0.0,-1.0]}",
        "time.start='equilibrium'",
        "effects.finite_strain={law='neo-hooke-quadratic'}",
    ]
    coarse = [*SQUARE, "tissue.cells=[4,4]", "time.steps=60", "effects.damping={kind='kelvin-voigt',beta=0.02}", *keys]
    true = sg.build("paper_forward", [*coarse, "tissue.material.mu=58"])
    run = sg.simulate(true)
    other = sg.simulate(sg.build("paper_forward", [*coarse, "tissue.material.mu=58", "motion.target=[-1.0,2.0]"]))
    rng = np.random.default_rng(3)
    both = [
        Measurements("scene", run.times, run.outputs + rng.normal(0, 1e-2, run.outputs.shape)),
        Measurements("hand", run.times, other.outputs + rng.normal(0, 1e-2, run.outputs.shape), (run.times, other.q_s)),
    ]
    found = sg.identify(sg.build("paper_forward", coarse), both, "mu", 1e-2, N=20)
    assert found.law == "neo-hooke-quadratic"
    assert abs(found.values[0] / 58 - 1) < 4 * found.noise[0]  # deviations; the mesh is that of the data
    assert found.residuals.misfit < found.residuals.limit
    with pytest.raises(SceneError, match="at finite strain identify fits mu, lambda and beta"):
        sg.identify(true, both, "rho", 1e-2)


def test_what_does_not_go_with_finite_strain_is_refused_in_a_sentence() -> None:
    pushed = sg.build("paper_forward", ["tissue.cells=[4,8]", "time.steps=100", "motion.drive='force'"])
    run = sg.simulate(pushed)
    measured = Measurements("tip", run.times, run.outputs)
    with pytest.raises(SceneError, match="needs the motion of the hand, and a force moves it"):
        sg.identify(pushed, measured, "mu", 1e-2, law="neo-hooke")
    turned = sg.build("block_3d", ["tissue.order=1", "tissue.refine={grading='off'}", "time.steps=20"])
    y = sg.simulate(turned).outputs
    with pytest.raises(SceneError, match=r"effects\.rotation does not go with finite strain"):
        sg.identify(turned, Measurements("tip", 0.05 * np.arange(21), y), "mu", 1e-2, law="neo-hooke")
