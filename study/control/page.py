"""Numbers, tables and files of ``softgrasp control``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.lqr.loop.full import LoopTrajectory
from softgrasp.lqr.plant.identities import gain_rigid_velocity, gain_translation, translation_defect, velocity_defect
from softgrasp.lqr.reduced.retune import BoxPoint
from softgrasp.lqr.reduced.riccati import GainReport
from softgrasp.study.control.loop import LoopRuns, MadeController, distance
from softgrasp.study.control.solve import Design, scene_words
from softgrasp.study.control.sweep import TITLES, Retuned, SweptBasis, radius_of, report_dict
from softgrasp.study.forward.result import trajectory_header
from softgrasp.study.pictures.animation import speed_up
from softgrasp.study.report.equation_control import control_text
from softgrasp.study.report.files import write_json, write_scene
from softgrasp.study.report.origin import command_line, made_with, origin, peak_memory_mb
from softgrasp.study.report.page import Section, write_report

Row = tuple[Any, ...]
SPECTRUM = ("abscissa [1/s]", "radius a tick")
REDUCED_HEADER = ("basis", "N", "error of P", "error of K", "excess cost", *SPECTRUM, "reduced ARE [ms]", "gain")
BOX_HEADER = ("lambda [Pa]", "mu [Pa]", "error of K", "excess cost", *SPECTRUM, "re-tuned in [ms]", "gain")
LOOP_HEADER = ("gain", "N", "distance at the end [m]", "cost", "over the optimal")
CAPTIONS = {
    "move.png": "The move to the target at some instants, full plant under the optimal gain.",
    "move.gif": "The move in motion{speed}.",
    "histories.png": "Outputs, force on the hand, and the distance of the farthest output to the target, on the "
    "full plant; dashed and dash-dotted under the a-priori gain and the dearest of the paper's.",
    "errors.png": "Reduced Riccati equations: relative error of P, relative error of the gain and excess cost against "
    "N. Errors above 100 % are not drawn, excess cost below 1e-12 at 1e-12. Red crosses: gains that leave the full "
    "plant unstable or without certificate; on the upper edge those with an error above 100 %.",
    "retune.png": "Excess cost over the box when the basis stays that of the scene's parameter. Red crosses: no stable "
    "gain.",
    "decay.png": "Decay rates of the lowest modes without feedback and with the gains.",
}


@dataclass(frozen=True)
class Found:
    """All that ``softgrasp control`` found.

    Attributes:
        design: the optimal feedback.
        swept: the reduced equations.
        retuned: gains over the box.
        made: the small controller; None when no small gain is certified.
        runs: closed loops.
        notes: what was chosen for the user, and why parts are missing.
    """

    design: Design
    swept: tuple[SweptBasis, ...]
    retuned: tuple[Retuned, ...]
    made: MadeController | None
    runs: LoopRuns
    notes: tuple[str, ...]


def control_result(model: Model, found: Found, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    layout, d = model.system.layout, found.design
    problem, solution = d.problem, d.solution
    return {
        "command": "control",
        **origin(model.scene, layout.comm.size),
        "n_s": layout.n_s,
        "n_e": layout.n_e,
        "states": layout.states,
        "method": scene_words(solution.method),
        "rank": solution.rank,
        "newton_steps": solution.counts.get("newton_steps", 0),
        "adi_steps": solution.counts.get("adi_steps", 0),
        "solves": solution.counts.get("solves", 0),
        "residual": solution.residual,
        "optimal_cost": d.judge.optimal,
        "gain_translation": gain_translation(problem, solution).tolist(),
        "gain_rigid_velocity": gain_rigid_velocity(problem, solution).tolist(),
        "identity_translation": translation_defect(problem, solution),
        "identity_velocity": velocity_defect(problem, solution),
        "closed_loop_abscissa": d.quality.abscissa,
        "closed_loop_certified": d.quality.certified,
        "closed_loop_exact": d.quality.exact,
        "sampled_radius": None if d.quality.sampled is None else d.quality.sampled.value,
        "sampled_certified": d.quality.sampled is not None and d.quality.sampled.certified,
        "sampled_exact": d.quality.sampled is not None and d.quality.sampled.exact,
        "stable": d.quality.stable,
        "findings": [scene_words(f.sentence) for f in d.diagnosis.findings],
        "damping_enough": d.diagnosis.damping_enough,
        "reduced": {s.name: [report_dict(r) for r in s.reports] for s in found.swept},
        "refused": {s.name: s.refused for s in found.swept if s.refused},
        "retune": [_retuned(r) for r in found.retuned],
        "controller": _controller(found.made),
        "loop": _loop(found),
        "notes": list(found.notes),
        "time": {**model.watch.seconds, **watch.seconds, "solver": dict(solution.seconds)},
        "memory_peak_mb": peak_memory_mb(layout.comm),
    }


def _retuned(r: Retuned) -> dict[str, Any]:
    points = [
        {
            "lambda": p.materials[0].lam,
            "mu": p.materials[0].mu,
            "error_K": p.error_K,
            "cost_excess": p.cost_excess,
            "abscissa_full": p.abscissa_full,
            "sampled_radius": radius_of(p),
            "time": p.seconds,
            "stable": p.stable,
            "reason": p.reason,
        }
        for p in r.points
    ]
    return {"method": r.name, "N": r.N, "slowest": r.slowest, "points": points}


def _controller(made: MadeController | None) -> dict[str, Any] | None:
    if made is None:
        return None
    c = made.controller
    return {"method": made.name, "N": c.plant.N, "period": c.period, "time_tick": made.tick,
            "sampled_radius": made.radius.value}  # fmt: skip


def _loop(found: Found) -> dict[str, Any]:
    runs, full = found.runs, found.runs.full
    far = distance(full, found.design)
    return {
        "steps": runs.plan.steps,
        "dt": runs.plan.dt,
        "hand_final": full.q_s[-1].tolist(),
        "output_names": list(full.output_names),
        "output_target": found.design.target.y.tolist(),
        "output_final": full.outputs[-1].tolist(),
        "distance_first": float(far[0]),
        "distance_final": float(far[-1]),
        "settled": settled(full.times, far),
        "cost": float(full.cost[-1]),
        "cost_to_come": runs.to_come,
        "input_largest": np.abs(full.inputs).max(axis=0).tolist(),
        "saturated": full.saturated,
        "solver": {"name": full.solver[0], "reason": full.solver[1]},
        "time": dict(full.seconds),
        "reduced": [
            {"method": name, "N": N, "reason": run}
            if isinstance(run, str)
            else {
                "method": name,
                "N": N,
                "distance_final": float(distance(run, found.design)[-1]),
                "cost": float(run.cost[-1]),
                "reason": "",
            }
            for name, (_, N, run) in runs.reduced.items()
        ],
    }


def settled(times: np.ndarray, far: np.ndarray, share: float = 0.01) -> float | None:
    """First time after which the distance stays below a share of the first; None when it never does."""
    outside = np.flatnonzero(far > share * far[0])
    if len(outside) == 0:
        return float(times[0])
    return None if outside[-1] + 1 >= len(times) else float(times[outside[-1] + 1])


# --- tables


def summary_rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """The short table as label and text."""
    loop, seconds = result["loop"], result["time"]
    rows = [
        ("method", result["method"]),
        ("rank, Newton steps, solves", f"{result['rank']}, {result['newton_steps']}, {result['solves']}"),
        ("true relative residual", f"{result['residual']:.1e}"),
        ("optimal cost from the start", f"{result['optimal_cost']:.6g}"),
    ]
    word = "" if result["closed_loop_certified"] else ", not certified for the modes left out"
    word = word if result["closed_loop_abscissa"] < 0 or word else ": not stable"
    if not word and not result["closed_loop_exact"]:
        word = ", a lower bound; stable for certain"
    if word and "stay on the imaginary axis" in result["method"]:
        word = ": that of the modes left out, zero to rounding"
    rows.append(("closed-loop spectral abscissa", f"{result['closed_loop_abscissa']:.4g} 1/s{word}"))
    if result["sampled_radius"] is not None:
        kept = "" if result["sampled_exact"] else ", of the modes kept"
        kept += "" if result["sampled_certified"] else ", not certified for the modes left out"
        rows.append(("spectral radius from tick to tick", f"{result['sampled_radius']:.6g}{kept}"))
    for label, key in (("gain, body displaced", "gain_translation"), ("gain, body moving", "gain_rigid_velocity")):
        rows.append((label, "; ".join(" ".join(f"{v:.5g}" for v in row) for row in np.array(result[key]))))
    rows.append(
        (
            "distance to the target",
            f"{loop['distance_first']:.3g} m at first, {loop['distance_final']:.3g} m at the end",
        )
    )
    when = "not within the run" if loop["settled"] is None else f"{loop['settled']:.4g} s"
    rows.append(("within 1 % for good after", when))
    rows.append(("cost of the run + still to come", f"{loop['cost']:.6g} + {loop['cost_to_come']:.3g}"))
    if loop["saturated"]:
        rows.append(("steps with a load at its limit", f"{100 * loop['saturated']:.3g} %"))
    made = result["controller"]
    if made is not None:
        text = f"N = {made['N']}, {1e6 * made['time_tick']:.2g} us a tick of {1e3 * made['period']:g} ms"
        rows.append(("small controller", text))
    rows += [("re-tuned", _fast(r)) for r in result["retune"]]
    rows.append(
        ("time: ARE, reduced, loop", ", ".join(f"{seconds.get(k, 0.0):.3g} s" for k in ("are", "reduced", "loop")))
    )
    return rows


def _fast(r: dict[str, Any]) -> str:
    stable = sum(p["stable"] for p in r["points"])
    worst = max((p["cost_excess"] for p in r["points"] if p["stable"]), default=float("nan"))
    return (
        f"{TITLES.get(r['method'], r['method'])}, N = {r['N']}: {stable} of {len(r['points'])} stable, "
        f"at most {1e3 * r['slowest']:.2g} ms, excess cost up to {worst:.1e}"
    )


def _mark(gain: GainReport | BoxPoint) -> str:
    if gain.reason:
        return "none"
    if gain.stable or not gain.certified:
        return "stable" if gain.stable else "not certified"
    if gain.abscissa_full >= 0 or gain.sampled is None:
        return "unstable"
    return "unstable as sampled" if gain.sampled.value >= 1 else "not certified as sampled"


def reduced_rows(swept: Sequence[SweptBasis]) -> list[Row]:
    """One row a gain; errors of an unusable gain are shown, its cost is not."""
    return [
        (
            s.title,
            r.N,
            *(None if r.reason or not np.isfinite(x) else float(x) for x in (r.error_P, r.error_K, r.cost_excess)),
            None if r.reason else r.abscissa_full,
            None if r.sampled is None else radius_of(r),
            None if r.reason else 1e3 * r.time_are,
            _mark(r),
        )
        for s in swept
        for r in s.reports
    ]


def box_rows(r: Retuned) -> list[Row]:
    """One row a setting."""
    return [
        (
            p.materials[0].lam,
            p.materials[0].mu,
            *(
                None if p.reason or not np.isfinite(x) else float(x)
                for x in (p.error_K, p.cost_excess, p.abscissa_full, radius_of(p), 1e3 * p.seconds)
            ),
            _mark(p),
        )
        for p in r.points
    ]


def loop_rows(found: Found) -> list[Row]:
    """Full plant under every gain."""
    full = found.runs.full
    rows: list[Row] = [("optimal", None, float(distance(full, found.design)[-1]), float(full.cost[-1]), 0.0)]
    for title, N, run in found.runs.reduced.values():
        if isinstance(run, LoopTrajectory):
            cost = float(run.cost[-1])
            rows.append((title, N, float(distance(run, found.design)[-1]), cost, cost / float(full.cost[-1]) - 1))
        else:
            rows.append((f"{title}: {run}", N, None, None, None))
    return rows


# --- files


def write_tables(out: Path, found: Found) -> list[Path]:
    """reduced.csv, retune.csv and trajectory.csv. Rank 0 only."""
    full, files = found.runs.full, []
    inputs = np.vstack([full.inputs, full.inputs[-1:]])
    n_s = full.q_s.shape[1]
    names = trajectory_header(n_s, found.design.problem.layout.dimension, full.columns, velocity=False)
    forces = hand_columns(n_s, found.design.problem.layout.dimension, "u")
    names += [*(f"{u.label} [{u.load_unit}]" for u in forces), "cost"]
    data = np.column_stack([full.times, full.q_s, full.outputs, inputs, full.cost])
    tables: dict[str, tuple[Sequence[str], list[Row]]] = {"trajectory.csv": (names, [tuple(row) for row in data])}
    if found.swept:
        tables["reduced.csv"] = (REDUCED_HEADER, reduced_rows(found.swept))
    if found.retuned:
        rows = [(TITLES[r.name], r.N, *row) for r in found.retuned for row in box_rows(r)]
        tables["retune.csv"] = (("basis", "N", *BOX_HEADER), rows)
    for name, (header, rows) in tables.items():
        with (out / name).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(["" if v is None else f"{v:.17g}" if isinstance(v, float) else v for v in r] for r in rows)
        files.append(out / name)
    return files


def write_all(
    out: Path, path: Path, overrides: list[str], model: Model, found: Found, result: dict[str, Any], drawn: list[Path]
) -> list[Path]:
    """Tables, resolved scene, report, and result.json last. Rank 0 only."""
    files = write_tables(out, found)
    names = {file.name for file in drawn}
    faster = speed_up(np.array([0.0, found.runs.plan.settle]))
    speed = "" if faster == 1 else f" at {faster:g} times its speed"
    figures = [(out / name, text.format(speed=speed)) for name, text in CAPTIONS.items() if name in names]
    report = write_report(
        out / "report.html",
        title=f"{model.scene.name}: optimal feedback",
        subtitle=model.scene.description,
        sections=sections(found, result, figures, control_text(model.scene)),
        scene=resolved_toml(model.scene),
        reproduce=command_line("control", path, overrides, result["ranks"]),
    )
    return [write_json(out / "result.json", result), *files, write_scene(out, model.scene), *drawn, report]


def sections(found: Found, result: dict[str, Any], figures: list[tuple[Path, str]], equation: str) -> list[Section]:
    """Parts of the page."""
    moving = [f for f in figures if f[0].name in ("move.png", "move.gif", "histories.png", "decay.png")]
    by_name = {f[0].name: f for f in figures}
    parts = [
        Section("", text="\n\n".join((*result["findings"], *found.notes)), figures=moving[:2]),
        Section("Result", rows=summary_rows(result), figures=moving[2:]),
        Section("Equation", code=equation),
    ]
    if found.swept:
        text = (
            "Each equation is projected on N basis vectors and solved; its gain is judged on the full plant. The bases "
            "of the paper need P first, the a-priori modes do not. Only stable gains are offered as controllers."
        )
        rows = reduced_rows(found.swept)
        own = [by_name[n] for n in ("errors.png",) if n in by_name]
        parts.append(Section("Reduced Riccati equations", text, header=REDUCED_HEADER, rows=rows, figures=own))
        refused = [(s.title, s.refused) for s in found.swept if s.refused]
        refused += [(f"{s.title}, N = {r.N}", r.reason) for s in found.swept for r in s.reports if r.reason]
        if refused:
            parts.append(Section("Refused", header=("basis", "reason"), rows=refused))
        text = "Full plant, same start, time step and actuation."
        parts.append(Section("Closed loop", text, header=LOOP_HEADER, rows=loop_rows(found)))
    for i, r in enumerate(found.retuned):
        text = f"{TITLES[r.name]}, N = {r.N}: basis of the scene's parameter, gain re-tuned at others."
        own = [by_name["retune.png"]] if i == 0 and "retune.png" in by_name else []
        parts.append(Section("" if i else "Re-tuning", text, header=BOX_HEADER, rows=box_rows(r), figures=own))
    about = [(key, result[key]) for key in ("n_s", "n_e", "states")] + made_with(result)
    about += [(f"time {k}", f"{v:.3g} s") for k, v in result["time"].items() if isinstance(v, float)]
    about += [(f"solver {k}", f"{v:.3g} s") for k, v in result["time"]["solver"].items()]
    return [*parts, Section("Made with", rows=about)]
