"""The midpoint step with an iterative solver: the balance of energy holds to rounding at any tolerance.

With S w = r - rho the step of `softgrasp.fem.run.midpoint` changes the energy by 2 w'G c - 2 s w'D w - 2 w'rho, if its
momentum goes on with the product S w in place of r. Scaling w by w'r / w'S w makes w'rho = 0. The solves begin with
the last solutions (`softgrasp.fem.solve.guess`).

A step adds an error of energy 2 rho'S^-1 rho at most, which later steps do not magnify. As these errors point anywhere,
their energies are summed; the preconditioner stands for S^-1.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.run.midpoint import Feedback, TissueMidpoint, TissueState
from softgrasp.fem.solve.guess import Previous

RESPONSE = 1e-10  # relative tolerance of S^-1 G, which all steps share and few solves make
SWEEPS = 10  # most of the hand's equation and the scaling: each gains the digits of the tolerance, twice


class InexactMidpoint(TissueMidpoint):
    """The tissue half of the step with cg or stars; arguments and calls are those of the exact step.

    Attributes:
        Sw: S w on the rows held.
        defect: S w - r, what the momentum goes on with beside r.
        previous: solutions of the last steps.
        iterations: of each solve of a step since the start.
        squares: sum of |rho|^2 over the steps since the start [N^2].
        softness: largest rho'S^-1 rho / |rho|^2 of the steps that were checked [m/N].
        strain: largest elastic energy z'K z / 2 at the instants whose energy was computed [J].
    """

    def _prepare(self) -> None:
        super()._prepare()
        self.Sw, self.defect = self.r.duplicate(), self.r.duplicate()
        self.previous = Previous(self.system.layout.comm, len(self.w_array))
        self.iterations: list[int] = []
        self._solve = self._solve_from_guess

    def start(self, state: TissueState) -> None:
        """Set the carried vectors and drop earlier solutions: a run repeats its bits. Collective."""
        super().start(state)
        self.previous.clear()
        self.iterations.clear()
        self.squares = self.softness = self.strain = 0.0

    def _solve_from_guess(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r from a guess, keep w and set S w. Collective."""
        ksp = self.solver.ksp
        w.array_w[:] = self.previous.guess(r.array_r)
        ksp.setInitialGuessNonzero(True)
        self.solver.solve(r, w)
        ksp.setInitialGuessNonzero(False)
        self.iterations.append(ksp.getIterationNumber())
        self.squares += ksp.getResidualNorm() ** 2
        self.solver.S.mult(w, self.Sw)
        square = w.dot(self.Sw)
        if square > 0:
            self.previous.add(w.array_r, self.Sw.array_r, square)

    def solve_midpoint(self, c: Array, feedback: Feedback | None = None) -> None:
        """Solve S w = h + G c with w'(r - S w) = 0. Collective."""
        super().solve_midpoint(c, feedback)
        self._scale(self._share())

    def _share(self) -> float:
        """Factor t with (t w)'(r - S t w) = 0 [1]. Collective."""
        square = self.w.dot(self.Sw)
        return float(self.w.dot(self.r) / square) if square > 0 else 1.0

    def _scale(self, share: float) -> None:
        """Multiply w by a number, and set the defect. Collective."""
        self.w.scale(share)
        self.Sw.scale(share)
        self.defect.waxpy(-1.0, self.r, self.Sw)

    def make_responses(self) -> Array:
        """Set Y = S^{-1} G and S Y, see `TissueMidpoint`; to a tolerance of its own. Collective."""
        ksp, rtol = self.solver.ksp, self.solver.ksp.getTolerances()[0]
        ksp.setTolerances(rtol=min(rtol, RESPONSE))
        Y = super().make_responses()
        ksp.setTolerances(rtol=rtol)
        self.SY = np.empty_like(self.Y)
        for j in range(Y.shape[1]):
            self.w.array_w[:] = self.Y[:, j]
            self.solver.S.mult(self.w, self.Sw)
            self.SY[:, j] = self.Sw.array_r
        return Y

    def push_hand(self, L: Array, L_tissue: Array, f: Array, f_tissue: Array, kappa: float, c_0: Array) -> Array:
        """Acceleration a of a hand that feels the tissue, with w = x - Y c scaled as above, c = kappa a + c_0.

        The hand obeys (L - tau L_tissue) a = f - tau f_tissue where w is tau (x - Y c), and tau depends on c: both are
        iterated upon, with vectors, since x and Y c may cancel. Collective, after `respond`.
        """
        x, product, h = (vector.array_r.copy() for vector in (self.w, self.Sw, self.r))
        comm, tau = self.system.layout.comm, 1.0
        for _ in range(SWEEPS):
            a = np.linalg.solve(L - tau * L_tissue, f - tau * f_tissue)
            c = kappa * a + c_0
            w, y, r = x - self.Y @ c, product - self.SY @ c, h - self.G @ c
            work, square = total(comm, np.array([w @ r, w @ y]))
            before, tau = tau, float(work / square) if square > 0 else 1.0
            if abs(tau - before) <= 4 * np.finfo(float).eps * abs(tau):
                break
        self.w.array_w[:], self.Sw.array_w[:] = w, y
        self.c = -c
        self.r.array_w[:] = r
        self._scale(tau)
        return np.asarray(a)

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write the new state and carry k and r on, with S w in place of r. Collective."""
        super().advance(old, new)
        if self.operators.D is None:  # else the momentum is M v and needs no S w
            self.r.axpy(self.a, self.defect)

    def residual(self) -> float:
        """Check a solve as the exact step does, and measure the softness of its defect. Collective."""
        square = self.defect.dot(self.defect)
        if square > 0:
            y = self.defect.duplicate()
            self.solver.ksp.getPC().apply(self.defect, y)
            self.softness = max(self.softness, self.defect.dot(y) / square)
            y.destroy()
        return super().residual()

    def energy(self, state: TissueState) -> float:
        """Energy as of the exact step, and keep the largest elastic one. Collective."""
        energy = super().energy(state)
        z, own = self._held_z(state), 0.0 if self.own is None else self.own
        self.strain = max(self.strain, self.over_ranks(float(np.dot(z.array_r, own - self.k.array_r / 2))) / 2)
        return energy

    def solve_error(self) -> float:
        """Estimated error of z by all solves, energy norm, over the largest z [1]."""
        return float(np.sqrt(2 * self.softness * self.squares / self.strain)) if self.strain > 0 else 0.0

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file: the solutions of the last steps, and their products."""
        return {
            "solver_rows": self.previous.W.T,
            "solver_numbers": np.array(
                [*self.previous.gram.ravel(), self.previous.count, self.squares, self.softness, self.strain]
            ),
        }

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what `restart_arrays` returned, after `adopt`. Collective."""
        if rows is None or numbers is None:
            return
        past = self.previous
        past.W[:], past.gram[:] = rows.T, numbers[:-4].reshape(past.gram.shape)
        past.count, (self.squares, self.softness, self.strain) = int(numbers[-4]), numbers[-3:].tolist()

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.Sw.destroy()
        self.defect.destroy()
        super().destroy()
