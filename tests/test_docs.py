"""The documentation builds without a warning, and what its pages tell a reader to type works."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

import softgrasp as sg
from benchmarks.__main__ import app as bench_app
from softgrasp.fem.scene.file import find_scene, load_scene
from softgrasp.study.cli import app
from softgrasp.study.runs.start import new_scene
from tests.hardcases.__main__ import app as hardcases_app

pytestmark = pytest.mark.serial
ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# with cells of their own
MESHED = (
    "pillow_3d",
    "set_down_3d",
    "turn_over_3d",
    "reach_over_3d",
    "paper_accurate",
    "franka_muscle",
    "layers_2d",
    "strip.toml",
    "block.toml",
)
SMALL: dict[str, tuple[str, ...]] = {  # keys that make a command cheap; a later one wins
    "simulate": ("time.steps=20", "output.frames=4"),
    "sweep": ("time.steps=20", "output.frames=4"),
    "explain": ("time.steps=20",),
    "reduce": ("time.steps=60", "reduction.methods=['craig_bampton']", "reduction.N=[14]", "reduction.train=[]",
               "reduction.grid=2", "reduction.validation=0"),
    "control": ("control.N=[8]",),
}  # fmt: skip
OUTSIDE = {"benchmarks": bench_app, "tests.hardcases": hardcases_app}
DRAWS = ("simulate", "sweep", "reduce", "control")
LONG = ("study", "effects")  # run as they stand, with -m slow
ELSEWHERE = {  # what no test here can run, or what another one does
    r"make -C out/\w+ .*": "tests/reduction/export/test_plant.py",
    r"make \w+": "test_make_targets_of_the_pages_exist; .ci/run",
    r"apt install .*|conda env .*|docker .*": "they need a network and rights",
    r"(python3 -m venv|\.venv/bin/pip|env/bin/pip) .*": "tests/test_project.py installs the wheel",
    r"module load .*|export .*|srun .*|env/bin/softgrasp doctor|mu=.*|out=.*|\[ -d .*": "a cluster's",
    r"status=\$\?|if \[ .*; then|scontrol .*|fi|exit \$status": "test_an_array_job_waits_again_only_if_stopped",
}


def blocks(language: str) -> list[tuple[str, str]]:
    """Pages and fenced blocks of a language, ids for pytest."""
    found = []
    for page in PAGES:
        fences = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
        found += [(f"{page.relative_to(ROOT)}:{i}", text) for i, (kind, text) in enumerate(fences) if kind == language]
    return found


def commands() -> dict[str, list[str]]:
    """Every softgrasp command of the pages in fenced blocks, with the pages that have it, in their order."""
    found: dict[str, list[str]] = {}
    for page, line in lines():
        if match := re.match(r"((?:mpiexec -n \d+ )?softgrasp .+)", line):
            found.setdefault(match[1], []).append(page)
    return found


def lines() -> list[tuple[str, str]]:
    """Pages and lines of their fenced blocks of commands, without comments."""
    texts = [
        (page, line.split(" #")[0].split()) for page, text in [*blocks("sh"), *blocks("")] for line in text.split("\n")
    ]
    return [(page, " ".join(words)) for page, words in texts if words and not words[0].startswith("#")]


def inline() -> list[str]:
    """Commands with arguments in the sentences of the pages."""
    texts = (re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE) for page in PAGES)
    command = r"`((?:mpiexec -n \d+ )?softgrasp \w+ [^`]+|python\s-m\s(?:benchmarks|tests\.hardcases)\s[^`]+)`"
    return sorted({" ".join(found.split()) for text in texts for found in re.findall(command, text)})


COMMANDS = commands()
PYTHON = [(name, text) for name, text in blocks("python") if not name.startswith("README")]  # see test_demos


def test_there_is_something_to_test() -> None:
    assert len(COMMANDS) > 25
    assert len(inline()) > 8
    assert len(PYTHON) > 8


def test_every_line_of_a_block_is_run_or_says_where() -> None:
    known = re.compile("|".join(f"(?:{pattern})" for pattern in ELSEWHERE))
    assert [(page, line) for page, line in lines() if line not in COMMANDS and not known.fullmatch(line)] == []


@pytest.mark.parametrize("line", [*COMMANDS, *inline()])
def test_command_has_real_options_scenes_and_keys(line: str) -> None:
    words = shlex.split(re.sub(r"^mpiexec -n \d+ ", "", line))
    outside = words[0] == "python"  # of a checkout: python -m MODULE
    program, rest = (OUTSIDE[words[2]], words[3:]) if outside else (app, words[1:])
    command = typer.main.get_command(program)
    if hasattr(command, "commands"):
        command, rest = command.commands[rest[0]], rest[1:]
    context = command.make_context(line, rest, resilient_parsing=False)
    scene = context.params.get("scene")
    if scene is not None and str(scene) not in ("block.toml", "strip.toml"):
        load_scene(find_scene(scene), context.params.get("set_") or [])


def test_jobs_of_the_cluster_page_have_real_scenes_and_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What only a cluster starts: each scene loads with the keys that are set, the variables of the job filled in."""
    monkeypatch.chdir(tmp_path)
    new_scene(Path("block.toml"), solid=True)
    jobs = [line.partition("softgrasp ")[2] for _, line in lines() if line.startswith("srun ")]
    assert len(jobs) > 1
    for job in jobs:
        words = shlex.split(re.sub(r" \$resume", "", re.sub(r"\$\{mu\[\$\w+\]\}", "100", job)))
        command = typer.main.get_command(app).commands[words[0]]  # type: ignore[attr-defined]
        context = command.make_context(job, words[1:], resilient_parsing=False)
        load_scene(find_scene(context.params["scene"]), context.params.get("set_") or [])


