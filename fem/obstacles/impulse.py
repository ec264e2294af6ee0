"""The inelastic impulse: minimise |u|_M with N u = b over the change u of velocity, hand included where it is free.

By conjugate gradients in the null space of N, with a projection that is orthogonal in the diagonal of M: every iterate
keeps N u = b, and the momentum M u of the last one is carried as it is, so that no error of the iteration is an error
of the balance of energy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError

Array = NDArray[Any]
MOST = 500  # iterations; a few dozen are usual
RTOL = 1e-14  # preconditioned norm of the residual against that of the momentum


def stop(
    multiply: Callable[[Array], Array],
    diagonal: Array,
    dot: Callable[[Array, Array], float],
    apply: Callable[[Array], Array],
    transpose: Callable[[Array], Array],
    invert: Callable[[Array], Array],
    b: Array,
) -> tuple[Array, Array, Array]:
    """U with N u = b and least u'Mu, its momentum M u, and the impulses y of the rows, M u = N'y. Collective.

    Args:
        multiply: M u.
        diagonal: of M.
        dot: product of two vectors over all ranks.
        apply: N u, (k,), on every rank.
        transpose: N'y.
        invert: (N D^-1 N')^-1 r with the diagonal D of M.
        b: right-hand side, (k,).

    Raises SolverError: no convergence.
    """

    def project(r: Array) -> tuple[Array, Array, Array]:
        """Projected gradient, what it leaves of r, and the y that it takes from r."""
        y = invert(apply(r / diagonal))
        r = r - transpose(y)
        again = invert(apply(r / diagonal))
        return (r - transpose(again)) / diagonal, r, y

    u = transpose(invert(b)) / diagonal
    u += transpose(invert(b - apply(u))) / diagonal
    momentum = multiply(u)
    # r goes on without what the projection takes from it: else its rounding grows as fast as r falls [GHN01]
    g, r, y = project(momentum)
    p, rho = -g, dot(r, g)
    least = RTOL**2 * dot(momentum, u)
    for _ in range(MOST):
        if rho <= least:
            return u, momentum, y
        q = multiply(p)
        step = rho / dot(p, q)
        u, momentum = u + step * p, momentum + step * q
        g, r, more = project(r + step * q)
        y = y + more
        new = dot(r, g)
        p, rho = -g + new / rho * p, new
    raise SolverError(f"the impulse of contact did not converge in {MOST} iterations; improve the mesh")
