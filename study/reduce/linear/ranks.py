"""Work that ranks with the whole model each divide, without a message in it: methods, parameters and repeats."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
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
    """Results of the calls of all shares, one for each rank; who is done with its own goes on with others' last ones.

    On one rank a forked process begins with a second share; ranks of several nodes keep to their own. Collective; the
    calls must not communicate. ``same``, Raises: as in :func:`dealt`.
    """
    if ranks.size == 1:
        own, *beside = shares
        return shared(own, [call for share in beside for call in share], same)
    calls = [call for share in shares for call in share]
    owners = [rank for rank, share in enumerate(shares) for _ in share]
    order = sorted(range(len(calls)), key=lambda i: (owners[i] != ranks.rank, i if owners[i] == ranks.rank else -i))
    return _first_come(ranks, calls, owners, order, same)


def dealt[T](ranks: MPI.Intracomm, calls: Sequence[Callable[[], T]], same: Sequence[object] = ()) -> list[T]:
    """Results of all calls on every rank; a rank takes the next one as soon as it is done with the one before.

    The longest should come first. Collective; the calls must not communicate.

    ``same``: objects in the results that are not sent, but are each rank's own.

    Raises Exception: that of the lowest rank with a call that fails.
    """
    if ranks.size == 1:
        return [call() for call in calls]
    return _first_come(ranks, calls, [i % ranks.size for i in range(len(calls))], range(len(calls)), same)


def _first_come[T](
    ranks: MPI.Intracomm,
    calls: Sequence[Callable[[], T]],
    owners: Sequence[int],
    order: Sequence[int],
    same: Sequence[object],
) -> list[T]:
    """Results of all calls on every rank. Collective.

    Args:
        owners: the rank of each call, where ranks cannot ask each other.
        order: in which this rank takes calls.
    """
    found: dict[int, T] = {}
    sent = b""
    with _taking(ranks, owners) as take, raise_on_all_ranks(ranks):
        found = {i: calls[i]() for i in order if take(i)}
        sent = packed(found, same)
    for rank, part in enumerate(ranks.allgather(sent)):
        if rank != ranks.rank:
            found |= unpacked(part, same)
    return [found[i] for i in range(len(calls))]


@contextmanager
def _taking(ranks: MPI.Intracomm, owners: Sequence[int]) -> Iterator[Callable[[int], bool]]:
    """A function that takes a call, by its number, unless another rank has taken it. Collective.

    Numbers in memory that ranks share count how often each was asked for: no rank waits for another. Without such
    memory a rank takes what is its own.

    ``owners``: rank of each call.
    """
    node = ranks.Split_type(MPI.COMM_TYPE_SHARED)
    together = node.size == ranks.size
    node.Free()
    if not together:
        yield lambda i: owners[i] == ranks.rank
        return
    one, before = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    window = MPI.Win.Allocate_shared(one.nbytes * len(owners) * (ranks.rank == 0), one.nbytes, comm=ranks)
    if ranks.rank == 0:
        np.frombuffer(window.Shared_query(0)[0], dtype=np.int64)[:] = 0
    ranks.Barrier()
    window.Lock_all()

    def take(i: int) -> bool:
        window.Fetch_and_op(one, before, 0, i)
        window.Flush(0)
        return not before[0]

    try:
        yield take
    except Exception:  # on all ranks
        window.Unlock_all()
        window.Free()
        raise
    window.Unlock_all()
    window.Free()
