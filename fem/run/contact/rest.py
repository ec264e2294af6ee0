"""The static obstacle problem: K z = G g + N'x with 0 <= x, gap >= 0, x'gap = 0 and normals N at the solution.

Rounds of the small problem with W = N K^-1 N', linearised at the places of the last round; half-spaces need no more
rounds than it takes to find the nodes that touch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.responses import Responses
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Time
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.solve.stiffness import factored_stiffness, static_solver

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.general import Contact

MOST = 100  # rounds


def resting(contact: Contact, q: Array, time: Time) -> Array:
    """Displacement (n_local,) [m] against the hand at q (n_s,) at which the tissue rests on the obstacles at t = 0.

    Collective. Raises SolverError: the stiffness is singular, or no solution is found, as where there is no room.
    """
    system, layout, surface = contact.system, contact.layout, contact.surface
    name = static_solver(system, time.solver)
    free = equilibrium(system, name, time)
    with factored_stiffness(system, name, reproducible=time.reproducible) as factor:

        def respond(forces: Array) -> Array:
            b = np.zeros((layout.n_local, forces.shape[1]))
            b[surface.rows] = np.column_stack([surface.on_nodes(force) for force in forces.T])[surface.mine]
            return factor.columns(b, "the response to an obstacle")

        responses = Responses(contact.responses.directions, respond, contact.p * contact.d, take=surface.gather)
        return free + _forces(contact, responses, q, surface.gather(free))


def _forces(contact: Contact, responses: Responses, q: Array, free: Array) -> Array:
    """What the forces of the obstacles add to z, (n_local,), given z on the boundary without them. Collective."""
    surface, z, small = contact.surface, free, contact.make_problem()
    known = np.zeros((len(contact.obstacles), contact.p), dtype=bool)
    pressed, limit, f, moved = known.copy(), 0.0, np.zeros(0), 0.0
    for _ in range(MOST):
        places = surface.places(q, z)
        tol = contact.tolerance(places)
        gaps, normals = (np.array(each) for each in zip(*(o.look(places) for o in contact.obstacles), strict=True))
        new = (gaps < -limit) & ~known
        # a gap of zero leaves the normal free to turn: the nodes must stand still as well
        if not new.any() and max(moved, np.abs(gaps[pressed]).max(initial=0.0)) <= tol:
            return np.asarray(responses.columns[:, : len(f)] @ f) if len(f) else np.zeros(contact.layout.n_local)
        known |= new
        rows, limit = np.argwhere(known), tol
        o, i = rows.T
        normal = normals[o, i]
        C = contact.select(responses, rows, normal)
        W = C @ responses.G[: C.shape[1], : C.shape[1]] @ C.T
        small.restart(W, np.flatnonzero(pressed[o, i]))
        back = (free - z).reshape(places.shape)[i]
        x = small.solve(len(rows), W, gaps[o, i] + np.einsum("ij,ij->i", normal, back), tol / 4)
        pressed[o, i] = x > 0
        f = C.T @ x
        before, z = z, free + responses.surface[:, : len(f)] @ f
        moved = float(np.abs(z - before).max())
    raise SolverError(
        f"contact: no equilibrium with the obstacles after {MOST} rounds; move them, or set time.start = 'rest'"
    )
