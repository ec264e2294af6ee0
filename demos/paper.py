"""Every figure and table of the paper again, and a page with the paper's value, ours, and the reason of a difference.

``python demos/paper.py --out out/paper``: forward run, all bases, Riccati equation and closed loop [SBRH21].
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from softgrasp.fem import _stack as _stack
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.reduction.bases.registry import PAPER_PLAIN
from softgrasp.study.control.result import TITLES
from softgrasp.study.control.run import run_control
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.reduce.run import run_reduce
from softgrasp.study.report.document import Page, Section, percent
from softgrasp.study.report.page import write_report

Row = tuple[str, str, str, str, str]
HEADER = ("quantity", "paper", "here", "verdict", "why different")
REPRODUCED, BETTER, DIFFERS, UNKNOWN = "reproduced", "better", "differs", ""
NEAR = 0.05  # [m] of a way of 5.8: within 1 %
N_FORWARD, N_RICCATI, N_FLAT = 14, 8, 25  # the paper's examples, and where its errors fall no more
OF_PAPER = ("global_pod", "componentwise_pod", "pod_fixed", "componentwise_pod_fixed", "psd", "psd_fixed")
FREE, FIXED = ("pod", "weighted_pod"), ("pod_fixed_solid", "componentwise_pod", "pod_decomposed")
FIGURES = (
    ("forward/move.png", "Figure 2: forward simulation of the coupled problem, full model."),
    (
        "forward/mesh_error.png",
        "The error of the deformation on the paper's mesh: tip against the hand on it, and corrected by the estimate.",
    ),
    ("accurate/mesh_error.png", "The same on the graded mesh of paper_accurate, where both lie on each other."),
    ("reduce/compare.png", "Figure 2: the reduced motion against the full one."),
    ("reduce/errors.png", "Figure 3: error of the reduced solutions against N, all six methods."),
    ("reduce/times.png", "The timings of the forward problem: error against the time of a run."),
    (
        "control/move.png",
        "Figure 4: the closed loop moves the body to its target, full plant under the optimal gain; the table has the "
        "distances under the reduced gains.",
    ),
    ("control/histories.png", "Figure 4: outputs, force and distance to the target, also under reduced gains."),
    (
        "control/errors.png",
        "Figure 5: error of the reduced Riccati solution against N, five methods and ours; beside it what the paper "
        "does not show, the error of the gain and the excess cost.",
    ),
)
ABOUT = (
    "Not in the paper and chosen here: the mass of the hand, 20; its motion in the forward problem, a quintic from "
    "rest to rest; Q = R = 1 and Kelvin-Voigt damping of 0.002 s in the control problem. Times are of this machine "
    "and of compiled kernels, those of the paper of RBmatlab on its own; so ratios compare better than seconds.",
    "The hypotheses of the paper that do not come out here are kept in the tables as they came out.",
)
PAGES = (
    "report.html in forward, accurate, reduce and control have the scenes with their equations, all sizes, "
    "all points of the figures and the commands that make each alone."
)

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


USELESS = "no digit of its P is right, so that its time is no comparison"


def at(points: list[dict[str, Any]], N: int) -> dict[str, Any]:
    """The point whose N is nearest to a given one, the smaller of two."""
    return min(points, key=lambda p: (abs(p["N"] - N), p["N"]))


def digits(value: float | None, unit: str = "") -> str:
    """Three digits; null in JSON is a number that is not finite."""
    return "not finite" if value is None else f"{value:.3g}{unit}"


def _span(values: list[float], unit: str) -> str:
    return f"{digits(min(values))} to {digits(max(values), unit)}" if values else "none"


def verdict(same: bool) -> str:
    """Whether the paper's statement comes out."""
    return REPRODUCED if same else DIFFERS


def less(here: float | None, paper: float) -> str:
    """Whether a number, the smaller the better, comes out smaller than the paper's."""
    return BETTER if here is not None and here < paper else DIFFERS


def _error(point: dict[str, Any]) -> float:
    return float("inf") if point["error"] is None else float(point["error"])


