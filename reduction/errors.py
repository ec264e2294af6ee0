"""Errors of reduced models against the full one: states, deformation, energy, and the projection error of their basis.

Every view of a model is linear in Y = [x; q_s; v_s], its state and its hand. With one QR factorisation V = Q R
of the views of the largest model of a family, and snapshots X = Q C + rest,

    |X - V Y|_F^2 = |rest|_F^2 + |C - R Y|_F^2

for every model whose columns lie in the span of Q: no cancellation, and the snapshots are read once for all views and
sizes of a family, and for all families that :func:`prepare` is given together. These have one orthonormal basis J of
all their Q in a view, so that X is multiplied by J alone: with X = J C_J + rest_J and Q = J P,

    C = P' C_J,    |rest|_F^2 = |rest_J|_F^2 + |C_J - P C|_F^2.

Of a run whose snapshots are condensed, X = X_r W' (:mod:`softgrasp.reduction.bases.condense`), the few columns X_r are
read instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.shown import Card, Shown, percent
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.condense import Condensed
from softgrasp.reduction.bases.engines import factor
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.system import EnergySystem, ModelError

BLOCK = 64  # columns at a time: 64 columns of both states are a small part of the snapshots themselves
RANK_TOLERANCE = 1e-13  # of the largest singular value: directions below are rounding of the basis
INSIDE = 1e-9  # share of a column that may lie outside the span: far above rounding, far below any error of a model

View = Literal["velocities", "momenta", "deformation"]
"""State in which errors are measured: [q_s, v_s, q_e, v_e], [q_s, p_s, q_e, p_e] with p_e = M_ee v_z + G v_s and
p_s = M_hand v_s, or [z, v_z] alone."""
VIEWS: tuple[View, ...] = get_args(View)


@dataclass(frozen=True, repr=False)
class ModelErrors(Shown):
    """Relative errors of a reduced run against snapshots of the full one, dimensionless."""

    error: float
    """|X - X_r|_F / |X|_F of X = [q_s, v_s, q_e, v_e] in absolute coordinates: the paper's error [SBRH21]."""
    error_canonical: float
    """|X - X_r|_F / |X|_F of X = [q_s, p_s, q_e, p_e], from which canonical bases are built."""
    error_deformation: float
    """|X - X_r|_F / |X|_F of X = [z, v_z], relative to the rigid motion of the hand."""
    error_energy: float
    """Error max_t |H_r - H| / max_t H of the tissue's energy relative to the hand."""

    def card(self) -> Card:
        """The four in percent, named by what they are errors of."""
        rows = (
            ("displacements and velocities", percent(self.error)),
            ("displacements and momenta", percent(self.error_canonical)),
            ("deformation and its rate", percent(self.error_deformation)),
            ("energy of the tissue", percent(self.error_energy)),
        )
        return Card("Relative errors of a reduced run", rows)


def full_energy(system: BlockSystem, Z: Array) -> Array:
    """(z' K_ee z + v_z' M_ee v_z) / 2 of columns [z; v_z], local rows [J], (m,), on every rank. Collective."""
    halves = ((slice(0, system.layout.n_local), system.K_ee), (slice(system.layout.n_local, None), system.M_ee))
    parts = [
        sum((Z[rows, b] * times_columns(A, Z[rows, b])).sum(axis=0) for rows, A in halves)
        for b in column_blocks(Z.shape[1])
    ]
    return total(system.layout.comm, np.concatenate(parts) / 2)


