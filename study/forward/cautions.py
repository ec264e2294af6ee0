"""Warnings about a scene, which `explain` gives before a run, and about its result, which `simulate` gives after it."""

from __future__ import annotations

import numpy as np

from softgrasp.fem import (
    ITERATIVE,
    SMALL_SHARE,
    BlockSystem,
    Model,
    Trajectory,
    linear_error,
    motion_table,
    percent,
    spread,
)
from softgrasp.fem.model.scales import SMALL_STRAIN, gradient, magnified, slowest
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.obstacles import Obstacle, obstacle_names

STIFF = 0.45  # P1 displacements lock from there on: the error grows like 1 / (1 - 2 nu) = lambda / mu + 1 [BS92]
LOCKING = 0.49  # where `effects` measures it
COARSE_STEP = 0.05  # dt / T_1: the midpoint rule lengthens a period by (omega dt)^2 / 12, here 0.8 %
SMALL_ANGLE = 0.1  # [rad]: a linearised rotation stretches by angle^2 / 2, here 0.5 %
EXACT = 1e-9  # a well conditioned direct solve leaves a drift of 1e-16 to 1e-12 and a residual below 1e-13
ITERATED = 1e-3  # residual of an iterated step, or estimated error of all, up to which nothing is said
LOOKED_AT = 25  # stored instants that strain and frequency are taken from,
LARGEST = 4_000_000  # fewer where they would be more numbers than this: their products need as much again
OVERSHOOT = 2.0  # largest response of an undamped mode to a sudden load, over the static one


def poisson_ratios(system: BlockSystem) -> dict[str, float]:
    """Poisson's ratio of each material by the name of its layer [1]."""
    names = [blocks.name for blocks in system.layers]
    pairs = zip(names, system.materials, strict=True)
    return {n: young_poisson(m.lam, m.mu)[1] for n, m in pairs if not m.part}


def locking(poisson: dict[str, float], order: int) -> list[str]:
    """P1 elements in a material that hardly changes its volume."""
    return [
        f"nu = {_near_half(nu)} of {name} is {STIFF} or more: P1 locks, its error grows with lambda / mu = "
        f"{2 * nu / (1 - 2 * nu):.3g}; use tissue.order = 2, on half the cells along each edge for as many unknowns."
        for name, nu in poisson.items()
        if nu > STIFF - 1e-9 and order == 1
    ]


def coarse(omega: float, dt: float, end: float, period: str) -> list[str]:
    """A step dt [s] too long for a period 2 pi / omega; the period in words."""
    share = omega * dt / (2 * np.pi)
    if not share > COARSE_STEP:
        return []
    steps = int(np.ceil(end * omega / (2 * np.pi * COARSE_STEP)))
    return [f"dt is {share:.2g} of {period}, coarse in time even for that: use at least {steps} steps."]


def turned(angle: float) -> list[str]:
    """A hand angle [rad] too large for the linearised rotation."""
    if angle <= SMALL_ANGLE:
        return []
    return [
        f"An angle of {angle:.3g} rad is not small: the linearised rotation stretches by {percent(angle**2 / 2)}; "
        "set effects.frame = 'hand', which allows any angle."
    ]


def small_obstacles(model: Model, finer: float = 1.0, order: int | None = None) -> list[str]:
    """Obstacles that contact can miss between two boundary nodes. Collective.

    ``finer``: edges of the cells over those of the model;
    ``order``: of the elements on these cells; None: that of the model.
    """
    if not model.scene.effects.obstacles:
        return []
    from softgrasp.fem.model.surface import node_distance  # only scenes with contact pay for it
    from softgrasp.fem.obstacles import make_obstacles
    from softgrasp.fem.obstacles.spacing import edge_parts

    layout, entries = model.system.layout, model.scene.obstacle or []
    order = order or layout.order
    longest = finer * node_distance(model.space) * layout.order
    parts = edge_parts(entries, order, layout.dimension)
    divided = 1 if parts is None else int(parts(np.array([longest]))[0])
    between, what = longest / max(divided, order), "nodes" if divided == 1 else "points"
    more = "" if any(entry.friction for entry in entries) else ", or more obstacle.parts"
    return _nodes_alone(entries, order, layout.dimension, longest) + [
        f"Obstacle '{o.name}' is {size:.2g} m {'in radius' if o.kind in ('disc', 'ball') else 'thick'}, less than the "
        f"{between:.2g} m between boundary {what}: only {what} touch, so it can sink in between two; use "
        f"smaller cells{more}."
        for o in make_obstacles(model.scene, layout.dimension)
        if (size := o.shape.size()) < between * (1 - 1e-9)  # edges of equal cells differ by rounding
    ]


def _nodes_alone(entries: list[Obstacle], order: int, d: int, longest: float) -> list[str]:
    """Points between nodes that would touch, on edges of this length [m], if no obstacle had friction."""
    from softgrasp.fem.obstacles.spacing import edge_parts

    rough = [name for name, entry in zip(obstacle_names(entries), entries, strict=True) if entry.friction]
    smooth = [entry.model_copy(update={"friction": 0.0}) for entry in entries]
    if not rough or (parts := edge_parts(smooth, order, d)) is None:
        return []
    if (count := int(parts(np.array([longest]))[0])) == 1:
        return []
    other = "smaller cells or tissue.order = 1 or 3" if d == 3 and order == 2 else "smaller cells"
    return [
        f"Obstacle '{rough[0]}' has friction, which acts on nodes alone, so only nodes touch, at all obstacles of the "
        f"scene; without friction points that divide each edge in {count} would touch too. Use {other}."
    ]


