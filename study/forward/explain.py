"""What a scene solves, before it is solved: its equation, sizes, time scales and which effects matter."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding

from softgrasp.fem.effects import EFFECTS, Gate
from softgrasp.fem.effects.sag import SMALL_SHARE, Sag
from softgrasp.fem.fields.scales import measure
from softgrasp.fem.fields.strain import SMALL_STRAIN
from softgrasp.fem.model.build import build
from softgrasp.fem.model.memory import Need, factor_bytes, need
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.solvers import DIRECT_LIMIT, choose_solver, factor_on_every_rank
from softgrasp.study.forward.cautions import coarse, locking, poisson_ratios, turned
from softgrasp.study.forward.explain_mesh import MeshReport, mesh_lines, mesh_report
from softgrasp.study.report.equation import Equation, equation
from softgrasp.study.report.files import plain

if TYPE_CHECKING:
    from mpi4py import MPI

    from softgrasp.fem.model.build import Model
    from softgrasp.fem.scene.scene import Scene

MODES = 6


@dataclass(frozen=True)
class Sizes:
    """Numbers of unknowns and entities; ``states`` is 2n of the first-order system."""

    n_s: int
    n_e: int
    states: int
    cells: int
    nodes: int
    nonzeros: int
    ranks: int


@dataclass(frozen=True)
class SolverPlan:
    """Solver, reason and estimated memory of its factor over all ranks [byte] (0: no factor)."""

    name: str
    reason: str
    factor_bytes: float


@dataclass(frozen=True)
class TimePlan:
    """Step and end [s] against the first periods T_k = 2 pi / omega_k of the clamped tissue [s, 1/s]."""

    steps: int
    dt: float
    end: float
    omega: tuple[float, ...]
    periods: tuple[float, ...]
    omega_dt: tuple[float, ...]


@dataclass(frozen=True)
class EffectReport:
    """One effect in this scene: `fem.effects` says what the entries mean."""

    on: bool
    term: str
    operators: tuple[str, ...]
    cost: str
    gate: Gate


@dataclass(frozen=True)
class Explanation:
    """All that explain says.

    Attributes:
        name: of the scene.
        equation: with exactly the terms of this scene.
        sizes: unknowns and entities.
        solver: choice and cost.
        time: step against periods.
        effects: by name.
        poisson: Poisson's ratio of each material by layer name [1].
        missing: effects that are off and would matter.
        idle: effects that are on and do not matter.
        sag: the tissue at rest under its weight.
        warnings: one sentence each.
        outputs: name and place of each output.
        memory: estimated need of mesh, factor and steps.
        snapshot_columns, snapshot_bytes: what the run stores in memory, over all ranks.
        mesh: singular ends, and the error they leave.
        dimension: 2 or 3.
    """

    name: str
    equation: Equation
    sizes: Sizes
    solver: SolverPlan
    time: TimePlan
    effects: dict[str, EffectReport]
    poisson: dict[str, float]
    missing: tuple[str, ...]
    idle: tuple[str, ...]
    sag: Sag
    warnings: tuple[str, ...]
    outputs: dict[str, str]
    memory: Need
    snapshot_columns: int
    snapshot_bytes: int
    mesh: MeshReport
    dimension: int

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts, lists and numbers for JSON; what is not known is None. Not collective."""
        result: dict[str, Any] = plain(asdict(self))
        return result


def explain(scene: Scene, comm: MPI.Intracomm) -> Explanation:
    """Assemble a scene and say what it is. Collective.

    Raises:
        SceneError, MeshError: the scene cannot be built.
        SolverError: its modes or its sag cannot be computed.
    """
    return explain_model(build(scene, comm=comm, run=False))


