"""Equations set for a page: formulas in MathML, lines that break between terms only."""

from __future__ import annotations

import re
from collections.abc import Sequence

from markupsafe import Markup, escape

from softgrasp.study.report.equation import Equation


def prose(text: str) -> Markup:
    """Text with formulas between dollars, as HTML."""
    from latex2mathml.converter import convert  # brings an HTTP client

    parts = re.split(r"\$(.*?)\$", text)
    return Markup("").join(Markup(convert(part)) if i % 2 else escape(part) for i, part in enumerate(parts))


def terms(side: Sequence[str], first: str = "") -> list[Markup]:
    """The terms of a side, each behind its sign; a line may break between them."""
    signs = [first, *("−" if term.startswith("$-") else "+" for term in side[1:])]
    shown = [side[0], *(f"${term[2:]}" if term.startswith("$-") else term for term in side[1:])]
    return [
        Markup('<span class="term">{}</span>').format(prose(f"{sign} {term}".strip()))
        for sign, term in zip(signs, shown, strict=True)
    ]


def equation_html(rows: Equation) -> Markup:
    """An equation in blocks, as it is stepped, how it is controlled, and what the symbols are."""
    parts = []
    for head, part in (("in blocks", rows.blocks), ("stepped as", rows.stepped), ("controlled by", rows.feedback)):
        parts += [Markup('<p class="head">{}</p>').format(head)] if part else []
        for name, left, right in part:
            sides = Markup(" ").join([*terms(left), *terms(right, "=")])
            parts.append(Markup('<p class="row"><span class="name">{}</span> {}</p>').format(name, sides))
    parts.append(Markup('<p class="head">with</p>'))
    parts += [Markup('<p class="where">{}</p>').format(prose(text)) for text in rows.where]
    return Markup('<div class="equation">{}</div>').format(Markup("\n").join(parts))
