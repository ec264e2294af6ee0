"""Text meshes of Gmsh (2.2 and 4.1) and Abaqus, in a tenth of meshio's time.

Files are read as these programs write them and give what meshio gives; all others, and wrong ones, are left to meshio.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import mmap
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt

from softgrasp.fem.compiled import functions, packed
from softgrasp.fem.mesh.check import Integers

SECTIONS = ("MeshFormat", "PhysicalNames", "Entities", "Nodes", "Elements")  # of Gmsh, in this order
SPARSE = 10  # span of the numbers of nodes or cells over how many there are, beyond which a table is too long [1]
_BEGIN, _END = re.compile(rb"\s*\$(\w+)[ \t\r]*\n"), re.compile(rb"[ \t\r]*(?:\n\s*|\Z)")

type Numbers = npt.NDArray[Any]
type Text = bytes | mmap.mmap


class _UnusualError(Exception):
    """Something in the file is left to meshio."""


def read_text(path: Path) -> meshio.Mesh | None:
    """Points, cells, their data and sets, and names as `meshio.read` gives them; None: meshio has to read the file.

    None too without compiled code. Raises OSError: the file cannot be opened.
    """
    with path.open("rb") as file:
        head = file.read(64).split()
        kinds: dict[bytes, Callable[[Text], meshio.Mesh]] = {b"2.2": _gmsh_2, b"4.1": _gmsh_4}
        gmsh = path.suffix.lower() == ".msh" and head[:1] + head[2:4] == [b"$MeshFormat", b"0", b"8"]
        read = _abaqus if path.suffix.lower() == ".inp" else kinds.get(head[1]) if gmsh else None
        if read is None:
            return None
        # what is not written as usual fails in many ways, and the tables of meshio that are used here are not public
        with contextlib.suppress(
            _UnusualError,
            LookupError,
            ValueError,
            ArithmeticError,
            RuntimeError,
            OSError,
            ImportError,
            MemoryError,
            meshio.ReadError,
        ):
            text: Text = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            return read(text if text[-1:] == b"\n" else text[:])  # a byte may be looked at behind the last one
    return None


class _Reader:
    """Reads the numbers of a part of a text one after the other, by `numbers.c`."""

    def __init__(self, text: Text, start: int, stop: int, commas: bool = False) -> None:
        code = functions(Path(__file__).with_name("numbers.c"), "text mesh files are read by meshio, more slowly")
        if code is None:
            raise _UnusualError
        self._read = code.softgrasp_numbers
        self._read.restype = ctypes.c_longlong
        self._text, self._at, self._stop, self._commas = np.frombuffer(text, np.uint8), start, stop, commas

    def take(self, count: int, whole: bool = True) -> Numbers:
        """The next so many numbers, whole or real ones."""
        if not 0 <= count <= self._stop - self._at:
            raise _UnusualError
        values, _ = self._next(count, whole, None)
        if len(values) < count:
            raise _UnusualError
        return values

    def lines(self, whole: bool = True) -> tuple[Numbers, Numbers]:
        """All numbers, and how many stand in each line."""
        most = self._stop - self._at + 1  # what is not written takes no memory
        return self._next(most, whole, np.empty(most, dtype=np.int32))

    def _next(self, most: int, whole: bool, lines: Numbers | None) -> tuple[Numbers, Numbers]:
        values = np.empty(most, dtype=np.int32 if whole else np.float64)
        kinds = (None, values) if whole else (values, None)
        asked = packed(self._stop - self._at, most, int(self._commas), self._text[self._at :], *kinds, lines)
        found = self._read(asked)
        if found < 0:
            raise _UnusualError
        self._at += asked.contents[0]
        return values[:found], values[:0] if lines is None else lines[: asked.contents[1]]


class _Places:
    """The place of each number of a node or cell, the last one where there are several."""

    def __init__(self, numbers: Numbers, kind: Any) -> None:
        if not len(numbers) or numbers.min() < 1 or np.ptp(numbers) > SPARSE * len(numbers):
            raise _UnusualError
        self.low = numbers.min()
        self.places = np.full(int(numbers.max() - self.low) + 1, -1, dtype=kind)
        self.places[numbers - self.low] = np.arange(len(numbers))

    def of(self, numbers: Numbers) -> Numbers:
        """The places of numbers that lie between the least and the largest, -1 of those that are none."""
        if not self.among(numbers).all():
            raise _UnusualError
        return np.asarray(self.places[numbers - self.low])

    def among(self, numbers: Numbers) -> Numbers:
        """Whether numbers lie between the least and the largest."""
        return np.asarray((numbers >= self.low) & (numbers < self.low + len(self.places)))


def _sections(text: Text) -> tuple[dict[str, tuple[int, int]], dict[str, Integers]]:
    """Where the contents of each section of Gmsh begin and end, and the names of physical groups."""
    parts: dict[str, tuple[int, int]] = {}
    at = 0
    while at < len(text):
        begin = _BEGIN.match(text, at)
        name = b"" if begin is None else begin[1]
        start = 0 if begin is None else begin.end()
        stop = text.find(b"\n$End" + name, start - 1)
        end = _END.match(text, stop + len(b"\n$End" + name))
        if begin is None or stop < 0 or end is None:
            raise _UnusualError
        parts[name.decode()] = start, max(start, stop)
        at = end.end()
    if list(parts) != [name for name in SECTIONS if name in parts]:
        raise _UnusualError
    names: dict[str, Integers] = {}
    if "PhysicalNames" in parts:
        from meshio.gmsh.common import _read_physical_names

        start, stop = parts["PhysicalNames"]
        _read_physical_names(io.BytesIO(text[start:stop] + b"\n$EndPhysicalNames\n"), names)
    return parts, names


def _counted(text: Text, part: tuple[int, int]) -> tuple[int, _Reader]:
    """The number in the first line of a section, and a reader of the others."""
    stop = text.find(b"\n", *part)
    return int(text[part[0] : max(stop, part[0])]), _Reader(text, stop + 1, part[1])


def _gmsh_2(text: Text) -> meshio.Mesh:
    """Gmsh 2.2: a row (number, x) for each node, a row (number, type, n, n tags, nodes) for each cell."""
    from meshio._common import num_nodes_per_cell
    from meshio.gmsh import gmsh_to_meshio_type
    from meshio.gmsh.common import _gmsh_to_meshio_order

    parts, names = _sections(text)
    count, reader = _counted(text, parts["Nodes"])
    nodes = reader.take(4 * count, whole=False).reshape(-1, 4)
    places = _Places(nodes[:, 0].astype(np.int32), np.int32)
    count, reader = _counted(text, parts["Elements"])
    values, lengths = reader.lines()
    if not len(lengths) == count or lengths.min() < 5:
        raise _UnusualError
    starts = np.cumsum(lengths, dtype=np.int64) - lengths
    types = values[starts + 1]
    cells, physical, geometrical = [], [], []
    for a, b in pairwise([0, *(np.flatnonzero(np.diff(types)) + 1).tolist(), count]):
        table = values[starts[a] : starts[a] + (b - a) * lengths[a]].reshape(b - a, -1)
        kind, tags = gmsh_to_meshio_type[int(types[a])], int(table[0, 2])
        corners = num_nodes_per_cell[kind]
        if (lengths[a:b] != 3 + tags + corners).any() or (table[:, 2] != tags).any() or tags < 2:
            raise _UnusualError
        cells.append((kind, places.of(_gmsh_to_meshio_order(kind, table[:, -corners:]))))
        physical.append(table[:, 3])
        geometrical.append(table[:, 4])
    data = {"gmsh:physical": physical, "gmsh:geometrical": geometrical}
    return meshio.Mesh(nodes[:, 1:], cells, cell_data=data, field_data=names)


def _gmsh_4(text: Text) -> meshio.Mesh:
    """Gmsh 4.1: nodes and cells by entity, whose physical groups are those of Entities."""
    from meshio._common import num_nodes_per_cell
    from meshio.gmsh import gmsh_to_meshio_type
    from meshio.gmsh.common import _gmsh_to_meshio_order

    parts, names = _sections(text)
    groups = _physical(_Reader(text, *parts["Entities"])) if "Entities" in parts else None
    points, places = _nodes_4(_Reader(text, *parts["Nodes"]))
    reader = _Reader(text, *parts["Elements"])
    cells, physical, geometrical = [], [], []
    sets: dict[str, list[Numbers]] = {name: [] for name in names}
    for _ in range(reader.take(4).tolist()[0]):
        dimension, tag, code, count = reader.take(4).tolist()
        kind = gmsh_to_meshio_type[code]
        table = reader.take(count * (1 + num_nodes_per_cell[kind])).reshape(count, -1)
        cells.append((kind, places.of(_gmsh_to_meshio_order(kind, table[:, 1:]))))
        own = [] if groups is None else groups[dimension][tag]
        physical += [np.broadcast_to(own[0], count)] if own else []
        geometrical.append(np.broadcast_to(tag, count))
        for name, (number, of) in names.items():
            sets[name].append(np.arange(count if of == dimension and number in own else 0, dtype=np.uint64))
    data = {"gmsh:physical": physical, "gmsh:geometrical": geometrical}
    data = {name: each for name, each in data.items() if each}
    return meshio.Mesh(points, cells, cell_data=data, field_data=names, cell_sets=sets)


def _physical(reader: _Reader) -> list[dict[int, list[int]]]:
    """Numbers of the physical groups of each entity, by dimension."""
    groups: list[dict[int, list[int]]] = [{}, {}, {}, {}]
    for dimension, count in enumerate(reader.take(4).tolist()):
        for _ in range(count):
            tag = int(reader.take(1)[0])
            reader.take(6 if dimension else 3, whole=False)  # the box around it
            groups[dimension][tag] = reader.take(int(reader.take(1)[0])).tolist()
            if dimension:
                reader.take(int(reader.take(1)[0]), whole=False)  # entities around it, some with a minus
    return groups


def _nodes_4(reader: _Reader) -> tuple[Numbers, _Places]:
    """Coordinates of the nodes, and the place of each node number."""
    blocks, total = reader.take(4)[:2].tolist()
    numbers, points = [], []
    for _ in range(blocks):
        _, _, parametric, count = reader.take(4).tolist()
        if parametric:
            raise _UnusualError
        numbers.append(reader.take(count))
        points.append(reader.take(3 * count, whole=False).reshape(-1, 3))
    places = _Places(np.concatenate(numbers), np.int64)
    if sum(map(len, points)) != total:
        raise _UnusualError
    return np.concatenate(points), places


def _abaqus(text: Text) -> meshio.Mesh:
    """Abaqus: blocks of lines behind *NODE, *ELEMENT, *NSET and *ELSET; other keywords are passed over."""
    from meshio.abaqus._abaqus import get_param_map

    if np.frombuffer(text, np.uint8).max() > 127 or (text.find(b"\r") >= 0 and re.search(rb"\r[^\n]|\r\Z", text)):
        raise _UnusualError
    file, at = _Abaqus(text), 0
    while at < len(text):
        stop = text.find(b"\n", at) % (len(text) + 1)
        line, at = text[at:stop].decode(), stop + 1
        keyword = line.partition(",")[0].strip().replace("*", "").upper()
        if line.startswith("**") or keyword not in ("NODE", "ELEMENT", "NSET", "ELSET", "INCLUDE"):
            continue
        end = text.find(b"\n*", stop) % (len(text) + 1)
        part, at = (min(at, end), end), end + 1
        if keyword == "NODE":
            file.nodes(part)
        elif keyword == "ELEMENT":
            file.elements(part, get_param_map(line, ["TYPE"]))
        elif keyword == "INCLUDE":
            raise _UnusualError
        else:
            file.set(part, get_param_map(line, [keyword]), keyword)
    return file.mesh()


class _Abaqus:
    """What was read of a file of Abaqus."""

    def __init__(self, text: Text) -> None:
        self.text = text
        self.points = np.zeros(0)
        self.places = _Places(np.ones(1, dtype=np.int32), np.int64)
        self.cells: list[tuple[str, Numbers]] = []
        self.numbers: list[_Places] = []  # place of each cell number, by block
        self.sets: dict[str, list[Any]] = {}
        self.named: dict[str, Numbers] = {}  # all cells of a block with a name
        self.order: list[str] = []  # of these names

    def nodes(self, part: tuple[int, int]) -> None:
        """Rows (number, x), of which a later block replaces those of an earlier one."""
        values, lengths = _Reader(self.text, *part, commas=True).lines(whole=False)
        lengths = lengths[lengths > 0]
        rows = values.reshape(len(lengths), -1)
        if (lengths != rows.shape[1]).any():
            raise _UnusualError
        self.points, self.places = rows[:, 1:], _Places(rows[:, 0].astype(np.int64), np.int64)

    def elements(self, part: tuple[int, int], options: dict[str, str]) -> None:
        """Rows (number, nodes), which may go on in the next line."""
        from meshio._common import num_nodes_per_cell
        from meshio.abaqus._abaqus import abaqus_to_meshio_type

        kind = abaqus_to_meshio_type[options["TYPE"]]
        values, _ = _Reader(self.text, *part, commas=True).lines()
        rows = values.reshape(-1, 1 + num_nodes_per_cell[kind])
        cells = self.places.of(rows[:, 1:])
        if cells.min() < 0:
            raise _UnusualError
        self.numbers.append(_Places(rows[:, 0], np.int32))
        self.cells.append((kind, cells))
        if "ELSET" in options:
            self.named[options["ELSET"]] = np.arange(len(cells), dtype=np.int32)
            self.order.append(options["ELSET"])

    def set(self, part: tuple[int, int], options: dict[str, str], keyword: str) -> None:
        """Numbers of nodes or cells, (first, last, step) of them, or names of sets."""
        from meshio.abaqus._abaqus import _read_set

        text = self.text[slice(*part)]
        names: list[str] = []
        if text[:1].isdigit():
            ids, _ = _Reader(self.text, *part, commas=True).lines()
            if "GENERATE" in options:
                first, last, step = ids.tolist()
                ids = np.arange(first, last + 1, step)
        else:
            ids, names, _ = _read_set(io.StringIO(text.decode()), options)
        if keyword == "NSET":
            if len(ids) and self.places.of(ids).min() < 0:
                raise _UnusualError
            return
        parts = [places.of(ids[places.among(ids)]) for places in self.numbers] if len(ids) else []
        found: list[Any] = [each[each >= 0] for each in parts]
        if not len(ids):
            found = [self.sets[name] if name in self.sets else self.named[name] for name in names]
        self.sets[options[keyword]] = found

    def mesh(self) -> meshio.Mesh:
        """The mesh. Names of blocks come last, and each in the place of its rank among them, as in meshio."""
        for i, name in enumerate(self.order):
            if name in self.sets:
                self.sets[name][i] = self.named[name]
            else:
                empty = np.zeros(0, dtype=np.int32)
                self.sets[name] = [self.named[name] if i == k else empty for k in range(len(self.cells))]
        if not self.cells:
            raise _UnusualError
        return meshio.Mesh(self.points, self.cells, cell_sets=self.sets)
