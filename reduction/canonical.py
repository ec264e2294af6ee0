"""Canonical reduced models: symplectic projection in (q, p), with the hand as input or inside.

A basis gives readouts q_s = S_q x, v_s = S_v x, z = L_q x, v_z = L_v x and momenta P_s, P_e of hand and tissue.
Requiring

    P_s' (S_q x' - S_v x) + P_e' (L_q x' - L_v x) = S_q' (P_s x' - f_s) + L_q' (P_e x' + K L_q x + D L_q x' - f_e)

gives E x' = A x + B u + F g with E = J' - L_q' D L_q, J' = P_s' S_q + P_e' L_q - (...)' the symplectic form on the span
(skew whatever the basis, V' J' V for the coordinates below), and A the Hessian of an energy H. Hence
dH/dt = -x'' L_q' D L_q x' <= 0 without input: undamped models are Hamiltonian, damped ones dissipative [AH19]. One
exception: one-way with drag in space a coasting hand pulls the tissue through the medium, in the full model as well;
the hand's motion is an input there, and H falls when the hand rests.

    two-way     P_s = M_s S_v + G' L_v, P_e = M L_v + G S_v, M_s = M_hand + M_rigid:       H = the total energy
    one-way     P_s = M_hand S_v, P_e = M L_v; the tissue is pulled by -G M_hand^-1 u:     H = tissue relative to the
                hand + hand; the hand does not feel the tissue, and in these coordinates it is Hamiltonian all the
                same
    one-way with fixed solid modes: the hand obeys M_hand v_s' = u by itself, and the rows above are those of
                the tissue alone, in the frame of the basis: H = the tissue's energy, with the hand as an input

Where the second rows of the basis are p_e = M_ee v_z + G v_s (absolute) or p_z = M_ee v_z (relative):
L_v = M_ee^-1 V_p [- M_ee^-1 G S_v in the absolute frame].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.galerkin import symmetric
from softgrasp.reduction.operators import Operators, Parameters, Parts

MASS_RTOL = 1e-13  # of cg, where no direct solver fits: the lifted velocity inherits it


@dataclass(frozen=True)
class CanonicalLift:
    """Local rows that turn a reduced state into velocities: v_z = Y x / scale - W_G v_s."""

    L_q: Array  # z = L_q x, (n_local, N)
    Y: Array  # M_ee^-1 V_p at the densities of the projection, (n_local, N)
    W_G: Array | None  # M_ee^-1 G, (n_local, n_s), or None in the relative frame


def _rows(basis: Basis, system: BlockSystem) -> tuple[Array, Array, Array]:
    """S_q, rows of the hand's velocity or momentum, and L_q."""
    S_q, S_p = basis.V_sq, basis.V_sv
    if basis.fixed_solid:
        n_s = system.layout.n_s
        S_q, S_p = np.eye(n_s, basis.N), np.eye(n_s, basis.N, n_s)
    absolute = basis.frame == "absolute"
    L_q = np.asfortranarray(basis.V_q - system.T @ S_q) if absolute else basis.V_q
    return S_q, S_p, L_q


def canonical_parts(basis: Basis, system: BlockSystem) -> tuple[Parts, CanonicalLift]:
    """Small matrices at the densities of ``system``, and what lifts velocities. Collective.

    Raises:
        SoftgraspError: the hand's own columns reach into the tissue.
        SolverError: the mass matrix cannot be factored.
    """
    comm, absolute = system.layout.comm, basis.frame == "absolute"
    k = 2 * system.layout.n_s if basis.fixed_solid else 0
    # canonical models take the hand as their input
    if comm.allreduce(float(np.abs(basis.V_q[:, :k]).sum() + np.abs(basis.V_p[:, :k]).sum())) > 0:
        raise SoftgraspError(f"{basis.name}: the hand's own columns of a canonical basis must be zero in the tissue")
    S_q, S_p, L_q = _rows(basis, system)
    V_p, G, T = basis.V_p, system.G, system.T
    both = solve_columns(system.M_ee, system.layout, np.hstack([V_p, G]), "the momentum of a basis vector", MASS_RTOL)
    Y, W_G = np.split(both, [basis.N], axis=1)
    W = basis.V_q if basis.fixed_solid and not system.two_way else L_q
    G_WG = total(comm, G.T @ W_G)
    parts: Parts = {
        "S_q": S_q,
        "S_p": S_p,
        "M_hand": system.M_hand,
        "M_rigid": system.M_rigid,
        "GWG": symmetric(G_WG),
        "TV": total(comm, T.T @ V_p),
        "VY": symmetric(total(comm, V_p.T @ Y)),
        "VW_G": total(comm, Y.T @ G),
        "VL": total(comm, V_p.T @ L_q),
        "GL": total(comm, G.T @ L_q),
        "WV": total(comm, W.T @ V_p),
        "WG": total(comm, W.T @ G),
    }
    stacks: dict[str, list[Array]] = {}
    for layer in system.layers:
        for key, component in (("mu", layer.K_mu), ("lambda", layer.K_lambda)):
            K_L = times_columns(component.ee, L_q)
            stacks.setdefault(f"energy_{key}", []).append(symmetric(total(comm, L_q.T @ K_L)))
            if W is not L_q:
                stacks.setdefault(f"K_{key}", []).append(total(comm, W.T @ K_L))
    parts.update({key: np.stack(value) for key, value in stacks.items()})
    if system.damping.alpha:
        parts["WM"] = total(comm, W.T @ times_columns(system.M_ee, L_q))
    return parts, CanonicalLift(L_q, Y, W_G if absolute else None)


