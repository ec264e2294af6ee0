"""``report.html``: one self-contained page of a run, for a telephone, a screen and paper."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image

if TYPE_CHECKING:
    from study.equation import Equation

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>
*{box-sizing:border-box} html{-webkit-text-size-adjust:100%}
body{font:16px/1.5 system-ui,sans-serif;max-width:54rem;margin:1.5rem auto;padding:0 1rem;color:#1a1a1a;
background:#fff;overflow-wrap:break-word}
h1{font-size:1.5rem;line-height:1.2;margin:0 0 .3rem} h2{font-size:1.15rem;margin:2rem 0 .4rem} p{margin:.4rem 0}
.wide{overflow-x:auto} table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.94rem}
td,th{padding:.25rem 1rem .25rem 0;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
thead th{border-bottom:1.5px solid #1a1a1a;vertical-align:bottom} td.n,th.n{text-align:right;white-space:nowrap}
table.wider td,table.wider th{white-space:nowrap}
table.wider td.t{white-space:normal;min-width:10rem}
table.pairs{width:100%} table.pairs td{overflow-wrap:anywhere}
table.pairs td:first-child{width:40%;color:#444;overflow-wrap:normal}
figure{margin:1rem 0} img{display:block;max-width:100%;height:auto} img.big{min-width:36rem}
figcaption{color:#444;font-size:.9rem}
pre{background:#f5f5f5;padding:.7rem;font:.85rem/1.45 ui-monospace,monospace;white-space:pre-wrap;margin:.4rem 0}
@media print{@page{margin:16mm} body{margin:0;max-width:none;padding:0;font-size:10.5pt} .wide{overflow:visible}
h2{break-after:avoid} figure,tr,pre.short{break-inside:avoid} img{max-height:110mm;width:auto} img.big{min-width:0}
table.wider td.t{min-width:0}
table.wider{font-size:8.5pt} table.wider td,table.wider th{white-space:normal}
pre{background:none;border:1px solid #bbb;font-size:8pt} .motion{display:none}}
</style></head><body>
<h1>{{ title }}</h1>{% if subtitle %}<p>{{ subtitle }}</p>{% endif %}

{% for section in sections %}<section>{% if section.title %}<h2>{{ section.title }}</h2>{% endif %}

{% for text in section.paragraphs %}<p>{{ text }}</p>
{% endfor %}
{% if section.code %}<pre class="short">{{ section.code }}</pre>
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
{%- if figure.width > 600 and not figure.moving %} class="big"{% endif %}></div>
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}</section>
{% endfor %}
{% if scene %}<h2>Scene</h2><pre>{{ scene }}</pre>{% endif %}

{% if reproduce %}<h2>Reproduce</h2><pre class="short">{{ reproduce }}</pre>{% endif %}

</body></html>
"""
KINDS = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml", ".jpg": "image/jpeg"}
PIXELS_PER_INCH = 115  # width of a figure on the screen against its width in print
NUMBERS = (int, float, np.integer, np.floating)
LONG = 24  # [letters]
SVG_WIDTH = 800  # [pixel]


@dataclass(frozen=True)
class Section:
    """One part of a page; whatever is given is shown in the order of the attributes.

    Attributes:
        title: heading; empty for none.
        text: paragraphs, parted by empty lines.
        code: text shown as it is, such as an equation.
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


def embed(path: Path) -> str:
    """A picture as a data URI, so that the page needs no other file."""
    return f"data:{KINDS[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def write_report(
    path: Path,
    *,
    title: str,
    subtitle: str = "",
    equation: str = "",
    figures: Sequence[tuple[Path, str]] = (),
    tables: Sequence[tuple[str, Sequence[Sequence[Any]]]] = (),
    sections: Sequence[Section] = (),
    scene: str = "",
    reproduce: str = "",
) -> Path:
    """Write the page; what is empty is left out. Not collective: call on one rank.

    Args:
        path: the HTML file.
        title, subtitle: first lines.
        equation: short for a first section with this text.
        figures: short for a section of (picture file, caption).
        tables: short for sections of (title, rows) without header.
        sections: what follows, in this order.
        scene: resolved scene text.
        reproduce: the commands that made this page.

    Raises:
        ValueError: a row is not as long as its table's header or first row.
    """
    given = [Section("Equation", code=equation)] if equation else []
    given += [Section("", figures=figures)] if figures else []
    given += [Section(name, rows=rows) for name, rows in tables]
    page = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined).from_string(TEMPLATE)
    shown = [_prepared(section) for section in (*given, *sections)]
    html = page.render(title=title, subtitle=subtitle, sections=shown, scene=scene.strip(), reproduce=reproduce.strip())
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
