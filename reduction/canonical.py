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

The equations need the span of the basis alone. Where its columns are nearly dependent (the two of a symplectic pair may
be long and almost parallel), the coordinates are those of orthonormal columns: measured with SVD-like pairs of block_3d
at N = 38, the deformation is right to 5e-8 then, and to 6e-6 .. 3e-5 with the pairs themselves, which one rank and two
make with other numbers.

Where the second rows of the basis are p_e = M_ee v_z + G v_s (absolute) or p_z = M_ee v_z (relative):
L_v = M_ee^-1 V_p [- M_ee^-1 G S_v in the absolute frame].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.bases.engines import triangle
from softgrasp.reduction.operators import (
    Parameters,
    Parts,
    Reconstruction,
    layer_products,
    own_loads,
    relative_rows,
    symmetric,
)
from softgrasp.reduction.system import EnergySystem, Outputs

# condition of the columns from which the model is made with orthonormal ones: rounding of E and A enters by its square
DEPENDENT = 100.0
MASS_RTOL = 1e-13  # of cg, where no direct solver fits: the lifted velocity inherits it


def well_conditioned(basis: Basis) -> Basis:
    """The same span, nested as before: [V_hand, V_tissue R^-1], orthonormal where columns depend. Collective.

    Unchanged where the condition is below :data:`DEPENDENT`, and where columns are dependent to rounding, for the model
    to be refused by its singular E. Rows of displacement and momentum, whose units differ, count by the norm of their
    half.
    """
    k = 2 * basis.layout.n_s if basis.fixed_solid else 0
    comm, n_s = basis.layout.comm, basis.layout.n_s
    hand, tissue = np.vstack([basis.V_sq, basis.V_sv])[:, k:], np.vstack([basis.V_q, basis.V_p])[:, k:]
    n = len(tissue) // 2
    squares = total(comm, np.array([np.sum(half**2, axis=0) for half in (tissue[:n], tissue[n:])]))
    squares += [np.sum(half**2, axis=0) for half in (hand[:n_s], hand[n_s:])]
    sizes = np.sqrt(squares.sum(axis=1))
    if not (sizes > 0).all():
        return basis
    lengths = np.sqrt(np.sum(squares / sizes[:, None] ** 2, axis=0))
    if not (lengths > 0).all():
        return basis
    tissue = tissue / np.repeat(sizes, n)[:, None] / lengths
    R = triangle(comm, tissue, hand / np.repeat(sizes, n_s)[:, None] / lengths)
    if not DEPENDENT < np.linalg.cond(R) < 1 / (len(R) * np.finfo(float).eps):
        return basis
    C = np.eye(basis.N)
    C[k:, k:] = scipy.linalg.solve_triangular(R, np.eye(len(R))) / lengths[:, None]
    V_q, V_p = (np.asfortranarray(V @ C) for V in (basis.V_q, basis.V_p))
    return replace(basis, V_sq=basis.V_sq @ C, V_sv=basis.V_sv @ C, V_q=V_q, V_p=V_p)


def canonical_parts(basis: Basis, system: BlockSystem) -> tuple[Parts, Reconstruction]:
    """Small matrices at the densities of ``system``, and the reconstruction. Collective.

    Raises:
        SoftgraspError: the hand's own columns reach into the tissue.
        SolverError: the mass matrix cannot be factored.
    """
    comm, layout = system.layout.comm, system.layout
    k = 2 * layout.n_s if basis.fixed_solid else 0
    # the hand is the input of canonical models
    if comm.allreduce(float(np.abs(basis.V_q[:, :k]).sum() + np.abs(basis.V_p[:, :k]).sum())) > 0:
        raise SoftgraspError(f"{basis.name}: the hand's own columns of a canonical basis must be zero in the tissue")
    basis = well_conditioned(basis)
    L_q, _ = relative_rows(basis, system)
    V_p, G = basis.V_p, system.G
    both = solve_columns(system.M_ee, layout, np.hstack([V_p, G]), "the momentum of a basis vector", MASS_RTOL)
    Y, W_G = np.split(both, [basis.N], axis=1)
    W = basis.V_q if basis.fixed_solid and not system.two_way else L_q
    parts: Parts = {
        "S_q": basis.V_sq,
        "S_p": basis.V_sv,
        "M_hand": system.M_hand,
        "M_rigid": system.M_rigid,
        "GWG": symmetric(total(comm, G.T @ W_G)),
        "TV": total(comm, system.T.T @ V_p),
        "VY": symmetric(total(comm, V_p.T @ Y)),
        "VW_G": total(comm, Y.T @ G),
        "VL": total(comm, V_p.T @ L_q),
        "GL": total(comm, G.T @ L_q),
        "WV": total(comm, W.T @ V_p),
        "WG": total(comm, W.T @ G),
    }
    for key in ("mu", "lambda"):
        energy, *stiffness = layer_products(system, f"K_{key}", L_q, *((L_q,) if W is L_q else (L_q, W)))
        parts[f"energy_{key}"] = symmetric(energy)
        parts |= {f"K_{key}": each for each in stiffness}
    if system.damping.alpha:
        parts["WM"] = total(comm, W.T @ times_columns(system.M_ee, L_q))
    parts |= own_loads(system, W)
    return parts, Reconstruction(layout, L_q, Y, W_G if basis.frame == "absolute" else None)


