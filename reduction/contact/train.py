"""Reduced models with contact of N columns, by a rich one that a few motions train.

The rich model has many modes, so that its runs take milliseconds. What moves in them beside the static answers to the
forces is x = a - Lambda^-1 N'mu; V of N columns spans K^-1 G and the directions R that hold most of it,

    minimise over R  sum_runs c |P x|_W^2,   x and SPEED v, each over the norm of a or v in the run,   W = Lambda^(1/2),

with P along K^-1 G. W lies between the mass, in which z is measured, and the stiffness, which forces feel; the rates
bring in the short waves of a landing. Phi of the model is that of the rich one and what V leaves of the rest.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, normalising
from softgrasp.reduction.contact.model import ContactModel, ContactRun, plane
from softgrasp.reduction.contact.motions import Motion, training_motions
from softgrasp.reduction.system import ModelError

# These, and the motions, were chosen on motions from other seeds than that of the errors in docs/guide.
POWER = 0.5  # of the stiffness in W [1]
SPEED = 0.03  # of the rates beside the positions, both over their norms [1]
LANDING = 10.0  # c of motions that only land, whose waves are the fastest and weigh in the forces; of others 1 [1]
DEPENDENT = 1e-13  # least share of a direction of the columns in their Gram matrix, scaled [1]
LEAST = 2  # columns beside those of the hand, at least
NUMBERS = (42, 30, 22)  # columns of models of which no number is given


@dataclass(frozen=True)
class Training:
    """A rich model and its runs."""

    rich: ContactModel
    runs: tuple[tuple[Motion, ContactRun], ...]  # motions of the hand, and what the rich model makes of them
    seconds: float  # time of the runs [s]

    def model(self, N: int) -> ContactModel:
        """The model of the N columns, at most, that these motions need. Collective.

        Raises ModelError: N has no room for the hand and a few more.
        """
        hand = self.rich.G.shape[1]
        if hand + LEAST > N:
            raise ModelError(f"the hand has {hand} columns; N = {N} has no room for {LEAST} more, which are the least")
        begin = time.perf_counter()
        assert self.rich.layout is not None
        comm, Q = self.rich.layout.comm, None
        with raise_on_all_ranks(comm):
            if comm.rank == 0:  # equal on all, whatever their rounding
                Q = self._columns(N)
        small = _narrowed(self.rich, comm.bcast(Q))
        return replace(small, seconds=self.rich.seconds | {"training": self.seconds + time.perf_counter() - begin})

    def _columns(self, N: int) -> Array:
        """V of a model in coordinates of the rich one, orthonormal, with a diagonal stiffness, (rich N, N)."""
        rich = self.rich
        fixed, weight = rich.G / rich.stiffness[:, None], rich.stiffness[:, None] ** (POWER / 2)
        B = np.linalg.qr(weight * fixed / np.linalg.norm(weight * fixed, axis=0))[0]
        P = np.eye(rich.N) - B @ B.T
        needed = np.linalg.eigh(P @ self._gram @ P)[1][:, ::-1][:, : N - fixed.shape[1]] / weight
        X = np.hstack([fixed, needed])
        X /= np.linalg.norm(X, axis=0)
        for share in (DEPENDENT, 0.0):  # twice, for orthonormality to rounding
            X = X @ normalising(X.T @ X, share)
        return np.asarray(X @ np.linalg.eigh(X.T @ (rich.stiffness[:, None] * X))[1])

    @cached_property
    def _gram(self) -> Array:
        """Sum over the runs of c x x', x as above and SPEED v times W^(1/2), each over its norm, (rich N, rich N)."""
        rich, weight = self.rich, self.rich.stiffness[:, None] ** (POWER / 2)
        static, gram = rich.rows()[0].T / rich.stiffness[:, None], np.zeros((rich.N, rich.N))
        for motion, run in self.runs:
            for x, whole, share in ((run.a.T - static @ run.mu.T, run.a.T, 1.0), (run.v.T, run.v.T, SPEED)):
                part, size = weight * x, float(np.linalg.norm(weight * whole)) or 1.0
                gram += _weight(motion) * share**2 * (part @ part.T) / size**2
        return gram


def _weight(motion: Motion) -> float:
    return LANDING if motion.landing else 1.0


def train(rich: ContactModel) -> Training:
    """Runs of a rich model on the motion of its scene and on others like it. Not collective.

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


def _narrowed(rich: ContactModel, Q: Array) -> ContactModel:
    """The rich model on the span of Q, orthonormal and with Q'Lambda Q diagonal. Not collective."""
    stiffness, rows = np.einsum("ij,i,ij->j", Q, rich.stiffness, Q), rich.rows()
    N = rows[0]
    rest = N.T / rich.stiffness[:, None] - Q @ ((N @ Q).T / stiffness[:, None])  # of the answers, beside Q
    old, more = float(np.trace(rows[1])), float((N.T * rest).sum())
    slow = rich.lag * old + float(np.einsum("ij,ik,kj", rest, rich.D, rest))
    return replace(
        rich,
        stiffness=stiffness,
        D=Q.T @ rich.D @ Q,
        G=Q.T @ rich.G,
        C=rich.C @ Q,
        on_surface=rich.on_surface @ Q,
        Phi_on_surface=rich.Phi_on_surface + rich.on_surface @ rest,
        C_Phi=rich.C_Phi + rich.C @ rest,
        lag=slow / (old + more) if old + more > 0 else 0.0,
        V=None if rich.V is None else rich.V @ Q,
        Phi=None if rich.Phi is None or rich.V is None else rich.Phi + rich.V @ rest,
    )
