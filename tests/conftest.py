"""pytest under mpiexec: all ranks agree on each outcome, and a stuck rank ends in Abort instead of a hang."""

from __future__ import annotations

from softgrasp.fem import _stack as _stack  # threads and MPI, before numpy and petsc4py

# isort: split
import gc
import os
import re
import resource
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

os.environ["MPLBACKEND"] = "Agg"  # before matplotlib: no test needs a display
for name in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL"):  # a test's own make must not ask for tokens of the make around us
    os.environ.pop(name, None)

OWN = MPI.COMM_WORLD.Dup()  # never matches the messages of a test
OUTCOMES = ("passed", "skipped", "failed")
SERIAL = {"study", "benchmarks", "hardcases"}  # rooms above lqr
MOST = 600  # [s] of a test, below faulthandler_timeout
LINES = 15  # of a failure, when it happens; all of it comes at the end
LIMIT = float(os.environ.get("MPI_TEST_LIMIT", "30"))  # [s] from one rank's failure to Abort


def _tell(text: str) -> None:
    sys.__stderr__.write(f"[rank {OWN.rank}] {text}\n")
    sys.__stderr__.flush()


def _outcomes(report: pytest.TestReport) -> list[str]:
    """Gather the outcome of each rank; Abort when this rank failed and the others do not come."""
    codes = np.zeros(OWN.size, dtype=np.int8)
    request = OWN.Iallgather(np.array([OUTCOMES.index(report.outcome)], dtype=np.int8), codes)
    start = time.monotonic()
    while not request.Test():
        if report.failed and time.monotonic() - start > LIMIT:
            _tell(f"{report.nodeid} failed here, other ranks are stuck:\n{report.longreprtext}")
            OWN.Abort(1)
        time.sleep(1e-3)
    return [OUTCOMES[code] for code in codes]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if OWN.size == 1:
        return report
    outcomes = _outcomes(report)
    if report.failed:
        if OWN.rank > 0:
            _tell(f"{item.nodeid} ({call.when})\n{report.longreprtext}")
    elif len(set(outcomes)) > 1:  # also a skip on some ranks only: they would part ways here
        report.outcome = "failed"
        report.longrepr = f"{call.when} differs by rank: {', '.join(outcomes)}"
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Name a failure when it happens: a run that is cut off later still says what failed."""
    if report.failed and OWN.rank == 0 and "PYTEST_XDIST_WORKER" not in os.environ:
        last = "\n".join(report.longreprtext.splitlines()[-LINES:])
        sys.__stderr__.write(f"\n{report.nodeid} ({report.when}) failed:\n{last}\n")
        sys.__stderr__.flush()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--queries", type=int, default=500, help="random queries of the slow test of certified models")
    parser.addoption("--seed", type=int, default=1, help="of the random queries")
    parser.addoption("--own-ranks", action="store_true", help="only tests whose mark names this number of ranks")


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    reporter = config.pluginmanager.getplugin("terminalreporter")
    if OWN.rank > 0 and reporter is not None:  # rank 0 speaks for all
        reporter._tw._file = open(os.devnull, "w")  # noqa: SIM115  (lives as long as the process)


def _named(item: pytest.Item) -> int | None:
    """Most ranks that the mark ``ranks`` of a test names, 3 where it names none; None where it leaves the test out."""
    mark = item.get_closest_marker("ranks")
    if mark is None:
        return None
    given = getattr(getattr(item, "callspec", None), "params", {})
    for name, wanted in mark.kwargs.items():
        if given[name] not in (wanted if isinstance(wanted, tuple) else (wanted,)):
            return None
    return int(mark.args[0]) if mark.args else 3


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not even import files none of whose tests run: on 3 ranks and with ``--own-ranks`` those without the mark."""
    own = config.option.own_ranks
    if not collection_path.name.startswith("test_") or not (OWN.size > 2 or own or "ranks" in config.option.markexpr):
        return None
    named = [int(n or 3) for n in re.findall(r"\bmark\.ranks\b(?:\((\d))?", collection_path.read_text())]
    return not any(n == OWN.size if own else n >= OWN.size for n in named) or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Most ranks of a test: 1 where marked serial, 3 where marked ranks, n where ranks(n); else 2, and 1 above lqr."""
    if config.option.own_ranks:
        found = [item for item in items if _named(item) == OWN.size]
        config.hook.pytest_deselected(items=[item for item in items if item not in set(found)])
        items[:] = found
    for item in items:
        most = _named(item) or (1 if SERIAL & set(item.path.relative_to(item.config.rootpath).parts) else 2)
        if item.get_closest_marker("serial"):
            most = 1
        if OWN.size > most:
            item.add_marker(pytest.mark.skip(reason=f"runs on at most {most} rank(s)"))


def pytest_collection_finish(session: pytest.Session) -> None:
    """What the imports made stays: without it the collection after each test looks through it every time."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """End a test that waits for another process by an error that names it, before pytest ends the whole process."""
    if OWN.size > 1:
        return (yield)

    def late(*_: object) -> None:
        raise TimeoutError(f"still running after {MOST} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(MOST)
    try:
        return (yield)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def _collect_petsc_objects() -> Iterator[None]:
    """Free collective objects at the same place on all ranks, after each test."""
    yield
    gc.collect()
    OWN.Barrier()


@pytest.fixture(autouse=True, scope="module")
def _keep_what_is_left() -> Iterator[None]:
    """What a module's tests have loaded stays: collections looked through it, half of the time of studies' tests."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture
def comm() -> MPI.Intracomm:
    return MPI.COMM_WORLD


@pytest.fixture
def mpi_tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One empty directory for all ranks."""
    return Path(OWN.bcast(str(tmp_path_factory.mktemp("mpi")) if OWN.rank == 0 else None))


@pytest.fixture
def small_files() -> Iterator[Callable[[int], None]]:
    """Limit the size of the files of this process."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
