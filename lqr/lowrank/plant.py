"""The plant in the form the low-rank solvers use: weights folded in, products with E' and A' for a few columns."""

from __future__ import annotations

from functools import partial

import numpy as np

from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.petsc import Array, on_root, times_columns, total
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError, check_finite, check_weights, square_root
from softgrasp.lqr.plant.problem import RiccatiProblem


class Plant:
    """E x' = A x + B u, y = C x with B <- B R^{-1/2}, C <- Q^{1/2} C, in hand-relative coordinates.

    Costates are kept as [a_s, b_s, a, b] with the displacement part scaled by the stiffness, z-row = K_ee a: in this
    form the energy [K_ee, M_ee] is their natural inner product. The adjoint operators are

        E'X = [a_s; M_s b_s + G'b; K a; M b + H b_s],
        A'X = [0; a_s - D_ss b_s - D_es'b; -K b; K a - D b - D_se'b_s],

    with H = G, D_ss = alpha M_rigid, D_se = alpha G' for two-way coupling (alpha only when damping acts in space).
    Without a hand its rows are empty and the inputs act on the tissue, B = [0; B_z].

    Raises:
        ControlError: R is not positive definite, Q has a negative eigenvalue or sees nothing, or a number is not
            finite.
    """

    def __init__(self, problem: RiccatiProblem) -> None:
        system = problem.system
        self.problem, self.system, self.layout, self.comm = problem, system, system.layout, system.layout.comm
        self.n_s, self.n_local = self.layout.n_s, self.layout.n_local
        with raise_on_all_ranks(self.comm):
            check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
            check_finite(C_s=problem.C_s, C_z=problem.C_z, G=system.G, M_hand=system.M_hand, B_z=problem.B_z)
            check_finite(K_ee=system.K_ee, M_ee=system.M_ee)
        weight = np.linalg.inv(np.linalg.cholesky(problem.R)).T
        self.B = weight if problem.B_z is None else np.zeros((0, len(weight)))
        self.B_z = None if problem.B_z is None else problem.B_z @ weight
        F = square_root(problem.Q)
        self.C_s, self.C_z = F @ problem.C_s, problem.C_z @ F.T
        self.M_s, self.G = problem.M_s, system.G
        self.two_way = system.two_way
        drag = system.damping.alpha if system.damping.in_space else 0.0
        self.drag_es = drag
        self.drag_hand = drag if self.two_way else 0.0
        self.mass, self.stiff = (partial(times_columns, A) for A in (system.M_ee, system.K_ee))
        viscous = system.damping.matrix
        self.viscous = None if viscous is None else partial(times_columns, viscous)
        seen = self.C_s @ self.C_s.T + total(self.comm, self.C_z.T @ self.C_z)
        # the same bits on every rank: the solvers stop by residuals over it
        self.scale = float(on_root(self.comm, partial(np.linalg.norm, seen, 2)))
        if self.scale == 0:
            raise ControlError("the outputs weighted with Q are all zero; give an output and a Q that is not zero")

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    def inputs_of(self, V: Block) -> Array:
        """V'B, (k, m), on every rank. Collective without a hand."""
        if self.B_z is None:
            return np.asarray(V.hand[self.n_s :].T @ self.B)
        return total(self.comm, V.tall[self.n_local :].T @ self.B_z)

    def outputs(self) -> Block:
        """C' as a block (z-row unscaled)."""
        hand = np.vstack([self.C_s.T, np.zeros_like(self.C_s.T)])
        return Block(hand, np.vstack([self.C_z, np.zeros_like(self.C_z)]))

    def mass_adjoint(self, V: Block, out: Array | None = None) -> Block:
        """E'V of a costate block; the z-row of the result is unscaled. Collective.

        ``out``: room for the tissue rows of the result.
        """
        n, (a_s, b_s, a, b) = self.n_local, V.parts
        tall = np.empty(V.tall.shape) if out is None else out
        tall[:n] = self.stiff(a)
        tall[n:] = self.mass(b)
        if self.two_way:
            tall[n:] += self.G @ b_s
        return Block(np.vstack([a_s, self.M_s @ b_s + total(self.comm, self.G.T @ b)]), tall)
