"""Hard cases of contact: thin, squeezing, fast and equal obstacles, corners, bounces, nearly incompressible tissue."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import scipy.sparse.linalg

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.surface import make_surface
from softgrasp.fem.obstacles import make_obstacles
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.contact.record import Tables
from softgrasp.fem.run.simulate import simulate
from tests.hardcases.cases import Family, HardCase, here, make, textbook

SIZE = 2.0  # of the body [m]
BODY = ("tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "control=false",
        "effects.obstacles=true", "effects.damping={kind='kelvin-voigt', beta=0.002}")  # fmt: skip
RUN = ("time.steps=200", "time.end=1.0")
TABLE = "{kind='halfspace', normal=[0, 1], offset=-0.03}"
STIFF = 20.0  # of the textbook's springs over Young's modulus [m]: stiffer ones blow up
FALL = 0.3  # energy by which the body falls 3 cm [J]
BOUND = 1e-12
REASON = (
    "rounding: a gap is met to 64 units of the coordinates, 1.4e-14 of the size, and the balance sums some units of "
    "the largest energy a step"
)


def ours(model: Model, bounces: int = 1) -> float:
    """The largest of depth over size, open balance, and energy that a step's first touch or impulses and friction gave.

    Raises SolverError, SceneError: the case is refused. The run must have so many landings.
    """
    taken, add = [0.0], Tables.add

    def watched(table: Tables) -> None:
        taken[0] = min(taken[0], table.energy[1], table.energy[2] + table.energy[3])
        add(table)

    with patch.object(Tables, "add", watched):
        run = simulate(model)
    contact = run.contact
    assert contact is not None
    pressed = contact.touching.sum(axis=1) > 0
    landings = int((pressed[1:] & ~pressed[:-1]).sum()) + int(pressed[0])
    assert landings >= bounces, landings
    scale = max(contact.touch + contact.stopped, FALL)
    return max(contact.penetration / SIZE, run.energy_drift, -taken[0] / scale)


def springs(model: Model) -> float:
    """Largest depth over size where springs hold the nodes back, evaluated at the start of each midpoint step."""
    system, scene = model.system, model.scene
    M, K = to_scipy(system.M_ee).tocsc(), to_scipy(system.K_ee).tocsc()
    surface, obstacles = make_surface(model.space, system), make_obstacles(scene, 2)
    dt = scene.time_end / scene.time.steps
    s, beta = 2 / dt, 0.0 if scene.effects.damping is None else scene.effects.damping.beta
    solve = scipy.sparse.linalg.factorized(K + s * beta * K + s**2 * M)
    load, k = system.G @ system.fall, STIFF * scene.tissue.material.young
    z, v, deepest = np.zeros(len(load)), np.zeros(len(load)), 0.0
    for n in range(scene.time.steps):
        x, force = surface.X + z[surface.rows].reshape(-1, 2), np.zeros_like(surface.X)
        for obstacle in obstacles:
            gap, normal = obstacle.look(x, n * dt)
            deepest = max(deepest, -float(gap.min()))
            force += k * np.maximum(-gap, 0.0)[:, None] * normal
        rhs = s * (M @ v) - K @ z + load
        rhs[surface.rows] += force.ravel()
        w = solve(rhs)
        z, v = z + 2 * w, 2 * s * w - v
    return deepest / SIZE


def box(x: float, y: float, width: float, height: float, path: str = "") -> str:
    """A box by its lowest corner, with a path if it is given."""
    motion = f", path={{{path}}}" if path else ""
    return f"{{kind='box', lo=[{x}, {y}], hi=[{x + width}, {y + height}]{motion}}}"


def jaws(speed: float) -> str:
    """Two blocks beside the body that close with a speed."""
    left, right = (box(x, -0.5, 2.0, 1.5, f"velocity=[{v}, 0]") for x, v in ((-2.01, speed), (1.01, -speed)))
    return f"{left}, {right}"


def fast(speed: float, edge: float = 1.0) -> str:
    """A plate that rises against the body."""
    return box(-1.0, -edge - 0.2, 3.0, edge, f"velocity=[0, {speed}]")


CASES: tuple[tuple[str, str, tuple[str, ...], bool], ...] = (
    ("plate of a fifth of a cell", box(-1, -0.1, 3, 0.05), (), True),
    ("plate of a fifth of a cell, 20 steps", box(-1, -0.1, 3, 0.05), ("time.steps=20",), True),
    ("jaws that squeeze by a tenth", jaws(0.06), (), True),
    ("jaws that close on each other", jaws(0.6), (), False),
    ("corner of a box under one node", box(0.3, -2.02, 2, 2), (), True),
    ("valley of two planes under a corner", "{kind='halfspace', normal=[1, 1], offset=-0.02}, "
     "{kind='halfspace', normal=[-1, 1], offset=-0.73}", (), True),
    ("plate that hits at 4 m/s", fast(4.0), ("time.end=0.06",), True),
    ("thin plate that hits at 100 m/s", fast(100.0, 0.05), ("time.steps=20", "time.end=0.06"), False),
    ("start 1e-3 inside", "{kind='halfspace', normal=[0, 1], offset=0.002}", (), False),
    ("start that touches", "{kind='halfspace', normal=[0, 1], offset=0}", (), True),
    ("nu = 0.499, P2", TABLE, ("tissue.order=2", "tissue.material={young=125.0, poisson=0.499, rho=1.0}"), True),
    ("three equal tables", f"{TABLE}, {TABLE}, {TABLE}", (), True),
    ("two discs on the same node", "{kind='disc', center=[0.4, -0.53], radius=0.5}, "
     "{kind='disc', center=[0.6, -0.53], radius=0.5}", (), True),
    ("friction of 100 on a slope", "{kind='halfspace', normal=[0.3, 1], offset=-0.03, friction=100.0}", (), True),
    ("finite strain, block falls on a corner", "{kind='halfspace', normal=[0.3, 1], offset=-0.03}",
     ("effects.finite_strain={}",), True),
    ("three equal tables with friction", ", ".join([TABLE.replace("}", ", friction=0.3}")] * 3), (), True),
    ("slit 0.1 narrower on each side", f"{box(-2, -1.03, 2.1, 1)}, {box(0.9, -1.03, 2, 1)}", (), True),
    ("table that drops away", "{kind='halfspace', normal=[0, 1], offset=-0.01, path={velocity=[0, -0.2]}}",
     ("time.start='equilibrium'",), True),
    ("free hand of 1e-6 of the body's mass", TABLE,
     ("effects.reaction=true", "hand={mass=2e-6}", "motion={profile='hold', drive='force'}",
      "effects.gravity={g=[0, -5], hand_weight=true}"), True),
    ("layers of stiffness 1e4 apart", TABLE,
     ("tissue.layers={stiff={box=[[0, 0], [1, 0.5]], material={young=1.25e6, poisson=0.3, rho=1.0}}}",), True),
    ("nu = 0.4999, P2", TABLE, ("tissue.order=2", "tissue.material={young=125.0, poisson=0.4999, rho=1.0}"), True),
    ("1e5 steps, undamped", TABLE, ("time.steps=100000", "time.end=100.0", "effects.damping=false"), True),
    ("steps of Courant number 10", TABLE, ("time.steps=20", "time.end=4.0"), True),
    ("steps of Courant number 0.01", TABLE, ("time.steps=5000",), True),
)  # fmt: skip
SLOW = ("steps of Courant number 0.01", "1e5 steps, undamped")
PERIOD = 0.1  # of the vibrating table [s]
NO_ROOM = "no state of the body fits, or a step is too long to see the obstacle"


def vibrating(folder: Path, bounces: int) -> tuple[str, ...]:
    """A table that goes up and down below a light body and hits it so many times in a run, by its csv file."""
    end, periods = PERIOD * bounces, bounces
    t = end * np.arange(2 * periods + 1) / (2 * periods)
    file = folder / "table.csv"
    file.write_text("\n".join(["t,x,y", *(f"{x:.17g},0,{0.01 * (i % 2)}" for i, x in enumerate(t.tolist()))]))
    table = f"{{kind='halfspace', normal=[0, 1], offset=-0.005, path={{csv='{file}'}}}}"
    return (
        "tissue.cells=[1, 3]",
        "effects.gravity={g=[0, -1]}",
        f"time={{steps={12 * bounces}, end={end}}}",
        f"obstacle=[{table}]",
    )


def contact_rows(quick: bool) -> Iterator[HardCase]:
    """Runs that meet obstacles which leave little room, or little time."""
    for number, (name, obstacles, changes, solved) in enumerate(CASES):
        if quick and name in SLOW:
            continue
        scene = (*BODY, *RUN, f"obstacle=[{obstacles}]", *changes)
        model = make("paper_forward", *scene)
        bound, reason = (BOUND, REASON) if solved else (None, NO_ROOM)
        yield HardCase(name, number + 1.0, here(ours, model), textbook(springs, model), bound, reason)
    bounces = 50 if quick else 10_000
    with tempfile.TemporaryDirectory() as folder:
        model = make("paper_forward", *BODY, *vibrating(Path(folder), bounces))
        balance, soft = here(ours, model, bounces - 1), textbook(springs, model)
        (file := Path(folder) / "broken.csv").write_text("t,x,y\n0,0,0\n0.5,0,nan\n1,0,0.1\n")
        model = make("paper_forward", *BODY, *RUN, f"obstacle=[{TABLE[:-1]}, path={{csv='{file}'}}}}]")
        refused, passed = here(ours, model), textbook(springs, model)
    yield HardCase(f"{bounces} bounces", len(CASES) + 1.0, balance, soft, BOUND, REASON)
    yield HardCase("path that is not a number", len(CASES) + 2.0, refused, passed, None, "a place must be a number")


FAMILIES = (
    Family("contact", "Contact with obstacles", "case", "largest of depth over size and open balance", "springs",
           "Springs at the nodes let the body in by more than a thousandth of its size or feed it energy until it is "
           "not finite, and go on where there is no room. Here no node is in an obstacle at the end of a step, the "
           "balance closes to rounding, and a sentence says when a step is too long.",
           contact_rows, axis="listed"),
)  # fmt: skip
