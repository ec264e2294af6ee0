"""Cases that break the textbook way, each with the bound that softgrasp has to keep."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.progress import MofNCompleteColumn

from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.shell import Session, folder_lock
from tests.hardcases import certified, contact, estimates, faults, loops, motion, plans, reduction, riccati, statics
from tests.hardcases.cases import Family, FamilyResult, HardCaseResult
from tests.hardcases.page import compose, show

MODULES: Any = (statics, estimates, motion, contact, reduction, certified, riccati, loops, plans, faults)
FAMILIES: dict[str, Family] = {family.name: family for module in MODULES for family in module.FAMILIES}


def choose(family: str | None) -> list[Family]:
    """The families to run. Raises SoftgraspError: there is no family of this name."""
    if family is not None and family not in FAMILIES:
        raise SoftgraspError(f"'{family}' is no family of hard cases; there are {', '.join(FAMILIES)}")
    return [chosen for name, chosen in FAMILIES.items() if family in (None, name)]


def run_family(family: Family, quick: bool) -> FamilyResult:
    """Run the cases of one family, or the quick half of them."""
    begin = time.perf_counter()
    cases = tuple(family.cases(quick))
    return FamilyResult(family, cases, time.perf_counter() - begin)


@folder_lock()
def run_hardcases(
    out: Path,
    console: Console,
    *,
    quick: bool = False,
    family: str | None = None,
    quiet: bool = False,
    pictures: bool = True,
    empty: bool = False,
) -> dict[str, Any]:
    """Run the cases, print one table a family, and write result.json, hardcases.csv, pictures and report.html.

    Raises SoftgraspError: the family is unknown, or the command was started under mpiexec.
    """
    if MPI.COMM_WORLD.size > 1:
        raise SoftgraspError("hardcases starts the ranks that it needs by itself; run it without mpiexec")
    families = choose(family)
    session = Session("hardcases", Path(), (), out, console, quiet, pictures, empty)
    session.claim("", tuple)
    results = []
    with session.progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("hard cases", total=len(families))
        for chosen in families:
            bar.update(task, description=chosen.title)
            results.append(run_family(chosen, quick))
            show(console, results[-1])
            bar.advance(task)
    result = HardCaseResult(tuple(results), quick)
    found = result.to_dict()
    session.write(None, found, lambda: compose(result, family, session), clock=False)
    return found
