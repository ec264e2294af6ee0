"""What `import softgrasp` gives: names that load nothing before they are used, and examples that run."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from pathlib import Path

import pytest

import softgrasp as sg

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


@pytest.mark.parametrize("name", sg.__all__)
def test_every_docstring_says_what_a_user_needs(name: str) -> None:
    """The equation first, units or shapes, errors, and a source that REFERENCES.md has."""
    value = getattr(sg, name)
    text = value.__doc__
    assert ("Raises:" in text) == (name not in ("Model", "Scene"))  # data that others make
    if isinstance(value, type) and name != "Scene":  # its keys say their units in the schema
        assert re.search(r"^    (Attributes|Args):$", text, re.MULTILINE)
    known = set(re.findall(r"\*\*\[(\w+)\]", (ROOT / "REFERENCES.md").read_text()))
    cited = {key for keys in re.findall(r"\[([A-Z][\w, ]*\d\d\w?)\]", text) for key in keys.split(", ")}
    assert cited <= known
    if name not in ("Scene", "Model", "load", "load_scene", "save"):  # what computes
        assert re.search(r" = |/ \|X\|", text.split(">>>")[0])
        assert cited or name in ("abscissa", "problem", "Controller", "design", "make_controller")  # definitions
