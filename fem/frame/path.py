"""A hand that turns on a known path: its mean turn and accelerations in each step, and the wrench that moves it so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from softgrasp.fem.errors import SceneError
from softgrasp.fem.frame.balance import HandPlace
from softgrasp.fem.frame.integrals import Sums, in_space
from softgrasp.fem.frame.rotation import Pose, cayley_vector, cross_matrix, freedoms, spatial
from softgrasp.fem.petsc import Array

LARGEST_TURN = 0.5  # of a hand in a step [rad]: the iteration on the rest would be slow above


@dataclass(frozen=True)
class PathSteps:
    """Motion of a hand on a known path, as loads of the tissue need it; accelerations are means over a step."""

    spins: Array  # angular velocity in the hand's axes at the instants, (steps + 1, 3) [rad/s]
    turns: Array  # angular velocity that turns the axes from start to end of each step, (steps, 3) [rad/s]
    felt: Array  # A - g and Omega' of each step, (steps, n_s) [m/s^2, rad/s^2]
    squared: Array  # (Omega x)^2 of each step, (steps, d, d) [1/s^2]
    mean: Array  # mean velocity of each step in the hand's axes, (steps, n_s) [m/s, rad/s]

    @staticmethod
    def of(q: Array, v: Array, dt: float, g: Array, d: int) -> PathSteps:
        """From [p; theta] and [p'; omega] in space, (steps + 1, n_s) each, and gravity g in space, (3,).

        Raises SceneError: the hand turns too far in a step.
        """
        steps, free = len(q) - 1, freedoms(d)
        places = [HandPlace.of(spatial(a), spatial(b)) for a, b in zip(q, v, strict=True)]
        spins = np.array([place.xi[3:] for place in places])
        turns, felt, squared = np.zeros((steps, 3)), np.zeros((steps, q.shape[1])), np.zeros((steps, d, d))
        mean = np.zeros((steps, q.shape[1]))
        for n, (before, after) in enumerate(pairwise(places)):
            spin = cayley_vector(before.Q.T @ after.Q) / dt
            if not np.linalg.norm(spin) * dt <= LARGEST_TURN:
                raise SceneError(
                    f"the hand turns by {np.linalg.norm(spin) * dt:.2g} rad in step {n + 1}, at most {LARGEST_TURN} is "
                    "possible; use more time.steps"
                )
            W = cross_matrix(spin)
            fall = (np.eye(3) - dt / 2 * W) @ before.Q.T @ (spatial(v[n + 1] - v[n])[:3] / dt - g)
            turns[n], squared[n] = spin, (W @ W)[:d, :d]
            felt[n] = np.concatenate([fall, (spins[n + 1] - spins[n]) / dt])[free]
            mean[n] = np.concatenate([(before.xi[:3] + after.xi[:3]) / 2, spin])[free]
        return PathSteps(spins, turns, felt, squared, mean)


def mean_wrench(masses: tuple[Array, Array, Array], g: Array, dt: float, q: Array, v: Array, rows: Array) -> Array:
    """Mean force and torque about the reference point, in the axes of space, that each step requires, (steps, n_s).

    From the momenta of hand and tissue: f = (QP)' - weight, torque = (QL)' + p' x QP - torque of the weight.

    Args:
        masses: of the hand, of the rigid tissue, and of the hand as far as it has weight, (n_s, n_s) each.
        g: gravity in space, (3,) [m/s2].
        dt: step [s].
        q: [p; theta] in space, (steps + 1, n_s) [m, rad].
        v: [p'; omega] in space, (steps + 1, n_s) [m/s, rad/s].
        rows: numbers of :class:`softgrasp.fem.frame.integrals.Sums` at the steps, over all ranks, (steps + 1, m).
    """
    n_s = q.shape[1]
    hand, rigid, heavy = map(in_space, masses)
    momenta, levers = np.zeros((len(rows), 6)), np.zeros((len(rows), 3))
    for n, row in enumerate(rows):
        place, sums = HandPlace.of(spatial(q[n]), spatial(v[n])), Sums.of(row, n_s)
        momenta[n] = (place.Q @ sums.momenta(hand + rigid, place.xi).reshape(2, 3).T).T.ravel()
        fall = place.Q.T @ g
        levers[n] = place.Q @ (rigid[3:, :3] @ fall + np.cross(sums.first, fall))
    rate, speeds = np.diff(momenta, axis=0) / dt, spatial(v)[:, :3]
    mean, p, lever = ((x[1:] + x[:-1]) / 2 for x in (momenta, speeds, levers))
    force = rate[:, :3] - (rigid + heavy)[:3, :3] @ g
    torque = rate[:, 3:] + np.cross(p, mean[:, :3]) - lever
    return np.asarray(np.hstack([force, torque])[:, freedoms(2 if n_s == 3 else 3)])


def world_outputs(sizes: Sequence[int], d: int, q: Array, linear: Array, z: Array) -> tuple[Array, Array]:
    """Outputs of tissue that moves rigidly with the hand, and of the tissue, in space, (steps + 1, p) [m, rad].

    Args:
        sizes: number of components of each output.
        d: dimension of space.
        q: [p; theta] of the hand, (steps + 1, n_s).
        linear: C_s q_s, the former for small rotations, (steps + 1, p).
        z: displacement against the hand, in its axes, (steps + 1, p).
    """
    pose, rigid, y, at = Pose.of(q, d), linear.copy(), linear.copy(), 0
    for size in sizes:
        part = slice(at, at + size)
        at += size
        if size == d:  # the hand itself has more
            rigid[:, part] = pose.rigid(linear[:, None, part])[:, 0]
            y[:, part] = rigid[:, part] + pose.turned(z[:, None, part])[:, 0]
    return rigid, y
