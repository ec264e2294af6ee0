from __future__ import annotations

import io
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from rich.console import Console

from softgrasp.fem import compiled
from softgrasp.study.shell import doctor, ending, processes


def script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No sign of an MPI job around us."""
    for name in processes.IN_MPI_JOB:
        monkeypatch.delenv(name, raising=False)


def test_this_environment_passes_every_look_but_memory() -> None:
    for name, look in doctor.CHECKS.items():
        if name not in ("memory", "two ranks"):
            check = look()
            assert check.ok, check
            assert check.name == name
            assert check.cure == ""


@pytest.mark.ranks
@pytest.mark.serial
@pytest.mark.usefixtures("alone")
def test_two_ranks_are_really_launched() -> None:
    assert doctor.check_launch() == doctor.Check("two ranks", True, "launched, found each other")


def test_no_launch_inside_a_job(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMI_RANK", "0")
    monkeypatch.setattr(doctor, "find_mpiexec", lambda: "/nonexistent/mpiexec")
    assert "already an MPI job" in doctor.check_launch().value


@pytest.mark.usefixtures("alone")
def test_singletons_of_another_mpi_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = 'case "$1" in --version) echo "mpiexec (OpenRTE) 4.1.4";; *) shift 2; "$@"; "$@";; esac'
    launcher = script(tmp_path / "mpiexec", text)
    monkeypatch.setattr(doctor, "find_mpiexec", lambda: launcher)
    monkeypatch.setattr(doctor, "SAY_SIZE", "import sys; sys.stdout.write('1\\n')")
    check = doctor.check_launch()
    assert not check.ok
    assert "another MPI" in check.cure
    check = doctor.check_launcher()
    assert not check.ok
    assert "Open MPI" in check.cure


@pytest.mark.usefixtures("alone")
def test_a_launcher_that_refuses_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    launcher = script(tmp_path / "mpiexec", "echo will not run as root; exit 3")
    monkeypatch.setattr(doctor, "find_mpiexec", lambda: launcher)
    check = doctor.check_launch()
    assert not check.ok
    assert check.value == "exit status 3: will not run as root"


@pytest.mark.usefixtures("alone")
def test_a_launcher_that_hangs_is_ended_with_its_children(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    launcher = script(tmp_path / "mpiexec", "sleep 60 & wait")
    monkeypatch.setattr(doctor, "find_mpiexec", lambda: launcher)
    monkeypatch.setattr(doctor, "LAUNCH_LIMIT", 0.2)
    start = time.monotonic()
    assert not doctor.check_launch().ok
    assert time.monotonic() - start < 30  # half of the sleep: the child held the pipe and was ended too


def test_the_launcher_beside_python_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folders = [tmp_path / "env", tmp_path / "system"]
    for folder in folders:
        folder.mkdir()
        script(folder / "mpiexec", "true")
    monkeypatch.setattr(sys, "executable", str(folders[0] / "python"))
    monkeypatch.setenv("PATH", str(folders[1]))
    assert doctor.find_mpiexec() == str(folders[0] / "mpiexec")
    (folders[0] / "mpiexec").unlink()
    assert doctor.find_mpiexec() == str(folders[1] / "mpiexec")
    (folders[1] / "mpiexec").unlink()
    assert doctor.find_mpiexec() is None
    assert "PATH" in doctor.check_launcher().cure


@pytest.mark.parametrize("value", ["2", None])
def test_threads(monkeypatch: pytest.MonkeyPatch, value: str | None) -> None:
    if value is None:
        monkeypatch.delenv("OMP_NUM_THREADS")
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert "OMP_NUM_THREADS=1" in doctor.check_threads().cure


def test_compiler_missing_or_without_headers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "no-such-compiler" in doctor.check_compiler().cure
    monkeypatch.setenv("CC", script(tmp_path / "cc", "exit 1"))
    assert "headers" in doctor.check_compiler().cure


def test_cache_that_cannot_be_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import dolfinx.jit

    (tmp_path / "file").touch()  # a folder below a file: refused to root as well
    options = {"cache_dir": tmp_path / "file" / "cache"}
    monkeypatch.setattr(dolfinx.jit, "get_options", lambda: options)
    assert "XDG_CACHE_HOME" in doctor.check_cache().cure


def test_complex_petsc_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from petsc4py import PETSc

    monkeypatch.setattr(PETSc, "ScalarType", complex)
    check = doctor.check_petsc()
    assert not check.ok
    assert "complex128" in check.value


def test_missing_stack_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dolfinx", None)  # import raises ModuleNotFoundError
    monkeypatch.setattr(doctor, "CHECKS", {"DOLFINx": doctor.check_dolfinx})
    (check,) = doctor.checks()
    assert not check.ok
    assert "softgrasp[solver]" in check.cure


@pytest.mark.parametrize("ok", [True, False])
def test_show_tells_the_cure_and_whether_all_is_well(monkeypatch: pytest.MonkeyPatch, ok: bool) -> None:
    check = doctor.Check("thing", ok, "value [1]", "" if ok else "Do 'softgrasp[solver]'.")
    monkeypatch.setattr(doctor, "CHECKS", {"thing": lambda: check})
    out = io.StringIO()
    assert doctor.show(Console(file=out, width=100)) is ok
    assert "value [1]" in out.getvalue()
    assert ("softgrasp[solver]" in out.getvalue()) is not ok
    assert os.linesep in out.getvalue()


def test_an_interrupted_program_takes_its_children_along(tmp_path: Path) -> None:
    """Ctrl-C reaches the program alone: what it started has a session of its own."""
    note = tmp_path / "child"
    shell = f"sleep 60 & echo $! > {note}.part; mv {note}.part {note}; wait"
    text = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which jobs of a shell ignore
    text += f"from softgrasp.study.shell.processes import run_limited; run_limited(['sh', '-c', {shell!r}], 50)"
    with subprocess.Popen([sys.executable, "-c", text], env=processes.child_environment()) as program:
        wait_for(note.exists)
        program.send_signal(signal.SIGINT)
        assert program.wait(10) != 0
    child = int(note.read_text())
    wait_for(lambda: not psutil.pid_exists(child) or psutil.Process(child).status() == psutil.STATUS_ZOMBIE)


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_warning_of_the_package_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a compiler a command says so as it says its errors; warnings of others keep their file and line."""
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(ending, "outlive_readers", lambda: None)  # pytest has no such streams
    monkeypatch.setattr(ending, "write_utf8", lambda: None)
    with warnings.catch_warnings():
        warnings.simplefilter("always")

        def command() -> None:
            compiled.functions.__wrapped__(Path("none.c"), "NumPy computes")
            warnings.warn("of another", RuntimeWarning, stacklevel=1)

        ending.run_command(command)
    own, other, *_ = capsys.readouterr().err.splitlines()
    assert own.startswith("warning: NumPy computes, for want of compiled code (there is no C compiler); install")
    assert other.startswith(__file__)
