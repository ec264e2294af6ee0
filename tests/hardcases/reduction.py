"""Hard cases of bases and reduced models: snapshots without rank or scale, N at the edge, models that grow."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import force_values
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.reduction.bases.engines import factor
from softgrasp.reduction.bases.inner import orthonormality
from softgrasp.reduction.bases.registry import make_bases, make_basis
from softgrasp.reduction.bases.states import States, states_of
from softgrasp.reduction.online import run
from softgrasp.reduction.projection import project
from softgrasp.reduction.replay import FullRun, full_run
from softgrasp.reduction.system import EnergySystem
from tests.hardcases.cases import EPS, Family, HardCase, Outcome, here, make, qr_rounding, textbook, thin

MOVE = 300  # steps of the move
REASON = "rounding of a QR factorisation, rows x columns x eps [H02]"


@cache
def moved(cells: int, every: int = 1, periods: int = 1) -> FullRun:
    """The paper's move in 3 s, driven by force, on a mesh of cells x 2 cells; then rest up to 3 s times periods."""
    scene = (f"tissue.cells=[{cells}, {2 * cells}]", "motion.drive='force'", f"output.every={every}")
    model = make("paper_forward", *scene, f"time={{steps={300 * periods}, end={3.0 * periods!r}}}")
    return full_run(model, simulate(model))


def stacked(snapshots: Snapshots, T: Array) -> Array:
    """Columns [q_s; v_s; q_e; v_e] of one rank."""
    return np.vstack([snapshots.q_s, snapshots.v_s, snapshots.displacement(T), snapshots.velocity(T)])


def gram_basis(X: Array, k: int) -> Array:
    """The method of snapshots: eigenvectors W of X'X, columns X w / sqrt(lambda)."""
    values, W = np.linalg.eigh(X.T @ X)
    return np.asarray(X @ W[:, ::-1][:, :k] / np.sqrt(values[::-1][:k]))


# --- small singular values


def sigma_rows(quick: bool) -> Iterator[HardCase]:
    """Singular values of a matrix made with known ones, from 1 to 1e-14."""
    generator, k = np.random.default_rng(7), 57
    U = np.linalg.qr(generator.standard_normal((400, k)))[0]
    W = np.linalg.qr(generator.standard_normal((k, k)))[0]
    exact = 10.0 ** (-14 * np.arange(k) / (k - 1))
    X = np.asfortranarray(U * exact @ W.T)
    f = factor(MPI.COMM_SELF, X)
    tsqr = np.linalg.svd(f.R, compute_uv=False) * f.scale
    gram = np.sqrt(np.linalg.eigvalsh(X.T @ X)[::-1].astype(complex)).real
    for j in thin(list(range(0, k, 8)), quick):
        i = int(j)
        reason = "backward error of QR and SVD: sqrt(rows) = 20 roundings of the largest singular value"
        errors = [Outcome(float(abs(s[i] / exact[i] - 1))) for s in (tsqr, gram)]
        name = f"singular value {exact[i]:.0e} of the largest"
        yield HardCase(name, float(exact[i]), errors[0], errors[1], math.sqrt(len(X)) * EPS / exact[i], reason)


# --- snapshots of any scale, of no rank


def _scaled(case: FullRun, factor: float) -> States:
    s = case.snapshots
    return states_of(case.model.system, replace(s, Z=factor * s.Z, q_s=factor * s.q_s, v_s=factor * s.v_s))


def _pod_defect(states: States, N: int) -> float:
    return orthonormality(make_basis("global_pod", states, N), states.system)


def _gram_defect(X: Array, N: int) -> Outcome:
    V = gram_basis(X, N)
    missing = "" if V.shape[1] == N else f"only {V.shape[1]} of {N} vectors, no warning"
    error = float(np.abs(V.T @ V - np.eye(V.shape[1])).max())
    return Outcome(error if np.isfinite(error) else None, missing or ("" if np.isfinite(error) else "not a number"))


def scale_rows(quick: bool) -> Iterator[HardCase]:
    """Orthonormality of ten POD vectors of snapshots in units from 1e-300 to 1e300."""
    case = moved(4, 6)
    X = stacked(case.snapshots, case.model.system.T)
    for power in thin([-300, -200, -150, -100, 0, 100, 150, 200, 300], quick):
        unit = 10.0**power
        pod, gram = here(_pod_defect, _scaled(case, unit), 10), textbook(_gram_defect, unit * X, 10)
        yield HardCase(f"snapshots times {unit:.0e}", unit, pod, gram, qr_rounding(*X.shape), REASON)


def _columns(case: FullRun, pick: NDArray[Any]) -> States:
    return states_of(case.model.system, case.snapshots.columns(pick))


