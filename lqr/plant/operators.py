"""Products of the plant with states and costates in hand-relative coordinates, a few columns at a time."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem


def modes_couple(system: BlockSystem) -> bool:
    """Whether the damping couples the modes of the coupled free motion."""
    return system.damping.matrix is not None or (system.two_way and system.damping.alpha > 0)


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
    system, n_s, n = problem.system, problem.layout.n_s, problem.layout.n_local
    v_s, v = X.hand[n_s:], X.tall[n:]
    hand, momentum = problem.M_s @ v_s, times_columns(system.M_ee, v)
    if system.two_way or adjoint:
        hand = hand + total(system.layout.comm, system.G.T @ v)
    if system.two_way or not adjoint:
        momentum = momentum + system.G @ v_s
    return Block(np.concatenate([X.hand[:n_s], hand]), np.concatenate([X.tall[:n], momentum]))


def descriptor_adjoint(problem: RiccatiProblem, Z: Block) -> Block:
    """E' Z. Collective."""
    return descriptor(problem, Z, adjoint=True)


def dynamics(problem: RiccatiProblem, X: Block) -> Block:
    """A X. Collective."""
    system, n_s, n = problem.system, problem.layout.n_s, problem.layout.n_local
    v_s, z, v = X.hand[n_s:], X.tall[:n], X.tall[n:]
    force = -times_columns(system.K_ee, z) - damp(system, v)
    hand = np.zeros_like(v_s)
    if system.damping.in_space:
        drag = system.damping.alpha
        force -= drag * (system.G @ v_s)
        if system.two_way:
            hand = -drag * (system.M_rigid @ v_s + total(system.layout.comm, system.G.T @ v))
    return Block(np.concatenate([v_s, hand]), np.concatenate([v, force]))


def inputs_adjoint(problem: RiccatiProblem, Z: Block) -> Array:
    """B'Z, (m, k), on every rank. Collective without a hand."""
    if problem.B_z is None:
        return Z.hand[problem.layout.n_s :]
    return total(problem.layout.comm, problem.B_z.T @ Z.tall[problem.layout.n_local :])


def normalising(gram: Array, share: float, least: float = 0.0) -> Array:
    """S with S'gram S = I on the eigenvectors of gram above ``least`` and a share of the largest eigenvalue."""
    sizes, vectors = np.linalg.eigh((gram + gram.T) / 2)
    keep = sizes > max(least, share * float(sizes.max(initial=0.0)))
    return np.asarray(vectors[:, keep] / np.sqrt(sizes[keep]))


def modal_inputs(problem: RiccatiProblem, Phi: Array) -> Array:
    """Coupling of the inputs to shapes of the tissue, (k, m): Phi'G through the hand, else Phi'B_z. Collective."""
    return total(problem.layout.comm, Phi.T @ (problem.system.G if problem.B_z is None else problem.B_z))


def outputs(problem: RiccatiProblem, X: Block) -> Array:
    """C X, (p, k), on every rank. Collective."""
    n_s, n = problem.layout.n_s, problem.layout.n_local
    return np.asarray(problem.C_s @ X.hand[:n_s] + total(problem.layout.comm, problem.C_z.T @ X.tall[:n]))