def state_rows(view: View, system: BlockSystem, z: Array, v_z: Array, q_s: Array, v_s: Array) -> Array:
    """Columns of a view from relative tissue states and the hand: local rows, those of the hand on rank 0. Collective.

    On graded meshes rows count by the diagonal d of the mass, over its mean m: sqrt(d / m) of displacements and
    velocities, sqrt(m / d) of momenta, which makes |X|_F a norm that does not see where nodes crowd [W87].

    ``z``, ``v_z``: local rows (n_local, m); ``q_s``, ``v_s``: (n_s, m), the same on every rank.
    """
    tissue, hand = row_weights(system)
    if view == "deformation":
        return np.vstack([tissue * z, tissue * v_z] if system.graded else [z, v_z])
    T, top = system.T, 1 if system.layout.comm.rank == 0 else 0  # the hand counts once
    if view == "velocities":
        second, p_s = v_z + T @ v_s, v_s
    else:
        second, p_s = times_columns(system.M_ee, v_z) + system.G @ v_s, system.M_hand @ v_s
    count, low = top * len(q_s), hand**2 / tissue if view == "momenta" else tissue
    return np.vstack([hand * q_s[:count], hand * p_s[:count], tissue * (z + T @ q_s), low * second])


def row_weights(system: BlockSystem) -> tuple[Array, float]:
    """Square roots of the diagonal d of the tissue mass (n_local, 1), and of its mean m; 1 on even meshes."""
    if not system.graded:
        return np.ones((1, 1)), 1.0
    diagonal = system.M_ee.getDiagonal().array_r
    whole = total(system.layout.comm, np.array([diagonal.sum(), len(diagonal)]))
    return np.sqrt(diagonal)[:, None], float(np.sqrt(whole[0] / whole[1]))


def shown_rows(view: View, model: ReducedModel, small: EnergySystem, system: BlockSystem) -> Array:
    """V with V Y = the state of the model for Y = [x; q_s; v_s], local rows, (..., N + 2 n_s). Collective.

    Raises ModelError: the model has no basis on the mesh.
    """
    N, n_s = model.N, small.n_s
    width = N + 2 * n_s
    x, q_s, v_s = np.eye(N, width), np.eye(n_s, width, N), np.eye(n_s, width, N + n_s)
    return state_rows(view, system, *model.reconstruct(small, x, v_s), q_s, v_s)


@dataclass(frozen=True)
class Columns:
    """Orthonormal columns of one view, among those of other families."""

    view: View  # state that the rows belong to
    Q: Array  # local rows (rows, k)
    J: Array  # orthonormal columns that span those of all these families, local rows (rows, K); Q itself of one alone
    P: Array | None  # J'Q, (K, k), on every rank; None of one alone


