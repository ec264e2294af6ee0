"""Sentences of `study` that no other test asks for: the bad call, and the sentence that refuses it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.precision.points import Request
from softgrasp.study.precision.run import run_study
from softgrasp.study.query.request import parse_settings, read_batch
from softgrasp.study.query.run import run_query
from softgrasp.study.reduce.run import run_reduce
from softgrasp.study.report.document import Table
from softgrasp.study.runs.listing import compare
from softgrasp.study.runs.run import run_sweep
from softgrasp.study.runs.sweep import parse_axes
from softgrasp.study.serve.protocol import Served
from tests.helpers.sentences import refused

pytestmark = pytest.mark.serial
Act = Callable[[Path], Any]
SMALL = ["tissue.cells=[2, 4]", "time.steps=4"]
QUIET = Console(quiet=True)
SCENE = Path("paper_forward")


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def batch(content: str) -> Act:
    return lambda folder: read_batch(text(folder / "b.csv", content))


def asked(**how: Any) -> Act:
    return lambda folder: run_query(folder / "m.h5", QUIET, **how)


def reduced(*keys: str) -> Act:
    return lambda folder: run_reduce(SCENE, folder / "out", [*SMALL, *keys], QUIET)


def compared(name: str, content: str | None) -> Act:
    """Two runs, one file of the second of which is another."""

    def act(folder: Path) -> Any:
        for each in ("a", "b"):
            (folder / each).mkdir()
            text(folder / each / "result.json", '{"command": "simulate"}')
        if content is None:
            os.mkfifo(folder / "b" / name)
        else:
            text(folder / "a" / name, content)
            text(folder / "b" / name, content)
        compare(folder / "a", folder / "b")

    return act


def requested(path: str, body: Any, method: str = "POST") -> Act:
    """The answer of the server, raised where it is an error."""

    def act(_: Path) -> None:
        model: Any = SimpleNamespace(drive=None)
        _, answer = Served(model, model.drive, ("mu",)).answer(method, path, body)
        raise SoftgraspError(answer["error"]["message"])

    return act


BENT = "effects.finite_strain={law='neo-hooke'}"
TORN = [*SMALL, "effects.finite_strain={law='stvk'}", "time.end=2e-3"]
SENTENCES: list[tuple[Act, str]] = [
    (lambda *_: parse_settings(["mu=1", "mu=2"]), "--set mu=2: mu is set twice; give one value, or many in a table"),
    (lambda folder: run_simulate(SCENE, folder / "out", SMALL, QUIET, resume=True, empty=True),
     "--empty removes what --resume goes on from; give one of them"),
    (lambda _: Request(names=("speed",)), "--question speed: it must be one of "),
    (lambda folder: run_study(SCENE, folder / "out", [*SMALL, BENT], QUIET),
     "study compares methods of linear elasticity; set effects.finite_strain to false, or run reduce, "),
    (lambda folder: read_batch(folder / "b.csv"),
     "b.csv: cannot be read (No such file or directory); name an existing"),
    (batch("heat\n1\n"), "the first line must name columns (lambda, mu, rho or some); it has heat"),
    (batch("mu,rho\n1\n"), "b.csv: row 1 has 1 entries; it must have 2"),
    (asked(tolerance=-1.0), "--tolerance -1: the largest relative error must be positive, for example 1e-2"),
    (asked(out=Path("nowhere/a.csv")),
     "--csv nowhere/a.csv: there is no folder nowhere; name a file in a folder that is"),
    (reduced("output.snapshots='hdf5'"),
     "output.snapshots is 'hdf5'; it must be 'memory' for a reduction, which builds"),
    (reduced(BENT, "reduction.N=[2, 4]"),
     "reduction.N = [2, 4]: a model at finite strain has an even number of columns,"),
    (reduced(BENT, "reduction.methods=['psd']"), "reduction.methods names linear bases; leave it out with "),
    (lambda _: Table(("b", "c"), [(1,)], title="times"), "the table 'times' has 2 columns, but a row has 1"),
    (compared("scene.toml", None),
     "scene.toml cannot be read (it is a pipe; write it to a file first); run the scene "),
    (compared("scene.toml", "["), "scene.toml is damaged ("),
    (compared("trajectory.csv", "t [s],a\n0,x\n"),
     "is damaged: it is no table of finite numbers with growing times; run"),
    (lambda folder: run_sweep(SCENE, folder / "out", TORN, QUIET, axes=["motion.duration=1e-3"]),
     "no point of the sweep could be run; the first: "),
    (lambda _: parse_axes(["tissue.material.mu=1:2:1000", "tissue.material.lambda=1:2:1000"]),
     "the sweep has 1000000 points; give at least one and at most "),
    (lambda folder: run_sweep(SCENE, folder / "out", SMALL, QUIET, axes=["motion.duration=0.1,0.2"], reduced=8),
     "--reduced 8: the reduced model is affine in tissue.material only; sweep its keys"),
    (requested("/Evaluate", {}, "GET"), "GET /Evaluate: the method must be POST"),
    (requested("/Evaluate", {"name": "heat"}), "the models are "),
    (requested("/InputSizes", {"name": "forward", "config": {"heat": 1}}), "config has the keys "),
    (requested("/Evaluate", {"name": "forward", "input": [[1, 2]]}),
     "input must have 1 finite numbers; it has 2 entries"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong(act: Act, sentence: str, tmp_path: Path) -> None:
    with refused(sentence):
        act(tmp_path)
