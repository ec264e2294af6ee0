"""`softgrasp reduce`: which points its tables name, and the mesh study beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from softgrasp.reduction.bases.registry import METHODS, PAPER_METHODS
from softgrasp.study.reduce.linear.measure import FURTHER, chosen_methods, speed_notes
from softgrasp.study.reduce.linear.page import error_table, findings, least_size, stability
from softgrasp.study.reduce.linear.plots import best_beyond
from softgrasp.study.reduce.linear.result import MethodSweep, Point, best, kept_points, nearest
from softgrasp.study.reduce.times import FullTimes
from softgrasp.study.report.document import cell_text
from tests.helpers.models import make_scene

PAPER = Path(__file__).parents[3] / "demos" / "scenes" / "paper_forward.toml"


def test_scene_chooses_methods() -> None:
    assert chosen_methods(make_scene()) == (*PAPER_METHODS, *FURTHER)
    assert chosen_methods(make_scene(reduction={"methods": ["psd_qv"]})) == ("psd_qv",)


def point(N: int, error: float, stable: bool = True, online: float = 1e-3) -> Point:
    return Point(N, N, (N,), error, *(5 * [2 * error]), 2.0, 1e-3, online, 0.0 if stable else 1.0, stable)


def test_the_first_figure_has_craig_bampton_and_svd_like_beside_the_papers_six() -> None:
    sweeps = [MethodSweep(METHODS[key], (point(14, 0.1),), {}, ()) for key in (*PAPER_METHODS, *FURTHER)]
    assert {s.method.key for s in best_beyond(sweeps)} == {"craig_bampton", "psd_svd_like"}


def test_choice_of_points() -> None:
    points = [point(4, 1e-1), point(12, 1e-3), point(14, 1e-9, stable=False), point(30, float("nan")), point(40, 1e-4)]
    assert nearest(points) is points[1]
    assert nearest(points, stable=False) is points[2]
    assert best(points) is points[4]
    assert kept_points(points) == {12, 14, 30, 40}  # nearest to 14, all and stable, nearest to 30, best
    assert least_size(points, 1e-2) == 12
    assert least_size(points, 1e-6) is None  # an unstable model does not count
    assert stability(swept_of("psd", *points)) == "not 14"
    assert nearest([]) is None


def test_times_of_the_paper_stand_beside_runs_of_its_size_only() -> None:
    swept, full = [swept_of("psd", point(14, 0.1))], FullTimes(0.1, 0.2)
    assert "a speed-up of 167; here the same comparison" in speed_notes(956, 600, full, swept)[-1]
    assert [len(speed_notes(*sizes, full, swept)) for sizes in ((956, 600), (956, 300), (36, 600))] == [3, 2, 2]


def swept_of(key: str, *points: Point) -> MethodSweep:
    return MethodSweep(METHODS[key], points, {}, ())


def test_findings_name_the_unstable_and_what_structure_costs() -> None:
    swept = [
        swept_of("componentwise_pod", point(6, 4e-2), point(14, 1e-2), point(30, 1e-1, stable=False)),
        swept_of("psd", point(6, 2e-2), point(14, 4e-2), point(30, 3e-2)),
        swept_of("psd_fixed", point(6, 5e-2), point(14, 3e-2), point(30, 4e-2)),
    ]
    assert findings(swept) == (
        "Of the 6 models that keep the structure, none is unstable.",
        "Of the 3 models that do not keep the structure, one is unstable: componentwise POD at N = 30.",
        "At N = 14 the least error of the deformation of a stable model is 3 % with structure (PSD complex SVD, fixed) "
        "and 1 % without (componentwise POD): structure raises it by a factor of 3.0.",
    )
    assert len(findings([swept_of("craig_bampton", point(8, 1e-2), point(10, 2e-2))])) == 1  # nothing without structure
    assert findings([]) == ()


def test_table_shows_the_deformation_first_and_the_split() -> None:
    split = replace(point(14, 1e-2), N_tissue=10, split=(5, 5))
    sweep = swept_of("componentwise_pod_fixed", point(6, 0.2), split, point(30, 1e-3, stable=False))
    table = error_table([sweep], 0.999)
    assert dict(zip(table.header, *table.rows, strict=True)) == {
        "method": "componentwise POD, fixed", "99.9 %": "-", "N": "14", "V_e": "5+5", "deform.": 0.01,
        "state": 0.02, "energy": 0.02, "to 10 %": 14, "to 1 %": 14, "to 0.1 %": "-", "stable N": "not 30",
    }  # fmt: skip
    assert [cell_text(cell) for cell in table.rows[0][4:7]] == ["1 %", "2 %", "2 %"]  # the numbers stay whole
