"""What `import softgrasp` gives: names that load nothing before they are used, and examples that run."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

import softgrasp as sg
from softgrasp._face import names_of
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.loop.full import LoopTrajectory
from softgrasp.lqr.plant.problem import RiccatiSolution
from softgrasp.reduction.model import ReducedModel

pytestmark = pytest.mark.serial
ROOT = Path(__file__).parents[1]


def test_import_loads_neither_mpi_nor_dolfinx() -> None:
    code = "import sys, softgrasp as sg; dir(sg); sg.Scene; print({'mpi4py.MPI', 'dolfinx'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr


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


DOCUMENTED = [sg.Scene, sg.Model, Trajectory, sg.Controller, ReducedModel, LoopTrajectory, Design, RiccatiSolution]
"""A docstring under each field."""


@pytest.mark.parametrize("value", DOCUMENTED)
def test_every_field_has_a_docstring(value: type) -> None:
    assert undocumented(inspect.getsource(value)) == []
    assert undocumented('class A:\n    a: int  # one\n    b: int\n    """Two."""\n    c: int') == ["a", "c"]


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
