"""A block held by a hand: reduced tissue on a body of MuJoCo beside MuJoCo's own flex bodies."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

from benchmarks import driver
from benchmarks.driver import Goal
from softgrasp.fem.accuracy.adapt import build
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.reduction.bridges import MujocoTissue, mujoco_body
from softgrasp.reduction.reduce import reduce
from softgrasp.reduction.turning.model import TurningModel

SIZE, GRIP = (0.05, 0.05, 0.1), 0.075  # [m]; two sides are held above
YOUNG, DENSITY, BETA = 2e5, 1080.0, 0.005  # [Pa], [kg/m^3], [s]
GRAVITY = (0.0, -9.81, 0.0)  # across the block [m/s^2]
POISSON = (0.3, 0.45, 0.49)
POINTS = [list(p) for p in itertools.product((0.0, 0.05), (0.0, 0.05), (0.0, 0.05))]  # nodes of all meshes [m]
END, STEPS, MOVE, WAY = 0.72, 720, 0.4, 0.2  # of the full run [s], of the move [s], [m]
FREE = 1.0  # [s] of free vibration
HEAVY = 1e6  # of a hand that goes where it is driven [kg]
SLIDES = "".join(f'<joint type="slide" axis="{a}" armature="{HEAVY:g}"/>' for a in ("1 0 0", "0 1 0", "0 0 1"))
DOFS = {
    "flex, tetrahedra": 'dof="full"',
    "flex, trilinear": 'dof="trilinear" cellcount="{} {} {}"',
    "flex, quadratic": 'dof="quadratic" cellcount="{} {} {}"',
}
LABEL = "reduced"
GRIDS = ((3, 3, 5), (5, 5, 9), (9, 9, 17))  # nodes of the flex bodies
MANY = 1000  # nodes of a grid that is run at the longest step alone
DTS, SETTLE, TO_KEEP = (4e-3, 2e-3, 1e-3), 4e-3, 1e-3  # [s]
BALANCED = 1e-2  # share of the weight
MARKS = "osD"
MOTIONS = {"method": "method", "unknowns": "unknowns", "step [ms]": "dt 3", "error [%]": "error 3",
           "processor time of a step [µs]": "step 3", "simulated / processor time": "speed 3"}  # fmt: skip
MATERIALS = {"method": "method", "unknowns": "unknowns"}
MATERIALS |= {f"error of the sag, ν = {nu} [%]": f"sag.{round(100 * nu)} 3" for nu in POISSON}
MATERIALS |= {"energy left [%]": "kept 3"}
HELP = f"""Reduced tissue in MuJoCo beside MuJoCo's flex bodies: error, time of a step, sag, energy.

