"""Bases of several methods at all N: what the snapshots carry, and which rank or process makes which."""

from __future__ import annotations

from collections.abc import Sequence

from softgrasp.fem import Reduction
from softgrasp.reduction import Basis, Truncation, registry
from softgrasp.reduction.bases.states import BasisError, States

WHOLE_BYTES = 2.0**28  # of all snapshots up to which each rank or process holds their rows


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


def small(states: States) -> bool:
    """Whether there are snapshots, and so few that each rank or process may hold all that is made of them."""
    size = sum(16 * states.layout.n_e * snapshots.Z.shape[1] for _, snapshots in states.runs)
    return bool(0 < size <= WHOLE_BYTES)


def shares_of(names: Sequence[str], count: int = 2) -> list[list[str]]:
    """Methods for processes or ranks with about equal work; those that share a tall factor stay together.

    Those of no pairs, whose factor costs least again, come last in each share: who is done takes from its end.
    """
    groups: dict[object, list[str]] = {}
    for name in names:
        method = registry.find_method(name)
        groups.setdefault((method.snapshots, method.coordinates, method.frame, method.inner), []).append(name)
    if len(groups) < count:
        return [list(names[i::count]) for i in range(count)]

    def work(group: Sequence[str]) -> tuple[bool, int]:
        """Pairs, and about seconds with 6558 unknowns: a tall factor, and all sizes of a method."""
        methods = [registry.find_method(name) for name in group]
        several = [method.pairs and method.snapshots for method in methods]  # pairs have twice the columns
        return several[0], 3 * several[0] + 2 * methods[0].snapshots + sum(2 + each for each in several)

    shares: list[list[str]] = [[] for _ in range(count)]
    sums = [0] * count
    for group in sorted(groups.values(), key=work, reverse=True):
        least = sums.index(min(sums))
        shares[least] += group
        sums[least] += work(group)[1]
    return shares
