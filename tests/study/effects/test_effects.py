"""effects judges scenes that are set wrong, counts what an effect adds, and proves that off is free."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.accuracy import adapt
from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.errors import ResourceError, SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.model.scales import rigid_inertia
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, load_scene_collective
from softgrasp.study.effects import measure as effects_measure
from softgrasp.study.effects.experiments import Displacements, Names, SwitchRuns, compare, displacements
from softgrasp.study.effects.measure import (
    MeasuredScene,
    bare_output,
    check_zero_cost,
    counting,
    difference,
    memory_by_object,
    objects_of,
    operator_hashes,
    read_table,
)
from softgrasp.study.effects.page import parts
from softgrasp.study.effects.result import Change, EffectResult, EffectsStudy, JointChange
from softgrasp.study.effects.run import check_variants, run_effects, study_effects
from softgrasp.study.effects.switch import TRIAL_ZETA, Scales, neutral, switches
from softgrasp.study.effects.together import advised, advised_together, finite_strain_beside
from softgrasp.study.effects.verdict import verdict_of
from softgrasp.study.report.document import show_sections
from softgrasp.study.shell.timing import RepeatableRun
from tests.helpers.browser import find_chromium, look, words_of
from tests.helpers.models import LAYERS, close, gather_states, make_scene, write_scene

QUICK = {"study": {"repeats": 1}, "time": {"steps": 20}}
CONTROL = {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}}
FORCE = {"motion": {"drive": "force"}}
SCALES = Scales(2, 2.0, (0.5,), 4.0)
ALL_ON = {
    "gravity": {"g": [0.0, -1.0]},
    "damping": {"kind": "kelvin-voigt", "beta": 0.01},
    "reaction": True,
    "rotation": True,
}


@pytest.fixture(autouse=True)
def _short_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test looks at a time, so a few steps are enough."""
    monkeypatch.setattr(effects_measure, "BURST_SECONDS", 1e-4)
    monkeypatch.setattr(effects_measure, "BURSTS", 1)


def found(comm: MPI.Intracomm, *changes: dict[str, Any], **tables: Any) -> tuple[EffectsStudy, dict[str, EffectResult]]:
    study = study_effects(make_scene(QUICK, *changes, **tables), comm)
    return study, {f.name: f for f in study.findings}


def measured(model: Any) -> MeasuredScene:
    stepper = RepeatableRun(model)
    held = memory_by_object(model, stepper.run)
    case = MeasuredScene(model, {"step": [1.0]}, operator_hashes(model, stepper.run), held, stepper.flops())
    stepper.destroy()
    case.objects, case.objects_in_steps = objects_of(model.system.layout.comm, model.scene)
    return case


# --- scenes that are set wrong


def test_variants_that_do_not_fit_are_refused_with_the_limit_of_the_scene(comm: MPI.Intracomm) -> None:
    explanation: Any = SimpleNamespace(solver=SimpleNamespace(factor_bytes=2.0**30))
    with pytest.raises(ResourceError, match=r"10.* GiB at once, where 2.* GiB are available; .* output.memory=GIB"):
        check_variants(make_scene(output={"memory": 2.5}), comm, explanation, 5)


def test_damping_without_effect_is_wasted(comm: MPI.Intracomm) -> None:
    _, by = found(comm, effects={"damping": {"kind": "kelvin-voigt", "beta": 1e-9}})
    damping = by["damping"]
    assert damping.on
    assert damping.change is not None
    assert 0 < damping.change.outputs < 1e-6  # beta is 1e-9 of a second, periods are longer than 1e-2
    assert damping.verdict == "wasted"
    assert damping.advice.startswith("Switch it off")
    assert not damping.gate.gate.matters


def test_gravity_that_matters_but_is_off_is_needed(comm: MPI.Intracomm) -> None:
    study, by = found(comm)
    gravity = by["gravity"]
    assert not gravity.on
    assert gravity.verdict == "needed"
    assert gravity.advice.startswith("Switch it on")
    assert "gravity" in study.explanation.missing
    # heavy only because it is soft: of steel it would not show
    _, hard = found(comm, tissue={"material": {"young": 2e11, "poisson": 0.3, "rho": 7850.0}}, time={"steps": 5})
    assert hard["gravity"].verdict == "optional"
    assert hard["gravity"].advice.startswith("It is right to leave it off")