def deficient_rows(quick: bool) -> Iterator[HardCase]:
    """Snapshots that repeat each other, are alone, or are all at rest."""
    case = moved(4, 6)
    last = case.snapshots.Z.shape[1] - 1
    five = np.linspace(last // 5, last, 5).astype(int)
    cases: list[tuple[str, NDArray[Any], int, bool]] = [
        ("five snapshots, each forty times, N = 5", np.tile(five, 40), 5, False),
        ("five snapshots, each forty times, N = 6", np.tile(five, 40), 6, True),
        ("one snapshot, N = 1", five[:1], 1, False),
        ("one snapshot, N = 2", five[:1], 2, True),
        ("only the state at rest, N = 1", np.zeros(3, dtype=int), 1, True),
    ]
    for i, (name, pick, N, refuse) in enumerate(cases[1::3] if quick else cases):
        states = _columns(case, pick)
        X = stacked(states.runs[0][1], case.model.system.T)
        pod, gram = here(_pod_defect, states, N), textbook(_gram_defect, X, N)
        bound = None if refuse else qr_rounding(*X.shape)
        reason = "N is more than the rank" if refuse else REASON
        yield HardCase(name, i + 1, pod, gram, bound, reason)


def edge_rows(quick: bool) -> Iterator[HardCase]:
    """Orthonormality of POD for N up to the number of snapshots and one more."""
    case = moved(4, 6)
    X = stacked(case.snapshots, case.model.system.T)
    m = X.shape[1] - 1  # the first snapshot is zero
    for N in thin([4, 12, 20, 28, 36, 44, m, m + 1], quick):
        n = int(N)
        pod, gram = here(_pod_defect, states_of(case.model.system, case.snapshots), n), textbook(_gram_defect, X, n)
        bound = qr_rounding(*X.shape) if n <= m else None
        reason = REASON + "; above the numerical rank a refusal is right" if bound else f"there are only {m} snapshots"
        yield HardCase(f"N = {n}", n, pod, gram, bound, reason, may_refuse=n > m // 2)


# --- models that grow


def textbook_loop(rom: EnergySystem, dt: float, force: Array) -> Array:
    """States of the midpoint rule on E x' = A x + B u as a textbook has it, unstable or not, (steps + 1, N)."""
    lu = scipy.linalg.lu_factor(rom.E - dt / 2 * rom.A)
    x = np.zeros(rom.N)
    states = [x]
    for u in force:
        x = scipy.linalg.lu_solve(lu, (rom.E + dt / 2 * rom.A) @ x + dt * (rom.B @ u))
        states.append(x)
    return np.array(states)


def _energy_change(case: FullRun, rom: EnergySystem, force: Array, checked: bool) -> float:
    """Largest change of the energy after the move, where no force acts, over the largest energy of the run."""
    x = run(rom, case.dt, force=force).x if checked else textbook_loop(rom, case.dt, force)
    energy = rom.total_energy(x)
    if not np.isfinite(energy).all():
        return math.inf
    free = energy[MOVE:]
    return float(np.abs(free - free[0]).max() / np.abs(energy[: MOVE + 1]).max())


def _rounding_of_energy(case: FullRun, rom: EnergySystem, force: Array) -> float:
    """N eps sqrt(steps), a random walk, times |x|'|H||x| / 2 over the largest energy: what its products cancel."""
    x = textbook_loop(rom, case.dt, force)[: MOVE + 1]
    terms = np.einsum("ki,ij,kj->k", abs(x), abs(rom.H), abs(x)).max() / 2
    return math.sqrt(len(force)) * rom.N * EPS * float(terms / np.abs(rom.total_energy(x)).max())


def growth_rows(quick: bool) -> Iterator[HardCase]:
    """Bases from the move of 3 s, run five times as long; and what happens to models that grow."""
    case = moved(5 if quick else 10, periods=5)
    scene, system = case.model.scene, case.model.system
    force, outputs = force_values(scene, system.layout.n_s, system.M_hand), make_outputs(scene, system)
    trained = _columns(case, np.arange(MOVE + 1))
    dimensions = [10, 20, 40] if quick else [10, 14, 18, 22, 26, 30, 34, 38, 42, 46, 50, 60]
    sweeps = {name: make_bases(name, trained, dimensions) for name in ("psd", "global_pod")}
    growing = []
    for i, N in enumerate(dimensions):
        roms = {name: project(bases[i], system, outputs).at() for name, bases in sweeps.items()}
        midpoint = here(_energy_change, case, roms["psd"], force, True)
        loop = textbook(_energy_change, case, roms["global_pod"], force, False)
        reason = "the midpoint rule keeps quadratic energies [HLW06]: N products in each step, rounded once each"
        bound = _rounding_of_energy(case, roms["psd"], force)
        yield HardCase(f"N = {N}", N, midpoint, loop, bound, reason)
        if not roms["global_pod"].stable:
            growing.append((N, roms["global_pod"], loop))
    for N, model, loop in growing[:: max(1, len(growing) // 3)]:
        name = f"(q, v) POD, N = {N}, grows by {model.spectral_abscissa:.1e}/s"
        refusal, reason = here(_energy_change, case, model, force, True), "a growing model must not be run silently"
        yield HardCase(name, N, refusal, loop, None, reason, group="(q, v) POD")


FAMILIES = (
    Family("sigma", "Small singular values of the snapshots", "singular value / largest",
           "relative error of the singular value", "eigenvalues of the Gram matrix",
           "Squaring the snapshots loses everything below 1e-8 of the largest; tall-skinny QR keeps it.", sigma_rows),
    Family("scale", "Snapshots in tiny and huge units", "unit of the snapshots", "defect of orthonormality",
           "POD by the Gram matrix",
           "Squares of small numbers underflow, of large ones overflow; a scale prevents both.",
           scale_rows),
    Family("deficient", "Snapshots without rank", "case", "defect of orthonormality", "POD by the Gram matrix",
           "Beyond the rank there is no vector to take: the textbook way returns noise or NaN, here it is said.",
           deficient_rows, axis="listed"),
    Family("edge", "Reduced dimension at the edge of the rank", "N", "defect of orthonormality",
           "POD by the Gram matrix", "Gram vectors lose orthogonality long before the rank is reached.", edge_rows,
           axis="linear"),
    Family("growth", "Unstable reduced models", "N", "change of the energy after the move / largest energy",
           "(q, v) POD, midpoint loop",
           "Galerkin models in (q, v) may grow without limit; symplectic ones cannot, and growing ones are refused.",
           growth_rows, axis="linear"),
)  # fmt: skip
