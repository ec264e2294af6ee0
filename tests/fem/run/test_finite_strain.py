"""Steps of finite strain: energy, order, the linear limit, the hand's equation, restart, ranks, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skfem
from mpi4py import MPI

from softgrasp.fem.checksums import read_manifest, write_manifest
from softgrasp.fem.errors import CheckpointError, Interrupted, Paused, SolverError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import total
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.states.checkpoint import FORMAT
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.solve.solvers import SolverName
from softgrasp.fem.solve.statics import equilibrium
from tests.helpers.models import (
    CUBE,
    LAYERS,
    close,
    gather_mesh,
    gather_rows,
    make_scene,
    node_order,
    run_from,
    wave,
)

LAWS = ("neo-hooke", "neo-hooke-quadratic", "stvk")
GENTLE = {"motion": {"target": [1.0, 0.6]}}
VISCOUS = {"damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01}}
UNSTABLE = "the equilibrium under gravity that was found is unstable"
STRIP: dict[str, Any] = {
    "tissue": {"size": [0.3, 2.0], "cells": [2, 10]},
    "contact": {"sides": ["top"], "box": [[0.0, 0.0], [0.3, 2.0]]},
}


def finite(
    *changes: dict[str, Any], law: str = "neo-hooke", tol: float = 1e-9, comm: Any = None, **tables: Any
) -> Model:
    effects = {"finite_strain": {"law": law, "tol": tol}, **tables.pop("effects", {})}
    return build(make_scene(*changes, effects=effects, **tables), comm=comm or MPI.COMM_WORLD)


def last(model: Model, run: Trajectory) -> Any:
    return gather_rows(model.system.layout, run.final[: model.system.layout.n_local])


@pytest.mark.ranks(law="neo-hooke")
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, id="2d"),
        pytest.param({"tissue": {"order": 2, "cells": [2, 4]}}, id="p2"),
        pytest.param(CUBE, id="3d"),
        pytest.param({"effects": VISCOUS}, id="damped"),
        pytest.param({"tissue": {"layers": LAYERS}, "effects": VISCOUS}, id="layers"),
        pytest.param({"effects": {"gravity": {"g": [1.0, -9.0]}}, "time": {"start": "equilibrium"}}, id="gravity"),
    ],
)
def test_energy_changes_by_the_work_of_the_load_alone(law: str, changes: dict[str, Any]) -> None:
    """With a tolerance of 1e-6 as well: what an iteration leaves of forces does no work."""
    gentle = {} if changes is CUBE else GENTLE
    run = simulate(finite(gentle, changes, law=law, tol=1e-6))
    assert run.energy_drift < 1e-13  # measured at most 1.4e-14; up to 3e-11 where R does work to second order
    assert run.newton is not None
    assert 0.2 < run.newton.min_det < 1.0
    assert run.newton.substepped == 0


@pytest.mark.serial
@pytest.mark.parametrize("law", LAWS)
def test_small_motion_is_linear_with_slope_one(law: str) -> None:
    """The difference to the linear run over the deformation: 1e-4 of amplitude 1e-4, and proportional to it."""

    def gap(size: float) -> float:
        motion = {"motion": {"target": [5.0 * size, 3.0 * size]}}
        model = finite(motion, law=law, tol=1e-11)
        ours, linear = simulate(model), simulate(build(make_scene(motion)))
        z, flat = (run.outputs - run.outputs_rigid for run in (ours, linear))
        return float(np.linalg.norm(z - flat) / np.linalg.norm(flat))

    small, large = gap(1e-4), gap(1e-3)
    assert small < 1e-4
    assert 0.95 < np.log10(large / small) < 1.05


@pytest.mark.serial
def test_steps_are_of_second_order() -> None:
    """Differences of the deformation over time between runs of dt, dt/2, dt/4 and dt/8."""
    runs = []
    for steps in (150, 300, 600, 1200):
        run = simulate(finite(GENTLE, time={"steps": steps}, tol=1e-11))
        runs.append((run.outputs - run.outputs_rigid)[:: steps // 150])
    gaps = [np.linalg.norm(a - b) for a, b in pairwise(runs)]
    assert 1.9 < np.log2(gaps[0] / gaps[1]) < 2.1
    assert 1.9 < np.log2(gaps[1] / gaps[2]) < 2.1


@pytest.mark.ranks
@pytest.mark.parametrize("effects", [{}, VISCOUS], ids=["undamped", "damped"])
def test_pushed_hand_gains_the_momentum_of_the_force(effects: dict[str, Any]) -> None:
    """Two-way: M_hand v_s + M_rigid v_s + G'z' = sum of u dt, though the tissue's force is not linear."""
    model = finite(effects={"reaction": True, **effects}, motion={"profile": "hold", "target": None, "drive": "force"})
    system = model.system
    run = simulate(model, force=lambda n, t, q, v: 6 * wave(n, t, q, v))
    dt = model.scene.time_end / model.scene.time.steps
    comm, n = system.layout.comm, system.layout.n_local
    tissue = comm.allreduce(system.G.T @ run.final[n:])
    momentum = (system.M_hand + system.M_rigid) @ run.v_s[-1] + tissue
    assert np.allclose(momentum, run.force.sum(axis=0) * dt, rtol=1e-8)
    assert run.energy_drift < 1e-9
    assert run.newton is not None
    assert run.newton.min_det < 0.95  # it is not a small deformation
    # led along the same way, the hand takes the same force
    again = simulate(model, force=lambda n, t, q, v: run.force[n])
    assert close(again.q_s, run.q_s) < 1e-12


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param("cholesky", marks=pytest.mark.ranks),
        pytest.param("mumps", marks=pytest.mark.ranks),
        pytest.param("cg", marks=pytest.mark.ranks(2)),
    ],
)
def test_ranks_and_solvers_agree(solver: str) -> None:
    """To the tolerance of the steps, over 10 of them; the spread factor of MUMPS and CG share the points by rank."""
    few = {"time": {"steps": 10, "end": 0.5}, "motion": {"target": [2.0, 1.0]}}
    alone = finite(few, tol=1e-11, comm=MPI.COMM_SELF)
    model = finite(few, tol=1e-11, time={"solver": solver, "reproducible": False, "rtol": 1e-12})
    assert close(last(model, simulate(model)), last(alone, simulate(alone))) < 1e-8


