"""The C of an energy, written from its operations and compiled once for a machine."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.compiled import LANES, cache_folder, library
from softgrasp.fem.energy.program import Operations, Program
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import Start
from softgrasp.fem.strain.points import QuadraturePoints, node_arrays

DECLARATION = """
void softgrasp_energy(int p, const double *H, const double *par, double *W);
void softgrasp_stress(int p, const double *H, const double *par, double *P);
void softgrasp_tangent(int p, const double *H, const double *par, double *A);
void softgrasp_step(int p, const double *H, const double *w, const double *par, double *keep, double *P);
void softgrasp_begin(int k, int p, const int *node, const double *G, const double *z, const double *par, double *H0,
                     double *j0, double *keep);
int softgrasp_force(int k, int p, const int *node, const double *G, const double *vol, const double *par,
                    const double *H0, const double *keep, const double *w, int n, double *f, double *J);"""


def source(law: Operations) -> str:
    """The text of `points.c` with the operations of an energy."""
    text, d = Path(__file__).with_name("points.c").read_text(), law.d
    places = [(i, j) for i in range(d) for j in range(d)]
    reads = {f"{key}.{i}{j}": f"{name}({d * i + j})" for key, name in (("H", "B"), ("w", "M")) for i, j in places}
    reads |= {name: f"A({i})" for i, name in enumerate(law.inputs)}
    programs, kept = law.programs, law.kept
    keep, step, density = Program(law.graph, kept), programs["step"], programs["energy"]

    def body(lines: list[str], program: Program, target: str) -> str:
        stores = (target.format(i=i, v=program.name(n)) for i, n in enumerate(program.outputs))
        return "\n  ".join([*lines, *stores])

    rows = "store({array} + (size_t){{i}} * p + q, {{v}});"
    parts = {
        "@D@": str(d),
        "@KEEP@": body(keep.lines(reads), keep, rows.format(array="keep")),
        "@STEP@": body(step.lines(reads, kept), step, "P[{i}] = {v};"),
        "@ENERGY@": body(density.lines(reads), density, "return {v};"),
    }
    for mark, key, array in (("@STRESS@", "stress", "P"), ("@TANGENT@", "tangent", "A")):
        parts[mark] = body(programs[key].lines(reads), programs[key], rows.format(array=array))
    for mark, part in parts.items():
        text = text.replace(mark, part)
    return text


def compiled(law: Operations) -> Library | None:
    """The compiled functions of an energy; None, with a warning, where they cannot be compiled."""
    text = source(law)
    path = cache_folder() / f"energy-{hashlib.sha256(text.encode()).hexdigest()[:20]}.c"
    if not path.exists():  # several ranks may write at once: each its own file, and the last one stays
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".c")
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.replace(name, path)
    code = library(path, DECLARATION, "the energy is computed by NumPy, many times slower")
    return None if code is None else Library(law, code)


class Library:
    """Compiled functions of an energy on arrays of points."""

    def __init__(self, law: Operations, code: Any) -> None:
        (self.ffi, self.c), self.d, self.kept = code, law.d, len(law.kept)

    def at(self, x: Any) -> Any:
        """Pointer to a contiguous array."""
        return self.ffi.from_buffer("int[]" if x.dtype == np.intc else "double[]", x)

    def run(self, key: str, H: Array, moduli: tuple[Array, ...], w: Array | None = None) -> Array:
        """The results of a program in all points, (outputs, Q)."""
        Q, n = H.shape[-1], self.d**2
        p = -(-Q // LANES) * LANES
        par = padded_moduli(moduli, Q, p)
        inputs = [self.at(padded(x.reshape(n, Q), p)) for x in (H, w) if x is not None]
        count = {"energy": 1, "tangent": n * (n + 1) // 2}.get(key, n)
        result = np.empty((count, p))
        own = [self.at(np.empty(max(self.kept, 1) * p))] if key == "step" else []
        getattr(self.c, f"softgrasp_{key}")(p, *inputs, self.at(par), *own, self.at(result))
        return result[:, :Q]


def padded(x: Array, p: int) -> Array:
    """Rows of p entries, zeros at the end."""
    return np.ascontiguousarray(np.pad(x, ((0, 0), (0, p - x.shape[1]))))


def padded_moduli(moduli: tuple[Array, ...], Q: int, p: int) -> Array:
    """Parameters of Q points as rows of p, the last value at the end."""
    par = np.zeros((max(len(moduli), 1), p))
    for row, x in zip(par, moduli, strict=False):
        row[:Q] = x
        row[Q:] = row[Q - 1] if Q else 0.0
    return par


class EnergyKernel:
    """Points of one rank with their nodes, as `softgrasp.fem.strain.body.Kernel` has them for a built-in law.

    Args:
        points: quadrature points, B on one rank.
        moduli: parameters of every point, (Q,) each.
        library: compiled functions of their energy.

    Attributes:
        J: det F at the end of the last trial step, (Q,) [1].
    """

    def __init__(self, points: QuadraturePoints, moduli: tuple[Array, ...], library: Library) -> None:
        d, Q = points.d, len(points.vol)
        node, G, k, p = node_arrays(points, LANES)
        self.library, at = library, library.at
        H, j, J = np.zeros((d, d, p)), np.zeros(p), np.zeros(p)
        self.begin, self.J = Start(H[:, :, :Q], j[:Q], j[:Q]), J[:Q]
        self.size = (k, p, at(node), at(G))
        self.vol, self.par = at(np.pad(points.vol, (0, p - Q))), at(padded_moduli(moduli, Q, p))
        self.H, self.j, self.keep = at(H), at(j), at(np.zeros(max(library.kept, 1) * p))
        self.end = at(J)

    def start(self, z: Array) -> Start:
        """The law at the start of a step; valid until the next call."""
        c, at = self.library.c, self.library.at
        c.softgrasp_begin(*self.size, at(z), self.par, self.H, self.j, self.keep)
        return self.begin

    def force(self, w: Array, f: Array) -> bool:
        """Force f [N] of the discrete gradient over a step of 2 w from the last start; whether there is a stress."""
        c, at = self.library.c, self.library.at
        answer = c.softgrasp_force(*self.size, self.vol, self.par, self.H, self.keep, at(w), len(f), at(f), self.end)
        return bool(answer)
