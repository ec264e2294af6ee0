"""pytest under mpiexec: all ranks agree on each outcome, and a stuck rank ends in Abort instead of a hang."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401  (threads and MPI, before numpy and petsc4py)

# isort: split
import gc
import os
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

os.environ["MPLBACKEND"] = "Agg"  # before matplotlib: no test needs a display

OWN = MPI.COMM_WORLD.Dup()  # never matches the messages of a test
OUTCOMES = ("passed", "skipped", "failed")
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


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    reporter = config.pluginmanager.getplugin("terminalreporter")
    if OWN.rank > 0 and reporter is not None:  # rank 0 speaks for all
        reporter._tw._file = open(os.devnull, "w")  # noqa: SIM115  (lives as long as the process)


# Thousands of small collective calls: minutes on more ranks than cores. Three ranks run their tests of ranks alone.
CHATTY = {
    "test_fem_effects", "test_fem_effect_gates", "test_lqr_large", "test_lqr_parts", "test_lqr_reduced",
    "test_lqr_second_order", "test_lqr_spectrum", "test_lqr_tail", "test_reduction_model", "test_reduction_online",
    "test_reduction_pymor", "test_reduction_snapshots", "test_study_bench", "test_study_cli",
    "test_study_control", "test_study_effects", "test_study_explain", "test_study_hardcases", "test_study_loop_plots",
    "test_study_plots", "test_study_reduce", "test_study_reduce_tables", "test_study_report", "test_study_simulate",
    "test_study_work", "test_study_work_control", "test_study_work_tolerance",
}  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if OWN.size > 1 and item.get_closest_marker("serial"):
            item.add_marker(pytest.mark.skip(reason="runs on one rank only"))
        elif OWN.size > 2 and item.path.stem in CHATTY and "rank" not in item.name.partition("[")[0]:
            item.add_marker(pytest.mark.skip(reason="runs on one and two ranks"))


def pytest_collection_finish(session: pytest.Session) -> None:
    """What the imports made stays: without it the collection after each test looks through it every time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _collect_petsc_objects() -> Iterator[None]:
    """Free collective objects at the same place on all ranks, after each test."""
    yield
    gc.collect()
    OWN.Barrier()


@pytest.fixture
def comm() -> MPI.Intracomm:
    return MPI.COMM_WORLD


@pytest.fixture
def mpi_tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One empty directory for all ranks."""
    return Path(OWN.bcast(str(tmp_path_factory.mktemp("mpi")) if OWN.rank == 0 else None))
