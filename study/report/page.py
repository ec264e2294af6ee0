"""``report.html``: one self-contained page of a run, for a telephone, a screen and paper."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image

from softgrasp.fem import Scene, note, resolved_toml
from softgrasp.study.report.equation import Equation, equation
from softgrasp.study.report.origin import made_with
from softgrasp.study.report.typeset import equation_html
from softgrasp.study.report.words import words_of

TEMPLATE = Path(__file__).with_name("page.html")
KINDS = {".png": "image/png", ".gif": "image/gif"}
PIXELS_PER_INCH = 135  # width of a figure on the screen against its width in print
EQUATION = "Equation"
HOW = (
    "Run it in a checkout, after make env, with OMP_NUM_THREADS=1. All numbers of this page are in {numbers} beside "
    "it. Sizes, counts and errors come out again up to rounding, which the number of ranks changes; times depend on "
    "the machine and on what else it does."
)
ADDRESS = re.compile(
    r"""<(?:script|link|iframe|object|embed|base|form)\b[^>]*|\b(?:src|srcset|action|data)\s*=\s*["']?(?!data:)[^"'>\s]+"""
    r"""|\bhref\s*=\s*["']?(?!#|[\w-][\w./-]*["'\s>])[^"'>\s]+"""
    r"""|@import[^;]*|url\(\s*["']?(?!data:)[^)]*""",
    re.IGNORECASE,
)
NUMBERS = (int, float, np.integer, np.floating)
LONG = 24  # [letters]
SHOWN, MOST_ROWS = 8, 14  # rows of a longer table that stand unfolded


@dataclass(frozen=True)
class Section:
    """One part of a page; whatever is given is shown in the order of the attributes."""

    title: str  # heading; empty for none
    text: str = ""  # paragraphs, parted by empty lines
    code: str = ""  # text shown as it is
    equation: Equation | None = None  # shown on the page in place of the code
    header: Sequence[str] = ()  # names of the columns; without it two columns are label and value
    rows: Sequence[Sequence[Any]] = ()  # a table; every row as long as the header. Numbers are shown with four digits.
    figures: Sequence[tuple[Path, str]] = ()  # (picture file, caption); the files are embedded
    terminal: bool = False  # a terminal shows texts and table too
    best: Sequence[int] = ()  # rows of a long table that stand unfolded; the first ones if there are none
    details: str = ""  # further paragraphs, folded on the page

    @property
    def unfolded(self) -> Sequence[Sequence[Any]]:
        """Rows that stand unfolded on the page, and alone in a terminal."""
        if not self.header or len(self.rows) <= MOST_ROWS:
            return self.rows
        return [self.rows[i] for i in self.best or range(SHOWN)]


def captioned(files: Sequence[Path], captions: Mapping[str, str]) -> list[tuple[Path, str]]:
    """The pictures among some files with their captions, in the order of the captions."""
    drawn = {file.name: file for file in files}
    return [(drawn[name], text) for name, text in captions.items() if name in drawn]


def of_scene(scene: Scene) -> Section:
    """The section with the equation of a scene."""
    return Section(EQUATION, equation=equation(scene))


def outside(page: str) -> list[str]:
    """Everything in the tags of a page that would load another file: scripts, links, addresses."""
    style = "".join(re.findall(r"<style>.*?</style>", page, re.DOTALL))
    marks = re.findall(r"<[^>]*>", re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL))
    return [address[0] for text in (*marks, style) for address in ADDRESS.finditer(text)]


