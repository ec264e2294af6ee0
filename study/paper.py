"""Every figure and table of the paper again, and a page that says what the paper has, what comes out here, and why.

``python -m study.paper --out out/paper``: forward run, all bases, Riccati equation and closed loop [SBRH21].
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from fem import _stack as _stack
from fem.results import package_version
from fem.scene_file import shipped_scenes
from study.control import run_control
from study.reduce import run_reduce
from study.report import Section, write_report
from study.simulate import run_simulate

Row = tuple[str, str, str, str]
HEADER = ("quantity", "paper", "here", "why different")
N_FORWARD, N_RICCATI = 14, 8  # the paper's examples
FIGURES = {
    "2": ("forward/move.png", "Figure 2: forward simulation of the coupled problem."),
    "2b": ("reduce/compare.png", "Figure 2: the reduced motion against the full one."),
    "3": ("reduce/errors.png", "Figure 3: error of the reduced solutions against N, all six methods."),
    "4": ("control/move.png", "Figure 4: the closed loop moves the body to its target."),
    "5": (
        "control/errors.png",
        "Figure 5: error of the reduced Riccati solution against N, five methods and ours.",
    ),
}

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def at(points: list[dict[str, Any]], N: int) -> dict[str, Any]:
    """The point whose N is nearest to the one wanted. Not collective."""
    return min(points, key=lambda p: (abs(p["N"] - N), p["N"]))


def number(value: float | None, unit: str = "") -> str:
    """Three digits; null in JSON stands for a number that is not finite."""
    return "not finite" if value is None else f"{value:.3g}{unit}"


def forward_rows(forward: dict[str, Any], reduced: dict[str, Any]) -> list[Row]:
    """Sizes, errors and times of the forward problem."""
    points = reduced["methods"]
    psd, speed = at(points["psd"], N_FORWARD), {row["method"]: row for row in reduced["speed"]}
    full = forward["time"]["factor"] + forward["time"]["steps"]
    stable = [name for name, rows in points.items() if all(p["stable"] for p in rows)]
    return [
        ("states 2n", "1916", str(forward["states"]), "the same mesh, contact zone and elements"),
        (
            "full run, 600 steps",
            "16.22 s",
            number(full, " s"),
            "factored once, compiled kernels, another machine",
        ),
        (
            f"reduced run, PSD, N = {psd['N']}",
            "0.097 s",
            number(psd["time_online"], " s"),
            "one small product a step, everything else done before",
        ),
        ("speed-up", "167", number(speed["psd"]["speedup"]), "against a full run that is fast itself"),
        (
            f"error of PSD, N = {psd['N']}",
            "about 1e-3",
            f"{number(psd['error'])} in (q, p), {number(psd['error_qv'])} in (q, v)",
            "hand mass and motion are not in the paper; velocities weigh more than displacements",
        ),
        (
            "best method",
            "PSD without fixed solid modes",
            min(("psd", "psd_fixed"), key=lambda k: at(points[k], N_FORWARD)["error"]) + " of the two",
            "in the fixed form N counts the tissue only",
        ),
        ("stable at every N tried", "not told", ", ".join(stable), "spectral abscissa of every reduced model"),
    ]


def control_rows(control: dict[str, Any]) -> list[Row]:
    """Sizes, times and errors of the control problem."""
    seconds = control["time"]["are"]
    rows: list[Row] = [
        ("states 2n", "880", str(control["states"]), "the same"),
        (
            "full Riccati equation",
            "84.53 s",
            number(seconds, " s"),
            "low rank; and Kelvin-Voigt damping 0.002 s, without which the problem is ill-posed in double precision",
        ),
        ("target reached at T = 300", "yes", f"{number(control['loop']['distance_final'])} m off", ""),
    ]
    for name, points in control["reduced"].items():
        p = at(points, N_RICCATI)
        rows.append(
            (
                f"{name}, N = {p['N']}",
                "0.053 s" if name == "pod" else "0.051 to 0.057 s",
                f"{number(p['time_are'], ' s')}; error of P {number(p['error_P'])}, of K {number(p['error_K'])}, "
                + ("stable" if p["stable"] else "not stable"),
                "a direct solver for the small equation; damping and hand mass are ours",
            )
        )
    return rows


def write_page(out: Path, results: dict[str, dict[str, Any]]) -> list[Path]:
    """paper.html and paper.json from the results of the three commands. Not collective.

    Raises:
        OSError: a file cannot be written.
    """
    forward, control = forward_rows(results["forward"], results["reduce"]), control_rows(results["control"])
    figures = [(out / name, text) for name, text in FIGURES.values() if (out / name).exists()]
    page = write_report(
        out / "paper.html",
        title="The paper, again",
        subtitle="Shuva, Buchfink, Röhrle, Haasdonk: Reduced Basis Methods for Efficient Simulation of a Rigid Robot "
        "Hand Interacting with Soft Tissue (LSSC 2021). Numbers of the paper beside those of this run.",
        sections=[
            Section("Forward problem", header=HEADER, rows=forward),
            Section("Control problem", header=HEADER, rows=control),
            Section("Figures", figures=figures),
            Section("Made with", rows=[("softgrasp", package_version()), ("machine", results["forward"]["machine"])]),
        ],
        reproduce="make paper",
    )
    data = out / "paper.json"
    tables = {"forward": forward, "control": control}
    data.write_text(
        json.dumps({k: [dict(zip(HEADER, r, strict=True)) for r in v] for k, v in tables.items()}, indent=2)
    )
    return [page, data]


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="folder for all results and paper.html")] = Path("out/paper"),
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> None:
    """Reproduce every figure and table of the paper."""
    console, scenes = Console(highlight=False), shipped_scenes()
    results = {
        "forward": run_simulate(scenes["paper_forward"], out / "forward", [], console, quiet=quiet),
        "reduce": run_reduce(scenes["paper_forward"], out / "reduce", [], console, quiet=quiet),
        "control": run_control(scenes["paper_lqr"], out / "control", [], console, quiet=quiet),
    }
    for file in write_page(out, results):
        console.print(f"  {file}", soft_wrap=True)


if __name__ == "__main__":
    app()
