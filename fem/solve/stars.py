"""Multigrid in two levels for elements of order 2 and more, flat in size and ranks for nearly incompressible tissue.

A V-cycle smooths S w = r by Chebyshev iterations with the overlapping blocks of the vertex stars [SMPZ08],

    B = sum over vertices of R_v' (R_v S R_v')^-1 R_v,

R_v taking the free nodes of the cells at v, in single precision (`softgrasp.fem.solve.smoother`), and corrects it on
linear elements, P'S P e = P'r.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, petsc_options, user_options
from softgrasp.fem.solve.differences import (
    Differences,
    as_matrix,
    differences,
    product_code,
    replace_product,
    require_same_code,
)
from softgrasp.fem.solve.smoother import Smoother

DEGREE = 2  # degree of the Chebyshev polynomial: 3 saves a sixth of the iterations for 1.4 times the time
COARSE_LIMIT = 20_000  # largest number of unknowns of the linear elements that one rank factors [1]
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
        require_same_code(layout.comm)
        self.P = self._matrix(d * p.count, rows, columns, np.repeat(p.weight, d))
        self.factored = factored(layout)
        self.matrices: tuple[PETSc.Mat, ...] = ()
        self.products: tuple[Smoother | Differences, ...] = ()
        self.renew(S)

    def renew(self, S: PETSc.Mat) -> None:
        """Set up the V-cycle for another matrix of the same pattern. Collective.

        Raises LinAlgError: S is not positive definite; what was set up before remains.
        """
        d, ksp, code = self.layout.dimension, self.ksp, product_code()
        blocks = Smoother(S, self.patches, d)
        entries = code is None or bool(user_options(ksp.getOptionsPrefix()))  # options may ask for them
        new = S.convert("baij", PETSc.Mat()) if entries else differences(S, d, code, 1.0)
        linear = S.ptap(self.P)
        linear.setBlockSize(d)
        self._set_rigid_modes(linear)
        linear.setOption(PETSc.Mat.Option.SPD, True)
        if self.matrices:  # the same objects, for multigrid keeps the matrix of its residual
            fine, smoother, old = self.matrices
            old.destroy()
            for part in self.products:
                part.destroy()
            replace_product(smoother, blocks)
            if isinstance(new, Differences):
                replace_product(fine, new)
            else:
                new.copy(fine, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                new.destroy()
        else:
            fine = as_matrix(new, S) if isinstance(new, Differences) else new
            fine.setOption(PETSc.Mat.Option.SPD, True)
            smoother = as_matrix(blocks, S)
        self.products = (blocks, new) if isinstance(new, Differences) else (blocks,)
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
        for part in (*self.matrices, *self.products, self.P):
            part.destroy()


def factored(layout: BlockLayout) -> bool:
    """Whether the linear elements of a layout with patches are factored."""
    assert layout.patches is not None
    return layout.comm.size == 1 and layout.patches().count * layout.dimension <= COARSE_LIMIT
