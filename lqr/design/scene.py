"""The control problem of a scene: outputs and weights, target, actuation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, checked_model
from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.scene.control import Control, ControlOutput
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.sampled import Sampling


def control_of(model: Model) -> Control:
    """The scene's ``[control]`` table; where it has none, the defaults of one without outputs."""
    return model.scene.control or Control.model_construct(outputs=[])


def weight(value: float | list[list[float]], size: int, key: str) -> Array:
    """A number as multiple of the identity, a matrix as it is. Raises SceneError: the matrix has the wrong size."""
    if isinstance(value, list):
        matrix = np.array(value, dtype=float)
        if matrix.shape != (size, size):
            raise SceneError(
                f"{key} is {matrix.shape[0]} x {matrix.shape[1]}; it must be {size} x {size} or one number"
            )
        return matrix
    return float(value) * np.eye(size)


def problem(model: Model) -> RiccatiProblem:
    """Outputs y = C_s q_s + C_z' z and weights Q, R of the scene's ``[control]`` table.

    Without that table: the free node farthest from the hand, Q = R = 1. Obstacles are no part of the plant. Collective.

    Raises:
        SceneError: an output lies outside the body, or Q or R has the wrong size.

    >>> import softgrasp as sg
    >>> problem = sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    >>> problem.names
    ('tip_x', 'tip_y')
    """
    model = checked_model(model)
    model.scene.refuse_frame("control")
    scene, system = model.scene, model.system
    outputs = make_outputs(scene, system)
    C_z = output_columns(outputs, system.layout.n_local)
    control, columns = control_of(model), tuple(column for output in outputs for column in output.columns)
    Q = weight(control.Q, C_z.shape[1], "control.Q")
    R = weight(control.R, system.layout.n_s, "control.R")
    return RiccatiProblem(system, np.vstack([o.C_s for o in outputs]), C_z, Q, R, columns)


def scene_target(model: Model) -> Array:
    """Target of the closed loop: motion.target, or the end of the table.

    Raises SceneError: the scene names no target, or it is the start.
    """
    scene, n_s = model.scene, model.system.layout.n_s
    target = scene.motion.target
    if target is None and scene.motion.profile == "csv" and scene.motion.drive == "motion":
        target = motion_table(scene, n_s).q[-1].tolist()
    if target is None:
        raise SceneError("motion.target is missing; `softgrasp control` moves the hand there, so give its displacement")
    if not np.any(target):
        raise SceneError(f"motion.target is {target}, where the hand starts; give another place to go to")
    return np.asarray(target, dtype=np.float64)


def actuation(model: Model) -> Actuation:
    """How the feedback of the scene reaches the hand; checked against the time step.

    Raises ControlError: rate, delay or limit do not fit.
    """
    scene, loop, layout = model.scene, control_of(model).loop, model.system.layout
    turns = layout.n_s - layout.dimension
    if loop.limit_torque is not None and turns == 0:
        raise ControlError(
            "control.loop.limit_torque limits a hand that does not turn; set effects.rotation = true, or leave it out"
        )
    limits = None
    if loop.limit is not None or loop.limit_torque is not None:
        limits = _per_axis("limit", loop.limit, layout.dimension) + _per_axis("limit_torque", loop.limit_torque, turns)
    law = Actuation(loop.rate if loop.sampling == "held" else None, int(loop.delay), limits)
    law.ticks(scene.time_end / scene.time.steps)
    return law


def _per_axis(key: str, limit: float | list[float] | None, axes: int) -> tuple[float, ...]:
    if isinstance(limit, list) and len(limit) != axes:
        raise ControlError(f"control.loop.{key} has {len(limit)} numbers; give one, or {axes}, one per axis")
    return tuple(limit) if isinstance(limit, list) else (limit or np.inf,) * axes


def sampling(model: Model) -> Sampling:
    """The instants of the scene's loop. Raises ControlError: the tick is no multiple of the time step."""
    return Sampling.of(actuation(model), model.scene.time_end / model.scene.time.steps)


def with_control(model: Model) -> tuple[Model, str]:
    """A scene without a [control] table gets tip output and Q = R = 1, and a turning hand is seen too. Collective.

    Returns the model, and a sentence about it; empty when the scene has its own table.
    """
    if model.scene.control is not None:
        return model, ""
    tip = make_outputs(model.scene, model.system)[0]
    outputs = [ControlOutput(kind="node", point=list(tip.point), name=tip.name)]
    what = f"the node at ({', '.join(f'{x:.4g}' for x in tip.point)}), the farthest from the hand,"
    if model.system.layout.n_s > model.system.layout.dimension:  # one node does not see all rotations
        outputs.append(ControlOutput(kind="hand", point=None, name="hand"))
        what += " and the hand itself"
    control = Control(outputs=outputs)
    note = f"the scene has no [control] table: {what} as output, Q = R = 1"
    return replace(model, scene=model.scene.model_copy(update={"control": control})), note


def given_force(model: Model, n_s: int) -> Array | None:
    """Largest force on the hand of the scene, one number per axis. Raises ControlError: their number does not fit."""
    given = control_of(model).constraints
    assert given is not None
    if given.force is None and given.margin == "bound":
        raise ControlError(
            "control.constraints.force is missing; the bound of the reduced plant needs it, or give "
            "control.constraints.margin in metres"
        )
    force = None if given.force is None else np.atleast_1d(np.asarray(given.force, dtype=np.float64))
    if force is not None and len(force) not in (1, n_s):
        raise ControlError(f"control.constraints.force has {len(force)} numbers; give one, or {n_s}, one per axis")
    return None if force is None else np.broadcast_to(force, (n_s,)).copy()
