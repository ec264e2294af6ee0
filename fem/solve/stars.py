"""Multigrid in two levels for elements of order 2 and more, flat in size and ranks for nearly incompressible tissue.

A V-cycle smooths S w = r by Chebyshev iterations with the overlapping blocks of the vertex stars [SMPZ08],

    B = sum over vertices of R_v' (R_v S R_v')^-1 R_v,

R_v taking the free nodes of the cells at v, and corrects it on linear elements, P'S P e = P'r. B is one sparse matrix:
for quadratic elements it has fewer entries than S.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.layout import BlockLayout, Patches
from softgrasp.fem.petsc import Array, PETSc, petsc_options, to_ranks

DEGREE = 2  # degree of the Chebyshev polynomial: 3 saves a sixth of the iterations for 1.4 times the time
COARSE_LIMIT = 20_000  # largest number of unknowns of the linear elements that one rank factors [1]
BYTES = 2**26  # memory of the stars that are inverted at once [byte]
# The upper bound of the spectrum of B S is PETSc's estimate; what lies below a tenth of it is left to the coarse level.
SMOOTHER: dict[str, object] = {"mg_levels_ksp_chebyshev_esteig": "0,0.1,0,1.1", "mg_levels_ksp_type": "chebyshev"}
FACTORED: dict[str, object] = {
    "mg_coarse_ksp_type": "preonly",
    "mg_coarse_pc_type": "cholesky",
    "mg_coarse_pc_factor_mat_solver_type": "mumps",
}
ITERATED: dict[str, object] = {
    "mg_coarse_ksp_type": "cg",
    "mg_coarse_ksp_rtol": 0.1,  # as good as a factor: one iteration more
    "mg_coarse_ksp_max_it": 30,
    "mg_coarse_ksp_converged_maxits": "",  # to stop there is no failure
    "mg_coarse_pc_type": "gamg",
    "mg_coarse_pc_gamg_threshold": 0.01,
    "ksp_fcg_mmax": 5,  # as few iterations as with 30, and a sixth of the vectors
    "ksp_fcg_nprealloc": 5,
}


class Stars:
    """The V-cycle of one matrix as the preconditioner of a solver, on the patches of the layout.

    Args:
        ksp: solver with its prefix and type; it receives operators and preconditioner here.
        S: symmetric positive definite matrix as single entries (AIJ), owned by the caller, who may free it.
        layout: layout of the unknowns, of order 2 or more.

    Attributes:
        factored: whether the linear elements are factored, so that the V-cycle is a fixed matrix.

    Making one is collective.
    """

    def __init__(self, ksp: PETSc.KSP, S: PETSc.Mat, layout: BlockLayout) -> None:
        assert layout.patches is not None
        self.layout, self.patches, self.ksp = layout, layout.patches(), ksp
        d, p = layout.dimension, self.patches
        q = np.arange(d)
        rows, columns = d * p.row[:, None] + q, d * p.column[:, None] + q
        ranges = np.asarray(S.getOwnershipRanges(), dtype=np.int64) // d
        self.blocks = pattern(p, layout.comm, ranges)
        self.P = self._matrix(d * p.count, rows, columns, np.repeat(p.weight, d))
        self.factored = factored(layout)
        self.matrices: tuple[PETSc.Mat, ...] = ()
        self.renew(S)

    def renew(self, S: PETSc.Mat) -> None:
        """Set up the V-cycle for another matrix of the same pattern. Collective."""
        d, ksp = self.layout.dimension, self.ksp
        for old in self.matrices:
            old.destroy()
        smoother = self._smoother(S)
        linear = S.ptap(self.P)
        linear.setBlockSize(d)
        self._set_rigid_modes(linear)
        fine = S.convert("baij", PETSc.Mat())
        for A in (fine, linear):
            A.setOption(PETSc.Mat.Option.SPD, True)
        self.matrices = fine, smoother, linear
        ksp.setOperators(fine)
        pc = ksp.getPC()
        if pc.getType() is None:
            pc.setType("mg")
            pc.setMGLevels(2)  # the levels get the prefix of this moment
            pc.setMGInterpolation(1, self.P)
        coarse = None
        if pc.getType() == "mg":
            level, coarse = pc.getMGSmoother(1), pc.getMGCoarseSolve()
            level.setOperators(fine, smoother)
            level.setType("chebyshev")
            level.getPC().setType("mat")
            level.setTolerances(max_it=DEGREE)
            coarse.setOperators(linear, linear)
        with petsc_options(ksp.getOptionsPrefix(), SMOOTHER | (FACTORED if self.factored else ITERATED)):
            ksp.setFromOptions()
            ksp.setUp()
            if coarse is not None and pc.getType() == "mg":  # the options may have changed it
                coarse.setUp()

    @property
    def package(self) -> str:
        """Package that solves the linear elements, as PETSc reports it; "" where the user's options took them away."""
        pc = self.ksp.getPC()
        if pc.getType() != "mg":
            return ""
        pc = pc.getMGCoarseSolve().getPC()
        return str(pc.getFactorSolverType() or pc.getType()).upper()

    def _smoother(self, S: PETSc.Mat) -> PETSc.Mat:
        """B in blocks. Collective."""
        d, size = self.layout.dimension, (self.layout.n_local, self.layout.n_e)
        B = PETSc.Mat().createBAIJ((size, size), d, nnz=self.blocks, comm=self.layout.comm)
        for nodes, inverses in star_inverses(S, self.patches, d):
            stars, m = nodes.shape
            rows, columns = nodes.ravel().astype(PETSc.IntType), np.repeat(nodes, m, axis=0).ravel()
            starts = m * np.arange(stars * m + 1, dtype=PETSc.IntType)
            blocks = inverses.reshape(stars, m, d, m, d).transpose(0, 1, 3, 2, 4).ravel()
            B.setValuesBlockedIJV(starts, columns.astype(PETSc.IntType), blocks, addv=True, rowmap=rows)
        B.assemble()
        return B

    def _matrix(self, columns: int, rows: NDArray[Any], at: NDArray[Any], values: Array) -> PETSc.Mat:
        """A matrix of n_local rows from entries of any rank, which are added."""
        A, d = PETSc.Mat().create(self.layout.comm), self.layout.dimension
        A.setSizes(((self.layout.n_local, None), (columns, None)))
        A.setType("aij")
        A.setBlockSizes(d, d)
        A.setPreallocationCOO(rows.ravel().astype(PETSc.IntType), at.ravel().astype(PETSc.IntType))
        A.setValuesCOO(values.ravel())
        A.assemble()
        return A

    def _set_rigid_modes(self, A: PETSc.Mat) -> None:
        """Give the linear elements their near null space, without which GAMG needs twice the iterations."""
        places = self.layout.nodes[self.patches.vertices]
        x = PETSc.Vec().createWithArray(places.ravel().copy(), bsize=self.layout.dimension, comm=self.layout.comm)
        near = PETSc.NullSpace().createRigidBody(x)
        A.setNearNullSpace(near)
        near.destroy()

    def destroy(self) -> None:
        """Free all matrices; the solver is its owner's. Collective."""
        for A in (*self.matrices, self.P):
            A.destroy()


