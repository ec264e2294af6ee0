"""What a run of the full model returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from softgrasp.fem.columns import Columns, labels
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.snapshots import Snapshots
from softgrasp.fem.solve.solvers import SolverUsed

if TYPE_CHECKING:
    from softgrasp.fem.strain.newton import NewtonFigures


@dataclass(frozen=True)
class Trajectory:
    """What a run returns.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> run = sg.simulate(model)
    >>> run.outputs.shape
    (61, 2)
    """

    times: Array  # time grid [s], shape (steps + 1,)
    q_s: Array  # displacement of the hand [m, rad], shape (steps + 1, n_s), on every rank
    v_s: Array  # its velocity [m/s, rad/s], alike
    outputs: Array  # y = C_s q_s + C_z' z [m, rad], shape (steps + 1, components), on every rank
    outputs_rigid: Array  # what they would be if the tissue moved rigidly with the hand, same shape
    columns: Columns  # one per output component
    snapshots: Snapshots | None  # stored states
    # mean force of the robot on the hand in each step, by the midpoint rule that at t_n + dt/2: applied, or what a
    # prescribed motion takes against inertia, tissue, gravity and drag [N, N m], shape (steps, n_s)
    force: Array
    final: Array  # [z; v_z] of this rank's nodes at the end [m; m/s], shape (2 n_local,)
    energy_drift: float  # |E_N - E_0 - work + dissipated| over the largest energy seen, dimensionless
    residuals: tuple[float, float]  # relative residual of the first and the last solve
    solver: SolverUsed  # name, reason and package
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage, "steps", "per_step", on the slowest rank
    steps_timed: int = 0  # steps taken since the run was started or resumed
    newton: NewtonFigures | None = None  # how the steps of finite strain converged; None where they are linear

    @property
    def output_names(self) -> tuple[str, ...]:
        """Labels of the columns."""
        return labels(self.columns)