def explain_model(model: Model) -> Explanation:
    """Say what a built model is. Collective.

    Raises:
        SolverError: its modes or its sag cannot be computed.
    """
    scene, system = model.scene, model.system
    layout = system.layout
    d, ranks = layout.dimension, layout.comm.size
    name, reason = choose_solver(layout, scene.time.solver)
    copies = ranks if factor_on_every_rank(layout, name, scene.time.reproducible) else 1
    if layout.n_e <= DIRECT_LIMIT[d]:  # the modes need a factor
        omega, Phi = lowest_modes(system, min(MODES, layout.n_e))
    else:
        omega, Phi = np.zeros(0), np.zeros((layout.n_local, 0))
    problem = measure(model, omega, Phi)
    reports = {
        key: EffectReport(e.active(scene), e.term, e.operators(scene), e.cost, e.gate(problem))
        for key, e in EFFECTS.items()
    }
    topology = model.space.mesh.mesh.topology
    stored = scene.output.snapshots == "memory"
    columns = scene.time.steps // scene.output.every + 1 if stored else 0
    dt = scene.time_end / scene.time.steps
    poisson = poisson_ratios(system)
    return Explanation(
        name=scene.name,
        equation=equation(scene),
        sizes=Sizes(
            n_s=layout.n_s,
            n_e=layout.n_e,
            states=layout.states,
            cells=topology.index_map(d).size_global,
            nodes=model.space.V.dofmap.index_map.size_global,
            nonzeros=int(system.K_ee.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]),
            ranks=ranks,
        ),
        solver=SolverPlan(name, reason, factor_bytes(name, layout.n_e, d, copies)),
        time=TimePlan(
            steps=scene.time.steps,
            dt=dt,
            end=scene.time_end,
            omega=problem.omega,
            periods=tuple((2 * np.pi / omega).tolist()),
            omega_dt=tuple((omega * dt).tolist()),
        ),
        effects=reports,
        poisson=poisson,
        missing=tuple(key for key, r in reports.items() if not r.on and r.gate.matters),
        idle=tuple(key for key, r in reports.items() if r.on and not r.gate.matters),
        sag=problem.sag,
        warnings=(*model.space.mesh.notes, *_warnings(scene, poisson, omega, dt, d, reports, problem.sag)),
        outputs={o.name: o.place for o in make_outputs(scene, system) if o.place},
        memory=need(scene, d, topology.index_map(d).size_global, layout.comm, run=True),
        snapshot_columns=columns,
        snapshot_bytes=16 * layout.n_e * columns,
        mesh=mesh_report(model),
        dimension=d,
    )


def _warnings(
    scene: Scene, poisson: dict[str, float], omega: Any, dt: float, d: int, effects: dict[str, EffectReport], sag: Sag
) -> list[str]:
    found = locking(poisson, scene.tissue.order)
    if len(omega):
        found += coarse(float(omega[0]), dt, scene.time_end, "the first period")
    if effects["gravity"].on and not sag.gradient.small:
        found.append(
            f"At rest under its weight the tissue would sag by {sag.largest:.2g} m and |grad z| would be above "
            f"{SMALL_STRAIN} in {sag.gradient.share:.0%} of the body, at most {sag.gradient.largest:.2g}: linear "
            "elasticity assumes small strains and rotations."
        )
    if scene.effects.rotation:
        found += turned(max(map(abs, (scene.motion.target or [])[d:]), default=0.0))
    return found


def run_explain(scene: Scene, comm: MPI.Intracomm, console: Console) -> Explanation:
    """Explain a scene; rank 0 writes it to the console. Collective.

    Raises:
        SceneError, MeshError, SolverError: as `explain`.
    """
    result = explain(scene, comm)
    if comm.rank == 0:
        render(result, console)
    return result


