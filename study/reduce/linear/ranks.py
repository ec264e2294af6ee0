"""Work that ranks with the whole model each divide, without a message in it: methods, parameters and repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

from softgrasp.fem import Model, Scene, build
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.forked import packed, unpacked
from softgrasp.fem.model.memory import need
from softgrasp.study.reduce.linear.bases import WHOLE_BYTES

MODEL_BYTES = 2.0**30  # of matrices and factor of one model up to which each rank holds them


def of_each_rank(model: Model, scene: Scene) -> tuple[Model, MPI.Intracomm]:
    """The model on each rank alone, and the ranks that divide work; where its run is large, itself and no others.

    Large are runs with more states or larger matrices than each rank shall hold, and graded meshes, which are estimated
    while they are made. Collective.
    """
    layout = model.system.layout
    states, held = 16 * layout.n_e * (scene.time.steps + 1), need(scene, layout.dimension, model.cells, 1, True)
    large = states > WHOLE_BYTES or held.of(1.0, 1) > MODEL_BYTES
    if layout.comm.size == 1 or large or scene.tissue.refine is not None:
        return model, MPI.COMM_SELF
    with raise_on_all_ranks(layout.comm):
        own = build(scene, comm=MPI.COMM_SELF)
    return own, layout.comm


def dealt[T](ranks: MPI.Intracomm, calls: Sequence[Callable[[], T]], same: Sequence[object] = ()) -> list[T]:
    """Results of all calls on every rank, each made by one of them. Collective; the calls must not communicate.

    ``same``: objects in the results that are not sent, but are each rank's own.

    Raises Exception: that of the lowest rank with a call that fails.
    """
    if ranks.size == 1:
        return [call() for call in calls]
    found: dict[int, T] = {}
    sent = b""
    with raise_on_all_ranks(ranks):
        found = {i: calls[i]() for i in range(ranks.rank, len(calls), ranks.size)}
        sent = packed(found, same)
    for rank, part in enumerate(ranks.allgather(sent)):
        if rank != ranks.rank:
            found |= unpacked(part, same)
    return [found[i] for i in range(len(calls))]
