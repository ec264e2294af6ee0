"""Contact of the tissue with rigid obstacles, in the momentum form of the midpoint step.

With the gap g_n of a boundary node, its normal N and what hand and obstacle add, dg, a step without contact ends at
S w_0 = h + G c. Forces x with

    0 <= x,  W x + q >= 0,  x'(W x + q) = 0,   W = N S^-1 N',  q = (g_n + dg) / 2 + N w_0

leave no penetration at the end of the step: w = w_0 + S^-1 N'x, and r takes N'x twice, once before and once after the
step, as it takes the load G c. Then nodes that are pressed stop: the inelastic impulse y with N v = 0 adds M^-1 N'y to
v and s N'y to r. The work of x is x'(g_{n+1} - g_n - dg) = -x'(g_n + dg), the impulse takes its kinetic energy, and
neither ever adds any at obstacles and a hand at rest.

Where normals turn, the mean normal n of a step has n.(x_1 - x_0) = g_1 - g_0, so that the same holds; it is found by
rounds on the small problem alone, see `planes`. A two-way hand feels N_s'x, N_s = N T.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.model.surface import Surface, make_surface
from softgrasp.fem.obstacles import HalfSpace, make_obstacles
from softgrasp.fem.obstacles.obstacle import Obstacle, check_passage
from softgrasp.fem.obstacles.responses import Responses
from softgrasp.fem.obstacles.small import DependentProblem, SmallProblem
from softgrasp.fem.obstacles.spacing import edge_parts
from softgrasp.fem.petsc import Array, rows_on_all
from softgrasp.fem.run.contact.planes import Planes
from softgrasp.fem.run.contact.record import ContactRecord, Tables
from softgrasp.fem.run.contact.rows import Flags, Ints, Rows
from softgrasp.fem.run.contact.strike import Strike
from softgrasp.fem.run.displacement import exact_sum
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Driven

ROUNDING = 64 * float(np.finfo(float).eps)  # of a gap, over the coordinates it is computed from [1]
STILL = 1e-12  # normal velocity of pressed nodes over the largest velocity on the boundary, which is rounding [1]
MOST = 200  # rounds of a step
LOOKED_AT = 100_000  # coordinates of held nodes that are looked at together
STRAIGHT = 1e-8  # motion of a node over the size of the body below which its normal does not turn [1]


def unsettled(reached: float) -> SolverError:
    """The error of a step whose rounds leave a gap [m]."""
    return SolverError(
        f"contact: {MOST} rounds leave a gap of {reached:.2g} m at pressed nodes; obstacles that leave the tissue no "
        "room, or are small against the cells, are the usual reason: move one, use smaller cells or raise time.steps"
    )


def contact_surface(model: Model) -> Surface:
    """The free boundary with the points at which it meets the obstacles of the scene. Collective."""
    layout = model.system.layout
    parts = edge_parts(model.scene.obstacle or [], layout.order, layout.dimension)
    return make_surface(model.space, model.system, parts)


class Contact:
    """Contact of one run. Making one is collective; its calls in a step as well where the tissue is distributed.

    Args:
        model: with ``effects.obstacles``.
        midpoint: factored step of a direct solver, before its start: its vectors are used as scratch.
        steps: of the run.
        hand: equation of a two-way hand, or None for a hand that feels no tissue.

    Raises SceneError: a path of an obstacle does not fit.
    """

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        system = model.system
        self.system, self.midpoint, self.layout, self.hand = system, midpoint, system.layout, hand
        self.dt, self.s = midpoint.dt, midpoint.s
        self.obstacles = make_obstacles(model.scene, self.layout.dimension)
        self.surface = contact_surface(model)
        self.p, self.d = self.surface.X.shape
        self.table = Tables.empty(steps, len(self.obstacles), self.p, self.d, self.layout.n_s)
        self.whole, places = midpoint.operators.whole, self.surface.rows
        if self.whole:
            places = np.argsort(midpoint.operators.enter(np.arange(self.layout.n_e)))[self.surface.dofs]
        self.places: Ints = places  # of the boundary nodes' unknowns on the rows here
        self.order: Any = slice(None) if self.whole else self.surface.mine  # which of them lie there
        held = rows_on_all(self.layout.comm, self.layout.held)
        self.held, self.held_T = held, rigid_modes(held, self.d, model.scene.effects.rotation, self.layout.reference)
        self.small = self.make_problem()
        self.z, self.low, self.moved, self.forces = (np.zeros(self.p * self.d) for _ in range(4))
        self.gaps = self.after = np.zeros((len(self.obstacles), self.p))
        self.planes = Planes(self.obstacles, self.dt, STRAIGHT * self.layout.extent, self.gaps > 0)
        self.fastest = 0.0  # largest velocity of a boundary node in a step with contact [m/s]
        self.drive: Driven | None = None
        self.n = 0  # number of the step in work
        self.responses = self._make_responses()
        self.strike = Strike(system, self.surface, midpoint, self.table, hand is not None)

    def _make_responses(self) -> Responses:
        self.bases = bases = [self._basis(o) for o in self.obstacles]
        directions = np.unique(np.vstack(bases), axis=0)
        self.numbers = [[int(np.flatnonzero((directions == n).all(axis=1))[0]) for n in basis] for basis in bases]
        self.b, self.y, reach = self.midpoint.r.duplicate(), self.midpoint.w.duplicate(), None
        if self.hand is not None:
            self.Y = np.column_stack([self._take(column) for column in self.midpoint.Y.T])
            reach = self.surface.T - self.hand.theta * self.Y, self.hand.inverse / self.s**2
        return Responses(directions, self._respond, self.p * self.d, reach, self._take)

    def _basis(self, obstacle: Obstacle) -> Array:
        """Directions in which the nodes that an obstacle presses have responses, (m, d)."""
        return obstacle.shape.normal[None] if isinstance(obstacle.shape, HalfSpace) else np.eye(self.d)

    def _respond(self, forces: Array) -> Array:
        """S^-1 of forces (p d, k) on the boundary. Collective."""
        b = np.zeros((len(self.b.array_r), forces.shape[1]), order="F")
        for j, force in enumerate(forces.T):
            b[self.places, j] = self.surface.on_nodes(force)[self.order]
        return self.midpoint.solver.columns(b, room=(self.b, self.y))

    def _take(self, x: Array) -> Array:
        """Values on the boundary of a vector on the rows here. Collective."""
        return self.surface.at_points(x[self.places]) if self.whole else self.surface.gather(x)

    def make_problem(self) -> SmallProblem:
        """A small problem for rows of this boundary."""
        return SmallProblem() if self.surface.B is None else DependentProblem()

    def _add_to_r(self) -> None:
        """Give r the forces on the boundary. Collective."""
        self.midpoint.r.array_w[self.places] += self.surface.on_nodes(self.forces)[self.order]

    def _gaps(self, x: Array, n: int) -> Array:
        return np.array([o.gap(x, n * self.dt) for o in self.obstacles])

    def tolerance(self, x: Array) -> float:
        """Rounding of the gaps of points x (p, d) [m]."""
        return ROUNDING * (float(np.abs(x).max(initial=0.0)) + self.layout.extent)

    def _make_rows(self, pairs: Ints) -> Rows:
        """Rows of pairs of obstacle and node, (k, 2), without force."""
        return Rows(pairs[:, 0], pairs[:, 1], np.zeros((len(pairs), self.d)), np.zeros(len(pairs)))

    # ---- the run

    def start(self, state: TissueState, q: Array, n: int = 0) -> None:
        """Look at the state at step n, with the hand at q and no node pressed. Collective.

        Raises SceneError: an obstacle is in the tissue at the start.
        """
        self.z, midpoint = np.array(self.surface.gather(state.z.array_r)), self.midpoint
        if self.surface.B is None:  # else z comes from the nodes in every step
            self.low[:] = self.surface.gather(midpoint.low.array_r[midpoint.operators.rows])
        x = self.surface.places(q, self.z)
        self.gaps = self._gaps(x, n)
        self.table.gap[n] = self.gaps.min(axis=1)
        self.rows = self._make_rows(np.zeros((0, 2), dtype=int))
        if n == 0 and self.gaps.min() < -self.tolerance(x):
            o, i = np.unravel_index(self.gaps.argmin(), self.gaps.shape)
            place = ", ".join(f"{c:.4g}" for c in x[i])
            raise SceneError(
                f"obstacle '{self.obstacles[o].name}' contains the point of the tissue at ({place}) m at the start, "
                f"{-self.gaps[o, i]:.3g} m deep; move it, or start elsewhere"
            )

    def lead(self) -> None:
        """Let a step leave the second half of its solve to `press`, where that saves time."""

    def press(self, n: int, drive: Driven) -> None:
        """Turn the step without contact in the midpoint into one that leaves no penetration. Collective.

        Raises SolverError: the rounds of the step do not end, or the step could carry a node through an obstacle.
        """
        self.n, self.drive = n, drive
        self.moved = self._take(self.midpoint.w_array)
        x1 = self.surface.places(drive.q[n + 1], self.z + (2 * self.moved + self.low))
        self.after = self._gaps(x1, n + 1)
        x0 = self.surface.places(drive.q[n], self.z)
        check_passage(self.obstacles, self.gaps, self.after, (x0, x1), (n * self.dt, (n + 1) * self.dt))
        if self.after.min() >= 0:
            self.rows = self._make_rows(np.zeros((0, 2), dtype=int))
            return
        f, self.rows = self._settle(n, x0, x1)
        self._add(n, f, drive)
        rows, table = self.rows, self.table
        np.add.at(table.force[n], rows.obstacle, rows.forces())
        np.add.at(table.touching[n], rows.obstacle, 1)
        table.hand[n] = self.surface.T.T @ self.forces
        table.energy[:2] += 2 * self.forces @ self.moved, rows.x @ self.gaps[rows.obstacle, rows.node]

    def _settle(self, n: int, x0: Array, free: Array) -> tuple[Array, Rows]:
        """Forces of the step, by columns of the responses and by rows, from its free end. Collective."""
        tol = self.tolerance(free)
        known = self.after < 0
        known[self.rows.obstacle, self.rows.node] = True
        x1, active, self.planes.kept = free, known & False, known & False
        active[self.rows.obstacle, self.rows.node] = True
        for count in range(MOST):
            f, rows = self._forces(known, active, n, x0, free, x1, tol)
            x1 = free + self._correction(f)
            after = self._gaps(x1, n + 1)
            new = (after < -tol) & ~known
            pressed = rows.x > 0
            left = self.planes.left(rows, n, x0, x1, self.gaps, after)
            reached = np.abs(left)[pressed].max(initial=0.0)
            if after.min() >= -tol and reached <= tol:  # rows without force too: their normals turn
                self.after = after
                return f, rows.take(pressed)
            known |= new
            self.planes.keep(rows, np.where(pressed, np.abs(left), -left) > tol, count)
            active[:] = False
            active[rows.obstacle[pressed], rows.node[pressed]] = True
        raise unsettled(max(float(reached), -float(after.min())))

    def _correction(self, f: Array) -> Array:
        """Motion of the boundary nodes over the step by forces f, (p, d) [m]."""
        k = len(f)
        z = 2 * (self.responses.surface[:, :k] @ f)
        if self.hand is not None:
            a = self.hand.inverse @ (self.responses.B[:k].T @ f)
            z += self.surface.T @ (2 / self.s**2 * a) - 2 * self.hand.kappa * (self.Y @ a)
        return z.reshape(self.p, self.d)

    def _forces(
        self, known: Flags, active: Flags, n: int, x0: Array, free: Array, x1: Array, tol: float
    ) -> tuple[Array, Rows]:
        """Forces with the mean normals between x0 and x1. Collective."""
        rows = self._make_rows(np.argwhere(known))
        q = self._look_along(rows, n, x0, free, x1)
        C = self.select(self.responses, np.argwhere(known), rows.normal)
        m = C.shape[1]
        W = C @ self.responses.G[:m, :m] @ C.T
        self.small.restart(W, np.flatnonzero(active[rows.obstacle, rows.node]))
        rows.x = self.small.solve(len(q), W, q, tol / 4).copy()
        return C.T @ rows.x, rows

    def _look_along(self, rows: Rows, n: int, x0: Array, free: Array, x1: Array) -> Array:
        """See :meth:`Planes.look_along`."""
        return self.planes.look_along(rows, n, x0, free, x1, self.gaps, self.after)

    def select(self, responses: Responses, pairs: Ints, normal: Array) -> Array:
        """Shares (k, m) of all responses in unit forces along normals (k, d) of pairs of obstacle and node, (k, 2).

        Responses that are missing are made. Collective.
        """
        keys = [[(int(i), number) for number in self.numbers[o]] for o, i in pairs]
        responses.enter([key for several in keys for key in several])
        C = np.zeros((len(pairs), responses.count))
        for row, several in enumerate(keys):
            shares = self.bases[pairs[row, 0]] @ normal[row] if len(several) > 1 else [1.0]
            C[row, [responses.where[key] for key in several]] = shares
        return C

    def _add(self, n: int, f: Array, drive: Driven) -> None:
        """Take forces f into the step of tissue and hand. Collective."""
        midpoint = self.midpoint
        w = midpoint.w.array_w  # PETSc sees that it changes
        w += self.responses.columns[:, : len(f)] @ f
        self.forces = self.responses.forces(f)
        self._add_to_r()
        self._push_hand(n, f, drive)
        self.moved = self._take(midpoint.w_array)

    def _push_hand(self, n: int, f: Array, drive: Driven) -> None:
        """Apply the reaction of forces f, which the step contains, to a two-way hand."""
        if self.hand is None:
            return
        midpoint = self.midpoint
        a = self.hand.inverse @ (self.responses.B[: len(f)].T @ f)
        c = self.hand.kappa * a
        w, r = midpoint.w.array_w, midpoint.r.array_w
        w -= midpoint.Y @ c
        r -= midpoint.G @ c
        drive.c[n] -= c
        midpoint.c = drive.c[n]
        drive.v[n + 1] += self.dt * a
        drive.q[n + 1] += self.dt**2 / 2 * a

    def finish(self, state: TissueState) -> None:
        """Carry on what the step has left in the midpoint, and stop what is pressed. Collective."""
        n = self.n
        self.gaps = self.after
        if self.surface.B is not None:
            self.z = self.surface.gather(state.z.array_r)
        else:
            self.z, self.low = exact_sum(self.z, 2 * self.moved + self.low)
        if len(self.rows.node) or self.surface.B is not None:
            assert self.drive is not None
            self.gaps = self._gaps(self.surface.places(self.drive.q[n + 1], self.z), n + 1)  # the bits of a restart
        self.table.gap[n + 1] = self.gaps.min(axis=1)
        self.table.count_back(n, self.rows.obstacle, self.rows.node)
        if len(self.rows.node):
            self._carry()
            self._stop(state, n + 1)

    def _carry(self) -> None:
        """Give r the forces once more, which it lacks as it lacks G c. Collective."""
        self._add_to_r()

    def _stop(self, state: TissueState, n: int) -> None:
        """The inelastic impulse on pressed nodes at the end of step n. Collective."""
        drive, rows, d = self.drive, self.rows, self.d
        assert drive is not None
        v = (self.surface.gather(state.v.array_r) + self.surface.T @ drive.v[n]).reshape(self.p, d)[rows.node]
        x = self.surface.places(drive.q[n], self.z)[rows.node]
        normal = np.zeros_like(x)
        for o, obstacle in enumerate(self.obstacles):
            mine = rows.obstacle == o
            normal[mine] = obstacle.normal(x[mine], n * self.dt)
            v[mine] -= obstacle.rate(n * self.dt)
        kept = self.planes.kept[rows.obstacle, rows.node]
        normal[kept] = rows.normal[kept]
        self.fastest = max(self.fastest, float(np.abs(v).max()))
        # slower than the rounding of a place in half a step is at rest
        self._halt(state, n, rows, normal, v, max(STILL * self.fastest, self.s * self.tolerance(x)))

    def _halt(self, state: TissueState, n: int, rows: Rows, normal: Array, v: Array, still: float) -> None:
        """Stop rows with normals and velocities (k, d) unless all are slower than ``still``. Collective."""
        b = -np.einsum("ij,ij->i", normal, v)
        if np.abs(b).max() > still:
            assert self.drive is not None
            self.strike.stop(state, self.drive, n, rows.obstacle, rows.node, normal, b)

    # ---- what is left of a run

    def pressing(self) -> Array:
        """Force of the obstacles on each boundary node in the last step, without impulses, (p, d) [N]."""
        return (self.forces if len(self.rows.node) else np.zeros_like(self.forces)).reshape(self.p, self.d)

    def check_hand(self, q: Array, begin: int, end: int) -> None:
        """See that the nodes that follow the hand are in no obstacle at the steps from begin to before end.

        q: displacement of the hand, (steps + 1, n_s) [m, rad]. Raises SolverError: they did, at that obstacle and time.
        """
        each = max(1, LOOKED_AT // max(1, self.held.size))
        for first in range(begin, end if len(self.held) else begin, each):
            steps = np.arange(first, min(first + each, end))
            x = self.held + (q[steps] @ self.held_T.T).reshape(len(steps), *self.held.shape)
            gaps = []
            for obstacle in self.obstacles:
                shift = np.array([obstacle.shift(n * self.dt) + np.zeros(self.d) for n in steps])[:, None]
                gaps.append(obstacle.shape.look((x - shift).reshape(-1, self.d))[0].reshape(len(steps), -1).min(axis=1))
            least, met = np.array(gaps), np.array(gaps).min(axis=0) < -self.tolerance(x)
            if met.any():
                n = int(met.argmax())
                o = int(least[:, n].argmin())
                raise SolverError(
                    f"the hand meets obstacle '{self.obstacles[o].name}' at t = {steps[n] * self.dt:.6g} s: the nodes "
                    f"that it holds are rigid and {-least[o, n]:.2g} m deep in it; change the motion, the obstacle or "
                    "[contact]"
                )

    def record(self) -> ContactRecord:
        """The record of the run."""
        table, (work, touch, stopped, rubbed) = self.table, self.table.energies.tolist()
        return ContactRecord(
            tuple(o.name for o in self.obstacles), table.force, table.impulse, table.gap, table.touching,
            table.chattering, np.array(list(table.instants), dtype=int), table.pressing, work, touch, stopped, rubbed,
            self.small.rounds, self.responses.count, self.p,
        )  # fmt: skip

    def restart_arrays(self) -> dict[str, Array]:
        """Record and sets of a restart file, see :class:`softgrasp.fem.run.states.checkpoint.RestartState`."""
        keys = self.responses.keys[: self.responses.count]
        parts: list[NDArray[Any]] = [
            self.table.sums.ravel(), np.array([self.fastest]), self.small.tally, keys.ravel(),
            np.array(self.responses.blocks), self.strike.nodes(), self.table.lately.ravel(),
            self.table.pressing.ravel(), *self._sets(),
        ]  # fmt: skip
        sizes = np.array([len(parts), *(len(part) for part in parts)])
        return {"solver_rows": self.table.packed(self.n + 1), "solver_numbers": np.concatenate([sizes, *parts])}

    def _sets(self) -> list[NDArray[Any]]:
        """What a run continues with, in flat arrays."""
        return [np.array([self.rows.obstacle, self.rows.node]).ravel()]

    def restore(self, rows: Array, numbers: Array) -> None:
        """Continue with what `restart_arrays` returned. Collective."""
        self.table.unpack(rows)
        count = 1 + int(numbers[0])
        ends = np.cumsum(numbers[1:count].astype(int))
        energy, fastest, tally, keys, blocks, struck, lately, film, *sets = np.split(numbers[count:], ends)[:-1]
        self.table.sums[:], self.fastest, self.small.tally[:] = energy.reshape(2, 4), float(fastest[0]), tally
        self.responses.again([(int(i), int(k)) for i, k in keys.reshape(-1, 2)], blocks.astype(int).tolist())
        self.strike.restore(struck.astype(int))
        for kept, values in ((self.table.lately, lately), (self.table.pressing, film)):
            kept[:] = values.reshape(kept.shape)
        self._resume(sets)

    def _resume(self, sets: list[Array]) -> None:
        """Take back what `_sets` returned. Collective."""
        self.rows = self._make_rows(sets[0].reshape(2, -1).T.astype(int))

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        for vector in (self.b, self.y):
            vector.destroy()
