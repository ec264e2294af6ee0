"""Every effect beside all others that are advised: which show there, which only together, which exclude each other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

from softgrasp.fem import EFFECTS, SolverError
from softgrasp.study.effects.experiments import Names, SwitchRuns
from softgrasp.study.effects.result import Change, JointChange, Shown

Changes = dict[str, tuple[Change, float | None]]  # of the outputs, and under a force


class Rival(NamedTuple):
    """Which effect is advised in place of one that changes the outputs as well."""

    name: str  # name of the effect
    why: str  # what the scene's validation says of both


@dataclass(frozen=True)
class JointAdvice:
    """All effects tried again."""

    on: tuple[str, ...]  # effects that are advised, those that cannot be tried as they are
    beside: tuple[str, ...]  # those of them that were on when the company of each was measured
    company: dict[str, JointChange]  # of each effect that was tried
    rivals: dict[str, Rival]  # effects that show, but give way to another


JointChanges = dict[str, Shown]


def rivals_of(runs: SwitchRuns, needed: Names, changes: Changes) -> dict[str, Rival]:
    """Of the needed effects that the scene does not allow together, those that change less."""
    kept, rivals = runs.on, dict[str, Rival]()
    for name in sorted(needed - runs.on, key=lambda name: -changes[name][0].outputs):
        if why := runs.refusal(kept | {name}):
            other = next(p for p in sorted(kept - runs.on) if not runs.refusal((kept - {p}) | {name}))
            rivals[name] = Rival(other, why)
        else:
            kept |= {name}
    return rivals


def advised(runs: SwitchRuns, needed: Names, changes: Changes) -> JointAdvice:
    """Judge every effect that was tried again beside all that are advised. Collective.

    ``needed`` show in the scene as it is. Finite strain on trial comes last, with one run: beside other effects it is
    dear and may leave its law.
    """
    tolerance, rivals = runs.scene.study.tolerance, rivals_of(runs, needed, changes)
    apart = frozenset({"finite_strain"}) - runs.on
    tried = tuple(name for name in changes if name not in apart and name not in rivals)
    apart = (apart & frozenset(changes)) - frozenset(rivals)
    later = needed & apart
    on, company = advised_together(runs, tried, (needed - frozenset(rivals)) - apart, tolerance, later)
    for name in tried:
        if name not in on and name in company and company[name].partners and (why := runs.refusal(on | later | {name})):
            rivals[name] = Rival(next(iter(later)), why)
    last = frozenset[str]()
    for name in apart:
        company[name] = finite_strain_beside(runs, name, changes[name], on)
        if name in needed or company[name].partners:
            last = apart
    return JointAdvice(_ordered(on | last), _ordered(on), company, rivals)


def _ordered(on: Names) -> tuple[str, ...]:
    return tuple(name for name in EFFECTS if name in on)


def advised_together(
    runs: SwitchRuns, tried: tuple[str, ...], needed: Names, tolerance: float, later: Names = frozenset()
) -> tuple[Names, dict[str, JointChange]]:
    """Judge every effect again with all advised effects on, until no further one shows. Collective.

    An effect that does not show in the scene as it is joins when it shows beside those advised so far; then two that
    show only as a pair do. ``tried`` can be switched; ``needed`` of them show in the scene as it is; ``later`` are
    advised without being on here, so nothing joins that the scene does not take beside them.
    """
    on = needed | (runs.on - frozenset(tried))
    joined: JointChanges = {}

    def free(*names: str) -> bool:
        return on.isdisjoint(names) and not runs.refusal(on | frozenset(names) | later)

    def next_ones() -> JointChanges:
        return _singles(runs, tried, on, [name for name in tried if free(name)], tolerance) or _pair(
            runs, tried, on, [pair for pair in combinations(tried, 2) if free(*pair)], tolerance
        )

    while new := next_ones():
        new = dict([*new.items()][:1]) if runs.refusal(on | frozenset(new) | later) else new
        on |= frozenset(new)
        joined |= new
    shut = [name for name in tried if name not in on and not runs.refusal(on | {name}) and not free(name)]
    joined |= _singles(runs, tried, on, shut, tolerance)
    return on, {
        name: JointChange(
            **vars(joined.get(name, Shown())), change=runs.change(on, other), control=runs.control(on, other)
        )
        for name, other in ((name, on ^ {name}) for name in tried)
        if not runs.refusal(other)
    }


def _switched(runs: SwitchRuns, tried: tuple[str, ...], on: Names, but: Names) -> tuple[str, ...]:
    """What is switched in the scene as it is where these are on, apart from the effects in question."""
    return tuple(p for p in tried if p not in but and (p in on) != (p in runs.on))


def _singles(runs: SwitchRuns, tried: tuple[str, ...], on: Names, names: list[str], tolerance: float) -> JointChanges:
    """Effects that show beside those that are on, with a partner that brings them out, or all. Collective."""
    joined: JointChanges = {}
    for name in names:
        if (change := runs.shows(on, on | {name}, tolerance)) is None:
            continue
        others = _switched(runs, tried, on, frozenset({name}))
        for p in sorted(others, key=lambda p: (runs.on ^ {p}, True) not in runs.runs):  # those first that ran pushed
            if (near := runs.shows(runs.on ^ {p}, runs.on ^ {p, name}, tolerance)) is not None:
                others, change = (p,), near
                break
        joined[name] = Shown(others, False, (), *change)
    return joined


def _pair(
    runs: SwitchRuns, tried: tuple[str, ...], on: Names, pairs: list[tuple[str, str]], tolerance: float
) -> JointChanges:
    """The first two effects that show together and not one by one, one of them if both are on. Collective."""
    for a, b in pairs:
        if (change := runs.shows(on, on | {a, b}, tolerance)) is None:
            continue
        among = _switched(runs, tried, on, frozenset({a, b}))
        if among and (alone := runs.shows(runs.on - {a, b}, runs.on | {a, b}, tolerance)) is not None:
            among, change = (), alone
        first = {a: Shown((b,), True, among, *change)}
        return first if {a, b} <= runs.on else first | {b: Shown((a,), True, among, *change)}
    return {}


def finite_strain_beside(runs: SwitchRuns, name: str, alone: tuple[Change, float | None], on: Names) -> JointChange:
    """Finite strain on trial beside all advised effects, one run more; alone where it fails there. Collective."""
    if on == runs.on or runs.refusal(on | {name}):
        return JointChange(change=alone[0], control=alone[1])
    try:
        change = runs.change(on, on | {name})
    except SolverError:
        return JointChange(change=alone[0], control=alone[1])
    if alone[0].outputs <= runs.scene.study.tolerance < change.outputs:
        return JointChange(tuple(sorted(on ^ runs.on)), together=change.outputs, change=change, control=alone[1])
    return JointChange(change=change, control=alone[1])
