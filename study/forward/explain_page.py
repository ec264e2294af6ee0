"""``softgrasp explain``: what a scene is, in the terminal, as result.json and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from softgrasp.fem import SMALL_SHARE, SMALL_STRAIN, Forecast, size_text
from softgrasp.fem.run.forecast import RELIABLE, START
from softgrasp.study.forward.explain import EffectReport, Explanation, MeshSummary, explain
from softgrasp.study.report import EQUATION, Page, Section, in_words, percent
from softgrasp.study.report.origin import origin
from softgrasp.study.shell import Session, folder_lock

OPERATORS = (
    "Operators are matrices and columns over the mesh. `softgrasp effects` adds up the memory of all that a run holds, "
    "with vectors and small arrays."
)
FORECAST = ("ranks", "solver", "mesh, assembly", "set-up", "equilibrium", "steps", "fields", "in all", "memory")


@folder_lock()
def run_explain(
    path: Path, out: Path | None, overrides: Sequence[str], console: Console, *, empty: bool = False
) -> Explanation:
    """Explain a scene file, and write result.json and report.html if there is a folder for them. Collective."""
    session = Session("explain", path, overrides, out or Path(), console, empty=empty, writes=out is not None)
    scene = session.scene()
    explanation = explain(scene, session.comm)
    page = Page(
        f"{scene.name}: what it simulates", summary(explanation), sections(explanation), options=" --out out",
        errors=error_lines(explanation.mesh, explanation.effects["frame"].on), warnings=remarks(explanation),
    )  # fmt: skip
    result = {}
    if out is not None:  # hashing large files takes a while
        result = {"command": "explain", **origin(scene, session.comm.size), **explanation.to_dict()}
    session.write(scene, result, lambda: page, clock=False)
    return explanation


def sections(result: Explanation) -> list[Section]:
    """The parts of the page."""
    s, t, solver = result.sizes, result.time, result.solver
    about, near = "" if result.counted else "about ", "" if result.built else "about "
    cells, nodes = (f"about {int(float(f'{n:.1e}'))}" if result.sampled else f"{n}" for n in (s.cells, s.nodes))
    states = s.states if result.counted else int(float(f"{s.states:.2e}"))
    sizes = [
        ("hand, tissue unknowns, states", f"n_s = {s.n_s}, n_e = {about}{s.n_e}, 2n = {about}{states}"),
        ("cells, nodes, non-zeros of K_ee", f"{cells}, {nodes}, {near}{s.nonzeros}"),
        *((f"output {name}", place) for name, place in result.outputs.items()),
        ("Poisson's ratio", ", ".join(f"{nu:.4g} ({name})" for name, nu in result.poisson.items())),
        ("solver", f"{solver.name}: {solver.reason}"),
        ("factor, estimated", size_text(solver.factor_bytes) if solver.factor_bytes else "none"),
        ("mesh and matrices, estimated, over all ranks", size_text(result.memory.mesh)),
        ("tables of the steps, on each rank", size_text(result.memory.tables)),
        ("snapshots", f"{result.snapshot_columns} columns, {size_text(result.snapshot_bytes)}"),
        ("time", f"{t.steps} steps of {t.dt:.4g} s to {t.end:.4g} s"),
    ]
    if (plan := result.plan) is not None:
        program = f"{plan.variables} variables, {about}{plan.rows} rows, {plan.intervals} intervals of {plan.grid:g} s"
        sizes.append(("plan of control, longer where its end is not safe", f"N = {plan.N}, {program}"))
    effects = [
        (f"{name}: {verdict(e)}", ". ".join(filter(None, (e.gate.comparison, e.gate.sentence))))
        for name, e in result.effects.items()
    ]
    costs = [(name, f"It adds {e.term} and {_operators(e.operators)}. {e.cost}")
             for name, e in result.effects.items() if e.on]  # fmt: skip
    periods = [(k, w, T, t.dt / T) for k, (w, T) in enumerate(zip(t.omega, t.periods, strict=True), 1)]
    modes = ("mode", "omega [1/s]", "period [s]", "dt / period")
    copied = [result.copied] if result.copied else []
    about_mesh = [*copied, *mesh_lines(result.mesh, result.dimension)]
    no_modes = "" if periods else "Not computed: the factor would not fit."
    parts = [
        Section(EQUATION, code="\n".join(result.equation.plain().lines()), equation=result.equation),
        Section("Sizes", rows=sizes),
        *forecast_section(result.forecasts),
        Section("At rest under its weight, the hand held still", rows=sag_rows(result)),
        *([Section("Mesh", text="\n\n".join(about_mesh))] if about_mesh else []),
        Section("Effects", rows=effects),
        *([Section("What is on", OPERATORS, rows=costs)] if costs else []),
        Section("First modes of the clamped tissue", no_modes, header=modes if periods else (), rows=periods),
    ]
    return [replace(part, terminal=True) for part in parts]


def _operators(names: Sequence[str]) -> str:
    return f"the operator{'s' * (len(names) > 1)} {in_words(names)}" if names else "no operator"


def forecast_section(forecasts: Sequence[Forecast]) -> list[Section]:
    """Modelled time and memory of the run by the number of ranks."""
    contact = any(f.contact for f in forecasts)
    rows = [
        (f.ranks, f.solver, *(f"{x:.2g} s" for x in (f.build, f.setup, f.equilibrium, f.steps, f.fields)),
         *([f"{f.contact:.2g} s"] if contact else []), f"{f.seconds:.2g} s", size_text(f.memory))
        for f in forecasts
    ]  # fmt: skip
    header = (*FORECAST[:-2], *(["contact"] if contact else []), *FORECAST[-2:])
    text = (
        f"A model, {RELIABLE}. Ranks beyond the cores of this node are on more nodes like it. {START:g} s in all are "
        "for the start and a page; pictures and the estimate of the mesh come on top."
    )
    return [Section("What simulate costs, by the cost model", text, header=header, rows=rows)] if rows else []


def summary(result: Explanation) -> list[str]:
    """What it is, in three sentences."""
    on = [name for name, e in result.effects.items() if e.on]
    sag, s, about = result.sag, result.sizes, "" if result.counted else "about "
    cells = f"about {int(float(f'{s.cells:.1e}'))}" if result.sampled else f"{s.cells}"
    return [
        f"The tissue has n_e = {about}{s.n_e} unknowns in {cells} cells; {result.solver.name} solves its "
        f"{result.time.steps} steps of {result.time.dt:.3g} s.",
        f"Effects that are on: {in_words(on)}; on although they do not matter: {in_words(result.idle)}; "
        f"off although they would matter: {in_words(result.missing)}.",
        f"Under its weight the tissue sags by {sag.largest:.2g} m; linear elasticity "
        f"{'is valid' if sag.gradient.linear else 'is not valid'} there.",
    ]


def sag_rows(result: Explanation) -> list[tuple[str, str]]:
    """Load, sag, gradient and validity of the static solution as label and text."""
    sag, assumed = result.sag, "" if result.effects["gravity"].on else " (assumed: gravity is off)"
    steep = sag.gradient
    return [
        ("g", "(" + ", ".join(f"{x + 0.0:g}" for x in sag.g) + f") m/s2{assumed}"),
        ("largest |z|", f"{sag.largest:.4g} m"),
        ("|grad z|", f"{steep.largest:.3g} at most, above {steep.typical:.3g} in {percent(SMALL_SHARE)} of the body"),
        ("linear elasticity", f"{'valid' if steep.linear else 'not valid'}: |grad z| is above {SMALL_STRAIN} in "
         f"{percent(steep.share)} of the body, at most {percent(SMALL_SHARE)} may be"),
    ]  # fmt: skip


def mesh_lines(report: MeshSummary, dimension: int) -> list[str]:
    """The report in sentences."""
    place = "point" if dimension == 2 else "edge"
    lines = [
        f"At {e.count} {place}{'s' * (e.count > 1)} of kind '{e.kind}' the displacement grows like r^{e.alpha:.3g}."
        for e in report.ends[:6]
    ]
    if len(report.ends) > len(lines):
        lines.append(f"{len(report.ends) - len(lines)} more kinds of ends have larger exponents.")
    if report.graded:
        lines.append(f"The cells are graded: outputs converge with the order {report.order:g} in n_e^(1/{dimension}).")
    elif report.ends:
        lines.append(
            f"The cells are even: outputs converge with the order {report.order:.2g} in h, whatever tissue.order is."
        )
    if report.first:
        lines.append("This is the first mesh: simulate may refine it further, to meet tissue.refine.tolerance.")
    return lines


def error_lines(report: MeshSummary, in_frame: bool = False) -> list[str]:
    """Error of mesh and time step in one sentence, or why there is none."""
    if report.estimate is not None and report.bound is not None and report.time_error is not None:
        return [
            f"The error of the deformation is about {percent(report.estimate)} "
            f"{'as extrapolated from coarser cells' if report.coarser else 'on this mesh'}, with a bound of "
            f"{percent(report.bound)}, and about {percent(report.time_error)} by the time step."
        ]
    if in_frame:
        return ["The error of the mesh is not estimated in the frame of the hand."]
    return ["The error of the mesh is not estimated here, as that takes some time; simulate --certify does it."]


def verdict(effect: EffectReport) -> str:
    """On or off, and whether that is right."""
    matters = ("matters" if effect.on else "would matter") if effect.gate.matters else ""
    return f"{'on' if effect.on else 'off'}, {matters or ('does not matter' if effect.on else 'not needed')}"


def remarks(result: Explanation) -> list[str]:
    """What the reader should look at, one sentence each."""
    texts = []
    for name in result.missing:
        proviso = result.effects[name].gate.proviso
        texts.append(f"{name} is off, but the scene seems to call for it{', ' + proviso if proviso else ''}.")
    texts += [f"{name} is on, but does not matter here." for name in result.idle]
    return [*texts, *result.warnings]