@dataclass(frozen=True)
class Span:
    """Snapshots in the columns of one orthonormal basis, X = Q C + rest."""

    comm: MPI.Intracomm  # ranks of the rows
    columns: Columns  # that basis
    C: Array  # (k, m), on every rank
    rest: float  # |X - Q C|_F^2
    square: float  # |X|_F^2

    @property
    def Q(self) -> Array:
        """Local rows (rows, k)."""
        return self.columns.Q

    def inside(self, V: Array) -> Array:
        """R = Q'V for columns V, local rows, that lie in the span. Collective. Raises ModelError: they do not."""
        R = total(self.comm, self.Q.T @ V)
        lost = total(self.comm, np.array([((V - self.Q @ R) ** 2).sum(axis=0), (V**2).sum(axis=0)]))
        if (lost[0] > INSIDE**2 * lost[1]).any():
            raise ModelError("the model is larger than the one that the errors were prepared for; use the larger one")
        return R

    def error(self, R: Array, Y: Array) -> float:
        """|X - V Y|_F / |X|_F for R from :meth:`inside`."""
        return ratio(self.rest + squares(self.C - R @ Y), self.square)

    def projection_error(self, R: Array) -> float:
        """min_Y |X - V Y|_F / |X|_F; no Gram matrix is formed, so that nearly dependent columns keep their digits."""
        norms = np.linalg.norm(R, axis=0)
        U, s, _ = np.linalg.svd(R / np.where(norms > 0, norms, 1.0), full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
        left = self.C - U @ (U.T @ self.C)
        left -= U @ (U.T @ left)  # what rounding left of the first pass
        return ratio(self.rest + squares(left), self.square)


def columns_of(bases: Sequence[tuple[View, Array]], comm: MPI.Intracomm) -> list[Columns]:
    """Orthonormal columns of several families with one basis J of each view. Collective.

    ``bases``: view and Q of each, local rows.

    Raises SolverError: the factorisation fails.
    """
    made: dict[int, Columns] = {}
    for view in VIEWS:
        every = {i: Q for i, (own, Q) in enumerate(bases) if own == view}
        if len(every) > 1:
            J = factor(comm, np.hstack(list(every.values()))).Q
            made |= {i: Columns(view, Q, J, total(comm, J.T @ Q)) for i, Q in every.items()}
        else:
            made |= {i: Columns(view, Q, Q, None) for i, Q in every.items()}
    return [made[i] for i in range(len(bases))]


def spans_in(bases: Sequence[Columns], system: BlockSystem, snapshots: Snapshots) -> list[Span]:
    """Snapshots in orthonormal columns: the snapshots are read once for all. Collective."""
    comm, n = system.layout.comm, system.layout.n_local
    whole_run: Condensed | None = snapshots.kept.get(Condensed)
    if whole_run is not None:
        snapshots = whole_run.few
    joined = {id(each.J): (each.view, each.J) for each in bases}
    C: dict[int, list[Array]] = {key: [] for key in joined}
    rests, whole = dict.fromkeys(joined, 0.0), {each.view: 0.0 for each in bases}
    for b in column_blocks(snapshots.Z.shape[1]):
        Z, hand = snapshots.Z[:, b], (snapshots.q_s[:, b], snapshots.v_s[:, b])
        seen = {view: state_rows(view, system, Z[:n], Z[n:], *hand) for view in whole}
        for view, X in seen.items():
            whole[view] += squares(X)
        for key, (view, J) in joined.items():
            X = seen[view]
            C[key].append(total(comm, J.T @ X))
            rests[key] += squares(X - J @ C[key][-1])  # rounding leaves eps |X|, far below the error of any model
    left = total(comm, np.array([*whole.values(), *rests.values()])).tolist()
    square = dict(zip(whole, left, strict=False))
    rest = dict(zip(rests, left[len(whole) :], strict=True))
    every = {key: np.hstack(parts) for key, parts in C.items()}
    spans = []
    for each in bases:
        c, lost = every[id(each.J)], rest[id(each.J)]
        if each.P is not None:
            C_J, c = c, each.P.T @ c
            lost += squares(C_J - each.P @ c)
        c = c if whole_run is None else c @ whole_run.W.T
        spans.append(Span(comm, each, c, lost, square[each.view]))
    return spans


@dataclass(frozen=True)
class ModelComparison:
    """Errors of one model, or of a whole family of nested ones, against one full run."""

    model: ReducedModel  # largest model of the family
    small: EnergySystem  # its system at the parameter of the snapshots
    system: BlockSystem  # system of the full run
    snapshots: Snapshots  # snapshots of the full run
    energy: Array | None = None  # :func:`full_energy` of the snapshots; None: made when asked for
    _spans: dict[View, Span] = field(default_factory=dict, repr=False)
    # views of the last model, in the span of each view
    _shown: dict[View, tuple[ReducedModel, Array]] = field(default_factory=dict, repr=False)

    def span(self, view: View) -> Span:
        """Snapshots in the span of the largest model's views; factored at the first call. Collective.

        Raises ModelError: the model has no basis on the mesh.
        """
        prepare([self], [view])
        return self._spans[view]

    def shown(self, view: View, model: ReducedModel, small: EnergySystem) -> Array:
        """R of :meth:`Span.inside` for the views of a model, kept until the next model. Collective.

        Raises ModelError: the model is larger than that.
        """
        known, R = self._shown.get(view, (None, np.zeros((0, 0))))
        if known is not model:
            R = self.span(view).inside(shown_rows(view, model, small, self.system))
            self._shown[view] = model, R
        return R

    def state_error(self, view: View, model: ReducedModel, small: EnergySystem, run: ReducedTrajectory) -> float:
        """|X - X_r|_F / |X|_F of a run on the full model's time grid, of the largest model or a smaller. Collective.

        Raises ModelError: the run is shorter than the snapshots, or the model has more columns than the largest.
        """
        steps = self.snapshots.steps
        if len(run.x) <= int(steps.max(initial=0)):
            raise ModelError(f"the reduced run has {len(run.x) - 1} steps, the snapshots reach step {int(steps.max())}")
        Y = np.vstack([run.x[steps].T, run.q_s[steps].T, run.v_s[steps].T])
        return self.span(view).error(self.shown(view, model, small), Y)

    def errors(self, model: ReducedModel, small: EnergySystem, run: ReducedTrajectory) -> ModelErrors:
        """All errors of a run; see :meth:`state_error`. Collective."""
        prepare([self], VIEWS)
        velocities, momenta, deformation = (self.state_error(view, model, small, run) for view in VIEWS)
        energy = full_energy(self.system, self.snapshots.Z) if self.energy is None else self.energy
        error = np.abs(small.energy(run.x[self.snapshots.steps]) - energy).max(initial=0.0)
        peak = float(energy.max(initial=0.0))
        return ModelErrors(velocities, momenta, deformation, float(error) / (peak if peak > 0 else 1.0))

    def projection_error(self, view: View, model: ReducedModel, small: EnergySystem) -> float:
        """min_Y |X - V Y|_F / |X|_F over all states V y, with the hand q_s = S_q y and v_s = S_v y. Collective.

        Raises ModelError: the model is larger than that.
        """
        return self.span(view).projection_error(self.shown(view, model, small) @ with_hand(small))


def prepare(comparisons: Sequence[ModelComparison], views: Sequence[View]) -> None:
    """Spans of the largest models' views that are not there yet, by one reading of the run that all have. Collective.

    Raises:
        ModelError: a model has no basis on the mesh.
        BasisError: its columns are zero or not finite.
        SolverError: the factorisation fails.
    """
    missing = [(each, view) for each in comparisons for view in views if view not in each._spans]
    if not missing:
        return
    first = comparisons[0]
    comm, bases = first.system.layout.comm, list[tuple[View, Array]]()
    for each, view in missing:
        bases.append((view, factor(comm, shown_rows(view, each.model, each.small, each.system)).Q))
    found = spans_in(columns_of(bases, comm), first.system, first.snapshots)
    for (each, view), span in zip(missing, found, strict=True):
        each._spans[view] = span


def all_at(
    known: Sequence[ModelComparison],
    places: Sequence[EnergySystem],
    system: BlockSystem,
    snapshots: Snapshots,
) -> list[ModelComparison]:
    """The same families against a run that differs in stiffness alone: the spans of their models stay. Collective.

    Args:
        places: systems of their largest models at the parameter of that run.
        system, snapshots: of that run.
    """
    spans: list[dict[View, Span]] = [{} for _ in known]
    every = [(i, span.columns) for i, each in enumerate(known) for span in each._spans.values()]
    found = spans_in([columns for _, columns in every], system, snapshots) if every else []
    for (i, columns), span in zip(every, found, strict=True):
        spans[i][columns.view] = span
    pairs = zip(known, places, spans, strict=True)
    return [ModelComparison(each.model, small, system, snapshots, None, own) for each, small, own in pairs]


def with_hand(small: EnergySystem) -> Array:
    """[I; S_q; S_v]: the hand that belongs to a reduced state, (N + 2 n_s, N)."""
    return np.vstack([np.eye(small.N), small.S_q, small.S_v])


def column_blocks(m: int) -> Iterator[slice]:
    """Slices of at most :data:`BLOCK` columns."""
    for first in range(0, m, BLOCK):
        yield slice(first, min(first + BLOCK, m))


def squares(X: Array) -> float:
    """Sum of all entries squared."""
    return float(np.vdot(X, X))


def ratio(part: float, whole: float) -> float:
    """sqrt(part / whole); of the part alone when the whole is zero."""
    return float(np.sqrt(part / whole if whole > 0 else part))
