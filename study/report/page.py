"""``report.html``: one self-contained page of a run, for a telephone, a screen and paper."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from markupsafe import Markup

from softgrasp.fem import Scene, note, resolved_toml
from softgrasp.fem.shown import unbroken
from softgrasp.study.report.document import NUMBERS, Page, Section, cell_text, in_words
from softgrasp.study.report.equation import equation
from softgrasp.study.report.origin import made_with

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
LONG = 24  # [letters]
WORDS = {  # what short words mean; a page lists those that it uses
    "N": "columns of the basis V of a reduced model, those of the hand included; states of the reduced equation",
    "n_s": "degrees of freedom of the hand: its translations, and its turns where rotation is on",
    "n_e": "displacements of the tissue that are free: the nodes that the hand does not hold, times the dimension",
    "2n": "states of the full model: positions and velocities of hand and tissue, 2 (n_s + n_e)",
    "gate": "the number that decides whether an effect matters: above the stated value it does",
    "energy drift": "change of the energy that no work or damping explains, over the largest energy of the run",
    "chatter": "how often a node begins or ends to touch in one step and takes it back in the next",
    "residual": "what is left of an equation when its solution is put in, relative to its terms",
    "abscissa": "largest real part of the poles [1/s]; the motion decays where it is negative",
    "spectral radius": "largest modulus of the poles from tick to tick; the sampled motion decays where it is below 1",
    "excess cost": "cost of a reduced gain over that of the optimal one, minus 1",
    "ARE": "the algebraic Riccati equation, whose solution P gives the optimal gain K",
    "a priori": "a basis chosen from the model alone, before any large equation is solved",
    "fixed": "fixed solid modes: the hand keeps columns of its own in the basis and is not reduced",
    "offline": "work done once, before the first reduced run: snapshots, basis, projection",
    "online": "the steps of a reduced run",
    "deformation": "displacement of the tissue relative to the rigid motion of the hand",
    "snapshot": "the state of the full run at one instant, of which bases are built",
    "box": "the range of lambda and mu that a model was trained for",
    "proved": "not exceeded, up to rounding; what is estimated is about so large",
    "tick": "one period of the controller: it measures, computes and holds a force",
}


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
    page: Page,
    *,
    scene: Scene | None = None,
    result: Mapping[str, Any] = MappingProxyType({}),
    files: Sequence[Path] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write a page; what is empty is left out. Not collective: call on one rank.

    Args:
        scene: what was run; its equation is added unless a section has it.
        result: what result.json holds, for sizes and times.
        files: what lies beside the page; the page links to it.
        notes: warnings before those of the page.

    Raises ValueError: a row is not as long as its table's header or first row, or the page would load anything.
    """
    from jinja2 import Environment, StrictUndefined  # not every command writes a page

    given = list(page.sections)
    if scene and all(section.title != EQUATION for section in given):
        given.insert(1, of_scene(scene))
    if page.command:
        given.append(Section("Made with", rows=made_with(result)))
    environment = Environment(
        autoescape=True,
        trim_blocks=True,
        undefined=StrictUndefined,
        finalize=lambda value: unbroken(value) if type(value) is str else value,
    )
    environment.filters["words"] = words
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    prepared, warnings = [_prepared(section) for section in given], list(dict.fromkeys([*notes, *page.warnings]))
    parts = (part for s in prepared for part in (s["title"], *s["paragraphs"], *s["details"], *s["header"]))
    text = " ".join((*page.errors, *warnings, *page.summary, *parts))
    text += " ".join(str(row[0]) for s in prepared for row in s["rows"])
    html = template.render(
        page=page,
        subtitle=page.subtitle or (scene.description if scene else ""),
        warnings=warnings,
        sections=prepared,
        words=words_of(text),
        files=[file.relative_to(path.parent).as_posix() for file in files if file.is_relative_to(path.parent)],
        scene="" if scene is None else resolved_toml(scene).strip(),
        how=HOW.format(numbers=page.numbers or in_words(["result.json", *page.tables])),
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
        "equation": "" if section.equation is None else section.equation.html(),
        "header": section.header,
        "rows": rows,
        "unfolded": [[cell_text(cell) for cell in row] for row in section.unfolded],
        "align": [Markup(f' class="{kind}"') if kind else "" for kind in kinds],
        "kind": "wider" if section.header else "pairs",
        "figures": figures,
    }


def words(text: str) -> Markup:
    """A sentence as the page shows it: `names` in the type of code."""
    parts = re.split(r"`([^`]+)`", text)
    return Markup().join(Markup("<code>{}</code>").format(p) if i % 2 else unbroken(p) for i, p in enumerate(parts))


def paragraphs(text: str) -> list[str]:
    """The parts of a text between empty lines."""
    return [part.strip() for part in text.split("\n\n") if part.strip()]


def _column(cells: Sequence[Any]) -> str:
    """Class of a column: "n" for numbers, "t" for text long enough to be broken into lines."""
    texts = [cell_text(cell) for cell in cells]
    if all(not t or (isinstance(c, NUMBERS) and not isinstance(c, bool)) for c, t in zip(cells, texts, strict=True)):
        return "n"
    return "t" if max(map(len, texts)) > LONG else ""


def _width(path: Path) -> int:
    """Width of a picture on the page: figures by their size in print, animations by their pixels."""
    from PIL import Image  # only pages with pictures need it

    with Image.open(path) as image:
        dpi = image.info.get("dpi", (0, 0))[0]
        return round(image.width / dpi * PIXELS_PER_INCH) if dpi and path.suffix == ".png" else image.width


def words_of(text: str) -> Sequence[tuple[str, str]]:
    """The words that a text uses, with their meaning."""
    return [(word, meaning) for word, meaning in WORDS.items() if re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text)]