def embed(path: Path) -> str:
    """A picture as a data URI, so that the page needs no other file."""
    return f"data:{KINDS[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def write_report(
    path: Path,
    *,
    title: str,
    summary: Sequence[str],
    errors: Sequence[str] = (),
    warnings: Sequence[str] = (),
    subtitle: str = "",
    sections: Sequence[Section] = (),
    scene: Scene | None = None,
    reproduce: str = "",
    result: Mapping[str, Any] = MappingProxyType({}),
    numbers: str = "result.json",
    files: Sequence[Path] = (),
) -> Path:
    """Write the page; what is empty is left out. Not collective: call on one rank.

    Args:
        summary: sentences that say what came out.
        errors: sentences on the error of the result; coloured, above the summary.
        warnings: sentences that a reader must not miss; coloured, below the errors.
        scene: what was run; its equation is added unless a section has it.
        reproduce: the commands that made this page.
        result: what result.json holds, for sizes and times.
        numbers: the files beside it that hold its numbers.
        files: what lies beside the page; the page links to it.

    Raises ValueError: a row is not as long as its table's header or first row, or the page would load anything.
    """
    given = list(sections)
    if scene and all(section.title != EQUATION for section in given):
        given.insert(1, of_scene(scene))
    if reproduce:
        given.append(Section("Made with", rows=made_with(result)))
    page = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined).from_string(
        TEMPLATE.read_text(encoding="utf-8")
    )
    prepared = [_prepared(section) for section in given]
    parts = (part for s in prepared for part in (s["title"], *s["paragraphs"], *s["details"], *s["header"]))
    text = " ".join((*errors, *warnings, *summary, *parts))
    text += " ".join(str(row[0]) for s in prepared for row in s["rows"])
    html = page.render(
        title=title,
        subtitle=subtitle,
        errors=errors,
        warnings=warnings,
        summary=summary,
        sections=prepared,
        words=words_of(text),
        files=[file.relative_to(path.parent).as_posix() for file in files if file.is_relative_to(path.parent)],
        scene="" if scene is None else resolved_toml(scene).strip(),
        reproduce=reproduce.strip(),
        how=HOW.format(numbers=numbers),
    )
    if address := outside(html):
        raise ValueError(f"the page needs more than itself: {address[0]}")
    note(path)
    path.write_text(html, encoding="utf-8")
    return path


def _prepared(section: Section) -> dict[str, Any]:
    columns = len(section.header or (section.rows[0] if section.rows else ()))
    for row in section.rows:
        if len(row) != columns:
            raise ValueError(f"the table {section.title!r} has {columns} columns, but a row has {len(row)} entries")
    kinds = [_column([row[i] for row in section.rows]) if section.header else "" for i in range(columns)]
    figures = [
        {"data": embed(file), "caption": caption, "moving": file.suffix == ".gif", "width": _width(file)}
        for file, caption in section.figures
    ]
    rows = [[cell_text(cell) for cell in row] for row in section.rows]
    return {
        "title": section.title,
        "paragraphs": paragraphs(section.text),
        "details": paragraphs(section.details),
        "code": section.code,
        "equation": "" if section.equation is None else equation_html(section.equation),
        "header": section.header,
        "rows": rows,
        "unfolded": [[cell_text(cell) for cell in row] for row in section.unfolded],
        "align": [Markup(f' class="{kind}"') if kind else "" for kind in kinds],
        "kind": "wider" if section.header else "pairs",
        "figures": figures,
    }


def paragraphs(text: str) -> list[str]:
    """The parts of a text between empty lines."""
    return [part.strip() for part in text.split("\n\n") if part.strip()]


def _column(cells: Sequence[Any]) -> str:
    """Class of a column: "n" for numbers, "t" for text long enough to be broken into lines."""
    texts = [cell_text(cell) for cell in cells]
    if all(not t or (isinstance(c, NUMBERS) and not isinstance(c, bool)) for c, t in zip(cells, texts, strict=True)):
        return "n"
    return "t" if max(map(len, texts)) > LONG else ""


def cell_text(cell: Any) -> str:
    """Text of a cell: numbers with four digits, counts in full, nothing for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool | np.bool_):
        return "yes" if cell else "no"
    return f"{cell:.4g}" if isinstance(cell, float | np.floating) else str(cell)


def _width(path: Path) -> int:
    """Width of a picture on the page: figures by their size in print, animations by their pixels."""
    with Image.open(path) as image:
        dpi = image.info.get("dpi", (0, 0))[0]
        return round(image.width / dpi * PIXELS_PER_INCH) if dpi and path.suffix == ".png" else image.width
