"""The command as a new user meets it: run, two ranks, and what happens on wrong input."""

from __future__ import annotations

import json
import locale
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from softgrasp.study.shell.streams import write_utf8
from tests.helpers.browser import look, words_of

ROOT = Path(__file__).parents[3]
FORWARD = ROOT / "demos" / "scenes" / "paper_forward.toml"
# A PETSc that was initialised before, with its own handler of signals, as a cluster may have it.
HANDLING = "from softgrasp.fem import _stack; import os; os.environ['PETSC_OPTIONS'] = ''; import petsc4py.PETSc; "
pytestmark = pytest.mark.serial


def launched(ranks: int) -> list[str]:
    """This Python, on one rank or more."""
    launcher = Path(sys.executable).with_name("mpiexec")
    if ranks > 1 and not launcher.exists():
        launcher = Path(shutil.which("mpiexec") or pytest.skip("no mpiexec"))
    return [*([str(launcher), "-n", str(ranks)] if ranks > 1 else []), sys.executable]


def softgrasp(*args: str, ranks: int = 1) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*launched(ranks), "-m", "softgrasp.study.cli", *args],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
    )


# Command lines one after the other in one process a rank: what each wrote and left, by rank 0.
IN_TURN = """
import sys
from softgrasp.study.shell.ending import rank
from softgrasp.study.cli import main
for line in sys.argv[1:]:
    sys.argv[1:] = line.split("\\n")
    try:
        main()
        status = 0
    except SystemExit as end:
        status = end.code
    for stream in (sys.stdout, sys.stderr):
        stream.write(f"\\n<{status}>\\n" if rank() == 0 else "")
        stream.flush()
"""


def in_turn(*lines: tuple[str, ...], ranks: int = 1) -> list[tuple[str, str, str]]:
    """Exit status, output and errors of command lines that one process a rank runs one after the other."""
    words = ["\n".join(line) for line in lines]
    run = subprocess.run(
        [*launched(ranks), "-c", IN_TURN, *words], cwd=ROOT, capture_output=True, text=True, timeout=240
    )
    shown, errors = (re.split(r"\n<(.*)>\n", text) for text in (run.stdout, run.stderr))
    assert shown[1::2] == errors[1::2], run.stderr
    return list(zip(shown[1::2], shown[:-1:2], errors[:-1:2], strict=True))


@pytest.mark.parametrize("ranks", [1, 2])
def test_simulate_writes_what_design_promises(tmp_path: Path, ranks: int) -> None:
    out = tmp_path / "out"
    few = ("--set", "output.frames=6") if ranks > 1 else ()  # of the animation, which one rank draws
    run = softgrasp("simulate", str(FORWARD), "--out", str(out), *few, ranks=ranks)
    assert run.returncode == 0, run.stderr
    result = json.loads((out / "result.json").read_text())
    assert (result["n_s"], result["n_e"], result["states"], result["steps"]) == (2, 956, 1916, 600)
    assert result["hand_final"] == pytest.approx([5.0, 3.0], abs=1e-12)  # the motion is prescribed: rounding only
    assert result["energy_drift"] < 1e-12  # momentum-form midpoint conserves to rounding
    assert result["ranks"] == ranks
    assert {"assembly", "factor", "steps", "per_step"} <= result["time"].keys()
    assert result["memory_peak_mb"] > 50  # MiB; Python with PETSc alone needs more
    for name in ("trajectory.csv", "scene.toml", "move.png", "move.gif", "traces.png", "report.html"):
        assert (out / name).stat().st_size > 500, name
    page = words_of(out / "report.html")
    assert "data:image/png;base64" in page
    strains, zone = result["warnings"]  # of the paper's move, and of its cells, which hold from 44/30 on
    assert "small strains" in strains
    assert zone.startswith("The contact zone ends 0.0333 m beside the edge of contact.box")
    assert result["mesh_error"]["estimate"] == pytest.approx(
        0.40, abs=0.02
    )  # against finer runs: tests of fem.accuracy
    assert result["time_error"] < 1e-3
    assert result["warnings"][0] in page
    assert run.stdout.count("warning:") == 2


@pytest.mark.parametrize("words", [("simulate", "--nonsense"), ("nonsense",)], ids=["option", "command"])
def test_one_rank_tells_of_a_wrong_word(words: tuple[str, ...]) -> None:
    run = softgrasp(*words, ranks=2)
    assert run.returncode == 2
    assert run.stderr.count("Usage:") == 1


