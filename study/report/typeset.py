"""Equations as text set for a page: italic symbols, real sub- and superscripts, lines that break between terms only."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "lambda": "λ", "mu": "μ", "nu": "ν", "rho": "ρ", "sigma": "σ",
    "zeta": "ζ", "omega": "ω",
}  # fmt: skip
NAMES = {"min", "max"}  # upright
SYMBOL = re.compile(r"(?<![\w'&])([A-Za-z]+)(?:_(\w+))?('{1,2})?(?:\^(-?\w+))?(?!\w)")
PRIMES = {"'": "′", "''": "″"}
LETTERS = set("bcdefghijklmnopqrstuvwxyzABCDEFGHJKLMNOPQRSTUVWXYZ")  # not the article, nor I
BREAKS = {"+", "-", "=", "=="}


def symbol(match: re.Match[str]) -> str:
    """One symbol as HTML, or the word as it is when it is a word."""
    name, below, primes, power = match.groups()
    sign = len(name) == 1 and name in LETTERS
    if not (sign or below or name in GREEK or power) or name in NAMES:
        return match[0]
    shown = GREEK.get(name, name)
    text = f"<i>{shown}</i>" if len(shown) == 1 else shown
    above = ""
    if primes:
        # a capital is a matrix and its prime the transpose; a small letter moves and its primes are rates
        above = "⊤" if name.isupper() else ""
        text += "" if name.isupper() else PRIMES[primes]
    if below:
        inner = GREEK.get(below, below)
        text += f"<sub>{inner if inner.isdigit() or len(inner) > 2 else f'<i>{inner}</i>'}</sub>"
    above += power.replace("-", "−").replace("T", "⊤") if power else ""
    return text + (f"<sup>{above}</sup>" if above else "")


def formula(text: str) -> Markup:
    """A formula, or prose with formulas in it, as HTML."""
    safe = str(escape(text)).replace("&#39;", "'")
    marked = re.sub(r"\bint ", "∫ ", SYMBOL.sub(symbol, safe).replace("&lt;", "⟨").replace("&gt;", "⟩"))
    return Markup(re.sub(r"(?<=[\s(\[])-(?=[\s\w<(])|^-", "−", marked))


def terms(text: str) -> list[Markup]:
    """The formula in pieces between which a line may break: each begins with its operator."""
    pieces, depth = [""], 0
    for word in text.split(" "):
        if depth == 0 and word in BREAKS and pieces[-1]:
            pieces.append(word)
        else:
            pieces[-1] += (" " if pieces[-1] else "") + word
        depth += sum(map(word.count, "(<[")) - sum(map(word.count, ")>]"))
    return [formula(" " + piece)[1:] if piece.startswith("-") else formula(piece) for piece in pieces]


def equation_html(text: str) -> Markup:
    """The lines of `study.report.page.equation_text` as HTML.

    A line that ends in a colon heads what follows; ``name: formula`` has its formula beside the name; other lines are
    prose with formulas.
    """
    parts = []
    rows = True
    for line in text.splitlines():
        name, colon, right = line.strip().partition(": ")
        if not line.strip():
            continue
        if line.endswith(":"):
            rows = line != "with:"
            parts.append(Markup('<p class="head">{}</p>').format(line[:-1]))
        elif rows and colon:
            pieces = Markup(" ").join(Markup('<span class="term">{}</span>').format(t) for t in terms(right.strip()))
            parts.append(Markup('<p class="row"><span class="name">{}</span> {}</p>').format(name, pieces))
        else:
            parts.append(Markup('<p class="where">{}</p>').format(formula(line.strip())))
    return Markup('<div class="equation">{}</div>').format(Markup("\n").join(parts))
