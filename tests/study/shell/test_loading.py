"""What the start of a command leaves out, and that it is there for who asks."""

import gc
import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from softgrasp.fem import _stack
from softgrasp.study.shell.loading import PLUGINS, loading

STARTED = """
import gc, importlib.metadata, os, sys
def read(*_, **__):
    raise AssertionError("the metadata of all packages were read")
importlib.metadata.distributions = importlib.metadata.entry_points = read
from typer.testing import CliRunner
from softgrasp.study.cli import app
line = ["simulate", "paper_forward", "--no-pictures", "--set", "tissue.cells=[2,4]", "--set", "time.steps=4"]
done = CliRunner().invoke(app, [*line, "--out", sys.argv[1]])
assert done.exit_code == 0, done.output
assert gc.isenabled()
assert "PYDANTIC_DISABLE_PLUGINS" not in os.environ
print(*sorted({"numpy.f2py", "numpy.testing", "h5py", "matplotlib", "PIL"} & set(sys.modules)))
import numpy
assert numpy.ma.masked_less([1, 2], 2).sum() == 2
assert numpy.f2py.__name__ == "numpy.f2py" and numpy.testing.assert_allclose
"""


@pytest.mark.serial
def test_a_run_loads_no_part_that_it_does_not_use(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", STARTED, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.strip()


@pytest.mark.serial
@pytest.mark.parametrize("given", [None, "logfire"])
def test_all_is_as_before_where_an_import_fails(given: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    if given is None:
        monkeypatch.delenv(PLUGINS, raising=False)
    else:
        monkeypatch.setenv(PLUGINS, given)
    on = []
    with pytest.raises(ModuleNotFoundError), loading():
        on.extend([gc.isenabled(), os.environ[PLUGINS]]) or importlib.import_module("softgrasp.no_such_module")
    assert [*on, gc.isenabled(), os.environ.get(PLUGINS)] == [False, given or "__all__", True, given]


@pytest.mark.serial
@pytest.mark.parametrize(
    "other", ["petsc4py-3.25.0.dist-info", "SLEPc-3.25.egg-info", "dolfinx_solver_complex-0.11.dist-info"]
)
def test_a_second_petsc_is_seen_by_the_names_of_folders(
    other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("petsc4py/__init__.py", "dolfinx_solver/__init__.py"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    (tmp_path / "dolfinx_solver_real-0.11.0.dist-info").mkdir()
    specs = {
        name: importlib.util.spec_from_file_location(name, tmp_path / name / "__init__.py")
        for name in ("petsc4py", "dolfinx_solver")
    }
    monkeypatch.setattr(importlib.util, "find_spec", specs.get)
    assert _stack.first_module() == "mpi4py.MPI"
    (tmp_path / other).mkdir()
    assert _stack.first_module() == "dolfinx_solver"  # which refuses to go on
    (tmp_path / other).rmdir()
    specs["petsc4py"] = importlib.util.spec_from_file_location("petsc4py", tmp_path.parent / "petsc4py" / "__init__.py")
    assert _stack.first_module() == "dolfinx_solver"
