"""Memory of a reduction beside its model, estimated before its run."""

from __future__ import annotations

import math

from mpi4py import MPI

from softgrasp.fem import Model, ResourceError, free_bytes, size_text

# Largest memory over that of all states [z; v_z], of both processes: states, their rows in one frame, copies in tall
# QRs, their Q, bases and models. Measured 11.0 to 13.0 with 601 states, slopes between 3.2e3, 6.6e3 and 1.6e4 unknowns.
PEAK = 13.0


def check_states(model: Model, comm: MPI.Intracomm) -> None:
    """Refuse a run whose states leave no memory for bases on some node. Collective.

    ``comm``: all ranks, which hold the whole model each or share it.

    Raises ResourceError: with the estimate, what may be used, and the ``output.every`` that fits.
    """
    scene, layout = model.scene, model.system.layout
    count = scene.time.steps // scene.output.every + 1
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    needed, free = node.allreduce(PEAK * 16 * layout.n_local * count), node.bcast(free_bytes(scene))
    node.Free()
    over, needed, free = max(comm.allgather((needed / max(free, 1.0), needed, free)))
    if over <= 1:
        return
    raise ResourceError(
        f"output.every = {scene.output.every} keeps {count} states of {2 * layout.n_e} numbers, whose bases need about "
        f"{size_text(needed)} on one node, where {size_text(free)} may be used; set output.every = "
        f"{math.ceil(over * scene.output.every)}, or allow more with --set output.memory=GIB"
    )
