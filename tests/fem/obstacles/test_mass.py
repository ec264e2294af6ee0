"""M^-1 of one component by a factor and by conjugate gradients, against a dense inverse."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.compiled import contact_library
from softgrasp.fem.obstacles.mass import NodalMass, SweptMass
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.contact import impulse
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.cholesky import nested_dissection

CASES = [("set_down", ["tissue.cells=[9, 7]"]), ("set_down_3d", ["tissue.cells=[3, 4, 3]", "tissue.order=2"])]
ROUNDING = 1e-13  # of the largest value: M has a condition below 100 with a unit diagonal


@pytest.mark.serial
@pytest.mark.parametrize("engine", ["factor", "C", "NumPy"])
@pytest.mark.parametrize(("scene", "overrides"), CASES)
def test_impulses_on_nodes_have_the_jumps_of_a_dense_inverse(scene: str, overrides: list[str], engine: str) -> None:
    system, rng = build(scene, overrides).system, np.random.default_rng(3)
    d = system.layout.dimension
    M = to_scipy(system.M_ee)[::d, ::d].tocsr()
    exact, n = np.linalg.inv(M.toarray()), M.shape[0]
    if engine == "factor":
        mass: NodalMass = SweptMass(M, d, nested_dissection(M.indptr, M.indices), contact_library())
    else:
        mass = NodalMass(M, d, engine)
    order = rng.permutation(n)
    for nodes in (order[:1], order[:20], np.concatenate([order[5:9], order[30:33]])):  # some are there already
        mass.enter(nodes)
    np.testing.assert_array_equal(mass.nodes, np.concatenate([order[:20], order[30:33]]))
    at, tol = mass.nodes, ROUNDING * np.abs(exact).max()
    np.testing.assert_allclose(mass.block, exact[np.ix_(at, at)], rtol=0, atol=tol)
    np.testing.assert_array_equal(mass.block, mass.block.T)
    y = rng.standard_normal((len(at), d))
    np.testing.assert_allclose(mass.jump(y)[:, mass.places].T, exact[:, at] @ y, rtol=0, atol=tol * len(at))
    b = rng.standard_normal(n)
    np.testing.assert_allclose(mass.respond(b), exact @ b, rtol=0, atol=tol * n)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scene", "overrides"),
    [("set_down", ["tissue.cells=[8, 6]"]), ("push_disc", ["time={steps=150, end=0.6}"]),
     ("set_down_3d", ["tissue.order=1", "time={steps=60, end=0.05}"])],
)  # fmt: skip
def test_large_runs_stop_nodes_without_a_factor(
    scene: str, overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Conjugate gradients in the place of a factor of the mass change the run by rounding alone."""
    found = simulate(build(scene, overrides))
    monkeypatch.setattr(impulse, "FACTORED", {2: 0, 3: 0})
    other = simulate(build(scene, overrides))
    assert found.contact is not None
    assert other.contact is not None
    assert np.abs(found.contact.impulse).max() > 0
    for name in ("force", "impulse", "gap"):
        one, two = (getattr(each.contact, name) for each in (found, other))
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-9 * np.abs(one).max(), err_msg=name)  # tolerance of gaps
    assert max(found.energy_drift, other.energy_drift) < 1e-13
