"""Random scenes of all kinds, valid or nearly, and what a run of one must leave: a right answer or one sentence."""

from __future__ import annotations

import io
import json
import math
import shutil
import warnings
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console

from softgrasp.fem.accuracy.krylov import KrylovModel, run_krylov
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.materials import LIBRARY
from softgrasp.study.forward.run import run_simulate

Rng = np.random.Generator
SIDES = {2: ["left", "right", "bottom", "top", "x-", "x+", "y-", "y+"], 3: ["left", "right", "bottom", "top", "front",
         "back", "z-", "z+"]}  # fmt: skip
MOST_DENSE = 260  # unknowns of a linear run that is repeated with dense matrices
DRIFT = 1e-9  # of the energy in a direct linear run: rounding, of materials up to nu = 0.499
DENSE = 1e-6  # a run against the same with dense matrices: rounding
# The same of iterations: cg stops at 1e-8 of its residual, seen up to 9e-7, of layers of very unlike nu; stars at 1e-4,
# and warns where it estimates more than 1e-3, within a factor 3.
ITERATED = {"cg": 1e-5, "stars": 3e-3}


def pick(rng: Rng, *choices: Any) -> Any:
    """One of them."""
    return choices[int(rng.integers(len(choices)))]


def log(rng: Rng, low: float, high: float) -> float:
    """A number between 10^low and 10^high, of three digits."""
    return float(f"{10 ** rng.uniform(low, high):.3g}")


def material(rng: Rng) -> Any:
    """A name of the library, E and nu, or Lame constants; now and then none that exists."""
    kind = rng.random()
    if kind < 0.3:
        return pick(rng, *LIBRARY)
    if kind < 0.31:
        return {"young": log(rng, 1, 6), "poisson": pick(rng, 0.5, -1.0, 0.4999999), "rho": 1e3}
    if kind < 0.75:
        nu = float(pick(rng, round(rng.uniform(-0.9, 0.45), 3), 0.0, 0.45, 0.49, 0.499))
        return {"young": log(rng, 1, 6), "poisson": nu, "rho": log(rng, 0, 4)}
    return {"lambda": log(rng, 1, 6), "mu": log(rng, 1, 6), "rho": log(rng, 0, 4)}


def random_scene(rng: Rng, folder: Path) -> dict[str, Any]:
    """The keys of a scene; a table of its motion is written into the folder."""
    d = pick(rng, 2, 2, 3)
    size = [log(rng, -2, 0.5) for _ in range(d)]
    if rng.random() < 0.8:  # else slender
        size = [size[0] * float(round(rng.uniform(0.4, 2.5), 2)) for _ in range(d)]
    cells = [int(rng.integers(1, 4 if rng.random() < 0.5 else {2: 9, 3: 4}[d])) for _ in range(d)]
    order = pick(rng, 1, 1, 1, 2, 2, 3)
    tissue: dict[str, Any] = {"size": size, "cells": cells, "order": order, "material": material(rng)}
    if rng.random() < 0.2:
        tissue["origin"] = [round(rng.normal(), 2) for _ in range(d)]
    if d == 2 and rng.random() < 0.2:
        tissue["thickness"] = log(rng, -2, 1)
    low = np.array(tissue.get("origin", [0.0] * d))
    effects, n_s = _effects(rng, d)
    if rng.random() < 0.3:
        tissue["layers"] = _layers(rng, low, np.array(size), "damping" in effects)
    if rng.random() < 0.3:
        tissue["refine"] = _refine(rng)
    contact: dict[str, Any] = {}
    if rng.random() < 0.9:
        contact["sides"] = [pick(rng, *SIDES[d]) for _ in range(pick(rng, 1, 1, 2))]
    if not contact or rng.random() < 0.2:
        box = _box(rng, low, np.array(size), 0.5)
        for axis in range(d):  # reach most sides, or there is no facet to hold
            if rng.random() < 0.8:
                box[0][axis], box[1][axis] = float(low[axis]), float(low[axis] + size[axis])
        contact["box"] = box
    scene = {
        "name": "random", "tissue": tissue, "contact": contact, "effects": effects,
        "hand": {"mass": log(rng, -2, 3), "inertia": log(rng, -3, 2)},
    }  # fmt: skip
    if rng.random() < 0.1:
        scene["hand"]["reference"] = (low + np.array(size) * rng.uniform(-1, 2, d)).round(3).tolist()
    scene |= _motion_and_time(rng, d, n_s, effects, size, folder)
    if order > 1 and scene["time"]["solver"] == "cg" and scene["time"]["steps"] in (5, 25):
        scene["time"]["solver"] = "stars"
    if rng.random() < 0.5:
        scene["control"] = {"outputs": [_output(rng, low, np.array(size)) for _ in range(pick(rng, 1, 1, 2, 3))]}
    output: dict[str, Any] = {
        "snapshots": pick(rng, "memory", "memory", "hdf5", "none"),
        "every": pick(rng, 1, 1, 3, 100),
    }
    output |= {"fields": pick(rng, "vtu", "none", "none"), "frames": pick(rng, 1, 2, 60)}
    scene["output"] = output | {"checkpoint_every": pick(rng, 0, 0, 0, 1, 7)}
    return scene


