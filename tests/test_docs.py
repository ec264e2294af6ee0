"""The documentation builds without a warning, and what its pages tell a reader to type works."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

import softgrasp as sg
from softgrasp.fem.errors import Interrupted
from softgrasp.fem.scene.file import find_scene, load_scene
from softgrasp.study.cli import app

pytestmark = pytest.mark.serial
ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TINY = {"cells": ["tissue.cells=[3,6]"], "steps": ["time.steps=20", "output.frames=4"]}
RUN = ("simulate", "explain", "scenes", "materials", "schema", "new", "list", "compare", "view", "sweep")  # cheap ones
"""Commands that are run as the pages have them, on tiny meshes; the others are read with their keys."""


def blocks(language: str) -> list[tuple[str, str]]:
    """Pages and fenced blocks of a language, ids for pytest."""
    found = []
    for page in PAGES:
        fences = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
        found += [(f"{page.relative_to(ROOT)}:{i}", text) for i, (kind, text) in enumerate(fences) if kind == language]
    return found


def commands() -> dict[str, list[str]]:
    """Every softgrasp command of the pages, in fenced blocks, with the pages that have it in their order."""
    found: dict[str, list[str]] = {}
    for page, text in [*blocks("sh"), *blocks("")]:
        for line in text.splitlines():
            line = re.sub(r"\s+#.*", "", line)
            if match := re.match(r"(?:mpiexec -n \d+ )?softgrasp (.+)", line):
                found.setdefault(match[1].strip(), []).append(page)
    return found


COMMANDS = commands()
PYTHON = [(name, text) for name, text in blocks("python") if not name.startswith("README")]  # see test_demos


def test_there_is_something_to_test() -> None:
    assert len(COMMANDS) > 25
    assert len(PYTHON) > 8


@pytest.mark.parametrize("line", COMMANDS)
def test_command_has_real_options_scenes_and_keys(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(line)
    name, rest = words[0], words[1:]
    if name.startswith("--"):
        return  # an option of the program, run below
    command = typer.main.get_command(app).commands[name]  # type: ignore[attr-defined]
    context = command.make_context(name, rest, resilient_parsing=False)
    scene = context.params.get("scene")
    if scene is not None and str(scene) not in ("block.toml", "strip.toml"):
        load_scene(find_scene(scene), context.params.get("set_") or [])


def test_cheap_commands_run_as_they_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the pages: later commands look at what earlier ones left."""
    monkeypatch.chdir(tmp_path)
    (strip,) = [text for name, text in PYTHON if "strip.vtu" in text]
    exec(compile(strip, "mesh.md", "exec"), {})
    done = set()
    for line in COMMANDS:
        words = shlex.split(line)
        own = "strip.toml" in words  # a reader's own mesh: reduced and controlled too
        if (words[0] not in RUN and not own) or (words[0] == "view" and "--save" not in words):
            continue
        extra = []
        if own and words[0] in ("reduce", "control"):
            changes = ["time.steps=60", "reduction.methods=['craig_bampton']", "reduction.N=[14]", "reduction.train=[]"]
            changes = changes if words[0] == "reduce" else ["control.N=[8]"]
            extra = ["--no-pictures", *(word for change in changes for word in ("--set", change))]
        if words[0] in ("simulate", "sweep", "explain"):
            boxed = not re.search("pillow|accurate|franka|layers|strip.toml|block.toml", line)
            changes = [*TINY["cells"] * boxed, *TINY["steps"]]
            if "accurate" in line:
                changes += ["tissue.refine.tolerance=0.5"]
            if "--until" in line or "--resume" in line:
                changes = ["tissue.cells=[3,6]", "time.steps=220", "output.frames=4"]
            extra = [word for change in changes for word in ("--set", change)]
            extra += ["--no-pictures"] * (words[0] != "explain")
        result = CliRunner().invoke(app, [*words, *extra])
        stopped = "--until" in words and isinstance(result.exception, Interrupted)
        assert stopped or result.exit_code == 0, f"softgrasp {line}: {result.output[-600:]} {result.exception}"
        done.add(words[0])
    assert {*RUN, "reduce", "control"} - {"schema"} <= done
    controller = sg.Controller.load("out/strip-control/controller.npz")
    assert controller.plant.lti().under(controller.K).to_control().poles().real.max() < 0


@pytest.mark.parametrize(("name", "text"), PYTHON, ids=[name for name, _ in PYTHON])
def test_python_of_a_page_runs(name: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from softgrasp.reduction.bases.registry import METHODS

    monkeypatch.chdir(tmp_path)
    known = dict(METHODS)
    try:
        exec(compile(text, name, "exec"), {"__name__": "__main__"})
    finally:
        METHODS.clear()
        METHODS.update(known)


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted((ROOT / "demos").glob("demo_*.py")), ids=lambda path: path.stem)
def test_tutorial_runs_as_a_notebook(script: Path, tmp_path: Path) -> None:
    """As a reader runs it: cell by cell in a kernel of this Python."""
    jupytext, nbclient = pytest.importorskip("jupytext"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    book = jupytext.read(script)
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    client = nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    client.execute(env=environment)
    assert all(cell.execution_count for cell in book.cells if cell.cell_type == "code" and cell.source.strip())


def test_pages_build_strictly(tmp_path: Path) -> None:
    """Links and anchors are checked; what the reader's browser loads lies beside the pages."""
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT), "no_proxy": "*"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr[-3000:]
    page = (tmp_path / "site" / "index.html").read_text()
    assert re.findall(r'<(?:script|link)[^>]+(?:src|href)="https?://', page) == []
    assert "<code>tissue.refine</code>" in (tmp_path / "site" / "scene.html").read_text()
    api = (tmp_path / "site" / "api.html").read_text()
    assert (tmp_path / "site" / "tutorials" / "forward.ipynb").stat().st_size > 1000
    assert all(f"sg.{name}" in api or f">{name}<" in api for name in sg.__all__), "api.md lacks a name of the face"


def test_make_targets_of_the_pages_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    used = {word for _, text in [*blocks("sh"), *blocks("")] for word in re.findall(r"^make (\w+)", text, re.MULTILINE)}
    assert used
    assert used <= targets
