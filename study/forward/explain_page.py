"""``softgrasp explain --out``: what a scene is, as result.json and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from softgrasp.fem.effects import Gate
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward.explain import Explanation, remarks, sag_rows, size_text, verdict
from softgrasp.study.forward.explain_mesh import mesh_lines
from softgrasp.study.report.files import write_json
from softgrasp.study.report.origin import command_line, origin
from softgrasp.study.report.page import EQUATION, Section, equation_text, write_report


def write_explanation(
    out: Path, found: Explanation, scene: Scene, path: Path, overrides: Sequence[str] = ()
) -> tuple[Path, Path]:
    """Write result.json and report.html. Not collective: call on one rank.

    Args:
        out: folder, made if need be.
        found: the explanation.
        scene: the scene.
        path, overrides: where it came from.
    """
    out.mkdir(parents=True, exist_ok=True)
    ranks = found.sizes.ranks
    result = write_json(out / "result.json", {"command": "explain", **origin(scene, ranks), **found.to_dict()})
    report = write_report(
        out / "report.html",
        title=f"{scene.name}: what it simulates",
        subtitle=scene.description,
        sections=_sections(found),
        scene=resolved_toml(scene),
        reproduce=command_line("explain", path, overrides, ranks, " --out out"),
    )
    return result, report


def _said(gate: Gate) -> str:
    return f"{gate.sentence} It {gate.condition}." if gate.condition else gate.sentence


def _sections(found: Explanation) -> list[Section]:
    s, t, solver = found.sizes, found.time, found.solver
    sizes = [
        ("hand, tissue unknowns, states", f"n_s = {s.n_s}, n_e = {s.n_e}, 2n = {s.states}"),
        ("cells, nodes, non-zeros of K_ee", f"{s.cells}, {s.nodes}, {s.nonzeros}"),
        *((f"output {name}", place) for name, place in found.outputs.items()),
        ("Poisson's ratio", ", ".join(f"{nu:.4g} ({name})" for name, nu in found.poisson.items())),
        ("solver", f"{solver.name}: {solver.reason}"),
        ("factor, estimated", size_text(solver.factor_bytes) if solver.factor_bytes else "none"),
        ("mesh and matrices, estimated, over all ranks", size_text(found.memory.mesh)),
        ("tables of the steps, on each rank", size_text(found.memory.tables)),
        ("snapshots", f"{found.snapshot_columns} columns, {size_text(found.snapshot_bytes)}"),
        ("time", f"{t.steps} steps of {t.dt:.4g} s to {t.end:.4g} s"),
    ]
    periods = [(k, w, T, t.dt / T) for k, (w, T) in enumerate(zip(t.omega, t.periods, strict=True), 1)]
    effects = [
        (name, verdict(e), e.gate.symbol, e.gate.number, e.gate.threshold, _said(e.gate))
        for name, e in found.effects.items()
    ]
    costs = [(name, e.term, ", ".join(e.operators) or "nothing", e.cost) for name, e in found.effects.items() if e.on]
    sections = [
        Section("Look at", text="\n\n".join(remarks(found)) or "Nothing stands out."),
        Section(EQUATION, code=equation_text(found.equation)),
        Section("Sizes", rows=sizes),
        Section("At rest under its weight, the hand held still", rows=sag_rows(found)),
        Section("Mesh", text="\n\n".join(mesh_lines(found.mesh, found.dimension))),
        Section(
            "Effects", header=("effect", "verdict", "gate", "number", "matters from", "what it says"), rows=effects
        ),
    ]
    if costs:
        sections.append(Section("What is on", header=("effect", "adds", "allocates", "cost"), rows=costs))
    if periods:
        head = ("mode", "omega [1/s]", "period [s]", "dt / period")
        sections.append(Section("First modes of the clamped tissue", header=head, rows=periods))
    return sections
