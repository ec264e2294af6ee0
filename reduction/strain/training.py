"""Training of reduced models at finite strain from full runs: basis, Galerkin's model on all cells, samples, errors.

Basis: cotangent lift (Phi, M Phi) with z = Phi a and Phi' M Phi = I [PM16]. Cells by energy-conserving sampling and
weighting [FCA15]: xi >= 0, most of them zero, with

    |sum_e xi_e g_e - sum_e g_e| <= tau |sum_e g_e|,   g_e = the cell's part of dW_r/da, stacked over training states.

The states are those of the model on all cells, which is what the sampled one is to repeat. tau is half of that model's
own error unless another is given: a smaller one would need more cells without a smaller error. Twice the columns
and cells sampled for them go with every model, to estimate the error of its answers (`indicator.py`).

Errors: everything comes from small products with the snapshots, made once for a basis and all that begin it:
|Z - Phi A|_W^2 = |Z|_W^2 - 2 (Phi'W Z) : A + A : (Phi'W Phi) A, W = I, K_ee or M_ee. Rounding leaves 1e-8 of it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.petsc import Array, PETSc, on_root, times_columns, total
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.shown import Card, Shown, percent
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.bases.inner import Rows, Weight
from softgrasp.reduction.bases.pod import pod_part
from softgrasp.reduction.bases.stack import stack_of
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.errors import column_blocks, ratio
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.operators import Reconstruction, layer_products, symmetric
from softgrasp.reduction.origin import origin_of
from softgrasp.reduction.parameters import thinned
from softgrasp.reduction.projection import project_outputs
from softgrasp.reduction.replay import FullRun, check_scenes
from softgrasp.reduction.strain.cells import Cells, Potential
from softgrasp.reduction.strain.indicator import COLUMNS
from softgrasp.reduction.strain.model import ReducedStrainSystem, StrainModel, StrainRun, TrainingDomain, coordinates
from softgrasp.reduction.strain.nnls import nnls, on_one_rank
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

SNAPSHOTS = 400  # behind a basis, of all runs together
STATES = 80  # of each run behind the weights
ENTRIES = 1 << 26  # of the matrix of their forces, which one rank stores: 512 MB
TAUS = (1e-4, 3e-2)  # least and largest tau chosen from the error of the model on all cells


@dataclass(frozen=True, repr=False)
class StrainErrors(Shown):
    """Relative errors over the snapshots of one full run, or of several, dimensionless."""

    z: float
    """Error |Z - Phi A|_F / |Z|_F of the deformation."""
    v: float
    """Error |V - Phi A'|_M / |V|_M of its velocity."""
    energy_norm: float
    """Error of (z, v) in the norm (z' K_ee z + v' M_ee v)^(1/2), K_ee at rest."""

    def card(self) -> Card:
        """The three in percent."""
        rows = (
            ("deformation", percent(self.z)),
            ("its rate", percent(self.v)),
            ("both, by energy", percent(self.energy_norm)),
        )
        return Card("Relative errors of a reduced run at finite strain", rows)


@dataclass(frozen=True)
class Products:
    """Phi'W Phi (k, k), Phi'W X (k, m) and |X|_W^2 of snapshots X in one product W."""

    gram: Array  # Phi'W Phi, (k, k)
    cross: Array  # Phi'W X, (k, m)
    square: float  # squared norm |X|_W^2

    def missed(self, a: Array) -> float:
        """|X - Phi A'|_W^2 of coordinates (m, k), of the leading ones alone where they are fewer."""
        k = a.shape[1]
        return self.square + float(np.sum(a * (a @ self.gram[:k, :k] - 2 * self.cross[:k].T)))


