"""What holds for the whole source tree: sizes, references, and a wheel that carries every package."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("fem", "reduction", "lqr", "study")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MODULE_LINES, FUNCTION_LINES = 400, 60  # what a reader holds in mind


@pytest.mark.serial
def test_modules_and_functions_are_small() -> None:
    long = [str(p.relative_to(ROOT)) for p in SOURCES if len(p.read_text().splitlines()) > MODULE_LINES]
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                if body and (body[-1].end_lineno or 0) - body[0].lineno + 1 > FUNCTION_LINES:
                    long.append(f"{path.relative_to(ROOT)}: {node.name}")
    assert long == []


@pytest.mark.serial
def test_keys_of_references_exist() -> None:
    text = (ROOT / "REFERENCES.md").read_text()
    known = set(re.findall(r"\*\*\[?([A-Za-z]\w+)\]?\*\*", text))
    cited = {
        key
        for path in SOURCES
        for key in re.findall(r"\[([A-Z][A-Za-z]*\d{2,4}[a-z]?)\]", path.read_text())
        if not re.fullmatch(r"[A-Z]\d+", key)
    }
    assert cited <= known, cited - known


@pytest.mark.serial
def test_no_path_of_a_machine_in_the_tree() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    private = re.compile(r"(?<![\w.])/(work|root|home)/\w")
    found = []
    for name in listed.stdout.split():
        path = ROOT / name
        if path.suffix in {".py", ".toml", ".md", ".sh", ".cff", ".yml", ""} and path.is_file():
            found += [f"{name}: {line}" for line in path.read_text().splitlines() if private.search(line)]
    assert [line for line in found if "re.compile" not in line] == []


@pytest.mark.serial
def test_wheel_holds_every_module_and_does_not_ask_for_a_solver(tmp_path: Path) -> None:
    """A cluster's own DOLFINx must not be shadowed: the wheel depends on no solver stack unless asked."""
    source = tmp_path / "source"  # building leaves files behind
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(n for n in names if n.endswith("METADATA"))).decode()
    assert {str(p.relative_to(ROOT)) for p in SOURCES} <= names
    needed = re.findall(r"^Requires-Dist: ([\w.-]+)[^;\n]*$", metadata, re.MULTILINE)
    assert "numpy" in needed
    assert not {"dolfinx-solver-real", "mpich", "fenics-dolfinx", "petsc4py"} & set(needed)
