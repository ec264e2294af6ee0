"""A basis of one's own in the comparison of `softgrasp reduce`."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from softgrasp.study.cli import app

EXAMPLE = Path(__file__).parents[3] / "demos" / "static_responses.py"


@pytest.mark.serial
def test_reduce_compares_it_with_the_others(tmp_path: Path) -> None:
    keys = [f"reduction.plugins=['{EXAMPLE}']", "reduction.methods=['static_responses', 'craig_bampton']",
            "reduction.N=[14]", "reduction.train=[]", "reduction.validation=0", "tissue.cells=[4, 8]",
            "time.steps=100"]  # fmt: skip
    words = ["reduce", "paper_forward", "--no-pictures", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*words, *(word for key in keys for word in ("-s", key))])
    assert result.exit_code == 0, result.output
    assert "static responses" in (tmp_path / "out" / "report.html").read_text()
    assert (tmp_path / "out" / "models" / "static_responses.h5").exists()
