"""Before any large solve: can this plant be stabilised by these inputs and outputs, in double precision?"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Shown
from softgrasp.lqr.dense.modal import ENOUGH, ModeRates, closed_loop_rates, enough_damping, lost_sentence, lowest_plant
from softgrasp.lqr.plant.checks import EPS, MODAL_KEY, ControlError, check_finite, check_weights, square_root
from softgrasp.lqr.plant.problem import RiccatiProblem

MODES = 60
WEAK = ENOUGH / 4  # damping ratio of the first mode where the low-rank solvers begin to need many hundred solves

Kind = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """One sentence about the control problem; an error means that no solver should be started."""

    kind: Kind  # "error" or "warning"
    topic: str  # "weights", "data", "outputs", "inputs" or "damping"
    sentence: str  # the fault and its remedy


@dataclass(frozen=True, repr=False)
class Diagnosis(Shown):
    """Findings and estimated poles from before the solve."""

    findings: tuple[Finding, ...]  # errors and warnings, errors first
    rates: ModeRates | None  # estimated closed-loop poles of the lowest modes; None when the data are unusable
    damping_enough: float  # least Kelvin-Voigt time beta for fast low-rank solvers, nan if unknown [s]

    @property
    def solvable(self) -> bool:
        """Whether a Riccati solver should be started."""
        return all(f.kind != "error" for f in self.findings)

    def require(self, but: Collection[str] = ()) -> None:
        """Go on only when solvable, whatever the errors of the topics ``but`` are.

        Raises ControlError: with the first error's sentence.
        """
        for finding in self.findings:
            if finding.kind == "error" and finding.topic not in but:
                raise ControlError(finding.sentence)


def diagnose(problem: RiccatiProblem, modes: int = MODES) -> Diagnosis:
    """Check weights and data, outputs and inputs, and the damping of the closed loop. Collective."""
    unusable = _data(problem)
    if unusable:
        return Diagnosis(tuple(unusable), None, float("nan"))
    plant = lowest_plant(problem, min(modes, problem.layout.n_e))
    rates = closed_loop_rates(problem, plant, largest=_largest_frequency(problem))
    findings = _outputs(problem) + _damping(problem, rates)
    findings.sort(key=lambda f: f.kind != "error")
    return Diagnosis(tuple(findings), rates, enough_damping(rates))


def _data(problem: RiccatiProblem) -> list[Finding]:
    """Weights that are refused and numbers that are none; agreed on by all ranks."""
    system = problem.system
    bad: list[Finding] = []
    try:
        check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
    except ControlError as error:
        bad.append(Finding("error", "weights", str(error)))
    try:
        check_finite(C_s=problem.C_s, C_z=problem.C_z, G=system.G, T=system.T, M_hand=system.M_hand, B_z=problem.B_z)
        check_finite(M_ee=system.M_ee, K_ee=system.K_ee)
    except ControlError as error:
        bad.append(Finding("error", "data", f"{error}; check material, mesh and outputs"))
    whole = [f for part in problem.layout.comm.allgather(bad) for f in part]
    return list(dict.fromkeys(whole))


def _outputs(problem: RiccatiProblem) -> list[Finding]:
    """The free hand has a double zero eigenvalue a freedom: x_T must be seen, C x_T = C_s."""
    n_s = problem.layout.n_s
    findings: list[Finding] = []
    weighted = square_root(problem.Q) @ problem.C_s
    _, sigma, right = np.linalg.svd(np.vstack([weighted, np.zeros((n_s, n_s))]), full_matrices=False)
    size = float(np.linalg.norm(problem.C_s)) * float(np.sqrt(np.linalg.norm(problem.Q, 2)))
    hidden = np.flatnonzero(sigma <= 1e3 * EPS * size)
    if len(hidden):
        motion = _motion(right[hidden[-1]], problem.layout.dimension)
        text = (
            f"not detectable: the weighted outputs do not see {len(hidden)} of the {n_s} rigid motions of the hand, "
            f"for example {motion}, which nothing else brings to rest; add outputs or give them a weight in control.Q"
        )
        findings.append(Finding("error", "outputs", text))
    rows = np.abs(problem.Q).sum(axis=1)
    idle = [name for name, row in zip(problem.names, rows, strict=True) if row == 0]
    if idle and not len(hidden):
        findings.append(
            Finding("warning", "outputs", f"control.Q gives no weight to {', '.join(idle)}: the cost ignores it")
        )
    return findings


def _motion(direction: Array, d: int) -> str:
    """Name a direction of the hand's freedoms."""
    if np.abs(direction[d:]).max(initial=0.0) > 1e-6 * np.abs(direction).max():
        return "a rotation about a point that they see"
    return f"the translation along {'xyz'[int(np.argmax(np.abs(direction[:d])))]}"


def _damping(problem: RiccatiProblem, rates: ModeRates) -> list[Finding]:
    """Modes that neither damping nor feedback brings to rest."""
    n_e, enough = problem.layout.n_e, enough_damping(rates)
    lost = int(rates.lost.sum())
    way_out = f"set effects.damping.beta >= {enough:.2g} s, or control only the lowest modes with {MODAL_KEY}"
    if not problem.system.damping.active:
        slowest = float(rates.rate.min())
        seen = f"{lost} of the lowest {len(rates.omega)} modes cannot be stabilised in double precision at all"
        if not lost:
            seen = f"the slowest of the lowest {len(rates.omega)} modes would decay at {slowest:.1e}/s"
        text = (
            f"no damping: feedback alone has to stabilise all {n_e} modes, {seen}, and X is not of low rank; {way_out}"
        )
        return [Finding("error", "damping", text)]
    if lost:
        return [Finding("error", "damping", lost_sentence(rates))]
    zeta = float(rates.own[0] / rates.omega[0])
    if zeta < WEAK:
        text = (
            f"nearly undamped: the first mode has the damping ratio {zeta:.1e}, so that X has a high rank and the "
            f"low-rank solvers may not converge; {way_out}"
        )
        return [Finding("warning", "damping", text)]
    return []


def _largest_frequency(problem: RiccatiProblem) -> float:
    """Bound of omega_max by row sums over lumped masses, (max |K_ii| row sum / min M_ii)^{1/2}. Collective."""
    system, comm = problem.system, problem.layout.comm
    indptr, _, values = system.K_ee.getValuesCSR()
    rows = np.add.reduceat(np.abs(values), indptr[:-1]) if len(indptr) > 1 else np.zeros(0)
    mass = system.M_ee.getDiagonal()
    ratio = float((rows / mass.array_r).max(initial=0.0))
    mass.destroy()
    return float(np.sqrt(max(comm.allgather(ratio))))