@pytest.mark.serial
def test_a_restart_file_of_another_iteration_is_refused(tmp_path: Path) -> None:
    """What steps carry on had another form in earlier versions; a linear run carries nothing."""
    manifest = tmp_path / "checkpoint/checkpoint.json"
    for model, iterates in ((finite(), True), (build(make_scene()), False)):
        with pytest.raises(Paused):
            simulate(model, RunOptions(tmp_path, until=3))
        entry = read_manifest(manifest, FORMAT)
        assert ("iterations" in entry) is iterates
    with pytest.raises(Paused):
        simulate(finite(), RunOptions(tmp_path, until=3))
    entry = read_manifest(manifest, FORMAT)
    write_manifest(manifest, {**entry, "iterations": 1})
    with pytest.raises(CheckpointError) as error:
        simulate(finite(), RunOptions(tmp_path, resume=True))
    assert str(error.value) == (
        f"{manifest} was written by another version of softgrasp, which continues iterations in another form; run "
        "again without --resume"
    )


@pytest.mark.ranks
@pytest.mark.parametrize("effects", [{}, {"reaction": True, **VISCOUS}], ids=["led", "pushed"])
def test_stopped_run_goes_on_bit_by_bit(tmp_path_factory: pytest.TempPathFactory, effects: dict[str, Any]) -> None:
    """In the middle of strong deformation, after tangents were made anew and pairs gathered."""
    comm = MPI.COMM_WORLD
    folder = Path(comm.bcast(str(tmp_path_factory.mktemp("restart"))))
    model = finite(effects=effects)
    force = (lambda n, t, q, v: 6 * wave(n, t, q, v)) if effects else None
    whole = simulate(model, RunOptions(folder / "a"), force)
    assert whole.newton is not None
    assert whole.newton.factors > 1
    with pytest.raises(Interrupted):
        simulate(model, RunOptions(folder, until=33), force)
    resumed = simulate(model, RunOptions(folder, resume=True), force)
    assert np.array_equal(resumed.final, whole.final)
    assert np.array_equal(resumed.outputs, whole.outputs)
    assert resumed.newton == whole.newton
    assert resumed.energy_drift == whole.energy_drift


@pytest.mark.ranks
@pytest.mark.parametrize("way", ["led", "led, two-way", "pushed"])
def test_step_that_does_not_converge_is_substepped(way: str) -> None:
    """Steps of more than a period under a violent motion; balances of energy and momentum hold over the parts too."""
    effects: dict[str, Any] = {
        "reaction": way != "led",
        "damping": {"kind": "rayleigh", "alpha": 0.1, "beta": 0.0, "drag": "space"},
    }
    model = finite(time={"steps": 6}, motion={"target": [6.0, 3.0], "duration": 1.5}, effects=effects)
    force = (lambda n, t, q, v: 12 * wave(n, t, q, v)) if way == "pushed" else None
    run = simulate(model, force=force)
    assert run.newton is not None
    assert run.newton.substepped > 0
    assert run.energy_drift < 1e-9
    system, dt = model.system, model.scene.time_end / 6
    n = system.layout.n_local
    moved, speed = (total(system.layout.comm, system.G.T @ part) for part in (run.final[:n], run.final[n:]))
    momentum = (system.M_hand + system.M_rigid) @ run.v_s[-1] + speed
    way_of_hand = (run.v_s[1:] + run.v_s[:-1]).sum(axis=0) / 2 * dt
    lost = 0.1 * (system.M_rigid @ way_of_hand + moved)  # alpha times what the whole tissue moved
    assert np.allclose(momentum + lost, run.force.sum(axis=0) * dt, rtol=1e-8)


@pytest.mark.ranks
def test_stvk_is_refused_where_it_folds() -> None:
    with pytest.raises(SolverError, match=r"step \d+ of 60, to t = .* s: finite strain \(stvk\): .* in the cell at \("):
        simulate(finite(law="stvk", motion={"target": [8.0, 5.0]}))


