"""Products of the plant with states and costates, a few columns at a time, and the way to the paper's coordinates.

From the paper's [q_s, v_s, q_e, v_e] to the hand-relative [q_s, v_s, z, v_z]:

    x_rel = S x,  S: z = q_e - T q_s, v_z = v_e - T v_s;
    E_rel = L E S^{-1}, A_rel = L A S^{-1}, B_rel = L B, C_rel = C S^{-1},
    L: the displacement row of the tissue loses T times that of the hand; with two-way coupling the force row of the
    hand gains T' times that of the tissue;
    P = L' X L, K = K_rel S.

The products with T need no solve, and K_ee T + K_es = 0 makes A_rel block diagonal. Costates (factors of X, P; bases
they are expanded in) go with L', states with S, gains with S.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem


def modes_couple(system: BlockSystem) -> bool:
    """Whether the damping couples the modes of the coupled free motion."""
    return system.damping.matrix is not None or (system.two_way and system.damping.alpha > 0)


def least_beta(system: BlockSystem) -> float:
    """Kelvin-Voigt time of the least damped layer [s]: D_ee >= alpha M_ee + beta K_ee."""
    if system.damping.matrix is None:
        return system.damping.beta
    return min((m.beta for m in system.materials), default=0.0)


def damp(system: BlockSystem, X: Array, M_X: Array | None = None, K_X: Array | None = None) -> Array:
    """D_ee X for local rows, with M_ee X and K_ee X where they are there already. Collective."""
    damping, result = system.damping, np.zeros_like(X)
    if damping.alpha:
        result += damping.alpha * (times_columns(system.M_ee, X) if M_X is None else M_X)
    if damping.beta:
        result += damping.beta * (times_columns(system.K_ee, X) if K_X is None else K_X)
    if damping.matrix is not None:
        result += times_columns(damping.matrix, X)
    return result


def descriptor(problem: RiccatiProblem, X: Block, *, adjoint: bool = False) -> Block:
    """E X, or E' X. Collective."""
    system, (q_s, v_s, z, v) = problem.system, X.parts
    hand, momentum = problem.M_s @ v_s, times_columns(system.M_ee, v)
    if system.two_way or adjoint:
        hand = hand + total(system.layout.comm, system.G.T @ v)
    if system.two_way or not adjoint:
        momentum = momentum + system.G @ v_s
    return Block.of_parts(q_s, hand, z, momentum)


def descriptor_adjoint(problem: RiccatiProblem, Z: Block) -> Block:
    """E' Z. Collective."""
    return descriptor(problem, Z, adjoint=True)


def dynamics(problem: RiccatiProblem, X: Block) -> Block:
    """A X. Collective."""
    system, (_, v_s, z, v) = problem.system, X.parts
    force = -times_columns(system.K_ee, z) - damp(system, v)
    hand = np.zeros_like(v_s)
    if system.damping.in_space:
        drag = system.damping.alpha
        force -= drag * (system.G @ v_s)
        if system.two_way:
            hand = -drag * (system.M_rigid @ v_s + total(system.layout.comm, system.G.T @ v))
    return Block.of_parts(v_s, hand, v, force)


def inputs_adjoint(problem: RiccatiProblem, Z: Block) -> Array:
    """B'Z, (m, k), on every rank. Collective without a hand."""
    _, v_s, _, v = Z.parts
    return v_s if problem.B_z is None else total(problem.layout.comm, problem.B_z.T @ v)


def outputs(problem: RiccatiProblem, X: Block) -> Array:
    """C X, (p, k), on every rank. Collective."""
    q_s, _, z, _ = X.parts
    return np.asarray(problem.C_s @ q_s + total(problem.layout.comm, problem.C_z.T @ z))


def _under(system: BlockSystem, local: Array) -> Array:
    """T' X over all ranks. Collective."""
    return total(system.layout.comm, system.T.T @ local)


def states_to_relative(system: BlockSystem, X: Block, sign: int = 1) -> Block:
    """S X; S^{-1} X for the other sign."""
    q_s, v_s, q, v = X.parts
    return Block(X.hand, np.concatenate([q - sign * (system.T @ q_s), v - sign * (system.T @ v_s)]))


def costates_to_absolute(system: BlockSystem, Z: Block, sign: int = 1) -> Block:
    """L' Z, a factor of P from a factor of X; L'^{-1} Z for the other sign. Collective."""
    q_s, v_s, z, v = Z.parts
    if system.two_way:
        v = v + sign * (system.T @ v_s)
    return Block.of_parts(q_s - sign * _under(system, z), v_s, z, v)


def costates_to_relative(system: BlockSystem, Z: Block) -> Block:
    """L'^{-1} Z: a factor of X from a factor of P. Collective."""
    return costates_to_absolute(system, Z, -1)


def gain_to_absolute(system: BlockSystem, K: Block, sign: int = 1) -> Block:
    """S' K' for a transposed gain, K = K_rel S; S'^{-1} K' for the other sign. Collective."""
    q_s, v_s, z, v = K.parts
    return Block(np.concatenate([q_s - sign * _under(system, z), v_s - sign * _under(system, v)]), K.tall)
