"""What holds for the whole source tree: sizes, references, and a wheel that carries every package."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import softgrasp
from tools.draw_badges import FOLDER, badge, facts

ROOT = Path(__file__).parents[1]
PACKAGES = ("fem", "reduction", "lqr", "study")
OWN_COMMENTS = PACKAGES  # whose fields have a comment each
SCENES = ROOT / "demos" / "scenes"
INSIDE = ROOT / "softgrasp"  # links in a checkout, folders in an unpacked sdist
SOURCES = sorted(path for package in PACKAGES for path in (INSIDE / package).rglob("*.py"))
OUTSIDE = (ROOT / "benchmarks", ROOT / "tests" / "hardcases")  # of a checkout only
BESIDE = sorted([*(path for folder in OUTSIDE for path in folder.rglob("*.py")), ROOT / "demos" / "paper.py"])
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef
MODULE_LINES, FUNCTION_LINES = 400, 60  # what a reader holds in mind


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a source file."""
    return list(ast.walk(ast.parse(path.read_text())))


@pytest.mark.serial
def test_modules_and_functions_are_small() -> None:
    assert len(BESIDE) > 20  # else nothing is looked at
    long = [str(p.relative_to(ROOT)) for p in SOURCES + BESIDE if len(p.read_text().splitlines()) > MODULE_LINES]
    for path in SOURCES + BESIDE:
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                if body and (body[-1].end_lineno or 0) - body[0].lineno + 1 > FUNCTION_LINES:
                    long.append(f"{path.relative_to(ROOT)}: {node.name}")
    assert long == []


PRIVATE = re.compile(  # words of docs/style.md that a sentence of a command, a page or the pages avoids
    r"\b(gripper|surrogate|FOM|high fidelity|dear(er|est)|rightly off|for good|mine|wanted|judged|worth|guaranteed"
    r"|regulator|observable)\b",
    re.IGNORECASE,
)


GROUP_COMMENT = re.compile(r"# *[A-Za-z_]\w*(, *[A-Za-z_]\w*)+ *:|# *(of |in )?the same\b")


def group_comments(text: str) -> list[int]:
    """Lines with a comment for several fields of a class, `# a, b:`, or one that refers to another field."""
    lines, found = text.splitlines(), set()
    for node in ast.walk(ast.parse(text)):
        for field in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(field, ast.AnnAssign):
                own = [field.lineno]
                while lines[own[-1] - 2].lstrip().startswith("#"):
                    own.append(own[-1] - 1)
                found |= {n for n in own if GROUP_COMMENT.search(lines[n - 1])}
    return sorted(found)


@pytest.mark.serial
def test_every_field_has_a_comment_of_its_own() -> None:
    """Not one for several fields, which a reader has to take apart."""
    bad = [
        "class A:",
        "    # a, b: sizes",
        "    a: int",
        "    b: int",
        "    c: int  # the same of b",
        "    d: int  # one",
    ]
    assert group_comments("\n".join(bad)) == [2, 5]
    paths = [path for path in SOURCES if path.relative_to(INSIDE).parts[0] in OWN_COMMENTS]
    paths += [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "tests" / "hardcases").glob("*.py")]
    found = {str(path): lines for path in paths if (lines := group_comments(path.read_text()))}
    assert found == {}


@pytest.mark.serial
def test_sentences_have_no_private_words() -> None:
    """Texts of two words and more in the source, docstrings apart, and the pages but the one that lists the words."""
    texts: list[tuple[Path, str]] = [
        (page, page.read_text()) for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    ]
    for path in SOURCES + BESIDE:
        nodes = nodes_of(path)
        docs = {
            id(n.body[0].value)
            for n in nodes
            if getattr(n, "body", 0) and isinstance(n, DOCUMENTED) and isinstance(n.body[0], ast.Expr)
        }
        texts += [
            (path, n.value)
            for n in nodes
            if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in docs
        ]
    found = [
        (p.name, m[0]) for p, text in texts if " " in text and p.name != "style.md" for m in PRIVATE.finditer(text)
    ]
    assert found == []


