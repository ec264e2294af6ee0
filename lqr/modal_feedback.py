"""Modal-truncated feedback, by name only: optimal for the hand and some modes, silent about all others."""

from __future__ import annotations

import time

import numpy as np

from softgrasp.fem.petsc import on_root
from softgrasp.lqr.dense.care import care_of
from softgrasp.lqr.dense.modal import closed_loop_rates, factor_psd, lowest_plant
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.checks import ControlError, check_weights
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import modal_basis
from softgrasp.lqr.reduced.riccati import full_gain, project_plant


def modal_lqr(problem: RiccatiProblem, modes: int = 10, candidates: int = 40) -> RiccatiSolution:
    """Riccati equation of the hand and the lowest modes that feedback can stabilise, expanded by the filter Phi'M_ee.

    One-way coupling and a modal filter leave the other modes where they are: with damping they decay by themselves,
    without damping they stay on the imaginary axis, driven but not destabilised. With two-way coupling the hand feels
    them, so that the whole loop must be checked with :class:`softgrasp.lqr.spectrum.modal_loop.ModalLoop`. Collective.

    Args:
        modes: number of modes in the model.
        candidates: lowest modes they are taken from; modes that inputs do not reach or outputs do not see are skipped.

    Returns:
        A solution of rank up to 2 n_s + 2 modes. ``residual`` is the true one of the whole plant: it is large when
        modes that matter are left out.

    Raises:
        ControlError: fewer than ``modes`` of the candidates can be stabilised, or the small equation has no solution.
    """
    system, comm = problem.system, problem.layout.comm
    begin = time.perf_counter()
    check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
    if modes < 0:
        raise ControlError(f"modal_lqr: modes = {modes} must be 0 or more")
    k = min(max(candidates, modes, 1), system.layout.n_e)
    plant = lowest_plant(problem, k)
    good = np.flatnonzero(closed_loop_rates(problem, plant).lost == 0)
    if len(good) < modes:
        raise ControlError(
            f"modal_lqr: only {len(good)} of the lowest {k} modes can be stabilised, {modes} are asked for; ask for at "
            f"most {len(good)}"
        )
    pick = good[:modes]
    basis = modal_basis(problem, "modal_lqr", plant, pick)
    m = project_plant(problem, basis)
    middle = time.perf_counter()
    P_N = on_root(comm, lambda: care_of(m).X)
    Z = basis.W.times(on_root(comm, lambda: factor_psd(P_N)))
    gain = full_gain(problem, basis, P_N)
    left = system.layout.n_e - modes
    word = (
        "decay by their own damping" if system.damping.active else "are not stabilised and stay on the imaginary axis"
    )
    return RiccatiSolution(
        Z,
        gain,
        residual(problem, Z),
        "modal_lqr",
        f"hand and {modes} modes; the other {left} modes {word}",
        counts={"newton_steps": 0, "adi_steps": 0, "solves": 0},
        seconds={"modes": middle - begin, "small": time.perf_counter() - middle},
    )
