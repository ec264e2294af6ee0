"""A controller as an FMU of FMI 3.0 [FMI3]: the C of `controller.py` behind the functions of the plant's FMU."""

from __future__ import annotations

from pathlib import Path

from softgrasp.lqr.export.controller import CODE, controller_texts, hand_names, other_names
from softgrasp.lqr.loop.controller import Controller
from softgrasp.reduction.export.affine import Label, named
from softgrasp.reduction.export.c import CODE as SHARED
from softgrasp.reduction.export.fmu import SOURCES, Face, write_archive

FMU = Path(__file__).parent / "fmu"
"""Folder of the code between fmi3.c and controller.c."""


def write_controller_fmu(controller: Controller, path: str | Path) -> Path:
    """Write a file of FMI 3.0 for co-simulation, sources and a binary for this machine inside. Not collective.

    Inputs: the measured hand, named as the outputs of a plant's FMU, and samples of the observer; outputs: the load on
    the hand, 0 before the first step. A step is one period or several, with the inputs held: step the controller
    first, give its load to the plant, then step the plant.

    Args:
        controller: controller of a scene, with or without an observer or a plan.
        path: file to write, `controller.fmu`.

    Raises:
        ModelError: no C compiler.
        ResourceError: the file cannot be written; what was there stays.
    """
    texts = {name: (CODE / name).read_text() for name in ("controller.c", "controller.h", "plan_controller.h")}
    texts |= {"vector.h": (SHARED / "vector.h").read_text()} | controller_texts(controller)
    texts |= {file.name: file.read_text() for file in FMU.iterdir() if file.suffix in (".c", ".h")}
    if controller.planner is None:
        del texts["plan_controller.h"]
    hand = (("position", "hand_q_", ""), ("velocity", "hand_v_", "/s"))
    measured = tuple(
        Label(label.name.replace(f"{word} ", stem), label.unit)
        for word, stem, rate in hand
        for label in named(tuple(hand_names(controller, rate)))
    )
    face = Face(
        f"Controller, {controller.plant.N} states, a tick of {controller.period:g} s", controller.period,
        measured + tuple(Label(name, "") for name in other_names(controller)), named(controller.plant.inputs),
    )  # fmt: skip
    return write_archive(Path(path), texts, face, (*SOURCES, "controller.c"))