def mesh_rows(forward: dict[str, Any], accurate: dict[str, Any]) -> list[Row]:
    """The error of the deformation, on the paper's and on the graded one."""
    here = [
        f"about {percent(error['estimate'])} (bound {percent(error['bound'])}) at n_e = {error['n_e']} in "
        f"{digits(result['time']['factor'] + result['time']['steps'], ' s')}"
        for result in (forward, accurate) if (error := result["mesh_error"])
    ]  # fmt: skip
    zone, cells = "the contact zone ends within two sides", "quadratic cells that shrink towards these ends"
    return [
        ("error of the deformation through the mesh", "not reported", here[0], UNKNOWN, zone),
        ("the same, scene paper_accurate", "-", here[1], UNKNOWN, cells),
    ]


def forward_rows(forward: dict[str, Any], reduced: dict[str, Any]) -> list[Row]:
    """Sizes, errors and times of the forward problem; every statement of the paper on it has a row."""
    points, speed = reduced["methods"], {row["method"]: row for row in reduced["speed"]}
    psd, about = at(points["psd"], N_FORWARD), reduced["about"]
    full, states = forward["time"]["factor"] + forward["time"]["steps"], forward["states"]
    paper = [name for name in OF_PAPER if points.get(name)]
    online, again = [p["time_online"] for name in paper for p in points[name]], speed["psd"]["speedup_same_model"]
    errors = (
        f"{digits(psd['error'])} in (q, v), {digits(psd['error_canonical'])} in (q, p), "
        f"{digits(psd['error_deformation'])} in the deformation"
    )
    near, chosen = any(3e-4 < (psd[key] or 0) < 3e-3 for key in ("error", "error_canonical")), f"PSD, N = {psd['N']}"
    return [
        ("states 2n", "1916", str(states), verdict(states == 1916), "the same mesh, contact zone and elements"),
        ("full run, 600 steps", "16.22 s", digits(full, " s"), less(full, 16.22),
         "the matrix is factored once, by compiled kernels on another machine"),
        (f"reduced run, {chosen}", "0.097 s", digits(psd["time_online"], " s"), less(psd["time_online"], 0.097),
         "a step is one small product, everything else is done before"),
        ("reduced runs, all six methods and N", "0.097 to 0.101 s", _span(online, " s"),
         less(max(online, default=None), 0.101), "as above; N matters more here"),
        (f"speed-up, {chosen}", "167", f"{digits(again)} for the same model again, "
         f"{digits(speed['psd']['speedup_new_parameter'])} for a new parameter", less(-again, -167),
         "the full run is fast itself"),
        (f"error of {chosen}", "about 1e-3", errors, verdict(near),
         "hand mass and motion are not in the paper; in (q, p) the rigid motion hides the deformation"),
        *_method_rows(points, about, paper),
    ]  # fmt: skip


def _method_rows(points: dict[str, Any], about: dict[str, Any], paper: list[str]) -> list[Row]:
    stable = [about[name]["title"] for name, rows in points.items() if all(p["stable"] for p in rows)]
    energies = "; ".join(f"{about[name]['title']}: {about[name]['N_energy']}" for name in paper)
    return [
        (
            "N for 99.9 % of the energy",
            "99.9 % is used, N is not reported",
            energies,
            UNKNOWN,
            "of the snapshots of each method",
        ),
        _best(points, about, paper),
        _structure(points, paper),
        _flat(points["psd"]),
        (
            "stable at every N tried",
            "not reported",
            "; ".join(stable),
            UNKNOWN,
            "spectral abscissa of every reduced model",
        ),
    ]


def _best(points: dict[str, Any], about: dict[str, Any], names: list[str]) -> Row:
    errors = {name: at(points[name], N_FORWARD) for name in names if points.get(name)}
    stable = {name: e for name, e in errors.items() if e["stable"]} or errors
    best = min(stable, key=lambda name: stable[name]["error"])
    here = f"{about[best]['title']}: {digits(errors[best]['error'])}; PSD: "
    here += ", ".join(
        f"{digits(errors[name]['error'])} {label}"
        for name, label in (("psd", "without fixed solid modes"), ("psd_fixed", "with"))
        if name in errors
    )
    reason = "all errors in (q, v), where the velocities of canonical bases lose; N counts the hand's columns"
    same = verdict(best == "psd")
    return (f"best of the six methods, stable, N = {N_FORWARD}", "PSD without fixed solid modes", here, same, reason)