def test_p1_near_incompressibility_is_repeated_in_the_report(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    scene = make_scene(QUICK, tissue={"material": {"young": 125.0, "poisson": 0.499, "rho": 1.0}}, time={"steps": 5})
    file = write_scene(comm, mpi_tmp_path, scene)
    result = run_effects(file, mpi_tmp_path / "out", ["study.tolerance=1e-2"], Console(quiet=True), quiet=True)
    (warning,) = [text for text in result["warnings"] if "P1 locks" in text]
    if comm.rank == 0:
        assert warning in words_of(mpi_tmp_path / "out" / "report.html")
    assert result["tolerance"] == 1e-2
    measured = result["elements"]
    assert measured["needed"]
    assert measured["advice"] in result["warnings"]


def test_locking_is_measured_and_not_only_suspected(comm: MPI.Intracomm) -> None:
    """The sag of a held block: what P2 changes is what two runs with outputs at one node differ by."""
    hold = {"motion": {"profile": "hold", "target": None}, "effects": {"gravity": {"g": [0.0, -1.0]}}}
    start = {"time": {"start": "equilibrium", "steps": 3}}
    soft = {"tissue": {"material": {"young": 125.0, "poisson": 0.499, "rho": 1.0}}}
    assert study_effects(make_scene(QUICK, hold, start), comm).elements is None  # nu = 1/4
    elements = study_effects(make_scene(QUICK, hold, start, soft), comm).elements
    assert elements is not None
    point = make_outputs(make_scene(), build(make_scene(), comm=comm).system)[0].point
    at = {"control": {"outputs": [{"kind": "node", "point": list(point)}]}}
    a, b = (
        simulate(build(make_scene(QUICK, hold, start, soft, at, {"tissue": {"order": n}}), comm=comm)).outputs[0]
        for n in (1, 2)
    )
    expected = np.linalg.norm(a - b) / max(np.linalg.norm(a), np.linalg.norm(b))
    assert elements.change.outputs == pytest.approx(expected, rel=1e-6)  # three steps of rest
    assert np.linalg.norm(a) < 0.6 * np.linalg.norm(b)  # P1 is far too stiff
    assert elements.needed
    assert elements.unknowns > 3  # nodes on every edge


def test_reaction_is_felt_only_when_a_force_moves_the_hand(comm: MPI.Intracomm) -> None:
    _, by = found(comm, time={"steps": 20})
    assert by["reaction"].change is not None
    assert by["reaction"].change.outputs == 0
    assert by["reaction"].control is None
    assert by["reaction"].verdict == "optional"  # nothing to gain, nothing to pay
    _, by = found(comm, CONTROL)
    assert by["reaction"].verdict == "optional"
    assert by["reaction"].control is not None
    assert by["reaction"].control == pytest.approx(0.1, rel=0.2)  # tissue over hand mass is 2 / 20
    assert "for control alone" in by["reaction"].advice
    _, by = found(comm, FORCE, CONTROL)
    assert by["reaction"].verdict == "needed"
    assert by["reaction"].cost is not None
    assert "step.Y" in by["reaction"].cost.holds


@pytest.mark.serial
def test_damping_for_control_is_not_called_wasted(comm: MPI.Intracomm) -> None:
    damped = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}, "study": {"tolerance": 0.5}}
    assert found(comm, damped)[1]["damping"].verdict == "wasted"
    finding = found(comm, damped, CONTROL)[1]["damping"]
    assert finding.verdict == "optional"
    assert "stabilises" in finding.advice


# --- several switches at once


class Trial(SwitchRuns):
    """Runs in which finite strain shows beside gravity by ``size``, or fails."""

    def __init__(self, size: float | None) -> None:
        self.on, self.size, self.asked = frozenset[str](), size, [Names()]
        self.scene, self.scales = make_scene(), SCALES

    def change(self, a: Names, b: Names) -> Change:
        self.asked.append(b)
        if self.size is None:
            raise SolverError("folded")
        return Change(self.size, self.size, self.size)


