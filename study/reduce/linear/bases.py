"""Bases of several methods at all N: what the snapshots carry, and which rank or thread makes which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from mpi4py import MPI

from softgrasp.fem import Reduction
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.reduction import Basis, Truncation, registry
from softgrasp.reduction.bases.aside import cores, in_threads
from softgrasp.reduction.bases.states import BasisError, States, whole_states

WHOLE_BYTES = 2.0**28  # of all snapshots up to which each rank holds their rows and makes bases by itself


def bases_of(
    name: str, states: States, sizes: list[int], options: Reduction, refused: dict[int, str]
) -> tuple[tuple[Basis, ...], int | None]:
    """Bases at all sizes that the snapshots carry, and the columns that keep the scene's share of the energy.

    What does not fit is put into ``refused`` by its N, with the reason. Collective.
    """
    method, n_s = registry.find_method(name), states.system.layout.n_s
    inner = None if options.inner == "auto" or not method.snapshots else options.inner
    rule = [Truncation(energy=options.energy)] if method.snapshots else []
    refused |= registry.impossible_sizes(method, n_s, sizes)
    sizes = registry.possible_sizes(method, n_s, sizes)
    while sizes or rule:
        try:
            bases = registry.make_bases(name, states, [*sizes, *rule], inner, options.engine)
        except BasisError as error:
            most = error.most
            larger = [N for N in sizes if most is not None and most < N]
            if not larger and rule:
                rule = []  # it may be the share that fails; what fails in general fails again
                continue
            limit = "the snapshots carry above rounding" if method.snapshots else "this mesh has modes for"
            reason = f"more than {limit}; request N <= {most}" if larger else error.reason
            refused |= dict.fromkeys(larger or sizes, reason)
            sizes = [N for N in sizes if larger and N not in larger]
        else:
            return bases[: len(sizes)], bases[-1].N if rule else None
    return (), None


Made = tuple[tuple[Basis, ...], int | None, dict[int, str]]
"""Bases of one method, the columns that keep the scene's share of the energy, and the sizes refused."""


def made_apart(tasks: Sequence[tuple[str, list[int]]], states: States, options: Reduction) -> dict[str, Made]:
    """Bases of several methods, each made by one rank alone, with all rows of small snapshots. Collective.

    A rank that is alone makes them by threads. Left out, because all ranks make them together later: everything for
    large snapshots or on one core, and methods that use more than snapshots and matrices.

    ``tasks``: names and sizes.

    Raises SolverError: a factorisation failed.
    """
    comm, layout = states.layout.comm, states.layout
    size = sum(16 * layout.n_e * snapshots.Z.shape[1] for _, snapshots in states.runs)
    apart = [(name, sizes) for name, sizes in tasks if name in registry.METHODS and registry.METHODS[name].snapshots]
    few = comm.size * (cores() if MPI.COMM_WORLD.size == 1 else 1) == 1  # threads beside ranks would share their cores
    if comm.bcast(few) or len(apart) < 2 or not 0 < size <= WHOLE_BYTES:
        return {}
    # pairs factor twice as many columns: they are dealt first
    apart.sort(key=lambda task: not registry.METHODS[task[0]].pairs)
    whole, made = whole_states(states) if comm.size > 1 else states, dict[str, Made]()

    def make(name: str, sizes: list[int]) -> Made:
        refused: dict[int, str] = {}
        return *bases_of(name, whole, sizes, options, refused), refused

    own = apart[comm.rank :: comm.size]
    with raise_on_all_ranks(comm):
        if comm.size == 1:
            results = in_threads([partial(make, *task) for task in own])
        else:
            results = [make(*task) for task in own]
        made = {name: result for (name, _), result in zip(own, results, strict=True)}
    if comm.size == 1:
        return made
    return {name: _dealt(layout, made.get(name), i % comm.size) for i, (name, _) in enumerate(apart)}


def _dealt(layout: BlockLayout, made: Made | None, owner: int) -> Made:
    """The local rows of bases whose rows are all on one rank. Collective."""
    starts, parts = layout.comm.allgather((layout.start, layout.n_local)), None
    nowhere: Any = None  # a communicator cannot be sent
    if made is not None:
        bases, *about = made
        parts = [
            (tuple(replace(b, layout=nowhere, V_q=b.V_q[i : i + n], V_p=b.V_p[i : i + n]) for b in bases), *about)
            for i, n in starts
        ]
    bases, kept, refused = layout.comm.scatter(parts, root=owner)
    return tuple(replace(b, layout=layout) for b in bases), kept, refused
