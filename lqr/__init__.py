"""Linear-quadratic regulator: Lyapunov and Riccati solvers, feedback; imports reduction, never DOLFINx."""

from typing import TYPE_CHECKING

from softgrasp._face import face
from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py

if TYPE_CHECKING:
    from softgrasp.lqr.constrained.plan import Plan, quadratic_program
    from softgrasp.lqr.constrained.task import Task
    from softgrasp.lqr.dense.care import solve_reduced
    from softgrasp.lqr.design.constrained import PlannedControl, plan_control
    from softgrasp.lqr.design.controller import CertifiedController
    from softgrasp.lqr.design.duration import LoopPlan
    from softgrasp.lqr.design.feedback import Design, running_words
    from softgrasp.lqr.design.linearise import finite_problem, linearised
    from softgrasp.lqr.design.orders import BasisGains, Notify
    from softgrasp.lqr.design.scene import control_of, with_control
    from softgrasp.lqr.loop.controller import load_gain
    from softgrasp.lqr.loop.full import LoopOptions, LoopTrajectory
    from softgrasp.lqr.loop.margins import LoopMargins
    from softgrasp.lqr.plant.checks import ControlError
    from softgrasp.lqr.plant.gain import PlantState
    from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution, rigid_gains
    from softgrasp.lqr.plant.target import Target
    from softgrasp.lqr.reduced.bases import A_PRIORI, BASES
    from softgrasp.lqr.reduced.retune import RetunedGain
    from softgrasp.lqr.reduced.riccati import GainQuality
    from softgrasp.lqr.riccati import Method, solve
else:
    __getattr__, __dir__ = face(__name__)
