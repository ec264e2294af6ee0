"""Finite strain reduced, on plain arrays: weights, both steppers, conservation, an exact polynomial, the box."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.optimize

from softgrasp.fem.compiled import library
from softgrasp.fem.errors import SolverError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import LAWS, LawName
from softgrasp.reduction.archive import load, save, write_checksums
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.strain import stepper
from softgrasp.reduction.strain.cells import Cells, Potential
from softgrasp.reduction.strain.model import StrainModel, TrainingDomain
from softgrasp.reduction.strain.nnls import nnls
from softgrasp.reduction.strain.stepper import March, StrainProblem, march_strain
from softgrasp.reduction.system import ModelError, Outputs

pytestmark = pytest.mark.serial
LAYERS = (LayerMaterial(50.0, 50.0, 1.0), LayerMaterial(80.0, 20.0, 1.0))
EACH_LAW = pytest.mark.parametrize("law", list(LAWS))
EACH_DIMENSION = pytest.mark.parametrize("d", [2, 3])


def cells_of(law: LawName, d: int, k: int = 4, q: int = 11) -> Cells:
    rng = np.random.default_rng(d)
    B = rng.standard_normal((k, d, d, q))
    weight = rng.uniform(0.5, 1.5, q) / q
    return Cells(law, B, weight, np.ones(q), rng.integers(0, 2, q), np.arange(q), rng.random((q, d)))


def problem_of(law: LawName, d: int, dt: float = 0.01, beta: float = 0.0) -> StrainProblem:
    potential = Potential(cells_of(law, d), LAYERS)
    K = potential.tangent(np.zeros(potential.k))
    return StrainProblem(potential, beta * K, K, dt)


def loads(problem: StrainProblem, steps: int, size: float = 100.0) -> Array:
    """A push that ends at half time, at the midpoints."""
    x = (np.arange(steps) + 0.5) / steps
    shape = np.random.default_rng(7).standard_normal(problem.potential.k)
    return size * np.outer(np.where(x < 0.5, np.sin(2 * np.pi * x) ** 2, 0.0), shape)


def run(problem: StrainProblem, load: Array, tol: float = 1e-11, engine: str = "NumPy") -> March:
    return march_strain(problem, load, np.zeros(load.shape[1]), np.zeros(load.shape[1]), tol, engine)


def test_weights_are_those_of_scipy_where_the_least_residual_is_asked_for() -> None:
    rng = np.random.default_rng(1)
    G = rng.standard_normal((40, 25))
    b = G @ np.where(rng.random(25) < 0.4, rng.random(25), 0.0)  # a unique answer: G has full rank
    answer = nnls(G, b, 1e-6)
    # the residual bounds the error by tau |b| / sigma_min(G)
    assert np.abs(answer.x - scipy.optimize.nnls(G, b)[0]).max() < 1e-6 * np.linalg.norm(b) * 2
    assert answer.residual <= 1e-6


def test_early_stop_takes_fewer_columns_and_keeps_its_promise() -> None:
    rng = np.random.default_rng(2)
    G = rng.standard_normal((60, 8)) @ rng.random((8, 300)) + 0.02 * rng.standard_normal((60, 300))
    b = G.sum(axis=1)
    counts = []
    for tau in (1e-1, 1e-2, 1e-3):
        answer = nnls(G, b, tau)
        assert (answer.x >= 0).all()
        assert np.linalg.norm(G @ answer.x - b) <= tau * np.linalg.norm(b) * (1 + 1e-12)
        counts.append(np.count_nonzero(answer.x))
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] <= 60


def test_weights_that_cannot_be_are_refused() -> None:
    with pytest.raises(ReductionError, match="no non-negative weights"):
        nnls(np.eye(3), np.array([1.0, -1.0, 1.0]), 1e-2)
    with pytest.raises(ReductionError, match="tau"):
        nnls(np.eye(3), np.ones(3), 0.0)


@EACH_LAW
@EACH_DIMENSION
def test_the_compiled_stepper_takes_the_steps_of_numpy(law: LawName, d: int) -> None:
    """Two programs: they share no line, and agree to the tolerance of the solves over many steps."""
    if stepper.compiled() is None:
        pytest.skip("no C compiler")
    problem = problem_of(law, d, beta=1e-3)
    load = loads(problem, 150)
    mine, other = run(problem, load, engine="C"), run(problem, load)
    assert (mine.engine, other.engine) == ("C", "NumPy")
    assert np.abs(mine.a - other.a).max() < 1e-9 * np.abs(other.a).max()
    assert np.abs(problem.potential.gradient(mine.a[40])).max() > 0.05  # strain that a linear model would miss


@EACH_LAW
@EACH_DIMENSION
def test_the_model_keeps_its_energy(law: LawName, d: int) -> None:
    problem = problem_of(law, d)
    load = loads(problem, 200)
    done = run(problem, load)
    energy = problem.potential.energy(done.a) + (done.v**2).sum(axis=1) / 2
    work = np.concatenate([[0.0], np.cumsum(np.einsum("ti,ti->t", np.diff(done.a, axis=0), load))])
    # every step adds at most tol |h| |2 w|
    assert np.abs(energy - work).max() < 1e-9 * energy.max()
    after = energy[101:]
    assert np.ptp(after) < 1e-9 * energy.max()


def test_damping_takes_what_it_says() -> None:
    problem = problem_of("neo-hooke", 2, beta=5e-3)
    load = loads(problem, 200)
    done = run(problem, load)
    energy = problem.potential.energy(done.a) + (done.v**2).sum(axis=1) / 2
    step = np.diff(done.a, axis=0)
    lost = np.einsum("ti,ij,tj->t", step, problem.D, step) / problem.dt
    assert np.abs(np.diff(energy) - np.einsum("ti,ti->t", step, load) + lost).max() < 1e-9 * energy.max()
    assert (np.diff(energy[101:]) < 0).all()


def test_the_step_is_of_second_order() -> None:
    ends = []
    for steps in (100, 200, 400, 3200):
        problem = problem_of("neo-hooke", 2, dt=2.0 / steps)
        ends.append(run(problem, loads(problem, steps)).a[-1])
    errors = [np.linalg.norm(end - ends[-1]) for end in ends[:-1]]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 1.9) & (orders < 2.1)).all(), orders


def test_small_motions_are_those_of_the_linear_model() -> None:
    """The difference to the linear midpoint rule shrinks with the square of the load."""
    problem, missed = problem_of("neo-hooke", 2), []
    k, s = problem.potential.k, 2 / problem.dt
    inverse = np.linalg.inv(s * s * np.eye(k) + problem.K)
    for size in (1e-2, 1e-3):
        load = loads(problem, 100, size)
        a, v = np.zeros(k), np.zeros(k)
        for now in load:
            w = inverse @ (s * v - problem.K @ a + now)
            a, v = a + 2 * w, 2 * s * w - v
        missed.append(np.linalg.norm(run(problem, load, 1e-13).a[-1] - a))
    assert 1.9 < np.log10(missed[0] / missed[1]) < 2.1


@EACH_DIMENSION
def test_saint_venant_kirchhoff_is_a_polynomial(d: int) -> None:
    """W_r = m'Tm/2 with m = [a; a_i a_j] exactly: T is made once, without any law."""
    potential = Potential(cells_of("stvk", d), LAYERS)
    T, m = polynomial(potential)
    rng = np.random.default_rng(3)
    a, w = 0.1 * rng.standard_normal((2, potential.k))
    assert potential.energy(a[None])[0] == pytest.approx(m(a) @ T @ m(a) / 2, rel=1e-13)
    # gradient by the product rule, dm/da of degree one, exact in central differences
    basis = 0.5 * np.eye(potential.k)
    pull = lambda at, y: np.array([(m(at + e) - m(at - e)) @ y for e in basis])  # noqa: E731
    np.testing.assert_allclose(potential.force(a), pull(a, T @ m(a)), rtol=1e-12, atol=1e-13)
    potential.begin(a)
    step, bad = potential.discrete(w)
    assert step is not None
    assert bad == -1
    # the discrete gradient: mean of T m at both ends, pulled back at the midpoint
    np.testing.assert_allclose(step, pull(a + w, T @ (m(a) + m(a + 2 * w)) / 2), rtol=1e-12, atol=1e-13)


