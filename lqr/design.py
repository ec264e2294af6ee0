"""The control problem of a scene: its outputs and weights on the built model."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.problem import RiccatiProblem


def weight(value: float | list[list[float]], size: int, key: str) -> Array:
    """A number as multiple of the identity, a matrix as it is. Not collective.

    Raises:
        SceneError: the matrix has the wrong size.
    """
    if isinstance(value, list):
        matrix = np.array(value, dtype=float)
        if matrix.shape != (size, size):
            raise SceneError(
                f"{key} is {matrix.shape[0]} x {matrix.shape[1]}; it must be {size} x {size} or one number"
            )
        return matrix
    return float(value) * np.eye(size)


def make_problem(model: Model) -> RiccatiProblem:
    """Outputs y = C_s q_s + C_z' z and weights Q, R of the scene's ``[control]`` table.

    Without that table: the free node farthest from the hand, Q = R = 1. Collective.

    Args:
        model: a built scene.

    Raises:
        SceneError: an output lies outside the body, or Q or R has the wrong size.
    """
    scene, system = model.scene, model.system
    outputs = make_outputs(scene, system)
    p = sum(output.size for output in outputs)
    C_z = np.zeros((system.layout.n_local, p), order="F")
    first = 0
    for output in outputs:
        for c in range(output.size):
            # every listed dof enters with the weight of the output; a dof is listed once
            C_z[output.dofs[:, c], first + c] = output.weight
        first += output.size
    control, columns = scene.control, tuple(column for output in outputs for column in output.columns)
    Q = weight(1.0 if control is None else control.Q, p, "control.Q")
    R = weight(1.0 if control is None else control.R, system.layout.n_s, "control.R")
    return RiccatiProblem(system, np.vstack([o.C_s for o in outputs]), C_z, Q, R, columns)