@dataclass(frozen=True)
class Reference:
    """A full run in terms of a basis."""

    full: FullRun  # the run
    flat: Products  # products of z with I
    stiff: Products  # products of z with K_ee
    mass: Products  # products of v with M_ee, so that its ``gram`` is I
    a: Array  # Phi' M Z, the coordinates of every snapshot, (m, k)

    def missed(self, a: Array, v: Array) -> Array:
        """[missed, whole] squares of z, v and the energy norm for states (steps + 1, k), (3, 2).

        Raises ModelError: the run is shorter than the snapshots.
        """
        steps = self.full.snapshots.steps
        if len(a) <= int(steps.max(initial=0)):
            raise ModelError(f"the reduced run has {len(a) - 1} steps, the snapshots reach step {int(steps.max())}")
        z, stiff, mass = self.flat, self.stiff, self.mass
        v_missed = mass.missed(v[steps])
        return np.array(
            [
                (z.missed(a[steps]), z.square),
                (v_missed, mass.square),
                (stiff.missed(a[steps]) + v_missed, stiff.square + mass.square),
            ]
        )

    def errors(self, a: Array, v: Array) -> StrainErrors:
        """Errors of one run."""
        return pooled_errors([self.missed(a, v)])

    def projection_error(self, k: int) -> float:
        """min_A |Z - Phi A|_F / |Z|_F over the first k columns."""
        cross = self.flat.cross[:k]
        best = np.linalg.solve(self.flat.gram[:k, :k], cross)
        return ratio(max(self.flat.square - float(np.sum(cross * best)), 0.0), self.flat.square)


def pooled_errors(missed: list[Array]) -> StrainErrors:
    """Errors over several runs together, from what :meth:`Reference.missed` gives of each."""
    sums = np.sum(missed, axis=0)
    return StrainErrors(*(ratio(max(float(part), 0.0), float(whole)) for part, whole in sums))


def reference_of(full: FullRun, Phi: Array) -> Reference:
    """Products of the snapshots with local rows Phi (n_local, k). Collective."""
    system, n = full.model.system, full.model.system.layout.n_local
    Z, V = full.snapshots.Z[:n], full.snapshots.Z[n:]
    comm = system.layout.comm
    M_Phi = times_columns(system.M_ee, Phi)

    def products(W_Phi: Array, W: PETSc.Mat, X: Array) -> Products:
        square = sum(float(np.vdot(X[:, b], times_columns(W, X[:, b]))) for b in column_blocks(X.shape[1]))
        return Products(total(comm, Phi.T @ W_Phi), total(comm, W_Phi.T @ X), float(comm.allreduce(square)))

    eye = Products(total(comm, Phi.T @ Phi), total(comm, Phi.T @ Z), float(comm.allreduce(float(np.vdot(Z, Z)))))
    stiff = products(times_columns(system.K_ee, Phi), system.K_ee, Z)
    return Reference(full, eye, stiff, products(M_Phi, system.M_ee, V), total(comm, M_Phi.T @ Z).T)


