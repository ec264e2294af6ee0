"""Draw the rooms of the source and what they import from one another: ``python tools/draw_rooms.py docs/rooms.png``.

Lines and heights come from the import contracts in pyproject.toml, arrows from the imports themselves; an arrow that
points up would be red.
"""

from __future__ import annotations

import sys
import tomllib
from collections import Counter
from pathlib import Path

import grimp
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).parents[1]
PACKAGES = ("fem", "reduction", "lqr", "study")
COLOURS = {"fem": "#dcebf7", "reduction": "#e2f2e4", "lqr": "#fdeeda", "study": "#efe6f5"}
WIDTH, HEIGHT, GAP, BESIDE = 1.7, 1.15, 0.4, 0.25


def lines_of(package: str) -> list[list[str]]:
    """Rooms by line, the highest first, as the contracts have them."""
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]:
        if contract.get("containers") == [f"softgrasp.{package}"]:
            return [[room.strip() for room in line.split("|")] for line in contract["layers"]]
    raise ValueError(f"pyproject.toml has no contract with the rooms of {package}")


def room_of(module: str) -> tuple[str, str]:
    """Package and room of a module."""
    _, package, *rest = module.split(".")
    return package, rest[0] if rest else ""


def arrows(graph: grimp.ImportGraph) -> Counter[tuple[tuple[str, str], tuple[str, str]]]:
    """Number of imports from one room to another."""
    count: Counter[tuple[tuple[str, str], tuple[str, str]]] = Counter()
    for module in graph.modules:
        if module.count(".") < 2:
            continue
        for target in graph.find_modules_directly_imported_by(module):
            if target.count(".") >= 2 and room_of(target) != room_of(module):
                count[room_of(module), room_of(target)] += 1
    return count


def place(
    axes: Axes, package: str, top: float, wide: float
) -> tuple[dict[tuple[str, str], tuple[float, float]], float]:
    """Boxes of one package; where they are, and its lower edge."""
    lines, at = lines_of(package), {}
    height = len(lines) * (HEIGHT + GAP) + 0.5
    axes.add_patch(
        FancyBboxPatch(
            (0.05, top - height), wide - 0.1, height, "round,pad=0.02", fc=COLOURS[package], ec="none", zorder=0
        )
    )
    axes.text(0.2, top - 0.12, package + "/", va="top", weight="bold", size=10)
    for i, line in enumerate(lines):
        y = top - 0.5 - i * (HEIGHT + GAP) - HEIGHT / 2
        for j, room in enumerate(line):
            x = wide / 2 + (j - (len(line) - 1) / 2) * (WIDTH + BESIDE)
            at[package, room] = x, y
            files = list((ROOT / package / room).rglob("*.py")) if (ROOT / package / room).is_dir() else []
            axes.add_patch(
                FancyBboxPatch(
                    (x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, "round,pad=0.02", fc="white", ec="#555", lw=0.8
                )
            )
            text = f"{room}\n{len(files)} files" if files else room
            axes.text(x, y, text, ha="center", va="center", size=7.5)
    return at, top - height - 0.25


def main(file: Path) -> None:
    """Draw and save."""
    figure, axes = plt.subplots(figsize=(9, 21))
    wide = max(len(line) for package in PACKAGES for line in lines_of(package)) * (WIDTH + BESIDE) + BESIDE
    at: dict[tuple[str, str], tuple[float, float]] = {}
    top = 0.0
    for package in reversed(PACKAGES):
        boxes, top = place(axes, package, top, wide)
        at |= boxes
    for (source, target), count in sorted(arrows(grimp.build_graph("softgrasp")).items()):
        if source[0] != target[0] or source not in at or target not in at:
            continue  # packages point down as the picture stands: study, lqr, reduction, fem
        (x, y), (u, v) = at[source], at[target]
        axes.add_patch(
            FancyArrowPatch(
                (x, y - HEIGHT / 2), (u, v + HEIGHT / 2), arrowstyle="-|>", mutation_scale=7,
                connectionstyle="arc3,rad=0.12", lw=0.5 + 0.12 * min(count, 12),
                color="#c0392b" if v > y else "#7a8a99", alpha=0.75, zorder=0.5,
            )
        )  # fmt: skip
    axes.set_xlim(0, wide)
    axes.set_ylim(top, 0.1)
    axes.set_axis_off()
    figure.savefig(file, dpi=90, bbox_inches="tight")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
