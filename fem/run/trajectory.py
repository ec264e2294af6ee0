"""What a run of the full model returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from softgrasp.fem.columns import Columns, labels
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.snapshots import Snapshots

if TYPE_CHECKING:
    from softgrasp.fem.strain.newton import NewtonFigures


@dataclass(frozen=True)
class Trajectory:
    """What a run returns.

    Attributes:
        times: time grid [s], shape (steps + 1,).
        q_s, v_s: displacement and velocity of the hand [m, rad; m/s, rad/s], shape (steps + 1, n_s), on every rank.
        outputs: y = C_s q_s + C_z' z [m, rad], shape (steps + 1, components), on every rank.
        outputs_rigid: what the outputs would be if the tissue moved rigidly with the hand, same shape.
        columns: one per output component.
        snapshots: stored states, or None.
        final: [z; v_z] of this rank's nodes at the end [m; m/s], shape (2 n_local,).
        energy_drift: |E_N - E_0 - work + dissipated| over the largest energy seen, dimensionless.
        residuals: relative residual of the first and the last solve.
        solver: name and reason.
        seconds: wall time of each stage, "steps" and "per_step" on the slowest rank [s].
        steps_timed: steps taken since the run was started or resumed.
        force: mean force on the hand in each step without its weight [N, N m], shape (steps, n_s): applied, or with
            two-way coupling what a prescribed motion takes; None when one-way coupling leaves it unknown.
        newton: how the steps of finite strain converged; None where they are linear.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> run = sg.simulate(model)
    >>> run.outputs.shape
    (61, 2)
    """

    times: Array
    q_s: Array
    v_s: Array
    outputs: Array
    outputs_rigid: Array
    columns: Columns
    snapshots: Snapshots | None
    final: Array
    energy_drift: float
    residuals: tuple[float, float]
    solver: tuple[str, str]
    seconds: dict[str, float] = field(default_factory=dict)
    steps_timed: int = 0
    force: Array | None = None
    newton: NewtonFigures | None = None

    @property
    def output_names(self) -> tuple[str, ...]:
        """Labels of the columns."""
        return labels(self.columns)
