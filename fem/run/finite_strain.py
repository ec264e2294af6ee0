"""The midpoint step of a hyperelastic body: an energy-conserving discrete gradient, solved with a tangent that is kept.

With w = z_mid - z_n, s = 2/dt, pi = M v and the force f_alg of `softgrasp.fem.strain.laws`, which does the work
2 w'f_alg = W(z_n + 2 w) - W(z_n), the step of `softgrasp.fem.run.midpoint` becomes

    R(w) = (s^2 M + s D) w + f_alg(z_n, w) - s pi_n - G c = 0,   z_{n+1} = z_n + 2 w,   s pi_{n+1} = 2 s^2 M w - s pi_n:

the linear step with one more load, -(f_alg - K z_mid). The energy W + v'pi/2 changes by the work 2 c'G'w of the load,
less what D dissipates, and by 2 w'R; so a step ends with fractions of a correction that make w'R = 0 to rounding.
A step that does not converge is divided into 2, 4, .. 16 substeps under the load that the whole step has.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import SAME, Array, PETSc, combine, driven_by_root, total
from softgrasp.fem.run.midpoint import Feedback, TissueMidpoint, TissueState, viscosity
from softgrasp.fem.solve.guess import STEPS, extrapolated
from softgrasp.fem.strain.body import HyperelasticBody
from softgrasp.fem.strain.newton import EPS, Counts, NewtonFigures, Pairs, QuasiNewton, Root
from softgrasp.fem.strain.points import whole_points

MOST_SUBSTEPS = 16  # largest number of substeps of a step [1]
BENDS = EPS**0.5  # of the loads: a larger R bends by more than rounding where its work is taken away [1]
MOST_BALANCED = 10  # times that a step takes away the work of R: each leaves a share of about R over the loads [1]
Begin = tuple[PETSc.Vec, Array, Array, float]  # z, s pi, v / s on the rows here, and the dissipated energy [J]


class FiniteStrainMidpoint(TissueMidpoint):
    """The step for a system with points; arguments and calls are those of the linear step.

    Attributes:
        r: s pi_n on the rows here, in place of the linear step's right-hand side.
        counts: convergence record of the run.
        refactor_cost: iterations of the same time as a tangent and its factor [1], from sizes alone.
    """

    def _parts(self) -> tuple[PETSc.Mat, ...]:
        system, springs = self.system, self.system.springs
        drag = [viscosity(system, self.s)] if system.damping.active else []
        return (combine([(self.s * self.s, system.M_ee)]), *drag, *([] if springs is None else [springs]))

    def _prepare(self) -> None:
        """Points, vectors and iteration. Collective."""
        self.comm: MPI.Intracomm = self.system.layout.comm
        self.dot: Callable[[Array, Array], float] = np.dot
        if self.comm.size > 1 and not self.operators.whole:
            self.dot = lambda a, b: self.over_ranks(float(np.dot(a, b)))
        self.body, self.tol = self._make_body()
        self.inertia, drag = (*self.operators.parts, None)[:2]
        self.drag = drag if self.system.damping.active else None
        for part in self.operators.parts:
            part.convert("aij")
        self.trial, self.f, self.y, self.solved = vectors = [self.w.duplicate() for _ in range(4)]
        self.trial_array, self.f_array, self.y_array, self.solved_array = (x.array_w for x in vectors)
        self.newton = self._make_iteration(Pairs(self._dots, len(self.w_array)))
        self.past: deque[Array] = deque(maxlen=STEPS)
        self.tangent_at: Array | None = None
        self.counts, self.refactor_cost = Counts(), self._refactor_cost()
        self.substeps, self.jump, self.feedback = 1, None, None
        self.load = self.right = np.zeros_like(self.r_array)
        self.last = 0.0
        self._propagate = self._carry_on

    def _make_body(self) -> tuple[HyperelasticBody, float]:
        """The law on the rows here, and the tolerance of a step. Collective."""
        system, points = self.system, self.system.points
        assert points is not None
        if self.operators.whole:
            points = whole_points(points, self.comm, self.operators.enter(np.arange(system.layout.n_e)))
        springs = (*self.operators.parts, None)[1 + system.damping.active]
        body = HyperelasticBody(points, system.materials, None if self.operators.whole else system.K_ee, springs)
        if not self.comm.allreduce(body.kernel is not None, MPI.LAND):
            body.kernel = None  # ranks that store all rows compute the same bits
        return body, points.tol

    def _make_iteration(self, pairs: Pairs) -> QuasiNewton:
        return QuasiNewton(self._residual, self._apply, lambda w: self._renew(self.at.array_r + w), pairs)

    substeps: int  # number of substeps of the step in work, 1 without substepping [1]
    jump: Array | None  # change of the velocity over a substepped step, rows here [m/s]; None without substeps
    rate: Array  # (v_0 + v_1) / 2s of a substepped step, on the rows here [m]
    feedback: Feedback | None  # dependence of the load on the tissue; None for a prescribed load
    sensed: Array  # p = N'w of the feedback, (m,)
    now: TissueState  # state at the beginning of the step in work

    def _refactor_cost(self) -> float:
        """Iterations of the same time as a tangent and its factor [1]: entries of the factor over 4 n_e."""
        return float(np.clip((self.solver.entries or 0.0) / (4 * self.system.layout.n_e), 8, 100))

    def _dots(self, A: Array, x: Array) -> Array:
        return np.asarray(A @ x if self.operators.whole else total(self.comm, A @ x))

    def _all(self, fine: bool) -> bool:
        return fine if self.operators.whole else bool(self.comm.allreduce(fine, MPI.LAND))

    # ---- the state

    def start(self, state: TissueState) -> None:
        """Set s pi_n = s M v and the law at z; the tangent there unless z = 0. Collective."""
        self._set_momentum(state)
        self.past.clear()
        self.newton.pairs.clear()
        z = self.at.array_r.copy()
        if self.dot(z, z) > 0 or self.tangent_at is not None:
            self._renew(z)
        self.trial_array[:] = z
        self.trial.stateIncrease()
        self.body.force(self.trial, self.f)
        self.counts = Counts(min_det=self.counts.min_det, scale=float(np.sqrt(self.dot(self.f_array, self.f_array))))

    def adopt(self, state: TissueState) -> None:
        """Continue from a state whose r is set. Collective."""
        self.now = state
        self._arrive(self._gathered_z(state), check=True)

    def _arrive(self, z: PETSc.Vec, check: bool = False) -> None:
        """Evaluate the law at z, where the next step starts, and refuse what it does not describe. Collective."""
        self.at, self.begin = z, self.body.start(z)
        self.counts.min_det = min(self.counts.min_det, 1 + float(self.begin.j.min(initial=np.inf)))
        if check or not self.body.law.barrier:
            self.body.refuse(self.begin, None if self.operators.whole else self.comm)

    def energy(self, state: TissueState) -> float:
        """Energy W(z) + v'pi/2 [J] of the state just reached. Collective."""
        W = self.over_ranks(self.body.energy(self._held_z(state)))
        v, momentum = state.array[self.system.layout.n_local :], self.r_array[self.rows] / self.s
        return W + float(total(self.comm, np.array([np.dot(v, momentum)]))[0]) / 2

    def figures(self) -> NewtonFigures:
        """Convergence of the steps so far. Collective."""
        counts, least = self.counts, self.counts.min_det
        least = least if self.operators.whole else float(self.comm.allreduce(least, MPI.MIN))
        mean = counts.iterations / max(counts.steps, 1)
        return NewtonFigures(mean, counts.most, counts.factors, least, counts.substepped)

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file: point of the tangent, last steps and pairs by rows, and counts."""
        tangent, pairs = [] if self.tangent_at is None else [self.tangent_at], self.newton.pairs
        rows = [self.operators.leave(x) for x in (*tangent, *self.past, *pairs.dx, *pairs.dr)]
        numbers = np.array([len(tangent), len(self.past), *vars(self.counts).values()], dtype=float)
        return {"solver_rows": np.array(rows).reshape(len(rows), len(self.r_array)), "solver_numbers": numbers}

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what :meth:`restart_arrays` returned, after :meth:`adopt`. Collective."""
        if rows is None or numbers is None:
            return
        tangents, past = (int(n) for n in numbers[:2])
        kept = [self.operators.enter(x) for x in rows]
        if tangents:
            self._renew(kept[0])
        at, pairs = tangents + past, self.newton.pairs
        self.past = deque(kept[tangents:at], maxlen=STEPS)
        pairs.dx[:], pairs.dr[:] = kept[at : at + len(pairs.dx)], kept[at + len(pairs.dx) :]
        for slot in range(len(pairs.dx)):
            pairs.multiply(slot)
        for (name, kind), value in zip(Counts.__annotations__.items(), numbers[2:], strict=True):
            setattr(self.counts, name, int(value) if kind == "int" else float(value))

    # ---- a step

    def hold(self, N: Array) -> Array:
        """Columns on the owned rows, (n_local, m), as they lie here. Collective."""
        return np.asfortranarray(self.operators.gather(N))

    def solve_midpoint(self, c: Array, feedback: Feedback | None = None) -> None:
        """Solve R(w) = 0 under the load G (c + C p); ``self.c`` is c + C p then, ``sensed`` is p. Collective.

        Args:
            c: load, (n_s,).
            feedback: what hand and controller add as the tissue moves; None where they do not depend on it.

        Raises:
            SolverError: no convergence, not even by substepping; the message names the cell with the smallest J.
        """
        self.feedback, self.jump, counts = feedback, None, self.counts
        self.load = self._load(c)
        self.right = self.r_array + self.load
        counts.scale = max(counts.scale, math.sqrt(self.dot(self.right, self.right)))
        guess = extrapolated(self.past, self.dot) if self.past else np.zeros_like(self.w_array)
        if counts.first >= 0 and counts.iterations_since_factor >= self.refactor_cost:
            self._renew_about(guess)
        root = self._find(guess)
        if root.iterations < 0:
            root = self._substepped(c)
        elif feedback is not None:
            self.sensed = self._dots(feedback.N.T, root.x)
            c = c + feedback.C @ self.sensed
        if self.jump is None:
            self.c = c
        self.w.array_w[:] = root.x
        counts.first = root.iterations if counts.first < 0 else counts.first
        counts.iterations_since_factor += max(root.iterations - counts.first, 0)
        counts.iterations, counts.steps = counts.iterations + root.iterations, counts.steps + 1
        counts.most = max(counts.most, root.iterations)

    def _find(self, guess: Array, balanced: bool = True) -> Root:
        """The root, moved to w'R = 0 if it is to be ``balanced``. Collective."""
        scale, least, cancel = self.substeps * self.counts.scale, 4 * self.body.rounding, self.newton.pairs.cancel
        target = max(self.tol * scale, least)
        root = self.newton.find(guess, target)
        if balanced and root.iterations >= 0:
            while (moved := cancel(root.x, root.R)) is None and target > least:  # R does work: iterate on
                target = max(target / 30, least)
                finer = self.newton.find(root.x, target)
                if finer.iterations < 0:
                    break
                root = finer._replace(iterations=root.iterations + finer.iterations)
            for _ in range(MOST_BALANCED):
                if moved is None or root.norm <= max(BENDS * scale, least):
                    break
                R, norm = self._residual(moved)
                if not math.isfinite(norm):
                    moved = None
                    break
                root = root._replace(x=moved, R=R, norm=norm)
                moved = None if self.is_workless(moved, R) else cancel(moved, R)
            root = root if moved is None else root._replace(x=moved)
        self.last = root.norm / scale if scale > 0 else 0.0
        return root

    def is_workless(self, w: Array, R: Array) -> bool:
        """Whether w'R is rounding of the loads' own work. Collective."""
        return abs(self.dot(w, R)) <= EPS * self.dot(np.abs(w), np.abs(self.right))

    def _residual(self, w: Array) -> tuple[Array, float]:
        """R(w) and its norm, infinite where the law has no stress. Collective."""
        n = self.substeps  # s is n times as large in a substep
        self.trial.stateIncrease()
        self.trial_array[:] = w
        if not self._all(self.body.step(self.begin, self.trial, self.f)):
            return w, np.inf
        self.inertia.mult(self.trial, self.y)
        R: Array = self.f_array - self.right
        R += self.y_array if n == 1 else n * n * self.y_array
        if self.drag is not None:
            self.drag.mult(self.trial, self.y)
            R += n * self.y_array
        if self.feedback is not None:
            R -= self.G @ (self.feedback.C @ self._dots(self.feedback.N.T, w))
        return R, math.sqrt(self.dot(R, R))

    def _apply(self, q: Array) -> Array:
        """(S - G C N')^-1 q for the tangent factored last. Collective."""
        self.trial_array[:] = q
        self.trial.stateIncrease()
        self._solve(self.trial, self.solved)
        x: Array = np.array(self.solved_array)
        if self.feedback is not None:
            C, N, _ = self.feedback
            seen = C @ self._dots(N.T, self.Y)
            x += self.Y @ np.linalg.solve(np.eye(len(seen)) - seen, C @ self._dots(N.T, x))
        return x

    def _renew(self, z: Array) -> bool:
        """Factor K(z) + s D + s^2 M; whether that worked. Collective."""
        self.trial.array_w[:] = z
        if not self._all(self.body.sound(self.trial)):
            return False
        S = self.body.tangent(self.trial)
        S.axpy(float(self.substeps**2), self.inertia, SAME)
        if self.drag is not None:
            S.axpy(float(self.substeps), self.drag, SAME)
        self.newton.pairs.clear()
        counts = self.counts
        counts.factors, counts.first, counts.iterations_since_factor = counts.factors + 1, -1, 0
        self.tangent_at = z.copy()
        if not self.solver.renew(S):
            return False
        if hasattr(self, "Y"):
            feedback, self.feedback = self.feedback, None
            self.Y = np.column_stack([self._apply(g) for g in self.G.T])
            self.feedback = feedback
        return True

    def _renew_about(self, w: Array) -> None:
        """Factor the tangent at z + w, or at z where that fails. Collective."""
        if not self._renew(self.at.array_r + w):
            self._renew(self.at.array_r)

    # ---- substeps

    def _substepped(self, c: Array) -> Root:
        """The step in 2 to 16 substeps under one load, ``self.c``; sets ``jump``, ``rate``, ``sensed``. Collective.

        Raises SolverError: no number of substeps converges.
        """
        feedback, self.feedback, at = self.feedback, None, self.at
        begin = at, self.r_array.copy(), self.operators.gather(self.now.v.array_r) / self.s, self.dissipated
        while self.substeps < MOST_SUBSTEPS:
            self.substeps *= 2
            root = self._substeps(c, begin) if feedback is None else self._balanced(c, feedback, begin)
            if root is None:
                continue
            self.substeps, self.past = 1, deque(maxlen=STEPS)
            self.counts.substepped += 1
            self._renew_about(root.x)
            return root
        self.substeps = 1
        J, place = self.body.lowest(self.body.J, None if self.operators.whole else self.comm)
        raise SolverError(
            f"finite strain ({self.body.law.name}): no convergence (16 substeps did not help); in the cell at "
            f"{place} the last trial has det F = {J:.3g}: use more time.steps, a finer mesh or a gentler motion"
        )

    def _balanced(self, c: Array, feedback: Feedback, begin: Begin) -> Root | None:
        """The substeps under the load with which hand and controller respond, by Powell's hybrid method. Collective."""
        root: Root | None = None

        def miss(load: Array) -> Array:
            nonlocal root
            root = self._substeps(load, begin)
            if root is None:
                raise ArithmeticError
            w = self._dots(feedback.N.T, root.x)
            self.sensed = w + feedback.speed * (self._dots(feedback.N.T, self.rate) - w)
            return np.asarray(load - c - feedback.C @ self.sensed)

        from scipy.optimize import root as solve  # few runs need it

        try:
            load = driven_by_root(
                self.comm, miss, lambda ask: np.array(solve(ask, c, options={"xtol": 1e-13, "eps": 1e-6}).x)
            )
            largest = np.abs(miss(load)).max() / max(np.abs(load).max(), np.abs(c).max())
        except ArithmeticError:
            return None
        return root if self.comm.bcast(bool(largest <= 10 * self.tol)) else None

    def _substeps(self, load: Array, begin: Begin) -> Root | None:
        """All substeps of a step, each with its own tangent; None where one does not converge. Collective."""
        at, r, v, self.dissipated = begin
        self.r.array_w[:], self.c, self.load = r, load, self._load(load)
        w, jump, count, self.at = np.zeros_like(r), np.zeros_like(r), 0, at.copy()
        try:
            for _ in range(self.substeps):
                self.begin, self.right = self.body.start(self.at), self.substeps * self.r_array + self.load
                if not self._renew(self.at.array_r.copy()):
                    return None
                root = self._find(np.zeros_like(w))
                if root.iterations < 0:
                    return None
                self.w.array_w[:] = root.x
                self._add_momentum()
                self.at.axpy(2.0, self.w)
                w, jump, count = w + root.x, 2 * self.s * self.substeps * root.x - jump, count + root.iterations
            self.jump, self.rate = jump, v + jump / (2 * self.s)
            return root._replace(x=w, iterations=count)
        finally:
            self.at.destroy()
            self.at, self.begin = at, self.body.start(at)

    # ---- the end of a step

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write z_{n+1}, v_{n+1} into ``new`` (may be ``old``) and carry momentum and law on. Collective."""
        self.now, v = new, None if self.jump is None else old.v.array_r + self.jump[self.rows]
        super().advance(old, new)
        if v is not None:
            new.v.array_w[:] = v

    def pull(self) -> Array:
        """G'w with w = (z_1 - z_0) / 2, and with (v_0 + v_1) / 2s behind it, over the rows here."""
        work = super().pull()
        return np.concatenate([work, work[: self.G.shape[1]] if self.jump is None else self.G.T @ self.rate])

    def _carry_on(self, z: PETSc.Vec) -> None:
        if self.jump is None:
            self._add_momentum()
            self.past.appendleft(self.w_array.copy())
        self.newton.pairs.retire()
        self._arrive(z)

    def _add_momentum(self) -> None:
        """S pi -> 2 s^2 M w - s pi, in a substep with its own s, and the work of the drag. Collective."""
        self.inertia.mult(self.w, self.y)
        self.r.axpby(2.0 * self.substeps, -1.0, self.y)
        if self.drag is not None:
            self.drag.mult(self.w, self.y)
            self.dissipated += 2 * self.substeps * float(np.dot(self.w_array, self.y_array))

    def residual(self) -> float:
        """|R| of the last step over the largest |s pi + G c| so far; the step was checked."""
        return self.last

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.body.destroy()
        for item in (*self.operators.parts, self.trial, self.f, self.y, self.solved):
            item.destroy()
        if self.operators.whole:  # else the points are the system's
            self.body.points.B.destroy()
        super().destroy()
