"""Contact with obstacles: balance, penetration, rest states against quadratic programmes, restarts, ranks, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI
from scipy.optimize import nnls

from softgrasp.fem.errors import CheckpointError, Paused, SceneError, SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.model.surface import make_surface
from softgrasp.fem.obstacles.compiled import contact_library
from softgrasp.fem.obstacles.small import SmallProblem
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.scene.file import load_scene

SMALL = [
    "tissue.cells=[4, 8]",
    "motion={profile='hold'}",
    "effects.gravity={g=[0, -5]}",
    "time.steps=300",
    "time.end=3",
]
ON = "effects.obstacles=true"
TABLE = "obstacle=[{kind='halfspace', name='table', normal=[0, 1], offset=-0.03}]"
BETA = "effects.damping={kind='kelvin-voigt', beta=0.01}"
SPACE = "effects.damping={kind='rayleigh', alpha=0.5, beta=0.01, drag='space'}"
TWO = ["effects.reaction=true", "motion={profile='hold', drive='force'}", "hand={mass=2.0}",
       "effects.gravity={g=[0, -1], hand_weight=true}"]  # fmt: skip
SHORT = ["time.steps=130", "time.end=1.3"]
DISC = "obstacle=[{kind='disc', center=[0.4, -0.53], radius=0.5}]"
BOX = "obstacle=[{kind='box', lo=[0.1, -0.53], hi=[2, -0.03], path={velocity=[0, 0.02]}}]"
RUBBING = TABLE.replace("name=", "friction=0.3, name=")
SLANTED = (
    "obstacle=[{kind='halfspace', normal=[0.1, 1], offset=-0.03}, {kind='halfspace', normal=[0, 1], offset=-0.04}]"
)


FRUSTUM = [[-0.03, -0.03, -0.03], [0.04, -0.03, -0.03], [0.04, 0.03, -0.03], [-0.03, 0.03, -0.03],
           [-0.02, -0.02, -2e-4], [0.03, -0.02, -2e-4], [0.03, 0.02, -2e-4], [-0.02, 0.02, -2e-4]]  # fmt: skip
BLUNT = ["kind='box', lo=[-0.02, -0.02, -0.03], hi=[0.03, 0.02, -2e-4]", f"kind='polyhedron', points={FRUSTUM}"]


def run(*overrides: str, **options: Any) -> Any:
    return simulate(build("paper_forward", [*SMALL, ON, *overrides]), **options)


@pytest.mark.parametrize("engine", ["C", "NumPy"])
def test_small_problem_is_solved_as_by_nonnegative_least_squares(engine: str) -> None:
    rng, small = np.random.default_rng(3), SmallProblem(engine)
    for p in (1, 7, 60, 60, 60):
        A = rng.standard_normal((p + 3, p))
        W, q = A.T @ A, rng.standard_normal(p)
        L = np.linalg.cholesky(W)
        expected, _ = nnls(L.T, -np.linalg.solve(L, q))
        if p > len(small.L):
            small.restart(W, np.zeros(0, dtype=int))
        x = small.solve(p, W, q, 1e-13)
        small.restart(W, np.flatnonzero(x > 0)[:3])
        # condition numbers up to 1e4, and the ridge of 1e-13
        assert np.abs(x - expected).max() <= 1e-8 * max(1.0, expected.max())
        assert (W @ x + q).min() > -1e-10


@pytest.mark.parametrize("equal", [2, 3])
def test_equal_rows_share_their_force(equal: int) -> None:
    W, q = np.ones((equal, equal)), -np.ones(equal)
    x = SmallProblem().solve(equal, W, q, 1e-12)
    assert x.min() >= 0
    assert x.sum() == pytest.approx(1.0, abs=1e-11)  # the ridge of 1e-13


def test_a_set_without_a_factor_begins_from_none() -> None:
    W = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])  # equal rows, by more rounding than the ridge of 1e-13 takes
    small = SmallProblem()
    small.restart(W, np.arange(2))
    assert small.solve(2, W, np.array([-1.0, 0.5]), 1e-12).tolist() == pytest.approx([1.0, 0.0], abs=1e-11)  # the ridge


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    "overrides",
    [
        [TABLE],
        [TABLE, BETA],
        [TABLE, BETA, *TWO],
        [TABLE, SPACE, *TWO],
        [SLANTED, BETA],
        [DISC],
        [DISC, *TWO],
        [BOX, BETA],
    ],
)
def test_balance_closes_without_penetration(overrides: list[str]) -> None:
    result = run(*overrides)
    contact = result.contact
    assert contact.touching.max() > 0
    assert result.energy_drift < 1e-13  # rounding: measured 1e-15 to 3e-14
    # of a body of size 2; curved obstacles iterate to 64 rounding units of the coordinates
    assert contact.penetration < 1e-12
    assert contact.touch >= 0
    assert contact.stopped >= 0
    assert contact.stopped > 1e-6 or contact.touch > 1e-6  # a landing takes some


def test_never_touched_is_the_run_without_contact_bit_for_bit() -> None:
    far = run("obstacle=[{kind='halfspace', normal=[0, 1], offset=-10}]", BETA)
    without = simulate(build("paper_forward", [*SMALL, BETA]))
    assert far.contact.columns == 0
    for name in ("outputs", "final", "force", "q_s"):
        assert np.array_equal(getattr(far, name), getattr(without, name))
    assert far.energy_drift == without.energy_drift


@pytest.mark.serial
def test_momentum_form_equals_the_textbook_step_with_dense_matrices() -> None:
    model = build("paper_forward", [*SMALL, ON, TABLE, BETA])
    result, system = simulate(model), model.system
    K, M = (to_scipy(A).toarray() for A in (system.K_ee, system.M_ee))
    surface, load = make_surface(model.space, system), system.G @ system.fall
    s = 2 * model.scene.time.steps / model.scene.time_end  # 2 / dt
    N = np.zeros((len(surface.X), len(K)))
    N[np.arange(len(N)), surface.rows.reshape(-1, 2)[:, 1]] = 1.0
    S, inverse = K + s * 0.01 * K + s * s * M, np.linalg.inv(M)
    columns, gap = np.linalg.solve(S, N.T), surface.X[:, 1] + 0.03
    W = N @ columns
    z, v, L = np.zeros(len(K)), np.zeros(len(K)), np.linalg.cholesky(W)
    for _ in range(model.scene.time.steps):
        w = np.linalg.solve(S, s * M @ v - K @ z + load)
        q = (gap + N @ z) / 2 + N @ w
        x = nnls(L.T, -np.linalg.solve(L, q))[0] if (q < 0).any() else np.zeros(len(q))
        w += columns @ x
        z, v = z + 2 * w, 2 * s * w - v
        if (x > 0).any():
            A = N[x > 0]
            v -= inverse @ A.T @ np.linalg.solve(A @ inverse @ A.T, A @ v)
    ours = np.split(result.final, 2)
    assert result.contact.stopped > 1e-4
    assert np.abs(ours[0] - z).max() < 1e-9 * np.abs(z).max()  # nnls solves to about 1e-10
    assert np.abs(ours[1] - v).max() < 1e-6 * np.abs(v).max() + 1e-9


def rest_of_block(*overrides: str) -> tuple[Any, np.ndarray, np.ndarray]:
    """The block on the table: model, z and forces of the static problem by nonnegative least squares, all dense."""
    damped = "effects.damping={kind='rayleigh', alpha=4.0, beta=0.05}"
    model = build("paper_forward", [*SMALL, ON, TABLE, damped, *overrides])
    system, surface = model.system, make_surface(model.space, model.system)
    K, load = to_scipy(system.K_ee).toarray(), system.G @ system.fall
    N = np.zeros((len(surface.X), len(K)))
    N[np.arange(len(N)), surface.rows.reshape(-1, 2)[:, 1]] = 1.0
    W, q = N @ np.linalg.solve(K, N.T), surface.X[:, 1] + 0.03 + N @ np.linalg.solve(K, load)
    L = scipy.linalg.cholesky((W + W.T) / 2, lower=True)
    x, _ = nnls(L.T, -scipy.linalg.solve_triangular(L, q, lower=True))
    on = np.flatnonzero(x)  # nnls solves to about 1e-10: the set is exact, the forces on it are solved for anew
    x[on] = np.linalg.solve(W[np.ix_(on, on)], -q[on])
    assert x.min() >= 0
    assert (q + W @ x).min() > -1e-13
    return model, np.linalg.solve(K, load + N.T @ x), x


@pytest.mark.serial
def test_rest_state_is_that_of_the_static_obstacle_problem() -> None:
    model, z, x = rest_of_block("time.steps=1500", "time.end=30")
    result = simulate(model)
    # dense and sparse factors: rounding times the condition of K, 1e3
    assert result.contact.force[-1, 0, 1] == pytest.approx(x.sum(), rel=1e-12)
    assert np.abs(np.split(result.final, 2)[0] - z).max() < 1e-12 * np.abs(z).max()


@pytest.mark.serial
def test_a_start_in_equilibrium_rests_on_the_table_and_stays() -> None:
    model, z, x = rest_of_block("time.start='equilibrium'", "time.steps=20")
    begin = Run(model, RunOptions())
    begin.start()
    assert np.abs(begin.state.z.array - z).max() < 1e-12 * np.abs(z).max()
    begin.midpoint.destroy()
    after = simulate(model)
    assert np.abs(np.split(after.final, 2)[0] - z).max() < 1e-12 * np.abs(z).max()
    assert after.contact.force[:, 0, 1] == pytest.approx(x.sum(), rel=1e-11)
    assert after.contact.stopped < 1e-20  # nothing moves


@pytest.mark.ranks(2)
@pytest.mark.parametrize("obstacle", [DISC, BOX, SLANTED])
def test_a_start_in_equilibrium_meets_the_conditions_of_contact(obstacle: str) -> None:
    deeper = obstacle.replace("-0.53]", "-0.49]").replace("-0.03]", "0.01]").replace("-0.03}", "0.03}")
    start = Run(build("paper_forward", [*SMALL, ON, deeper, BETA, "time.start='equilibrium'"]), RunOptions())
    start.start()
    contact, system = start.contact, start.model.system
    assert contact is not None
    surface, z = contact.surface, start.state.z
    residual = system.K_ee @ z
    residual.array_w[:] -= system.G @ system.fall
    force = surface.gather(residual.array_r).reshape(-1, 2)
    inside = np.array(residual.array_r)
    inside[surface.rows] = 0
    scale = np.abs(force).max()
    assert np.abs(inside).max(initial=0.0) < 1e-12 * scale  # rounding
    places = surface.places(start.drive.q[0], surface.gather(z.array_r))
    touched = np.zeros(len(places), dtype=bool)
    for o in contact.obstacles:
        gap, normal = o.look(places)
        assert gap.min() > -1e-14  # rounding of coordinates of size 2
        touched |= gap < 1e-14
        if len(contact.obstacles) == 1:
            along = np.einsum("ij,ij->i", force, normal)
            assert along.min() > -1e-12 * scale
            assert np.abs(force - along[:, None] * normal).max() < 1e-11 * scale  # coordinates over radius
    assert np.abs(force[~touched]).max() < 1e-12 * scale
    assert touched.sum() > 1
    start.midpoint.destroy()


def test_a_free_hand_rests_with_its_weight_on_the_table() -> None:
    damped = "effects.damping={kind='rayleigh', alpha=4.0, beta=0.05, drag='space'}"
    model = build("paper_forward", [*SMALL, ON, TABLE, *TWO, damped, "time.steps=2000", "time.end=60"])
    weight = model.system.M_hand[1, 1] + model.system.M_rigid[1, 1]
    force = simulate(model).contact.force[-1, 0]
    assert force[1] == pytest.approx(weight, rel=1e-8)  # what is left of the motion after 60 s


@pytest.mark.parametrize(
    "overrides", [[TABLE, BETA], [SLANTED, "time.solver='mumps'"], [DISC, *TWO, *SHORT], [DISC, *SHORT]]
)
def test_restart_in_contact_repeats_the_bits(overrides: list[str], mpi_tmp_path: Path) -> None:
    whole, model = run(*overrides), build("paper_forward", [*SMALL, ON, *overrides])
    with pytest.raises(Paused):
        simulate(model, RunOptions(mpi_tmp_path, until=101))
    again = simulate(build("paper_forward", [*SMALL, ON, *overrides]), RunOptions(mpi_tmp_path, resume=True))
    assert whole.contact.touching[:101].max() > 0
    assert np.array_equal(again.final, whole.final)
    for name in ("force", "impulse", "gap", "touching", "chattering", "pressing"):
        assert np.array_equal(getattr(again.contact, name), getattr(whole.contact, name))
    assert again.energy_drift == whole.energy_drift
    assert again.contact.touch == whole.contact.touch


@pytest.mark.parametrize("first", [True, False])
def test_a_run_resumes_where_contact_is_compiled_as_it_was(
    first: bool, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, here = build("paper_forward", [*SMALL, ON, TABLE, *SHORT]), contact_library()

    def have(compiler: bool) -> None:
        for name in ("obstacles.compiled", "run.contact.step", "run.contact.flat", "obstacles.small"):
            monkeypatch.setattr(f"softgrasp.fem.{name}.contact_library", lambda: here if compiler else None)

    have(first)
    with pytest.raises(Paused):
        simulate(model, RunOptions(mpi_tmp_path, until=101))
    have(not first)
    words = "with compiled contact, which this machine lacks" if first else "without compiled contact, which this"
    with pytest.raises(CheckpointError, match=f"{words}.*resume where the run began, or run again without --resume"):
        simulate(model, RunOptions(mpi_tmp_path, resume=True))


@pytest.mark.ranks(3)
@pytest.mark.parametrize("reproducible", ["true", "false"])
def test_ranks_agree_with_one(reproducible: str) -> None:
    here = run(TABLE, BETA, f"time.reproducible={reproducible}")
    alone = simulate(build("paper_forward", [*SMALL, ON, TABLE, BETA], MPI.COMM_SELF))
    # rounding of another order of elimination, over 300 steps in which nodes touch and leave
    assert np.abs(here.outputs - alone.outputs).max() < 1e-9 * np.abs(alone.outputs).max()
    assert np.abs(here.contact.force[-1] - alone.contact.force[-1]).max() < 1e-6 * np.abs(alone.contact.force).max()


def test_three_dimensions_and_higher_orders_close_their_balance() -> None:
    table = "obstacle=[{kind='halfspace', normal=[0, 0, 1], offset=-0.0001}]"
    low = ["tissue.cells=[2, 2, 2]", "time.start='rest'", "motion={profile='hold'}", "time.steps=60", "time.end=0.3"]
    low += [ON, table]
    for order in (1, 2):
        result = simulate(build("block_3d", [*low, f"tissue.order={order}", "effects.gravity={g=[0, 0, -9.81]}"]))
        assert result.contact.touching.max() > 0
        assert result.energy_drift < 1e-12  # rounding
        assert result.contact.penetration < 1e-13


@pytest.mark.ranks(2)
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("shape", BLUNT)
def test_nodes_that_pass_an_edge_within_a_step_stay_outside(shape: str, friction: float) -> None:
    """Normals turn from face to face between rounds, also without force; on the frustum without end, but for planes."""
    result = simulate(
        build(
            "block_3d",
            ["tissue.cells=[3, 3, 3]", "tissue.order=1", "tissue.refine=false", ON, "time={steps=60, end=0.3}",
             "time.start='rest'", "effects.rotation=false", "effects.reaction=false",
             "effects.gravity={g=[0, 0, -9.81]}",
             "motion={profile='quintic', target=[0.02, 0.01, -0.001], duration=0.3}",
             f"obstacle=[{{{shape}, friction={friction}}}]"],
        )
    )  # fmt: skip
    assert result.contact.touching.max() > 3
    assert result.energy_drift < 1e-13  # rounding: measured 3e-15
    assert result.contact.penetration < 1e-14  # of a body of 0.05 m: rounding of its places
    assert min(result.contact.touch, result.contact.stopped, result.contact.rubbed) >= 0  # an obstacle at rest


def test_the_force_on_a_prescribed_hand_takes_in_the_contact() -> None:
    result = run(TABLE, BETA, "time.start='rest'")
    model = build("paper_forward", [*SMALL, ON, TABLE, BETA])
    weight = model.system.M_rigid[1, 1] * 5
    # over a run that ends nearly at rest the mean force of hand and table carries the weight
    total = result.force[-100:, 1].mean() + result.contact.force[-100:, 0, 1].mean()
    assert total == pytest.approx(weight, rel=0.02)  # what is left of the oscillation


REFUSED = [
    ([ON], "obstacle is missing; effects.obstacles needs at least one [[obstacle]]"),
    ([TABLE], "set effects.obstacles = true for contact"),
    ([TABLE, ON, "time.solver='cg'"], "effects.obstacles needs a factor"),
    (
        [TABLE, ON, "effects.finite_strain={}", "effects.reaction=true"],
        "effects.reaction cannot go with effects.obstacles",
    ),
    (
        [TABLE, ON, "effects.finite_strain={}", "effects.gravity={g=[0, -1]}", "time.start='equilibrium'"],
        "starts at 'rest'",
    ),
    (
        [TABLE.replace("}]", ", friction=0.1}]"), ON, "effects.finite_strain={}"],
        "friction, which effects.finite_strain",
    ),
    ([TABLE, ON, "tissue.refine={tolerance=0.1}"], "tissue.refine.tolerance cannot go with effects.obstacles"),
]


@pytest.mark.ranks(2)
@pytest.mark.parametrize("overrides", [[SLANTED, BETA], [TABLE, SPACE, *TWO]])
def test_compiled_half_spaces_are_those_of_the_general_step(
    overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = run(*overrides)
    monkeypatch.setattr("softgrasp.fem.run.contact.step.contact_library", lambda: None)
    general = run(*overrides)
    assert general.contact.rounds >= compiled.contact.rounds > 0
    # two orders of the same sums, over 300 steps in which nodes touch and leave
    assert np.abs(compiled.final - general.final).max() < 1e-9 * np.abs(general.final).max()
    assert compiled.contact.stopped == pytest.approx(general.contact.stopped, rel=1e-9)
    assert compiled.contact.touch == pytest.approx(general.contact.touch, rel=1e-9, abs=1e-15)
    assert np.array_equal(compiled.contact.touching, general.contact.touching)
    scale = np.abs(general.force).max()
    assert np.abs(compiled.force - general.force).max() <= 1e-6 * scale  # impulses over dt: sums that cancel


@pytest.mark.ranks(3)
@pytest.mark.parametrize("overrides", [[TABLE, SPACE, *TWO], [SLANTED, BETA], [RUBBING, SPACE, *TWO]])
def test_forces_enter_between_the_sweeps_of_a_solve_as_by_columns_or_another_solve(
    overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = build("paper_forward", [*SMALL, ON, *overrides, *SHORT])
    between = simulate(model)
    monkeypatch.setattr("softgrasp.fem.run.contact.flat.sweeps_of", lambda *_: None)
    columns = simulate(model)
    monkeypatch.setattr("softgrasp.fem.run.contact.flat.READS", 0)
    solved = simulate(model)
    for one in (between, solved):
        # two orders of the same sums, over 130 steps in which nodes touch and leave
        assert np.abs(columns.final - one.final).max() < 1e-9 * np.abs(one.final).max()
        assert np.array_equal(columns.contact.touching, one.contact.touching)
        assert not np.array_equal(columns.final, one.final)  # the way there differs
        assert one.energy_drift < 1e-13
        assert one.contact.penetration < 1e-13


@pytest.mark.parametrize(("overrides", "words"), REFUSED)
def test_what_contact_cannot_do_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene("paper_forward", overrides)
    assert words in str(error.value)


def test_a_start_inside_and_a_hand_that_meets_an_obstacle_are_refused() -> None:
    with pytest.raises(SceneError, match=r"obstacle 'disc1' contains the point of the tissue at .* m deep; move it"):
        run("obstacle=[{kind='disc', center=[0.5, 0.2], radius=0.3}]")
    model = build("paper_forward", [*SMALL, ON, TABLE])
    held = np.concatenate(MPI.COMM_WORLD.allgather(model.system.layout.held))[0].tolist()
    with pytest.raises(SoftgraspError, match="the hand meets obstacle 'disc1' at t = 0 s"):
        run(f"obstacle=[{{kind='disc', center={held}, radius=0.01}}]")


@pytest.mark.serial
@pytest.mark.skipif(contact_library() is None, reason="no C compiler")
def test_a_gap_that_is_no_number_is_the_least() -> None:
    """Also where gaps of later nodes are numbers."""
    one = Run(build("set_down", ["tissue.cells=[4, 4]", "time.steps=4"]), RunOptions())
    one.start()
    contact: Any = one.contact
    contact.moved[0] = np.nan
    contact.f.whole = False
    contact.c.softgrasp_look(contact.f)
    one.midpoint.destroy()
    assert np.isnan(contact.least).all()