def hand_velocity(parts: Parts, p: Parameters, fixed: bool, absolute: bool) -> Array:
    """S_v with v_s = S_v x, (n_s, N): the hand's own columns, or its momentum over its inertia."""
    if fixed:
        return parts["S_p"]
    if not (p.two_way and absolute):
        return np.linalg.solve(parts["M_hand"], parts["S_p"])
    inertia = parts["M_hand"] + p.scale * (parts["M_rigid"] - parts["GWG"])
    return np.linalg.solve(inertia, parts["S_p"] + parts["TV"] - parts["VW_G"].T)


def canonical_system(
    name: str, parts: Parts, p: Parameters, outputs: Outputs, fixed: bool, absolute: bool
) -> EnergySystem:
    """The system at one parameter; online.

    Args:
        name: name of the basis.
        parts: from :func:`canonical_parts`.
        p: materials; their densities are ``scale`` times those of the projection.
        outputs: outputs of the scene.
        fixed: the hand's displacement and velocity are the first 2 n_s coordinates.
        absolute: the tissue rows of the basis are absolute.
    """
    c, M_hand, S_q, V_L, V_W = p.scale, parts["M_hand"], parts["S_q"], parts["VL"], parts["VW_G"]
    S_v = hand_velocity(parts, p, fixed, absolute)
    rigid, G_L, W_tG = c * parts["M_rigid"], c * parts["GL"], c * parts["WG"]
    # G' L_v and V_p' L_v; L_v loses M^-1 G S_v in the absolute frame
    G_Lv = V_W.T - (c * parts["GWG"] @ S_v if absolute else 0.0)
    V_Lv = parts["VY"] / c - (V_W @ S_v if absolute else 0.0)
    K_energy = p.stiffness(parts["energy_mu"], parts["energy_lambda"])
    own = "K" if "K_mu" in parts else "energy"  # W_q' K L_q where W_q is another than L_q
    K = K_energy if own == "energy" else p.stiffness(parts["K_mu"], parts["K_lambda"])
    energy = symmetric(K_energy + (V_Lv - (S_v.T @ G_Lv if absolute else 0.0)))

    inertia = M_hand + rigid if p.two_way else M_hand
    coupled = S_v.T @ G_Lv if p.two_way else np.zeros_like(K)
    hamiltonian = symmetric(energy + S_v.T @ inertia @ S_v + coupled + coupled.T)
    B, weight = -S_q.T, M_hand if p.hand_weight else np.zeros_like(M_hand)
    F = -W_tG - S_q.T @ weight
    if p.two_way:
        # momenta M_s S_v + G' L_v of the hand and M L_v + G S_v of the tissue
        X = (inertia @ S_v + G_Lv).T @ S_q + V_L + (0.0 if absolute else S_v.T @ G_L)
        E, A = X - X.T, hamiltonian
        F = F - S_q.T @ rigid
    elif fixed:
        # the hand as input; the tissue's own block is skew and symmetric to the bit
        P_s = parts["S_p"] + (parts["TV"] if absolute else 0.0)
        W_tP = parts["WV"] + (0.0 if absolute else W_tG @ S_v)
        E = P_s.T @ S_q + V_L - W_tP - S_q.T @ M_hand @ S_v
        A = P_s.T @ S_v + V_Lv + K
        k = 2 * len(M_hand)
        E[k:, k:] = (E[k:, k:] - E[k:, k:].T) / 2
        A[k:, k:] = symmetric(A[k:, k:])
    else:
        # momenta M_hand S_v and M L_v; the tissue feels a_s = M_hand^-1 (u + weight)
        X = (M_hand @ S_v).T @ S_q + V_L - (S_v.T @ G_L if absolute else 0.0)
        E, A = X - X.T, hamiltonian
        pull = np.linalg.solve(M_hand, G_L).T
        B, F = B + pull, F + pull @ weight
    if p.damped:  # W' D L_q, plus the drag on the rigid motion when it acts in space
        D = p.viscosity(parts[f"{own}_mu"], parts[f"{own}_lambda"])
        if p.alpha:
            D = D + p.alpha * c * parts["WM"]
        if p.alpha and p.in_space:
            D = D + p.alpha * c * (parts["WG"] @ S_q)
            if p.two_way:
                D = D + p.alpha * c * S_q.T @ (parts["GL"] + parts["M_rigid"] @ S_q)
        E = E - D
    load = p.load(F) - p.own_load(parts, "own_tissue")
    if p.two_way and "own_hand" in parts:
        load = load - S_q.T @ p.own_load(parts, "own_hand")
    C = outputs.C_z + outputs.C_s @ S_q
    return EnergySystem(
        E, A, B, C, load, S_q, S_v, outputs.names, name=name, C_s=outputs.C_s, H_tissue=energy, H=hamiltonian,
        two_way=p.two_way, structured=p.conservative, scale=p.scale,
    )  # fmt: skip
