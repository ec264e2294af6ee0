"""What is measured of hand and tissue, and what disturbs them.

y = C x + noise:  q_s [, v_s], markers q_s + z at nodes of the tissue, and the force T'(K_ee z + D_ee v_z) that the
tissue puts on the hand; D_ee without damping proportional to the mass.
E x' = A x + B u + F w:  F = [0; M_s; 0; 0] unknown acceleration of the hand, [0; 0; 0; p] load on the tissue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.columns import AXES
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.shown import Shown
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a sample; None: not measured."""

    pose: float  # of the hand's displacement [m, rad]
    speed: float | None = None  # of the hand's velocity [m/s, rad/s]
    marker: float = 1e-3  # of a marker's displacement [m]
    force: float | None = None  # of the force on the hand [N, N m]


@dataclass(frozen=True, repr=False)
class Sensors(Shown):
    """Samples of every tick, those of the hand first."""

    C: Block  # samples of the state, transposed, hand (2 n_s, p), local rows (2 n_local, p)
    sd: Array  # standard deviation of a sample [m, rad, m/s, rad/s, N, N m], (p,)
    names: tuple[str, ...]  # of the samples, p
    speed: bool  # whether the velocity of the hand is a sample
    markers: slice  # samples of the markers
    nodes: tuple[tuple[float, ...], ...]  # coordinates of the node of each marker [m], d each

    def of(self, Phi: Array) -> tuple[Array, Array]:
        """Samples of z = Phi and of v_z = Phi, local sums, (p, k) each."""
        _, _, z, v = self.C.parts
        return np.asarray(z.T @ Phi), np.asarray(v.T @ Phi)


@dataclass(frozen=True)
class Disturbance:
    """White noise w that acts on hand and tissue."""

    M_s: Array  # inertia of the hand, its acceleration is disturbed, (n_s, n_s)
    p: Array  # loads on the tissue, local rows (n_local, d)
    W: Array  # intensity of accelerations and loads, diagonal [m2/s3, rad2/s3, N2 s], (n_s + d, n_s + d)

    @property
    def factor(self) -> Block:
        """F W^{1/2}, hand (2 n_s, n_s + d), local rows (2 n_local, n_s + d)."""
        n_s, root = len(self.M_s), np.sqrt(self.W)
        hand = np.zeros((2 * n_s, len(root)))
        hand[n_s:, :n_s] = self.M_s
        loads = np.hstack([np.zeros((len(self.p), n_s)), self.p])
        return Block(hand @ root, np.vstack([np.zeros_like(loads), loads]) @ root)


def make_sensors(problem: RiccatiProblem, markers: list[list[float]], noise: Noise) -> Sensors:
    """Pose, velocity, markers at the free nodes nearest to ``markers`` [m], force. Collective.

    Raises ControlError: a marker lies outside the body, has another number of entries, or two name one node.
    """
    system, layout = problem.system, problem.layout
    n_s, n, d = layout.n_s, layout.n_local, layout.dimension
    hands, z, v, names, sd = [np.eye(2 * n_s, n_s)], [np.zeros((n, n_s))], [np.zeros((n, n_s))], [], [noise.pose] * n_s
    names += [f"q{i + 1}" for i in range(n_s)]
    if noise.speed is not None:
        hands, z, v = [*hands, np.eye(2 * n_s, n_s, -n_s)], [*z, z[0]], [*v, v[0]]
        names, sd = [*names, *(f"v{i + 1}" for i in range(n_s))], [*sd, *[noise.speed] * n_s]
    first, taken = len(names), list[tuple[float, ...]]()
    for i, point in enumerate(markers):
        rigid, column, where = _marker(problem, np.asarray(point, dtype=float), i)
        if where in taken:
            raise ControlError(f"control.observer.markers[{i}] = {point} names the node {list(where)} a second time")
        taken.append(where)
        hands, z, v = [*hands, np.vstack([rigid.T, np.zeros((n_s, d))])], [*z, column], [*v, np.zeros((n, d))]
        names, sd = [*names, *(f"marker{i + 1}_{axis}" for axis in AXES[:d])], [*sd, *[noise.marker] * d]
    last = len(names)
    if noise.force is not None:
        stretch = times_columns(system.K_ee, system.T)
        viscous = system.damping.beta * stretch
        if system.damping.matrix is not None:
            viscous = viscous + times_columns(system.damping.matrix, system.T)
        hands, z, v = [*hands, np.zeros((2 * n_s, n_s))], [*z, stretch], [*v, viscous]
        names, sd = [*names, *(f"f{i + 1}" for i in range(n_s))], [*sd, *[noise.force] * n_s]
    C = Block(np.hstack(hands), np.vstack([np.hstack(z), np.hstack(v)]))
    size = np.array(sd, dtype=np.float64)
    return Sensors(C, size, tuple(names), noise.speed is not None, slice(first, last), tuple(taken))


def _marker(problem: RiccatiProblem, point: Array, i: int) -> tuple[Array, Array, tuple[float, ...]]:
    """Marker i: rows of C for q_s (d, n_s), for z transposed, local (n_local, d), and its node [m]. Collective."""
    layout, d = problem.layout, problem.layout.dimension
    if point.shape != (d,):
        raise ControlError(f"control.observer.markers[{i}] = {point.tolist()} must have {d} entries")
    if not layout.near_body(point):
        raise ControlError(f"control.observer.markers[{i}] = {point.tolist()} lies outside the body; move it there")
    rank, first, where = layout.nearest_node(point)
    owns, column = layout.comm.rank == rank, np.zeros((layout.n_local, d))
    if owns:
        column[first + np.arange(d), np.arange(d)] = 1.0
    rigid = layout.comm.bcast(problem.system.T[first : first + d].copy() if owns else None, root=rank)
    return rigid, column, tuple(where.tolist())


def make_disturbance(problem: RiccatiProblem, hand: float, load: float, box: list[list[float]] | None) -> Disturbance:
    """Accelerations of the hand, and a load spread evenly over the free nodes in a box. Collective.

    Args:
        hand: acceleration along every freedom of the hand [m/s2, rad/s2 per sqrt(Hz)].
        load: along every axis [N per sqrt(Hz)].
        box: [[lo], [hi]] [m]; None: the whole tissue.

    Raises ControlError: the box contains no free node.
    """
    layout = problem.layout
    n_s, d = layout.n_s, layout.dimension
    inside = np.ones(len(layout.nodes), dtype=bool)
    if box is not None:
        slack = 1e-9 * layout.extent  # of a node on the edge of the box
        low, high = np.asarray(box, dtype=float)
        inside = ((layout.nodes >= low - slack) & (layout.nodes <= high + slack)).all(axis=1)
    count = int(total(layout.comm, np.array([float(inside.sum())]))[0])
    if count == 0:
        raise ControlError(f"control.observer.disturbance.box = {box} contains no free node of the body; enlarge it")
    p = np.zeros((layout.n_local, d))
    for axis in range(d):
        p[axis::d, axis] = inside / count
    return Disturbance(problem.M_s, p, np.diag([hand**2] * n_s + [load**2] * d))