@pytest.mark.serial
def test_reading_guide_names_what_exists() -> None:
    assert len(SOURCES) > 200  # else nothing is looked at
    names = re.findall(
        r"`((?:fem|reduction|lqr|study|benchmarks|tests|demos)/[\w/.]*)`", (ROOT / "docs" / "reading.md").read_text()
    )
    assert len(names) > 20
    assert [name for name in names if not (INSIDE / name).exists() and not (ROOT / name).exists()] == []


@pytest.mark.serial
def test_doctor_finds_a_healthy_installation_healthy() -> None:
    """In a process of its own: pytest has loaded MPI already."""
    command = [sys.executable, "-m", "softgrasp.study.cli", "doctor"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert "bad  DOLFINx" not in done.stdout, done.stdout
    assert re.search(r"ok +DOLFINx", done.stdout), done.stdout + done.stderr


def module_of(name: str) -> Path | None:
    """File of the longest part of a dotted name that is a module of the package."""
    parts = name.split(".")[1:]
    for k in range(len(parts), 0, -1):
        path = INSIDE.joinpath(*parts[:k])
        if path.with_suffix(".py").is_file():
            return path.with_suffix(".py")
        if (path / "__init__.py").is_file():
            return path / "__init__.py"
    return None


def imports_of(path: Path, modules: set[str]) -> set[str]:
    """Modules that a file imports anywhere: at its head, inside functions, and for types only."""
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names} & modules
            found |= inside or {node.module}
    return found & modules


@pytest.mark.serial
def test_no_circles() -> None:
    """Also none of imports that run late or never; the face, whose names load when they are used, apart."""
    names = {path: ("softgrasp", *path.relative_to(INSIDE).with_suffix("").parts) for path in SOURCES}
    names |= {path: path.relative_to(ROOT).with_suffix("").parts for path in BESIDE}
    modules = {".".join(name).removesuffix(".__init__"): path for path, name in names.items()}
    graph = {name: imports_of(path, set(modules)) - {name} for name, path in modules.items()}
    assert sum(map(len, graph.values())) > 1000  # else nothing is looked at
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle
    graph["softgrasp.fem.errors"].add("softgrasp.study.cli")
    with pytest.raises(CycleError):
        TopologicalSorter(graph).prepare()


@pytest.mark.serial
def test_what_docstrings_refer_to_exists() -> None:
    names = {
        name
        for path in SOURCES + BESIDE
        for name in re.findall(r":(?:class|func|mod|data|meth|attr|exc):`~?([A-Za-z_]+\.[\w.]+)`", path.read_text())
        if name.split(".")[0] in ("softgrasp", *PACKAGES)
    }
    assert len(names) > 40
    lost = [name for name in names if not name.startswith("softgrasp.") or module_of(name) is None]
    for name in names - set(lost):
        path = module_of(name)
        assert path is not None
        inside = (path.parent if path.name == "__init__.py" else path.with_suffix("")).relative_to(INSIDE).parts
        text = path.read_text()
        lost += [name for part in name.split(".")[1 + len(inside) :] if not re.search(rf"\b{part}\b", text)]
    assert lost == [], "write :mod:`softgrasp.fem.model.build`, with the whole path"


@pytest.mark.serial
def test_tests_of_a_lower_floor_need_no_higher_one() -> None:
    """As the source: study above lqr above reduction above fem; what a test takes as a tool is in tests/helpers."""
    wrong = []
    for below, above in (("fem", "reduction|lqr|study"), ("reduction", "lqr|study"), ("lqr", "study")):
        pattern = rf"^\s*(?:from|import) softgrasp\.(?:{above})\b"
        files = sorted((ROOT / "tests" / below).rglob("*.py"))
        assert files
        wrong += [str(f.relative_to(ROOT)) for f in files if re.search(pattern, f.read_text(), re.MULTILINE)]
    assert wrong == []


