"""``report.html``: one self-contained page of a run, for a telephone, a screen and paper."""

from __future__ import annotations

import base64
import platform
import re
import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from mpi4py import MPI
from PIL import Image
from slepc4py import SLEPc

from softgrasp.fem.petsc import PETSc
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward.result import package_version
from softgrasp.study.report.equation import Equation, equation
from softgrasp.study.report.typeset import equation_html

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>
*{box-sizing:border-box} html{-webkit-text-size-adjust:100%}
body{font:16px/1.5 system-ui,sans-serif;max-width:54rem;margin:1.5rem auto;padding:0 1rem;color:#1a1a1a;
background:#fff;overflow-wrap:break-word}
h1{font-size:1.5rem;line-height:1.2;margin:0 0 .3rem} h2{font-size:1.15rem;margin:2rem 0 .4rem} p{margin:.4rem 0}
.wide{overflow-x:auto;margin:.8rem 0;background:linear-gradient(to right,#fff 40%,#fff0) 0/4rem 100% no-repeat local,
linear-gradient(to left,#fff 40%,#fff0) 100%/4rem 100% no-repeat local,
linear-gradient(to right,#0003,#0000) 0/.8rem 100% no-repeat,
linear-gradient(to left,#0003,#0000) 100%/.8rem 100% no-repeat}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.94rem}
td,th{padding:.25rem 1rem .25rem 0;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
thead th{border-bottom:1.5px solid #1a1a1a;vertical-align:bottom} td.n,th.n{text-align:right;white-space:nowrap}
table.wider td,table.wider th{white-space:nowrap}
table.wider td.t{white-space:normal;min-width:10rem}
table.pairs{width:100%} table.pairs td{overflow-wrap:anywhere}
table.pairs td:first-child{width:40%;color:#444;overflow-wrap:normal}
figure{margin:1rem 0} img{display:block;max-width:100%;height:auto} img.big{min-width:36rem}
figcaption{color:#444;font-size:.9rem}
pre{background:#f5f5f5;padding:.7rem;font:.85rem/1.45 ui-monospace,monospace;white-space:pre-wrap;margin:.4rem 0}
.equation{margin:.4rem 0} .equation i,.term{font-family:Cambria,"STIX Two Text",Georgia,"Times New Roman",serif}
.equation .head{margin:.7rem 0 .1rem;color:#444;font-size:.94rem}
.equation .row{margin:.3rem 0 .3rem 6.5rem;text-indent:-6.5rem;font-size:1.1rem;line-height:1.6}
.equation .name{display:inline-block;width:6.5rem;text-indent:0;color:#444;font-size:.94rem}
.term{display:inline-block;text-indent:0} .equation .where{margin:.15rem 0 .15rem 1.2rem;text-indent:-1.2rem}
sub,sup{font-size:.72em;line-height:0}
@media(max-width:30rem){.equation .row{margin-left:1.2rem;text-indent:-1.2rem} .equation .name{display:block;
margin-left:-1.2rem}
table.wider th:first-child,table.wider td:first-child{position:sticky;left:0;background:#fff;white-space:normal;
min-width:5.5rem;max-width:9rem;box-shadow:inset -1px 0 #ddd;padding-left:0} td,th{padding-right:.7rem}
table.wider th:nth-child(2),table.wider td:nth-child(2){padding-left:.5rem}}
@media print{@page{margin:16mm} body{margin:0;max-width:none;padding:0;font-size:10.5pt} .wide{overflow:visible}
.wide{background:none} h2{break-after:avoid} figure,tr,pre.short,.equation p{break-inside:avoid}
img{max-height:110mm;width:auto} img.big{min-width:0}
table.wider td.t{min-width:0}
table.wider{font-size:8.5pt} table.wider td,table.wider th{white-space:normal}
table.wider td.n{white-space:nowrap} table.wider td,table.wider th{padding-right:.6rem}
pre{background:none;border:1px solid #bbb;font-size:8pt} .motion{display:none}}
</style></head><body>
<h1>{{ title }}</h1>{% if subtitle %}<p>{{ subtitle }}</p>{% endif %}

{% for section in sections %}<section>{% if section.title %}<h2>{{ section.title }}</h2>{% endif %}

{% for text in section.paragraphs %}<p>{{ text }}</p>
{% endfor %}
{% if section.equation %}{{ section.equation }}
{% elif section.code %}<pre class="short">{{ section.code }}</pre>
{% endif %}
{% if section.rows %}<div class="wide"><table class="{{ section.kind }}">
{% if section.header %}<thead><tr>{% for cell in section.header %}<th{{ section.align[loop.index0] }} scope="col">
{{- cell }}</th>{% endfor %}</tr></thead>
{% endif %}
<tbody>{% for row in section.rows %}<tr>{% for cell in row %}<td{{ section.align[loop.index0] }}>{{ cell }}</td>
{%- endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endif %}
{% for figure in section.figures %}<figure{% if figure.moving %} class="motion"{% endif %}>
<div class="wide"><img src="{{ figure.data }}" alt="{{ figure.caption }}" width="{{ figure.width }}"
{%- if figure.width > 700 and not figure.moving %} class="big"{% endif %}></div>
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}</section>
{% endfor %}
{% if scene %}<h2>Scene</h2>
<p>Every key that has a value, defaults included; saved as a file it is the scene of this page.</p>
<pre>{{ scene }}</pre>{% endif %}

{% if reproduce %}<h2>Reproduce</h2><pre class="short">{{ reproduce }}</pre>
<p>{{ how }}</p>{% endif %}

</body></html>
"""
KINDS = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml", ".jpg": "image/jpeg"}
PIXELS_PER_INCH = 135  # width of a figure on the screen against its width in print
EQUATION = "Equation"  # first word of the heading of a section whose code is an equation
PACKAGES = {"DOLFINx": ("fenics-dolfinx", "dolfinx-solver-real"), "NumPy": ("numpy",), "SciPy": ("scipy",)}
HOW = (
    "In a checkout, after `make env`, with OMP_NUM_THREADS=1. All numbers of this page are in {numbers} beside it. "
    "Sizes, counts and errors come out again up to rounding, which the number of ranks changes; times depend on the "
    "machine and on what else it does."
)
ADDRESS = re.compile(
    r"""<(?:script|link|iframe|object|embed|base|form)\b[^>]*|\b(?:src|href|srcset|action|data)\s*=\s*["']?(?!data:)[^"'>\s]+"""
    r"""|@import[^;]*|url\(\s*["']?(?!data:)[^)]*""",
    re.IGNORECASE,
)
NUMBERS = (int, float, np.integer, np.floating)
LONG = 24  # [letters]
SVG_WIDTH = 800  # [pixel]


@dataclass(frozen=True)
class Section:
    """One part of a page; whatever is given is shown in the order of the attributes.

    Attributes:
        title: heading; empty for none.
        text: paragraphs, parted by empty lines.
        code: text shown as it is; under the heading Equation it is set as one, see `equation_text`.
        header: names of the columns; without it two columns are label and value.
        rows: a table; every row as long as the header. Numbers are shown with four digits.
        figures: (picture file, caption); the files are embedded.
    """

    title: str
    text: str = ""
    code: str = ""
    header: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()
    figures: Sequence[tuple[Path, str]] = ()


def equation_text(rows: Equation) -> str:
    """An equation as lines of text: in blocks, as it is stepped, and what the symbols are."""
    lines = ["in blocks:", *_lines(rows.blocks), "", "stepped as:", *_lines(rows.stepped), "", "with:"]
    return "\n".join([*lines, *(f"  {text}" for text in rows.where)])


def _lines(rows: Sequence[tuple[str, Sequence[str], Sequence[str]]]) -> list[str]:
    sides = [[" + ".join(terms).replace("+ -", "-") for terms in (left, right)] for _, left, right in rows]
    wide = max(len(name) for name, _, _ in rows)
    return [f"  {row[0] + ':':<{wide + 1}} {left} = {right}" for row, (left, right) in zip(rows, sides, strict=True)]


def of_scene(scene: str) -> Section:
    """The section with the equation of a resolved scene. Not collective.

    Raises:
        pydantic.ValidationError: the text is no scene.
    """
    return Section(EQUATION, code=equation_text(equation(Scene.model_validate(tomllib.loads(scene)))))


def command_line(command: str, path: Path, overrides: Sequence[str], ranks: int, options: str = "") -> str:
    """How a page about a scene is made again: the command as it is typed. Not collective."""
    launch = f"mpiexec -n {ranks} " if ranks > 1 else ""
    sets = "".join(f" --set {shlex.quote(o)}" for o in overrides)
    return f"{launch}softgrasp {command} {shlex.quote(str(path))}{sets}{options}"


def made_with(result: dict[str, Any]) -> list[tuple[str, Any]]:
    """Rows on where the numbers of a result come from, see :func:`study.shell.session.origin`. Not collective."""
    names = {"version": "softgrasp", "machine": "machine", "ranks": "ranks", "scene_hash": "scene hash"}
    return [(name, result[key]) for key, name in names.items()]


def versions() -> list[tuple[str, str]]:
    """Versions of this program and of what its numbers come from. Not collective."""
    commit = _commit(Path(__file__).parents[1] / ".git")
    rows = [("softgrasp", package_version() + (f", commit {commit}" if commit else ""))]
    for name, distributions in PACKAGES.items():
        found = [text for distribution in distributions if (text := _version(distribution))]
        rows += [(name, found[0])] if found else []
    rows += [(name, ".".join(map(str, sys.getVersion()))) for name, sys in (("PETSc", PETSc.Sys), ("SLEPc", SLEPc.Sys))]
    library = MPI.Get_library_version().splitlines()[0].split(",")[0]
    rows.append(("MPI", " ".join(library.replace("Version:", " ").split())))
    return [*rows, ("Python", f"{platform.python_version()}, {platform.system()} on {platform.machine()}")]


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _commit(git: Path) -> str:
    """Ten digits of the commit of a checkout, read from its files; empty where there is none."""
    try:
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head[:10]
        name = head.removeprefix("ref: ")
        if (git / name).exists():
            return (git / name).read_text()[:10]
        packed = (git / "packed-refs").read_text().splitlines()
        return next((line[:10] for line in packed if line.endswith(f" {name}")), "")
    except OSError:
        return ""


def outside(page: str) -> list[str]:
    """Whatever in the marks of a page would load something else: scripts, links, addresses. Not collective."""
    style = "".join(re.findall(r"<style>.*?</style>", page, re.DOTALL))
    marks = re.findall(r"<[^>]*>", re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL))
    return [found[0] for text in (*marks, style) for found in ADDRESS.finditer(text)]


def embed(path: Path) -> str:
    """A picture as a data URI, so that the page needs no other file."""
    return f"data:{KINDS[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def write_report(
    path: Path,
    *,
    title: str,
    subtitle: str = "",
    figures: Sequence[tuple[Path, str]] = (),
    tables: Sequence[tuple[str, Sequence[Sequence[Any]]]] = (),
    sections: Sequence[Section] = (),
    scene: str = "",
    reproduce: str = "",
    numbers: str = "result.json",
) -> Path:
    """Write the page; what is empty is left out. Not collective: call on one rank.

    The equation of the scene is added unless a section has it, and the versions unless there is nothing to reproduce.

    Args:
        path: the HTML file.
        title, subtitle: first lines.
        figures: short for a section of (picture file, caption).
        tables: short for sections of (title, rows) without header.
        sections: what follows, in this order.
        scene: resolved scene text.
        reproduce: the commands that made this page.
        numbers: the files beside it that hold its numbers.

    Raises:
        ValueError: a row is not as long as its table's header or first row, or the page would load anything.
    """
    given = [Section("", figures=figures)] if figures else []
    given += [*(Section(name, rows=rows) for name, rows in tables), *sections]
    if scene and all(section.title != EQUATION for section in given):
        given.insert(1 if given and not given[0].title else 0, of_scene(scene))
    if reproduce:
        given.append(Section("Versions", rows=versions()))
    page = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined).from_string(TEMPLATE)
    html = page.render(
        title=title,
        subtitle=subtitle,
        sections=[_prepared(section) for section in given],
        scene=scene.strip(),
        reproduce=reproduce.strip(),
        how=HOW.format(numbers=numbers),
    )
    if found := outside(html):
        raise ValueError(f"the page needs more than itself: {found[0]}")
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
    return {
        "title": section.title,
        "paragraphs": [part.strip() for part in section.text.split("\n\n") if part.strip()],
        "code": section.code,
        "equation": equation_html(section.code) if section.title.startswith(EQUATION) and section.code else "",
        "header": section.header,
        "rows": [[_shown(cell) for cell in row] for row in section.rows],
        "align": [Markup(f' class="{kind}"') if kind else "" for kind in kinds],
        "kind": "wider" if section.header else "pairs",
        "figures": figures,
    }


def _column(cells: Sequence[Any]) -> str:
    """Class of a column: "n" for numbers, "t" for text long enough to be broken into lines."""
    texts = [_shown(cell) for cell in cells]
    if all(not t or (isinstance(c, NUMBERS) and not isinstance(c, bool)) for c, t in zip(cells, texts, strict=True)):
        return "n"
    return "t" if max(map(len, texts)) > LONG else ""


def _shown(cell: Any) -> str:
    """Text of a cell: numbers with four digits, counts in full, nothing for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool | np.bool_):
        return "yes" if cell else "no"
    return f"{cell:.4g}" if isinstance(cell, float | np.floating) else str(cell)


def _width(path: Path) -> int:
    """Width of a picture on the page: figures by their size in print, animations by their pixels."""
    if path.suffix == ".svg":
        return SVG_WIDTH
    with Image.open(path) as image:
        dpi = image.info.get("dpi", (0, 0))[0]
        return round(image.width / dpi * PIXELS_PER_INCH) if dpi and path.suffix == ".png" else image.width
