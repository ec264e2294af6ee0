"""Products by differences of neighbours, which keep digits that the entries of a stiff matrix would lose.

    (K z)_i = sum over j of K_ij (z_j - z_i) + R_i z_i,   R_i = sum over j of K_ij,

for blocks K_ij of d x d of the nodes. Entries of K grow with the ratio of the sides of a cell and with lambda, while a
smooth z leaves little of them in K z; the rounding of that sum is a force in every step. R_i is not zero beside the
nodes that the hand holds alone, but for rounding. As K = K', a pair of nodes is read once for both of its products:
half the memory of K. A step multiplies with -2 K, and CG over vertex stars with its matrix S.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.compiled import address, functions, packed
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc, to_scipy
from softgrasp.fem.solve.cholesky import Dissection

Ints = NDArray[np.intc]
SOURCE = Path(__file__).with_name("products.c")


def product_code() -> Any:
    """The functions of `products.c`, or None with a warning where there is no compiler."""
    return functions(SOURCE, "the balance of energy loses digits on flat cells and near nu = 0.5")


def require_same_code(comm: MPI.Intracomm) -> None:
    """Refuse ranks of which some have compiled code and some have none: their numbers and messages differ. Collective.

    Raises SolverError: it is so.
    """
    without = [rank for rank, has in enumerate(comm.allgather(product_code() is not None)) if not has]
    if 0 < len(without) < comm.size:
        raise SolverError(
            f"rank {without[0]} finds neither a C compiler nor what others have compiled; install one on every "
            "machine, name it in CC, or let XDG_CACHE_HOME be a folder that all of them can read and write"
        )


@dataclass(frozen=True)
class Blocks:
    """Rows of a matrix in blocks of d x d; columns are numbers of nodes."""

    first: Ints  # block with which each row begins, (nodes + 1,)
    columns: Ints  # (blocks,)
    values: Array  # (blocks, d, d)

    def where(self, chosen: NDArray[np.bool_]) -> Blocks:
        """The chosen blocks of each row."""
        counts = np.concatenate([[0], np.cumsum(chosen)])
        return Blocks(counts[self.first].astype(np.intc), self.columns[chosen], self.values[chosen])


class Differences:
    """Products factor K z with the calls of a PETSc matrix. Making one is collective, and so are the products.

    Args:
        rows: blocks of K = K' on the rows here, columns among all nodes.
        begin: number of the first node here.
        like: a vector of the rows here, kept.
        code: from `product_code`.
        factor: of the product [1].
    """

    def __init__(self, rows: Blocks, begin: int, like: PETSc.Vec, code: Any, factor: float) -> None:
        d, nodes = rows.values.shape[1], len(rows.first) - 1
        here = np.repeat(np.arange(begin, begin + nodes, dtype=np.intc), np.diff(rows.first))
        sums, self.like = np.empty((nodes, d, d)), like
        code.softgrasp_sums(d, nodes, *map(address, (rows.first, rows.values, sums)))
        mine = (rows.columns >= begin) & (rows.columns < begin + nodes)
        self.diagonal: Array = factor * rows.values[rows.columns == here].diagonal(axis1=1, axis2=2).ravel()
        above, beside = rows.where(mine & (rows.columns > here)), rows.where(~mine)
        above.values.__imul__(factor)
        beside.values.__imul__(factor)
        sums *= factor
        above.columns.__isub__(np.intc(begin))
        self._pairs = code.softgrasp_pairs
        self._fixed = packed(d, nodes, above.first, above.columns, above.values, sums)
        self.above, self.beside, self.sums = above, beside, sums
        # last vectors and where they begin, which a small step has no time to look up; it stays for their lives, as
        # nothing here calls placeArray
        self._z = self._y = like
        self._from = self._to = address(like.array_r)
        self._low, self._rest = None, None
        self.ghosts: PETSc.Vec | None = None
        if like.comm.size > 1:
            self._ghosts(beside, d, nodes, code)

    def _ghosts(self, beside: Blocks, d: int, nodes: int, code: Any) -> None:
        """Prepare the messages of a product. Collective."""
        others, columns = np.unique(beside.columns, return_inverse=True)
        columns = columns.astype(np.intc)
        places = PETSc.IS().createBlock(d, others.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        self.ghosts, self.behind = (PETSc.Vec().createSeq(d * len(others), comm=PETSc.COMM_SELF) for _ in range(2))
        self.scatter = PETSc.Scatter().create(self.like, places, self.ghosts, None)
        places.destroy()
        self._beside = code.softgrasp_beside
        arrays = beside.first, columns, beside.values, self.ghosts.array_w, self.behind.array_w
        self._of_ghosts = (d, nodes, *map(address, arrays))
        self._kept = arrays  # addresses of which are in the arguments

    def createVecLeft(self) -> PETSc.Vec:  # noqa: N802 - of PETSc
        """A vector of the rows here."""
        return self.like.duplicate()

    def getDiagonal(self) -> PETSc.Vec:  # noqa: N802 - of PETSc
        """The diagonal of factor K."""
        result = self.like.duplicate()
        result.array_w[:] = self.diagonal
        return result

    def mult(self, z: PETSc.Vec, y: PETSc.Vec, low: PETSc.Vec | None = None) -> None:
        """Set y = factor K z, or factor K (z + low). Collective."""
        y.set(0.0)
        self.multAdd(z, y, y, low)

    def multAdd(  # noqa: N802 - of PETSc
        self, z: PETSc.Vec, r: PETSc.Vec, y: PETSc.Vec, low: PETSc.Vec | None = None
    ) -> None:
        """Set y = r + factor K z, or with z + low for a z that is rounded. Collective."""
        if y is not r:
            r.copy(y)
        if z is not self._z:
            self._z, self._from = z, address(z.array_r)
        if low is not self._low:
            self._low, self._rest = low, None if low is None else address(low.array_r)
        if y is not self._y:
            self._y, self._to = y, address(y.array_r)
        if self.ghosts is not None:
            self.scatter.scatter(z, self.ghosts)
            if low is not None:
                self.scatter.scatter(low, self.behind)
            self._beside(*self._of_ghosts, self._from, self._rest, self._to)
        self._pairs(self._fixed, self._from, self._rest, self._to)
        y.stateIncrease()

    @property
    def arrays(self) -> list[Any]:
        """Numbers of the matrix here, and the columns of its blocks."""
        return [self.sums, *(part for rows in (self.above, self.beside) for part in (rows.values, rows.columns))]

    def destroy(self) -> None:
        """Free PETSc's objects. Collective."""
        self.like.destroy()
        if self.ghosts is not None:
            self.ghosts.destroy()
            self.behind.destroy()
            self.scatter.destroy()