@dataclass
class Training:
    """Full runs of one scene, at several materials or motions, and what models of every size share."""

    model: Model  # the scene
    runs: tuple[FullRun, ...]  # full runs to train on
    Phi: Array  # largest basis, and as many columns again where the snapshots carry them, local rows (n_local, K)
    cells: Cells  # all cells of this rank
    offset: int  # number of this rank's first cell
    references: tuple[Reference, ...]  # the runs in terms of the basis
    seconds: float = 0.0  # time of the computation of the basis [s]
    _galerkin: dict[int, tuple[StrainRun, ...]] = field(default_factory=dict)
    _spent: dict[int, dict[str, float]] = field(default_factory=dict)

    @cached_property
    def whole(self) -> StrainModel:
        """The largest model on the cells of this rank, every weight 1. Collective."""
        system, Phi = self.model.system, self.Phi
        comm, layout = system.layout.comm, system.layout
        K_mu, K_lambda = (symmetric(layer_products(system, key, Phi, Phi)[0]) for key in ("K_mu", "K_lambda"))
        outputs = project_outputs(self.model.outputs, Reconstruction(layout, Phi, Phi))
        G, K_mu, K_lambda = comm.bcast((total(comm, Phi.T @ system.G), K_mu, K_lambda))
        count = comm.allreduce(int(self.cells.cell.max(initial=-1)) + 1)
        return StrainModel(
            self.cells, K_mu, K_lambda, G, system.materials, outputs, self._box(), count, system.damping.alpha,
            system.damping.in_space, system.gravity, layout=layout, Phi=Phi, scene_hash=self.model.scene_hash,
            origin=origin_of(self.model.scene_keys),
        )  # fmt: skip

    def _box(self) -> TrainingDomain:
        materials = [run.model.system.materials for run in self.runs]
        lam, mu = (np.array([[getattr(m, key) for m in each] for each in materials]) for key in ("lam", "mu"))
        c = [self._felt(run) for run in self.runs]
        least, most = np.min([x.min(axis=0) for x in c], axis=0), np.max([x.max(axis=0) for x in c], axis=0)
        largest = np.max([np.abs(r.a).max(axis=0) for r in self.references], axis=0)
        ends = [np.stack([x.min(axis=0), x.max(axis=0)], axis=1) for x in (lam, mu)]
        load = np.stack([np.minimum(least, 0.0), np.maximum(most, 0.0)], axis=1)
        return TrainingDomain(ends[0], ends[1], load, largest)

    def _felt(self, run: FullRun) -> Array:
        """Accelerations a_s - g of the hand of a run, (steps, n_s)."""
        g = self.model.system.gravity
        return np.asarray(np.diff(run.trajectory.v_s, axis=0) / run.dt - (0.0 if g is None else g))

    def leading(self, k: int) -> StrainModel:
        """The model of k displacements on all cells."""
        whole = self.whole
        if not 0 < k <= whole.k:
            raise ReductionError(f"k = {k} must lie between 1 and the {whole.k} columns of the basis")
        return whole.leading(k)

    def galerkin(self, k: int) -> tuple[StrainRun, ...]:
        """All training runs of the model on all cells; made once for each k. Collective.

        Raises SolverError: a run did not converge.
        """
        if k not in self._galerkin:
            with self._stage(k, "galerkin"):
                model = self.leading(k)
                self._galerkin[k] = tuple(self._run(model, run) for run in self.runs)
        return self._galerkin[k]

    def _run(self, model: StrainModel, run: FullRun) -> StrainRun:
        comm, materials = self.model.system.layout.comm, run.model.system.materials
        small = model.at(run.dt, materials, outside=True)
        if comm.size > 1:
            shared = Potential(model.cells, materials, comm)
            small = replace(small, problem=replace(small.problem, potential=shared))
        return _replay(small, run)

    def galerkin_error(self, k: int) -> float:
        """Error in z of :meth:`galerkin` over all training runs. Collective."""
        pairs = zip(self.references, self.galerkin(k), strict=True)
        return pooled_errors([reference.missed(run.a, run.v) for reference, run in pairs]).z

    def reduce(self, N: int, tau: float | None = None) -> StrainModel:
        """A model of dimension N on sampled cells. Collective; the weights are found on one rank.

        Args:
            N: the hand's 2 n_s and two for each displacement.
            tau: of the weights; None: half of the Galerkin error, within 1e-4 and 3e-2.

        Raises:
            ReductionError: N does not fit, or no weights reach tau.
            SolverError: a run did not converge.
        """
        (model,) = self.family(N, [tau])
        return model

    def family(self, N: int, taus: Sequence[float | None]) -> list[StrainModel]:
        """Models of one dimension at several tau; the forces are gathered once. Collective."""
        k = displacements(self.model.system, N)
        error, all_cells = self.galerkin_error(k), self.leading(k)
        K, goal = min(COLUMNS * k, self.whole.k), float(np.clip(error / 2, *TAUS))
        with self._stage(k, "forces"):
            G = self._forces(k, K)
        with self._stage(k, "estimate"):
            further, gram = self.leading(K), self.references[0].flat.gram[:K, :K]
            ((cells, _),) = self._sampled(further.cells, G.reshape(-1, G.shape[2]), [goal])
            finer = further.finer_space(cells, gram)
        goals, models = [goal if tau is None else tau for tau in taus], []
        with self._stage(k, "weights"):
            done = self._sampled(all_cells.cells, G[:, :k].reshape(-1, G.shape[2]), goals)
        for goal, (cells, residual) in zip(goals, done, strict=True):
            seconds = {"basis": self.seconds, **self._spent[k]}
            models.append(replace(
                all_cells, cells=cells, cubature_tolerance=goal, cubature_residual=residual, error_galerkin=error,
                finer=finer, seconds=seconds,
            ))  # fmt: skip
        return models

    def _sampled(self, cells: Cells, G: Array, taus: Sequence[float]) -> list[tuple[Cells, float]]:
        """For each tau the sampled cells of the body, and the residual of their weights. Collective."""
        comm = self.model.system.layout.comm
        (C, c), counts, answers = on_one_rank(comm, G), comm.allgather(G.shape[1]), []
        for tau in taus:
            weights = on_root(comm, partial(nnls, C, c, tau))
            xi = weights.x[sum(counts[: comm.rank]) :][: counts[comm.rank]]
            answers.append((gathered(comm, cells.sampled(xi), self.offset), weights.residual))
        return answers

    def _forces(self, k: int, K: int) -> Array:
        """Every cell's part of dW/da in K columns at the training states of k, (states, K, cells of this rank)."""
        cells = self.cells.leading(K)
        count = int(cells.cell.max(initial=-1)) + 1
        states = int(np.clip(ENTRIES // (K * self.whole.cells_full * len(self.runs)), 20, STATES))
        rows = []
        for run, done in zip(self.runs, self.galerkin(k), strict=True):
            potential = Potential(cells, run.model.system.materials)
            chosen = done.a[np.unique(np.linspace(1, len(done.a) - 1, states).round().astype(int))]
            for a in np.pad(chosen, [(0, 0), (0, K - k)]):
                each = np.einsum("aijq,ijq->aq", cells.B, potential.weighted_stress(a), optimize=True)
                rows.append(np.stack([np.bincount(cells.cell, row, count) for row in each]))
        return np.stack(rows)

    @contextmanager
    def _stage(self, k: int, key: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        spent = self.model.system.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX)
        self._spent.setdefault(k, {})[key] = spent


def displacements(system: BlockSystem, N: int) -> int:
    """Number k of a model of dimension N = 2 n_s + 2 k. Raises ReductionError: there is none."""
    hand = 2 * system.layout.n_s
    if hand + 2 > N or N % 2:
        raise ReductionError(f"N = {N} does not fit; it must be the {hand} columns of the hand plus an even number")
    return (N - hand) // 2


def basis_of(system: BlockSystem, runs: Sequence[Snapshots], k: int) -> Array:
    """Phi' M Phi = I: POD of z, of one run with v too, in the mass product. Collective.

    Local rows of k columns and of as many again as the snapshots carry, up to :data:`COLUMNS` k. Both weigh the same:
    the velocities of one run contain shapes that its displacements pass too fast; several runs have these shapes, and
    their velocities would only crowd out the soft ones.

    Raises BasisError: the snapshots carry fewer columns, or are zero or not finite.
    """
    layout, n = system.layout, system.layout.n_local
    parts = [thinned(run, -(-SNAPSHOTS // len(runs))).Z for run in runs]
    X = np.asfortranarray(np.hstack([Z[:n] for Z in parts]))
    if len(parts) == 1:
        V = np.asfortranarray(parts[0][n:])
        q, p = (float(layout.comm.allreduce(np.vdot(Y, times_columns(system.M_ee, Y)))) for Y in (X, V))
        X = np.asfortranarray(np.hstack([X, V * (q / p) ** 0.5 if p > 0 else V]))
    rows, mass = Rows(layout, hand=False), Weight(system.M_hand, system.M_ee)
    none = np.zeros((layout.n_s, X.shape[1]))
    part = pod_part("deformation", {0: stack_of({}, "deformation", rows, none, lambda: X, mass, "tsqr")})
    if k > part.rank:
        most = 2 * (layout.n_s + part.rank)
        raise BasisError(f"more displacements than the snapshots carry above rounding; request N <= {most}", most=most)
    (columns,) = part.columns(min(COLUMNS * k, part.rank))
    return columns.e_q


def train(model: Model, runs: Sequence[FullRun], N: int) -> Training:
    """Basis for models up to dimension N, the hand's 2 n_s included, and all cells in its coordinates. Collective.

    Raises:
        ReductionError: the scene has no finite strain, or the snapshots carry fewer columns.
    """
    system, points = model.system, model.system.points
    if points is None:
        raise ReductionError("the scene has no effects.finite_strain; softgrasp.reduce makes its linear models")
    if model.system.energy is not None:
        raise ReductionError(
            f"reduced models at finite strain know the built-in laws, not the energy {model.system.energy.law.name}; "
            "set effects.finite_strain=false for a linear one of its tangent"
        )
    fulls = tuple(runs)
    if not fulls:
        raise ReductionError("there is no full run to train on; give at least one")
    begin = time.perf_counter()
    Phi = basis_of(system, [run.snapshots for run in fulls], displacements(system, N))
    seconds = float(system.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX))
    d = points.d
    B = times_columns(points.B, Phi).reshape(d, d, -1, Phi.shape[1]).transpose(3, 0, 1, 2)
    mesh = model.space.mesh.mesh
    offset = int(mesh.topology.index_map(d).local_range[0])
    numbers = points.cell - offset
    centres = mesh.geometry.x[cell_nodes(mesh), :d].mean(axis=1)
    ones, B = np.ones(len(points.vol)), np.ascontiguousarray(B)
    cells = Cells(points.laws.name, B, points.vol, ones, points.layer, numbers, centres[numbers])
    return Training(model, fulls, Phi, cells, offset, tuple(reference_of(run, Phi) for run in fulls), seconds)


def replay_strain(rom: StrainModel, full: FullRun, model: Model | None = None, *, outside: bool = False) -> StrainRun:
    """Under the hand of a full run, see :func:`softgrasp.reduction.reduce.replay`. Collective.

    ``model``: a scene that is to fit beside that of the run, or None.
    """
    check_scenes(rom.origin, "finite strain", model or full.model, full)
    return _replay(rom.at(full.dt, full.model.system.materials, outside=outside), full)


def _replay(small: ReducedStrainSystem, full: FullRun) -> StrainRun:
    a0 = small.equilibrium(full.hand[0][0]) if full.model.scene.time.start == "equilibrium" else None
    return small.run(full.hand, a0=a0)


def errors_strain(rom: StrainModel, reduced_run: ReducedTrajectory, full: FullRun) -> StrainErrors:
    """Errors of deformation, velocity, energy norm, see :func:`softgrasp.reduction.reduce.errors`. Collective."""
    if rom.Phi is None:
        raise ModelError("the model has no basis on the mesh; load it with the layout of its mesh")
    return reference_of(full, rom.Phi).errors(*coordinates(reduced_run))


def gathered(comm: MPI.Intracomm, cells: Cells, offset: int) -> Cells:
    """The cells of all ranks, numbered over the body, on every rank. Collective."""
    parts = comm.allgather(replace(cells, cell=cells.cell + offset))
    rows = {
        key: np.concatenate([getattr(p, key) for p in parts]) for key in ("weight", "xi", "layer", "cell", "centre")
    }
    B = np.ascontiguousarray(np.concatenate([p.B for p in parts], axis=-1))
    return Cells(cells.law, B, **rows)
