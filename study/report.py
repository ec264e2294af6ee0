"""``report.html``: one self-contained page of a run."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from jinja2 import Environment

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>
body{font:16px/1.5 system-ui,sans-serif;max-width:52rem;margin:2rem auto;padding:0 1rem;color:#222;background:#fff}
h1{font-size:1.5rem;margin-bottom:.2rem} h2{font-size:1.15rem;margin-top:2rem}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
td:first-child{white-space:nowrap;color:#555} img{max-width:100%;height:auto} figure{margin:1rem 0}
figcaption{color:#555;font-size:.9rem} pre{background:#f6f6f6;padding:.8rem;overflow-x:auto;font-size:.85rem}
@media print{body{margin:0;max-width:none} figure,table{break-inside:avoid}}
</style></head><body>
<h1>{{ title }}</h1><p>{{ subtitle }}</p>
{% if equation %}<h2>Equation</h2><pre>{{ equation }}</pre>{% endif %}
{% for figure in figures %}<figure><img src="{{ figure.data }}" alt="{{ figure.caption }}">
<figcaption>{{ figure.caption }}</figcaption></figure>{% endfor %}
{% for table in tables %}<h2>{{ table.title }}</h2><table>{% for row in table.rows %}<tr>
{%- for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>{% endfor %}
<h2>Scene</h2><pre>{{ scene }}</pre>
<h2>Reproduce</h2><pre>{{ reproduce }}</pre>
</body></html>
"""


def embed(path: Path) -> str:
    """A picture as a data URI, so that the page needs no other file."""
    kind = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}[path.suffix]
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def write_report(
    path: Path,
    *,
    title: str,
    subtitle: str,
    tables: list[tuple[str, list[tuple[Any, ...]]]],
    figures: list[tuple[Path, str]],
    scene: str,
    reproduce: str,
    equation: str = "",
) -> Path:
    """Write the page.

    Args:
        path: the HTML file.
        title, subtitle: first lines.
        tables: (title, rows) pairs.
        figures: (picture file, caption) pairs; embedded.
        scene: resolved scene text.
        reproduce: the commands that made this page.
        equation: plain text of the equation of motion.
    """
    page = Environment(autoescape=True, trim_blocks=True).from_string(TEMPLATE)
    html = page.render(
        title=title,
        subtitle=subtitle,
        equation=equation,
        tables=[{"title": name, "rows": rows} for name, rows in tables],
        figures=[{"data": embed(file), "caption": caption} for file, caption in figures],
        scene=scene,
        reproduce=reproduce,
    )
    path.write_text(html, encoding="utf-8")
    return path
