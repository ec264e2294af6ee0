"""Contact on meshes of a file, graded ones and layers, against the textbook's step with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import nnls

from softgrasp.fem.model.build import build
from softgrasp.fem.model.surface import make_surface
from softgrasp.fem.obstacles import make_obstacles
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.simulate import simulate

pytestmark = pytest.mark.serial
HELD = ["motion={profile='hold'}", "time.start='rest'", "effects.obstacles=true"]
FROM_ABOVE = "obstacle=[{kind='halfspace', normal=[0, 0, -1], offset=-0.1, path={velocity=[0, 0, -0.05]}}]"
ON_SKIN = "obstacle=[{kind='halfspace', normal=[0.1, -1], offset=-0.052, path={velocity=[0, -0.05]}}]"
SCENES = {
    "mesh file": ["pillow_3d", "tissue.order=1", "tissue.refine=false", FROM_ABOVE, "time.steps=30", "time.end=0.3"],
    "layers, graded": ["layers_2d", "tissue.cells=[6, 6]", "tissue.order=1", ON_SKIN, "time.steps=60", "time.end=0.3"],
    "layers, graded, P2": ["layers_2d", "tissue.cells=[5, 5]", ON_SKIN, "time.steps=60", "time.end=0.3"],
}


@pytest.mark.parametrize("name", SCENES)
def test_the_run_equals_the_textbook_step(name: str) -> None:
    scene, *overrides = SCENES[name]
    model = build(scene, [*HELD, *overrides])
    result, system, surface = simulate(model), model.system, make_surface(model.space, model.system)
    (table,), d = make_obstacles(model.scene, system.layout.dimension), system.layout.dimension
    dt = model.scene.time_end / model.scene.time.steps
    matrix, s = midpoint_matrix(system, dt), 2 / dt
    S, K, M = (to_scipy(A).toarray() for A in (matrix, system.K_ee, system.M_ee))
    matrix.destroy()
    n = table.normal(surface.X[:1])[0]
    N = np.zeros((len(surface.X), len(K)))
    for axis in range(d):
        N[np.arange(len(N)), surface.rows.reshape(-1, d)[:, axis]] = n[axis]
    load = 0.0 if system.gravity is None else system.G @ system.fall
    factor, mass = scipy.linalg.cho_factor(S), scipy.linalg.cho_factor(M)
    columns = scipy.linalg.cho_solve(factor, N.T)
    W = N @ columns
    L = np.linalg.cholesky((W + W.T) / 2)
    z, v, pressed = np.zeros(len(K)), np.zeros(len(K)), 0
    for k in range(model.scene.time.steps):
        w = scipy.linalg.cho_solve(factor, s * M @ v - K @ z + load)
        t = (k + 1) * dt
        q = table.gap(surface.X + z[surface.rows].reshape(-1, d), t) / 2 + N @ w
        x = nnls(L.T, -scipy.linalg.solve_triangular(L, q, lower=True))[0] if (q < 0).any() else np.zeros(len(q))
        w += columns @ x
        z, v = z + 2 * w, 2 * s * w - v
        if (on := x > 0).any():
            pressed, A = pressed + 1, N[on]
            response = scipy.linalg.cho_solve(mass, A.T)
            v -= response @ np.linalg.solve(A @ response, A @ v - n @ np.asarray(table.rate(t)))
    ours = np.split(result.final, 2)
    assert result.contact is not None
    assert pressed == (result.contact.touching.sum(axis=1) > 0).sum() > 5
    assert result.energy_drift < 1e-12  # rounding
    assert result.contact.penetration < 1e-14  # of a body of 0.05 m to 0.3 m
    assert np.abs(ours[0] - z).max() < 1e-8 * np.abs(z).max()  # nnls solves to about 1e-10
    assert np.abs(ours[1] - v).max() < 1e-6 * np.abs(v).max()