def minus_twice(A: PETSc.Mat, d: int, dissection: Dissection | None = None) -> Differences | PETSc.Mat:
    """-2 K in the order of its rows or of a dissection; the product of PETSc where there is no compiler. Collective."""
    code = product_code()
    if code is None:
        K = A.copy() if dissection is None else dissection.matrix(A)
        if K.comm.size == 1:  # the conversion of a parallel matrix destroys its source
            K.convert("baij")
        K.scale(-2.0)
        return K
    return differences(A, d, code, -2.0, dissection)


def differences(A: PETSc.Mat, d: int, code: Any, factor: float, dissection: Dissection | None = None) -> Differences:
    """Products with factor A, A = A', in the order of its rows or of a dissection. Collective."""
    if dissection is None:
        rows = to_scipy(A).tobsr((d, d))
        blocks = rows.indptr, rows.indices, rows.data
    else:
        blocks = dissection.blocks(A)
    first, columns, values = blocks
    rows_here = Blocks(first.astype(np.intc), columns.astype(np.intc), np.ascontiguousarray(values))
    return Differences(rows_here, A.getOwnershipRange()[0] // d, A.createVecLeft(), code, factor)


class Multiplied:
    """What PETSc calls for the product with a matrix that is not assembled."""

    def __init__(self, product: Any) -> None:
        self.product = product

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set y = A x. Collective."""
        self.product.mult(x, y)


def arrays_of(A: PETSc.Mat) -> list[Any]:
    """Numbers and indices of a matrix on this rank."""
    return list(A.getPythonContext().product.arrays if A.getType() == "python" else A.getValuesCSR())


def as_matrix(product: Any, A: PETSc.Mat) -> PETSc.Mat:
    """A product with vectors as a PETSc matrix, symmetric and positive definite, of the sizes of A. Collective."""
    result = PETSc.Mat().createPython(A.getSizes(), Multiplied(product), comm=A.comm)
    result.setOption(PETSc.Mat.Option.SPD, True)
    return result


def replace_product(A: PETSc.Mat, product: Any) -> None:
    """Let a matrix from `as_matrix` multiply by another product."""
    A.getPythonContext().product = product
    A.stateIncrease()
