"""Reduced plant and gain for other packages: python-control and pyMOR."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.small_plant import SmallPlant
from softgrasp.lqr.plant.checks import ControlError


@dataclass(frozen=True)
class Exported:
    """One plant in another package's objects, all in deviations from the target.

    Attributes:
        plant: x' = A x + B u, y = C x (pyMOR: with E).
        gain: K of u = K x; python-control's own functions write u = -K x, so pass them -K.
        closed_loop: the plant under u = K x + r, r an extra load on the hand.
    """

    plant: Any
    gain: Array
    closed_loop: Any


def state_names(plant: SmallPlant) -> list[str]:
    """q_1.., v_1.., eta_1.., rate_1.. of a plant whose hand comes first; x_1.. of any other."""
    n_s, N = plant.B.shape[1], plant.N
    k = (N - 2 * n_s) // 2
    one = np.eye(N)
    if not (np.array_equal(plant.S_q, one[:n_s]) and np.array_equal(plant.S_v, one[n_s : 2 * n_s])):
        return [f"x_{i + 1}" for i in range(N)]
    blocks = (("q", n_s), ("v", n_s), ("eta", k), ("rate", k))
    return [f"{name}_{i + 1}" for name, count in blocks for i in range(count)]


def to_python_control(plant: SmallPlant, K: Array) -> Exported:
    """The plant as ``control.StateSpace`` with named inputs, states and outputs.

    Raises:
        ControlError: python-control is not installed, or K does not fit.
    """
    _check(plant, K)
    try:
        control: Any = import_module("control")  # by name: optional, and without type hints
    except ImportError as error:
        raise ControlError("python-control is not installed; `pip install control` brings it") from error
    solved = np.linalg.solve(plant.E, np.hstack([plant.A, plant.B]))
    A, B = solved[:, : plant.N], solved[:, plant.N :]
    D = np.zeros((len(plant.C), B.shape[1]))
    names = {
        "states": state_names(plant),
        "inputs": [f"u_{i + 1}" for i in range(B.shape[1])],
        "outputs": [name.replace(".", "_") for name in output_names(plant)],  # their names hold no dots
    }
    # without removing states: python-control may drop those it thinks uncontrollable
    options = {"remove_useless_states": False, **names}
    return Exported(
        control.ss(A, B, plant.C, D, name="plant", **options),
        np.array(K),
        control.ss(A + B @ K, B, plant.C, D, name="closed_loop", **options),
    )


def to_pymor(plant: SmallPlant, K: Array) -> Exported:
    """The plant as ``pymor.models.iosys.LTIModel`` E x' = A x + B u.

    For programs of one rank: save the controller and load it there.

    Raises:
        ControlError: pyMOR is not installed, K does not fit, or the program runs on several ranks.
    """
    _check(plant, K)
    if MPI.COMM_WORLD.size > 1:  # importing pyMOR would put all ranks but the first into an event loop of its own
        raise ControlError(
            f"to_pymor was called on {MPI.COMM_WORLD.size} ranks; save the controller and export it on one"
        )
    try:
        from pymor.models.iosys import LTIModel
    except ImportError as error:
        raise ControlError("pyMOR is not installed; `pip install pymor` brings it") from error
    return Exported(
        LTIModel.from_matrices(plant.A, plant.B, plant.C, E=plant.E, name="plant"),
        np.array(K),
        LTIModel.from_matrices(plant.A + plant.B @ K, plant.B, plant.C, E=plant.E, name="closed_loop"),
    )


def output_names(plant: SmallPlant) -> list[str]:
    """Names of the outputs, y_1.. where the plant has none."""
    return list(plant.names) if len(plant.names) == len(plant.C) else [f"y_{i + 1}" for i in range(len(plant.C))]


def _check(plant: SmallPlant, K: Array) -> None:
    shape = (plant.B.shape[1], plant.N)
    if K.shape != shape or not np.isfinite(K).all():
        raise ControlError(f"the gain has the shape {K.shape}; this plant needs finite numbers of shape {shape}")
