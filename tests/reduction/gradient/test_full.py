"""Derivatives of full runs against complex steps through the rule as a textbook writes it, in dense matrices."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import ResourceError, SceneError
from softgrasp.fem.petsc import to_scipy
from softgrasp.reduction.system import ModelError

pytestmark = pytest.mark.serial
TINY = 1e-30  # complex steps have no cancellation
# of the largest derivative of its kind: rounding of 30 to 40 steps with matrices of condition 1e4; 4e-13 measured
EXACT = 1e-12
SMALL = ["tissue.cells=[3, 6]", "time.steps=40", "output.snapshots='none'"]
DAMPED = "effects.damping={kind='rayleigh', beta=0.004, alpha=0.1, drag='space'}"
FORCED = ["motion.drive='force'", "hand.mass=20"]
LAYERS = (
    "{low={box=[[0.0, 0.0], [1.0, 0.7]], material={lambda=90.0, mu=20.0, rho=2.5}, beta=0.03},"
    " core={box=[[0.0, 0.7], [1.0, 1.4]], material={lambda=10.0, mu=70.0, rho=0.5}}}"
)
SCENES: dict[str, tuple[str, list[str]]] = {
    "undamped": ("paper_forward", SMALL),
    "damped": ("paper_forward", [*SMALL, DAMPED]),
    "force": ("paper_forward", [*SMALL, DAMPED, *FORCED]),
    "two-way": ("paper_forward", [*SMALL, DAMPED, *FORCED, "effects.reaction=true", "effects.rotation=true",
        "hand.inertia=3", "motion.target=[1, 0.5, 0.1]"]),
    "led two-way": ("paper_forward", [*SMALL, "effects.reaction=true", "hand.mass=20"]),
    "layers": ("paper_forward", [*SMALL, "tissue.thickness=0.5", "tissue.layers=" + LAYERS, DAMPED,
        "effects.gravity={g=[1.0, -9.0]}", "time.start='equilibrium'"]),
}  # fmt: skip


@dataclass
class Dense:
    """Matrices of a model, one of each layer and kind, and the textbook's rule in them."""

    model: Any

    def __post_init__(self) -> None:
        system = self.model.system
        self.layers = [
            tuple((to_scipy(A.ee).toarray(), A.es, A.ss) for A in (layer.K_lambda, layer.K_mu, layer.M_1))
            for layer in system.layers
        ]
        self.C = self.model.output_columns.T
        self.C_s = np.vstack([o.C_s for o in self.model.outputs])
        self.dt = self.model.scene.time_end / self.model.scene.time.steps

    def loss(self, y: Any, materials: Any, alpha: Any, hand: Any = None, force: Any = None, start: Any = None) -> Any:
        """J = |y_h - y|^2 / 2, with [z; v_z] relative to the hand; ``start``: a change of the scene's start."""
        system, T = self.model.system, self.model.system.T
        n, n_s = T.shape
        K, D, M = (np.zeros((n, n), dtype=complex) for _ in range(3))
        G, rigid = np.zeros((n, n_s), dtype=complex), np.zeros((n_s, n_s), dtype=complex)
        for (K_lam, K_mu, M_1), m in zip(self.layers, materials, strict=True):
            own = m["lam"] * K_lam[0] + m["mu"] * K_mu[0]
            K, D, M = K + own, D + m["beta"] * own, M + m["rho"] * M_1[0]
            part = M_1[1] + M_1[0] @ T
            G = G + m["rho"] * part
            rigid = rigid + m["rho"] * (M_1[2] + T.T @ part + M_1[1].T @ T)
        drag = alpha if system.damping.in_space else 0.0
        D = D + alpha * M
        dt, g = self.dt, system.fall
        steps = len(force) if hand is None else len(hand[0]) - 1
        # unknowns of a step: mean accelerations of hand and tissue
        middle = M + dt / 2 * D + dt**2 / 4 * K
        A = np.zeros((n_s + n, n_s + n), dtype=complex)
        A[n_s:, n_s:], A[n_s:, :n_s] = middle, G * (1 + drag * dt / 2)
        A[:n_s, :n_s] = system.M_hand
        if system.two_way:
            A[:n_s, :n_s] += rigid * (1 + drag * dt / 2)
            A[:n_s, n_s:] = G.T * (1 + drag * dt / 2)
        left, left_z = np.linalg.inv(A), np.linalg.inv(middle)
        z, v, q, p = (np.zeros(size, dtype=complex) for size in (n, n, n_s, n_s))
        if self.model.scene.time.start == "equilibrium":
            z = np.linalg.solve(K, G @ g)
        if start is not None:
            q, p, z, v = (a + b for a, b in zip((q, p, z, v), np.split(start, np.cumsum([n_s, n_s, n])), strict=True))
        total = 0.0
        for k in range(steps + 1):
            at = q if hand is None else hand[0][k]
            total = total + ((self.C @ z + self.C_s @ at - y[k]) ** 2).sum() / 2
            if k == steps:
                return total
            rest_z = G @ g - K @ (z + dt / 2 * v) - D @ v
            if hand is None:
                rest_h = force[k] + system.weight
                if system.two_way:
                    rest_h = rest_h + rigid @ (g - drag * p) - drag * (G.T @ v)
                a = left @ np.concatenate([rest_h, rest_z - drag * (G @ p)])
                a_s, a_z = a[:n_s], a[n_s:]
            else:
                now, then = hand[1][k], hand[1][k + 1]
                a_s = (then - now) / dt
                a_z = left_z @ (rest_z - G @ (a_s + drag * (now + then) / 2))
            q, p = q + dt * p + dt**2 / 2 * a_s, p + dt * a_s
            z, v = z + dt * v + dt**2 / 2 * a_z, v + dt * a_z
        raise AssertionError


