"""The force of a step by `force.c`: gradient, law and its force on the nodes in one pass over the points of a rank."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.strain.compiled import LANES, library
from softgrasp.fem.strain.laws import LAWS, Start
from softgrasp.fem.strain.points import Points

DECLARATION = """
void softgrasp_start(int d, int k, int p, const int *node, const double *G, const double *z, double *H0, double *j0,
                     double *l0);
int softgrasp_force(int law, int d, int k, int p, const int *node, const double *G, const double *vol,
                    const double *lam, const double *mu, const double *H0, const double *j0, const double *l0,
                    const double *w, int n, double *f, double *J);"""


def compiled() -> Any:
    """(ffi, library) of `force.c`, or None with a warning where it cannot be compiled."""
    return library(Path(__file__).with_name("force.c"), DECLARATION, "finite strain steps in NumPy, twice as slow")


class Kernel:
    """Points of one rank with their nodes.

    Args:
        points: on a communicator of this rank alone.
        lam, mu: in every point [Pa], (Q,).
        code: from :func:`compiled`.

    Attributes:
        J: det F at the end of the step tried last, (Q,).
    """

    def __init__(self, points: Points, lam: Array, mu: Array, code: Any) -> None:
        (ffi, self.c), d, Q = code, points.d, len(points.vol)
        B = to_scipy(points.B)
        counts = np.diff(B.indptr[: Q + 1])  # the rows of a point have the same nodes
        point, k, p = np.repeat(np.arange(Q), counts), int(counts.max(initial=0)), -(-Q // LANES) * LANES
        place = np.arange(len(point)) - np.repeat(B.indptr[:Q], counts)
        node, G = np.zeros((p, k), dtype=np.intc), np.zeros((p, k, d))
        node[point, place] = B.indices[: len(point)] // d
        for j in range(d):
            G[point, place, j] = B.data[B.indptr[j * Q] : B.indptr[(j + 1) * Q]]
        node = np.ascontiguousarray(node.reshape(-1, LANES, k).swapaxes(1, 2))
        G = np.ascontiguousarray(G.reshape(-1, LANES, k, d).transpose(0, 2, 3, 1))
        H, change, log, J = np.zeros((d, d, p)), np.zeros(p), np.zeros(p), np.zeros(p)
        self.begin, self.J = Start(H[:, :, :Q], change[:Q], log[:Q]), J[:Q]

        def at(x: Any) -> Any:
            return ffi.from_buffer("int[]" if x.dtype == np.intc else "double[]", x)

        self.at = at
        self.law = list(LAWS).index(points.law)
        self.size = (d, k, p, at(node), at(G))
        self.points = tuple(at(np.pad(x, (0, p - Q))) for x in (points.vol, lam, mu))
        self.state, self.end = (at(H), at(change), at(log)), at(J)

    def start(self, z: Array) -> Start:
        """The law at the start of a step; valid until the next call."""
        self.c.softgrasp_start(*self.size, self.at(z), *self.state)
        return self.begin

    def force(self, w: Array, f: Array) -> bool:
        """Force f [N] of the discrete gradient over a step of 2 w from the last start; whether there is a stress."""
        return bool(
            self.c.softgrasp_force(
                self.law, *self.size, *self.points, *self.state, self.at(w), len(f), self.at(f), self.end
            )
        )
