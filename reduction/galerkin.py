"""The paper's reduced models: Galerkin projection of E x' = A x + B u + F g in (q, v), W = V [SBRH21].

With z = q_e - T q_s the rows of x = [q_s, v_s, q_e, v_e] read

    q_s' = v_s,   q_e' = v_e (relative frame: z' = v_z),
    M_hand v_s' [+ G' v_z' + M_rigid (v_s' - g)] = u          ([...] two-way only)
    M_ee v_z' + G (v_s' - g) + D v_z [+ alpha G v_s] + K_ee z = 0

K_ee z replaces the paper's K_es q_s + K_ee q_e: the same numbers without the cancellation.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.system import BlockSystem, coupling
from softgrasp.reduction.bases.basis import Basis
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


def unit_coupling(system: BlockSystem) -> tuple[list[Array], list[Array]]:
    """G and M_rigid of every layer at density 1. Collective."""
    unit = LayerMaterial(0.0, 0.0, 1.0)
    pairs = [coupling((layer,), (unit,), system.T) for layer in system.layers]
    return [g for g, _ in pairs], [r for _, r in pairs]


def galerkin_parts(basis: Basis, system: BlockSystem) -> tuple[Parts, Reconstruction]:
    """Small matrices from which every parameter is assembled, and the reconstruction. Collective.

    The rows of the tissue are tested with V_v itself (the paper), or with V_v - T V_sv where virtual work requires it:
    two-way coupling, and bases of second order, whose models stay symmetric that way.
    """
    comm = system.layout.comm
    S_q, S_v = basis.V_sq, basis.V_sv
    Z, Z_v = relative_rows(basis, system)
    W = Z_v if system.two_way or basis.structure == "second_order" else basis.V_p
    G, rigid = unit_coupling(system)
    parts: Parts = {
        "identity_E": S_q.T @ S_q + total(comm, basis.V_q.T @ basis.V_q),
        "identity_A": S_q.T @ S_v + total(comm, basis.V_q.T @ basis.V_p),
        "S_q": S_q,
        "S_v": S_v,
        "M_hand": system.M_hand,
        "rigid": np.stack(rigid),
        "WG": np.stack([total(comm, W.T @ g) for g in G]),
        "ZG": np.stack([total(comm, Z_v.T @ g) for g in G]),
    }
    for key in ("mu", "lambda"):
        parts[f"K_{key}"], parts[f"energy_{key}"] = layer_products(system, f"K_{key}", Z, W, Z)
        if system.damping.active:
            (parts[f"D_{key}"],) = layer_products(system, f"K_{key}", Z_v, W)
    parts["M"], parts["energy_M"] = layer_products(system, "M_1", Z_v, W, Z_v)
    return parts | own_loads(system, W), Reconstruction(system.layout, Z, Z_v)


def galerkin_equations(parts: Parts, p: Parameters) -> tuple[Array, Array, Array]:
    """E, A and f at one parameter; online. They are affine in lambda, mu, rho, alpha and beta (lambda, mu)."""
    S_v, M_hand = parts["S_v"], parts["M_hand"]
    G, rigid = p.density(parts["WG"]), p.density(parts["rigid"])
    M = p.density(parts["M"]) + G @ S_v
    if p.two_way:
        M += S_v.T @ (p.density(parts["ZG"]).T + rigid @ S_v)
    A = parts["identity_A"] - p.stiffness(parts["K_mu"], parts["K_lambda"])
    if p.damped:
        A -= p.viscosity(parts["D_mu"], parts["D_lambda"])
        A -= p.alpha * (M if p.in_space else p.density(parts["M"]))
    F = G + (S_v.T @ rigid if p.two_way else 0.0) + (S_v.T @ M_hand if p.hand_weight else 0.0)
    own = p.own_load(parts, "own_tissue")
    if p.two_way and "own_hand" in parts:
        own = own + S_v.T @ p.own_load(parts, "own_hand")
    return parts["identity_E"] + S_v.T @ M_hand @ S_v + M, A, p.load(F) + own


def galerkin_system(name: str, parts: Parts, p: Parameters, outputs: Outputs, second_order: bool) -> EnergySystem:
    """The system at one parameter; online. ``second_order``: the basis keeps the equations of second order."""
    S_q, S_v = parts["S_q"], parts["S_v"]
    E, A, f = galerkin_equations(parts, p)
    energy = symmetric(p.stiffness(parts["energy_mu"], parts["energy_lambda"]) + p.density(parts["energy_M"]))
    cross = p.density(parts["ZG"]) @ S_v
    hand = parts["M_hand"] + p.density(parts["rigid"]) if p.two_way else parts["M_hand"]
    return EnergySystem(
        E,
        A,
        S_v.T.copy(),
        outputs.C_z + outputs.C_s @ S_q,
        f,
        S_q,
        S_v,
        outputs.names,
        name=name,
        C_s=outputs.C_s,
        H_tissue=energy,
        H=symmetric(energy + S_v.T @ hand @ S_v + ((cross + cross.T) if p.two_way else 0.0)),
        two_way=p.two_way,
        structured=p.conservative and second_order,
        scale=p.scale,
    )