@pytest.fixture(scope="module", params=SCENES)
def case(request: pytest.FixtureRequest) -> tuple[Any, Any, Any, dict[str, Any]]:
    """A model, its run, data, and the arguments of the oracle."""
    model = sg.build(*SCENES[request.param])
    run = sg.simulate(model)
    y = 0.9 * run.outputs + 1e-2 * np.random.default_rng(2).standard_normal(run.outputs.shape)
    materials = [{k: getattr(m, k) for k in ("lam", "mu", "rho", "beta")} for m in model.system.materials]
    given = {"y": y, "materials": materials, "alpha": model.system.damping.alpha}
    driven = model.scene.motion.drive == "motion"
    given.update({"hand": (run.q_s, run.v_s)} if driven else {"force": run.force})
    return model, run, y, given


def test_gradients_are_those_of_complex_steps(case: Any) -> None:
    model, _, y, given = case
    dense = Dense(model)
    found = sg.gradient(model, lambda x: (((x - y) ** 2).sum() / 2, x - y))

    def slope(**changes: Any) -> float:
        return float(dense.loss(**{**given, **changes}).imag / TINY)

    assert found.value == pytest.approx(dense.loss(**given).real, rel=1e-10)  # rounding
    materials = given["materials"]
    for key in ("lam", "mu", "rho", "beta"):
        if (derivative := getattr(found, key)) is None:
            assert key == "beta"
            assert model.scene.effects.damping is None
            continue
        exact = [
            slope(materials=[*materials[:i], {**m, key: m[key] + 1j * TINY}, *materials[i + 1 :]])
            for i, m in enumerate(materials)
        ]
        np.testing.assert_allclose(derivative, exact, rtol=0, atol=EXACT * np.abs(exact).max(), err_msg=key)
    if found.alpha is not None:
        assert found.alpha == pytest.approx(slope(alpha=given["alpha"] + 1j * TINY), rel=EXACT)
    n_s, n = model.system.T.shape[1], len(model.system.T)
    driven = found.force is None
    for i in (0, n_s, 2 * n_s, 2 * n_s + n // 2, 2 * n_s + n, 2 * n_s + n + n // 3):
        bump = np.zeros(2 * n_s + 2 * n, dtype=complex)
        bump[i] = 1j * TINY
        exact = 0.0 if driven and i < 2 * n_s else slope(start=bump)
        assert abs(found.start[i] - exact) <= EXACT * np.abs(found.start).max(), i
    tables = given["hand"] if driven else (given["force"],)
    slopes = found.hand if driven else (found.force,)
    for part, table in enumerate(tables):
        for k in (0, 7, len(table) - 1):
            bump = table.astype(complex)
            bump[k, 1] += 1j * TINY
            changed = {"force": bump} if not driven else {
                "hand": tuple(bump if j == part else t for j, t in enumerate(tables))
            }  # fmt: skip
            assert abs(slopes[part][k, 1] - slope(**changed)) <= EXACT * np.abs(slopes[part]).max(), (part, k)


def test_states_in_a_file_change_no_bit(case: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, y, _ = case

    def loss(x: Any) -> Any:
        return ((x - y) ** 2).sum() / 2, x - y

    one, needed, mapped = sg.gradient(model, loss), 16 * model.system.layout.n_e * (len(y)), []
    memmap = np.memmap
    monkeypatch.setattr(np, "memmap", lambda *a, **k: mapped.append(a) or memmap(*a, **k))
    monkeypatch.setattr("softgrasp.fem.adjoint.forward.free_memory", lambda: 2 * needed)
    sg.gradient(model, loss)
    assert not mapped
    monkeypatch.setattr("softgrasp.fem.adjoint.forward.free_memory", lambda: 2 * needed - 1)
    many = sg.gradient(model, loss)
    assert mapped
    np.testing.assert_array_equal(many.run.outputs, one.run.outputs)
    for key in ("lam", "mu", "rho", "start"):
        np.testing.assert_array_equal(getattr(many, key), getattr(one, key), err_msg=key)


def test_tables_and_materials_take_the_place_of_the_scenes() -> None:
    model = sg.build("paper_forward", [*SMALL, "effects.reaction=true", "hand.mass=20"])
    run = sg.simulate(model)
    other = model.with_materials(mu=70.0)
    fast = 1.1 * run.q_s, 1.1 * run.v_s

    def loss(x: Any) -> Any:
        return (x**2).sum() / 2, x

    a = sg.gradient(model, loss, hand=fast, materials=other.system.materials)
    b = sg.gradient(other, lambda x: ((1.1 * x) ** 2 @ [0.5, 0.5] @ np.ones(len(x)), 1.1**2 * x))
    assert a.value == pytest.approx(b.value, rel=1e-12)  # linear: rounding
    np.testing.assert_allclose(a.mu, b.mu, rtol=1e-10)  # rounding of 40 steps
    pushed = sg.gradient(model, loss, force=np.ones((40, 2)))
    assert pushed.hand is None
    assert pushed.force is not None
    step = 1e-3  # J is of second order in the force: central differences are exact but for rounding
    ends = [sg.gradient(model, loss, force=np.ones((40, 2)) * (1 + s)).value for s in (step, -step)]
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(pushed.force.sum(), rel=1e-9)


def test_a_reduced_model_with_all_states_has_the_same_gradient() -> None:
    model = sg.build("paper_forward", ["tissue.cells=[2, 4]", "time.steps=40"])
    run = sg.simulate(model)

    def loss(x: Any) -> Any:
        return ((x - 0.9 * run.outputs) ** 2).sum() / 2, x - 0.9 * run.outputs

    rom = sg.reduce(model, run, "craig_bampton", N=model.states)
    small = sg.gradient(rom, loss, run.times[1], hand=(run.q_s, run.v_s))
    full = sg.gradient(model, loss)
    for key in ("lam", "mu", "rho"):
        np.testing.assert_allclose(getattr(full, key), getattr(small, key), rtol=1e-8, err_msg=key)  # two ways
    assert full.hand is not None
    assert small.hand is not None
    np.testing.assert_allclose(full.hand[1], small.hand[1], rtol=0, atol=1e-8 * np.abs(full.hand[1]).max())


def test_what_has_no_gradient_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sg.build("paper_forward", SMALL)

    def loss(x: Any) -> Any:
        return 0.0, np.zeros_like(x)

    with pytest.raises(SceneError, match=r"dJ/dy has the shape \(2,\)"):
        sg.gradient(model, lambda x: (0.0, np.zeros(2)))
    with pytest.raises(SceneError, match="either the force"):
        sg.gradient(model, loss, force=np.zeros((40, 2)), hand=(np.zeros((41, 2)),) * 2)
    with pytest.raises(SceneError, match=r"the hand has a table of the shape \(40, 2\); it must be \(41, 2\)"):
        sg.gradient(model, loss, hand=(np.zeros((40, 2)),) * 2)
    with pytest.raises(SceneError, match="2 materials; the model has 1"):
        sg.gradient(model, loss, materials=model.system.materials * 2)
    with pytest.raises(ModelError, match="leave out dt"):
        sg.gradient(model, loss, 0.1)  # type: ignore[call-overload]
    finite = sg.build("paper_forward", [*SMALL, "effects.finite_strain={}"])
    with pytest.raises(SceneError, match="needs linear elasticity"):
        sg.gradient(finite, loss)
    turning = ["effects.rotation=true", "hand.inertia=1.0", "motion.target=[1, 0, 0.1]", "effects.frame='hand'"]
    with pytest.raises(SceneError, match=r"a gradient cannot go with effects\.frame = 'hand' yet"):
        sg.gradient(sg.build("paper_forward", [*SMALL, *turning]), loss)
    monkeypatch.setattr("softgrasp.fem.adjoint.forward.free_memory", lambda: 1)

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(ResourceError, match=r"has room for them \(No space left on device\); free the disk"):
        sg.gradient(model, loss)