A block is held at two sides, sags across and is carried {WAY:g} m in {MOVE:g} s. Its deformation at eight nodes is
compared with that of the full model on a fine mesh at 1 ms, each method at its own step: largest
distance over the largest deformation. Flex bodies have MuJoCo's integrator "discrete" and stand in the frame of the
hand, where its acceleration is gravity: this is exact, and cheaper than a flex on a body that moves. The reduced
model is on a hand with three slides, Python included. Sag: at rest at three Poisson's ratios. Energy: what is left
of the largest kinetic energy after {FREE:g} s of undamped vibration at 1 ms. Times are of the processor."""


@dataclass(frozen=True)
class Motion:
    """One method at one step."""

    method: str  # name
    unknowns: int  # of the deformation
    dt: float  # step [ms]
    error: float  # of the deformation over its largest [%]
    step: float  # processor time of a step [us]
    speed: float  # simulated over processor time


@dataclass(frozen=True)
class Material:
    """One method at rest and in free vibration."""

    method: str  # name
    unknowns: int  # of the deformation
    sag: dict[str, float]  # error by Poisson's ratio in percent [%]; NaN: it did not come to rest
    kept: float  # kinetic energy after the vibration over the first [%]


@dataclass(frozen=True)
class Results:
    """What one run of the benchmark found."""

    motions: list[Motion]  # rows of the move
    materials: list[Material]  # rows of rest and vibration


def block(nu: float, cells: Sequence[int], reduced: bool, steps: int, beta: float = BETA, start: str = "rest") -> Model:
    """The block on a mesh of quadratic tetrahedra."""
    effects: dict[str, Any] = {"gravity": {"g": list(GRAVITY)}, "reaction": reduced, "rotation": reduced}
    effects |= {"damping": {"kind": "kelvin-voigt", "beta": beta} if beta else False}
    effects |= {"frame": "hand"} if reduced else {}
    outputs = [{"kind": "node", "point": p, "name": f"p{i}"} for i, p in enumerate(POINTS)]
    material = {"young": YOUNG, "poisson": nu, "rho": DENSITY}

    def edit(table: dict[str, Any]) -> None:
        table["tissue"] |= {"cells": list(cells), "order": 2, "material": material}
        table |= {
            "effects": effects,
            "output": {"snapshots": "memory" if reduced else "none"},
            "control": {"outputs": outputs},
        }
        table["motion"] = {"target": [WAY, 0.0, 0.0, *([0.0] * 3 if reduced else [])], "duration": MOVE}
        table["time"] = {"steps": steps, "end": END if steps > 2 else 0.01, "start": start}

    return build(load_scene(shipped_scenes()["turn_over_3d"]).changed(edit), comm=MPI.COMM_SELF)


def reference(cells: Sequence[int], steps: int = STEPS) -> tuple[Array, Array]:
    """Velocity of the hand (steps + 1, 3) and displacements of the points against it (steps + 1, 24) of a full run."""
    run = simulate(block(POISSON[0], cells, False, steps))
    return run.v_s, run.outputs - run.outputs_rigid


def reduced_model(cells: Sequence[int], nu: float, N: int = 36, beta: float = BETA) -> TurningModel:
    """Clamped modes of the block."""
    model = block(nu, cells, True, 2, beta)
    rom = reduce(model, simulate(model), "craig_bampton", N=N)
    assert isinstance(rom, TurningModel)
    return rom


def at_rest(cells: Sequence[int], nu: float) -> Array:
    """Displacements of the points under gravity, (24,) [m]."""
    run = simulate(block(nu, cells, False, 2, start="equilibrium"))
    return np.asarray((run.outputs - run.outputs_rigid)[0])


class Flex:
    """A flex body, whose hand stands: its acceleration is gravity."""

    def __init__(self, method: str, counts: Sequence[int], nu: float, h: float, beta: float = BETA) -> None:
        import mujoco

        self.method, self.mujoco = method, mujoco
        mujoco.set_mju_user_warning(lambda text: None)  # counted in the data, and not written into a file
        spacing = [s / (n - 1) for s, n in zip(SIZE, counts, strict=True)]
        held = itertools.product((0, counts[0] - 1), range(counts[1]), range(counts[2]))
        pins = " ".join(f"{i} {j} {k}" for i, j, k in held if k * spacing[2] >= GRIP - 1e-9)
        each = 2 if "quadratic" in method else 1
        attributes = DOFS[method].format(*[(n - 1) // each for n in counts])
        texts = {"count": counts, "spacing": spacing, "pos": [s / 2 for s in SIZE]}
        numbers = " ".join(f'{key}="{" ".join(map(str, value))}"' for key, value in texts.items())
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{h}" integrator="discrete"/><size memory="1G"/><worldbody><body name="hand">'
            f'<flexcomp name="block" type="grid" dim="3" mass="{DENSITY * np.prod(SIZE)}" radius="0.0005" {numbers} '
            f'{attributes}><contact selfcollide="none" contype="0" conaffinity="0"/><pin grid="{pins}"/>'
            f'<elasticity young="{YOUNG}" poisson="{nu}" damping="{beta}"/></flexcomp></body></worldbody></mujoco>'
        )
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.start = self.data.flexvert_xpos.copy()
        self.points = [int(np.argmin(np.linalg.norm(self.start - p, axis=1))) for p in POINTS]
        assert np.abs(self.start[self.points] - POINTS).max() < 1e-9  # nodes of this grid
        self.unknowns = int(self.model.nv)

    @property
    def displacement(self) -> Array:
        """Of the points, (24,) [m]."""
        return np.asarray((self.data.flexvert_xpos - self.start)[self.points].ravel())

    def kinetic(self) -> float:
        """Energy of motion [J]."""
        self.mujoco.mj_energyVel(self.model, self.data)
        return float(self.data.energy[1])

    def step(self, acceleration: Array) -> None:
        """One step of a hand with this acceleration."""
        self.model.opt.gravity[:] = np.array(GRAVITY) - acceleration
        self.mujoco.mj_step(self.model, self.data)

    def rest(self) -> Array:
        """Displacements of the points at rest under gravity; NaN where implicit steps do not end in balance."""
        for _ in range(200):
            self.step(np.zeros(3))
            if np.abs(self.data.qvel).max() < 1e-5 and self._out_of_balance() < BALANCED:
                return self.displacement
        return self.displacement * np.nan

    def _out_of_balance(self) -> float:
        """Force that is left over the weight."""
        return float(np.linalg.norm(self.data.qfrc_smooth) / np.linalg.norm(self.data.qfrc_bias))


class Reduced:
    """Modes on a hand with three slides."""

    def __init__(self, rom: TurningModel, h: float) -> None:
        import mujoco

        self.method, self.unknowns = LABEL, rom.k
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{h}" gravity="{" ".join(map(str, GRAVITY))}" integrator="Euler"/><worldbody>'
            f"{mujoco_body(rom, joint=SLIDES)}</worldbody></mujoco>"
        )
        self.data, self.tissue = mujoco.MjData(self.model), MujocoTissue(rom, self.model, dt=h)
        self.C = rom.outputs.C_z

    @property
    def displacement(self) -> Array:
        """Of the points, (24,) [m]."""
        return np.asarray(self.C @ self.tissue.a)

    def kinetic(self) -> float:
        """Energy of motion against the hand [J]."""
        return float(self.tissue.e @ self.tissue.small.M @ self.tissue.e) / 2

    def step(self, acceleration: Array) -> None:
        """One step of a hand with this acceleration."""
        self.data.qfrc_applied[:] = HEAVY * acceleration
        self.tissue.step(self.data)

    def rest(self) -> Array:
        """Displacements of the points at rest under gravity."""
        self.tissue.settle(self.data)
        return self.displacement


def motion(body: Flex | Reduced, h: float, hand: Array, exact: Array) -> Motion:
    """Follow the hand, and compare at every step."""
    every = round(h * (len(hand) - 1) / END)
    v, found = hand[::every], [body.displacement]
    seconds = 0.0
    for acceleration in np.diff(v, axis=0) / h:
        begin = time.process_time()
        body.step(acceleration)
        seconds += time.process_time() - begin
        found.append(body.displacement)
    far = np.linalg.norm(np.array(found) - exact[::every], axis=1).max()
    step = seconds / (len(v) - 1)
    error = 100 * far / np.linalg.norm(exact, axis=1).max()
    return Motion(body.method, body.unknowns, 1e3 * h, float(error), 1e6 * step, h / step)


def kept(body: Flex | Reduced, h: float) -> float:
    """Largest kinetic energy in the last half second over that in the first, of a block let go undeformed [%]."""
    energies = []
    for _ in range(round(FREE / h)):
        body.step(np.zeros(3))
        energies.append(body.kinetic())
    half = round(0.5 / h)
    return 100 * max(energies[-half:]) / max(energies[:half])


def methods(grids: Sequence[tuple[int, ...]]) -> list[tuple[str, tuple[int, ...]]]:
    """Every flex method on every grid."""
    return [(method, counts) for method in DOFS for counts in grids]


def measure(cells: Sequence[int], fine: Sequence[int], grids: Sequence[tuple[int, ...]], console: Any) -> Results:
    """All rows."""
    hand, exact = reference(fine)
    motions, materials = [], []
    models = {nu: reduced_model(cells, nu) for nu in POISSON}
    free = reduced_model(cells, POISSON[0], beta=0.0)
    for N in (24, 36, 72):
        model = models[POISSON[0]] if N == 36 else reduced_model(cells, POISSON[0], N)
        motions += [motion(Reduced(model, h), h, hand, exact) for h in DTS]
    exact_rest = {nu: at_rest(fine, nu) for nu in POISSON}

    def sags(found: dict[float, Array]) -> dict[str, float]:
        far = {nu: np.linalg.norm(z - exact_rest[nu]) / np.linalg.norm(exact_rest[nu]) for nu, z in found.items()}
        return {f"{round(100 * nu)}": 100 * float(error) for nu, error in far.items()}

    rest = {nu: Reduced(model, TO_KEEP).rest() for nu, model in models.items()}
    materials.append(Material(LABEL, free.k, sags(rest), kept(Reduced(free, TO_KEEP), TO_KEEP)))
    for method, counts in methods(grids):
        with console.status(f"{method}, {counts}"):
            last = np.prod(counts) > MANY
            motions += [motion(Flex(method, counts, POISSON[0], h), h, hand, exact) for h in DTS[: 1 if last else 3]]
            rest = {nu: Flex(method, counts, nu, SETTLE, 4 * BETA).rest() for nu in POISSON}
            body = Flex(method, counts, POISSON[0], TO_KEEP, beta=0.0)
            left = float("nan") if last else kept(body, TO_KEEP)
            materials.append(Material(method, body.unknowns, sags(rest), left))
    return Results(motions, materials)


def goals_of(results: Results) -> list[Goal]:
    """At 1 ms the reduced model errs less than every flex body, and its step takes less time."""
    mine = min((r for r in results.motions if r.method == LABEL and r.dt == 1.0), key=lambda r: r.error)
    flexes = [r for r in results.motions if r.method != LABEL]
    return [
        Goal("error of the reduced model over the least of a flex", mine.error / min(r.error for r in flexes), 1.0),
        Goal("its step over the shortest of a flex with an error below 20 %",
             mine.step / min((r.step for r in flexes if r.error < 20), default=np.inf), 1.0),
    ]  # fmt: skip


def main(
    fine: Annotated[int, typer.Option(help="cells of the reference across the block; twice as many along it")] = 6,
    large: Annotated[bool, typer.Option(help="also the finest flex bodies, of 3861 unknowns")] = False,
    out: Annotated[Path, typer.Option(help="folder for bench_mujoco.json, .csv, .md and .png")] = Path("out"),
) -> None:
    """See HELP."""
    console = driver.open_console(130)
    results = measure((4, 4, 8), (fine, fine, 2 * fine), GRIDS if large else GRIDS[:-1], console)
    tables = [
        driver.table_of(results.motions, MOTIONS, "a move of the hand, against the full model on a fine mesh"),
        driver.table_of(results.materials, MATERIALS, "the body at rest, and in free vibration at 1 ms"),
    ]
    for table in tables:
        console.print(table.terminal())
    goals = goals_of(results)
    driver.show_goals(console, goals)
    content = {"command": "bench_mujoco", **asdict(results), "goals": driver.goal_rows(goals)}
    files = driver.write_bench(out, "bench_mujoco", content, tables[0], "\n\n".join(t.markdown() for t in tables))
    driver.list_bench(console, [*files, *draw(results, out / "bench_mujoco.png")])


def draw(results: Results, path: Path) -> tuple[Path, ...]:
    """Error against the time of a step."""
    groups = itertools.groupby(results.motions, key=lambda r: (r.method, r.unknowns))
    looks = {LABEL: "C0", **{method: f"C{i + 1}" for i, method in enumerate(DOFS)}}
    curves: list[driver.Curve] = []
    for (method, unknowns), rows in groups:
        points = [(r.step / r.dt, r.error) for r in rows]
        more = "coordinates" if method == LABEL else "unknowns"
        look = {"color": looks[method], "marker": MARKS[sum(label.startswith(method) for label, *_ in curves)]}
        curves.append((f"{method}, {unknowns} {more}", points, look))
    return driver.loglog(path, curves, "processor time per ms of motion [µs]", "error of the deformation [%]")