@pytest.mark.parametrize(("size", "expected"), [(0.5, ("gravity",)), (1e-9, ()), (None, ())])
def test_finite_strain_is_judged_beside_the_advised_effects_in_one_run(size: float | None, expected: Any) -> None:
    alone, name, runs = (Change(1e-6, 1e-6, 1e-6), None), "finite_strain", Trial(size)
    found = finite_strain_beside(runs, name, alone, frozenset({"gravity"}))  # type: ignore[arg-type]
    assert runs.asked[1:] == [frozenset({"gravity", name})]
    assert found.partners == expected
    assert found.change.outputs == (1e-6 if size is None else size)
    assert finite_strain_beside(runs, name, alone, frozenset({"rotation"})).change is alone[0]  # type: ignore[arg-type]
    assert len(runs.asked) == 2


def largest_change(comm: MPI.Intracomm, *tables: dict[str, Any]) -> float:
    """The largest relative change of the outputs between two scenes, by numpy alone."""
    a, b = (simulate(build(make_scene(QUICK, FORCE, table), comm=comm)).outputs for table in tables)
    return float(np.linalg.norm(a - b, axis=1).max() / max(np.linalg.norm(y, axis=1).max() for y in (a, b)))


def test_rotation_shows_only_beside_the_reaction_that_is_advised(comm: MPI.Intracomm) -> None:
    """A free hand turns when the tissue pulls on it: alone neither advice nor run would tell."""
    study, by = found(comm, FORCE, {"study": {"tolerance": 0.03}})
    rotation = by["rotation"]
    assert rotation.change is not None
    assert rotation.company is not None
    assert rotation.change.outputs == 0
    assert by["reaction"].verdict == rotation.verdict == "needed"
    assert rotation.company.partners == ("reaction",)
    assert rotation.advice.startswith("Switch it on, with reaction on: alone it changes nothing")
    both, one = ({"effects": {"reaction": True, "rotation": r}} for r in (True, False))
    expected = largest_change(comm, both, one)
    assert expected > 0.03
    assert rotation.company.together == pytest.approx(expected, rel=1e-9)  # parallel sums in another order
    assert {"reaction", "rotation"} <= set(study.advised)
    # nothing is left that would show beside what is advised
    for f in study.findings:
        if f.company is not None and f.name not in study.advised:
            assert f.company.change.outputs <= 0.03


class Table(SwitchRuns):
    """Runs whose outputs are a formula of the effects that are on."""

    def __init__(self, on: set[str], output: Callable[[Names], float], forced: Callable[[Names], float] | None) -> None:
        self.on, self.scales = frozenset(on), SCALES
        self.scene = make_scene(effects={name: ALL_ON[name] for name in on})
        self.force = None if forced is None else lambda n, t, q, v: q
        self.runs = {}
        self.formulas = {False: output, True: forced or output}

    def of(self, on: Names, forced: bool = False) -> Displacements:
        y = np.full((1, 1, 2), self.formulas[forced](on))
        return Displacements(y, 0 * y)


def test_pairs_that_hide_below_the_tolerance_one_by_one() -> None:
    tried, sizes = ("gravity", "damping", "reaction"), {"gravity": 0.6, "damping": 0.6, "reaction": 0.1}

    def y(on: Names) -> float:
        return 1 + sum(1e-3 * sizes[name] for name in on)

    on, company = advised_together(Table(set(), y, None), tried, frozenset(), 1e-3)
    assert on == {"gravity", "damping"}
    assert company["gravity"].partners == ("damping",)
    assert company["gravity"].pair
    assert company["gravity"].together == pytest.approx(1.2e-3, rel=2e-3)  # relative to 1 + 1.2e-3
    assert company["reaction"].partners == ()
    on, company = advised_together(Table(set(tried), y, None), tried, frozenset(), 1e-3)
    assert on == {"gravity"}  # one of both is enough
    assert company["gravity"].pair
    assert company["damping"].partners == ()
    assert not advised_together(Table(set(), lambda on: y(on) - 1 + 1e3, None), tried, frozenset(), 1e-3)[0]


def named(runs: SwitchRuns, name: str, company: JointChange) -> float:
    """The change by what the advice names, from the runs of exactly these scenes."""
    partners = frozenset(company.partners)
    pair = partners | {name}
    a, b = (runs.on - pair, runs.on | pair) if company.pair else (runs.on ^ partners, runs.on ^ pair)
    x, y = (runs.of(on, company.forced).places for on in (a, b))
    most = [np.linalg.norm(v, axis=2).max() for v in (x, y, x - y)]
    return float(most[2] / max(most[:2]))


