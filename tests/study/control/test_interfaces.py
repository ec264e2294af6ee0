"""Systems for python-control and pyMOR from files that the commands wrote, against the full model."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse.linalg
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.lqr.loop.margins import loop_margins
from softgrasp.study.control.plots import bode
from softgrasp.study.control.run import run_control
from softgrasp.study.pictures.style import save
from softgrasp.study.reduce.run import run_reduce

pytestmark = pytest.mark.serial
CELLS = "tissue.cells=[4,8]"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What small runs of `reduce` and `control` leave."""
    out, quiet = tmp_path_factory.mktemp("commands"), Console(quiet=True)
    changes = [CELLS, "time.steps=200", "reduction.methods=['craig_bampton']", "reduction.N=[24]", "reduction.train=[]"]
    run_reduce(shipped_scenes()["paper_forward"], out / "reduce", changes, quiet, quiet=True, pictures=False)
    changes = [CELLS, "control.N=[8,12]", "control.loop.limit=[9.0,7.0]"]
    run_control(shipped_scenes()["paper_lqr"], out / "control", changes, quiet, quiet=True, pictures=False)
    return out


def full_response(name: str, s: float) -> np.ndarray:
    """y / u of the whole plant at a real s: the hand moves as M_hand s^2 q_s = u, the tissue follows."""
    model = sg.build(name, [CELLS])
    system = model.system
    M, K = (to_scipy(A) for A in (system.M_ee, system.K_ee))
    damping = system.damping.alpha * M + system.damping.beta * K
    q = np.linalg.inv(system.M_hand) / s**2
    z = scipy.sparse.linalg.spsolve((s**2 * M + s * damping + K).tocsc(), -(s**2) * system.G @ q)
    (tip, *_) = make_outputs(model.scene, system)
    return np.asarray(tip.C_s @ q + tip.weight * z[tip.dofs].sum(axis=0))


def check(system: ReducedSystem, name: str, tolerance: float) -> None:
    """The same numbers from the file, python-control, pyMOR and the full model."""
    assert system.inputs == ("force_x [N]", "force_y [N]")
    assert all(output.endswith(" [m]") for output in system.outputs)
    theirs, pymors = system.to_control(), system.to_pymor()
    for s in (0.5, 2.0, 6.0):
        ours = system.transfer([s])[0]
        np.testing.assert_allclose(theirs(s), ours, rtol=1e-8)  # one solve more, of a small well conditioned E
        np.testing.assert_allclose(pymors.transfer_function.eval_tf(s), ours, rtol=1e-8)
        whole = full_response(name, s)
        assert np.linalg.norm(ours - whole) < tolerance * np.linalg.norm(whole)


def test_reduced_model_from_its_file(files: Path) -> None:
    rom = sg.load(files / "reduce" / "models" / "craig_bampton.h5")
    check(rom.at(), "paper_forward", 5e-3)  # N = 24; 2e-3 at s = 6, above the lowest frequency
    stiff = rom.at(tuple(m.__class__(m.lam, 2 * m.mu, m.rho, m.beta) for m in rom.materials))
    assert not np.allclose(stiff.transfer([2.0]), rom.at().transfer([2.0]), rtol=1e-3)
    with (files / "reduce" / "points.csv").open() as file:
        assert "time_online [s]" in next(csv.reader(file))


def test_controller_from_its_file(files: Path) -> None:
    controller = sg.Controller.load(files / "control" / "controller.npz")
    assert controller.limits is not None
    assert controller.limits.tolist() == [9.0, 7.0]
    check(controller.plant, "paper_lqr", 0.05)  # a few modes
    closed = controller.plant.under(controller.K).to_control()
    assert closed.poles().real.max() < 0
    told = json.loads((files / "control" / "result.json").read_text())["controller"]["margins"]
    margins = loop_margins(controller)
    assert told["distance"] == pytest.approx(margins.distance, rel=1e-12)
    assert [axis["phase"] for axis in told["axes"]] == pytest.approx([axis.phase for axis in margins.axes], rel=1e-12)
    assert 0.9 < margins.distance < 1.01  # the guarantee of LQR, which reduction and ticks of 1 ms hardly touch
    (picture, *_) = save(bode(margins), files / "bode.png")
    assert picture.stat().st_size > 5000
    assert "Margins of the small controller" in (files / "control" / "report.html").read_text()