def out_of_reach(model: Model, strain: float, length: float) -> list[str]:
    """Obstacles that a body which moves with the hand stays clear of by more than it deforms. Collective.

    The gap is that of the points that can touch, at some instants of a prescribed motion. The deformation is estimated
    as `OVERSHOOT` times ``strain``, the static rms gradient under the largest load [1], times ``length`` [m].
    """
    scene, system = model.scene, model.system
    if not scene.effects.obstacles or scene.motion.drive == "force":
        return []
    from softgrasp.fem.obstacles import make_obstacles  # only scenes with contact pay for it
    from softgrasp.fem.run.contact.expected import nearest_gaps
    from softgrasp.fem.run.contact.general import contact_surface

    surface, q = contact_surface(model), motion_table(scene, system.layout.n_s).q
    obstacles = make_obstacles(scene, system.layout.dimension)
    gap = float(nearest_gaps(surface, obstacles, q, scene.time_end / scene.time.steps).min())
    margin = OVERSHOOT * strain * length
    if gap <= margin:
        return []
    return [
        f"On the path of the hand the undeformed body stays {gap:.2g} m from every obstacle, and its deformation is "
        f"estimated at {margin:.2g} m at most: nothing should touch; set effects.obstacles = false and drop "
        "[[obstacle]]."
    ]


def inexact(
    drift: float, residual: float, solver: str, nu: float, rounding: float = 0.0, solves: float = 0.0
) -> list[str]:
    """Drift of the energy, residual or error of solves or loss to rounding, as the digits they leave; all are relative.

    The drift is of energy that nothing explains; ``rounding`` is of :func:`magnified`, ``solves`` the solve_error of a
    trajectory.
    """
    iterated = solver in ITERATIVE
    early = {"residual": residual, "estimated error of the solves": solves}
    shares = {
        **{name: 0.0 if iterated and share <= ITERATED else share for name, share in early.items()},
        "energy drift": drift,
        "rounding of K": rounding,
    }
    name = max(shares, key=lambda key: shares[key])
    worst = shares[name]
    if not worst > EXACT:
        return []
    if iterated and name in early:
        reason = f"time.rtol lets {solver} stop there; a smaller one brings more"
    elif nu > 0.4999:
        reason = f"nu = {_near_half(nu)} makes the matrix of a step nearly singular, which magnifies rounding"
    else:
        reason = "the matrix of a step is badly conditioned (materials, cells or masses of very different size)"
    digits = max(int(-np.log10(worst)), 0)
    left = f"only about {digits} digit{'' if digits == 1 else 's'}" if digits else "no digit"
    return [f"{name} {worst:.1e}: the numbers carry {left}, because {reason}."]


def looked_at(n_e: int) -> int:
    """Stored instants that the warnings of a run are computed from, with n_e unknowns of the tissue."""
    return int(np.clip(LARGEST // n_e, 4, LOOKED_AT))


def run_warnings(model: Model, run: Trajectory, most: tuple[float, Array] | None = None) -> list[str]:
    """What the result of a run warns of, without an eigenvalue problem. Collective.

    Strain is that of the largest of at most `LOOKED_AT` stored displacements, the last one and ``most``; the period is
    that of :func:`slowest`, which needs snapshots in memory.

    ``most``: time [s] and local rows (n_local,) [m] of a large displacement that was seen on the way.
    """
    scene, system, d = model.scene, model.system, model.space.mesh.dimension
    poisson = poisson_ratios(system)
    Z, times = _instants(run, system)
    texts = [*locking(poisson, scene.tissue.order), *small_obstacles(model)]
    omega = slowest(system, Z)
    if omega > 0:
        period = f"the slowest period of the tissue in this run ({2 * np.pi / omega:.3g} s)"
        texts += coarse(omega, float(run.times[1]), float(run.times[-1]), period)
    sizes = total(system.layout.comm, np.einsum("ij,ij->j", Z, Z))
    z, t = Z[:, int(np.argmax(sizes))], times[int(np.argmax(sizes))]
    if most is not None and total(system.layout.comm, np.array([np.dot(most[1], most[1])]))[0] > sizes.max():
        t, z = most
    steep = None if system.points is not None else gradient(model, z)
    if steep is not None and not steep.linear:
        texts.append(
            f"The gradient of the displacement against the hand is above {SMALL_STRAIN} in {percent(steep.share)} of "
            f"the body at t = {t:.3g} s, and at most {steep.typical:.2g} in {percent(1 - SMALL_SHARE)} of it: linear "
            "elasticity assumes small strains and rotations, with an error of about "
            f"{percent(linear_error(steep.rms, d))} of the deformation here"
            + (
                "."
                if scene.effects.rotation and system.frame is None
                else "; set effects.finite_strain.law = 'neo-hooke'."
            )
        )
    if system.frame is None:
        texts += turned(float(np.abs(run.q_s[:, d:]).max(initial=0.0)))
    return texts + inexact(
        run.energy_drift,
        max(run.residuals),
        run.solver[0],
        max(poisson.values()),
        magnified(system, z),
        run.solve_error,
    )


def _near_half(nu: float) -> str:
    return f"{nu:.4g}" if nu < 0.4999 else f"0.5 - {0.5 - nu:.1e}"


def _instants(run: Trajectory, system: BlockSystem) -> tuple[Array, list[float]]:
    """Displacements against the hand, local rows (n_local, k) [m], and their times [s]."""
    n = system.layout.n_local
    if run.snapshots is None:
        return run.final[:n, None], [float(run.times[-1])]
    columns = spread(len(run.snapshots.times), looked_at(system.layout.n_e)).tolist()
    times = [*run.snapshots.times[columns].tolist(), float(run.times[-1])]
    return np.column_stack([run.snapshots.Z[:n, columns], run.final[:n]]), times