REFUSED: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    (("--set", "tissue.cels=[4,8]"), ("tissue.cels", "tissue.cells")),
    (("--set", "tissue.material.mu=-1.0"), ("tissue.material.mu", "> 0")),
    (("--set", "time.steps=0"), ("time.steps",)),
    (("--set", "motion.target=[1.0,2.0,3.0]"), ("motion.target",)),
    (("--set", "contact.box=[[0.4,0.4],[0.5,0.5]]"), ("contact",)),
    (("--set", "control.outputs=[{kind='node', point=[9.0,9.0]}]"), ("control.outputs[0].point", "outside")),
    (("--resume",), ("checkpoint.json", "--resume")),
]


@pytest.fixture(scope="module", params=[1, 2])
def refusals(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str, Path]]:
    """Output, errors and folder of each refused command, whose status was 1."""
    folder = tmp_path_factory.mktemp("refused")
    outs = [folder / f"out{i}" for i in range(len(REFUSED))]
    lines = [("simulate", str(FORWARD), "--out", str(out), *args) for out, (args, _) in zip(outs, REFUSED, strict=True)]
    ended = in_turn(*lines, ranks=request.param)
    assert [status for status, _, _ in ended] == ["1"] * len(REFUSED)
    return [(shown, errors, out) for (_, shown, errors), out in zip(ended, outs, strict=True)]


@pytest.mark.parametrize("case", range(len(REFUSED)), ids=[" ".join(args) for args, _ in REFUSED])
def test_wrong_input_is_one_sentence(refusals: list[tuple[str, str, Path]], case: int) -> None:
    shown, errors, out = refusals[case]
    assert "Traceback" not in errors
    assert "resumed" not in shown
    message = errors[errors.index("error:") :]
    assert message.count("error:") == 1  # one rank speaks
    for word in REFUSED[case][1]:
        assert word in message, message
    assert not (out / "result.json").exists()


def test_a_resumed_run_says_from_where_and_what_it_timed(tmp_path: Path) -> None:
    small = ("simulate", str(FORWARD), "--out", str(tmp_path), "--set", "tissue.cells=[4,8]", "--set", "time.steps=40")
    (stopped, *_), (ended, shown, errors) = in_turn(
        (*small, "--until", "20", "--no-pictures"), (*small, "--resume", "--no-pictures")
    )
    assert (stopped, ended) == ("0", "0"), errors  # the first one as asked
    assert "resumed from step 20 of 40" in shown
    assert "20 of 40, since the run was resumed," in shown
    assert any(tmp_path.glob("fields-from20*"))
    assert json.loads((tmp_path / "result.json").read_text())["time"]["steps_timed"] == 20
    assert json.loads((tmp_path / "result.json").read_text())["output_final"][0] > 5  # the tissue came along


@pytest.mark.parametrize("first", ["", HANDLING])
def test_a_reader_that_leaves_ends_no_run(tmp_path: Path, first: str) -> None:
    out = tmp_path / "out"
    code = f"{first}from softgrasp.study.cli import main; main()"
    small = ["--set", "tissue.cells=[4,8]", "--set", "time.steps=40", "--no-pictures"]
    command = [sys.executable, "-c", code, "simulate", str(FORWARD), "--out", str(out), *small]
    reader, writer = os.pipe()
    os.close(reader)
    clean = {key: value for key, value in os.environ.items() if key != "PETSC_OPTIONS"}  # a new shell has none
    run = subprocess.run(command, cwd=ROOT, env=clean, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60)
    os.close(writer)
    assert (run.returncode, run.stderr) == (0, "")
    assert json.loads((out / "result.json").read_text())["states"] > 0
    assert (out / "report.html").exists()


