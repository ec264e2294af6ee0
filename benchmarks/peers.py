"""The same time loop by other means, for the benchmark: textbook PETSc loop, plain SciPy, pyMOR.

Every method starts from rest, has the load l_n = G c_n of step n and can make k more steps.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.solve.solvers import TissueSolver
from softgrasp.fem.system import BlockSystem


class TextbookLoop:
    """S w = l - K z + s M v, z += 2 w, v = 2 s w - v in a bare Python loop: one solve, two products. Collective.

    Args:
        dt: step [s].
        solve: S w = r with S = K + s^2 M and s = 2/dt, as a function of r and w.
        loads: c_n, shape (steps, n_s).
    """

    def __init__(
        self, system: BlockSystem, dt: float, solve: Callable[[PETSc.Vec, PETSc.Vec], None], loads: Array
    ) -> None:
        self.K, self.M, self.G = system.K_ee, system.M_ee, system.G
        self.s, self.solve, self.loads, self.n = 2 / dt, solve, loads, 0
        self.z, self.v, self.r, self.y, self.w, self.load = (system.K_ee.createVecRight() for _ in range(6))

    def advance(self, k: int) -> None:
        """Take k steps. Collective."""
        s, load = self.s, self.load.array_w
        for n in range(self.n, self.n + k):
            np.dot(self.G, self.loads[n], out=load)
            self.M.mult(self.v, self.r)
            self.K.mult(self.z, self.y)
            self.r.axpby(-1.0, s, self.y)
            self.r.axpy(1.0, self.load)
            self.solve(self.r, self.w)
            self.z.axpy(2.0, self.w)
            self.v.axpby(2 * s, -1.0, self.w)
        self.n += k


class BareSolve:
    """Nothing but the triangular solves with one right-hand side: those that a step of the run does. Collective."""

    def __init__(self, solver: TissueSolver, r: PETSc.Vec) -> None:
        self.r, self.w = r.copy(), r.duplicate()
        self.solve = solver.ksp.solve if solver.factor is None else solver.factor.solve

    def advance(self, k: int) -> None:
        """Solve k times. Collective."""
        for _ in range(k):
            self.solve(self.r, self.w)


class PlainCholesky(BareSolve):
    """The solves of PETSc's Cholesky as ``-pc_type cholesky`` gives it: single entries, its nested dissection.

    S, all of it on one rank, is used up.
    """

    def __init__(self, S: PETSc.Mat) -> None:
        S.setOption(PETSc.Mat.Option.SPD, True)
        self.ksp = PETSc.KSP().create(S.comm)
        self.ksp.setOperators(S)
        self.ksp.setType("preonly")
        self.ksp.getPC().setType("cholesky")
        self.ksp.getPC().setFactorOrdering("nd")
        self.ksp.setUp()
        self.r, self.w = S.createVecs()
        self.r.set(1.0)
        self.solve = self.ksp.getPC().getFactorMatrix().solve
        S.destroy()  # the ksp owns it


class ScipyLoop:
    """Sparse LU of S and the second-order loop in NumPy, on one rank.

    SuperLU gets its options for a matrix with symmetric pattern, which halve its fill.
    """

    def __init__(self, K: Any, M: Any, G: Array, dt: float, loads: Array) -> None:
        self.K, self.M, self.G, self.loads, self.s, self.n = K, M, G, loads, 2 / dt, 0
        options: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        self.lu = scipy.sparse.linalg.splu((K + self.s**2 * M).tocsc(), permc_spec="MMD_AT_PLUS_A", **options)
        self.z, self.v = np.zeros(K.shape[0]), np.zeros(K.shape[0])

    def advance(self, k: int) -> None:
        """Take k steps."""
        for _ in range(k):
            self._step()

    def store(self, k: int) -> Array:
        """Make k steps and keep every [z; v], shape (2 n_e, k + 1)."""
        n_e = len(self.z)
        X = np.zeros((2 * n_e, k + 1), order="F")
        X[:n_e, 0], X[n_e:, 0] = self.z, self.v
        for n in range(k):
            self._step()
            X[:n_e, n + 1], X[n_e:, n + 1] = self.z, self.v
        return X

    def _step(self) -> None:
        s = self.s
        w = self.lu.solve(self.G @ self.loads[self.n] - self.K @ self.z + s * (self.M @ self.v))
        self.n += 1
        self.z += 2 * w
        self.v = 2 * s * w - self.v


def has_pymor() -> bool:
    """Whether pyMOR is installed."""
    return importlib.util.find_spec("pymor") is not None


class PymorLoop:
    """pyMOR's ``ImplicitMidpointTimeStepper`` on the first-order form of size 2 n_e, on one rank.

    [I 0; 0 M] x' + [0 -I; K 0] x = [0; G c(t)] with x = [z; v]; pyMOR keeps its LU factor.
    """

    def __init__(self, K: Any, M: Any, G: Array, dt: float, loads: Array) -> None:
        from pymor.algorithms.timestepping import ImplicitMidpointTimeStepper
        from pymor.core.logger import set_log_levels
        from pymor.operators.constructions import LincombOperator, VectorOperator
        from pymor.operators.numpy import NumpyMatrixOperator
        from pymor.parameters.functionals import GenericParameterFunctional

        set_log_levels({"pymor": "ERROR"})
        n_e, steps = K.shape[0], len(loads)
        one = scipy.sparse.identity(n_e)
        E = NumpyMatrixOperator(scipy.sparse.block_diag([one, M]).tocsc())
        A = NumpyMatrixOperator(scipy.sparse.bmat([[None, -one], [K, None]]).tocsc())

        def component(j: int) -> Any:
            return GenericParameterFunctional(lambda mu: loads[int(mu["t"][0] / dt), j], {"t": 1})

        columns = [np.concatenate([np.zeros(n_e), G[:, j]]) for j in range(G.shape[1])]
        vectors = [VectorOperator(A.source.from_numpy(c[:, None])) for c in columns]
        F = LincombOperator(vectors, [component(j) for j in range(G.shape[1])])
        stepper = ImplicitMidpointTimeStepper(steps)
        self._states: Iterator[Any] = stepper.iterate(0.0, steps * dt, A.source.zeros(1), A, rhs=F, mass=E)
        next(self._states)
        self.x: Array = np.zeros(2 * n_e)

    def advance(self, k: int) -> None:
        """Make k steps; the first one factors."""
        for _ in range(k):
            state, _t = next(self._states)
        self.x = state.to_numpy().ravel()
