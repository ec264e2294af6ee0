"""Sentences of errors that no other test asks for: what is wrong, and what would be right."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import SoftgraspError
from softgrasp.lqr.loop.filter import Filter
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.reduction.identify.unknowns import parse_unknowns
from softgrasp.study.export.run import run_export
from softgrasp.study.identify.suggest.run import parse_motions
from softgrasp.study.runs.listing import compare
from softgrasp.study.serve.run import make_server, served_model

pytestmark = pytest.mark.serial
NOWHERE = Path("nowhere")


def scene(name: str, *keys: str) -> Callable[[], Any]:
    return lambda: sg.load_scene(name, list(keys))


def build(name: str, *keys: str, **given: Any) -> Callable[[], Any]:
    return lambda: sg.build(name, ["tissue.cells=[4, 8]", *keys], **given)


def nothing() -> Any:
    """A form that is never made."""


def filtered(names: tuple[str, ...], delay: int) -> Callable[[], Any]:
    A, B, C = np.eye(2), np.ones((2, 1)), np.ones((1, 2))
    return lambda: Filter(A, B, np.zeros(2), C, C.T, names, delay=delay)


def fitted(word: str, *keys: str) -> Callable[[], Any]:
    return lambda: parse_unknowns([word], build("paper_forward", *keys)())


LAW = "tissue.energy='law.py:W'"
SENTENCES: list[tuple[Callable[[], Any], str]] = [
    (scene("turn_over", "effects.rotation=false"), "effects.rotation is off; set effects.rotation to true"),
    (scene("paper_forward", LAW, "tissue.parameters={'a b'=1.0}"), "parameters has 'a b'; a name is a word of letters"),
    (
        scene("paper_forward", LAW, "tissue.parameters={a=1.0}",
              "tissue.layers.top={box=[[0, 1], [1, 2]], parameters={c=2.0}, material={mu=50.0, lambda=50.0, rho=1.0}}"),
        "parameters has 'c', which tissue.parameters lacks; give it there too",
    ),
    (
        build("paper_forward", "tissue.layers.far={box=[[7, 7], [8, 8]], material={mu=50.0, lambda=50.0, rho=1.0}}"),
        "tissue.layers.far has no cell of the mesh; check its tag or box",
    ),
    (build("paper_forward", terms=["bed"]), "terms has 'bed'; give softgrasp.Term(name, form, value)"),
    (build("paper_forward", terms=[sg.Term("bed", nothing, 1.0, adds="heat")]), "the term bed adds 'heat'; choose "),
    (lambda: sg.contact_model(build("paper_forward")()), "contact_model needs effects.obstacles, motion.drive"),
    (filtered(("x", "y"), 0), "a filter of 1 samples has 2 names and a delay of 0 ticks"),
    (filtered(("x",), -1), "a filter of 1 samples has 1 names and a delay of -1 ticks"),
    (lambda: nearest(np.zeros((1, 2)), np.array([-1.0])), "a row without entries is violated"),
    (lambda: nearest(np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])), "no point keeps all rows"),
    (lambda: run_export(Path("a.h5"), Console(quiet=True), c=None, fmu=Path("a.zip"), tick=1e-3), "name it a.fmu"),
    (lambda: parse_motions(["duration=" + ";".join("1" * 51)]), "51 motions are too many; give at most"),
    (lambda: compare(NOWHERE, NOWHERE), "nowhere/result.json is not there; name folders that `softgrasp list` prints"),
    (lambda: served_model(NOWHERE, "heat"), "--inputs heat: give some of "),
    (lambda: make_server(None, "127.0.0.1", -1), "--port -1: "),  # type: ignore[arg-type]
    (fitted("mu", "tissue.layers.all={box=[[-9, -9], [9, 9]], material='fat'}"), "all cells are in layers; name one"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong_and_what_would_be_right(act: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(SoftgraspError, match=re.escape(sentence)) as caught:
        act()
    assert "\n" not in str(caught.value).strip()
