"""Hard cases of certified reduced models: motions, materials and scenes that nobody trained for, and damaged files."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.linalg

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.residual import ResidualSpace
from softgrasp.reduction.certified.trainer import Trainer, build_certified
from softgrasp.reduction.certified.training import certified_model, scene_drive
from softgrasp.reduction.certified.validation import energy_norm, true_error
from softgrasp.reduction.parameters import materials_at
from softgrasp.reduction.replay import FullRun
from tests.hardcases.cases import EPS, Family, HardCase, Outcome, here, make, textbook

KV = "effects.damping={kind='kelvin-voigt', beta=0.002}"
MESH = ("tissue.cells=[4, 8]", "time={steps=300, end=3.0}")
CONTRAST = (
    "tissue.layers={low={box=[[0.0, 0.0], [1.0, 0.5]], material={lambda=500000.0, mu=500000.0, rho=1.0}, beta=0.0}}"
)
SAG = ("effects.gravity={g=[1.0, -9.0]}", "time={steps=300, end=3.0, start='equilibrium'}")
TRAINING = ((50.0, 50.0), (30.0, 20.0), (500.0, 20.0), (30.0, 500.0), (500.0, 500.0))
ROUNDING = 1e-9  # of the solution: the bound is exact in exact arithmetic
TOLERANCE = 0.02


@dataclass(frozen=True)
class Query:
    """One question to a certified model."""

    case: str  # in words
    scene: tuple[str, ...] = (KV,)  # overrides of the scene that the model is trained on
    at: tuple[float, float] = (60.0, 45.0)  # lambda and mu [Pa]
    motion: tuple[str, ...] = ()  # overrides of the question alone
    k: int = 12  # modes of the answer
    k2: int = 36  # modes of the basis that certifies it
    refuse: bool = False  # the answer must be refused


QUESTIONS = (
    Query("a parameter between those of the training"),
    Query("ten times faster", motion=("motion.duration=0.3",), refuse=True),
    Query("another direction than trained", motion=("motion.target=[3.0, -5.0]",), refuse=True),
    Query("lambda / mu = 100", at=(5000.0, 50.0)),
    Query("lambda / mu = 1e4", at=(5e5, 50.0)),
    Query("lambda < 0", at=(-20.0, 50.0)),
    Query("mu a tenth of the least trained", at=(30.0, 2.0), refuse=True),
    Query("a layer 1e4 times as stiff", scene=(KV, CONTRAST)),
    Query("viscosity with omega beta dt > 10", scene=("effects.damping={kind='kelvin-voigt', beta=5.0}",)),
    Query("no damping, 300 s", scene=(), motion=("time={steps=30000, end=300.0}",), refuse=True),
    Query("start in equilibrium under gravity", scene=(KV, *SAG)),
    Query("hand driven by a force, coupled both ways", scene=(KV, "effects.reaction=true", "motion.drive='force'")),
    Query("a hand that does not move", motion=("motion={profile='hold', drive='motion'}",)),
    Query("one mode", k=1),
    Query("one basis, k2 = k", k=36),
)


def pod(model: Model, k: int) -> Array:
    """K-orthonormal POD modes of displacements and velocities of full runs over the box, (n_e, k)."""
    root = np.linalg.cholesky(to_scipy(model.system.K_ee).toarray())
    n, columns = model.system.layout.n_local, []
    for lam, mu in TRAINING:
        Z = full(model, lam, mu).snapshots.Z[:, ::6]
        z, v = Z[:n], Z[n:]
        columns += [z, v * np.linalg.norm(z) / max(float(np.linalg.norm(v)), EPS)]
    U = np.linalg.svd(root.T @ np.hstack(columns), full_matrices=False)[0]
    return np.asfortranarray(scipy.linalg.solve_triangular(root.T, U[:, :k], lower=False))


def full(model: Model, lam: float, mu: float) -> FullRun:
    """The full run at a parameter, with all states; also of a hand that does not move."""
    other = replace(model, system=model.system.with_materials(materials_at(model, lam, mu)))
    run = simulate(other)
    if run.snapshots is None:
        raise ValueError("the scene keeps no snapshots in memory")
    return FullRun(other, run, run.snapshots)


@cache
def certified_for(scene: tuple[str, ...], k: int, k2: int) -> tuple[Model, CertifiedModel]:
    """A scene and its certified model."""
    model = make("paper_forward", *MESH, *scene)
    return model, certified_model(model, pod(model, k2), k=k, tolerance=TOLERANCE)


def shares(exact: FullRun, model: CertifiedModel, run: CertifiedRun, coupled: bool) -> tuple[Outcome, Outcome]:
    """Largest true error over the proved bound, and over the difference of two bases taken for one.

    ``ROUNDING`` of the largest norm of the solution is allowed beside the bound.
    """
    system, s, reconstruction, c = exact.model.system, exact.snapshots, model.fine.reconstruction, run.certificate
    if reconstruction is None:
        raise ValueError("the model has no reconstruction")
    hand, size = 2 * system.layout.n_s, energy_norm(system, s.Z, s.v_s if coupled else None).max()
    error = true_error(exact, run.trajectory, reconstruction.L_q[:, hand : hand + model.k], coupled)

    def share(bound: Array) -> float:
        return float(np.max(error / np.maximum(bound + ROUNDING * size, np.finfo(float).tiny)))

    estimate = c.estimate
    plain = Outcome(None, "no second basis") if estimate is None else textbook(lambda: share(estimate.values))
    return Outcome(share(c.energy.values)), plain


def question_row(i: int, q: Query) -> HardCase:
    """One question: the bound against the truth, and the difference of two bases taken for the error."""
    model, certified = certified_for(q.scene, q.k, q.k2)
    question = make("paper_forward", *MESH, *q.scene, *q.motion) if q.motion else model
    drive, materials = scene_drive(question.scene, model.system.M_hand, 1), certified.materials(*q.at)
    run = certified.run(materials, drive, allow=True)
    c, coupled = run.certificate, model.system.two_way and drive.hand is None
    answered, plain = shares(full(question, *q.at), certified, run, coupled)
    if q.refuse:
        refusal = here(lambda: certified.run(materials, drive).certificate.reduction)
        answered = refusal if refusal.refused else answered
    if not answered.refused:
        factor = certified.norms.static_factor(materials)
        answered = replace(answered, text=f"relative bound {c.reduction:.2g}, static factor {factor:.2g}")
    reason = "a bound holds at every step"
    if not c.energy.size:
        answered = Outcome(float(c.energy.largest), "bound of a run without motion")
        return HardCase(q.case, i + 1, answered, plain, 0.0, "nothing moves: no error, and 0, not 0 / 0")
    if q.refuse:
        reason = f"the bound {c.reduction:.2g} is above the tolerance {TOLERANCE:g}"
    return HardCase(q.case, i + 1, answered, plain, None if q.refuse else 1.0, reason)


GREEDY = (
    ("greedy on a grid of one point", 1, 0.05),
    ("greedy, one parameter again and again", 1, 1e-9),
    ("greedy to a tolerance below rounding", 2, 1e-13),
)


def greedy_row(i: int, case: str, grid: int, tolerance: float) -> HardCase:
    """A greedy that has little to choose from, or cannot arrive: it ends, says why, and its bound holds."""
    model = make("paper_forward", *MESH, KV, f"reduction.grid={grid}")
    trainer = Trainer(model)
    try:
        certified = build_certified(trainer, tolerance)
    finally:
        trainer.destroy()
    first, run = model.system.materials[0], certified.run(allow=True)
    text = f"{len(certified.training['rounds'])} rounds, ends by {certified.training['reason']}, "
    proved, plain = shares(full(model, first.lam, first.mu), certified, run, False)
    proved = replace(proved, text=f"{text}bound {run.certificate.reduction:.1g}")
    return HardCase(case, i, proved, plain, 1.0, "a bound holds at every step")


def file_rows(first: int) -> Iterator[HardCase]:
    """Model files that are not what was written, or of another mesh."""
    certified = certified_for((KV,), 12, 36)[1]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "certified.h5"
        save_certified(certified, path)
        other = make("paper_forward", "tissue.cells=[5, 10]")
        with h5py.File(path, "r") as file:
            at = file["certificate/static"].id.get_offset()

        def load(layout: Any) -> int:
            return load_certified(path, layout).k

        def read() -> Outcome:
            with h5py.File(path, "r") as file:
                change = np.linalg.norm(file["certificate/static"][()] - certified.norms.static)
            return Outcome(None, "h5py reads it" + (f", its triangle off by {change:.1g}" if change else ""))

        yield HardCase(
            "a file of another mesh", first, here(load, other.system.layout), textbook(read), None, "another mesh"
        )
        data = bytearray(path.read_bytes())
        data[at + 6] ^= 0x10  # one bit of the exponent of the first entry
        path.write_bytes(data)
        yield HardCase("a bit flipped in a triangle", first + 1, here(load, None), textbook(read), None, "a hash")


def certified_rows(quick: bool) -> Iterator[HardCase]:
    """All questions, then files."""
    for i, q in enumerate(QUESTIONS):
        if not quick or i in (0, 1, 3, 12, 14):
            yield question_row(i, q)
    for i, (case, grid, tolerance) in enumerate(GREEDY[:1] if quick else GREEDY):
        yield greedy_row(len(QUESTIONS) + 1 + i, case, grid, tolerance)
    yield from file_rows(len(QUESTIONS) + len(GREEDY) + 1)


def residual_rows(quick: bool) -> Iterator[HardCase]:
    """Norms of residuals that cancel to a small share of their terms, in natural modes: K phi = omega^2 M phi."""
    model = make("paper_forward", *MESH)
    stiffness, mass = (to_scipy(A).toarray() for A in (model.system.K_ee, model.system.M_ee))
    G = model.system.G
    squares, Phi = scipy.linalg.eigh(stiffness, mass, subset_by_index=[0, 3])
    space = ResidualSpace(model.system, model.system.materials)
    space.extend(np.asfortranarray(Phi))
    norms = space.norms()
    space.destroy()
    C = np.hstack([G, mass @ Phi, stiffness @ Phi])
    gram = C.T @ np.linalg.solve(mass, C)
    T = np.hstack(norms.columns("mass", model.system.materials)[:3])
    length = float(np.sqrt(G[:, 0] @ np.linalg.solve(mass, G[:, 0])))
    scale = float(np.linalg.norm(squares * np.sqrt(np.diag(gram)[2:6])))
    for power in (0, -4, -8) if quick else range(0, -11, -2):
        small = 10.0**power
        c = np.concatenate([[small, 0.0], -squares, np.ones(4)])

        def off(norm: float, exact: float = small * length) -> float:
            return abs(norm / exact - 1)

        norms_of = here(off, float(np.linalg.norm(T @ c))), textbook(off, float(np.sqrt(max(c @ gram @ c, 0.0))))
        part, reason = small * length / scale, "a thousand roundings of its terms"
        yield HardCase(f"{part:.0e} of its terms", part, *norms_of, 1e3 * EPS / part, reason)


FAMILIES = (
    Family("certified", "Reduced models outside their training", "case", "true error / bound",
           "difference of two bases as bound",
           "A proved bound holds where the training says nothing, and refuses what it cannot prove; the difference "
           "of two bases is an estimate, which may be too small.", certified_rows, axis="listed"),
    Family("residual", "Norms of small residuals", "residual / its terms", "relative error of the norm", "Gram matrix",
           "A Gram matrix squares the columns and stalls at 1e-8 of them; a triangle follows the residual down to "
           "rounding [BEOR14].", residual_rows),
)  # fmt: skip
