"""Unstructured grids of VTK, one binary file for all ranks, and the list of such files against time (``.pvd``).

ParaView, PyVista, VisIt and meshio read them; the numbers follow the XML, each array after its length in bytes.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.errors import no_pipe, raise_on_all_ranks
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array, on_root

HEAD = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32", "u1": "UInt8"}
ENTRY = re.compile(r'(<DataSet timestep="(.*?)" part="0" file="(.*?)"/>)<!--(\S*) (.*)-->')
TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")  # the order of a symmetric tensor in VTK


@dataclass(frozen=True)
class Field:
    """One array of a grid."""

    name: str  # as ParaView displays it; empty where the place in the file determines it
    unit: str  # unit, "m/s"
    values: npt.NDArray[np.generic]  # shape (n,) or (n, components)

    def block(self) -> bytes:
        """Length and numbers."""
        values = np.ascontiguousarray(self.values, dtype=self.values.dtype.newbyteorder("<"))
        return np.uint64(values.nbytes).tobytes() + values.tobytes()

    def xml(self, offset: int, more: str = "") -> str:
        """The array's description, for numbers that begin at an offset [bytes]."""
        width = self.values.shape[1] if self.values.ndim > 1 else 0
        more += f' NumberOfComponents="{width}"' if width else ""
        more += "".join(f' ComponentName{i}="{name}"' for i, name in enumerate(TENSOR)) if width == 6 else ""
        unit = f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{self.unit}</InformationKey>'
        return (
            f'<DataArray type="{TYPES[self.values.dtype.str[1:]]}" Name="{self.name}"{more} format="appended" '
            f'offset="{offset}">{unit if self.unit else ""}</DataArray>\n'
        )


@dataclass(frozen=True)
class Grid:
    """The cells of one rank."""

    points: Array  # [m], shape (n, 3)
    cells: npt.NDArray[np.int32]  # local point numbers in VTK's order, shape (m, k)
    kind: int  # VTK's number of the kind of cell

    def fields(self) -> dict[str, list[Field]]:
        """Points and cells as arrays of the file, by the XML element that contains them."""
        m, k = self.cells.shape
        return {
            "Points": [Field("points", "m", self.points)],
            "Cells": [
                Field("connectivity", "", self.cells.ravel()),
                Field("offsets", "", np.arange(k, k * m + 1, k, dtype=np.int32)),
                Field("types", "", np.full(m, self.kind, dtype=np.uint8)),
            ],
        }


def write_vtu(
    comm: MPI.Intracomm, path: Path, grid: Grid, points: list[Field], cells: list[Field], whole: list[Field]
) -> str:
    """Write one file, in which each rank's grid is a piece; its checksum on rank 0. Collective.

    Args:
        points, cells: fields of this rank, one row a point or a cell.
        whole: fields of the whole file, the same on every rank.

    Raises OSError: the file cannot be written.
    """
    parts = grid.fields() | {"PointData": points, "CellData": cells}
    own = b"".join(field.block() for fields in parts.values() for field in fields)
    shared = b"".join(field.block() for field in whole)
    start = len(shared) + int(comm.exscan(len(own)) or 0)  # the first number of this rank
    piece = f'<Piece NumberOfPoints="{len(grid.points)}" NumberOfCells="{len(grid.cells)}">\n{_xml(parts, start)}'
    pieces = comm.gather(piece + "</Piece>\n")
    head = b""
    if pieces is not None:
        head = (
            HEAD.format("UnstructuredGrid")
            + "<UnstructuredGrid>\n"
            + _xml({"FieldData": whole}, 0)
            + "".join(pieces)
            + '</UnstructuredGrid>\n<AppendedData encoding="raw">\n_'
        ).encode()
    begin, length = comm.bcast(len(head)), len(shared) + comm.allreduce(len(own))
    contents = [(begin + start, own)]
    first, last = head + shared, b"\n</AppendedData>\n</VTKFile>\n"
    checks = comm.gather(_check(own))
    if comm.rank == 0:
        contents += [(0, first), (begin + length, last)]
    on_root(comm, lambda: _begin(path))
    try:
        file = MPI.File.Open(comm, str(path), MPI.MODE_CREATE | MPI.MODE_WRONLY)
        try:
            with raise_on_all_ranks(comm):
                for place, content in contents:
                    file.Write_at(place, content)
        finally:
            file.Close()
    except MPI.Exception as error:
        raise OSError(f"{path}: {error}") from error
    return " ".join([_check(first), *(checks or ()), _check(last)])


def _check(part: bytes) -> str:
    """Length and CRC-32 of a part of a file."""
    return f"{len(part)}:{zlib.crc32(part):08x}"


def _begin(path: Path) -> None:
    note(path)
    path.unlink(missing_ok=True)


def _xml(parts: dict[str, list[Field]], start: int) -> str:
    """Elements with their arrays, the first of which begins at `start`."""
    text = ""
    for element, fields in parts.items():
        text += f"<{element}>\n"
        for field in fields:
            text += field.xml(start, f' NumberOfTuples="{len(field.values)}"' if element == "FieldData" else "")
            start += 8 + field.values.nbytes
        text += f"</{element}>\n"
    return text


class Collection:
    """The files of a series against time, a whole ``.pvd`` file after each `add`; rank 0 only.

    ``remark``: kept in it; no "--".
    """

    END = b"</Collection>\n</VTKFile>\n"

    def __init__(self, path: Path, remark: str) -> None:
        self.path, self.last = path, ""  # checksum of the line before
        note(path)
        path.write_bytes(f"{HEAD.format('Collection')}<!--{remark}-->\n<Collection>\n".encode() + self.END)

    def add(self, t: float, file: Path, checks: str) -> None:
        """Append the file of an instant t [s] with its checksum in a comment behind it."""
        with self.path.open("r+b") as stream:
            stream.seek(-len(self.END), 2)
            line = f'<DataSet timestep="{float(t)!r}" part="0" file="{file.relative_to(self.path.parent)}"/>'
            self.last = _check(f"{self.last}{line}{checks}".encode())
            stream.write(f"{line}<!--{self.last} {checks}-->\n".encode() + self.END)

    @classmethod
    def read(cls, path: Path) -> list[tuple[float, Path, str]]:
        """Times [s], files and their checksums. Raises OSError, ValueError: it cannot be read, or is damaged."""
        with path.open("rb") as stream:
            data = stream.read()
        entries, last = [], ""
        if not data.startswith(HEAD.format("Collection").encode()) or not data.endswith(cls.END):
            raise ValueError("it is not whole")
        for line in data.removesuffix(cls.END).decode().splitlines()[4:]:
            found = ENTRY.fullmatch(line)
            if found is None or _check(f"{last}{found[1]}{found[5]}".encode()) != found[4]:
                raise ValueError("a line is not what was written")
            last = found[4]
            entries.append((float(found[2]), path.parent / found[3], found[5]))
        return entries


def check_file(path: Path, checks: str) -> None:
    """Compare a file with its checksum. Raises OSError, ValueError: it cannot be read, or is damaged."""
    with no_pipe(path).open("rb") as stream:
        for check in checks.split():
            if _check(stream.read(int(check.partition(":")[0]))) != check:
                raise ValueError("it is not what was written")
        if stream.read(1):
            raise ValueError("it is longer than what was written")


def note_of(path: Path) -> str:
    """The remark in a ``.pvd`` file; empty if there is none."""
    try:
        line = path.read_text().split("\n", 3)[2]
    except (OSError, UnicodeDecodeError, IndexError):
        return ""
    return line.removeprefix("<!--").removesuffix("-->") if line.startswith("<!--") else ""
