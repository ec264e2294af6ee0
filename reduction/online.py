"""Running small models: for given forces or a prescribed hand, one step a call, or many runs at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from softgrasp.fem.columns import label_unit
from softgrasp.fem.labelled import Labelled, Quantity, of_energy, of_hand
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import march_together
from softgrasp.fem.shown import Card, Shown, amount, counted, drawn, listed
from softgrasp.reduction.propagator import Propagator, propagator
from softgrasp.reduction.system import EnergySystem, ModelError, UnstableModelError

# byte of the matrices of a batch up to which all models step together; somewhere between 4 and 11 MB they leave the
# cache, and one model after the other is faster (docs/benchmarks.md)
TOGETHER = 5_000_000


@dataclass(frozen=True, repr=False)
class ReducedTrajectory(Shown, Labelled):
    """What a reduced run returns."""

    times: Array
    """Instants [s], (steps + 1,)."""
    x: Array
    """Reduced state at every instant, (steps + 1, N)."""
    q_s: Array
    """Displacement of the hand [m, rad], (steps + 1, n_s)."""
    v_s: Array
    """Velocity of the hand [m/s, rad/s], (steps + 1, n_s)."""
    outputs: Array
    """Outputs y [m, rad], (steps + 1, p)."""
    output_names: tuple[str, ...]
    """Name of every output, (p,)."""
    system: EnergySystem | Callable[[], EnergySystem] | None = field(default=None, repr=False, kw_only=True)
    """System of the run, or what makes it, for the energy; None where the run's own class has that."""

    @cached_property
    def energy(self) -> Array | None:
        """Energy of the tissue at each time [J], (steps + 1,), computed at the first use; None without a system."""
        if self.system is None:
            return None
        system = self.system if isinstance(self.system, EnergySystem) else self.system()
        return system.energy(self.x)

    def card(self) -> Card:
        """Steps, dimension and outputs."""
        rows = (
            ("time", f"{counted(len(self.times) - 1, 'step')} to {amount(self.times[-1], 's')}"),
            ("dimension", f"N = {self.x.shape[1]}"),
            ("outputs", listed(self.output_names)),
        )
        return Card("Trajectory of a reduced model", rows)

    def plot(self) -> Any:
        """Hand and outputs over time, as ``matplotlib`` figure."""
        return drawn("reduced", self)

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Outputs, hand and energy over time with their labels and units."""
        units = tuple(label_unit(name) for name in self.output_names)
        return {
            "outputs": Quantity(self.outputs, self.output_names, units, "output"),
            "q_s": of_hand(self.q_s, self.output_names),
            "v_s": of_hand(self.v_s, self.output_names, rate="/s"),
            **({} if self.energy is None else {"energy": of_energy(self.energy)}),
        }


def _check_stable(step: Propagator, allow_unstable: bool) -> None:
    if not (allow_unstable or step.stable):
        model = step.model
        raise UnstableModelError(
            f"{model.name} with N = {model.N} is unstable (spectral abscissa {model.spectral_abscissa:.2e} 1/s); "
            "choose another N or a structure-preserving basis, or run with allow_unstable"
        )


def run(
    model: EnergySystem | Propagator,
    dt: float | None = None,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    x0: Array | None = None,
    allow_unstable: bool = False,
) -> ReducedTrajectory:
    """Midpoint steps E (x_1 - x_0) / dt = A (x_0 + x_1) / 2 + B u + f of a small model. Online; not collective.

    They equal the full model's steps [HLW06], so that structure and errors carry over; many steps are one product.

    Args:
        model: small model, or a propagator made beforehand.
        dt: step [s]; needed without a propagator made beforehand.
        force: u on the hand at the step midpoints, (steps, n_s) [N, N m].
        hand: q_s and v_s of a prescribed hand, (steps + 1, n_s) each, instead of a force.
        x0: initial state (N,); None is zero. With a prescribed hand its first 2 n_s entries are replaced.
        allow_unstable: run a model with growing modes all the same.

    Raises:
        UnstableModelError: the model is unstable and ``allow_unstable`` is not set.
        ModelError: neither or both of force and hand are given, or shapes do not fit.
    """
    if (force is None) == (hand is None):
        raise ModelError("give either the force on the hand or the motion of the hand")
    step = prepared(model, dt, hand is not None)
    _check_stable(step, allow_unstable)
    model = step.model
    inputs = np.asarray(force, dtype=float) if hand is None else hand_inputs(model, hand, step.dt)
    if hand is None and (inputs.ndim != 2 or inputs.shape[1] != model.n_s or len(inputs) < 1):
        raise ModelError(f"the force has the shape {inputs.shape}; it must be (steps, {model.n_s})")
    start = np.zeros(model.N) if x0 is None else np.asarray(x0, dtype=float)
    w = step.march(inputs, step.at.X_inverse @ start[model.N - step.size :])
    return trajectory(step, w, hand)


def prepared(model: EnergySystem | Propagator, dt: float | None, driven: bool) -> Propagator:
    """A propagator for the kind of input; checks one that was made beforehand."""
    if isinstance(model, EnergySystem):
        if dt is None:
            raise ModelError("give the time step dt [s]")
        return propagator(model, dt, driven)
    if model.driven != driven or (dt is not None and dt != model.dt):
        raise ModelError("the propagator was made for another time step or another kind of input")
    return model


def consistent(q: Array, v: Array, dt: float) -> Array:
    """Positions that the midpoint rule reaches with the velocities v: q_0 + dt sum (v_n + v_{n+1}) / 2.

    A table of an analytic motion differs from them by O(dt^2); the tissue feels velocities and accelerations.
    """
    return np.vstack([q[:1], q[0] + dt * np.cumsum((v[1:] + v[:-1]) / 2, axis=0)])


def checked_hand(hand: tuple[Array, Array], n_s: int) -> tuple[Array, Array]:
    """Tables q_s and v_s of a prescribed hand. Raises ModelError: their shapes are not (steps + 1, n_s)."""
    q, v = (np.asarray(table, dtype=float) for table in hand)
    if q.shape != v.shape or q.ndim != 2 or q.shape[1] != n_s or len(q) < 2:
        raise ModelError(f"the hand's tables have the shapes {q.shape} and {v.shape}; both must be (steps + 1, {n_s})")
    return q, v


def hand_inputs(model: EnergySystem, hand: tuple[Array, Array], dt: float) -> Array:
    """Mean position, velocity and acceleration of each step from tables (steps + 1, n_s); (steps, 3 n_s)."""
    q, v = checked_hand(hand, model.n_s)
    q = consistent(q, v, dt)
    return np.hstack([(q[1:] + q[:-1]) / 2, (v[1:] + v[:-1]) / 2, np.diff(v, axis=0) / dt])


def trajectory(step: Propagator, w: Array, hand: tuple[Array, Array] | None) -> ReducedTrajectory:
    """Bundle states w (steps + 1, k) with the hand, prescribed or of the states, and the outputs."""
    model, x = step.model, w @ step.at.X.T
    if hand is None:
        q, v = x @ model.S_q.T, x @ model.S_v.T
        y = x @ model.C.T
    else:
        q, v = hand
        x = np.hstack([consistent(q, v, step.dt), v, x])
        y = x @ model.C.T + (q - x[:, : model.n_s]) @ model.C_s.T
    return ReducedTrajectory(step.dt * np.arange(float(len(x))), x, q, v, y, model.names, system=model)


class Stepper:
    """One midpoint step a call, for a control loop: u (n_s,) [N, N m] goes in, y (p,) [m] comes out.

    One product with a prefactored matrix of (N + p) x (N + n_s + 1) a step; nothing is allocated.

    Arguments as for :func:`run`. Raises UnstableModelError: the model is unstable and ``allow_unstable`` is not set.
    """

    def __init__(
        self,
        model: EnergySystem | Propagator,
        dt: float | None = None,
        x0: Array | None = None,
        allow_unstable: bool = False,
    ) -> None:
        self.step = prepared(model, dt, False)
        _check_stable(self.step, allow_unstable)
        model = self.step.model
        k, C = self.step.size, model.C
        # new state, and outputs of the new state, in one product
        self._matrix = np.ascontiguousarray(np.vstack([self.step.matrix, C @ self.step.at.X @ self.step.matrix]))
        self._row = np.zeros(self._matrix.shape[1])
        self._row[-1] = 1.0
        self._new = np.zeros(len(self._matrix))
        self._w, self._u = self._row[:k], self._row[k:-1]
        self._w_new, self.outputs = self._new[:k], self._new[k:]
        self._dot = np.dot
        if x0 is not None:
            self._w[:] = self.step.at.X_inverse @ x0
        self.outputs[:] = C @ (self.step.at.X @ self._w)

    def __call__(self, u: Array) -> Array:
        """Advance by dt under the force u (n_s,); returns the outputs, overwritten by the next call."""
        self._u[:] = u
        self._dot(self._matrix, self._row, self._new)
        self._w[:] = self._w_new
        return self.outputs

    @property
    def state(self) -> Array:
        """Reduced state x now, (N,)."""
        return np.asarray(self.step.at.X @ self._w)


def run_batch(
    models: Sequence[EnergySystem | Propagator],
    dt: float,
    forces: Array | None = None,
    allow_unstable: bool = False,
    hands: tuple[Array, Array] | None = None,
) -> list[ReducedTrajectory]:
    """Many parameters or many inputs at once, from rest: one product for the whole batch at a time.

    Conservative models of many parameters go mode by mode, one after the other, since each has angles of its own.

    Args:
        models: one for all runs, or one for each; all of one dimension.
        dt: step [s].
        forces: (runs, steps, n_s), or (steps, n_s) for all runs [N, N m].
        allow_unstable: run models with growing modes all the same.
        hands: q_s and v_s of prescribed hands instead, (runs, steps + 1, n_s) or (steps + 1, n_s) for all runs.

    Raises:
        UnstableModelError: a model is unstable and ``allow_unstable`` is not set.
        ModelError: the batch does not fit together, or neither or both of forces and hands are given.
    """
    if (forces is None) == (hands is None):
        raise ModelError("give either the forces on the hand or the motions of the hand")
    steps = [prepared(m, dt, hands is not None) for m in models]
    tables = [np.asarray(forces, dtype=float)] if hands is None else [np.asarray(table, dtype=float) for table in hands]
    tables = [np.broadcast_to(t, (len(steps), *t.shape)) if t.ndim == 2 else t for t in tables]
    n_s = steps[0].model.n_s if steps else 0
    sizes, shape = {s.size for s in steps}, tables[0].shape
    if (
        len(sizes) != 1 or len(shape) != 3 or shape[2] != n_s or len(steps) not in (1, shape[0])
        or any(t.shape != shape for t in tables)
    ):  # fmt: skip
        what = "forces" if hands is None else "hands"
        raise ModelError(
            f"{len(steps)} models of the dimensions {sorted(sizes)} do not fit {what} of the shape "
            f"{' and '.join(str(t.shape) for t in tables)}; give one model or one for each run, all with one N"
        )
    for s in steps:
        _check_stable(s, allow_unstable)
    own = [None if hands is None else (tables[0][i], tables[1][i]) for i in range(shape[0])]
    u = tables[0] if hands is None else np.stack([hand_inputs(steps[0].model, h, dt) for h in own if h is not None])
    many = len(steps) > 1
    rest, alone = np.zeros(steps[0].size), all(s.modal is not None for s in steps)
    if many and (alone or sum(s.block.nbytes for s in steps) > TOGETHER):
        states: Iterable[Array] = (s.march(inputs, rest) for s, inputs in zip(steps, u, strict=True))
    else:
        states = march_together(steps, u, rest)
    return [trajectory(steps[i if many else 0], w, own[i]) for i, w in enumerate(states)]
