"""The velocity of a linear run, brought back to the momentum of its steps from time to time.

A step carries the momentum pi, and the velocity by v_{n+1} = 2 s w - v_n, which forgets no rounding: e = pi - M v grows
like the root of the number of steps. The energy (`softgrasp.fem.run.energy`) has the square of e alone, but an impulse
of contact stops v, not M^-1 pi, and its work would be wrong by e'dv.
"""

from __future__ import annotations

from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState

EVERY = 128  # steps from one time to the next: a tenth of the time of a product a step
ROUNDS = 8  # of conjugate gradients, which leave 1e-4 (linear elements) to 1e-2 of e


def restore_velocity(midpoint: TissueMidpoint, state: TissueState) -> None:
    """Set v = M^-1 pi up to a small share of what it was wrong by, for a step that is done. Collective."""
    M, rows = midpoint.system.M_ee, midpoint.operators.rows
    if not midpoint.spare:
        inverse = M.getDiagonal()
        inverse.reciprocal()
        midpoint.spare = [inverse, *(inverse.duplicate() for _ in range(4))]
    inverse, r, q, y, p = midpoint.spare
    midpoint.adopt(state)  # sets -2 (K z - f)
    h = midpoint.r_array[rows] + midpoint.G[rows] @ midpoint.pending
    M.mult(state.v, q)
    r.array_w[:] = (h - midpoint.k_array[rows] / 2) / midpoint.s - q.array_r
    y.pointwiseMult(inverse, r)
    y.copy(p)
    rho = r.dot(y)
    for _ in range(ROUNDS):
        if not rho > 0:
            break
        M.mult(p, q)
        curvature = p.dot(q)
        if not curvature > 0:  # of a body at rest but for numbers whose squares vanish
            break
        step = rho / curvature
        state.v.axpy(step, p)
        r.axpy(-step, q)
        y.pointwiseMult(inverse, r)
        rho, before = r.dot(y), rho
        p.aypx(rho / before, y)