def test_missing_scene_and_mesh(tmp_path: Path) -> None:
    scene = tmp_path / "lost.toml"
    text = (ROOT / "demos" / "scenes" / "pillow_3d.toml").read_text()
    scene.write_text(text.replace("meshes/pillow_small.msh", "no_such.msh"))
    no_scene, no_mesh = in_turn(
        ("simulate", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out")),
        ("simulate", str(scene), "--out", str(tmp_path / "out")),
    )
    assert (no_scene[0], no_mesh[0]) == ("1", "1")
    assert "none.toml" in no_scene[2]
    assert "no_such.msh" in no_mesh[2]
    assert "Traceback" not in no_scene[2] + no_mesh[2]


def test_scenes_schema_explain_and_help(tmp_path: Path) -> None:
    muscle, why = str(ROOT / "demos" / "scenes" / "franka_muscle.toml"), tmp_path / "why"
    ended = in_turn(("scenes",), ("schema",), ("explain", muscle, "--out", str(why)), ("--help",))
    assert [status for status, _, _ in ended] == ["0"] * 4
    listing, schema, explained, helping = (shown for _, shown, _ in ended)
    for name in ("paper_forward", "paper_lqr", "paper_lqr_undamped", "franka_muscle", "block_3d", "pillow_3d"):
        assert name in listing
    assert "tissue" in json.loads(schema)["properties"]
    assert "|grad z| of its sag" in explained
    result, page = json.loads((why / "result.json").read_text()), (why / "report.html").read_text()
    assert all(name in page for name in result["effects"])
    assert f"2n = {result['sizes']['states']}" in page
    assert look(why / "report.html", figures=0) == []
    assert "simulate" in helping
    for words in ("Run a scene", "Reduce, control and study", "Examples", "Exit status", "3: an answer is refused"):
        assert words in helping
    assert helping.index("Examples") < helping.index("softgrasp sweep my.toml") < helping.index("Exit")


def test_any_locale_reads_and_writes_the_letters_of_a_scene(tmp_path: Path) -> None:
    before = locale.setlocale(locale.LC_CTYPE)
    try:
        locale.setlocale(locale.LC_CTYPE, "C")
        write_utf8()
        (tmp_path / "a").write_text("é → λ")  # as commands write their results
    finally:
        locale.setlocale(locale.LC_CTYPE, before)
    assert (tmp_path / "a").read_bytes().decode("utf-8") == "é → λ"


def test_an_argument_that_is_no_text_is_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "softgrasp.study.cli", "explain", b"/no\xff.toml"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 1
    assert run.stderr.startswith("error: /no\\udcff.toml: this argument is not text here")
    assert run.stderr.count("\n") == 1


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_job_that_is_told_to_end_goes_on_later(tmp_path: Path, ranks: int) -> None:
    """SIGTERM to the program or to its launcher, as a cluster sends it before it kills."""
    # steps for half a minute on a quiet core: the signal must come before their end
    keys = ("tissue.cells=[40,80]", "time.steps=200000", "output.snapshots='none'", "output.fields='none'")
    words = ["simulate", str(FORWARD), "--out", str(tmp_path), *(w for key in keys for w in ("--set", key))]
    command = [*launched(ranks), "-m", "softgrasp.study.cli", *words, "--no-pictures"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        while "n_e" not in program.stdout.readline():  # the model is built
            assert program.poll() is None
        time.sleep(2.0)  # factored
        program.send_signal(signal.SIGTERM)
        _, message = program.communicate(timeout=60)
    assert program.returncode != 0
    assert "lets --resume go on from there" in message, message
    assert (tmp_path / "checkpoint" / "checkpoint.json").exists()
    assert not (tmp_path / "softgrasp.lock").exists()
    if ranks == 1:
        return
    again = softgrasp(*words, "--resume", "--no-pictures", "--until", "199999")
    assert again.returncode == 1
    assert "was written on 2 ranks" in again.stderr
    assert "n_e" not in again.stdout  # refused before anything was built


def test_an_empty_folder_name_is_refused(tmp_path: Path) -> None:
    run = subprocess.run(
        [*launched(1), "-m", "softgrasp.study.cli", "simulate", "paper_forward", "--out", ""],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert run.returncode == 1
    assert run.stderr == "error: --out is empty; name a folder, which is made if it is missing, or . for this one\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ranks", [1, 2])
def test_without_a_compiler_there_is_one_sentence(tmp_path: Path, ranks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # no form is compiled yet
    monkeypatch.setenv("CC", "/nowhere/cc")
    run = softgrasp("simulate", "paper_forward", "--out", str(tmp_path / "out"), ranks=ranks)
    assert run.returncode != 0
    assert "Traceback" not in run.stderr
    assert run.stderr.count("error: a form cannot be compiled") == 1
    assert "install a C compiler or name one in CC" in run.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("ranks", [1, 2])
def test_petsc_options_are_read_and_one_that_is_not_is_named(
    tmp_path: Path, ranks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "guide" / "petsc.md").read_text()
    options = re.findall(r'^export PETSC_OPTIONS="(.*)"$', page, re.MULTILINE)[0]
    monkeypatch.setenv("PETSC_OPTIONS", f"{options} -softgrasp_midpont_ksp_view")
    args = (
        "simulate",
        str(FORWARD),
        "--set",
        "tissue.cells=[4,8]",
        "--set",
        "time.steps=40",
        "--no-pictures",
        "--out",
        str(tmp_path),
    )
    run = softgrasp(*args, ranks=ranks)
    assert run.returncode == 0
    assert re.search(r"KSP Object: .*\(softgrasp_midpoint_\)", run.stdout)
    assert re.search(r"PC Object: .*\(softgrasp_midpoint_\).*\n *type: lu", run.stdout)
    assert run.stderr.count("no solver of this command read -softgrasp_midpont_ksp_view of PETSC_OPTIONS;") == 1
    assert "WARNING!" not in run.stdout + run.stderr
