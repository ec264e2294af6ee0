"""Text to values: the bounds on all entries of a scene, a `--set` or a table of motion.

What passes can be squared, counted, drawn and written as a file name without a special case further on.
"""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from pathlib import Path
from typing import Any

from softgrasp.fem.errors import no_pipe

LARGEST, SMALLEST = 1e50, 1e-50  # squares of areas and of energies stay within double precision
INTEGER = 2**63  # what TOML, HDF5 and PETSc can represent
DEEPEST = 16  # tables and lists in each other; a scene needs 6
LETTERS = 4096  # of a text: the longest path of Linux
KEY = 80  # letters of a key
BYTES = 1 << 26  # of a file, also of one without end

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")  # and halves of surrogate pairs
_KEY = re.compile(rf"[^$\\\t\n]{{1,{KEY}}}")


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, with or without byte order mark.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is too large or no UTF-8 text, as the rest of a sentence about it.
    """
    with no_pipe(path).open("rb") as file:
        data = file.read(BYTES + 1)
    if len(data) > BYTES:
        raise ValueError(f"is larger than {BYTES >> 20} MiB; give a text file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"is not UTF-8 text (line {line}); save it as UTF-8") from None


def parse_toml(text: str) -> dict[str, Any]:
    """`tomllib.loads` with a sentence for all that it meets.

    Raises:
        tomllib.TOMLDecodeError: the text is no TOML.
        ValueError: brackets or digits are beyond every use, as the rest of a sentence about the text.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError(f"has too many nested brackets; at most {DEEPEST} have a meaning") from None
    except ValueError:  # Python's limit on the digits of an integer
        raise ValueError("has an integer of thousands of digits; integers lie between -2^63 and 2^63") from None


def check_values(data: dict[str, Any]) -> None:
    """Bound the values of a parsed scene: depth, keys, texts and numbers.

    Infinite numbers and NaN pass: the types of the scene refuse them by key. Raises ValueError: the first key whose
    value is beyond all use, with what would be right.
    """
    todo: list[tuple[tuple[str, ...], Any]] = [((), data)]
    while todo:
        path, value = todo.pop()
        if len(path) > DEEPEST:
            raise ValueError(f"{'.'.join(path[:3])}... nests more than {DEEPEST} tables and lists; write it flatter")
        if isinstance(value, dict):
            if odd := [key for key in value if not _KEY.fullmatch(key) or _CONTROL.search(key)]:
                name = ".".join((*path, ascii(odd[0])[1:-1][:KEY]))
                raise ValueError(
                    f"{name} is no key; a key has 1 to {KEY} letters and neither $, \\ nor control characters"
                )
            todo += [((*path, key), item) for key, item in reversed(value.items())]
        elif isinstance(value, list):
            todo += [((*path, str(i)), item) for i, item in reversed(list(enumerate(value)))]
        elif reason := _wrong(value):
            raise ValueError(f"{'.'.join(path)} {reason}")


def _wrong(value: Any) -> str:
    """Why a value is beyond all use; empty if it is not."""
    if isinstance(value, str):
        if len(value) > LETTERS:
            return f"has {len(value)} letters; at most {LETTERS} are accepted"
        if sign := _CONTROL.search(value):
            return f"has the control character {sign[0]!a}; give text without it"
    elif isinstance(value, int) and not -INTEGER <= value < INTEGER:
        return f"is an integer of {value.bit_length()} bits; integers lie between -2^63 and 2^63"
    elif isinstance(value, float) and (bounds := out_of_range(value)):
        return f"is {value:g}; give {bounds}"
    return ""


def out_of_range(value: float) -> str:
    """Bounds that a finite number must keep to be computed with; empty if it does."""
    if value == 0 or not math.isfinite(value) or SMALLEST <= abs(value) <= LARGEST:
        return ""
    return f"numbers that are 0 or of size {SMALLEST:g} to {LARGEST:g}"


def read_table(path: Path, *columns: int) -> list[list[float]]:
    """The rows of numbers of a CSV file; a line of names may come first, comments start with #.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no table of finite numbers with one of these numbers of columns, as the rest of a sentence.
    """
    try:
        lines = [row for row in csv.reader(io.StringIO(read_text(path))) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise ValueError(f"is no CSV table ({error}); give numbers with commas between") from None
    rows: list[list[float]] = []
    for i, line in enumerate(lines):
        try:
            row = [float(entry) for entry in line]
        except ValueError as error:
            if i == 0 and not _number(line[0]):
                continue
            raise ValueError(f"has a value that is not a number in data row {len(rows) + 1} ({error})") from None
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            must = f"{len(rows[0])}" if rows else " or ".join(map(str, columns))
            raise ValueError(f"has {len(row)} entries in data row {len(rows) + 1}; it must have {must} columns")
        for j, value in enumerate(row):
            if bounds := ("finite numbers" if not math.isfinite(value) else out_of_range(value)):
                place = "the time" if j == 0 else f"column {j + 1}, at t = {row[0]:g} s,"
                raise ValueError(f"has {value:g} as {place} in data row {len(rows) + 1}; give {bounds}")
        rows.append(row)
    return rows


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
