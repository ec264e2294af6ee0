"""Projection of a full model onto a basis: distributed products, then small matrices that are equal on every rank."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import total
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.canonical import canonical_parts
from softgrasp.reduction.galerkin import galerkin_parts
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.operators import Reconstruction
from softgrasp.reduction.system import Outputs

if TYPE_CHECKING:
    from softgrasp.fem.model.outputs import Output


def project(
    basis: Basis,
    system: BlockSystem,
    outputs: Sequence[Output] = (),
    scene_hash: str = "",
    origin: dict[str, Any] | None = None,
) -> ReducedModel:
    """Reduced model E x' = A x + B u + F g, y = C_z x + C_s q_s of a basis V of shape (2n, N). Collective.

    A basis in (q, v) gives the paper's Galerkin model with W = V [SBRH21] (`reduction.galerkin`), one in (q, p) a
    canonical model that is Hamiltonian, or dissipative with damping [AH19] (`reduction.canonical`).

    A canonical model is affine around the densities of ``system``. Needs a product with every component for each basis
    vector; a canonical model also one factorisation of M_ee and a solve for each vector with a momentum.

    Raises:
        SolverError: the mass matrix cannot be factored.
        SoftgraspError: a canonical basis with fixed solid modes whose hand columns reach into the tissue.
    """
    layout = system.layout
    layout.comm.Barrier()
    begin = time.perf_counter()
    parts, reconstruction = (galerkin_parts if basis.coordinates == "qv" else canonical_parts)(basis, system)
    # sums over ranks may differ in the last bit from rank to rank
    parts = layout.comm.bcast(parts)
    damping = system.damping
    seconds = layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX)
    return ReducedModel(
        name=basis.name,
        N=basis.N,
        coordinates=basis.coordinates,
        frame=basis.frame,
        structure=basis.structure,
        fixed_solid=basis.fixed_solid,
        parts=parts,
        materials=system.materials,
        outputs=project_outputs(outputs, reconstruction),
        split=basis.split,
        alpha=damping.alpha,
        in_space=damping.in_space,
        damped=damping.active,
        hand_weight=system.hand_weight,
        two_way=system.two_way,
        gravity=system.gravity,
        reconstruction=reconstruction,
        scene_hash=scene_hash,
        origin=origin or {},
        seconds={**basis.seconds, "projection": seconds},
    )


def project_outputs(outputs: Sequence[Output], reconstruction: Reconstruction) -> Outputs:
    """C_z = C_e L_q on every rank, with the rigid parts. Collective."""
    n_s, N = reconstruction.layout.n_s, reconstruction.L_q.shape[1]
    rows = [o.weight * reconstruction.L_q[o.dofs].sum(axis=0) for o in outputs]
    local = np.concatenate(rows) if rows else np.zeros((0, N))
    C_z = reconstruction.layout.comm.bcast(total(reconstruction.layout.comm, local))
    C_s = np.vstack([o.C_s for o in outputs]) if rows else np.zeros((0, n_s))
    names = tuple(name for o in outputs for name in o.names)
    return Outputs(C_z, C_s, names)
