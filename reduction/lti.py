"""A small model as a linear time-invariant system, and the objects that python-control and pyMOR make of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.columns import TURNS, hand_columns
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, listed
from softgrasp.reduction.bases.basis import ReductionError


@dataclass(frozen=True, repr=False)
class LTI(Shown):
    """E x' = A x + B u, y = C x: deviations from a state of rest, so that gravity drops out.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> system = sg.reduce(model, sg.simulate(model), "craig_bampton", N=12).lti()
    >>> system.inputs, system.at([1j]).shape
    (('force_x [N]', 'force_y [N]'), (1, 2, 2))
    """

    E: Array  # mass-like matrix, (N, N)
    A: Array  # system matrix, (N, N)
    B: Array  # input of the force and torque u on the hand, (N, n_s)
    C: Array  # outputs of the state, (p, N)
    states: tuple[str, ...]  # names of the states with their units, "q_x [m]"
    inputs: tuple[str, ...]  # names of the inputs with their units, "force_x [N]"
    outputs: tuple[str, ...]  # names of the outputs with their units, "tip_x [m]"

    def card(self) -> Card:
        """Dimension, inputs and outputs."""
        rows = (("states", str(len(self.E))), ("inputs", listed(self.inputs)), ("outputs", listed(self.outputs)))
        return Card("LTI E x' = A x + B u, y = C x", rows)

    def at(self, s: Sequence[complex] | np.ndarray) -> np.ndarray:
        """Transfer function C (s E - A)^{-1} B at points s [1/s], (len(s), p, n_s)."""
        points = np.asarray(s, dtype=complex).reshape(-1, 1, 1)
        return np.asarray(
            self.C @ np.linalg.solve(points * self.E - self.A, np.broadcast_to(self.B, (len(points), *self.B.shape)))
        )

    def under(self, K: Array) -> LTI:
        """The closed loop u = K x + r with the extra load r as input. python-control's own functions take -K.

        Raises:
            ReductionError: K (n_s, N) does not fit, or is not finite.
        """
        shape = self.B.T.shape
        if K.shape != shape or not np.isfinite(K).all():
            raise ReductionError(f"the gain has the shape {K.shape}; this plant needs finite numbers of shape {shape}")
        return replace(self, A=self.A + self.B @ K)

    def to_control(self) -> Any:
        """The system as ``control.StateSpace`` with named inputs, states and outputs.

        Raises:
            ReductionError: python-control is not installed.
        """
        try:
            control: Any = import_module("control")  # by name: optional, and without type hints
        except ImportError as error:
            raise ReductionError("python-control is not installed; `pip install control` brings it") from error
        A, B = np.split(np.linalg.solve(self.E, np.hstack([self.A, self.B])), [len(self.A)], axis=1)
        # python-control may drop states that it thinks uncontrollable, and its names hold no dots
        names = {
            key: [name.replace(".", "_") for name in getattr(self, key)] for key in ("states", "inputs", "outputs")
        }
        D = np.zeros((len(self.C), B.shape[1]))
        return control.ss(A, B, self.C, D, remove_useless_states=False, **names)

    def to_pymor(self) -> Any:
        """The system as ``pymor.models.iosys.LTIModel``, in programs of one rank.

        Raises:
            ReductionError: pyMOR is not installed, or the program runs on several ranks.
        """
        if MPI.COMM_WORLD.size > 1:  # importing pyMOR would put all ranks but the first into an event loop of its own
            raise ReductionError(
                f"to_pymor runs on one rank, not on {MPI.COMM_WORLD.size}; save the model and load it there"
            )
        try:
            from pymor.models.iosys import LTIModel
        except ImportError as error:
            raise ReductionError("pyMOR is not installed; `pip install pymor` brings it") from error
        return LTIModel.from_matrices(self.A, self.B, self.C, E=self.E)


def make_lti(E: Array, A: Array, B: Array, C: Array, labels: Sequence[str], hand_first: bool) -> LTI:
    """The system with names made from what its outputs are called.

    Args:
        labels: of the outputs, "tip_x"; y_1.. where their number does not fit.
        hand_first: the first 2 n_s states are q_s and v_s.
    """
    N, n_s = B.shape
    given = tuple(labels) if len(labels) == len(C) else tuple(f"y_{i + 1}" for i in range(len(C)))
    hand = hand_columns(n_s, 3 if n_s == 6 or any(name.endswith("_z") for name in given) else 2, "hand")
    outputs = tuple(f"{name} [{'rad' if name.rsplit('_', 1)[-1] in TURNS else 'm'}]" for name in given)
    inputs = tuple(f"{'torque' if c.rotation else 'force'}_{c.axis} [{c.load_unit}]" for c in hand)
    states = tuple(f"x_{i + 1}" for i in range(N))
    if hand_first:
        states = (
            tuple(f"q_{c.axis} [{c.unit}]" for c in hand)
            + tuple(f"v_{c.axis} [{c.unit}/s]" for c in hand)
            + states[2 * n_s :]
        )
    return LTI(E, A, B, C, states, inputs, outputs)
