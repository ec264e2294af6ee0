"""``softgrasp export``: files for a linear reduced model, one sentence for all else."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from typer.testing import CliRunner

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.study.cli import app

SMALL = ["tissue.cells=[3, 6]", "time.steps=60", "effects.damping={kind='kelvin-voigt',beta=0.01}"]


def export(*words: object) -> str:
    result = CliRunner().invoke(app, ["export", *map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.output


def test_a_saved_model_becomes_c(tmp_path: Path) -> None:
    """The files of the guide, a warning where the basis keeps no structure, and no folder without a door."""
    model = sg.build("paper_forward", SMALL)
    run, file, folder = sg.simulate(model), tmp_path / "rom.h5", tmp_path / "plant"
    sg.save(sg.reduce(model, run, "craig_bampton", N=10), file)
    with pytest.raises(SceneError, match="name what to write: --c FOLDER, --fmu FILE or --mujoco FILE"):
        export(file)
    with pytest.raises(SceneError, match=r"name it plant\.fmu"):
        export(file, "--c", folder, "--fmu", tmp_path / "plant.zip")
    assert not folder.exists()
    output = export(file, "--c", folder, "--fmu", tmp_path / "plant.fmu", "--tick", 2e-3)
    assert zipfile.is_zipfile(tmp_path / "plant.fmu")
    assert "craig_bampton, N = 10, a tick of 0.002 s" in output
    assert "warning" not in output
    assert {"Makefile", "golden.log", "plant.c", "plant.h", "plant_data.h"} < {path.name for path in folder.iterdir()}
    assert f"SG_PLANT_TICK {(2e-3).hex()}" in (folder / "plant_size.h").read_text()
    sg.save(sg.reduce(model, run, "pod_fixed", N=8), file)
    assert "unstable with other materials" in " ".join(export(file, "--c", folder).split())


def test_a_controller_becomes_c_and_an_fmu(tmp_path: Path) -> None:
    model = sg.build("paper_lqr", ["tissue.cells=[2, 4]"])
    sg.make_controller(sg.design(model), order=8).save(tmp_path / "controller.npz")
    output = export(tmp_path / "controller.npz", "--c", tmp_path / "robot", "--fmu", tmp_path / "robot.fmu")
    assert zipfile.is_zipfile(tmp_path / "robot.fmu")
    assert "no observer" in output
    assert (tmp_path / "robot" / "controller.c").exists()


def test_finite_strain_is_refused(tmp_path: Path) -> None:
    model = sg.build("paper_forward", ["tissue.cells=[2, 4]", "time.steps=20", "effects.finite_strain={}"])
    file = tmp_path / "strain.h5"
    sg.save(sg.reduce(model, sg.simulate(model), N=6), file)
    with pytest.raises(SceneError, match=r"strain\.h5: only linear reduced models are exported"):
        export(file, "--c", tmp_path / "plant")
    assert not (tmp_path / "plant").exists()


def test_nothing_of_it_is_loaded_unless_it_is_used() -> None:
    """Models, gains and the commands need neither the writers nor a simulator."""
    code = (
        "import sys, softgrasp as sg; import softgrasp.study.cli; sg.reduce, sg.save, sg.design, sg.Controller; "
        "print([name for name in sys.modules if name.endswith(('reduction.export', 'lqr.export')) or name == 'fmpy'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_model_in_the_frame_of_the_hand_becomes_a_body_for_mujoco(tmp_path: Path) -> None:
    """Its masses are those of hand and tissue; a model of small angles has none of its integrals."""
    model = sg.build(
        "block_3d", tissue={"cells": [1, 1, 2], "order": 1, "refine": False}, output={"snapshots": "memory"},
        effects={"rotation": True, "frame": "hand"}, time={"steps": 20},
    )  # fmt: skip
    file, xml = tmp_path / "rom.h5", tmp_path / "hand.xml"
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=16)
    sg.save(rom, file)
    export(file, "--mujoco", xml, "--tick", 2e-3)
    root = ET.parse(xml).getroot()
    masses = [float(entry.get("mass", "0")) for entry in root.iter("inertial")]
    assert masses == pytest.approx([model.system.M_hand[0, 0], model.system.M_rigid[0, 0]], rel=1e-12)
    option = root.find("option")
    assert option is not None
    assert (option.get("timestep"), option.get("integrator")) == ("0.002", "Euler")
    with pytest.raises(SceneError, match="is not written as C or FMU"):
        export(file, "--mujoco", xml, "--c", tmp_path / "plant")
    with pytest.raises(SceneError, match="only linear reduced models are exported, of small angles"):
        export(file, "--c", tmp_path / "plant")
    flat = sg.build("paper_forward", SMALL)
    sg.save(sg.reduce(flat, sg.simulate(flat), "craig_bampton", N=10), file)
    with pytest.raises(SceneError, match="is no model in the frame of the hand"):
        export(file, "--mujoco", xml)
