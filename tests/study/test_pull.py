"""The page in which the mouse pulls the hand: it makes the steps of the reduced model, in a browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.fields.picture import gather_picture, vertex_displacement
from softgrasp.reduction import online
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.propagator import propagator
from softgrasp.reduction.system import ModelError
from tests.helpers.browser import DESK, PHONE, Browser, find_chromium

pytestmark = pytest.mark.serial
LOG = """const own = step, log = []; step = () => { own(); log.push([...q, ...v, ...w, time]) }"""
SCENES: dict[str, dict[str, Any]] = {  # in the plane with weight, in space with turns
    "paper_lqr": {"tissue": {"cells": [4, 8]}, "effects": {"gravity": [0.0, -1.0]}, "time": {"steps": 300}},
    "block_3d": {"tissue": {"cells": [2, 2, 3], "order": 1}, "time": {"steps": 100}, "effects": {"rotation": True}},
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if (program := find_chromium()) is None:
        pytest.skip("no Chromium here")
    with Browser(program, "--enable-unsafe-swiftshader") as found:  # WebGL without a graphics card
        yield found


def mouse(browser: Browser, kind: str, x: float, y: float) -> None:
    browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)


@pytest.mark.parametrize("name", SCENES)
def test_the_mouse_pulls_the_hand_and_the_tissue_makes_the_steps_of_the_model(
    browser: Browser, name: str, tmp_path: Path
) -> None:
    model = sg.build(name, **SCENES[name])
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=4 * model.system.layout.n_s + 6)
    assert isinstance(rom, ReducedModel)
    browser.open(rom.pull(model).save(tmp_path / "pull.html"), DESK, 800)
    browser.ask(LOG)
    mouse(browser, "mousePressed", 640, 400)
    for i in range(1, 9):
        mouse(browser, "mouseMoved", 640 + 10 * i, 400 - 5 * i)
        browser.ask("new Promise(r => setTimeout(r, 60))")
    browser.ask("tick = () => show(); 1")  # the last picture
    browser.ask("new Promise(r => setTimeout(r, 100))")
    assert [text for text in browser.complaints() if "GPU stall" not in text] == []  # there is no graphics card
    rows, places = np.array(browser.ask("log")), np.array(browser.ask("[...place]")).reshape(-1, 3)
    n_s, d = model.system.layout.n_s, model.system.layout.dimension
    starts = (np.zeros(n_s), np.zeros(n_s), browser.ask("D.start"))
    parts = np.split(rows[:, :-1], [n_s, 2 * n_s], axis=1)
    q, v, w = (np.vstack([start, part]) for start, part in zip(starts, parts, strict=True))
    pixel = 2 * float(browser.ask("radius()")) / float(browser.ask("Math.min($('c').clientWidth, $('c').clientHeight)"))
    assert np.abs(browser.ask("[...goal]")).max() > 40 * pixel * 0.5  # 80 pixels along x, 40 up, seen from any side
    assert len(rows) > 20
    assert np.linalg.norm(q[-1]) > 0.2 * np.linalg.norm(browser.ask("[...goal]"))
    small = rom.at()
    step = propagator(small, rows[0, -1], driven=True)
    run = online.run(step, hand=(q, v), x0=small.equilibrium())
    # the same rule by other sums: rounding of some hundred steps
    assert np.allclose(w, run.x[:, 2 * n_s :] @ step.at.X_inverse.T, rtol=0, atol=1e-10 * np.abs(w).max())
    z, _ = rom.reconstruct(small, run.x[-1:].T)
    moved = vertex_displacement(model, z, run.q_s[-1:].T)
    picture = gather_picture(model)
    assert moved is not None
    assert picture is not None
    used = np.unique(picture.cells if d == 2 else picture.facets)
    expected = (picture.points + moved[0])[used]
    assert np.allclose(places[:, :d], expected, rtol=0, atol=1e-6 * np.abs(expected).max())  # 32 bits
    assert re.match(r"t = [\d.]+ s, hand at \(", browser.ask("$('place').textContent"))


def test_the_page_fits_a_telephone_and_comes_back(browser: Browser, tmp_path: Path) -> None:
    model = sg.build("paper_lqr", **SCENES["paper_lqr"])
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)
    page = rom.pull(model).save(tmp_path / "pull.html")
    browser.open(page, PHONE, mobile=True)
    assert browser.ask("document.documentElement.scrollWidth") <= PHONE
    start = browser.ask("[...w]")
    browser.ask("moved({buttons: 1}, 50, 20); for (let i = 0; i < 50; i++) step(); show(); 1")
    assert browser.ask("[...w]") != start
    browser.ask("$('back').click()")
    assert browser.ask("[...w, ...q]") == pytest.approx([*start, 0, 0], rel=0, abs=1e-12)  # at rest, but for rounding


def test_models_that_cannot_be_pulled_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sg.build("paper_lqr", **SCENES["paper_lqr"])
    run = sg.simulate(model)
    whole = sg.reduce(model, run, "psd", N=14)
    assert isinstance(whole, ReducedModel)
    with pytest.raises(ModelError, match="the hand is inside the basis"):
        whole.pull(model)
    rom = sg.reduce(model, run, "craig_bampton", N=14)
    assert isinstance(rom, ReducedModel)
    for other in ({"tissue": {"cells": [3, 6]}}, {"effects": {"gravity": [0.0, -2.0]}}):
        with pytest.raises(ModelError, match=r"was built with .* reduce that scene itself"):
            rom.pull(sg.build("paper_lqr", **{**SCENES["paper_lqr"], **other}))
    monkeypatch.setattr("softgrasp.study.pull.page.MOST_BYTES", 1000)
    with pytest.raises(ModelError, match="MB of shapes, more than 0; use a coarser mesh"):
        rom.pull(model)
