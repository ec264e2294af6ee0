"""What is said before a Riccati equation is solved, against what the solution turns out to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.diagnosis import Diagnosis, diagnose
from softgrasp.lqr.plant.checks import ControlError, check_finite, check_weights, square_root
from softgrasp.lqr.plant.problem import RiccatiProblem, translation_defect
from softgrasp.lqr.riccati import modal_lqr
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from tests.helpers.models import close, make_scene, same_everywhere

SMALL = {"tissue": {"cells": [3, 6]}}


def damped(beta: float) -> dict:
    return {"effects": {"damping": {"kind": "kelvin-voigt", "beta": beta}}}


def make(*changes: dict) -> RiccatiProblem:
    return make_problem(build(make_scene(SMALL, *changes), comm=MPI.COMM_WORLD))


def sentences(d: Diagnosis, kind: str) -> list[str]:
    return [f.sentence for f in d.findings if f.kind == kind]


def test_a_good_problem_has_no_findings_and_its_poles_are_known_beforehand() -> None:
    problem = make(damped(0.002))
    found = diagnose(problem)
    assert found.findings == ()
    assert found.solvable
    found.require()
    assert found.rates is not None
    poles = ModalLoop(problem).poles(DenseRiccati().solve(problem).gain.block)
    # riccati.md: 3 to 4 digits as long as modes do not overlap; the lowest ones do not
    for pole in found.rates.poles[:8]:
        nearest = poles[np.argmin(np.abs(poles - pole))]
        assert abs(nearest - pole) < 2e-3 * abs(pole)
        assert abs(nearest.real / pole.real - 1) < 2e-3  # 3 digits of the rate alone, too
    assert same_everywhere(problem.layout.comm, found.rates.rate)


def test_rates_without_damping_are_those_of_the_dense_closed_loop() -> None:
    """The real part is feedback's alone: sqrt(Q) |g| |c| / (2 omega m)."""
    problem = make({"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}], "Q": 1.0, "R": 1.0}})
    found = diagnose(problem)
    assert found.rates is not None
    poles = ModalLoop(problem).poles(modal_lqr(problem, 4).gain.block)
    first = poles[np.argmin(np.abs(poles - found.rates.poles[0]))]
    assert abs(first.real / found.rates.poles[0].real - 1) < 0.05  # first order in the rate; riccati.md
    assert first.real < -1e-3  # 6e-3 measured: damped, beyond rounding


@pytest.mark.parametrize("reaction", [False, True], ids=["one-way", "two-way"])
def test_undamped_is_refused_with_a_way_out(reaction: bool) -> None:
    found = diagnose(make({"effects": {"reaction": reaction}}))
    assert not found.solvable
    (sentence,) = sentences(found, "error")
    assert sentence.startswith("no damping: feedback alone has to stabilise all")
    assert f"effects.damping.beta >= {found.damping_enough:.2g} s" in sentence
    assert "control.method = 'modal'" in sentence
    with pytest.raises(ControlError, match="no damping"):
        found.require()
    enough = diagnose(make(damped(1.01 * found.damping_enough), {"effects": {"reaction": reaction}}))
    assert enough.solvable
    assert sentences(enough, "warning") == []


def test_nearly_undamped_is_a_warning() -> None:
    for beta in (0.2, 0.002):
        enough = diagnose(make(damped(beta)), modes=20)
        assert enough.solvable
        assert sentences(enough, "warning") == []
    weak = diagnose(make(damped(1e-5)))
    assert weak.solvable
    assert sentences(weak, "warning")[0].startswith("nearly undamped: the first mode has the damping ratio 2")


NODE = [{"kind": "node", "point": [0.5, 0.0]}]


def test_outputs_that_do_not_see_and_weights_that_are_refused() -> None:
    problem = make(damped(0.002))
    zero, one = np.zeros((2, 2)), np.eye(2)
    table = [
        (replace(problem, Q=np.diag([1.0, 0.0])), "outputs", "do not see 1 of the 2 rigid .* translation along y"),
        (replace(problem, Q=zero), "outputs", "do not see 2 of the 2"),
        (replace(problem, R=zero), "weights", "R has the eigenvalue 0; all must be > 0"),
        (replace(problem, R=np.diag([1.0, -2.0])), "weights", "R has the eigenvalue -2"),
        (replace(problem, Q=-one), "weights", "Q has the eigenvalue -1; all must be >= 0"),
        (replace(problem, Q=np.array([[1.0, 1], [0, 1]])), "weights", "Q is not symmetric"),
        (replace(problem, Q=np.eye(3)), "weights", r"Q has the shape \(3, 3\); it must be \(2, 2\)"),
        (replace(problem, R=np.diag([1.0, np.nan])), "weights", "R has an entry that is not a finite number"),
        (replace(problem, C_z=np.full_like(problem.C_z, np.nan)), "data", "C_z has .* not finite .* check material"),
    ]
    for bad, topic, message in table:
        found = diagnose(bad)
        assert not found.solvable, message
        assert {f.topic for f in found.findings} == {topic}, message
        with pytest.raises(ControlError, match=message):
            found.require()


def test_rotation_needs_a_second_output() -> None:
    turning = {"effects": {"rotation": True}}
    found = diagnose(make(damped(0.002), turning, {"control": {"outputs": NODE}}))
    assert "1 of the 3 rigid motions of the hand, for example a rotation about a point" in sentences(found, "error")[0]
    more = {"control": {"outputs": [*NODE, {"kind": "node", "point": [1.0, 1.0]}]}}
    assert diagnose(make(damped(0.002), turning, more)).solvable


def test_an_output_without_weight_is_a_warning() -> None:
    problem = make(damped(0.002), {"control": {"outputs": [*NODE, {"kind": "hand", "name": "grip"}]}})
    found = diagnose(replace(problem, Q=np.diag([1.0, 1, 0, 1])))
    assert found.solvable
    assert sentences(found, "warning") == ["control.Q gives no weight to grip_x: the cost ignores it"]


@pytest.mark.ranks
def test_a_nan_on_one_rank_is_told_on_all() -> None:
    problem = make(damped(0.002))
    bad = problem.C_z.copy()
    if problem.layout.comm.rank == 0 and len(bad):
        bad[0, 0] = np.inf
    found = diagnose(replace(problem, C_z=bad))
    assert sentences(found, "error")[0].startswith("C_z has 1 entries that are not finite")


def test_modal_lqr_says_what_it_leaves_and_does_not_move_it() -> None:
    problem = make()
    gains = []
    for modes in (0, 3, 10):
        solution = modal_lqr(problem, modes)
        left = problem.layout.n_e - modes
        assert solution.about.endswith(f"the other {left} modes are not stabilised and stay on the imaginary axis")
        assert solution.rank <= 4 + 2 * modes
        assert solution.residual > 1e-3  # it is no solution of the whole equation, and says so
        assert translation_defect(problem, solution) < 1e-10  # the residual of the small equation
        poles = ModalLoop(problem).poles(solution.gain.block)
        assert (poles.real > -1e-9).sum() >= 2 * left  # still on the axis
        assert poles.real.max() < 1e-8  # not driven off it: rounding of frequencies up to 3e2
        assert (poles.real < -1e-9).sum() >= 2 * min(modes, 3) + 4  # off it
        gains.append(solution.gain.K_s)
    assert close(gains[1], gains[2]) < 1e-4  # riccati.md: hand gains settle with the modes
    assert 0 < close(gains[1], gains[2]) < close(gains[0], gains[2])


def test_modal_lqr_with_all_modes_is_the_full_solution() -> None:
    problem = make(damped(0.02))
    full, n_e = DenseRiccati().solve(problem), problem.layout.n_e
    modal = modal_lqr(problem, n_e)
    assert modal.residual < 1e-9  # modes from SLEPc are good to 1e-11 relative, amplified by |A|
    assert close(modal.gain.K_s, full.gain.K_s) < 1e-9  # as above
    comm = problem.layout.comm
    parts = [np.concatenate(comm.allgather(np.array(x))) for x in (modal.gain.K_z, full.gain.K_z)]
    assert close(parts[0], parts[1]) < 1e-7  # K_z is 1e-3 of K_s


def test_modal_lqr_does_not_promise_what_cannot_be() -> None:
    problem = make({"control": {"outputs": [{"kind": "hand"}]}})
    with pytest.raises(ControlError, match="only 0 of the lowest 40 modes can be stabilised, 10 are requested"):
        modal_lqr(problem)
    with pytest.raises(ControlError, match="modes = -1 must be 0 or more"):
        modal_lqr(problem, -1)


def test_small_checks() -> None:
    check_weights(np.zeros((2, 2)), np.eye(1), 2, 1)
    check_finite(a=None, b=np.ones(3))
    S = square_root(np.array([[2.0, 2.0], [2.0, 2.0]]))
    assert S.shape == (1, 2)  # full row rank
    assert np.allclose(S.T @ S, 2, atol=1e-14)  # rounding