def hand_velocity(parts: Parts, p: Parameters, fixed: bool, absolute: bool) -> Array:
    """S_v with v_s = S_v x, (n_s, N): the hand's own columns, or its momentum over its inertia."""
    if fixed:
        return parts["S_p"]
    if not (p.two_way and absolute):
        return np.linalg.solve(parts["M_hand"], parts["S_p"])
    inertia = parts["M_hand"] + p.scale * (parts["M_rigid"] - parts["GWG"])
    return np.linalg.solve(inertia, parts["S_p"] + parts["TV"] - parts["VW_G"].T)


@dataclass(frozen=True)
class Terms:
    """Products at one parameter that the equations are put together from."""

    S_q: Array  # S_q, S_v: readouts of the hand, (n_s, N)
    S_v: Array
    rigid: Array  # rigid, G_WG: inertia of the tissue moved rigidly, and G' M^-1 G, (n_s, n_s)
    G_WG: Array
    G_L: Array  # G_L, G_Lv: G' L_q and G' L_v, (n_s, N)
    G_Lv: Array
    W_tG: Array  # W_q' G, (N, n_s)
    V_Lv: Array  # V_p' L_v, (N, N)
    K: Array  # W_q' K L_q, (N, N)
    energy: Array  # Hessian of the tissue's energy relative to the hand, (N, N)


def _terms(parts: Parts, p: Parameters, fixed: bool, absolute: bool) -> Terms:
    c, V_W = p.scale, parts["VW_G"]
    S_v = hand_velocity(parts, p, fixed, absolute)
    G_WG = c * parts["GWG"]
    # L_v loses M^-1 G S_v in the absolute frame
    G_Lv = V_W.T - (G_WG @ S_v if absolute else 0.0)
    V_Lv = parts["VY"] / c - (V_W @ S_v if absolute else 0.0)
    K_energy = p.stiffness(parts["energy_mu"], parts["energy_lambda"])
    K = p.stiffness(parts["K_mu"], parts["K_lambda"]) if "K_mu" in parts else K_energy
    kinetic = V_Lv - (S_v.T @ G_Lv if absolute else 0.0)
    energy = symmetric(K_energy + kinetic)
    W_tG, G_L = c * parts["WG"], c * parts["GL"]
    return Terms(parts["S_q"], S_v, c * parts["M_rigid"], G_WG, G_L, G_Lv, W_tG, V_Lv, K, energy)


def canonical_operators(parts: Parts, p: Parameters, fixed: bool, absolute: bool) -> Operators:
    """E, A, B, F and the energies at one parameter; online.

    Args:
        parts: from :func:`canonical_parts`.
        p: materials; their densities are ``scale`` times those of the projection.
        fixed: the hand's displacement and velocity are the first 2 n_s coordinates.
        absolute: the tissue rows of the basis are absolute.
    """
    t = _terms(parts, p, fixed, absolute)
    M_hand, S_q, S_v = parts["M_hand"], t.S_q, t.S_v
    inertia = M_hand + t.rigid if p.two_way else M_hand
    coupled = S_v.T @ t.G_Lv if p.two_way else np.zeros_like(t.K)
    hamiltonian = symmetric(t.energy + S_v.T @ inertia @ S_v + coupled + coupled.T)
    B, weight = -S_q.T, M_hand if p.hand_weight else np.zeros_like(M_hand)
    F = -t.W_tG - S_q.T @ weight
    if p.two_way:
        # momenta M_s S_v + G' L_v of the hand and M L_v + G S_v of the tissue
        X = (inertia @ S_v + t.G_Lv).T @ S_q + parts["VL"] + (0.0 if absolute else S_v.T @ t.G_L)
        E, A = X - X.T, hamiltonian
        F = F - S_q.T @ t.rigid
    elif fixed:
        E, A = _hand_as_input(parts, t, absolute)
    else:
        # momenta M_hand S_v and M L_v; the tissue feels a_s = M_hand^-1 (u + weight)
        X = (M_hand @ S_v).T @ S_q + parts["VL"] - (S_v.T @ t.G_L if absolute else 0.0)
        E, A = X - X.T, hamiltonian
        pull = np.linalg.solve(M_hand, t.G_L).T
        B, F = B + pull, F + pull @ weight
    if p.damped:
        E = E - _damping(parts, p, S_q)
    return Operators(E, A, B, F, S_q, S_v, t.energy, hamiltonian)


def _hand_as_input(parts: Parts, t: Terms, absolute: bool) -> tuple[Array, Array]:
    """E and A of a one-way model with fixed solid modes; the tissue's own block is skew and symmetric to the bit."""
    S_q, S_v, M_hand = t.S_q, t.S_v, parts["M_hand"]
    P_s = parts["S_p"] + (parts["TV"] if absolute else 0.0)
    W_tP = parts["WV"] + (0.0 if absolute else t.W_tG @ S_v)
    E = P_s.T @ S_q + parts["VL"] - W_tP - S_q.T @ M_hand @ S_v
    A = P_s.T @ S_v + t.V_Lv + t.K
    k = 2 * len(M_hand)
    E[k:, k:] = (E[k:, k:] - E[k:, k:].T) / 2
    A[k:, k:] = symmetric(A[k:, k:])
    return E, A


def _damping(parts: Parts, p: Parameters, S_q: Array) -> Array:
    """W' D L_q, plus the drag on the rigid motion when it acts in space."""
    prefix = "K" if "K_mu" in parts else "energy"
    D = p.viscosity(parts[f"{prefix}_mu"], parts[f"{prefix}_lambda"])
    if p.alpha:
        c = p.scale
        D = D + p.alpha * c * parts["WM"]
        if p.in_space:
            D = D + p.alpha * c * (parts["WG"] @ S_q)
            if p.two_way:
                D = D + p.alpha * c * S_q.T @ (parts["GL"] + parts["M_rigid"] @ S_q)
    return D