def test_an_array_job_waits_again_only_if_stopped(tmp_path: Path) -> None:
    """The page's own script in bash, with a run and a queue that only say what they were asked for."""
    (job,) = [text for _, text in blocks("") if "scontrol" in text]
    assert all(text.startswith("#!/bin/bash\n") for _, text in blocks("") if "#SBATCH" in text)  # sbatch asks for it
    (tmp_path / "env" / "bin").mkdir(parents=True)
    folder = tmp_path / "sweep" / "2"
    stubs = f'srun() {{ echo "$@"; mkdir -p {folder}/$LEAVES; return $ENDS; }}\nscontrol() {{ echo "$@"; }}\n'

    def ended(leaves: str, ends: int, restarts: int) -> tuple[int, list[str]]:
        given = {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_JOB_ID": "7", "SLURM_RESTART_COUNT": str(restarts)}
        given |= {"SCRATCH": str(tmp_path), "HOME": str(tmp_path), "LEAVES": leaves, "ENDS": str(ends)}
        done = subprocess.run(["bash", "-c", stubs + job], env=os.environ | given, capture_output=True, text=True)
        assert done.stderr == ""
        return done.returncode, done.stdout.splitlines()

    status, said = ended("", 1, 0)  # refused, without a restart file
    assert (status, len(said)) == (1, 1)
    assert "tissue.material.mu=60 " in said[0]
    assert not said[0].endswith("--resume")
    assert ended("checkpoint", 1, 0)[1][1:] == ["requeue 7_2"]  # stopped
    status, said = ended("checkpoint", 0, 1)  # went on, and ended
    assert (status, len(said)) == (0, 1)
    assert said[0].endswith("--resume")
    assert len(ended("checkpoint", 1, 20)[1]) == 1  # not for ever


def small(words: list[str]) -> list[str]:
    """What makes a command cheap, as further words."""
    name, line = words[0], " ".join(words)
    keys = [*SMALL.get(name, ())]
    if name in SMALL and not any(scene in words for scene in MESHED):
        keys.append("tissue.cells=[3,6]")
    if "paper_accurate" in words:
        keys.append("tissue.refine.tolerance=0.5")
    if "--until" in words or "--resume" in words:
        keys[0] = "time.steps=220"
    if "finite_strain" in line and name == "reduce":
        keys = ["time.steps=40", "tissue.cells=[3,6]", "reduction.N=[8]"]
    extra = [word for key in keys for word in ("--set", key)] + ["--no-pictures"] * (name in DRAWS)
    if name == "identify" and "--suggest-markers" not in words:
        extra += ["--law", "linear"]  # fits at finite strain: tests/reduction/identify/test_laws.py
    return extra + ["--tolerance", "0.5"] * (name == "reduce" and "--tolerance" in words)


def effective(words: list[str]) -> list[str]:
    """The words without keys that are set again by a later one."""
    last = {word.split("=")[0]: i for i, word in enumerate(words) if words[i - 1] in ("--set", "-s")}
    lost = {i for i, word in enumerate(words) if words[i - 1] in ("--set", "-s") and last[word.split("=")[0]] != i}
    return [word for i, word in enumerate(words) if i not in lost and i + 1 not in lost]


class Shell:
    """One folder in which the commands of the pages run, on small meshes and in their order: later ones look at what
    earlier ones left."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.left = list(COMMANDS)
        self.done: list[tuple[str | None, list[str]]] = []

    def run_to(self, page: str) -> None:
        """Run what is left up to the last command that a page is the first to have."""
        own = [line for line in self.left if COMMANDS[line][0].split(":")[0] == page]
        while own and own[-1] in self.left:
            self.run(self.left.pop(0))

    def run(self, line: str) -> None:
        ranks = re.match(r"mpiexec -n (\d+) ", line)
        words = shlex.split(line[ranks.end() if ranks else 0 :])[1:]
        if " ".join(words).startswith(LONG):
            return
        words = effective(words + small(words))
        if (ranks and ranks[1], words) in self.done:
            return
        self.done.append((ranks and ranks[1], words))
        if ranks:
            launcher = Path(sys.executable).with_name("mpiexec")
            start = [str(launcher), "-n", ranks[1], sys.executable, "-m", "softgrasp.study.cli"]
            environment = os.environ | {"PYTHONPATH": str(ROOT)}
            ended = subprocess.run([*start, *words], env=environment, capture_output=True, text=True, timeout=200)
            assert ended.returncode == 0, f"{line}: {ended.stderr}"
            return
        result = CliRunner().invoke(app, words)
        blind = words[0] == "view" and "--save" not in words and "no display" in str(result.exception)
        assert blind or result.exit_code == 0, f"{line}: {result.output[-600:]} {result.exception}"


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    folder = tmp_path_factory.mktemp("shell")
    (folder / "demos").symlink_to(ROOT / "demos")
    (strip,) = [text for name, text in PYTHON if "strip.vtu" in text]
    before = Path.cwd()
    os.chdir(folder)
    try:
        exec(compile(strip, "mesh.md", "exec"), {})
    finally:
        os.chdir(before)
    return Shell(folder)


# the first page that has a command runs it, so that no test takes minutes on a loaded machine
FIRST = list(dict.fromkeys(pages[0].split(":")[0] for pages in COMMANDS.values()))


@pytest.mark.parametrize("page", FIRST)
def test_every_command_runs(page: str, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(shell.folder)
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    shell.run_to(page)


def test_pages_of_these_commands_are_whole(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(shell.folder)
    for name in FIRST:
        shell.run_to(name)
    assert shell.left == []
    for page in Path("out").rglob("report.html"):
        text, head = page.read_text(), page.read_text().split("<section")[0]
        assert 1 <= head.partition('class="summary"')[2].count("<p>") <= 4, f"{page}: a summary of some lines"
        assert re.search(r"<nav>\s*<a href", head), f"{page}: contents"
        assert {"Files", "Reproduce"} <= set(re.findall("<h2>(.*?)</h2>", text)), page
        assert all((page.parent / file).exists() for file in re.findall('<li><a href="(.*?)"', text)), page
        warned = json.loads((page.parent / "result.json").read_text()).get("warnings")
        assert not warned or 'class="warning"' in head or ">Warnings</h2>" in text, page
    controller = sg.Controller.load("out/strip-control/controller.npz")
    assert controller.plant.under(controller.K).to_control().poles().real.max() < 0
    assert Path("out/answer/report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in COMMANDS if line.removeprefix("softgrasp ").startswith(LONG)])
def test_long_command_runs_as_it_stands(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, shlex.split(line)[1:])
    assert result.exit_code == 0, f"{result.output[-600:]} {result.exception}"


@pytest.mark.parametrize(("name", "text"), PYTHON, ids=[name for name, _ in PYTHON])
def test_python_of_a_page_runs(name: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from softgrasp.reduction.bases.registry import METHODS

    for package in re.findall(r"^import (jax|torch|mujoco)$", text, re.MULTILINE):
        pytest.importorskip(package, reason=f"{package} is no dependency, and not installed here")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    known = dict(METHODS)
    try:
        exec(compile(text, name, "exec"), {"__name__": "__main__"})
    finally:
        METHODS.clear()
        METHODS.update(known)


BOOK = """# %% [markdown]
# # Does a cell show what it makes?

# %%
import matplotlib.pyplot as plt
import softgrasp as sg

run = sg.simulate(sg.build("paper_forward", ["tissue.cells=[2,4]", "time.steps=10"]))
print("one")
print("two")
run.plot()

# %%
plt.subplots()[1].plot(run.times, run.energy)

# %%
run
"""


def test_a_tutorial_shows_what_its_cells_print_draw_and_return(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one kernel; figures of the reader's own appear after one of ours, too."""
    for package in ("jupytext", "nbclient", "ipykernel"):
        pytest.importorskip(package)
    monkeypatch.syspath_prepend(ROOT / "tools")
    gallery = importlib.import_module("gallery")
    book = gallery.jupytext.reads(BOOK, fmt="py:percent")
    gallery.execute(book, "book.py")
    page = gallery.page("book", book)
    assert page.title == "Does a cell show what it makes?"
    assert "```text\none\ntwo\n```\n\n![Figure 1 of this tutorial](book/0.png)" in page.text
    assert list(page.images) == ["book/0.png", "book/1.png"]
    assert page.images["book/1.png"] != page.images["book/0.png"]
    assert "<strong>Trajectory of the full model</strong><table>" in page.text
    assert page.thumbnail is not None
    assert replace(page, images=dict([*page.images.items()][:1])).thumbnail == page.thumbnail  # of the first figure
    wrong = gallery.jupytext.reads("# %%\nassert 1 == 2", fmt="py:percent")
    with pytest.raises(RuntimeError, match=r"wrong\.py: [\s\S]*assert 1 == 2"):
        gallery.execute(wrong, "wrong.py")


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted((ROOT / "demos").glob("demo_*.py")), ids=lambda path: path.stem)
def test_tutorial_runs_as_a_notebook(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `make docs` runs it: cell by cell in a kernel of this Python."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    gallery = importlib.import_module("gallery")
    book = gallery.jupytext.read(script)
    gallery.execute(book, script.name)
    assert all(cell.execution_count for cell in book.cells if cell.cell_type == "code" and cell.source.strip())
    assert gallery.page(script.stem, book).images


def test_links_of_the_raw_pages_are_alive() -> None:
    """As on a site that shows the repository, where nothing is built."""
    texts = {page: page.read_text() for page in [*PAGES, *ROOT.glob("*.md")]}
    links = [(page, target) for page, text in texts.items() for target in re.findall(r"\]\(([^)#\s:]+)(?=[)#])", text)]
    assert len(links) > 40
    assert [(str(page), target) for page, target in links if not (page.parent / target).exists()] == []


def test_pages_build_strictly(tmp_path: Path) -> None:
    """Links and anchors are checked; what the reader's browser loads lies beside the pages."""
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    fast = {"SOFTGRASP_TUTORIALS": "none"}  # `make docs` runs them
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT), "no_proxy": "*"} | fast
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr[-3000:]
    page = (tmp_path / "site" / "index.html").read_text()
    assert re.findall(r'<(?:script|link)[^>]+(?:src|href)="https?://', page) == []
    worker = page.index('<script src="iframe-worker.js">')  # pages opened from the disk have their search by it
    assert worker < page.index('<script src="assets/javascripts/bundle')
    assert (tmp_path / "site" / "search" / "search_index.js").read_text().startswith("var __index")
    assert "<code>tissue.refine</code>" in (tmp_path / "site" / "scene.html").read_text()
    api = (tmp_path / "site" / "api.html").read_text()
    assert (tmp_path / "site" / "tutorials" / "forward.ipynb").stat().st_size > 1000
    gallery = (tmp_path / "site" / "tutorials" / "index.html").read_text()
    assert gallery.count("<li><a href=") >= len(list((ROOT / "demos").glob("demo_*.py")))
    for name in ("Trajectory", "LoopTrajectory", "METHODS"):
        assert re.search(rf'id="softgrasp[\w.]*\.{name}"', api), f"api.md lacks {name}"
    assert all(f"sg.{name}" in api or f">{name}<" in api for name in sg.__all__), "api.md lacks a name of the face"
    assert not re.search(r"<td><code>(?:<[^>]+>)?_[a-z]", api), "api.md lists a private field"


def test_limits_of_the_page_of_costs_are_those_of_the_source() -> None:
    """Name and value, as in `reduction.online.TOGETHER`, 5 MB; of a dictionary the values in 2D and 3D."""
    rows = re.findall(
        r"^\| `((?:fem|reduction|lqr)[\w.]+\.[A-Z_]+)`, ([^|]+) \|", (ROOT / "docs/benchmarks.md").read_text(), re.M
    )
    assert len(rows) >= 6
    for name, text in rows:
        module, constant = name.rsplit(".", 1)
        value = getattr(importlib.import_module(f"softgrasp.{module}"), constant)
        told = text.replace(" MB", "000000").replace(" 000", "000").replace("131 072", "131072")
        numbers = [int(word) for word in re.findall(r"(?<![\w])\d+(?!D)", told)]
        assert numbers == ([value] if isinstance(value, int) else [value[d] for d in (2, 3) if f"{d}D" in text]), name


def test_make_targets_of_the_pages_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    used = {word for _, text in [*blocks("sh"), *blocks("")] for word in re.findall(r"^make (\w+)", text, re.MULTILINE)}
    assert used
    assert used <= targets