@pytest.mark.parametrize("start", [{"gravity", "damping", "reaction"}, set(), {"damping", "reaction"}])
@pytest.mark.parametrize("enough", [1, 2])
def test_a_combination_has_the_number_of_what_its_advice_names(start: set[str], enough: int) -> None:
    """One of gravity and damping, or both, hold the body: where reaction is off too it falls less."""

    def y(on: Names) -> float:
        return 1.0 if len(on & {"gravity", "damping"}) >= enough else 0.85 if "reaction" not in on else -0.23

    runs = Table(start, y, None)
    tried = ("gravity", "damping", "reaction")
    needed = frozenset(name for name in tried if runs.change(runs.on, runs.on ^ {name}).outputs > 0.1)
    _, company = advised_together(runs, tried, needed, 0.1)
    joined = {name: found for name, found in company.items() if found.partners}
    for name, found in joined.items():
        assert found.among == ()
        assert found.together == pytest.approx(named(runs, name, found), rel=1e-12)  # the same operations
    if len(start) == 3 and enough == 1:
        assert joined["gravity"].partners == ("damping",)
        assert joined["gravity"].together == pytest.approx(1.23)  # not the 0.15 of a scene without reaction
    if not start and enough == 2:
        assert joined["gravity"].pair


@pytest.mark.parametrize("sizes", [(0.5, 0.1), (0.1, 0.5)])
def test_effects_that_the_scene_does_not_take_together_are_not_advised_together(sizes: tuple[float, float]) -> None:
    names, rest = ("rotation", "finite_strain"), {"gravity": 0.2}

    def y(on: Names) -> float:
        return 1 + sum(({**dict(zip(names, sizes, strict=True)), **rest})[name] for name in on)

    runs = Table(set(), y, None)
    changes = {name: (runs.change(runs.on, runs.on ^ {name}), None) for name in ("gravity", *names)}
    result = advised(runs, frozenset(changes), changes)
    larger, smaller = sorted(names, key=lambda name: -sizes[names.index(name)])
    assert set(result.on) == {"gravity", larger}
    assert result.rivals[smaller].name == larger
    assert "effects.finite_strain cannot go with effects.rotation" in result.rivals[smaller].why
    assert runs.refusal(frozenset(result.on)) == ""
    assert runs.refusal(frozenset(names)) == result.rivals[smaller].why


@pytest.mark.ranks(2)
def test_advice_on_a_shipped_scene_can_be_followed(comm: MPI.Intracomm) -> None:
    """All of it together builds; each number of a combination is that of two runs of the scenes it names."""
    small = ["tissue.cells=[4,8]", "time.steps=40", "study.repeats=1"]
    scene = load_scene_collective(comm, "paper_forward", small)
    study = study_effects(scene, comm)
    model = build(scene, comm=comm)
    runs = SwitchRuns(scene, Scales(2, *rigid_inertia(model), None), {frozenset(): model})
    assert {"gravity", "reaction", "finite_strain"} <= set(study.advised)
    assert runs.refusal(frozenset(study.advised) - {"damping"}) == ""  # its trial value needs a frequency
    by = {f.name: f for f in study.findings}
    assert by["rotation"].advice.startswith("Switch it on only in place of finite_strain, which is advised: with reac")
    assert "effects.finite_strain cannot go with effects.rotation" in by["rotation"].advice
    joined = {f.name: f.company for f in study.findings if f.company is not None and f.company.partners}
    assert joined
    for name, company in joined.items():
        assert company.together == pytest.approx(named(runs, name, company), rel=1e-9)  # parallel sums, other order


