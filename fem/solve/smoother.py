"""The sum over the vertex stars of inverse blocks of a matrix S, by their factors in single precision.

    B = sum over vertices of R_v' W_v' W_v R_v,   W_v = L_v^-1,   L_v L_v' = R_v S R_v',

R_v taking the free nodes of the cells at v. B is not assembled: the triangles W_v in single precision take a quarter of
the memory of B. As products of W_v and its transpose, whose entries are fixed, and with sums in double precision, B is
symmetric and positive definite whatever was rounded; the rounding changes its least eigenvalues by about
1e-7 cond(R_v S R_v')^(1/2) of themselves, so neither units nor layers of unequal stiffness need a scaling.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.compiled import address
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.layout import Patches
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.solve.differences import product_code

Single = NDArray[np.float32]
BYTES = 2**26  # memory of the stars that are inverted at once [byte]
SIDE = 4  # stars beside each other in products.c


class Smoother:
    """The product y = B x. Making one is collective, and so are the products.

    Without a compiler NumPy multiplies with the same factors, at several times the time.

    Args:
        S: symmetric positive definite matrix as single entries (AIJ).
        patches: its stars.
        d: unknowns of a node.

    Raises LinAlgError: S is not positive definite.
    """

    def __init__(self, S: PETSc.Mat, patches: Patches, d: int) -> None:
        low, high = (end // d for end in S.getOwnershipRange())
        seen = np.unique(patches.node)
        others, own = seen[(seen < low) | (seen >= high)], high - low
        self.d, self._code = d, product_code()
        self.ghosts = PETSc.Vec().createSeq(d * len(others), comm=PETSc.COMM_SELF)
        self.back = self.ghosts.duplicate()
        places = PETSc.IS().createBlock(d, others.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        like = S.createVecLeft()
        self.scatter = PETSc.Scatter().create(like, places, self.ghosts, None)
        self._spread = S.comm.size > 1
        places.destroy()
        like.destroy()
        blocks = star_blocks(S, seen, d)
        sizes: list[int] = []
        nodes: list[NDArray[np.intc]] = []
        factors: list[Single] = []
        with raise_on_all_ranks(S.comm.tompi4py()):
            for at, W in star_factors(blocks, seen, patches, d):
                mine = (at >= low) & (at < high)
                places_here = np.where(mine, at - low, own + np.searchsorted(others, at)).astype(np.intc)
                if self._code is None:
                    nodes.append(places_here)
                    factors.append(W.astype(np.float32))
                    continue
                rows, columns = np.tril_indices(W.shape[1])
                nodes.append(side_by_side(places_here, repeat=True).ravel())
                factors.append(side_by_side(W[:, rows, columns].astype(np.float32)).ravel())
                sizes += [at.shape[1]] * -(-len(at) // SIDE)
        if self._code is not None:
            self.sizes = np.array(sizes, dtype=np.intc)
            nodes = [np.concatenate([*nodes, np.zeros(0, np.intc)])]
            factors = [np.concatenate([*factors, np.zeros(0, np.float32)])]
            self._arguments = (d, len(sizes), *map(address, (self.sizes, nodes[0], factors[0])), own)
        self.nodes, self.factors = nodes, factors

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set y = B x. Collective."""
        if self._spread:
            self.scatter.scatter(x, self.ghosts)
        if self._code is None:
            left = self._multiply(np.concatenate([x.array_r, self.ghosts.array_r]))
            y.array_w[:], self.back.array_w[:] = np.split(left, [y.getLocalSize()])
        else:
            for to in (y, self.back):
                to.set(0.0)
            vectors = x.array_r, self.ghosts.array_r, y.array_r, self.back.array_r
            self._code.softgrasp_stars(*self._arguments, *map(address, vectors))
            for to in (y, self.back):
                to.stateIncrease()
        if self._spread:
            self.scatter.scatter(self.back, y, addv=True, mode=PETSc.ScatterMode.REVERSE)

    def _multiply(self, x: Array) -> Array:
        """B x without compiled code, for and of the nodes here and those of other ranks."""
        right = x.reshape(-1, self.d)
        left = np.zeros_like(right)
        for nodes, W in zip(self.nodes, self.factors, strict=True):
            part = W.mT @ (W @ right[nodes].reshape(len(nodes), -1, 1))
            np.add.at(left, nodes, part.reshape(*nodes.shape, self.d))
        return left.ravel()

    @property
    def arrays(self) -> list[Any]:
        """Nodes and factors of the stars here."""
        return [*self.nodes, *self.factors]

    def destroy(self) -> None:
        """Free PETSc's objects. Collective."""
        for part in (self.ghosts, self.back, self.scatter):
            part.destroy()


def side_by_side[Kind: np.generic](values: NDArray[Kind], repeat: bool = False) -> NDArray[Kind]:
    """Rows of stars (stars, k) by fours, (fours, k, 4), the last four filled with zeros, or with the first row."""
    fill = np.broadcast_to(values[:1], (-len(values) % SIDE, values.shape[1]))
    whole = np.concatenate([values, fill if repeat else np.zeros_like(fill)])
    return whole.reshape(-1, SIDE, values.shape[1]).transpose(0, 2, 1)


def star_blocks(S: PETSc.Mat, seen: NDArray[Any], d: int) -> Any:
    """Rows and columns of S of the nodes that the stars here see, as SciPy's blocks of d x d. Collective."""
    rows = PETSc.IS().createBlock(d, seen.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
    (local,) = S.createSubMatrices([rows], [rows])
    indptr, columns, values = local.getValuesCSR()
    size = local.getSize()
    local.destroy()
    rows.destroy()
    return scipy.sparse.csr_matrix((values, columns, indptr), shape=size).tobsr((d, d))


def star_factors(blocks: Any, seen: NDArray[Any], patches: Patches, d: int) -> Iterator[tuple[NDArray[Any], Array]]:
    """Nodes (stars, m) and factors W (stars, m d, m d) of this rank's stars, those of one size together."""
    n = len(seen)
    blocks.sort_indices()
    keys = np.repeat(np.arange(n, dtype=np.int64), np.diff(blocks.indptr)) * n + blocks.indices
    for nodes in equal_stars(patches, d):
        at = np.searchsorted(seen, nodes)
        m = at.shape[1]
        key = (at[:, :, None] * n + at[:, None, :]).ravel()
        place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        data = np.where((keys[place] == key)[:, None, None], blocks.data[place], 0.0)
        dense = data.reshape(-1, m, m, d, d).transpose(0, 1, 3, 2, 4).reshape(-1, m * d, m * d)
        yield nodes, np.linalg.inv(np.linalg.cholesky(dense))


def equal_stars(patches: Patches, d: int) -> Iterator[NDArray[Any]]:
    """Nodes (stars, m) of stars of one size, in parts whose inverses need little memory."""
    sizes = np.unique(patches.star, return_counts=True)[1]
    first = np.append(0, np.cumsum(sizes))
    for m in np.unique(sizes):
        stars = np.flatnonzero(sizes == m)
        for part in np.array_split(stars, -(-len(stars) * 8 * (m * d) ** 2 // BYTES)):
            yield patches.node[first[part][:, None] + np.arange(m)]