@pytest.mark.serial
def test_keys_of_references_exist() -> None:
    text = (ROOT / "REFERENCES.md").read_text()
    known = set(re.findall(r"\*\*\[?([A-Za-z]\w+)\]?\*\*", text))
    cited = {
        key
        for path in SOURCES + BESIDE
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
def test_what_is_cited_is_the_version_of_the_code() -> None:
    """Also where another version is installed: pages and results name that of the code that ran."""
    version = softgrasp.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    readme = (ROOT / "README.md").read_text()
    assert f"version {version}" in readme
    assert f"version = {{{version}}}" in readme
    assert re.search(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version


@pytest.mark.serial
def test_badges_say_what_the_project_states() -> None:
    for name, value in facts().items():
        assert (FOLDER / f"{name}.svg").read_text() == badge(name, value), "run python -m tools.draw_badges"
        assert f"![{name}](docs/badges/{name}.svg)" in (ROOT / "README.md").read_text()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the sdist of this tree, built from a copy: building leaves files behind."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in (*PACKAGES, "softgrasp", "demos", "benchmarks", "tests"):
        if not (ROOT / name).is_dir():
            continue
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (file,) = folder.glob("*.whl")
    return file


@pytest.mark.serial
def test_wheel_is_one_package_and_does_not_ask_for_a_solver(wheel: Path) -> None:
    """A cluster's own DOLFINx must not be shadowed, nor a user's own modules: one name, no solver, no benchmark."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(n for n in names if n.endswith("METADATA"))).decode()
    assert f"\nVersion: {softgrasp.__version__}\n" in metadata
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"softgrasp"}
    outside = {path.name for path in BESIDE} - {path.name for path in SOURCES}
    assert {"riccati.py", "faults.py", "paper.py"} <= {path.name for path in BESIDE}
    assert not [n for n in names if re.search(r"bench|hardcases|(^|/)tests/", n) or n.rsplit("/", 1)[-1] in outside]
    scenes = {f"softgrasp/scenes/{p.relative_to(SCENES)}" for p in SCENES.rglob("*.*") if p.suffix != ".pyc"}
    modules = {str(p.relative_to(ROOT)) for p in SOURCES}
    assert modules | scenes | {"softgrasp/__init__.py", "softgrasp/py.typed"} <= names
    needed = re.findall(r"^Requires-Dist: ([\w.-]+)[^;\n]*$", metadata, re.MULTILINE)
    assert "numpy" in needed
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    assert re.findall(r"^Project-URL: (.+), (\S+)$", metadata, re.MULTILINE) == list(urls.items())
    assert not {"dolfinx-solver-real", "mpich", "fenics-dolfinx", "petsc4py"} & set(needed)


@pytest.mark.serial
def test_wheel_runs_a_scene_beside_modules_of_the_same_names(wheel: Path, tmp_path: Path) -> None:
    site, here = tmp_path / "site", tmp_path / "here"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--target", site, wheel]
    subprocess.run(install, check=True)
    (here / "fem").mkdir(parents=True)
    for name in ("study.py", "lqr.py", "fem/__init__.py"):
        (here / name).write_text("raise ImportError('a module of the user')\n")
    changes = ["--set", "tissue.cells=[2,4]", "--set", "time.steps=4"]
    command = [sys.executable, "-m", "softgrasp.study.cli", "simulate", "paper_forward", "--no-pictures", *changes]
    done = subprocess.run(
        command, cwd=here, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((here / "out" / "paper_forward-simulate" / "result.json").read_text())["steps"] == 4


LIGHT = """
import sys
from typer.testing import CliRunner
from softgrasp.study.cli import app
for line in (["--help"], ["--version"], ["scenes"], ["schema"]):
    assert CliRunner().invoke(app, line).exit_code == 0, line
import softgrasp.study.shell.doctor
loaded = {"mpi4py.MPI", "dolfinx", "petsc4py", "scipy", "matplotlib"} & set(sys.modules)
sys.exit(", ".join(loaded) or 0)
"""


@pytest.mark.serial
def test_commands_that_compute_nothing_load_neither_mpi_nor_dolfinx() -> None:
    done = subprocess.run([sys.executable, "-c", LIGHT], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
