"""J of the outputs of a full run and its derivatives, for two to three runs whatever their number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.adjoint.backward import Backward
from softgrasp.fem.adjoint.forward import KeptRun, checked_tables
from softgrasp.fem.adjoint.result import Loss, RunGradient
from softgrasp.fem.adjoint.sums import MaterialSums
from softgrasp.fem.errors import SceneError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import Model, Stopwatch, checked_model
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.run.states.trajectory import Trajectory


def full_gradient(
    model: Model,
    loss: Loss,
    *,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    materials: tuple[LayerMaterial, ...] | None = None,
) -> RunGradient[Trajectory]:
    """J and its derivatives by the adjoint of the midpoint rule, see :mod:`softgrasp.fem.adjoint.backward`. Collective.

    The step matrix K + s D + s^2 M is symmetric, so that the factor of the run serves the way back.

    Args:
        model: linear, without obstacles; its scene gives time steps and start. A start in equilibrium moves with the
            materials, which the derivatives contain.
        loss: J and dJ/dy of the outputs; called on rank 0.
        force: u on the hand at the step midpoints, (steps, n_s) [N, N m], in place of the scene's.
        hand: q_s and v_s of a prescribed hand, (steps + 1, n_s) each, in place of the scene's.
        materials: one a layer; None: those of the model.

    Raises:
        SceneError: effects.finite_strain or effects.obstacles is on, or tables or dJ/dy do not fit.
        ResourceError: the states fit neither in memory nor on the disk of temporary files.
        SolverError: a solve fails or misses its tolerance.
    """
    model = _checked(model, materials)
    hand, force = checked_tables(model, hand, force)
    driven = hand is not None or (force is None and model.scene.motion.drive == "motion")
    system, comm, outputs = model.system, model.system.layout.comm, model.outputs
    run = KeptRun(model, hand, force)
    try:
        answer = run.whole()
        value, r = on_root(comm, lambda: _value(loss, answer.outputs))
        C_s = np.vstack([o.C_s for o in outputs])
        back = Backward(run, model.output_columns, C_s, r, driven)
        sums = MaterialSums(system, back, model.scene.effects.damping is not None)
        for first, states, eta in back.blocks():
            sums.add(first, states, eta)
            start = states[: system.layout.n_local, 0].copy()  # at the end that of the run
        back.finish()
        Z, V = (back.operators.leave(x)[_own(back)] for x in (back.Z, back.V))
        if model.scene.time.start == "equilibrium" and system.gravity is not None:
            sums.add_equilibrium(start, Z)
        by_layer, alpha = sums.finish()
    finally:
        run.close()
    damped, n_s = model.scene.effects.damping is not None, system.layout.n_s
    by_hand = np.zeros(2 * n_s) if driven else np.concatenate([back.p, back.m])
    return RunGradient(
        run=answer, value=value, lam=by_layer["lam"], mu=by_layer["mu"], rho=by_layer["rho"],
        beta=by_layer["beta"] if damped else None, alpha=alpha if damped else None,
        start=np.concatenate([by_hand, Z, V]), force=None if driven else back.xi,
        hand=(r @ C_s, _velocities(back)) if driven else None,
    )  # fmt: skip


def _checked(model: Model, materials: tuple[LayerMaterial, ...] | None) -> Model:
    """The model at the materials. Raises SceneError: it has no adjoint, or an argument does not fit."""
    scene = checked_model(model).scene
    scene.refuse_contact("a gradient")
    scene.refuse_frame("a gradient")
    if any(m.part for m in model.system.materials):
        raise SceneError(
            f"scene '{scene.name}': a gradient is by lambda, mu, rho and beta, and cannot go with tissue.energy or own "
            "terms yet"
        )
    if scene.effects.finite_strain is not None:
        raise SceneError(
            f"scene '{scene.name}': a gradient needs linear elasticity, and effects.finite_strain is on; use --set "
            "effects.finite_strain=false"
        )
    if materials is None:
        return model
    if len(materials) != len(model.system.layers):
        raise SceneError(f"there are {len(materials)} materials; the model has {len(model.system.layers)} layers")
    system = model.system.with_materials(tuple(materials))
    return replace(model, system=system, watch=Stopwatch(system.layout.comm), accuracy=None)


def _value(loss: Loss, outputs: Array) -> tuple[float, Array]:
    """J and dJ/dy. Raises SceneError: their shapes do not fit."""
    value, r = loss(outputs.copy())
    r = np.asarray(r, dtype=float)
    if r.shape != outputs.shape:
        raise SceneError(f"dJ/dy has the shape {r.shape}; it must be {outputs.shape}, that of the outputs")
    return float(value), r


def _own(back: Backward) -> slice:
    """Rows of this rank in the order of the layout."""
    layout = back.system.layout
    return slice(layout.start, layout.start + layout.n_local) if back.operators.whole else slice(0, layout.n_local)


def _velocities(back: Backward) -> Array:
    """dJ/dv_s of a table; c_n = g - (v_{n+1} - v_n) / dt - alpha (v_{n+1} + v_n) / 2."""
    result = np.zeros((back.n + 1, back.pulls.shape[1]))
    result[:-1] += back.pulls * (1 / back.dt - back.alpha / 2)
    result[1:] -= back.pulls * (1 / back.dt + back.alpha / 2)
    return result