def polynomial(potential: Potential):  # type: ignore[no-untyped-def]
    """T and m of W = mu E:E + lam/2 (tr E)^2, E = (H + H' + H'H) / 2, H = B a."""
    k, d, cells = potential.k, potential.d, potential.cells
    m, n = np.triu_indices(k)
    both = np.where(m == n, 1.0, 2.0)
    T = np.zeros((k + len(m), k + len(m)))

    def add(rows: Array, factor: Array) -> None:
        nonlocal T
        T += (rows * (factor * cells.weight)) @ rows.T

    trace = np.zeros((len(T), len(cells.weight)))
    for i in range(d):
        for j in range(d):
            B, C = cells.B[:, :, i], cells.B[:, :, j]
            square = sum((B[m, r] * C[n, r] + B[n, r] * C[m, r]) / 4 for r in range(d)) * both[:, None]
            E = np.vstack([(cells.B[:, i, j] + cells.B[:, j, i]) / 2, square])
            add(E, 2 * potential.mu)
            trace += E if i == j else 0.0
    add(trace, potential.lam)
    return T, lambda a: np.concatenate([a, a[m] * a[n]])


def test_derivatives_of_the_reduced_energy() -> None:
    potential = Potential(cells_of("neo-hooke", 3), LAYERS)
    a, h = 0.05 * np.random.default_rng(4).standard_normal(potential.k), 1e-5
    up, down = (potential.energy(a + s * h * np.eye(potential.k)) for s in (1, -1))
    np.testing.assert_allclose((up - down) / (2 * h), potential.force(a), rtol=1e-6, atol=1e-8)  # h^2 W''' = 1e-9
    columns = [(potential.force(a + h * e) - potential.force(a - h * e)) / (2 * h) for e in np.eye(potential.k)]
    np.testing.assert_allclose(columns, potential.tangent(a), rtol=1e-6, atol=1e-6)


