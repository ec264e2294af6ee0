"""What `import softgrasp` gives: names that load nothing before they are used, and examples that run."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

import softgrasp as sg
from softgrasp._face import names_of
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.shown import Shown
from softgrasp.lqr.loop.full import LoopTrajectory
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.errors import ModelErrors
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.strain.model import StrainModel, StrainRun
from softgrasp.reduction.strain.training import StrainErrors
from softgrasp.reduction.system import EnergySystem

pytestmark = pytest.mark.serial
ROOT = Path(__file__).parents[1]


def test_import_loads_neither_mpi_nor_dolfinx() -> None:
    code = "import sys, softgrasp as sg; dir(sg); sg.Scene; print({'mpi4py.MPI', 'dolfinx'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr


@pytest.mark.parametrize(("given", "threads"), [(None, 1), ("2", 2)])
def test_numpy_loaded_before_gets_one_thread_unless_the_user_asks_for_more(given: str | None, threads: int) -> None:
    """A small model on several threads takes three to seven times the processor time; threadpoolctl counts them."""
    pytest.importorskip("threadpoolctl")
    if (os.cpu_count() or 1) < threads:
        pytest.skip("one core")
    code = "import numpy, scipy.linalg, softgrasp as sg; from threadpoolctl import threadpool_info as info\n"
    code += "print(*(pool['num_threads'] for pool in info() if pool['internal_api'] == 'openblas'))"
    own = {key: value for key, value in os.environ.items() if key not in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    own |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=own, capture_output=True, text=True)
    assert set(done.stdout.split()) == {str(threads)}, done.stderr


def test_a_script_beside_the_checkout_imports_the_package(tmp_path: Path) -> None:
    (tmp_path / "softgrasp" / "fem").mkdir(parents=True)  # as a clone, whose own softgrasp lies deeper
    (tmp_path / "mine.py").write_text("import softgrasp as sg; print(sg.__version__)")
    done = subprocess.run([sys.executable, tmp_path / "mine.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.strip() == sg.__version__, done.stderr


def test_an_unknown_name_says_what_there_is() -> None:
    with pytest.raises(AttributeError, match=r"'simulat'; it has ClosedLoop, .*simulate"):
        sg.simulat  # noqa: B018


@pytest.mark.parametrize("name", sg.__all__)
def test_every_name_has_an_example_that_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    value = getattr(sg, name)
    (example,) = [e for e in doctest.DocTestFinder(recurse=False).find(value, name) if e.examples]
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert result.attempted > 1
    assert result.failed == 0


def undocumented(source: str) -> list[str]:
    """Public fields of a class without a docstring below them."""
    (cls,) = ast.parse(source).body
    assert isinstance(cls, ast.ClassDef)
    pairs = [(a, b) for a, b in pairwise([*cls.body, ast.Pass()]) if isinstance(a, ast.AnnAssign)]
    fields = [(ast.unparse(a.target), isinstance(getattr(b, "value", None), ast.Constant)) for a, b in pairs]
    return [name for name, documented in fields if not documented and not name.startswith("_")]


# Classes that modules import for their annotations only.
FOR_TYPES = {
    c.__name__: c for c in (sg.Scene, sg.Model, Trajectory, CertifiedModel, StrainModel, StrainRun, StrainErrors)
}


def returned(value: Any) -> set[type]:
    """Classes of the package in the annotation of a function's result; a class is its own."""
    if isinstance(value, type):
        return {value}
    value = getattr(value, "fget", None) or getattr(value, "func", None) or value  # properties
    if not inspect.isfunction(value) or not value.__module__.startswith("softgrasp."):
        return set()
    found, left = set(), [get_type_hints(value, localns=FOR_TYPES).get("return")]
    while left:
        hint = left.pop()
        left += get_args(hint)
        found |= {hint} if isinstance(hint, type) and hint.__module__.startswith("softgrasp.") else set()
    return found


def shown_to_users() -> list[type]:
    """Classes that the names of the package return, those that their methods return, and the bases of both."""
    first = {c for name in sg.__all__ for c in returned(getattr(sg, name))}
    then = {d for c in first for name, value in inspect.getmembers(c) if name[0] != "_" for d in returned(value)}
    every = {base for c in first | {d for d in then if issubclass(d, Shown)} for base in c.__mro__}
    return sorted((c for c in every if c.__module__.startswith("softgrasp.")), key=lambda c: c.__name__)


DOCUMENTED = shown_to_users()
"""A docstring under each field."""


@pytest.mark.parametrize("value", DOCUMENTED)
def test_every_field_has_a_docstring(value: type) -> None:
    assert undocumented(inspect.getsource(value)) == []
    assert undocumented('class A:\n    a: int  # one\n    b: int\n    """Two."""\n    c: int') == ["a", "c"]


def test_what_users_get_is_found() -> None:
    least = {sg.Scene, sg.Model, Trajectory, ReducedModel, StrainModel, StrainRun, ModelErrors, StrainErrors}
    assert least | {sg.Controller, LoopTrajectory, EnergySystem} <= set(DOCUMENTED)


@pytest.mark.parametrize("name", sg.__all__)
def test_every_docstring_says_what_a_user_needs(name: str) -> None:
    """The equation first, units or shapes, errors, and a source that REFERENCES.md has."""
    value = getattr(sg, name)
    text = value.__doc__
    assert ("Raises:" in text) == (name not in ("Model", "Scene"))  # data that others make
    if isinstance(value, type) and value not in DOCUMENTED:
        assert re.search(r"^    (Attributes|Args):$", text, re.MULTILINE)
    known = set(re.findall(r"\*\*\[(\w+)\]", (ROOT / "REFERENCES.md").read_text()))
    cited = {key for keys in re.findall(r"\[([A-Z][\w, ]*\d\d\w?)\]", text) for key in keys.split(", ")}
    assert cited <= known
    if name not in ("Scene", "Model", "load", "load_scene", "save"):  # what computes
        assert re.search(r" = |/ \|X\|", text.split(">>>")[0])
        assert cited or name in (
            "abscissa",
            "problem",
            "Controller",
            "design",
            "make_controller",
            "sweep",
            "Term",
        )  # definitions


FACES = [
    f"softgrasp.{name}"
    for name in ("fem", "reduction", "lqr", *(f"study.{room}" for room in ("report", "pictures", "shell")))
]


@pytest.mark.parametrize("package", FACES)
def test_a_package_gives_its_names_when_they_are_used(package: str) -> None:
    """Each is that of its module, and none is called like a module of the package, which an import would put there."""
    module = importlib.import_module(package)
    names = names_of(str(module.__file__))
    assert len(names) > 5
    assert set(names) <= set(dir(module))
    for name, at in names.items():
        origin = importlib.import_module(at)
        assert getattr(module, name) is getattr(origin, name)
    folder = Path(str(module.__file__)).parent
    assert not set(names) & {path.stem for path in folder.iterdir()} - {"style"}
    with pytest.raises(AttributeError, match=r"no attribute 'Sceen'"):
        module.Sceen  # noqa: B018


def test_a_face_loads_only_what_is_used() -> None:
    code = "import sys; from softgrasp.fem import Scene; print({'mpi4py.MPI', 'dolfinx'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr
