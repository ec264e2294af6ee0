"""Results of runs of the full model: what all have in common, and that of a forward run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softgrasp.fem.columns import Columns, labels
from softgrasp.fem.labelled import Labelled, Quantity, of_columns, of_energy, of_hand
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.shown import Card, Shown, amount, counted, drawn, listed
from softgrasp.fem.solve.solvers import SolverUsed

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.run.contact.record import ContactRecord
    from softgrasp.fem.strain.newton import NewtonFigures


class FullOrderRun(Labelled):
    """A run of the full model, forward or in a closed loop, whose outputs have columns."""

    LOAD: ClassVar[str]
    """Name of the field with the force on the hand in each step."""
    outputs: Array
    """Outputs, (steps + 1, p) [m, rad]."""
    outputs_rigid: Array
    """Outputs of tissue that moves rigidly with the hand, (steps + 1, p) [m, rad]."""
    columns: Columns
    """Name, axis and unit of each output component, p."""
    q_s: Array
    """Displacement of the hand, (steps + 1, n_s) [m, rad]."""
    v_s: Array
    """Velocity of the hand, (steps + 1, n_s) [m/s, rad/s]."""
    energy: Array
    """Energy of the deformation, (steps + 1,) [J]."""
    dissipated: Array
    """Energy dissipated by damping, (steps + 1,) [J]."""

    @property
    def output_names(self) -> tuple[str, ...]:
        """Labels of the columns."""
        return labels(self.columns)

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Outputs, hand, its force and energies over time with their labels and units."""
        names = self.output_names
        return {
            "outputs": of_columns(self.outputs, self.columns, "output"),
            "outputs_rigid": of_columns(self.outputs_rigid, self.columns, "output"),
            "q_s": of_hand(self.q_s, names),
            "v_s": of_hand(self.v_s, names, rate="/s"),
            self.LOAD: of_hand(getattr(self, self.LOAD), names, load=True),
            "energy": of_energy(self.energy),
            "dissipated": of_energy(self.dissipated),
        }

    def animate(self, model: Model) -> Any:
        """The move on the mesh of its model, as an animated picture with ``save``. Collective.

        Rank 0 has the picture. Raises SoftgraspError: the run kept no snapshots.
        """
        return drawn("animation", self, model)

    def plot_contact(self) -> Any:
        """Force, least gap and touching nodes of each obstacle over time, as ``matplotlib`` figure.

        Raises SoftgraspError: the scene has no obstacles.
        """
        return drawn("contact", self)

    def view3d(self, model: Model) -> Any:
        """The move on the mesh of its model to turn, zoom and play in a notebook, with ``save`` as a page. Collective.

        Rank 0 has the page. Obstacles are not drawn. Raises SoftgraspError: the run kept no snapshots.
        """
        return drawn("view3d", self, model)


@dataclass(frozen=True, repr=False)
class Trajectory(Shown, FullOrderRun):
    """Motion, outputs, force and figures of a run of the full model.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> run = sg.simulate(model)
    >>> run.outputs.shape
    (61, 2)
    """

    LOAD: ClassVar[str] = "force"
    """Field of the force on the hand."""
    times: Array
    """Time grid, on every rank, (steps + 1,) [s]."""
    q_s: Array
    """Displacement of the hand, on every rank, (steps + 1, n_s) [m, rad]."""
    v_s: Array
    """Velocity of the hand, on every rank, (steps + 1, n_s) [m/s, rad/s]."""
    outputs: Array
    """Outputs y = C_s q_s + C_z' z, on every rank, (steps + 1, components) [m, rad]."""
    outputs_rigid: Array
    """Outputs of tissue that moves rigidly with the hand, on every rank, (steps + 1, components) [m, rad]."""
    columns: Columns
    """Name, axis and unit of each output component, (components,)."""
    snapshots: Snapshots | None
    """Stored states [z; v_z] of this rank's nodes; None where they are not in memory."""
    force: Array
    """Mean force of the robot on the hand in each step, on every rank, (steps, n_s) [N, N m].

    By the midpoint rule it is the force at t_n + dt/2: the one applied, or the one that a prescribed motion requires
    against inertia, tissue, gravity and drag.
    """
    energy: Array
    """Energy of the tissue relative to the hand at each time, on every rank, (steps + 1,) [J].

    (z'K z + v_z'M v_z) / 2, at finite strain W(z) + v_z'M v_z / 2: that at the start plus the work of all loads since,
    less what damping took. It is that of the states to ``energy_drift``; a step without damping and contact does
    nothing for it.
    """
    dissipated: Array
    """Energy dissipated by damping up to each time, on every rank, (steps + 1,) [J]."""
    final: Array
    """State [z; v_z] of this rank's nodes at the end, (2 n_local,) [m; m/s]."""
    energy_drift: float
    """|E_N - E_0 - work + dissipated| over the largest energy, E from the momentum of linear steps [1]."""
    residuals: tuple[float, float]
    """Relative residuals of the first and of the last solve [1]."""
    solver: SolverUsed
    """Name of the linear solver, reason of its choice, and package."""
    solve_error: float = 0.0
    """Estimated error of z by solves that end early, energy norm, over the largest z [1]; 0 with a factor."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each stage, of all "steps" and "per_step", on the slowest rank [s]."""
    steps_timed: int = 0
    """Number of steps since the run was started or resumed [1]."""
    newton: NewtonFigures | None = None
    """Convergence of the steps at finite strain; None where they are linear."""
    contact: ContactRecord | None = None
    """What obstacles did; None without effects.obstacles."""

    def card(self) -> Card:
        """Steps, outputs, deformation, energy drift, solver."""
        kept = "none in memory" if self.snapshots is None else counted(len(self.snapshots.steps), "state")
        rows = (
            ("time", f"{counted(len(self.times) - 1, 'step')} to {amount(self.times[-1], 's')}, snapshots: {kept}"),
            ("outputs", listed(self.output_names)),
            ("deformation", f"at most {amount(np.abs(self.outputs - self.outputs_rigid).max(initial=0.0), 'm')}"),
            ("energy drift", amount(self.energy_drift)),
            ("solver", f"{self.solver.name} ({self.solver.package})"),
        )
        return Card("Trajectory of the full model", rows)

    @property
    def attributes(self) -> dict[str, Any]:
        """Energy drift and solver."""
        return {"energy_drift": self.energy_drift, "solver": self.solver.name}

    def plot(self) -> Any:
        """Hand and outputs over time, and what outputs move relative to the hand, as ``matplotlib`` figure."""
        return drawn("trajectory", self)
