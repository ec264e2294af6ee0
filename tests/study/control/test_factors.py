"""How often ``softgrasp control`` factors the matrices of a plant that does not keep all modes, and what it frees."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.fem.solve import solvers
from softgrasp.lqr.design.orders import course_of, with_bounds
from softgrasp.study.control import run

KEYS = ["tissue.cells=[8,16]", "control.N=[8,12]", "output.fields='none'"]


@pytest.mark.serial
@pytest.mark.parametrize("more", [[], ["effects.gravity={g=[0.0,-1.0]}"]], ids=["free", "weight"])
def test_all_gains_share_one_factor_of_each_matrix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str]
) -> None:
    made, studies = Counter[str](), list[Any]()
    real = solvers.make_solver

    def counted(S: Any, name: Any, layout: Any, prefix: str, *given: Any, **named: Any) -> Any:
        made[prefix] += 1
        return real(S, name, layout, prefix, *given, **named)

    for module in ("fem.run.midpoint", "fem.solve.stiffness", "lqr.spectrum.certificate"):
        monkeypatch.setattr(f"softgrasp.{module}.make_solver", counted)
    whole = run.loop_study
    monkeypatch.setattr(run, "loop_study", lambda *given: studies.append(whole(*given)) or studies[0])
    run.run_control(
        shipped_scenes()["paper_lqr"], tmp_path, [*KEYS, *more], Console(quiet=True), quiet=True, pictures=False
    )
    assert made == {"softgrasp_stiffness_": 1, "softgrasp_spectrum_": 1, "softgrasp_midpoint_": 1}
    study = studies[0][0]
    feedback, plan = study.design, study.loops.plan
    assert not feedback.gain_check.loop.complete  # certificates need eigenvalues of the full plant
    layers = feedback.problem.system.layers
    assert not any(A.ee.handle for x in layers for A in (x.K_mu, x.K_lambda, x.M_1))  # freed, as nothing is re-tuned
    reports = [report for basis in study.bases for report in basis.reports]
    again = with_bounds(feedback.problem, feedback.solution, reports, course_of(feedback, plan))  # by another factor
    bounds = [[report.cost_excess_proved for report in each] for each in (reports, again)]
    np.testing.assert_array_equal(*bounds)
