"""The small algebra of `MujocoTissue` in C: `step.c`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.compiled import library
from softgrasp.fem.obstacles.compiled import HEADERS, RIDGE
from softgrasp.fem.petsc import Array
from softgrasp.reduction.bridges.flight import PASSES

SOURCE = Path(__file__).with_name("step.c")
FUNCTIONS = """
void softgrasp_tissue_begin(const Tissue *t, const double *gravity, double *room);
int softgrasp_tissue_end(const Tissue *t, double *room);
void softgrasp_tissue_depart(const Tissue *t);
void softgrasp_tissue_keep(const Tissue *t, const double *gravity);
"""
# work arrays of the C struct by name; a size is a product of letters: k coordinates, n velocities of MuJoCo, r what is
# kept of a root, 3, 6, 9
ROOM = {"known": "k", "pulled": "k6", "turned": "k6", "pairs": "k99", "six": "n6", "product": "n6", "b": "6",
        "before": "n", "user": "n", "inertia": "66", "force": "6", "wrench": "6", "a": "k", "e": "k",
        "begun": "r", "given": "6"}  # fmt: skip


class CompiledStep:
    """What a step of a `MujocoTissue` does before and after MuJoCo solves, in place in its data.

    ``compiled``: ffi and functions of the library; ``tissue``: the `MujocoTissue`, whose arrays are read here.
    """

    def __init__(self, compiled: Any, tissue: Any) -> None:
        self._ffi, self._code = compiled
        self._body, self._gravity, self._data = tissue.body, tissue._gravity, None
        self._root, self._flies = tissue.mj_model.body_rootid[self._body], tissue._flight is not None
        small, k, nv = tissue.small, len(tissue.a), tissue.mj_model.nv
        sizes = {"k": k, "n": nv, "3": 3, "6": 6, "9": 9, "r": 28}
        room = {name: np.zeros(int(np.prod([sizes[c] for c in size]))) for name, size in ROOM.items()}
        given = {
            "E": small.E, "sums": tissue._loads, "G": small.G, "K": small.K, "D": small.D + tissue.dt / 2 * small.K,
            "inverse": tissue.inverse, "J": tissue._J, "Jd": tissue._Jd, "past": tissue._past, "rate": tissue._rate,
        }  # fmt: skip
        self._arrays = {name: np.ascontiguousarray(array) for name, array in given.items()} | room
        self._rows, self._columns = tissue._rows, tissue._columns
        self._struct = self._ffi.new("Tissue *")
        self._struct.k, self._struct.nv, self._struct.entries = k, nv, len(self._rows)
        self._struct.free = self._struct.place = -1
        if tissue._flight is not None:
            self._flown = tissue._flight.views
            self._struct.free, self._struct.place = tissue._flight.free, tissue._flight.place
            for name, array in zip(("own_M", "own_J", "own_Q", "own_v"), self._flown, strict=True):
                setattr(self._struct, name, self._at(array))
        self._struct.h = tissue.dt
        for name, array in self._arrays.items():
            setattr(self._struct, name, self._at(array))
        self._struct.rows, self._struct.columns = self._at(self._rows, "int"), self._at(self._columns, "int")
        self._room, self._fall = np.zeros(2 * k), self._at(self._gravity)
        self._room_at = self._at(self._room)

    @classmethod
    def of(cls, tissue: Any) -> CompiledStep | None:
        """For a tissue whose arrays are there; None, with a warning, without a compiler."""
        code = SOURCE.read_text()
        struct = code[code.index("typedef struct {") : code.index("} Tissue;")] + "} Tissue;\n"
        otherwise = "tissue in MuJoCo is stepped in NumPy, more slowly"
        compiled = library(SOURCE, struct + FUNCTIONS, otherwise, HEADERS, (f"RIDGE={RIDGE!r}", f"PASSES={PASSES}"))
        return None if compiled is None else cls(compiled, tissue)

    def _at(self, values: Any, kind: str = "double") -> Any:
        return self._ffi.from_buffer(f"{kind}[]", values)

    def begin(self, data: Any, a: Array, e: Array) -> None:
        """Add inertia to MuJoCo's mass matrix and loads to its applied forces, from coordinates a and rates e, (k,)."""
        if data is not self._data:  # its arrays stay where they are
            self._data = data
            names = ("qpos", "qvel", "M", "qfrc_applied", "qfrc_smooth", "qfrc_bias")
            self._views = {"Q": data.xmat[self._body], "R": data.xmat[self._root]}
            self._views |= {name.removeprefix("qfrc_"): getattr(data, name) for name in names}
            for name, view in self._views.items():
                setattr(self._struct, name, self._at(view))
        self._arrays["a"][:], self._arrays["e"][:] = a, e
        if self._flies:
            self._code.softgrasp_tissue_depart(self._struct)
        self._code.softgrasp_tissue_begin(self._struct, self._fall, self._room_at)

    def end(self) -> bool:
        """The state at the end of the step; whether it is finite."""
        return bool(self._code.softgrasp_tissue_end(self._struct, self._room_at))

    def keep(self) -> None:
        """The momenta of a tree that no constraint held in the step."""
        self._code.softgrasp_tissue_keep(self._struct, self._fall)

    def state(self) -> tuple[Array, Array, Array]:
        """Coordinates a and rates e, (k,), and the wrench on the body in its axes, (6,) [N, N m]."""
        return self._arrays["a"].copy(), self._arrays["e"].copy(), self._arrays["wrench"].copy()