@EACH_LAW
@EACH_DIMENSION
def test_many_states_at_once_are_those_one_by_one(law: LawName, d: int) -> None:
    potential = Potential(cells_of(law, d), LAYERS)
    a, w = 0.05 * np.random.default_rng(6).standard_normal((2, 3, potential.k))
    steps = []
    for each, half in zip(a, w, strict=True):
        potential.begin(each)
        steps.append(potential.discrete(half)[0])
    np.testing.assert_allclose(potential.discrete_forces(a, w), steps, rtol=1e-12, atol=1e-13)  # sums in another order
    np.testing.assert_allclose(potential.tangents(a), [potential.tangent(x) for x in a], rtol=1e-12, atol=1e-12)
    assert law == "stvk" or np.isinf(potential.discrete_forces(a, 1e3 * w)).all()  # a cell folds


def test_a_model_without_a_finer_space_gives_no_number() -> None:
    assert np.isnan(model_of().at(0.01).run(hand_of(1.0)).error_estimate)


@pytest.mark.parametrize("engine", ["C", "NumPy"])
def test_a_run_that_folds_names_step_time_and_cell(engine: str) -> None:
    if engine == "C" and stepper.compiled() is None:
        pytest.skip("no C compiler")
    problem = problem_of("neo-hooke", 2, dt=5.0)
    with pytest.raises(SolverError, match=r"neo-hooke.* in step \d+ \(t = .* s\)"):
        run(problem, loads(problem, 20, 1e9), engine=engine)


def test_without_a_compiler_numpy_steps_and_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library.cache_clear()
    try:
        problem = problem_of("neo-hooke", 2)
        with pytest.warns(RuntimeWarning, match="NumPy, about thirty times slower"):
            assert run(problem, loads(problem, 5), engine="").engine == "NumPy"
        with pytest.raises(SolverError, match="compiled stepper"):
            run(problem, loads(problem, 5), engine="C")
        assert list(tmp_path.rglob("*.so")) == []  # nothing half-written
    finally:
        library.cache_clear()


