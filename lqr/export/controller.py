"""The C of a controller: gain, limits, the tissue's model or the observer, and a log of its own ticks."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.controller import Controller
from softgrasp.reduction.export.c import array, code_of, comment, hexadecimal, write_files

CODE = Path(__file__).parent / "code"
"""Folder of the code that is the same for all controllers."""
GOLDEN_STEPS = 400  # of the log
LOST = (50, 120)  # ticks at which samples of the observer are lost
DIGITS = 1e-12  # of the largest load of the same unit: rounding of 400 ticks in two orders of summation


def write_controller(controller: Controller, folder: str | Path) -> list[Path]:
    """Write C99 that does what :meth:`softgrasp.lqr.loop.controller.Controller.step` does. Returns the files.

    `make test` compares it with `golden.log`, ticks of the controller itself. Not collective.

    Args:
        controller: controller of a scene, with or without an observer.
        folder: where the files go, made if it is missing; those of the same names are replaced.

    Raises ResourceError: the folder cannot be written; what was there stays.
    """
    texts = code_of(CODE, "controller") | controller_texts(controller)
    return write_files(Path(folder), texts | {"golden.log": golden_log(controller)})


def controller_texts(controller: Controller) -> dict[str, str]:
    """The files with sizes and arrays."""
    own, n_s, N = controller.observer, controller.n_s, controller.plant.N
    limits = controller.limits if controller.limits is not None and np.isfinite(controller.limits).any() else None
    rest = deepcopy(controller)
    rest.reset()
    arrays = {"K": controller.K.T, "OFFSET": controller.u_bar - controller.K @ controller.x_bar, "REST": rest.tissue}
    if limits is not None:
        arrays["LIMIT"] = np.minimum(limits, np.finfo(float).max)
    dragged, samples, others, hand, delay = None, 0, 0, n_s, 0
    if own is None:
        step, accelerated, dragged, constant = controller.model
        arrays |= {"STEP": step.T, "ACCELERATED": accelerated.T, "CONSTANT": constant}
        arrays |= {} if dragged is None else {"DRAGGED": dragged.T}
    else:
        arrays |= {"A": own.A.T, "B": own.B.T, "LOAD": own.f, "C": own.C.T, "CORRECTION": own.M.T}
        samples, others, hand, delay = len(own.C), own.others, len(own.C) - own.others, own.delay
    numbers = {
        "N": N, "INPUTS": n_s, "PERIOD": controller.period.hex(), "LIMITED": int(limits is not None),
        "OBSERVER": int(own is not None), "DRAGGED": int(dragged is not None), "SAMPLES": samples, "OTHERS": others,
        "HAND": hand, "DELAY": delay,
    }  # fmt: skip
    words = ", ".join(f"{key} {value}" for key, value in controller.about.items())
    size = [comment(f"{words}; a tick of {controller.period!r} s".replace("*/", "")), "/*"]
    groups = {"q": _hand(controller, ""), "v": _hand(controller, "/s"), "y": _others(controller)}
    for letter, names in (groups | {"u": controller.plant.inputs}).items():
        size += [f"   {letter}[{i}]  {name}".replace("*/", "") for i, name in enumerate(names)]
    size += ["*/"] + [f"#define SG_CONTROLLER_{key} {value}" for key, value in numbers.items()]
    data = [comment("matrices column by column"), *(array(key, value) for key, value in arrays.items())]
    return {"controller_size.h": "\n".join([*size, ""]), "controller_data.h": "\n".join([*data, ""])}


def _hand(controller: Controller, rate: str) -> list[str]:
    """Names of q and v with their units."""
    kind = {"": "position", "/s": "velocity"}[rate]
    axes = [name.split(" [")[0].split("_", 1) for name in controller.plant.inputs]
    return [f"{kind} {axis} [{'rad' if what == 'torque' else 'm'}{rate}]" for what, axis in axes]


def _others(controller: Controller) -> tuple[str, ...]:
    """Names of the samples beside those of the hand."""
    own = controller.observer
    return () if own is None else own.names[len(own.C) - own.others :]


def golden_log(controller: Controller) -> str:
    """Ticks of a copy of the controller that closes the loop with its own plant, from rest at the origin."""
    robot, own, plant = deepcopy(controller), controller.observer, controller.plant
    robot.reset()
    n_s, step = controller.n_s, plant.midpoint(controller.period).matrix
    x, rows, loads = np.zeros(plant.N), list[Array](), list[Array]()
    x[2 * n_s :] = robot.tissue
    past = [np.full(own.others, np.nan)] * own.delay if own is not None else []
    for k in range(GOLDEN_STEPS):
        y = np.zeros(0)
        if own is not None:
            past.append((own.C @ x)[len(own.C) - own.others :] + 1e-3 * np.sin(7.0 * k + np.arange(own.others)))
            y = past.pop(0).copy()
            y[: 1 if k in LOST else 0] = np.nan
        u = robot.step(x[:n_s], x[n_s : 2 * n_s], None if own is None else y)
        rows.append(np.concatenate([x[: 2 * n_s], y, u]))
        loads.append(u)
        x = step @ np.concatenate([x, u, [1.0]])
    most = np.abs(loads).max(axis=0)
    units = [name.rsplit(" [", 1)[1] for name in plant.inputs]
    scale = np.array([max(most[j] for j, other in enumerate(units) if other == unit) for unit in units])
    lines = [f"tolerance {DIGITS.hex()}", f"scale {hexadecimal(np.where(scale > 0, scale, 1.0))}", "start"]
    return "\n".join([*lines, *(f"tick {hexadecimal(row)}" for row in rows), ""])
