"""Reduced models with contact of N columns, by a rich one that a few motions train.

The rich model has a row for every node, many modes and answers to a landing, so that its runs take milliseconds. V of
N columns spans K^-1 G, the static responses to the rows, and the directions R that its runs need most beside them,

    minimise over R  sum_runs c |P x|_W^2,   x = a and SPEED v, each over its norm in the run,   W = Lambda^(1/2),

with P along the other columns. W lies between the mass, in which z is measured, and the stiffness, which forces feel;
the rates bring in the short waves of a landing. Rows are hat functions between the nodes whose responses the forces
need, in the same norm. Of several numbers of rows that with the least error on these motions is taken.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.obstacles import Obstacle
from softgrasp.fem.petsc import Array, normalising
from softgrasp.reduction.contact.hats import along, hats_at, nested_places
from softgrasp.reduction.contact.model import ContactModel, ContactRun, plane
from softgrasp.reduction.contact.motions import Motion, training_motions
from softgrasp.reduction.system import ModelError

# These up to FORCE, and the motions, were chosen on motions from other seeds than that of the errors in docs/guide.
POWER = 0.5  # of the stiffness in W [1]
SPEED = 0.03  # of the rates beside the positions, both over their norms [1]
LANDING = 10.0  # c of motions that only land, whose waves are the fastest and weigh in the forces; of others 1 [1]
SHARES = 0.32, 0.56  # least and largest part of the columns without the hand's that hat functions take [1]
TRIED = 8  # numbers of rows, at most
FORCE = 0.1  # of an error of the force beside one of z, in the choice of the rows: 1 % and 0.1 % are asked for [1]
DEPENDENT = 1e-13  # least share of a direction of the columns in their Gram matrix, scaled [1]
LEAST = 4  # columns beside those of the hand and of rows of all nodes, at least
NUMBERS = (42, 30, 22)  # columns of models of which no number is given, in 2D
BESIDE = (20, 14, 5)  # the same in 3D, beside those of the hand and of all nodes within reach


@dataclass(frozen=True)
class Training:
    """A rich model and its runs."""

    rich: ContactModel
    runs: tuple[tuple[Motion, ContactRun], ...]  # motions of the hand, and what the rich model makes of them
    seconds: float  # time of the runs [s]

    @property
    def numbers(self) -> list[int]:
        """Numbers of columns to offer where none are given, the largest first."""
        rich = self.rich
        if rich.X.shape[1] == 2:
            return list(NUMBERS)
        return [rich.G.shape[1] + _directions(rich.obstacles) * len(rich.kept) + more for more in BESIDE]

    def model(self, N: int) -> ContactModel:
        """The model with the least error on these motions, of at most N columns. Collective.

        Raises ModelError: N has no room for the hand, the rows and a few more.
        """
        begin = time.perf_counter()
        assert self.rich.layout is not None
        comm, found = self.rich.layout.comm, None
        with raise_on_all_ranks(comm):
            if comm.rank == 0:  # equal on all, whatever their rounding
                found = self._best(N)
        Q, hats = comm.bcast(found)
        small = _narrowed(self.rich, Q, hats)
        return replace(small, seconds=self.rich.seconds | {"training": self.seconds + time.perf_counter() - begin})

    def _best(self, N: int) -> tuple[Array, tuple[Array, ...]]:
        """V in coordinates of the rich model, and the rows before each half-space. Not collective."""
        rich, numbers = self.rich, _numbers_of_rows(self.rich, N)
        if not numbers:
            return self._columns(N, rich.hats), rich.hats
        faces = self._places(numbers[-1])
        least, best = np.inf, None
        for rows in numbers:
            hats = tuple(hats_at(x, at[:rows]) for x, at in faces)
            Q = self._columns(N, hats)
            error = self._error(_narrowed(replace(rich, V=None), Q, hats), Q, least)
            if best is None or error < least:
                least, best = error, (Q, hats)
        assert best is not None
        return best

    def _places(self, most: int) -> list[tuple[Array, Array]]:
        """Places of the nodes along each half-space, and where hat functions are 1, the best first."""
        rich, result = self.rich, []
        nodes = len(rich.kept)
        for j, (obstacle, rows) in enumerate(zip(rich.obstacles, _rows(rich), strict=True)):
            x, F = along(rich.X[rich.kept], obstacle), np.zeros((nodes, nodes))
            for motion, run in self.runs:
                force = run.row_force[:, j * nodes : (j + 1) * nodes]
                size = float(np.linalg.norm(force @ rows * rich.stiffness ** (POWER / 2 - 1)))
                F += _weight(motion) * (force.T @ force) / (size or 1.0) ** 2
            result.append((x, nested_places(x, rows * rich.stiffness ** (POWER - 2) @ rows.T, F, most)))
        return result

    def _columns(self, N: int, hats: tuple[Array, ...]) -> Array:
        """V of a model in coordinates of the rich one, orthonormal, with a diagonal stiffness, (rich N, N)."""
        rich = self.rich
        responses = [(H @ rows).T for H, rows in zip(hats, _rows(rich), strict=True)]
        normals = [plane(o)[0] for o in rich.obstacles]
        each = [j for j, n in enumerate(normals) if not any(np.array_equal(n, other) for other in normals[:j])]
        fixed = np.hstack([rich.G, *(responses[j] for j in each)]) / rich.stiffness[:, None]
        weight = rich.stiffness[:, None] ** (POWER / 2)
        B = np.linalg.qr(weight * fixed / np.linalg.norm(weight * fixed, axis=0))[0]
        P = np.eye(rich.N) - B @ B.T
        gram = P @ self._gram @ P
        free = max(0, N - fixed.shape[1])
        needed = np.linalg.eigh(gram)[1][:, ::-1][:, :free] / weight
        X = np.hstack([fixed, needed])
        X /= np.linalg.norm(X, axis=0)
        for share in (DEPENDENT, 0.0):  # twice, for orthonormality to rounding
            X = X @ normalising(X.T @ X, share)
        return np.asarray(X @ np.linalg.eigh(X.T @ (rich.stiffness[:, None] * X))[1])

    @cached_property
    def _gram(self) -> Array:
        """Sum over the runs of c x x', x = W^(1/2) a and SPEED W^(1/2) v, each over its norm, (rich N, rich N)."""
        weight, gram = self.rich.stiffness[:, None] ** (POWER / 2), np.zeros((self.rich.N, self.rich.N))
        for motion, run in self.runs:
            for x, share in ((run.a, 1.0), (run.v, SPEED)):
                part = weight * x.T
                gram += _weight(motion) * share**2 * (part @ part.T) / (float(np.linalg.norm(part)) or 1.0) ** 2
        return gram

    def _error(self, small: ContactModel, Q: Array, least: float) -> float:
        """Error on the motions in the mean of squares, inf above ``least`` [1].

        It is of each the larger one of z in the mass norm and of the forces times FORCE.
        """
        total = 0.0
        for motion, run in self.runs:
            try:
                other = small.run(motion.q, motion.v, small.dt)
            except (ModelError, SolverError):
                return np.inf
            worst = 0.0
            for x, y, share in ((other.a @ Q.T, run.a, 1.0), (other.force, run.force, FORCE)):
                size = float(np.linalg.norm(y))
                worst = max(worst, share * float(np.linalg.norm(x - y)) / size if size else 0.0)
            total += worst**2
            if total >= len(self.runs) * least**2:
                return np.inf
        return float(np.sqrt(total / len(self.runs)))


