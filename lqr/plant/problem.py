"""The linear-quadratic problem of a hand that carries tissue, hand-relative, its solution, and its exact identities."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from softgrasp.fem.columns import Columns, labels
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, rows_on_all
from softgrasp.fem.shown import Card, Shown, amount, listed
from softgrasp.fem.system import BlockSystem, whole_system
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain

SolverName = Literal["dense", "newton_adi", "radi", "galerkin", "modal_lqr"]


@dataclass(frozen=True, repr=False)
class RiccatiProblem(Shown):
    """A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 with x = [q_s, v_s, z, v_z], z = q_e - T q_s.

    In these coordinates (one-way; [...] two-way only)

        E = [I 0 0 0; 0 M_s 0 [G']; 0 0 I 0; 0 G 0 M_ee],  B = [0; I; 0; 0],  M_s = M_hand [+ M_rigid],
        A = [0 I 0 0; 0 [-D_ss] 0 [-D_es']; 0 0 0 I; 0 -D_es -K_ee -D_ee],
        D_es = alpha G, [D_ss = alpha M_rigid] when the damping acts in space, else 0.

    A second-order system without a hand, M_ee z'' + D_ee z' + K_ee z = B_z u, is the case n_s = 0, B = [0; B_z]; see
    :func:`softgrasp.lqr.plant.second_order.second_order`.
    """

    system: BlockSystem
    """Sparse operators of hand and tissue."""
    C_s: Array
    """Outputs of the hand's displacement, on every rank, (p, n_s)."""
    C_z: Array
    """Outputs of the relative displacement, transposed, local rows (n_local, p)."""
    Q: Array
    """Weight of the outputs, symmetric positive semidefinite [1/(m2 s)], (p, p)."""
    R: Array
    """Weight of the inputs, symmetric positive definite [1/(N2 s)], (m, m), m = n_s."""
    columns: Columns = ()
    """Label and unit of each output, (p,), or none."""
    B_z: Array | None = None
    """Forces of the inputs on the tissue, local rows (n_local, m), when there is no hand; else None."""

    def card(self) -> Card:
        """Size, inputs, outputs and weights."""
        rows = (
            ("states", str(self.layout.states)),
            ("inputs", str(self.inputs)),
            ("outputs", listed(self.names)),
            ("weights", f"Q up to {amount(np.abs(self.Q).max())}, R up to {amount(np.abs(self.R).max())}"),
        )
        return Card("RiccatiProblem A'XE + E'XA - E'XB R^-1 B'XE + C'QC = 0", rows)

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of the outputs; y1, y2.. where they have none."""
        return labels(self.columns) or tuple(f"y{i + 1}" for i in range(len(self.Q)))

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.layout.n_s if self.B_z is None else int(self.B_z.shape[1])

    @property
    def layout(self) -> BlockLayout:
        """Sizes and ownership."""
        return self.system.layout

    @property
    def M_s(self) -> Array:
        """Inertia that the input has to move, (n_s, n_s)."""
        return self.system.M_hand + (self.system.M_rigid if self.system.two_way else 0.0)


def whole_problem(problem: RiccatiProblem) -> RiccatiProblem:
    """The same problem with all rows on every rank, for what ranks do by themselves. Collective."""
    comm, system = problem.layout.comm, whole_system(problem.system)
    B_z = None if problem.B_z is None else rows_on_all(comm, problem.B_z)
    return replace(problem, system=system, C_z=rows_on_all(comm, problem.C_z), B_z=B_z)


@dataclass(frozen=True, repr=False)
class RiccatiSolution(Shown):
    """X ~ Z Z' and the feedback u = K x, in the hand-relative coordinates of :class:`RiccatiProblem`."""

    factor: Block
    """Factor Z, hand (2 n_s, rank), local rows (2 n_local, rank)."""
    gain: Gain
    """Optimal gain K = -R^{-1} B'XE."""
    residual: float
    """True relative residual ||Res||_2 / ||C'QC||_2, recomputed from Z."""
    method: SolverName
    """Name of the solver."""
    about: str = ""
    """Order and steps of the solver, in words."""
    reason: str = ""
    """Why this solver was chosen; empty when the caller made it."""
    history: tuple[dict[str, float], ...] = ()
    """Residual or change of each iteration, one dictionary per iteration."""
    counts: dict[str, int] = field(default_factory=dict)
    """Numbers of "newton_steps", "adi_steps" and tissue "solves"."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by stage [s]."""

    def card(self) -> Card:
        """Solver, rank and residual."""
        rows = (("solver", self.method), ("rank", str(self.rank)), ("residual", amount(self.residual)))
        return Card("RiccatiSolution X = Z Z'", rows)

    @property
    def rank(self) -> int:
        """Columns of Z."""
        return self.factor.columns

    @property
    def summary(self) -> str:
        """Method, what it did and why it was chosen, in one line."""
        about = f": {self.about}" if self.about else ""
        return f"{self.method}{about}" + (f" (chosen: {self.reason})" if self.reason else "")


def rigid_gains(problem: RiccatiProblem, solution: RiccatiSolution) -> tuple[Array, Array]:
    """Gain u for the whole body displaced by unit translations [N/m], and moving so [N s/m], (n_s, d) each."""
    n_s, d, K = problem.layout.n_s, problem.layout.dimension, solution.gain.K_s
    return K[:, :d], K[:, n_s : n_s + d]


def translation_defect(problem: RiccatiProblem, solution: RiccatiSolution) -> float:
    """||(K x_T)'R(K x_T) - C_s'QC_s|| / ||C_s'QC_s||, zero for every mesh, material and damping.

    For x_T = [I; 0; 0; 0] (the whole body displaced rigidly by unit motions of the hand) and v_T = [0; I; 0; 0] (moving
    rigidly) A x_T = 0 and, without damping against space, A v_T = E x_T: the Riccati equation between them.
    """
    K = solution.gain.K_s[:, : problem.layout.n_s]
    exact = problem.C_s.T @ problem.Q @ problem.C_s
    return float(np.linalg.norm(K.T @ problem.R @ K - exact) / (np.linalg.norm(exact) or 1.0))


def velocity_defect(problem: RiccatiProblem, solution: RiccatiSolution) -> float | None:
    """||(K x_T)'R(K v_T) - x_T'E'XE x_T|| / ||x_T'E'XE x_T||.

    None when the damping drags against space: the identity is not valid then.
    """
    if problem.system.damping.in_space and problem.system.damping.alpha > 0:
        return None
    n_s = problem.layout.n_s
    left = solution.gain.K_s[:, :n_s].T @ problem.R @ solution.gain.K_s[:, n_s:]
    right = solution.factor.hand[:n_s] @ solution.factor.hand[:n_s].T
    return float(np.linalg.norm(left - right) / (np.linalg.norm(right) or 1.0))
