"""Where the closed loop goes: a state at rest, and the steady input that keeps the plant there.

At rest, with the hand at q_bar, the equations of motion leave

    K_ee z_bar = G g,    u_bar = -(weight of the hand) [- M_rigid g],    y_bar = C_s q_bar + C_z' z_bar

([...] two-way only); without gravity the target is a rigid translation, z_bar = 0, u_bar = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.shown import Shown
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem


@dataclass(frozen=True, repr=False)
class Target(Shown):
    """State, input and outputs at rest."""

    state: PlantState  # state x_bar at rest
    u: Array  # steady input u_bar [N, N m], (n_s,)
    y: Array  # outputs at rest [m, rad], (p,)


def steady_input(system: BlockSystem) -> Array:
    """u_bar that balances the weight of the hand (and, two-way, of the tissue) [N, N m], (n_s,)."""
    u = np.zeros(system.layout.n_s)
    if system.hand_weight:
        u -= system.M_hand @ system.fall
    if system.two_way:
        u -= system.M_rigid @ system.fall + system.own_wrench
    return u


def rest(system: BlockSystem, *, deformed: bool = True) -> PlantState:
    """The plant at rest with the hand at 0, in equilibrium or undeformed. Collective."""
    n_s, n = system.layout.n_s, system.layout.n_local
    return PlantState(np.zeros(n_s), np.zeros(n_s), equilibrium(system) if deformed else np.zeros(n), np.zeros(n))


def hand_target(problem: RiccatiProblem, q_bar: Array) -> Target:
    """Rest with the hand at q_bar. Collective.

    ``q_bar``: displacement of the hand [m], (d,), which moves it without turning, or with angles [rad], (n_s,).

    Raises:
        ControlError: q_bar has another number of entries, or one that is not finite.
        SolverError: the equilibrium under gravity fails.
    """
    layout = problem.layout
    given = np.asarray(q_bar, dtype=np.float64).ravel()
    if len(given) not in (layout.dimension, layout.n_s) or not np.isfinite(given).all():
        counts = " or ".join(dict.fromkeys((str(layout.dimension), str(layout.n_s))))
        raise ControlError(f"the target {given.tolist()} of the hand must have {counts} finite entries")
    q = np.zeros(layout.n_s)
    q[: len(given)] = given
    return _at(problem, q, equilibrium(problem.system))


def _at(problem: RiccatiProblem, q: Array, z: Array) -> Target:
    n_s, n = problem.layout.n_s, problem.layout.n_local
    state = PlantState(q, np.zeros(n_s), z, np.zeros(n))
    y = problem.C_s @ q + total(problem.layout.comm, problem.C_z.T @ z)
    return Target(state, steady_input(problem.system), y)
