"""Work that ranks with the whole model each divide, without a message in it: methods, parameters and repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from mpi4py import MPI

from softgrasp.fem import Model, Scene, build
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.forked import packed, shared, unpacked
from softgrasp.fem.model.memory import need
from softgrasp.study.reduce.linear.bases import WHOLE_BYTES

MODEL_BYTES = 2.0**30  # of matrices and factor of one model up to which each rank holds them


def of_each_rank(model: Model, scene: Scene) -> tuple[Model, MPI.Intracomm]:
    """The model on each rank alone, and the ranks that divide work; where its run is large, itself and no others.

    Large are runs with more states or larger matrices than each rank shall hold. Collective.
    """
    layout = model.system.layout
    states, held = 16 * layout.n_e * (scene.time.steps + 1), need(scene, layout.dimension, model.cells, 1, True)
    large = states > WHOLE_BYTES or held.of(1.0, 1) > MODEL_BYTES
    if layout.comm.size == 1 or large:
        return model, MPI.COMM_SELF
    mesh = None
    if scene.tissue.refine is not None:
        from softgrasp.fem.mesh.grading import on_each_rank  # only scenes with graded cells pay for it

        mesh = on_each_rank(model.space.mesh, scene)
    with raise_on_all_ranks(layout.comm):
        own = build(scene, comm=MPI.COMM_SELF, mesh=mesh)
    return replace(own, accuracy=model.accuracy), layout.comm


def divided[T](
    ranks: MPI.Intracomm, shares: Sequence[Sequence[Callable[[], T]]], same: Sequence[object] = ()
) -> list[T]:
    """Results of the calls of all shares, one for each rank; on one rank a forked process begins with a second share.

    Collective; the calls must not communicate. ``same``, Raises: as in :func:`dealt`.
    """
    if ranks.size == 1:
        own, *beside = shares
        return shared(own, [call for share in beside for call in share], same)
    parts = dealt(ranks, [partial(_in_turn, share) for share in shares], same)
    return [each for part in parts for each in part]


def _in_turn[T](calls: Sequence[Callable[[], T]]) -> list[T]:
    return [call() for call in calls]


def dealt[T](ranks: MPI.Intracomm, calls: Sequence[Callable[[], T]], same: Sequence[object] = ()) -> list[T]:
    """Results of all calls on every rank, each made by one of them. Collective; the calls must not communicate.

    ``same``: objects in the results that are not sent, but are each rank's own.

    Raises Exception: that of the lowest rank with a call that fails.
    """
    if ranks.size == 1:
        return _in_turn(calls)
    found: dict[int, T] = {}
    sent = b""
    with raise_on_all_ranks(ranks):
        found = {i: calls[i]() for i in range(ranks.rank, len(calls), ranks.size)}
        sent = packed(found, same)
    for rank, part in enumerate(ranks.allgather(sent)):
        if rank != ranks.rank:
            found |= unpacked(part, same)
    return [found[i] for i in range(len(calls))]