def _effects(rng: Rng, d: int) -> tuple[dict[str, Any], int]:
    """Every combination, and how many freedoms the hand has."""
    effects: dict[str, Any] = {"reaction": bool(rng.random() < 0.4), "rotation": bool(rng.random() < 0.3)}
    if rng.random() < 0.5:
        g = [0.0] * (d - 1) + [-9.81] if rng.random() < 0.7 else rng.normal(size=d).round(2).tolist()
        effects["gravity"] = {"g": g, "hand_weight": bool(rng.random() < 0.5)}
    if rng.random() < 0.5:
        kind = pick(rng, "kelvin-voigt", "rayleigh")
        effects["damping"] = {"kind": kind, "beta": float(pick(rng, 0.0, log(rng, -5, -1)))}
        if kind == "rayleigh":
            effects["damping"] |= {"alpha": float(pick(rng, 0.0, log(rng, -2, 1))), "drag": pick(rng, "hand", "space")}
    if rng.random() < 0.25 and (not effects["rotation"] or rng.random() < 0.1):
        effects["finite_strain"] = {"law": pick(rng, "neo-hooke", "neo-hooke-quadratic", "stvk")}
    return effects, d + (d * (d - 1) // 2 if effects["rotation"] else 0)


def _box(rng: Rng, low: Any, size: Any, least: float) -> list[list[float]]:
    """A box that covers at least a share of each edge."""
    begin = rng.uniform(0, 1 - least, len(size)) * (rng.random(len(size)) < 0.5)
    end = np.maximum(begin + least, rng.uniform(0, 1, len(size)))
    return [(low + share * size).tolist() for share in (begin, end)]


def _layers(rng: Rng, low: Any, size: Any, damped: bool) -> dict[str, Any]:
    layers: dict[str, Any] = {}
    for name in ("inner", "outer")[: pick(rng, 1, 2)]:
        layers[name] = {"box": _box(rng, low, size, 0.4), "material": material(rng)}
        if damped and rng.random() < 0.5:
            layers[name]["beta"] = log(rng, -5, -1)
    return layers


def _refine(rng: Rng) -> dict[str, Any]:
    refine: dict[str, Any] = {"most": 3000}
    if rng.random() < 0.5:
        refine["tolerance"] = float(pick(rng, 0.5, 0.1, 0.03))
        refine["passes"] = pick(rng, 0, 1, 3)
    if rng.random() < 0.3:
        refine["grading"] = pick(rng, "off", 0.5, 1.0)
    return refine | {"method": pick(rng, "auto", "auto", "bisect", "lines")}


def _motion_and_time(
    rng: Rng, d: int, n_s: int, effects: dict[str, Any], size: list[float], folder: Path
) -> dict[str, Any]:
    duration = log(rng, -3, 1)
    motion: dict[str, Any] = {"duration": duration}
    span = [float(x) for x in (rng.normal(size=n_s) * 0.3 * max(size)).round(6)]
    span[d:] = [float(x) for x in (rng.normal(size=n_s - d) * 0.05).round(6)]
    if rng.random() < 0.35:
        motion["drive"] = "force"
        span = [float(f"{x:.3g}") for x in rng.normal(size=n_s) * 10 ** rng.uniform(-3, 1)]
    profile = pick(rng, "quintic", "quintic", "quintic", "hold", "csv")
    if profile == "quintic":
        motion["target"] = span
    else:
        motion["profile"] = profile
    if profile == "csv":
        times = np.linspace(0, duration, pick(rng, 2, 3, 8))
        rows = np.outer(np.sin(times / duration), span)
        np.savetxt(folder / "table.csv", np.column_stack([times, rows]), delimiter=",")
        motion["csv"] = "table.csv"
    steps, solver = pick(rng, 2, 5, 10, 25), pick(rng, "auto", "auto", "cholesky", "mumps", "cg")
    time: dict[str, Any] = {"steps": 1 if rng.random() < 0.05 else steps, "solver": solver}
    if rng.random() < 0.15:
        time["end"] = duration * (1.5 if rng.random() < 0.2 else pick(rng, 0.5, 1.0))
    if "gravity" in effects and rng.random() < 0.5:
        time["start"] = "equilibrium"
    return {"motion": motion, "time": time}


def _output(rng: Rng, low: Any, size: Any) -> dict[str, Any]:
    kind = pick(rng, "node", "node", "region", "hand")
    if kind == "node":
        share = rng.random(len(size)) if rng.random() < 0.5 else rng.integers(0, 2, len(size))
        return {"kind": kind, "point": (low + share * size).tolist(), "name": "tip" if rng.random() < 0.02 else ""}
    if kind == "region":
        return {"kind": kind, "box": _box(rng, low, size, 0.5)}
    return {"kind": kind}


def inline(value: Any) -> str:
    """A value in TOML, tables in braces."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {inline(entry)}" for key, entry in value.items()) + "}"
    return "[" + ", ".join(map(inline, value)) + "]" if isinstance(value, list) else json.dumps(value)


def write_scene(seed: int, folder: Path) -> Path:
    """The file of the random scene of a seed."""
    file = folder / "random.toml"
    scene = random_scene(np.random.default_rng(seed), folder)
    file.write_text("".join(f"{key} = {inline(value)}\n" for key, value in scene.items()))
    return file


# --- what a run leaves


def run_random(seed: int, folder: Path) -> str:
    """Simulate the random scene of a seed; "" for a right answer, the sentence of a refusal, or what is wrong.

    Raises AssertionError: the run leaves something that is neither.
    """
    out = folder / "out"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    file = write_scene(seed, folder)
    before = {path.name for path in folder.iterdir()}
    console = Console(file=io.StringIO(), width=200)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # a nan or an overflow that nobody looked at
            run_simulate(file, out, [], console, quiet=True, pictures=False)
    except SoftgraspError as error:
        text = str(error)
        assert "\n" not in text
        assert len(text) > 20
        assert not (out / "result.json").exists(), f"half written before: {text}"
        assert {path.name for path in folder.iterdir()} - before <= {"out"}
        return text
    check_answer(file, out)
    return ""


def no_constant(name: str) -> NoReturn:
    """JSON has no such number."""
    raise AssertionError(f"result.json holds {name}")


def check_answer(file: Path, out: Path) -> None:
    """Files, finite numbers, energy, and the same run with dense matrices where that is cheap."""
    result = json.loads((out / "result.json").read_text(), parse_constant=no_constant)
    missing = [name for name in result["files"] if not (out / name).is_file()]
    assert not missing, f"files that are not there: {missing}"
    table = np.genfromtxt(out / "trajectory.csv", delimiter=",", skip_header=1, ndmin=2)
    header = (out / "trajectory.csv").read_text().splitlines()[0].split(",")
    force = np.array([name.startswith("force_") for name in header])
    assert np.isfinite(table[:, ~force]).all(), "a trajectory that is not finite"
    assert np.isfinite(table[1:]).all(), "a force that is not finite"
    scene = load_scene(file)
    solver = result["solver"]["name"]
    direct = solver not in ITERATED and scene.effects.finite_strain is None
    told = any("digit" in text for text in result["warnings"])
    if direct and not told:
        assert abs(result["energy_drift"]) < DRIFT, f"energy drift {result['energy_drift']:.1e} without a word"
    if "mesh_error" in result:
        error = result["mesh_error"]
        assert 0 <= error["estimate"] <= error["bound"] * (1 + 1e-12), "an estimate above its bound"
    if scene.effects.finite_strain is None and result["n_e"] <= MOST_DENSE and scene.tissue.refine is None and not told:
        compare(build(scene), table, DENSE if direct else ITERATED[solver])


def compare(model: Model, table: Any, limit: float) -> None:
    """The outputs of the run against those of dense matrices in coordinates where K = 1."""
    system = model.system
    L = np.linalg.cholesky(to_scipy(system.K_ee).toarray())
    V = np.linalg.inv(L).T
    outputs = make_outputs(model.scene, system)
    C = output_columns(outputs, system.layout.n_local)
    M = V.T @ to_scipy(system.M_ee).toarray() @ V
    D = system.damping.alpha * M + system.damping.beta * np.eye(len(M))
    if system.damping.matrix is not None:
        D = system.damping.alpha * M + V.T @ to_scipy(system.damping.matrix).toarray() @ V
    C_s = np.vstack([o.C_s for o in outputs])
    dense = run_krylov(KrylovModel(V, (M + M.T) / 2, D, V.T @ system.G, (V.T @ C).T, C_s, np.zeros((len(V), 0)), model))
    expected = dense.deformation + dense.rigid
    at = 1 + 2 * system.layout.n_s
    y = table[:, at : at + expected.shape[1]]
    scale = max(float(np.abs(expected).max()), float(np.abs(dense.deformation).max()))
    off = float(np.abs(y - expected).max())
    assert off <= limit * scale or math.isclose(off, 0.0, abs_tol=1e-14), (
        f"outputs off by {off / scale:.1e} of {scale:.1e}"
    )
