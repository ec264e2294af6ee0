"""Every demo runs, on one rank and two, and so does the Python of the README."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

pytestmark = pytest.mark.ranks(2)

ROOT = Path(__file__).parents[1]
DEMOS = sorted((ROOT / "demos").glob("demo_*.py"))
LONG = ("demo_own_basis", "demo_certified", "demo_finite_strain", "demo_arm", "demo_contact")  # 3 to 11 s on one rank


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LONG), id=p.stem) for p in DEMOS]
)
def test_demo(path: Path, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without figures, which cost more than the rest; `make docs` and tests/test_shown.py draw them."""
    monkeypatch.setattr("softgrasp.fem.run.states.trajectory.drawn", lambda *of: None)
    monkeypatch.chdir(mpi_tmp_path)
    runpy.run_path(str(path), run_name="__main__")


def test_there_are_demos() -> None:
    assert len(DEMOS) >= 3


def test_python_of_the_readme(mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    monkeypatch.chdir(ROOT)  # the README speaks from the root of the checkout
    for block in blocks:
        exec(compile(block.replace('"out', f'"{mpi_tmp_path}/out'), "README.md", "exec"), {"__name__": "__main__"})
