"""Display of an object: a title and a few named values, as text and as a table in a notebook."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from importlib import import_module
from types import FunctionType
from typing import Any

import numpy as np

UNITS = (
    r"%|1/s|[mµu]?s|[mµ]?m|k?m/s2?|kg(?:/m3)?|[mk]?N(?:/m| m| s)?|Nm|[mk]?J|[kM]?Pa|k?Hz|rad(?:/s)?|deg|[kMG]i?B|min|h"
)
# spaces at which no line may end: "2 %", "N = 14"
TIED = re.compile(rf"(?<=\d) (?=(?:{UNITS})(?![\w/]))|(?<=\bN) (?== )|(?<=\bN =) ")
MOST_LAYERS = 3  # materials that are shown one by one


@dataclass(frozen=True)
class Card:
    """Displayed part of an object."""

    title: str  # kind and name of the object
    rows: tuple[tuple[str, str], ...]  # name and value of each line

    def text(self) -> str:
        """Title and lines, the values in one column."""
        width = max((len(name) for name, _ in self.rows), default=0)
        return "\n".join([self.title, *(f"  {name:<{width}}  {value}" for name, value in self.rows)])

    def html(self) -> str:
        """A small table with its title above."""
        cells = "".join(
            f'<tr><th style="text-align:left">{html.escape(name)}</th>'
            f'<td style="text-align:left">{html.escape(unbroken(value))}</td></tr>'
            for name, value in self.rows
        )
        return f"<div><strong>{html.escape(self.title)}</strong><table>{cells}</table></div>"


class Shown:
    """An object with a :class:`Card`, which ``print`` and notebooks show. Neither is collective."""

    __slots__ = ()

    def card(self) -> Card:
        """Title and lines; without one of its own a data class names its fields, arrays by shape. Not collective."""
        rows = ((entry.name, brief(getattr(self, entry.name))) for entry in fields(self) if entry.repr)  # type: ignore[arg-type]
        return Card(type(self).__name__, tuple(rows))

    def __repr__(self) -> str:
        return self.card().text()

    def _repr_html_(self) -> str:
        return self.card().html()


def drawn(what: str, *of: Any) -> Any:
    """A figure by the floor that draws, :mod:`softgrasp.study.notebook`, loaded by name: nothing below imports it."""
    return getattr(import_module("softgrasp.study.notebook"), what)(*of)


def brief(value: Any) -> str:
    """A value within some forty letters: an array by its shape, an object by its class."""
    if isinstance(value, np.ndarray):
        return f"array {value.shape}"
    if isinstance(value, str | bool | int | float | complex | FunctionType | None):
        text = getattr(value, "__name__", None) or (digits(value) if isinstance(value, float) else str(value))
        return text if len(text) <= 40 else text[:37] + "..."
    if isinstance(value, tuple | list | dict):
        return counted(len(value), "entry", "entries")
    return type(value).__name__


def amount(value: float, unit: str = "") -> str:
    """A number of three digits with its unit: "0.0123 m"."""
    return f"{digits(value, 3)} {unit}".rstrip()


def digits(value: float, count: int = 4) -> str:
    """A number of some digits, below ten million without a power of ten: "30000"."""
    text = f"{value:.{count}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e7 else text


def counted(number: int, one: str, many: str = "") -> str:
    """A number of things: "1 step", "600 steps"."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def listed(names: Iterable[str], most: int = 6) -> str:
    """Names in a row, no more than ``most`` of them: "tip_x, tip_y, 4 more"; "none" without any."""
    names = tuple(names)
    shown = names if len(names) <= most else (*names[: most - 1], f"{len(names) - most + 1} more")
    return ", ".join(shown) or "none"


def length_unit(largest: float) -> tuple[float, str]:
    """Factor and name of the unit in which a length in metres reads well."""
    if largest >= 0.1 or largest == 0.0:
        return 1.0, "m"
    return (1e3, "mm") if largest >= 1e-4 else (1e6, "µm")


def percent(share: float, sign: str = "", digits: int = 2) -> str:
    """A share as a percentage of so many digits, "+" with its sign; "> 9999 %" also where it is not finite."""
    if not abs(share) < 100:
        return "< -9999 %" if share < 0 else "> 9999 %"
    return f"{100 * share:{sign}{f'.{digits}g' if abs(share) < 0.995 else '.0f'}} %"


def unbroken(text: str) -> str:
    """The text with no-break spaces between numbers and units, so that no line begins with "%", and in "N = 14"."""
    return TIED.sub("\u00a0", text)