@pytest.mark.ranks
def test_inverted_start_is_refused() -> None:
    model = finite()
    z = np.where(np.arange(model.system.layout.n_e) % 4 == 0, 0.6, 0.0)
    with pytest.raises(SolverError, match=r"neo-hooke\): det F = -"):
        run_from(model, z, 0 * z)


@pytest.mark.ranks
@pytest.mark.parametrize("g", [-1.0, -150.0, 0.8])
def test_equilibrium_is_scikit_fem_s(g: float) -> None:
    """The static body by Newton's method in another code, to 1e-8; pulled, the strip sags by more than its length.

    Pushed, it carries 0.8 of the load that buckles it.
    """
    model = finite(
        STRIP, law="neo-hooke-quadratic", effects={"gravity": {"g": [0.0, g]}}, time={"start": "equilibrium"}
    )
    layout = model.system.layout
    ours = gather_rows(layout, equilibrium(model.system))
    points, cells = gather_mesh(model.space.mesh.mesh)
    mesh = skfem.MeshTri(points.T.copy(), cells.T.astype(np.int64).copy())
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP1()), intorder=2)
    m = model.scene.tissue.material

    def parts(w: Any) -> tuple[Any, Any, Any]:
        F = w.u.grad + np.eye(2)[:, :, None, None]
        J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        return F, J, np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]])

    @skfem.LinearForm
    def force(v: Any, w: Any) -> Any:
        F, J, C = parts(w)
        P = m.mu * F + (m.lam * (J - 1) - m.mu / J) * C
        return np.einsum("ij...,ij...->...", P, v.grad) - m.rho * g * v[1]

    @skfem.BilinearForm
    def tangent(u: Any, v: Any, w: Any) -> Any:
        _, J, C = parts(w)
        G = u.grad
        turned = np.array([[G[1, 1], -G[1, 0]], [-G[0, 1], G[0, 0]]])
        slope = np.einsum("ij...,ij...->...", C, G)
        moved = m.mu * G + (m.lam + m.mu / J**2) * slope * C + (m.lam * (J - 1) - m.mu / J) * turned
        return np.einsum("ij...,ij...->...", moved, v.grad)

    held = basis.get_dofs(mesh.facets_satisfying(lambda x: abs(x[1] - 2.0) < 1e-9)).flatten()
    free = np.setdiff1d(np.arange(basis.N), held)
    where = basis.doflocs.T[free][::2]
    component = np.zeros(basis.N, dtype=int)
    for c, dofs in enumerate(basis.nodal_dofs):
        component[dofs] = c
    assert np.array_equal(component[free], np.tile([0, 1], len(free) // 2))
    order = (node_order(where)[:, None] * 2 + np.arange(2)).ravel()
    u = np.zeros(basis.N)
    u[free[order]] = ours + 1e-3 * np.sin(np.arange(len(ours)))  # Newton must find its own way back
    for _ in range(12):
        field = basis.interpolate(u)
        K, r = tangent.assemble(basis, u=field), force.assemble(basis, u=field)
        u[free] -= skfem.solve(K[free][:, free], r[free])
    assert close(ours, u[free[order]]) < 1e-8
    assert (np.abs(ours).max() > 2.0) == (g == -150.0)


@pytest.mark.ranks(solver=("cholesky", "mumps"))
@pytest.mark.parametrize(
    ("solver", "words"), [("cholesky", UNSTABLE), ("mumps", UNSTABLE), ("cg", r"no stable equilibrium beyond 0\.98")]
)
def test_a_column_beyond_its_load_is_refused(solver: SolverName, words: str) -> None:
    """A slender column under its own weight buckles at 7.8373 EI / L^3 [Greenhill 1881], plane strain, to 1 %.

    Beyond, Newton's method still finds it upright: an equilibrium that no column keeps.
    """
    column: dict[str, Any] = {
        "tissue": {"size": [0.1, 2.0], "cells": [2, 20], "order": 2},
        "contact": {"sides": ["bottom"], "box": [[0.0, 0.0], [0.1, 2.0]]},
    }
    m = make_scene(column).tissue.material
    E = 4 * m.mu * (m.lam + m.mu) / (m.lam + 2 * m.mu)
    g = 7.8373 * E * 0.1**2 / 12 / (m.rho * 2.0**3)  # EI over the mass of a unit of length, times L^-3

    def stand(part: float) -> None:
        gravity = {"effects": {"gravity": {"g": [0.0, -part * g]}}, "time": {"start": "equilibrium"}}
        equilibrium(finite(column, gravity).system, solver)

    stand(0.98)
    with pytest.raises(SolverError, match=words):
        stand(1.02)


@pytest.mark.serial
def test_off_loads_nothing_of_it() -> None:
    code = (
        "import sys, softgrasp as sg; m = sg.build('paper_forward', ['tissue.cells=[2, 4]', 'time.steps=3']); "
        "sg.simulate(m); print([n for n in sys.modules if n.startswith('softgrasp') "
        "and ('.strain' in n or 'finite' in n) and not n.startswith('softgrasp.fem.effects')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
