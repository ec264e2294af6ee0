"""Badges of the README, from what the project states of itself: ``python -m tools.draw_badges``."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "badges"
LETTER = 6.6  # width of a letter of 11 px in a monospaced face, which every renderer measures alike [px]
SVG = """<svg xmlns="http://www.w3.org/2000/svg" width="{all}" height="20" role="img" aria-label="{left}: {right}">
<rect width="{all}" height="20" rx="3" fill="#40566b"/>
<path d="M{split} 0h{rest}a3 3 0 0 1 3 3v14a3 3 0 0 1-3 3h-{rest}z" fill="#2b7bba"/>
<g fill="#fff" font-family="DejaVu Sans Mono,Menlo,Consolas,monospace" font-size="11">
<text x="6" y="14" textLength="{a}">{left}</text>
<text x="{start}" y="14" textLength="{b}">{right}</text>
</g>
</svg>
"""


def facts() -> dict[str, str]:
    """What the badges say, by name: of pyproject.toml and the version of the code."""
    from softgrasp import __version__

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    solver = project["optional-dependencies"]["solver"][0].partition(">=")[2].partition(",")[0]
    python = project["requires-python"].removeprefix(">=")
    return {
        "version": __version__, "license": project["license"], "python": f"{python}+", "dolfinx": solver,
    }  # fmt: skip


def badge(left: str, right: str) -> str:
    """The picture of a name and its value, in SVG."""
    a, b = (round(LETTER * len(text)) for text in (left, right))
    split = a + 12
    return SVG.format(all=split + b + 12, left=left, right=right, split=split, rest=b + 9, a=a, start=split + 6, b=b)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, value in facts().items():
        (FOLDER / f"{name}.svg").write_text(badge(name, value))