def _structure(points: dict[str, Any], names: list[str]) -> Row:
    errors = {name: at(points[name], N_FORWARD) for name in names}
    kept = {name: e for name, e in errors.items() if name not in PAPER_PLAIN}
    lost = {name: e for name, e in errors.items() if name in PAPER_PLAIN}
    texts = [
        f"{label}: " + ", ".join(f"{digits(e['error'])}{'' if e['stable'] else ' unstable'}" for e in group.values())
        for label, group in (("preserving", kept), ("not preserving", lost))
        if group
    ]
    return (
        f"errors of methods that the paper calls structure-preserving, N = {N_FORWARD}",
        "smaller than of those that do not",
        "; ".join(texts),
        verdict(max(map(_error, kept.values()), default=1.0) < min(map(_error, lost.values()), default=0.0)),
        "the paper does not report which of its models are unstable",
    )


def _flat(points: list[dict[str, Any]]) -> Row:
    near, last = at(points, N_FLAT), max(points, key=lambda p: p["N"])
    here = f"{digits(near['error'])} at N = {near['N']}, {digits(last['error'])} at N = {last['N']}"
    reason = "canonical momenta of a stable integrator: the singular values go on falling"
    same = BETTER if _error(last) < _error(near) / 2 else REPRODUCED
    return (f"PSD beyond N = {N_FLAT}", "no improvement", here, same, reason)


def control_rows(control: dict[str, Any]) -> list[Row]:
    """Sizes, times and errors of the control problem; every statement of the paper on it has a row."""
    seconds, reduced, states = control["time"]["are"], control["reduced"], control["states"]
    times = [p["time_are"] for name in (*FREE, *FIXED) for p in reduced.get(name, ()) if not p.get("reason")]
    first, best, away = at(reduced["pod"], N_RICCATI), control["loop"]["cost"], control["loop"]["distance_final"]
    gained = seconds / first["time_are"]
    rows: list[Row] = [
        ("states 2n", "880", str(states), verdict(states == 880), "the same"),
        ("full Riccati equation", "84.53 s", digits(seconds, " s"), less(seconds, 84.53), "of low rank; "
         "Kelvin-Voigt damping of 0.002 s, without which the problem is ill-posed in double precision"),
        ("reduced equations, five methods, all N", "0.051 to 0.057 s", _span(times, " s"),
         less(max(times, default=None), 0.057), "a direct solver"),
        (f"speed-up, POD of P, N = {first['N']}", "1600", digits(gained),
         less(-gained, -1600) if useful(first) else UNKNOWN,
         "the full equation is solved in low rank; both need P for the basis" if useful(first) else USELESS),
        ("target reached at T = 300, optimal gain", "yes", f"distance {digits(away)} m",
         verdict((away or 1.0) < NEAR), ""),
    ]  # fmt: skip
    for run in control["loop"].get("reduced", ()):
        named = run["method"] == "pod"
        end = (
            run["reason"] or f"distance {digits(run['distance_final'])} m, excess cost {digits(run['cost'] / best - 1)}"
        )
        name = f"target reached, {TITLES[run['method']]}, N = {run['N']}"
        same = verdict(not run["reason"]) if named else UNKNOWN
        rows.append(
            (name, "yes, N is not reported" if named else "not shown", end, same, "the stable gain of least cost")
        )
    for name, points in reduced.items():
        rows += basis_rows(name, at(points, N_RICCATI))
    return [*rows, _small(reduced)]


def useful(p: dict[str, Any]) -> bool:
    """Whether the P of a reduced equation has a right digit, so that its time may be compared."""
    return p["error_P"] is not None and p["error_P"] < 1


def basis_rows(name: str, p: dict[str, Any]) -> list[Row]:
    """Time, error of P, error of K and stability of one reduced equation, each with a verdict of its own."""
    title, five = f"{TITLES[name]}, N = {p['N']}", name in (*FREE, *FIXED)
    paper = "0.053 s" if name == "pod" else "0.051 to 0.057 s" if five else "not in the paper"
    time = less(p["time_are"], 0.051) if five and useful(p) else UNKNOWN
    why = "a direct solver for the small equation" if useful(p) else USELESS
    drawn, other = ("drawn up to 1 (Figure 5)", "not reported") if five else ("not in the paper",) * 2
    return [
        (f"{title}: time", paper, digits(p["time_are"], " s"), time, why),
        (f"{title}: error of P", drawn, digits(p["error_P"]), UNKNOWN, "damping and hand mass are chosen here"),
        (f"{title}: error of K", other, digits(p["error_K"]), UNKNOWN, "the gain is what a robot uses"),
        (f"{title}: full closed loop", other, "stable" if p["stable"] else "not stable", UNKNOWN, ""),
    ]


