"""Contact at points between nodes: equal to nodes where both are exact, small obstacles, P2 in 3D, restart, ranks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI
from scipy.optimize import lsq_linear

from softgrasp.fem.errors import Paused, SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.small import DependentProblem
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.contact.general import contact_surface
from softgrasp.fem.run.simulate import RunOptions, simulate

SMALL = ["tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "time.steps=130",
         "time.end=1.3", "effects.obstacles=true"]  # fmt: skip
BETA = "effects.damping={kind='kelvin-voigt', beta=0.01}"
TWO = ["effects.reaction=true", "motion={profile='hold', drive='force'}", "hand={mass=2.0}",
       "effects.gravity={g=[0, -1], hand_weight=true}"]  # fmt: skip
PIN = "obstacle=[{kind='disc', center=[0.4, -0.055], radius=0.025}]"  # a tenth of an edge, between two nodes
WEDGE = "obstacle=[{kind='polygon', points=[[0.375, -0.02], [-0.6, -1], [1.4, -1]], parts=4}]"
SPACE = ["tissue.order=2", "tissue.cells=[2, 2, 3]", "motion={profile='hold'}", "effects.obstacles=true",
         "effects.damping={kind='kelvin-voigt', beta=0.005}"]  # fmt: skip


def table(parts: int, more: str = "") -> str:
    return f"obstacle=[{{kind='halfspace', normal=[0, 1], offset=-0.03, parts={parts}}}{more}]"


def run(*overrides: str, **options: Any) -> Any:
    return simulate(build("paper_forward", [*SMALL, *overrides]), **options)


@pytest.mark.parametrize("engine", ["C", "NumPy"])
def test_dependent_rows_are_solved_to_the_tolerance(engine: str) -> None:
    rng = np.random.default_rng(5)
    for p, rank in ((4, 2), (60, 20), (150, 12)):
        A, small = rng.standard_normal((rank, p)), DependentProblem(engine)
        q, W = A.T @ rng.standard_normal(rank) + rng.random(p) * (rng.random(p) < 0.5), A.T @ A
        kept = W.copy()
        small.restart(W, np.arange(p))  # a set whose rows are not independent
        x = small.solve(p, W, q, 1e-11)
        assert np.array_equal(W, kept)
        assert x.min() >= 0
        assert (W @ x + q).min() > -2e-11  # the tolerance, and rounding of numbers up to 50
        assert abs(x @ (W @ x + q)) < 1e-10 * abs(x).sum()  # so x is the least of x'W x / 2 + q'x


@pytest.mark.parametrize(
    "overrides",
    [
        [table(3)],
        pytest.param([table(5), BETA, *TWO], marks=pytest.mark.ranks),
        pytest.param([table(3), "tissue.order=2", BETA], marks=pytest.mark.ranks),
        [table(4), "tissue.order=3", "tissue.cells=[2, 4]"],
        [table(3, ", {kind='halfspace', normal=[0.1, 1], offset=-0.02}"), BETA],
        [PIN, BETA],
        [PIN, *TWO],
        pytest.param([WEDGE, BETA], marks=pytest.mark.ranks),
    ],
)
def test_balance_closes_without_penetration_at_points(overrides: list[str]) -> None:
    result = run(*overrides)
    contact = result.contact
    assert contact.touching.max() > 0
    assert result.energy_drift < 1e-13  # rounding: measured 1e-16 to 1e-14
    assert contact.penetration < 1e-12  # of a body of size 2
    assert contact.touch >= 0
    assert contact.stopped >= 0


@pytest.mark.serial
def test_points_on_straight_edges_before_a_plane_add_nothing() -> None:
    """Of linear elements no point is deeper than the deeper end of its edge."""
    nodes, points = (run(table(parts), BETA) for parts in (1, 4))
    assert points.contact.nodes == 4 * nodes.contact.nodes - 6 + 12  # 4 parts, and 2 edges go on to held nodes
    assert (
        np.abs(points.final - nodes.final).max() < 1e-8 * np.abs(nodes.final).max()
    )  # rounding, and the ridge of 1e-13
    assert np.abs(points.contact.force - nodes.contact.force).max() < 1e-8 * nodes.contact.force.max()


@pytest.mark.serial
def test_a_pin_between_two_nodes_does_not_sink_in() -> None:
    deep, met = run(PIN.replace("0.025}", "0.025, parts=1}"), BETA), run(PIN, BETA)
    assert deep.contact.touching.max() == 0  # nodes pass it on both sides
    assert deep.outputs[-1, 1] < -0.033  # beside the pin, whose top is at -0.03 m
    assert met.contact.touching.max() > 0
    assert met.contact.nodes == 18 * 16 + 30  # points at half its radius would be 20 to an edge; at most 16 are chosen
    assert met.contact.penetration < 1e-12


@pytest.mark.serial
def test_quadratic_elements_in_3d_rest_as_a_dense_solver_says() -> None:
    """Static equilibrium on a table: min z'Kz/2 - f'z with gaps >= 0 at all points, by its dual."""
    offset, force = 0.002, []
    for parts in ("", ", parts=4", ", parts=1"):
        spec = f"obstacle=[{{kind='halfspace', normal=[0, 0, 1], offset={offset}{parts}}}]"
        model = build("block_3d", [*SPACE, spec, "time={steps=2, end=0.002, start='equilibrium'}"])
        result = simulate(model)
        force.append(result.contact.force_end[0, 2])
        assert result.contact.penetration < 1e-14
        if parts:
            continue
        system, surface = model.system, contact_surface(model)
        assert len(surface.X) > 1.5 * surface.B.shape[1]  # the default has points in 3D on order 2
        K = to_scipy(system.K_ee).toarray()
        N = np.zeros((len(surface.X), len(K)))
        N[:, surface.rows[2::3]] = surface.B.toarray()
        factor = scipy.linalg.cho_factor(K)
        free = scipy.linalg.cho_solve(factor, system.G @ system.fall)
        L = np.linalg.cholesky(K)
        gap = surface.X[:, 2] + N @ free - offset
        near = np.flatnonzero(surface.X[:, 2] < 1e-9)
        A = scipy.linalg.solve_triangular(L, N[near].T, lower=True)
        R = np.linalg.qr(A, mode="r")
        x = lsq_linear(R, -np.linalg.lstsq(R.T, gap[near], rcond=1e-12)[0], (0, np.inf), tol=1e-14).x
        z = free + scipy.linalg.cho_solve(factor, N[near].T @ x)
        assert force[0] == pytest.approx(x.sum(), rel=1e-5)  # of lsq_linear
        assert np.abs(result.snapshots.Z[: len(z), 0] - z).max() < 1e-5 * np.abs(z).max()
    assert force[1] == pytest.approx(force[0], rel=1e-9)  # more points leave an even contact as it is
    assert 1e-6 < abs(force[2] / force[0] - 1) < 1e-3  # nodes alone do not: no pressure is a force on vertices


@pytest.mark.ranks(2)
@pytest.mark.parametrize("overrides", [[table(3), BETA], [PIN, BETA, *TWO], [table(3), "effects.finite_strain={}"]])
def test_a_restart_repeats_the_bits(overrides: list[str], mpi_tmp_path: Path) -> None:
    whole, model = run(*overrides), build("paper_forward", [*SMALL, *overrides])
    with pytest.raises(Paused):
        simulate(model, RunOptions(mpi_tmp_path, until=70))
    again = simulate(build("paper_forward", [*SMALL, *overrides]), RunOptions(mpi_tmp_path, resume=True))
    assert whole.contact.touching[:70].max() > 0
    assert np.array_equal(again.final, whole.final)
    for name in ("force", "impulse", "gap", "touching", "chattering", "pressing"):
        assert np.array_equal(getattr(again.contact, name), getattr(whole.contact, name))


@pytest.mark.ranks(3)
def test_ranks_agree(comm: MPI.Intracomm) -> None:
    ours, alone = (
        simulate(build("paper_forward", [*SMALL, PIN, BETA, "tissue.order=2"], c)) for c in (comm, MPI.COMM_SELF)
    )
    assert ours.contact.nodes == alone.contact.nodes
    assert np.abs(ours.outputs - alone.outputs).max() < 1e-9  # of a body of 2 m: rounding turns the normals of a pin


@pytest.mark.ranks
@pytest.mark.parametrize(
    "within", ["kind='disc', center=[0.5, 1], radius=0.3", "kind='box', lo=[0.2, 1.6], hi=[0.3, 1.7]"]
)
def test_an_obstacle_that_no_point_can_touch_is_refused(within: str) -> None:
    with pytest.raises(SceneError, match=r"obstacle '(disc|box)1' has its middle within the tissue at the start"):
        run(f"obstacle=[{{{within}}}]")