def factored(layout: BlockLayout) -> bool:
    """Whether the linear elements of a layout with patches are factored."""
    assert layout.patches is not None
    return layout.comm.size == 1 and layout.patches().count * layout.dimension <= COARSE_LIMIT


def star_inverses(S: PETSc.Mat, patches: Patches, d: int) -> Iterator[tuple[NDArray[Any], Array]]:
    """Nodes (stars, m) and inverses (stars, m d, m d) of this rank's stars, those of one size together. Collective."""
    seen = np.unique(patches.node)
    n = len(seen)
    rows = PETSc.IS().createBlock(d, seen.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
    (local,) = S.createSubMatrices([rows], [rows])
    indptr, columns, values = local.getValuesCSR()
    size = local.getSize()
    local.destroy()
    rows.destroy()
    blocks = scipy.sparse.csr_matrix((values, columns, indptr), shape=size).tobsr((d, d))
    del values, columns
    blocks.sort_indices()
    keys = np.repeat(np.arange(n, dtype=np.int64), np.diff(blocks.indptr)) * n + blocks.indices
    for nodes in equal_stars(patches, d):
        at = np.searchsorted(seen, nodes)
        m = at.shape[1]
        key = (at[:, :, None] * n + at[:, None, :]).ravel()
        place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        data = np.where((keys[place] == key)[:, None, None], blocks.data[place], 0.0)
        dense = data.reshape(-1, m, m, d, d).transpose(0, 1, 3, 2, 4).reshape(-1, m * d, m * d)
        yield nodes, np.linalg.inv(dense)


def equal_stars(patches: Patches, d: int) -> Iterator[NDArray[Any]]:
    """Nodes (stars, m) of stars of one size, in parts whose inverses need little memory."""
    sizes = np.unique(patches.star, return_counts=True)[1]
    first = np.append(0, np.cumsum(sizes))
    for m in np.unique(sizes):
        stars = np.flatnonzero(sizes == m)
        for part in np.array_split(stars, -(-len(stars) * 8 * (m * d) ** 2 // BYTES)):
            yield patches.node[first[part][:, None] + np.arange(m)]


def pattern(patches: Patches, comm: MPI.Intracomm, ranges: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Blocks in each owned row of nodes of B, with an own column and with another. Collective.

    ``ranges``: first nodes of the ranks and the number of all.
    """
    count = int(ranges[-1])
    parts = [np.unique(at[:, :, None] * count + at[:, None, :]) for at in equal_stars(patches, 1)]
    key = np.unique(np.concatenate([*parts, np.zeros(0, dtype=np.int64)]))
    owner = np.searchsorted(ranges, key // count, side="right") - 1
    key = np.unique(to_ranks(comm, owner, key))
    low, high = ranges[comm.rank], ranges[comm.rank + 1]
    row, column = key // count - low, key % count
    own = (column >= low) & (column < high)
    blocks = [np.bincount(row[which], minlength=high - low).astype(PETSc.IntType) for which in (own, ~own)]
    return blocks[0], blocks[1]
