"""The page of a run: set equations, nothing loaded from outside, and what a real browser makes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from rich.console import Console

from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.report.document import Page, Section
from softgrasp.study.report.equation import Equation, control_equation, equation, prose, terms
from softgrasp.study.report.origin import versions
from softgrasp.study.report.page import outside, write_report
from tests.helpers.browser import DESK, PHONE, Browser, faults, find_chromium

pytestmark = pytest.mark.serial


# --- equations


def test_formulas_are_set_and_words_are_not() -> None:
    html = str(prose(r"the hand's row: $M_{ee} \ddot z$ & $R^\top$"))
    assert html.startswith("the hand&#39;s row: <math")
    assert "<msub><mi>M</mi><mrow><mi>e</mi><mi>e</mi></mrow></msub><mover><mi>z</mi>" in html
    assert "</math> &amp; <math" in html
    assert "<msup><mi>R</mi><mo>&#x022A4;</mo></msup>" in html  # of a matrix: transposed


def test_lines_break_before_operators() -> None:
    pieces = [str(piece) for piece in terms(["$-G (a - g)$", "$- u$", "$w$"], "=")]
    assert [piece.removeprefix('<span class="term">')[:1] for piece in pieces] == ["=", "−", "+"]
    assert "<mi>g</mi>" in pieces[0]


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
@pytest.mark.parametrize("kind", [equation, control_equation])
def test_every_symbol_of_every_scene_is_set(name: str, kind: Callable[[Scene], Equation]) -> None:
    """Nothing of the notation of LaTeX or of text is left in the page: no dollar, backslash, underscore or power."""
    html = str(kind(load_scene(shipped_scenes()[name])).html())
    assert not any(mark in html for mark in ("_", "$", "^", "\\", "{"))
    assert html.count("<math") == html.count("</math>") > 20
    ET.fromstring(html)  # well formed
    assert "tissue" in html


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_a_terminal_shows_no_latex(name: str) -> None:
    text = "\n".join(equation(load_scene(shipped_scenes()[name])).plain().lines())
    assert not any(mark in text for mark in ("\\", "$", "{", "}"))


def test_finite_strain_has_its_energy_in_a_terminal() -> None:
    scene = load_scene(shipped_scenes()["paper_forward"], ["effects.finite_strain={law='neo-hooke'}"])
    assert equation(scene).plain().where[0] == "f(z) = dW/dz, W(F) neo-hooke, F = I + grad z"


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_control_has_its_cost_and_riccati_equation(name: str) -> None:
    scene = load_scene(shipped_scenes()[name])
    if scene.effects.frame is not None:
        pytest.skip("control refuses a hand that turns by any angle")
    rows = control_equation(scene)
    assert "prescribed" not in " ".join(rows.where)  # a force moves the hand, whatever moves it in `simulate`
    assert any(line.startswith("  hand:   M_hand q_s''") for line in rows.plain().lines())
    html = str(rows.html())
    assert html.index("Riccati") < html.index(">with<")


# --- nothing from outside


@pytest.mark.parametrize(
    "mark",
    [
        '<script src="https://x.org/a.js">', "<script>1</script>", '<link rel="stylesheet" href="a.css">',
        '<img src="a.png">', "<img src=//x.org/a>", '<img alt="" srcset="a.png 2x">', '<a href="https://x.org">',
        "<style>@import 'a.css';</style>", "<style>p{background:url(a.png)}</style>", '<iframe title="x">',
    ],
)  # fmt: skip
def test_a_page_that_loads_something_is_seen(mark: str) -> None:
    assert outside(f"<p>before</p>{mark}")


def test_no_line_ends_between_a_number_and_its_unit_but_commands_stay_as_they_are_typed(tmp_path: Path) -> None:
    parts = [
        Section("T", text="It is 0.52 % or 3 m/s in 3 `<steps> 4 s`.", code="sleep 3 s"),
        Section("", rows=[("a", "2 Pa")]),
    ]
    page, files = Page("t", (), parts, command="run 5 m"), [tmp_path / "at 6 s.csv"]
    html = write_report(tmp_path / "report.html", page, files=files).read_text()
    assert "0.52\u00a0% or 3\u00a0m/s in 3 <code>&lt;steps&gt; 4 s</code>." in html
    assert '<a href="at 6 s.csv">' in html
    assert "2\u00a0Pa" in html
    assert "sleep 3 s" in html
    assert "run 5 m" in html


def test_text_about_addresses_is_no_address(tmp_path: Path) -> None:
    assert outside('<p>src=a.png href="x" url(a) @import</p><img src="data:image/png;base64,AA">') == []
    path = write_report(tmp_path / "r.html", Page("t", (), [Section("", "<script src='a.js'></script>")]))
    assert "&lt;script" in path.read_text()


def test_versions_name_what_the_numbers_come_from() -> None:
    found = dict(versions())
    assert {"softgrasp", "DOLFINx", "NumPy", "SciPy", "PETSc", "SLEPc", "MPI", "Python"} == set(found)
    assert all(any(letter.isdigit() for letter in text) for name, text in found.items() if name != "softgrasp")


def test_the_equation_comes_from_the_scene(tmp_path: Path) -> None:
    scene = load_scene(shipped_scenes()["paper_forward"])
    page = write_report(tmp_path / "r.html", Page("t", (), command="softgrasp"), scene=scene).read_text()
    assert str(equation(scene).html()) in page
    assert "<h2>Made with</h2>" in page


# --- a real browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a small run of the command."""
    out = tmp_path_factory.mktemp("page")
    changes = ["tissue.cells=[3,6]", "time.steps=30", "output.frames=4", "effects={gravity={g=[0.0,-1.0]}}"]
    run_simulate(shipped_scenes()["paper_forward"], out, changes, Console(quiet=True), quiet=True)
    return out / "report.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium here")
    with Browser(program) as found:
        yield found