def test_changes_of_a_large_box_are_those_of_the_same_scene_on_coarser_cells(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("softgrasp.study.effects.run.MOST_TRIED", {2: 40, 3: 40})
    changes = ["time.steps=10", "study.repeats=1", "effects.damping={kind='kelvin-voigt',beta=0.01}"]
    study = study_effects(load_scene("paper_forward", ["tissue.cells=[4,8]", *changes]), comm)
    coarse = build(load_scene("paper_forward", ["tissue.cells=[2,4]", *changes]), comm=comm)  # meets the zone's end
    assert study.coarser == study.to_dict()["coarser"] == coarse.system.layout.n_e <= 40 < study.sizes["n_e"]
    by = {f.name: f for f in study.findings}
    alone = SwitchRuns(coarse.scene, SCALES, {frozenset({"damping"}): coarse}).alone("damping")
    assert by["damping"].change == alone[0]
    assert by["damping"].cost.memory > 100  # of the scene's own matrices
    note = next(part.text for part in parts(study) if "deform." in part.text)
    assert f"on coarser cells, n_e = {study.coarser}" in note


@pytest.mark.ranks(2)
def test_a_prescribed_motion_feels_neither_reaction_nor_the_freedom_to_turn(comm: MPI.Intracomm) -> None:
    """So runs that differ in them alone are made once, with all other effects on."""
    model = build(make_scene(QUICK, hand={"inertia": 3.0}), comm=comm)
    runs = SwitchRuns(model.scene, SCALES, {frozenset(): model})
    for base in (frozenset[str](), frozenset({"gravity", "damping"})):
        plain = simulate(runs.model(base))
        for more in ({"reaction"}, {"rotation"}, {"reaction", "rotation"}):
            other = runs.model(base | more)
            assert runs.shown(base | more, False) == base
            assert close(simulate(other).outputs, plain.outputs) < 1e-12  # vectors of three columns round otherwise


@pytest.mark.ranks(2)
def test_under_a_force_a_hand_without_reaction_does_not_turn(comm: MPI.Intracomm) -> None:
    """So the freedom to turn needs no run of its own there; beside the reaction it does."""
    model = build(make_scene(QUICK, CONTROL, hand={"inertia": 3.0}), comm=comm)
    runs = SwitchRuns(model.scene, SCALES, {frozenset(): model})
    for base in (frozenset[str](), frozenset({"gravity", "damping"})):
        plain, other = (simulate(runs.model(on), force=runs.force) for on in (base, base | {"rotation"}))
        assert runs.shown(base | {"rotation"}, True) == base
        assert not other.q_s[:, 2].any()
        assert close(other.outputs, plain.outputs) < 1e-12  # vectors of three columns round otherwise
    felt = frozenset({"reaction", "rotation"})
    assert runs.shown(felt, True) == felt
    assert simulate(runs.model(felt), force=runs.force).q_s[:, 2].any()


def test_an_effect_may_need_two_partners_and_a_force() -> None:
    tried = ("gravity", "damping", "reaction", "rotation")

    def still(on: Names) -> float:
        return 1 + 0.1 * (("gravity" in on) + ("reaction" in on))

    def forced(on: Names) -> float:
        return still(on) + 0.5 * ({"gravity", "reaction", "rotation"} <= on)

    needed = frozenset({"gravity", "reaction"})
    on, company = advised_together(Table(set(), still, forced), tried, needed, 1e-2)
    assert on == {"gravity", "reaction", "rotation"}
    assert company["rotation"].partners == ("gravity", "reaction")
    assert company["rotation"].forced
    assert company["rotation"].together == pytest.approx(0.5 / 1.7)
    assert company["rotation"].change.outputs == 0
    on, company = advised_together(Table(set(), still, None), tried, needed, 1e-2)
    assert on == {"gravity", "reaction"}
    assert not company["rotation"].forced


# --- numbers against independent ones


@pytest.mark.ranks(2)
def test_change_is_what_two_runs_differ_by(comm: MPI.Intracomm) -> None:
    _, by = found(comm, CONTROL, effects={"gravity": {"g": [0.0, -3.0]}})
    with_, without = (
        simulate(build(make_scene(QUICK, CONTROL, effects={"gravity": g}), comm=comm))
        for g in ({"g": [0.0, -3.0]}, False)
    )
    difference = np.linalg.norm(with_.outputs - without.outputs, axis=1).max()
    scale = max(np.linalg.norm(run.outputs, axis=1).max() for run in (with_, without))
    change = by["gravity"].change
    assert change is not None
    assert change.outputs == pytest.approx(difference / scale, rel=1e-9)  # parallel sums in another order
    assert change.absolute == pytest.approx(difference, rel=1e-9)  # as above
    assert change.deformation > change.outputs  # the rigid move hides it


@pytest.mark.serial
def test_strength_below_which_gravity_does_not_show(comm: MPI.Intracomm) -> None:
    """The change is proportional to g: at the g that the advice names it is the tolerance."""
    _, by = found(comm, CONTROL)
    gravity = by["gravity"]
    named = float(gravity.advice.split("below about ")[1].split(" m/s2")[0])
    start = {"time": {"start": "equilibrium"}}
    _, again = found(comm, CONTROL, start, effects={"gravity": {"g": [0.0, -named]}})
    change = again["gravity"].change
    assert change is not None
    # two digits are printed; the scale of the outputs changes with g
    assert change.outputs == pytest.approx(1e-3, rel=0.08)


def test_hand_outputs_compare_places_and_not_angles(comm: MPI.Intracomm) -> None:
    outputs = {"control": {"outputs": [{"kind": "hand"}, {"kind": "node", "point": [0.5, 0.0]}]}}
    plain = build(make_scene(outputs), comm=comm)
    turning = build(make_scene(outputs, effects={"rotation": True}, motion={"target": [5.0, 3.0, 0.3]}), comm=comm)
    a, b = simulate(plain), simulate(turning)
    assert b.outputs.shape[1] == a.outputs.shape[1] + 1
    node = np.linalg.norm(b.outputs[:, 3:] - a.outputs[:, 2:], axis=1).max()
    assert node > 0.1  # [m]; the turn moves the tip
    change = compare(displacements(plain, a), displacements(turning, b))
    assert change.absolute == pytest.approx(node, rel=1e-12)  # the same sums


@pytest.mark.ranks(2)
def test_stepper_repeats_the_same_run(comm: MPI.Intracomm) -> None:
    """A run taken back to its start gives the state of a fresh one."""
    model = build(make_scene(effects=ALL_ON, motion={"drive": "force"}), comm=comm)
    stepper = RepeatableRun(model)
    stepper.seconds_per_step(2 * 60 + 17)
    stepper.rewind()
    stepper.run.advance_to(stepper.ts, 60)
    layout = model.system.layout
    end, fresh = gather_states(layout, stepper.run.state.array), gather_states(layout, simulate(model).final)
    np.testing.assert_allclose(end, fresh, rtol=0, atol=1e-11 * np.abs(fresh).max())  # sixty steps of rounding
    stepper.destroy()


def test_memory_counts_what_each_effect_holds(comm: MPI.Intracomm) -> None:
    bare = measured(build(make_scene(), comm=comm))
    n_e = bare.model.system.layout.n_e
    for effects, tables, new in (
        ({"damping": {"kind": "kelvin-voigt", "beta": 0.01}}, {}, {"step.k_old": 8 * n_e}),
        ({"reaction": True}, FORCE, {"step.Y": 16 * n_e}),
    ):
        case = measured(build(make_scene(tables, effects=effects), comm=comm))
        # on ranks that all step the whole tissue, each holds it
        assert [case.bytes[name] / size for name, size in new.items()] in ([1], [comm.size])
        assert not set(new) & set(bare.bytes)
    entries = bare.model.system.K_ee.getInfo()["nz_used"]
    assert bare.bytes["K_ee"] >= 12 * entries
    assert bare.bytes["G"] == 16 * n_e


def test_verdict() -> None:
    assert verdict_of(2e-3, False, False, 1e-3) == "needed"
    assert verdict_of(2e-3, True, True, 1e-3) == "needed"
    assert verdict_of(1e-3, False, True, 1e-3) == "wasted"
    assert verdict_of(0.0, True, True, 1e-3) == "optional"
    assert verdict_of(0.0, False, False, 1e-3) == "optional"


# --- off is free, and the proof can fail


def test_every_effect_that_is_off_is_shown_to_be_free(comm: MPI.Intracomm) -> None:
    for tables in (CONTROL | FORCE, {"effects": {"damping": ALL_ON["damping"]}}):
        _, by = found(comm, tables)
        off = {name for name, effect in EFFECTS.items() if not effect.active(make_scene(tables))}
        assert {name for name, f in by.items() if f.proof is not None} == off
        for name in off:
            proof = by[name].proof
            assert proof is not None
            assert all(dataclasses.asdict(proof).values()), name


def test_objects_are_counted_by_petsc_itself(comm: MPI.Intracomm) -> None:
    """The log sees exactly what is made, and what an effect that is on makes more; steps make nothing."""
    with counting(comm) as made:
        vectors = [PETSc.Vec().createMPI(4, comm=comm) for _ in range(3)]
        matrix = PETSc.Mat().createAIJ((4, 4), nnz=1, comm=comm)
    for thing in (*vectors, matrix):
        thing.destroy()
    assert made["Matrix"] == (1 if comm.size == 1 else 3)  # its diagonal and its other block
    assert made["Vector"] == 3
    bare, in_steps = objects_of(comm, bare_output(make_scene()))
    assert in_steps == {}
    assert bare["Matrix"] >= 6  # three parts, M, K and S
    damped, in_steps = objects_of(comm, bare_output(make_scene(effects={"damping": ALL_ON["damping"]})))
    assert in_steps == {}
    assert difference(damped, bare) == {"Vector": 1}  # K z of the last step
    for effects in ({"gravity": {"g": [0.0, 0.0]}}, {"gravity": ALL_ON["gravity"]}, {"reaction": True}):
        assert objects_of(comm, bare_output(make_scene(effects=effects)))[0] == bare, effects


def test_table_of_petsc_is_read_over_all_stages() -> None:
    text = (
        "Object Type          Creations   Destructions.\n\n--- Event Stage 0: Main Stage\n\n"
        "   Index Set    24             24\n      Vector    82             80\n"
        "--- Event Stage 1: other\n\n      Vector     2              2\n      Viewer     1              0\n======\n"
        "   Average    1      2\n"
    )
    assert read_table(text) == {"Index Set": 24, "Vector": 84}


def test_proof_sees_every_effect_that_is_on(comm: MPI.Intracomm) -> None:
    """The proof fails for a scene in which the effect is on after all."""
    bare = measured(build(make_scene(FORCE), comm=comm))
    for name in ("gravity", "damping", "reaction", "rotation", "layers"):
        tables: dict[str, Any] = {"effects": {name: ALL_ON[name]}} if name in ALL_ON else {"tissue": {"layers": {}}}
        if name == "layers":
            tables = {"tissue": {"layers": {"core": LAYERS["core"]}}}
        on = measured(build(make_scene(FORCE, tables), comm=comm))
        proof = check_zero_cost(name, bare, on)
        assert not proof.holds, name
        assert not proof.same_operators, name
    assert check_zero_cost("reaction", bare, bare).holds


# --- scenes switched the other way


def test_trial_values_are_those_that_are_stated(comm: MPI.Intracomm) -> None:
    by = {s.name: s for s in switches(make_scene(), SCALES)}
    assert not any(s.on for s in by.values())
    assert by["gravity"].other.effects.gravity.g == [0.0, -9.81]
    assert by["gravity"].other.time.start == "equilibrium"
    assert by["damping"].other.effects.damping.beta * 4.0 / 2 == pytest.approx(TRIAL_ZETA)  # zeta = beta omega / 2
    assert by["reaction"].other.effects.reaction
    assert by["rotation"].other.hand.inertia == 3.0  # given, though rotation is off
    assert by["rotation"].other.motion.target == [5.0, 3.0, 0.0]
    assert by["layers"].other is None
    unknown = make_scene(hand={"inertia": None})
    (rotation,) = [s for s in switches(unknown, SCALES) if s.name == "rotation"]
    assert rotation.other.hand.inertia == pytest.approx(20.0 * 0.5 / 2.0)
    (damping,) = [s for s in switches(make_scene(), Scales(2, 2.0, (0.5,), None)) if s.name == "damping"]
    assert damping.other is None
    assert "frequency" in damping.reason


def test_switched_off_leaves_a_valid_scene(comm: MPI.Intracomm) -> None:
    R = np.diag([1.0, 2.0, 3.0]).tolist()
    scene = make_scene(
        CONTROL,
        tissue={"layers": LAYERS},
        effects=ALL_ON,
        time={"start": "equilibrium"},
        motion={"target": [5.0, 3.0, 0.2]},
        control={"R": R},
    )
    apart = ("finite_strain", "obstacles", "frame")  # the first not beside rotation, the last needs it
    by = {s.name: s for s in switches(scene, SCALES) if s.name not in apart}
    assert all(s.on for s in by.values())
    for name, s in by.items():
        assert not EFFECTS[name].active(s.other)
        others = [e for key, e in EFFECTS.items() if key not in (name, *apart)]
        assert all(e.active(s.other) for e in others)
        assert neutral(s.other, name, 2) is None or EFFECTS[name].active(neutral(s.other, name, 2))
    assert by["rotation"].other.control.R == [[1.0, 0.0], [0.0, 2.0]]
    assert by["damping"].other.tissue.layers["low"].beta is None
    (frame,) = [s for s in switches(by["rotation"].other, SCALES) if s.name == "frame"]
    assert frame.other is None
    assert frame.reason == "the hand does not turn"
    (frame,) = [s for s in switches(scene, SCALES) if s.name == "frame"]
    assert frame.other is not None
    assert frame.other.effects.frame == "hand"
    again = by["rotation"].other.changed(lambda table: None)
    assert again == by["rotation"].other


# --- files


@pytest.mark.ranks(2)
def test_command_writes_every_file(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    scene = make_scene(QUICK, CONTROL, tissue={"layers": LAYERS}, effects={"damping": ALL_ON["damping"]})
    file, out = write_scene(comm, mpi_tmp_path, scene), mpi_tmp_path / "out"
    text = io.StringIO()
    console = Console(file=text, width=78, quiet=comm.rank != 0)
    result = run_effects(file, out, ["time.steps=20"], console, quiet=True)
    assert set(result["effects"]) == set(EFFECTS)
    assert result["ranks"] == comm.size
    if comm.rank == 0:
        assert json.loads((out / "result.json").read_text()) == json.loads(json.dumps(result))
        rows = list(csv.DictReader((out / "effects.csv").open()))
        assert [row["effect"] for row in rows] == list(EFFECTS)
        assert [row["verdict"] for row in rows] == [e["verdict"] for e in result["effects"].values()]
        assert float(rows[0]["change_outputs"]) == result["effects"]["gravity"]["change"]["outputs"]
        page = (out / "report.html").read_text()
        assert "data:image/png;base64" in page
        if comm.size == 1 and find_chromium():
            assert look(out / "report.html", figures=1) == []
        assert "block.toml --set time.steps=20" in page.replace("&#39;", "'")
        assert (out / "effects.png").stat().st_size > 5000
        assert all(name in text.getvalue() for name in EFFECTS)
        assert max(map(len, text.getvalue().split("files:")[0].splitlines())) <= 78


def test_show_says_what_a_proof_misses(comm: MPI.Intracomm) -> None:
    study, _ = found(comm, time={"steps": 3})
    broken = tuple(
        dataclasses.replace(f, proof=f.proof and dataclasses.replace(f.proof, same_work=False)) for f in study.findings
    )
    text = io.StringIO()
    show_sections(Console(file=text, width=100), parts(dataclasses.replace(study, findings=broken)))
    assert text.getvalue().count("NOT the same") == sum(f.proof is not None for f in broken)
    assert not dataclasses.replace(study, findings=broken).to_dict()["off_is_free"]


@pytest.mark.serial
def test_effects_are_measured_on_the_mesh_that_a_tolerance_led_to(comm: MPI.Intracomm) -> None:
    """The weight of the tissue, whose variant would have a mesh of its own, against two runs on the one mesh."""
    few = ["time.steps=60", "study.repeats=1", "tissue.refine={tolerance=0.05}"]
    scene = load_scene_collective(comm, "paper_forward", few)
    study, model = study_effects(scene, comm), adapt.build(scene, comm=comm)
    assert study.sizes["n_e"] == model.system.layout.n_e != build(scene, comm=comm).system.layout.n_e
    weighing = SwitchRuns(scene, Scales(2, *rigid_inertia(model), None), {frozenset(): model}).variant({"gravity"})
    heavy = build(weighing, comm=comm, mesh=model.space.mesh)
    change = compare(displacements(model, simulate(model)), displacements(heavy, simulate(heavy)))
    (gravity,) = (f for f in study.findings if f.name == "gravity")
    assert gravity.change is not None
    assert gravity.change.outputs == pytest.approx(change.outputs, rel=1e-9)  # sums in another order
