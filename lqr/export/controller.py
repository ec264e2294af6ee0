"""The C of a controller: gain, limits, the tissue's model or the observer, and a log of its own ticks."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.program.program import HARD, MOST_STEPS, Program
from softgrasp.lqr.program.replan import Outcome, Replanner
from softgrasp.reduction.export.c import array, code_of, comment, hexadecimal, write_files

CODE = Path(__file__).parent / "code"
"""Folder of the code that is the same for all controllers."""
GOLDEN_STEPS = 400  # of the log
MOST_TICKS = 2000  # of a log that reaches the second plan
NOISE = 1e-5  # of the hand in logs and timings of plans [m, m/s, rad, rad/s]
STEPS = 1e-8  # the same in timings without an observer, whose tube is that of rounding
PUSH = 0.1  # of the hand in a log of plans, beyond what rows are kept for [m, m/s, rad, rad/s]
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
    if controller.planner is None:
        del texts["plan_controller.h"]
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
    size_of_plan: dict[str, int | str] = {}
    if controller.planner is not None:
        if own is None:
            own_ticks = controller.planner
            arrays |= {"A": own_ticks.A.T, "B": own_ticks.B.T, "LOAD": own_ticks.f}
        del arrays["OFFSET"]
        size_of_plan, more = plan_arrays(controller, controller.planner)
        arrays |= more
    numbers = {
        "N": N, "INPUTS": n_s, "PERIOD": controller.period.hex(), "LIMITED": int(limits is not None),
        "OBSERVER": int(own is not None), "DRAGGED": int(dragged is not None), "SAMPLES": samples, "OTHERS": others,
        "HAND": hand, "DELAY": delay, "PLAN": int(controller.planner is not None),
    }  # fmt: skip
    words = ", ".join(f"{key} {value}" for key, value in controller.about.items())
    size = [comment(f"{words}; a tick of {controller.period!r} s".replace("*/", "")), "/*"]
    groups = {"q": hand_names(controller, ""), "v": hand_names(controller, "/s"), "y": other_names(controller)}
    for letter, names in (groups | {"u": controller.plant.inputs}).items():
        size += [f"   {letter}[{i}]  {name}".replace("*/", "") for i, name in enumerate(names)]
    size += ["*/"] + [f"#define SG_CONTROLLER_{key} {value}" for key, value in numbers.items()]
    size += [f"#define SG_{key} {value}" for key, value in size_of_plan.items()]
    data = [comment("matrices column by column"), *(array(key, value) for key, value in arrays.items())]
    return {"controller_size.h": "\n".join([*size, ""]), "controller_data.h": "\n".join([*data, ""])}


def plan_arrays(controller: Controller, own: Program) -> tuple[dict[str, int | str], dict[str, Array]]:
    """Sizes and arrays of a plan, matrices column by column."""
    parts, k = own.most.shape[1:]
    counts = [own.count(j) for j in range(own.H + 1)]
    obstacles = int(own.obstacle.max(initial=HARD)) + 1
    sizes: dict[str, int | str] = {
        "PLAN_N": len(own.F), "PLAN_INTERVALS": own.H, "PLAN_VARIABLES": own.variables, "PLAN_OBSTACLES": obstacles,
        "PLAN_SLACKS": obstacles * own.H, "PLAN_ROWS": len(own.a), "PLAN_FEWEST": min(counts),
        "PLAN_LARGEST": max(counts), "PLAN_MODES": k, "PLAN_PARTS": parts, "PLAN_SEEN": len(own.tube),
        "PLAN_MAPPED": len(own.T), "PLAN_EVERY": own.every, "PLAN_STEPS": MOST_STEPS, "PLAN_PRICE": own.price.hex(),
        "TIME_POSE": (NOISE if controller.observer else STEPS).hex(), "TIME_SAMPLE": (10 * NOISE).hex(),
    }  # fmt: skip

    def pairs(x: Array) -> Array:  # (parts, k, 2, n) as columns of 2 k
        return np.moveaxis(x.reshape(len(x), -1, x.shape[-1]), 1, 2)

    arrays: dict[str, Any] = {
        "U_BAR": controller.u_bar, "REST_AT_TARGET": controller.x_bar, "PLAN_F": own.F.T, "PLAN_D": own.D.T,
        "PLAN_K": own.K.T, "PLAN_L": own.L.T, "PLAN_A": own.a.T, "PLAN_NOW": own.coefficients[:, -own.n_s :].T,
        "PLAN_FREE": own.free, "PLAN_EXACT": own.exact, "PLAN_OBSTACLE": own.obstacle, "PLAN_PART": own.part,
        "PLAN_LEAVES": own.leaves, "PLAN_ALONG": own.along, "PLAN_FIRST": own.first,
        "PLAN_SWING_X": pairs(own.swing_x), "PLAN_SWING_C": pairs(own.swing_c), "PLAN_MOST": own.most,
        "PLAN_NEAR_X": np.swapaxes(own.near_x, 1, 2), "PLAN_NEAR_C": np.swapaxes(own.near_c, 1, 2),
        "PLAN_WAY": own.way, "PLAN_WAY_C": own.way_c, "PLAN_BOX": own.box,
        "PLAN_TAIL": np.stack([own.tail_real.T, own.tail_imag.T]), "PLAN_SEES": own.seen.T, "PLAN_TUBE": own.tube,
        "PLAN_START": own.start, "PLAN_BEGIN": own.c, "PLAN_T": own.T.T, "PLAN_REST": own.rest,
        "PLAN_SPREAD": own.spread, "PLAN_INSTANT": own.instant, "PLAN_REACH": own.reach, "PLAN_BETWEEN": own.between,
    }  # fmt: skip
    return sizes, arrays


def hand_names(controller: Controller, rate: str) -> list[str]:
    """Names of q and v with their units."""
    kind = {"": "position", "/s": "velocity"}[rate]
    axes = [name.split(" [")[0].split("_", 1) for name in controller.plant.inputs]
    return [f"{kind} {axis} [{'rad' if what == 'torque' else 'm'}{rate}]" for what, axis in axes]


def other_names(controller: Controller) -> tuple[str, ...]:
    """Names of the samples beside those of the hand."""
    own = controller.observer
    return () if own is None else own.names[len(own.C) - own.others :]


def golden_log(controller: Controller) -> str:
    """Ticks of a copy of the controller that closes the loop with its own plant, from rest at the origin."""
    robot, own, plant = deepcopy(controller), controller.observer, controller.plant
    robot.reset()
    again = controller.planner
    n_s, step = controller.n_s, plant.midpoint(controller.period).matrix
    x, rows, loads = np.zeros(plant.N), list[Array](), list[Array]()
    x[2 * n_s :] = robot.tissue
    ticks = GOLDEN_STEPS
    if again is not None:
        x[: 2 * n_s] = again.rest[: 2 * n_s]
        ticks = max(ticks, min(again.every + 50, MOST_TICKS))
    past = [np.full(own.others, np.nan)] * own.delay if own is not None else []
    for k in range(ticks):
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
    lines += [f"tick {hexadecimal(row)}" for row in rows]
    return "\n".join([*lines, *(_golden_plans(controller) if again is not None else []), ""])


def _golden_plans(controller: Controller) -> list[str]:
    """Plans of a replanner from states near the way, with a push in the middle, as lines of a log."""
    own = controller.planner
    assert own is not None
    robot, rng = Replanner(own, controller.K, controller.x_bar, controller.u_bar), np.random.default_rng(0)
    n_s, lines = controller.n_s, ["start"]
    for j in range(own.H + 10):
        x = robot.nominal.copy()
        push = PUSH * (j in (own.H // 3, own.H))
        x[: 2 * n_s] += NOISE * rng.standard_normal(2 * n_s) + push
        robot.begin(j, x)
        lines.append(f"interval {hexadecimal(np.concatenate([x, robot.planned]))}")
        for _ in range(own.every):
            robot.nominal = own.A @ robot.nominal + own.B @ robot.planned + own.f
    counts = [sum(entry.outcome is kind for entry in robot.log) for kind in Outcome]
    return [*lines, f"outcomes {hexadecimal(np.array(counts, dtype=float))}"]