def _small(reduced: dict[str, Any]) -> Row:
    best = {
        label: min((at(reduced[n], N_RICCATI)["error_P"] or float("inf") for n in names if reduced.get(n)), default=0.0)
        for label, names in (("without", FREE), ("with", FIXED))
    }
    return (
        f"smallest error of P at N = {N_RICCATI}",
        "without fixed solid modes",
        ", ".join(f"{digits(value)} {label}" for label, value in best.items()),
        verdict(best["without"] < best["with"]),
        "with damping P has another decay than in the paper, whose damping and weights are not reported",
    )


def write_page(out: Path, results: dict[str, dict[str, Any]]) -> list[Path]:
    """paper.html and paper.json from the results of the three commands."""
    forward, control = forward_rows(results["forward"], results["reduce"]), control_rows(results["control"])
    forward += mesh_rows(results["forward"], results["accurate"])
    figures = [(out / name, text) for name, text in FIGURES if (out / name).exists()]
    page = Page(
        title="The paper, again",
        summary=[_count(forward + control), *_differ(forward + control)],
        subtitle="Shuva, Buchfink, Röhrle, Haasdonk: Reduced Basis Methods for Efficient Simulation of a Rigid Robot "
        "Hand Interacting with Soft Tissue (LSSC 2021). Numbers of the paper beside those of this run.",
        sections=[
            Section("", text="\n\n".join(ABOUT)),
            _table("Forward problem", forward),
            _table("Control problem", control),
            Section("Figures", figures=figures),
            Section("Pages behind it", text=PAGES),
        ],
        files=[out / name / "report.html" for name in ("forward", "accurate", "reduce", "control")],
        command="make paper",
        numbers="paper.json, and result.json in forward, accurate, reduce and control",
    )
    data = out / "paper.json"
    tables = {"forward": forward, "control": control}
    data.write_text(
        json.dumps({k: [dict(zip(HEADER, r, strict=True)) for r in v] for k, v in tables.items()}, indent=2)
    )
    return [write_report(out / "paper.html", page, files=page.files), data]


def _table(title: str, rows: list[Row]) -> Section:
    """The verdict beside the quantity, where a telephone shows it; rows with a verdict stay unfolded."""
    lines = [(name, same, paper, here, why) for name, paper, here, same, why in rows]
    header = ("quantity", "verdict", "paper", "here", "why different")
    return Section(title, header=header, rows=lines, best=[i for i, row in enumerate(rows) if row[3]])


def _count(rows: list[Row]) -> str:
    count = {word: sum(row[3] == word for row in rows) for word in (REPRODUCED, BETTER, DIFFERS)}
    return (
        f"Of the statements of the paper {count[REPRODUCED]} are reproduced, {count[BETTER]} numbers are better here, "
        f"and {count[DIFFERS]} differ, each with its reason."
    )


def _differ(rows: list[Row]) -> list[str]:
    names = [row[0] for row in rows if row[3] == DIFFERS]
    return [f"What differs: {'; '.join(names)}."] if names else []


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="folder for all results and paper.html")] = Path("out/paper"),
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> None:
    """Reproduce every figure and table of the paper."""
    console, scenes = Console(highlight=False), shipped_scenes()
    results = {
        "forward": run_simulate(scenes["paper_forward"], out / "forward", [], console, quiet=quiet),
        "accurate": run_simulate(scenes["paper_accurate"], out / "accurate", [], console, quiet=quiet),
        "reduce": run_reduce(scenes["paper_forward"], out / "reduce", [], console, quiet=quiet),
        "control": run_control(scenes["paper_lqr"], out / "control", [], console, quiet=quiet),
    }
    for file in write_page(out, results):
        console.print(f"  {file}", soft_wrap=True)


if __name__ == "__main__":
    app()