@pytest.mark.parametrize("width", [PHONE, DESK])
def test_browser_shows_the_page_without_complaint(browser: Browser, page: Path, width: int) -> None:
    assert faults(browser, page, width, figures=4) == []
    assert browser.ask("document.querySelectorAll('.term').length") > 5


def test_a_wide_table_is_stacked_on_a_telephone(browser: Browser, tmp_path: Path) -> None:
    """A name and its value share a line there; on a desk the columns stand side by side."""
    header = tuple(f"a long name of column {i}" for i in range(8))
    section = Section("Many", header=header, rows=[[f"row {k}", *range(7)] for k in range(3)])
    scene = load_scene(shipped_scenes()["paper_forward"])
    file = write_report(tmp_path / "r.html", Page("t", (), sections=(section,), command="softgrasp"), scene=scene)
    widths = "[...document.querySelectorAll('td')].slice(0, 2).map(e => e.getBoundingClientRect().top)"
    browser.open(file, PHONE, mobile=True)
    first, second = browser.ask(widths)
    assert second > first + 10  # [px] one below the other
    assert browser.ask("getComputedStyle(document.querySelectorAll('td')[1], '::before').content") == f'"{header[1]}"'
    assert browser.ask("document.querySelector('.wide').scrollWidth <= document.querySelector('.wide').clientWidth")
    browser.open(file, DESK)
    first, second = browser.ask(widths)
    assert first == second


def test_browser_prints_the_page(browser: Browser, page: Path, tmp_path: Path) -> None:
    browser.open(page, DESK)
    browser.pdf(tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "page.pdf").stat().st_size > 20_000  # with its figures


def test_the_checks_can_fail(browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "bad.html"
    wide = "<meta name=viewport content='width=device-width'><p style='width:900px'>x</p>"
    file.write_text(f"{wide}<img src='no.png'><script>console.error('e'); f()</script>")
    said = " ".join(faults(browser, file, PHONE, figures=2))
    assert all(word in said for word in ("console", "exception", "failed", "cut off", "1 figures", "px wide of 0"))
