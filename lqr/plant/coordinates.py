"""Between the paper's coordinates [q_s, v_s, q_e, v_e] and the hand-relative ones [q_s, v_s, z, v_z].

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

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.plant.block import Block


def _split(system: BlockSystem, X: Block) -> tuple[Array, Array, Array, Array]:
    n_s, n = system.layout.n_s, system.layout.n_local
    return X.hand[:n_s], X.hand[n_s:], X.tall[:n], X.tall[n:]


def _under(system: BlockSystem, local: Array) -> Array:
    """T' X over all ranks. Collective."""
    return total(system.layout.comm, system.T.T @ local)


def states_to_relative(system: BlockSystem, X: Block, sign: int = 1) -> Block:
    """S X; S^{-1} X for the other sign."""
    q_s, v_s, q, v = _split(system, X)
    return Block(X.hand, np.concatenate([q - sign * (system.T @ q_s), v - sign * (system.T @ v_s)]))


def costates_to_absolute(system: BlockSystem, Z: Block, sign: int = 1) -> Block:
    """L' Z, a factor of P from a factor of X; L'^{-1} Z for the other sign. Collective."""
    q_s, v_s, z, v = _split(system, Z)
    if system.two_way:
        v = v + sign * (system.T @ v_s)
    return Block(np.concatenate([q_s - sign * _under(system, z), v_s]), np.concatenate([z, v]))


def costates_to_relative(system: BlockSystem, Z: Block) -> Block:
    """L'^{-1} Z: a factor of X from a factor of P. Collective."""
    return costates_to_absolute(system, Z, -1)


def gain_to_absolute(system: BlockSystem, K: Block, sign: int = 1) -> Block:
    """S' K' for a transposed gain, K = K_rel S; S'^{-1} K' for the other sign. Collective."""
    q_s, v_s, z, v = _split(system, K)
    return Block(np.concatenate([q_s - sign * _under(system, z), v_s - sign * _under(system, v)]), K.tall)
