"""The C of a reduced model: fixed code, its arrays, and a log of its own steps to compare with."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from softgrasp.fem.material import of_layers
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import midpoint_map
from softgrasp.reduction.export.affine import FIXED, AffinePlant, Label, affine_plant, theta_of
from softgrasp.reduction.export.c import CODE, array, code_of, comment, hexadecimal, write_files
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import Stepper
from softgrasp.reduction.system import EnergySystem, UnstableModelError

EPS = float(np.finfo(float).eps)
GOLDEN_STEPS = 200  # of the log, with each of two materials
OTHER = (1.3, 1.3, 0.7)  # times mu, lambda, beta: the second of them
# Least tolerance of the test, of the largest output of the same unit: our stepper repeats the rounding of its matrix
# every step, and where nothing damps it rounds its rotations to a length of 1.
DIGITS, TURNED = 1e-13, 1e-11
ROUNDINGS = 4.0  # times the change by one rounding of each entry, with signs at random


def write_c(model: ReducedModel, folder: str | Path, tick: float = 1e-3) -> list[Path]:
    """Write C99 that steps a reduced model, with its test. Returns the files; not collective.

    The code is that of the midpoint rule (E - tick/2 A) dw = tick (A w + B u + f) in energy coordinates, for any mu,
    lambda, beta. `make test` compares it with `golden.log`, steps of :class:`softgrasp.reduction.online.Stepper`.

    Args:
        model: linear reduced model.
        folder: where the files go, made if it is missing; those of the same names are replaced.
        tick: time step [s].

    Raises:
        ModelError: the tick is no positive number, or the model cannot be exported.
        UnstableModelError: the model is unstable with its own material.
        ResourceError: the folder cannot be written; what was there stays.

    >>> import softgrasp as sg
    >>> from softgrasp.reduction.export import write_c
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=12)
    >>> [path.name for path in write_c(rom, "plant")][:3]
    ['Makefile', 'golden.log', 'plant.c']
    """
    plant = affine_plant(model, tick)
    return write_files(
        Path(folder), code_of(CODE, "plant") | plant_texts(plant) | {"golden.log": golden_log(model, plant)}
    )


def plant_texts(plant: AffinePlant) -> dict[str, str]:
    """The files with sizes and arrays."""
    viscous = plant.E_0 is not None
    numbers = {
        "N": plant.N, "INPUTS": len(plant.inputs), "OUTPUTS": len(plant.outputs), "LAYERS": plant.layers,
        "MATERIALS": len(of_layers(plant.rows)),
        "THETA": plant.theta.size, "DAMPED": int(plant.damped), "VISCOUS_E": int(viscous), "TICK": plant.tick.hex(),
    }  # fmt: skip
    size = [f"/* {plant.name}, N = {plant.N}, a tick of {plant.tick!r} s"]
    size += [_listed(*pair) for pair in zip(("u", "y", "theta"), _groups(plant), strict=True)]
    left = [label.name for label, able in zip(plant.constants(), plant.tunable(), strict=True) if not able]
    size += [f"   leave as they are: {', '.join(left)}"] if left else []
    size += ["*/"] + [f"#define SG_PLANT_{key} {value}" for key, value in numbers.items()]
    arrays: dict[str, Array] = {"A_0": plant.A_0, "A_MU": plant.A_mu, "A_LAMBDA": plant.A_lambda}
    if plant.damped:
        side = "E" if viscous else "A"
        arrays |= {f"{side}_BETA_MU": plant.beta_mu, f"{side}_BETA_LAMBDA": plant.beta_lambda}
    if plant.E_0 is not None:
        arrays["E_0"] = plant.E_0
    arrays |= {"B": plant.B, "C": plant.C}
    columns = {key: np.swapaxes(value, -1, -2) for key, value in arrays.items()}  # a column is contiguous
    columns |= {"LOAD": plant.f, "START": plant.start, "THETA": plant.theta.ravel()}
    data = [comment("matrices column by column")] + [array(key, value) for key, value in columns.items()]
    return {"plant_size.h": "\n".join([*size, ""]), "plant_data.h": "\n".join([*data, ""])}


def _groups(plant: AffinePlant) -> tuple[tuple[Label, ...], ...]:
    return plant.inputs, plant.outputs, plant.constants()


def _listed(letter: str, names: tuple[Label, ...]) -> str:
    units = (f" [{label.unit}]" if label.unit else ", of your form" for label in names)
    pairs = enumerate(zip(names, units, strict=True))
    return "\n".join(f"   {letter}[{i}]  {label.name}{unit}" for i, (label, unit) in pairs)


def golden_log(model: ReducedModel, plant: AffinePlant) -> str:
    """Steps of our own stepper as text: with the material of the model, then with another where that is stable."""
    n_s, t = len(plant.inputs), plant.tick * (np.arange(2 * GOLDEN_STEPS) + 0.5)
    # forces that would accelerate the hand by 1 m/s2, 1 rad/s2
    inertia = 1 / np.abs(np.diag((plant.C @ plant.B)[n_s : 2 * n_s]))
    u = inertia * np.sin(2 * np.pi * np.outer(t, np.linspace(0.7, 1.9, n_s)))
    stepper = Stepper(model.at(), plant.tick, plant.d * plant.start)
    parts = [("start", _march(stepper, u[:GOLDEN_STEPS]))]
    other = tuple(
        m if m.adds in FIXED else replace(m, mu=OTHER[0] * m.mu, lam=OTHER[1] * m.lam, beta=OTHER[2] * m.beta)
        for m in model.materials
    )
    with suppress(UnstableModelError):
        stepper = Stepper(model.at(other), plant.tick, stepper.state)
        theta = theta_of(other)
        parts.append((f"material {hexadecimal(theta)}", _march(stepper, u[GOLDEN_STEPS:])))
    most = np.abs(np.concatenate([y for _, y in parts])).max(axis=0)
    units = [label.unit for label in plant.outputs]
    scale = np.array([max(most[j] for j, same in enumerate(units) if same == unit) for unit in units])
    scale = np.where(scale > 0, scale, 1.0)
    systems = [model.at(m) for m in (model.materials, other)[: len(parts)]]
    plain, rounded = (_midpoint(systems, plant, u, rounded) / scale for rounded in (False, True))
    own = np.vstack([y for _, y in parts]) / scale if model.at().structured else plain
    tolerance = max(TURNED if model.at().structured else DIGITS,
                    ROUNDINGS * (np.abs(rounded - plain).max() + np.abs(own - plain).max()))  # fmt: skip
    lines = [f"tolerance {tolerance.hex()}", f"scale {hexadecimal(scale)}"]
    for i, (head, y) in enumerate(parts):
        lines.append(head)
        rows = u[i * GOLDEN_STEPS :]
        lines += [f"tick {hexadecimal(row)} {hexadecimal(values)}" for row, values in zip(rows, y, strict=False)]
    return "\n".join([*lines, ""])


def _midpoint(systems: list[EnergySystem], plant: AffinePlant, u: Array, rounded: bool) -> Array:
    """The outputs of the log by the plain midpoint rule; ``rounded``: with each entry of E and A changed by eps."""
    rng = np.random.default_rng(0)
    x, rows = plant.d * plant.start, []
    for i, system in enumerate(systems):
        signs = (rounded * EPS * rng.choice([-1.0, 1.0], system.E.shape) for _ in range(2))
        E, A = (M * (1 + s) for M, s in zip((system.E, system.A), signs, strict=True))
        step = midpoint_map(E, A, np.column_stack([system.B, system.f]), plant.tick)
        read = np.vstack([system.S_q, system.S_v, system.C])
        for row in u[i * GOLDEN_STEPS : (i + 1) * GOLDEN_STEPS]:
            x = step @ np.concatenate([x, row, [1.0]])
            rows.append(read @ x)
    return np.array(rows)


def _march(stepper: Stepper, u: Array) -> Array:
    """q_s, v_s and the outputs after every step, (steps, p)."""
    system, rows = stepper.step.model, []
    for row in u:
        y, x = stepper(row), stepper.state
        rows.append(np.concatenate([system.S_q @ x, system.S_v @ x, y]))
    return np.array(rows)
