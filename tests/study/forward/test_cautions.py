"""The digits that a warning leaves, against the same run in fifty decimal digits."""

from __future__ import annotations

import re
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import pytest

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.scales import magnified
from softgrasp.fem.run.simulate import simulate
from softgrasp.study.forward.cautions import run_warnings
from tests.hardcases.cases import make

pytestmark = pytest.mark.serial
YOUNG, RHO, STEPS = 100, 1, 60
exact: Any = np.frompyfunc(Decimal, 1, 1)  # a double as it is


def exact_matrices(model: Model, nu: float) -> tuple[Any, Any, Any]:
    """K, M and M T of linear triangles on the free nodes, assembled by hand in decimal arithmetic."""
    geometry = model.space.mesh.mesh.geometry
    nodes, cells = geometry.x[:, :2], geometry.dofmaps[0]
    share = Decimal(nu)
    lam, mu = YOUNG * share / ((1 + share) * (1 - 2 * share)), YOUNG / (2 * (1 + share))
    C = np.array([[2 * mu + lam, lam, 0], [lam, 2 * mu + lam, 0], [0, 0, mu]], dtype=object)
    K, M = (np.full((2 * len(nodes), 2 * len(nodes)), Decimal(0)) for _ in range(2))
    for cell in cells:
        p = exact(nodes[cell])
        (a, b), (c, d) = p[1] - p[0], p[2] - p[0]
        area = abs(a * d - b * c) / 2
        grad = np.array([[-1, -1], [1, 0], [0, 1]], dtype=object) @ np.array([[d, -c], [-b, a]]) / (a * d - b * c)
        B = np.zeros((3, 6), dtype=object)
        B[0, 0::2] = B[2, 1::2] = grad[:, 0]
        B[1, 1::2] = B[2, 0::2] = grad[:, 1]
        dofs = np.ix_(*2 * [(2 * cell[:, None] + np.arange(2)).ravel()])
        K[dofs] += area * (B.T @ C @ B)
        M[dofs] += RHO * area / 12 * np.kron(np.ones((3, 3), dtype=int) + np.eye(3, dtype=int), np.eye(2, dtype=int))
    at = [int(np.abs(nodes - x).sum(axis=1).argmin()) for x in model.system.layout.nodes]
    free = (2 * np.array(at)[:, None] + np.arange(2)).ravel()
    carried = M @ np.tile(np.eye(2, dtype=int), (len(nodes), 1))
    return K[np.ix_(free, free)], M[np.ix_(free, free)], carried[free]


def exact_inverse(S: Any) -> Any:
    """S^{-1} by elimination."""
    work = np.hstack([S, np.eye(len(S), dtype=int).astype(object)])
    for i in range(len(S)):
        work[i] = work[i] / work[i, i]
        factor = work[:, i].copy()
        factor[i] = 0
        work = work - factor[:, None] * work[i]
    return work[:, len(S) :]


def exact_run(model: Model, nu: float, v_s: Any) -> Any:
    """Last z of the midpoint rule, the hand moving as it did."""
    K, M, G = exact_matrices(model, nu)
    dt = Decimal(model.scene.time_end) / STEPS
    s = 2 / dt
    inverse = exact_inverse(K + s * s * M)
    z = v = np.full(len(K), Decimal(0))
    for a in np.diff(exact(v_s), axis=0) / dt:
        w = inverse @ (s * (M @ v) - K @ z - G @ a)
        z, v = z + 2 * w, 2 * s * w - v
    return z.astype(float)


@pytest.mark.parametrize("nu", [0.3, 0.4999999, 0.499999999])
def test_as_many_digits_are_right_as_the_warning_leaves(nu: float) -> None:
    """Residual and drift take the rounded stiffness for the true one: at nu = 0.4999999 both claim ten digits."""
    material = f"tissue.material={{young={YOUNG}.0, poisson={nu!r}, rho={RHO}.0}}"
    model = make("paper_forward", "tissue.cells=[2, 4]", material, f"time.steps={STEPS}", "control=false")
    run = simulate(model)
    assert run.snapshots is not None
    with localcontext(prec=50):
        z = exact_run(model, nu, run.v_s)
    n = len(z)
    size = np.linalg.norm(run.snapshots.Z[:n], axis=0).max()
    error = float(np.linalg.norm(run.final[:n] - z) / size)
    said = [re.search(r"only about (\d+) digits", text) for text in run_warnings(model, run)]
    digits = next((int(found[1]) for found in said if found), 9)  # without a warning nine or more
    assert error < 10.0**-digits
    if nu > 0.4:
        assert digits < 9
        assert error > 10.0 ** -(digits + 2)  # nor is it much too careful


def test_nothing_is_magnified_at_rest() -> None:
    model = make("paper_forward", "tissue.cells=[2, 4]", "control=false")
    assert magnified(model.system, np.zeros(model.system.layout.n_local)) == 0