def model_of() -> StrainModel:
    cells = cells_of("neo-hooke", 2)
    ones = np.ones(2)
    box = TrainingDomain(
        lam=np.outer([50.0, 80.0], [0.8, 1.2]),
        mu=np.outer([50.0, 20.0], [0.8, 1.2]),
        load=np.outer(ones, [-2.0, 2.0]),
        largest_coordinates=np.full(4, 0.5),
    )
    K = np.stack([np.eye(4), np.eye(4)])
    return StrainModel(
        cells, K, K, np.random.default_rng(5).standard_normal((4, 2)), LAYERS,
        Outputs(np.ones((1, 4)), np.ones((1, 2)), ("tip",)), box, 99, cubature_tolerance=1e-2, scene_hash="abc",
    )  # fmt: skip


def hand_of(size: float, steps: int = 50, dt: float = 0.01) -> tuple[Array, Array]:
    """One to and fro whose largest acceleration is the size."""
    t = dt * np.arange(steps + 1)
    v = size / 7 * np.outer(np.sin(7 * t), [1.0, -0.5])
    return np.zeros_like(v), v


def test_a_model_answers_inside_its_box_only() -> None:
    model = model_of()
    soft = (replace(LAYERS[0], mu=39.0), LAYERS[1])
    with pytest.raises(ModelError, match=r"mu = 39 Pa of layer 1 is outside the training range \[40, 60\] Pa"):
        model.at(0.01, soft)
    with pytest.raises(ModelError, match="densities"):
        model.at(0.01, (replace(LAYERS[0], rho=2.0), LAYERS[1]))
    outside = model.at(0.01, soft, outside=True).run(hand_of(1.0))
    assert outside.energy_drift < 1e-8
    assert outside.untrained == "mu = 39 Pa of layer 1 is outside the training range [40, 60] Pa"
    small = model.at(0.01, (replace(LAYERS[0], mu=41.0), LAYERS[1]))
    assert small.run(hand_of(1.0)).energy_drift < 1e-8
    assert small.run(hand_of(1.0)).untrained == ""
    with pytest.raises(ModelError, match="acceleration in degree of freedom 1"):
        small.run(hand_of(3.0))
    for dt in (0.0, -0.01, np.nan):
        with pytest.raises(ModelError, match="must be a positive number"):
            model.at(dt)
    with pytest.raises(ModelError, match="not finite"):
        small.run((hand_of(1.0)[0], np.full_like(hand_of(1.0)[1], np.nan)))
    narrow = replace(model, box=replace(model.box, largest_coordinates=model.box.largest_coordinates * 1e-4))
    with pytest.raises(ModelError, match="times what the training runs reached"):
        narrow.at(0.01).run(hand_of(1.0))


def test_equilibrium_under_gravity_is_at_rest() -> None:
    small = model_of().at(0.01, gravity=np.array([0.0, -1.0]))
    a = small.equilibrium()
    still = np.zeros((11, 2))
    run = small.run((still, still), a0=a)
    assert np.abs(a).max() > 1e-3
    assert np.abs(run.a - a).max() < 1e-9 * np.abs(a).max()  # Newton's residual of 1e-12 and the solves' of 1e-10


def test_a_file_gives_the_same_model(tmp_path: Path) -> None:
    model = model_of()
    save(model, tmp_path / "strain.h5")
    read = load(tmp_path / "strain.h5", scene_hash="abc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where there is no compiler
        one, two = (m.at(0.01).run(hand_of(1.0)) for m in (model, read))
    np.testing.assert_array_equal(one.a, two.a)
    assert (read.N, read.cubature_tolerance, read.outputs.names, read.cells.law) == (12, 1e-2, ("tip",), "neo-hooke")
    with pytest.raises(ModelError, match="another scene"):
        load(tmp_path / "strain.h5", scene_hash="other")
    for key, value in (("cells_full", None), ("beta", 0.1)):  # as other versions would write it
        save(model, tmp_path / "strain.h5")
        with h5py.File(tmp_path / "strain.h5", "r+") as file:
            data = json.loads(file.attrs["model"])
            file.attrs["model"] = json.dumps({k: v for k, v in {**data, key: value}.items() if v is not None})
            write_checksums(file)
        with pytest.raises(ModelError, match=f"cannot be read .*{key}"):
            load(tmp_path / "strain.h5")
