"""Each effect by itself: what it adds when on, that it adds nothing when off, and what it must not change."""

from __future__ import annotations

from typing import Any

import dolfinx.fem
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.differences import Differences
from tests.helpers.effects import GRAVITY, NEUTRAL, OFF, RAYLEIGH, VISCOUS, WEIGHT
from tests.helpers.models import (
    LAYERS,
    absolute,
    at_rest,
    close,
    gather_matrix,
    gather_rows,
    gather_states,
    make_scene,
    reference,
    run_from,
    wave,
)

BARE_FORMS = ["K_mu", "K_lambda", "M_1"]
BARE_OPERATORS = ["K_mu[tissue]", "K_lambda[tissue]", "M_1[tissue]", "M_ee", "K_ee", "T", "G"]
DRAGGED = {"damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01, "drag": "space"}}
HOLD: dict[str, Any] = {"profile": "hold", "target": None}


class Forms:
    """Stands in for dolfinx.fem.form and remembers what was compiled."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.names: list[str] = []
        self.form = dolfinx.fem.form
        monkeypatch.setattr(dolfinx.fem, "form", self)

    def __call__(self, *args: Any, **options: Any) -> Any:
        self.names.append(args[0].signature())
        return self.form(*args, **options)


@pytest.mark.parametrize(
    "effects", [{}, OFF, GRAVITY, WEIGHT, VISCOUS, RAYLEIGH, DRAGGED, {"reaction": True}, {"rotation": True}]
)
def test_no_effect_compiles_a_form_or_adds_a_matrix(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, effects: dict[str, Any]
) -> None:
    forms = Forms(monkeypatch)
    model = build(make_scene(effects=effects), comm=comm)
    simulate(model)
    assert len(forms.names) == len(set(forms.names)) == 3
    assert model.inventory.forms == BARE_FORMS
    assert model.inventory.operators == BARE_OPERATORS
    assert model.system.damping.matrix is None
    assert (model.system.gravity is None) == ("gravity" not in effects or not effects["gravity"])


def test_layers_share_their_forms_and_add_only_their_components(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    forms = Forms(monkeypatch)
    scene = make_scene(tissue={"layers": LAYERS}, effects=VISCOUS)
    model = build(scene, comm=comm)
    assert len(set(forms.names)) == 3
    assert model.inventory.forms == BARE_FORMS
    parts = [f"{key}[{name}]" for name in ("low", "core", "tissue") for key in BARE_FORMS]
    assert sorted(model.inventory.operators) == sorted([*parts, "M_ee", "K_ee", "T", "G", "D_ee"])
    undamped = build(make_scene(tissue={"layers": {"core": LAYERS["core"]}}), comm=comm)
    assert "D_ee" not in undamped.inventory.operators


def work_of_a_run(model: Model) -> dict[str, int]:
    """Calls of PETSc operations in the run, as PETSc itself counts them, and of our product with K."""
    names = ("MatMult", "MatMultAdd", "MatMultTranspose", "MatSolve", "VecAXPY", "VecAYPX", "VecWAXPY", "VecAXPBYCZ")
    events = [PETSc.Log.Event(name) for name in names]
    before = [event.getPerfInfo()["count"] for event in events]
    products, add = [0], Differences.multAdd

    def counted(self: Differences, *vectors: PETSc.Vec | None) -> None:
        products[0] += 1
        add(self, *vectors)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Differences, "multAdd", counted)
        simulate(model)
    calls = {e.name: e.getPerfInfo()["count"] - b for e, b in zip(events, before, strict=True)}
    return calls | {"products with K": products[0]}


def test_off_takes_no_branch_in_the_loop_and_gravity_costs_nothing(comm: MPI.Intracomm) -> None:
    PETSc.Log.begin()
    steps = 60

    def extra(effects: dict[str, Any], name: str) -> float:
        """Calls per step: the difference of two runs takes set-up and checks away."""
        short, long = (
            work_of_a_run(build(make_scene(effects=effects, time={"steps": n}), comm=comm)) for n in (steps, 2 * steps)
        )
        return (long[name] - short[name]) / steps

    for effects in ({}, OFF, GRAVITY, WEIGHT):
        assert extra(effects, "MatSolve") == 1
        assert extra(effects, "products with K") == 1
        assert extra(effects, "MatMult") + extra(effects, "MatMultAdd") == 1  # the n_s columns of G
        assert extra(effects, "MatMultTranspose") == 1  # G' w, for the work of the load
        assert extra(effects, "VecAXPY") == extra({}, "VecAXPY")
    assert extra(RAYLEIGH, "MatSolve") == 1
    assert extra(RAYLEIGH, "products with K") == 1
    assert extra(RAYLEIGH, "VecAXPY") > extra({}, "VecAXPY")  # the count can tell


def bits(model: Model) -> list[bytes]:
    run = simulate(model)
    return [a.tobytes() for a in (run.q_s, run.v_s, run.outputs, run.snapshots.Z, run.final)]


def test_effects_off_give_the_same_bits(comm: MPI.Intracomm) -> None:
    """Off, on with strength zero, and off after other scenes ran in the same process."""
    bare = bits(build(make_scene(), comm=comm))
    for effects in NEUTRAL:
        assert bits(build(make_scene(effects=effects), comm=comm)) == bare, effects
    everything = GRAVITY | DRAGGED | {"reaction": True, "rotation": True}
    changed = simulate(build(make_scene(tissue={"layers": LAYERS}, effects=everything), comm=comm))
    assert changed.outputs.tobytes() != bare[2]
    assert bits(build(make_scene(), comm=comm)) == bare


def test_gravity_reuses_the_coupling(comm: MPI.Intracomm) -> None:
    """The body force is G g, no vector of its own: it equals the integral of rho g phi."""
    model = build(make_scene(effects=GRAVITY | VISCOUS, tissue={"layers": LAYERS}), comm=comm)
    ref = reference(model)
    force = ref.M[~ref.held] @ np.tile([1.0, -9.0], len(ref.nodes))
    assert close(gather_rows(model.system.layout, model.system.G) @ model.system.gravity, force) < 1e-12  # rounding


@pytest.mark.parametrize("solver", ["cholesky", "mumps"])
@pytest.mark.parametrize("effects", [GRAVITY, GRAVITY | VISCOUS, GRAVITY | DRAGGED, GRAVITY | {"rotation": True}])
def test_equilibrium_is_static_and_stays(comm: MPI.Intracomm, effects: dict[str, Any], solver: str) -> None:
    scene = make_scene(effects=effects, motion=HOLD, time={"start": "equilibrium", "end": 3.0, "solver": solver})
    model = build(scene, comm=comm)
    ref, layout = reference(model), model.system.layout
    Z = gather_states(layout, simulate(model).snapshots.Z)
    free = ~ref.held
    f = ref.M[free] @ np.tile([1.0, -9.0], len(ref.nodes))
    static = np.linalg.solve(ref.K[np.ix_(free, free)], f)
    assert close(Z[: layout.n_e, 0], static) < 1e-11  # condition of K about 1e3
    drift = np.abs(Z[: layout.n_e] - Z[: layout.n_e, :1]).max() / np.abs(static).max()
    assert drift < 1e-12  # 60 steps of rounding
    assert np.abs(Z[layout.n_e :]).max() < 1e-11 * np.abs(static).max() * 100  # times the highest frequency


def test_a_held_hand_keeps_its_tissue_in_equilibrium(comm: MPI.Intracomm) -> None:
    """Two-way under a force that holds the weight: load and stiffness cancel, and the check of the solve knows it."""
    scene = make_scene(
        effects=WEIGHT | {"reaction": True},
        motion=HOLD | {"drive": "force"},
        time={"start": "equilibrium", "end": 3.0},
    )
    model = build(scene, comm=comm)
    system = model.system
    holding = -(system.M_hand + system.M_rigid) @ [1.0, -9.0]
    run = simulate(model, force=lambda n, t, q, v: holding)
    assert np.abs(run.q_s).max() < 1e-10  # rounding of the balance, in metres, over 60 steps
    assert max(run.residuals) < 1e-12  # rounding of a direct solve


@pytest.mark.parametrize("effects", [{}, VISCOUS, RAYLEIGH])
@pytest.mark.parametrize("reaction", [False, True])
def test_free_fall_strains_nothing(comm: MPI.Intracomm, effects: dict[str, Any], reaction: bool) -> None:
    """A hand that weighs and holds nothing back falls with its tissue: q = g t^2 / 2, no deformation."""
    scene = make_scene(
        effects=effects | WEIGHT | {"reaction": reaction}, motion=HOLD | {"drive": "force"}, time={"end": 3.0}
    )
    model = build(scene, comm=comm)
    run = simulate(model)
    fall = np.outer(run.times**2 / 2, [1.0, -9.0])
    assert close(run.q_s, fall) < 1e-12  # sixty sums
    assert np.abs(run.snapshots.Z).max() < 1e-11 * np.abs(fall).max()  # rounding of a_s - g, times compliance


@pytest.mark.parametrize(("effects", "slows"), [(VISCOUS, False), (RAYLEIGH, False), (DRAGGED, True)])
def test_rigid_motion_is_dragged_only_on_request(comm: MPI.Intracomm, effects: dict[str, Any], slows: bool) -> None:
    """Hand and tissue coast and turn together: damping against the hand finds nothing to damp."""
    model = build(make_scene(effects=effects | {"reaction": True, "rotation": True}, time={"end": 3.0}), comm=comm)
    zero = np.zeros(model.system.layout.n_e)
    v_s = np.array([2.0, -1.0, 0.5])
    run = run_from(model, zero, zero, v_s, lambda n, t, q, v: np.zeros(3))
    assert (np.abs(run.drive.v[-1] - v_s).max() > 1e-2) == slows  # [m/s]; drag takes 0.7
    if not slows:
        np.testing.assert_allclose(run.drive.v, np.tile(v_s, (61, 1)), rtol=0, atol=1e-12)  # sixty steps of rounding
        assert np.abs(run.state.array).max(initial=0) < 1e-12  # the same rounding


@pytest.mark.parametrize("effects", [VISCOUS, RAYLEIGH])
def test_damping_takes_energy_and_says_how_much(comm: MPI.Intracomm, effects: dict[str, Any]) -> None:
    model = build(make_scene(effects=effects, motion=HOLD, time={"end": 3.0}), comm=comm)
    rng = np.random.default_rng(2)
    z, v = rng.standard_normal((2, model.system.layout.n_e))
    run = run_from(model, 0.1 * z, v)
    work, lost = run.ledger.balance(run.reached)
    after = run.midpoint.energy(run.state)
    K, M = (gather_matrix(model.system.layout, A) for A in (model.system.K_ee, model.system.M_ee))
    before = (0.01 * z @ (K @ z) + v @ (M @ v)) / 2
    assert abs(work) < 1e-12 * before  # the hand holds still
    assert abs(before - after - lost) < 1e-12 * before  # sixty steps of rounding
    assert lost > 0.1 * before  # a part that shows: three seconds take nearly all


def test_reaction_vanishes_for_a_heavy_hand(comm: MPI.Intracomm) -> None:
    """The difference of two-way and one-way coupling falls as tissue mass over hand mass."""
    gaps = []
    for mass in (1e2, 1e4, 1e6):
        runs = []
        for reaction in (False, True):
            model = build(make_scene(hand={"mass": mass}, effects={"reaction": reaction}), comm=comm)
            runs.append(simulate(model, force=lambda n, t, q, v, m=mass: m * wave(n, t, q, v) / 20))
        gaps.append(np.abs(runs[1].q_s - runs[0].q_s).max() / np.abs(runs[0].q_s).max())
    assert 1e-4 < gaps[0] < 1  # about tissue over hand mass, 2e-2: no rounding
    np.testing.assert_allclose(gaps[:-1], 100 * np.array(gaps[1:]), rtol=0.05)  # next term: mass ratio 2e-2


def test_equal_layers_are_a_uniform_body(comm: MPI.Intracomm) -> None:
    same = {"material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}}
    layers = {name: {"box": layer["box"]} | same for name, layer in LAYERS.items()}
    runs = [
        simulate(build(make_scene(tissue={"layers": chosen}, effects=GRAVITY | RAYLEIGH), comm=comm))
        for chosen in ({}, layers)
    ]
    assert close(runs[1].outputs, runs[0].outputs) < 1e-11  # condition times rounding of sums in another order
    assert close(runs[1].final, runs[0].final) < 1e-10  # as above, of the tissue alone, without the way of 5 m


def test_rotation_without_torque_is_no_rotation(comm: MPI.Intracomm) -> None:
    """A prescribed motion with zero angles moves the tissue as a hand that cannot turn."""
    plain, turning = (build(make_scene(effects={"rotation": on}), comm=comm) for on in (False, True))
    a, b = simulate(plain), simulate(turning)
    assert close(b.q_s[:, :2], a.q_s) == 0
    assert np.abs(b.q_s[:, 2]).max() == 0
    assert (
        close(gather_states(turning.system.layout, b.snapshots.Z), gather_states(plain.system.layout, a.snapshots.Z))
        < 1e-12  # the same solves; the column of the angle is times zero
    )


def test_thickness_scales_forces_and_not_motion(comm: MPI.Intracomm) -> None:
    thin, thick = (build(make_scene(tissue={"thickness": t}, effects=VISCOUS), comm=comm) for t in (1.0, 3.0))
    assert close(simulate(thick).outputs, simulate(thin).outputs) < 1e-11  # condition times rounding
    np.testing.assert_allclose(thick.system.M_rigid, 3 * thin.system.M_rigid, rtol=0, atol=1e-12)  # rounding of sums


def test_start_at_rest_is_zero(comm: MPI.Intracomm) -> None:
    model = build(make_scene(effects=GRAVITY), comm=comm)
    run = simulate(model)
    x = absolute(model, run.snapshots.q_s, run.snapshots.v_s, run.snapshots.Z)[:, 0]
    np.testing.assert_array_equal(x, at_rest(model))
