"""The page that compares with the paper, from results as the commands return them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from study.paper import at, number, write_page

POINT = {"N": 14, "error": 1e-3, "error_qv": 1e-2, "time_online": 2e-4, "stable": True}
REDUCED = {"N": 8, "time_are": 3e-4, "error_P": None, "error_K": 0.1, "stable": False}


@pytest.mark.serial
def test_page_has_every_row(tmp_path: Path) -> None:
    methods = {"psd": [POINT, POINT | {"N": 40, "stable": False}], "psd_fixed": [POINT | {"error": 2e-3}]}
    results = {
        "forward": {"states": 1916, "time": {"factor": 0.002, "steps": 0.04}, "machine": "m"},
        "reduce": {"methods": methods, "speed": [{"method": "psd", "speedup": 200.0}]},
        "control": {
            "states": 880,
            "time": {"are": 0.2},
            "loop": {"distance_final": 1e-4},
            "reduced": {"pod": [REDUCED], "structured": [REDUCED | {"stable": True}]},
        },
    }
    page, data = write_page(tmp_path, results)
    rows = json.loads(data.read_text())
    assert {row["quantity"]: row["here"] for row in rows["forward"]}["stable at every N tried"] == "psd_fixed"
    assert "not finite" in rows["control"][3]["here"]
    assert "not stable" in rows["control"][3]["here"]
    text = page.read_text()
    for words in ("16.22 s", "84.53 s", "167", "0.053 s", "1916", "880"):
        assert words in text


def test_nearest_point_and_numbers() -> None:
    assert at([{"N": 4}, {"N": 10}, {"N": 12}], 8)["N"] == 10
    assert number(None) == "not finite"
    assert number(0.12345, " s") == "0.123 s"
