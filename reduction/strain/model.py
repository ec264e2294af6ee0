"""Reduced models of tissue at finite strain, z = Phi a with Phi' M Phi = I, the hand as their input.

    a'' + D a' + dW_r/da = -G (a_s - g) [- alpha G v_s],   D = alpha I + sum_l beta_l K_l (mu K_mu + lambda K_lambda)_l

W_r lives on sampled cells (`cells.py`), is affine in lambda and mu, and is stepped by its own discrete gradient
(`stepper.py`), so that the model keeps its energy |a'|^2 / 2 + W_r. It answers inside what it was trained on: Lamé
constants, accelerations of the hand, and the coordinates that its training runs reached.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial, in_words
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, listed
from softgrasp.reduction.online import ReducedTrajectory, checked_hand
from softgrasp.reduction.strain.cells import Cells, Potential
from softgrasp.reduction.strain.indicator import Finer, estimated_error
from softgrasp.reduction.strain.stepper import StrainProblem, march_strain
from softgrasp.reduction.system import ModelError, Outputs

TOLERANCE = 1e-10  # of a step's residual: the drift of a model's own energy stays near it
SLACK = 1e-9  # of the edges of the box: rounding of the user's own arithmetic
# of accelerations: those of a run are means over its steps h, up to (w h)^2 / 6 below the peak of a motion, hence 1 %
# from 25 steps a period on; another step of the same motion comes closer to the peak than the training did
LOAD_SLACK = 1e-2
REACH, SMALL = 2.0, 0.02  # times what the training runs reached, of coordinates above this share of the largest
LOAD_STEPS, NEWTON_STEPS = 10, 30  # on the way to an equilibrium


@dataclass(frozen=True)
class TrainingDomain:
    """Materials, accelerations of the hand and coordinates for which a model was trained."""

    lam: Array  # least and largest lambda of every layer, (layers, 2) [Pa]
    mu: Array  # least and largest mu of every layer, (layers, 2) [Pa]
    load: Array  # least and largest a_s - g of the hand, by degree of freedom, (n_s, 2) [m/s^2, rad/s^2]
    largest_coordinates: Array  # largest |a_i| of the training runs, (k,)

    def refuse(self, materials: tuple[LayerMaterial, ...]) -> str:
        """Why materials lie outside; empty inside."""
        for i, m in enumerate(materials):
            for key, value, (low, high) in (("lambda", m.lam, self.lam[i]), ("mu", m.mu, self.mu[i])):
                if not low * (1 - SLACK) <= value <= high * (1 + SLACK):
                    return f"{key} = {value:g} Pa of layer {i + 1} is outside the training range [{low:g}, {high:g}] Pa"
        return ""

    def refuse_load(self, load: Array) -> str:
        """Why accelerations a_s - g (steps, n_s) lie outside; empty inside."""
        room = LOAD_SLACK * np.abs(self.load).max(initial=0.0)
        for i, (low, high) in enumerate(self.load):
            least, most = float(load[:, i].min(initial=0.0)), float(load[:, i].max(initial=0.0))
            if least < low - room or most > high + room:
                return (
                    f"the hand's acceleration in degree of freedom {i + 1} spans [{least:.4g}, {most:.4g}], outside "
                    f"the training range [{low:.4g}, {high:.4g}]"
                )
        return ""

    def refuse_states(self, a: Array) -> str:
        """Why coordinates (steps + 1, k) lie outside; empty inside."""
        # what is small beside the largest coordinate cannot spoil a run
        largest = self.largest_coordinates
        ratio = np.abs(a).max(axis=0) / np.maximum(largest, SMALL * largest.max(initial=1e-300))
        i = int(np.argmax(ratio))
        if ratio[i] <= REACH:
            return ""
        return f"the run moves coordinate {i + 1} to {ratio[i]:.2g} times what the training runs reached"


@dataclass(frozen=True, repr=False)
class StrainRun(ReducedTrajectory):
    """A reduced run at finite strain, x = [q_s, v_s, a, a']."""

    small: ReducedStrainSystem = field(repr=False)
    """System at the parameter and time step of the run."""
    acceleration: Array = field(repr=False)
    """Apparent acceleration a_s - g [+ alpha v_s] of the hand at the midpoints [m/s^2, rad/s^2], (steps, n_s)."""
    evaluations: float
    """Mean number of evaluations of the force in a step."""
    restarts: int
    """Number of tangents made anew in the run."""
    engine: str
    """Name of the stepper, "C" or "NumPy"."""
    untrained: str = ""
    """Reason why the run lies outside of the training domain, a sentence; empty inside."""

    @property
    def a(self) -> Array:
        """Coordinates of the displacement, (steps + 1, k)."""
        return coordinates(self)[0]

    @property
    def v(self) -> Array:
        """Their rates, (steps + 1, k)."""
        return coordinates(self)[1]

    @cached_property
    def energy(self) -> Array:
        """|v|^2 / 2 + W_r of every state [J], (steps + 1,)."""
        return np.asarray(self.small.problem.potential.energy(self.a) + (self.v**2).sum(axis=1) / 2)

    @cached_property
    def error_estimate(self) -> float:
        """Estimate, no bound, of |Z - Phi A|_F / |Z|_F against the full run, see `indicator.py`; made at the first use.

        Within a factor of three where ``untrained`` is empty; outside it has come out at an eighth of the error. Not a
        number where the model brings no finer space: one with all cells of the body.
        """
        problem, finer = self.small.finer, self.small.model.finer
        if problem is None or finer is None:
            return float("nan")
        load, weight = -self.acceleration @ finer.G.T, finer.G @ self.small.gravity
        return estimated_error(problem, finer.gram, load, weight, coordinates(self))

    @cached_property
    def energy_drift(self) -> float:
        """Largest |E_n - E_0 - work + loss| over the largest of the four seen, dimensionless."""
        step, problem, load = np.diff(self.a, axis=0), self.small.problem, -self.acceleration @ self.small.model.G.T
        work = np.concatenate([[0.0], np.cumsum(np.einsum("ti,ti->t", step, load))])
        lost = np.cumsum(np.einsum("ti,ij,tj->t", step, problem.D, step, optimize=True)) / problem.dt
        lost = np.concatenate([[0.0], lost])
        defect = np.abs(self.energy - self.energy[0] - work + lost).max()
        scale = max(float(np.abs(x).max()) for x in (self.energy, work, lost))
        return float(defect) / scale if scale > 0 else 0.0


def coordinates(run: ReducedTrajectory) -> tuple[Array, Array]:
    """A and a' of a run at finite strain, (steps + 1, k) each."""
    a, v = np.split(run.x[:, 2 * run.q_s.shape[1] :], 2, axis=1)
    return a, v


@dataclass(frozen=True, repr=False)
class ReducedStrainSystem(Shown):
    """A model at one parameter and one time step, everything made that a run needs."""

    model: StrainModel
    """Reduced model that it was made from."""
    problem: StrainProblem
    """Potential, damping, tangent at rest and time step."""
    materials: tuple[LayerMaterial, ...]
    """Materials of the run, one a layer."""
    gravity: Array
    """Acceleration of free fall [m/s^2], (n_s,)."""
    outside: bool = False
    """Whether runs outside of the training domain are allowed."""

    @cached_property
    def finer(self) -> StrainProblem | None:
        """The problem that answers are checked in, made at the first use; None where the model brings none."""
        finer, dt = self.model.finer, self.problem.dt
        return None if finer is None else strain_problem(finer, self.materials, self.model.alpha, dt)

    def equilibrium(self, q: Array | None = None) -> Array:
        """The a with dW_r/da = G g, by Newton's method under growing load, (k,).

        ``q``: place of the hand (n_s,), which counts where gravity turns with it; None is zero.

        Raises ModelError: there is none within reach, or it is unstable.
        """
        potential, full = self.problem.potential, self.model.G @ self.fall(q)
        a = np.zeros(len(full))
        for share in np.linspace(0, 1, LOAD_STEPS + 1)[1:] if full.any() else ():
            for _ in range(NEWTON_STEPS):
                with np.errstate(invalid="ignore", divide="ignore"):
                    rest = share * full - potential.force(a)
                if np.linalg.norm(rest) <= 1e-12 * np.linalg.norm(full):
                    break
                if not np.isfinite(rest).all():
                    raise ModelError("the reduced body folds on the way to its equilibrium under gravity")
                a = a + np.linalg.solve(potential.tangent(a), rest)
            else:
                raise ModelError("Newton's method found no equilibrium of the reduced body under gravity")
        if full.any() and not np.linalg.eigvalsh(potential.tangent(a))[0] > 0:
            raise ModelError("the equilibrium of the reduced body under gravity is unstable: it buckles")
        return a

    def fall(self, q: Array | None) -> Array:
        """Acceleration of free fall that tissue of a hand at q (n_s,) feels, (n_s,)."""
        return self.gravity

    def run(
        self, hand: tuple[Array, Array], *, a0: Array | None = None, tol: float = TOLERANCE, engine: str = ""
    ) -> StrainRun:
        """Run under a prescribed hand; online, not collective.

        Args:
            hand: q_s and v_s, (steps + 1, n_s) each.
            a0: start at rest, (k,); None is the undeformed body.
            tol: residual of a step over the largest load seen.
            engine: see :func:`softgrasp.reduction.strain.stepper.march_strain`.

        Raises:
            ModelError: shapes do not fit, or the hand or the run leaves the training box.
            SolverError: a step did not converge.
        """
        model, dt = self.model, self.problem.dt
        q, v = checked_hand(hand, model.G.shape[1])
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            raise ModelError("the hand's tables contain numbers that are not finite")
        c = np.diff(v, axis=0) / dt - self.gravity
        untrained = model.box.refuse(self.materials) or model.box.refuse_load(c)
        refuse(untrained, self.outside)
        if model.in_space:
            c = c + model.alpha * (v[1:] + v[:-1]) / 2
        load = -c @ model.G.T
        start = np.zeros(model.k) if a0 is None else a0
        done = march_strain(self.problem, load, start, np.zeros(model.k), tol, engine)
        untrained = untrained or model.box.refuse_states(done.a)
        refuse(untrained, self.outside)
        y = done.a @ model.outputs.C_z.T + q @ model.outputs.C_s.T
        times = dt * np.arange(float(len(q)))
        x = np.hstack([q, v, done.a, done.v])
        counts = done.evaluations, done.restarts, done.engine
        return StrainRun(times, x, q, v, y, model.outputs.names, self, c, *counts, untrained)


def strain_problem(
    space: StrainModel | Finer, materials: tuple[LayerMaterial, ...], alpha: float, dt: float
) -> StrainProblem:
    """Potential, damping and tangent at rest of a space at materials, one a layer."""
    K = [m.mu * a + m.lam * b for m, a, b in zip(materials, space.K_mu, space.K_lambda, strict=True)]
    D = alpha * np.eye(len(space.G)) + sum(m.beta * each for m, each in zip(materials, K, strict=True))
    return StrainProblem(Potential(space.cells, materials), D, sum(K), dt)


def refuse(reason: str, outside: bool) -> None:
    """Raise ModelError where there is a reason, unless what the model was not trained on is allowed."""
    if reason and not outside:
        raise ModelError(f"{reason}; train the model there, or allow it with outside=True and check the result")


@dataclass(frozen=True, repr=False)
class StrainModel(Shown):
    """Reduced model of tissue at finite strain for all lambda and mu of its training box."""

    cells: Cells
    """Sampled cells with their weights, in reduced coordinates."""
    K_mu: Array
    """Linear stiffness of every layer at mu = 1 Pa, lambda = 0, (layers, k, k)."""
    K_lambda: Array
    """Linear stiffness of every layer at lambda = 1 Pa, mu = 0, (layers, k, k)."""
    G: Array
    """Phi' G at the densities of the projection, (k, n_s)."""
    materials: tuple[LayerMaterial, ...]
    """Materials of the projection, one a layer."""
    outputs: Outputs
    """Names and matrices of the outputs y = C_z a + C_s q_s."""
    box: TrainingDomain
    """Materials, coordinates and accelerations of the training."""
    cells_full: int
    """Number of cells of the body."""
    alpha: float = 0.0
    """Mass-proportional damping [1/s]."""
    in_space: bool = False
    """Whether alpha damps the rigid motion too."""
    gravity: Array | None = None
    """Acceleration of free fall [m/s^2], (n_s,), or None."""
    cubature_tolerance: float = 0.0
    """Largest allowed |G x - b| / |b| of the cubature weights x [1]."""
    cubature_residual: float = 0.0
    """Reached |G x - b| / |b| [1]; 0 where no cell is left out."""
    error_galerkin: float = 0.0
    """Relative error in z of the model with all cells, over the training runs [1]."""
    layout: BlockLayout | None = None
    """Distribution of the mesh's rows in Phi, or None."""
    Phi: Array | None = None
    """Reconstruction z = Phi a, local rows (n_local, k), or None."""
    scene_hash: str = ""
    """Hash of the scene it was made for."""
    origin: dict[str, Any] = field(default_factory=dict)
    """Keys of the scene that decide on a run, see `reduction.origin`; {} for none."""
    finer: Finer | None = None
    """Larger space in which the error of a run is estimated; None: without an estimate."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Offline time by stage [s]."""

    def card(self) -> Card:
        """Dimension, cells, materials and outputs."""
        rows = (
            ("dimension", f"N = {self.N}"),
            ("cells", f"{self.cells.count} of {self.cells_full}"),
            ("material", in_words(self.materials)),
            ("outputs", listed(self.outputs.names)),
        )
        return Card("StrainModel, finite strain", rows)

    @property
    def k(self) -> int:
        """Displacements."""
        return len(self.cells.B)

    @property
    def N(self) -> int:
        """Dimension of the first-order model, the hand's 2 n_s included."""
        return 2 * (self.k + int(self.G.shape[1]))

    def at(
        self,
        dt: float,
        materials: tuple[LayerMaterial, ...] | None = None,
        gravity: Array | None = None,
        *,
        outside: bool = False,
    ) -> ReducedStrainSystem:
        """The model at new materials and a time step; online, not collective.

        Args:
            dt: step [s].
            materials: one a layer; None: those of the projection.
            gravity: acceleration of free fall (n_s,) [m/s^2]; None: that of the scene.
            outside: allow what the model was not trained on.

        Raises:
            ModelError: dt is no positive number, or materials outside the training box, of another density, too many.
        """
        if not (np.isfinite(dt) and dt > 0):
            raise ModelError(f"dt = {dt:g} s must be a positive number")
        materials = self.materials if materials is None else materials
        if len(materials) != len(self.materials):
            raise ModelError(f"{len(materials)} materials are given; the model has {len(self.materials)} layers")
        if any(m.rho != old.rho for m, old in zip(materials, self.materials, strict=True)):
            raise ModelError("a model at finite strain keeps the densities it was made with; reduce the scene again")
        refuse(self.box.refuse(materials), outside)
        own = self.gravity if gravity is None else np.asarray(gravity, dtype=float)
        g = np.zeros(self.G.shape[1]) if own is None else own
        return ReducedStrainSystem(self, strain_problem(self, materials, self.alpha, dt), materials, g, outside)

    def leading(self, k: int) -> StrainModel:
        """The model of the first k displacements: bases are nested."""
        return replace(
            self,
            cells=self.cells.leading(k),
            K_mu=self.K_mu[:, :k, :k],
            K_lambda=self.K_lambda[:, :k, :k],
            G=self.G[:k],
            outputs=replace(self.outputs, C_z=self.outputs.C_z[:, :k]),
            box=replace(self.box, largest_coordinates=self.box.largest_coordinates[:k]),
            Phi=None if self.Phi is None else self.Phi[:, :k],
        )

    def finer_space(self, cells: Cells, gram: Array) -> Finer:
        """The columns of this model as the space in which answers of smaller ones are checked, on these cells."""
        return Finer(cells, self.K_mu, self.K_lambda, self.G, gram)

    def displacement(self, a: Array) -> Array:
        """Deformation z = Phi a, local rows (n_local, m), of coordinates (m, k).

        Raises ModelError: the model was loaded without its reconstruction.
        """
        if self.Phi is None:
            raise ModelError("the model has no basis on the mesh; load it with the layout of its mesh")
        return np.asarray(self.Phi @ a.T)
