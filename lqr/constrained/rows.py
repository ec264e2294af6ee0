"""Rows G c <= h of a plan: gaps of every node at every instant, limits of force, speed and jumps, and the tail.

A node may leave the chord between two instants a distance delta apart by delta^2/8 max n.y''. In a held interval mode m
swings about its static answer with the energy E_m, which falls, so that with zeta = eta + g a / omega^2

    n.y_j'' <= n.a + sum_m |n.S_jm| (omega_m + 2 delta_m) sqrt(2 E_m),    2 E_m = zeta_m'^2 + omega_m^2 zeta_m^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.horizon import HeldPlant, Horizon


@dataclass(frozen=True)
class Limits:
    """Bounds of the hand; None for none."""

    force: Array | None = None  # on |u_i| [N], (n_s,)
    speed: float | None = None  # on |v_i| along the axes [m/s]
    jump: float | None = None  # on |u_i| from interval to interval [N]


def gap_rows(horizon: Horizon, start: Array, normals: Array, free: Array) -> tuple[Array, Array]:
    """n_k.(displacement of node j) >= -free at all instants of interval k.

    Args:
        start: x_0, (N,).
        normals: unit normal of each interval, (H, d).
        free: how far each node may move against the normal from its place at the target, (H, parts + 1, nodes).

    Returns rows and right-hand side, (H (parts + 1) nodes, n_s H) and (H (parts + 1) nodes,).
    """
    F, G = horizon.instants
    Y = np.einsum("kd,jdn->kjn", normals, horizon.plant.Y)
    moved = np.einsum("kjn,kin->kij", Y, F @ start)
    rows = -(Y[:, None] @ G)
    return rows.reshape(-1, rows.shape[-1]), (moved + free).reshape(-1)


def limit_rows(horizon: Horizon, start: Array, limits: Limits, u_bar: Array) -> tuple[Array, Array]:
    """|u| <= force, |v| <= speed at the ends of the intervals, between which it is linear, and |u_k - u_{k-1}| <= jump.

    ``u_bar``: steady input, which acts before the first interval [N], (n_s,).
    """
    (F, G), (U, V), n_s = horizon.states, horizon.inputs, horizon.plant.n_s
    parts: list[tuple[Array, Array, Array, Array]] = []  # rows, their value without c, lower and upper bounds
    if limits.force is not None:
        parts.append((V, U @ start, -limits.force - u_bar, limits.force - u_bar))
    if limits.speed is not None:
        v, most = speeds(horizon.plant), np.full(horizon.plant.Y.shape[1], limits.speed)
        parts.append((G[1:, v], F[1:, v] @ start, -most, most))
    if limits.jump is not None:
        most = np.full(n_s, limits.jump)
        parts.append((np.diff(V, axis=0, prepend=0.0), np.diff(U @ start, axis=0, prepend=0.0), -most, most))
    if not parts:
        return np.zeros((0, V.shape[2])), np.zeros(0)
    rows = [sign * row.reshape(-1, V.shape[2]) for row, *_ in parts for sign in (1, -1)]
    right = [side.reshape(-1) for _, value, low, high in parts for side in (high - value, value - low)]
    return np.vstack(rows), np.concatenate(right)


def swings(plant: HeldPlant) -> tuple[Array, Array]:
    """T and W with 2 E_m = |T_m x + W_m u|^2 in a held interval: (k, 2, N) and (k, 2, n_s)."""
    tissue, n_s, k = plant.tissue, plant.n_s, len(plant.tissue.omega)
    T, W = np.zeros((k, 2, plant.N)), np.zeros((k, 2, n_s))
    modes = np.arange(k)
    T[modes, 0, 2 * n_s + modes] = tissue.omega
    T[modes, 1, 2 * n_s + k + modes] = 1.0
    W[:, 0] = -plant.B[2 * n_s + k :] / tissue.omega[:, None]
    return T, W


def bends(plant: HeldPlant, states: Array, inputs: Array, normals: Array, turns: Array | float = 0.0) -> Array:
    """Bound on what a node goes below the chord between two instants, (H, parts, nodes) [m].

    ``states``: at all instants, (H, parts + 1, N); ``inputs``: (H, n_s); ``normals``: (H, d); ``turns``: bound on the
    acceleration of the obstacle along them, (H, parts) [m/s2].
    """
    T, W = swings(plant)
    moving = np.einsum("men,kin->kime", T, states[:, :-1]) + np.einsum("mes,ks->kme", W, inputs)[:, None]
    seen = np.abs(np.einsum("kd,jdm->kjm", normals, plant.tissue.seen))
    tissue = np.einsum("kjm,kim->kij", seen, np.linalg.norm(moving, axis=-1) * _pace(plant))
    M_inv = plant.B[plant.n_s : 2 * plant.n_s]
    if plant.tissue.rigid is None:
        along = np.einsum("kd,ks,ds->k", normals, inputs, M_inv)[:, None]
    else:
        along = np.einsum("kd,ks,es,jde->kj", normals, inputs, M_inv, plant.tissue.rigid, optimize=True)
    rigid = along[:, None, :] + np.asarray(turns)[..., None]
    return np.asarray((plant.grid / plant.parts) ** 2 / 8 * np.maximum(tissue + rigid, 0.0))


def _pace(plant: HeldPlant) -> Array:
    """The sum omega + 2 delta of every mode [1/s]."""
    return np.asarray(plant.tissue.omega + 2 * plant.tissue.delta)


def both_ends(bend: Array) -> Array:
    """What the two instants of every part must keep for it, (H, parts + 1, nodes)."""
    padded = np.pad(bend, ((0, 0), (1, 1), (0, 0)))
    return np.asarray(np.maximum(padded[:, 1:], padded[:, :-1]))


def tail_level(
    plant: HeldPlant,
    gaps: list[tuple[Array, Array]],
    limits: Limits,
    u_bar: Array,
    arms: Array | float = 0.0,
    angle: Array | None = None,
) -> float:
    """alpha: from every x with x'P x <= alpha the loop u = K x keeps all gaps and limits for ever.

    x'P x falls, so that |r x| <= sqrt(x'P x) |r P^{-1/2}| for every row r: at all instants of all later intervals, and
    for the bends between them.

    Args:
        gaps: normal (d,) and free way of every node against it at the target, (nodes,), of each obstacle.
        u_bar: steady input [N], (n_s,).
        arms: |r_j| of every node of a hand that turns, (nodes,) [m].
        angle: of this hand at the target, (n_s - d,) [rad].

    Negative where the target itself violates a gap or a limit.
    """
    n_s, M_inv = plant.n_s, plant.B[plant.n_s : 2 * plant.n_s]
    root = np.linalg.inv(np.linalg.cholesky(plant.P)).T  # P^{-1} = root root'
    T, W = swings(plant)
    flows = np.stack([A + B @ plant.K for A, B in plant.held]) @ root
    swing = np.einsum("men,inr->imer", T, flows[:-1]) + np.einsum("mes,sr->mer", W, plant.K @ root)
    size = np.linalg.norm(swing, ord=2, axis=(-2, -1)) * _pace(plant)  # (parts, modes)
    most: list[Array] = []
    room: list[Array] = []
    # |r| ((theta_bar + t s)^2 - theta_bar^2) / 2 = |r| theta_bar t s + |r| t^2 s^2 / 2 for s = sqrt(x'P x)
    t, theta, squares = 0.0, 0.0, list[Array]()
    if angle is not None:
        d = plant.Y.shape[1]
        t = float(np.linalg.norm(root[d:n_s], 2))
        t += (plant.grid / plant.parts) ** 2 / 8 * float(np.linalg.norm(M_inv[d:] @ plant.K @ root, 2))
        theta = float(np.linalg.norm(angle))
    for normal, free in gaps:
        rows = np.linalg.norm(np.einsum("d,jdn,inr->ijr", normal, plant.Y, flows), axis=-1)
        seen = np.abs(np.einsum("d,jdm->jm", normal, plant.tissue.seen))
        bend = np.einsum("jm,im->ij", seen, size) + _size_along(plant, normal, M_inv @ plant.K @ root)
        bend = (plant.grid / plant.parts) ** 2 / 8 * bend
        most.append((rows + both_ends(bend[None])[0] + arms * theta * t).ravel())
        squares.append(np.broadcast_to(arms * t**2 / 2, rows.shape).ravel())
        room.append(np.broadcast_to(free, rows.shape).ravel())
    if limits.force is not None:
        most.append(np.linalg.norm(plant.K @ root, axis=1))
        room.append(limits.force - np.abs(u_bar))
    if limits.speed is not None:
        most.append(np.linalg.norm(root[speeds(plant)], axis=1))
        room.append(np.full(plant.Y.shape[1], limits.speed))
    if limits.jump is not None:
        most.append(np.linalg.norm(plant.K @ (plant.closed - np.eye(plant.N)) @ root, axis=1))
        room.append(np.full(n_s, limits.jump))
    if not most:
        return np.inf
    all_room, all_most = np.concatenate(room), np.concatenate(most)
    curve = np.concatenate([*squares, np.zeros(len(all_most) - sum(map(len, squares)))])
    # the least s with most s + curve s^2 = room
    bent = 1 + 4 * curve * np.maximum(all_room, 0.0) / all_most**2
    least = float((2 * all_room / all_most / (1 + np.sqrt(bent))).min())
    return float(np.sign(least) * least**2)


def _size_along(plant: HeldPlant, normal: Array, accelerations: Array) -> Array:
    """Norm of n.R_j a for every node, or once for all; a (n_s, r)."""
    if plant.tissue.rigid is None:
        return np.asarray(np.linalg.norm(normal @ accelerations))
    return np.asarray(np.linalg.norm(np.einsum("d,jds->js", normal, plant.tissue.rigid) @ accelerations, axis=1))


def speeds(plant: HeldPlant) -> slice:
    """Velocities of the hand along the axes in a state."""
    return slice(plant.n_s, plant.n_s + plant.Y.shape[1])


def turned(plant: HeldPlant, states: Array, inputs: Array, arms: Array, angle: Array) -> Array:
    """|r_j| theta^2 / 2, a bound on the distance of nodes from their places by small angles, (H, parts + 1, nodes) [m].

    Args:
        states: at all instants, (H, parts + 1, N); ``inputs``: (H, n_s).
        arms: |r_j| of every node, (nodes,) [m].
        angle: of the hand at the target, (n_s - d,) [rad].
    """
    n_s, d = plant.n_s, plant.Y.shape[1]
    theta = np.linalg.norm(states[..., d:n_s] + angle, axis=-1)
    leaves = (plant.grid / plant.parts) ** 2 / 8 * np.linalg.norm(inputs @ plant.B[n_s + d : 2 * n_s].T, axis=1)
    theta = np.maximum(theta[:, 1:], theta[:, :-1]) + leaves[:, None]
    return both_ends(theta[:, :, None] ** 2 / 2 * arms)


def follow(plant: HeldPlant, x: Array, level: float, most: int) -> tuple[Array, Array]:
    """States and inputs under u = K x until x'P x <= ``level``, or for ``most`` intervals.

    Returns the states at all instants, (T, parts + 1, N), and the inputs, (T, n_s).
    """
    flows = np.stack([A + B @ plant.K for A, B in plant.held])
    states: list[Array] = []
    while not x @ plant.P @ x <= level and len(states) < most:
        states.append(flows @ x)
        x = states[-1][-1]
    every = np.array(states).reshape(-1, plant.parts + 1, plant.N)
    return every, every[:, 0] @ plant.K.T


def broken(plant: HeldPlant, states: Array, inputs: Array, limits: Limits, u_bar: Array) -> Array:
    """Intervals whose inputs, last speed or jump from the one before exceed the limits, beyond rounding; (H,)."""
    slack = 1 + 1e-9  # rounding of a plan that keeps its rows with equality
    result = np.zeros(len(inputs), dtype=bool)
    if limits.force is not None:
        result |= (np.abs(inputs + u_bar) > slack * limits.force).any(axis=1)
    if limits.speed is not None:
        result |= (np.abs(states[:, -1, speeds(plant)]) > slack * limits.speed).any(axis=1)
    if limits.jump is not None:
        result |= (np.abs(np.diff(inputs, axis=0, prepend=0.0)) > slack * limits.jump).any(axis=1)
    return result