def render(result: Explanation, console: Console) -> None:
    """Write an explanation; narrow terminals wrap. Not collective: call on one rank."""

    def title(text: str) -> None:
        console.print(f"\n[bold]{escape(text)}[/]")

    def line(text: str, indent: int = 2) -> None:
        console.print(Padding.indent(escape(text), indent), highlight=False)

    console.print(f"[bold]{escape(result.name)}[/]")
    title("Equation")
    for row in result.equation.blocks:
        line(_row(*row))
    line("stepped as")
    for row in result.equation.stepped:
        line(_row(*row))
    line("with")
    for text in result.equation.where:
        line(text, 4)
    s, t = result.sizes, result.time
    title("Sizes")
    line(f"n_s = {s.n_s}, n_e = {s.n_e}, states 2n = {s.states}")
    line(f"{s.cells} cells, {s.nodes} nodes, {s.nonzeros} non-zeros in K_ee, {s.ranks} rank(s)")
    for output, place in result.outputs.items():
        line(f"output {output}: {place}")
    line("nu = " + ", ".join(f"{nu:.4g} ({name})" for name, nu in result.poisson.items()))
    title("Mesh")
    for text in mesh_lines(result.mesh, result.dimension):
        line(text)
    title("Solver")
    line(f"{result.solver.name}: {result.solver.reason}")
    if result.solver.factor_bytes:
        line(f"factor about {size_text(result.solver.factor_bytes)} (estimate)")
    line(
        f"mesh and matrices about {size_text(result.memory.mesh)} over all ranks, tables of the steps "
        f"{size_text(result.memory.tables)} on each (estimates)"
    )
    line(f"snapshots: {result.snapshot_columns} columns, {size_text(result.snapshot_bytes)}")
    title("Time")
    line(f"{t.steps} steps of {t.dt:.4g} s to {t.end:.4g} s")
    if not t.omega:
        line("first periods not computed: the factor would not fit")
    for k, (T, phase) in enumerate(zip(t.periods, t.omega_dt, strict=True), 1):
        line(f"T_{k} = {T:.4g} s, dt/T_{k} = {t.dt / T:.2g}, omega_{k} dt = {phase:.2g}")
    title("At rest under its weight, the hand held still")
    for label, value in sag_rows(result):
        line(f"{label}: {value}")
    title("Effects")
    for name, e in result.effects.items():
        gate = e.gate
        line(f"{name}: {verdict(e)}")
        line(gate.comparison, 4)
        line(gate.sentence, 4)
        if e.on:
            line(f"adds {e.term}; allocates {', '.join(e.operators) or 'nothing'}.", 4)
            line(e.cost, 4)
    found = remarks(result)
    if found:
        title("Look at")
    for text in found:
        line(text)


def sag_rows(result: Explanation) -> list[tuple[str, str]]:
    """Load, sag, gradient and validity of the static solution as label and text. Not collective."""
    sag, assumed = result.sag, "" if result.effects["gravity"].on else " (assumed: gravity is off)"
    steep = sag.gradient
    return [
        ("g", "(" + ", ".join(f"{x:g}" for x in sag.g) + f") m/s2{assumed}"),
        ("largest |z|", f"{sag.largest:.4g} m"),
        ("|grad z|", f"{steep.largest:.3g} at most, above {steep.typical:.3g} in {SMALL_SHARE:.0%} of the body"),
        ("linear elasticity", f"{'holds' if steep.small else 'does not hold'}: |grad z| is above {SMALL_STRAIN} in "
         f"{steep.share:.2%} of the body, at most {SMALL_SHARE:.0%} may be"),
    ]  # fmt: skip


def verdict(effect: EffectReport) -> str:
    """On or off, and whether that is right. Not collective."""
    matters = ("matters" if effect.on else "would matter") if effect.gate.matters else ""
    return f"{'on' if effect.on else 'off'}, {matters or ('does not matter' if effect.on else 'not needed')}"


def remarks(result: Explanation) -> list[str]:
    """What deserves a look, one sentence each. Not collective."""
    found = []
    for name in result.missing:
        proviso = result.effects[name].gate.proviso
        found.append(f"{name} is off, but the scene seems to call for it{', ' + proviso if proviso else ''}.")
    found += [f"{name} is on, but does not matter here." for name in result.idle]
    return [*found, *result.warnings]


def _row(name: str, left: tuple[str, ...], right: tuple[str, ...]) -> str:
    return f"{name}: {_sum(left)} = {_sum(right)}"


def _sum(terms: tuple[str, ...]) -> str:
    return " + ".join(terms).replace("+ - ", "- ")


def size_text(size: float) -> str:
    """Bytes in a unit that suits. Not collective."""
    for unit in ("byte", "KiB", "MiB"):
        if size < 1024:
            return f"{size:.3g} {unit}" if unit != "byte" else f"{size:.0f} byte"
        size /= 1024
    return f"{size:.3g} GiB"
