"""The page that compares with the paper, from results as the commands return them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from demos.paper import at, digits, write_page
from tests.helpers.browser import words_of

POINT = {"N": 14, "error": 1e-3, "error_canonical": 1e-2, "error_deformation": 0.1, "time_online": 2e-4, "stable": True}
REDUCED = {"N": 8, "time_are": 4e-4, "error_P": None, "error_K": 0.1, "stable": False, "reason": ""}
ROOT = Path(__file__).parents[1]


def about(title: str, preserving: bool) -> dict[str, Any]:
    return {"title": title, "structure_preserving": preserving, "N_energy": 5}


@pytest.fixture
def results() -> dict[str, dict[str, Any]]:
    """As the three commands return them, cut to what the page reads."""
    methods = {
        "global_pod": [POINT | {"error": 0.5, "time_online": 3e-4, "stable": False}],
        "psd": [POINT, POINT | {"N": 40, "error": 1e-5, "stable": False}],
        "psd_fixed": [POINT | {"error": 2e-3}],
    }
    titles = {"global_pod": about("global POD", False), "psd": about("PSD", True), "psd_fixed": about("PSD, f", True)}
    run = {"method": "pod", "N": 16, "distance_final": 2e-4, "cost": 11.0, "reason": ""}
    return {
        "forward": {
            "states": 1916,
            "time": {"factor": 0.002, "steps": 0.04},
            "mesh_error": {"estimate": 0.4, "bound": 0.6, "n_e": 956},
        },
        "accurate": {
            "time": {"factor": 0.02, "steps": 0.3},
            "mesh_error": {"estimate": 4e-4, "bound": 8.8e-4, "n_e": 4704},
        },
        "reduce": {
            "methods": methods,
            "about": titles,
            "speed": [{"method": "psd", "speedup_same_model": 200.0, "speedup_new_parameter": 100.0}],
        },
        "control": {
            "states": 880,
            "time": {"are": 0.2},
            "loop": {"distance_final": 1e-4, "cost": 10.0, "reduced": [run, run | {"reason": "not stable"}]},
            "reduced": {"pod": [REDUCED], "pod_decomposed": [REDUCED | {"error_P": 0.25, "stable": True}]},
        },
    }


@pytest.mark.serial
def test_page_has_every_row(tmp_path: Path, results: dict[str, dict[str, Any]]) -> None:
    page, data = write_page(tmp_path, results)
    found = json.loads(data.read_text())
    forward = {row["quantity"]: row["here"] for row in found["forward"]}
    assert forward["stable at every N tried"] == "PSD, f"
    mesh = "error of the deformation through the mesh"
    assert forward[mesh] == "about 40 % (bound 60 %) at n_e = 956 in 0.042 s"
    assert forward["the same, scene paper_accurate"] == "about 0.04 % (bound 0.088 %) at n_e = 4704 in 0.32 s"
    assert forward["reduced runs, all six methods and N"] == "0.0002 to 0.0003 s"
    assert forward["errors of methods that the paper calls structure-preserving, N = 14"] == (
        "preserving: 0.001, 0.002; not preserving: 0.5 unstable"
    )
    assert forward["best of the six methods, stable, N = 14"] == (
        "PSD: 0.001; PSD: 0.001 without fixed solid modes, 0.002 with"
    )
    assert forward["PSD beyond N = 25"] == "0.001 at N = 14, 1e-05 at N = 40"
    control = {row["quantity"]: row["here"] for row in found["control"]}
    assert control["POD of P, N = 8: time"] == "0.0004 s"
    assert control["POD of P, N = 8: error of P"] == "not finite"
    assert control["POD of P, N = 8: full closed loop"] == "not stable"
    assert control["speed-up, POD of P, N = 8"] == "500"
    assert control["target reached, POD of P, N = 16"] in ("distance 0.0002 m, excess cost 0.1", "not stable")
    assert control["smallest error of P at N = 8"] == "inf without, 0.25 with"
    verdicts = {row["quantity"]: row["verdict"] for rows in found.values() for row in rows}
    assert verdicts["full run, 600 steps"] == "better"
    assert verdicts["speed-up, PSD, N = 14"] == "better"
    assert verdicts["speed-up, POD of P, N = 8"] == ""  # of a P that is not finite
    assert verdicts["best of the six methods, stable, N = 14"] == "reproduced"
    assert verdicts["smallest error of P at N = 8"] == "differs"
    # a time is compared only where the equation's answer has a right digit, and no error is called better for it
    times = {name: verdict for name, verdict in verdicts.items() if name.endswith(": time")}
    assert list(times.values()) == ["", "better"]
    assert {verdict for name, verdict in verdicts.items() if ": error of" in name} == {""}
    assert not re.search(r"\btold\b|\btell", data.read_text())
    text = words_of(page)
    # every number that the paper states on its results
    for words in (
        "16.22 s",
        "84.53 s",
        "167",
        "1600",
        "0.097 to 0.101 s",
        "0.051 to 0.057 s",
        "0.053 s",
        "1916",
        "880",
    ):
        assert words in text
    assert "Made with" in text


@pytest.mark.serial
def test_every_reference_is_cited_and_every_citation_is_listed() -> None:
    listed = set(re.findall(r"^- \*\*\[?(\w+)\]?\*\*", (ROOT / "REFERENCES.md").read_text(), re.MULTILINE))
    places = [
        path for package in ("fem", "reduction", "lqr", "study", "tests") for path in (ROOT / package).rglob("*.py")
    ]
    places += [*(ROOT / "demos").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    text = "\n".join(path.read_text() for path in places if path != Path(__file__))
    cited = set(re.findall(r"\[([A-Z][A-Za-z]*\d{2,4}[a-z]?)\]", text))
    assert cited <= listed
    assert [key for key in listed if key not in text] == []


def test_nearest_point_and_numbers() -> None:
    assert at([{"N": 4}, {"N": 10}, {"N": 12}], 8)["N"] == 10
    assert digits(None) == "not finite"
    assert digits(0.12345, " s") == "0.123 s"