def _weight(motion: Motion) -> float:
    return LANDING if motion.landing else 1.0


def train(rich: ContactModel) -> Training:
    """Runs of a rich model with rows of nodes on the motion of its scene and on others like it. Not collective.

    Raises ModelError: the rich model refuses the motion of the scene.
    """
    begin, runs = time.perf_counter(), []
    for i, motion in enumerate(training_motions(*rich.motion(), rich.dt, plane(rich.obstacles[0])[0])):
        try:
            runs.append((motion, rich.run(motion.q, motion.v, rich.dt)))
        except (ModelError, SolverError):  # another may leave the reach of the rows
            if i == 0:
                raise
    return Training(rich, tuple(runs), time.perf_counter() - begin)


def _directions(obstacles: tuple[Obstacle, ...]) -> int:
    """Number of different normals of half-spaces; equal ones share their responses."""
    return len({tuple(plane(o)[0].tolist()) for o in obstacles})


def _rows(rich: ContactModel) -> list[Array]:
    """N of the nodes before each half-space in coordinates, (nodes, N) each."""
    d = rich.X.shape[1]
    on = rich.on_surface.reshape(-1, d, rich.N)[rich.kept]
    return [np.einsum("i,jik->jk", plane(o)[0], on) for o in rich.obstacles]


def _numbers_of_rows(rich: ContactModel, N: int) -> list[int]:
    """Numbers of hat functions before each half-space that are tried; none in 3D, where each node has a row.

    Raises ModelError: N has no room for them.
    """
    nodes, hand, normals = len(rich.kept), rich.G.shape[1], _directions(rich.obstacles)
    free = N - hand
    if rich.X.shape[1] == 3:
        if free < normals * nodes + LEAST:
            raise ModelError(
                f"the hand has {hand} columns and {nodes} nodes within reach {normals * nodes}; N = {N} has no room "
                f"for {LEAST} more, which are the least"
            )
        return []
    low, high = (int(share * free / normals) for share in SHARES)
    if high < 2:
        raise ModelError(f"the hand has {hand} columns; N = {N} has no room for two rows before an obstacle and others")
    tried = np.linspace(max(2, low), high, TRIED).astype(int)
    return [int(rows) for rows in np.unique(np.minimum(tried, nodes))]


def _narrowed(rich: ContactModel, Q: Array, hats: tuple[Array, ...]) -> ContactModel:
    """The rich model on the span of Q, orthonormal and with Q'Lambda Q diagonal. Not collective."""
    return replace(
        rich,
        stiffness=np.einsum("ij,i,ij->j", Q, rich.stiffness, Q),
        D=Q.T @ rich.D @ Q,
        G=Q.T @ rich.G,
        C=rich.C @ Q,
        on_surface=rich.on_surface @ Q,
        hats=hats,
        V=None if rich.V is None else rich.V @ Q,
    )
