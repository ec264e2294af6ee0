"""``softgrasp export``: a saved reduced model or controller, as C and as FMU."""

from __future__ import annotations

import shlex
from pathlib import Path

from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import SceneError, raise_on_all_ranks
from softgrasp.reduction.archive import load
from softgrasp.reduction.export import write_c, write_fmu
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.study.shell.session import list_files

TARGETS = "--c FOLDER, --fmu FILE or --mujoco FILE"  # options of which at least one is given


def run_export(
    path: Path,
    console: Console,
    *,
    c: Path | None = None,
    fmu: Path | None = None,
    mujoco: Path | None = None,
    tick: float = 1e-3,
) -> None:
    """Write a saved model or controller for other programs, see ``softgrasp export --help``. Collective; rank 0 writes.

    Args:
        path: reduced model (.h5) or controller (.npz).
        console: terminal.
        c: folder of the C code; None for none.
        fmu: file of the FMU; None for none.
        mujoco: file of the body for MuJoCo, of a model in the frame of the hand; None for none.
        tick: time between two steps of an exported model [s]; a controller has its own.

    Raises:
        SoftgraspError: with one sentence; nothing is half-written.
    """
    with raise_on_all_ranks(MPI.COMM_WORLD):
        if MPI.COMM_WORLD.rank == 0:
            _export(path, console, c, fmu, mujoco, tick)


def _export(path: Path, console: Console, c: Path | None, fmu: Path | None, mujoco: Path | None, tick: float) -> None:
    """Check the options, write and list the files; on rank 0."""
    if c is None and fmu is None and mujoco is None:
        raise SceneError(f"softgrasp export {path}: name what to write: {TARGETS}")
    if fmu is not None and fmu.suffix != ".fmu":
        raise SceneError(
            f"--fmu {fmu}: simulators recognise an FMU by its ending; name it {fmu.with_suffix('.fmu').name}"
        )
    if mujoco is not None:
        files = [_mujoco(path, console, c, fmu, mujoco, tick)]
    elif path.suffix == ".npz":
        files = _controller(path, console, c, fmu)
    else:
        files = _model(path, console, c, fmu, tick)
    list_files(console, files)
    if c is not None:
        console.print(f"next: make -C {shlex.quote(str(c))} test time", soft_wrap=True, markup=False)


def _controller(path: Path, console: Console, c: Path | None, fmu: Path | None) -> list[Path]:
    """Files of the C code and the FMU of a controller."""
    from softgrasp.lqr.export.controller import write_controller  # with lqr, which models do not need
    from softgrasp.lqr.export.fmu import write_controller_fmu
    from softgrasp.lqr.loop.controller import Controller

    controller = Controller.load(path)
    seen = "no observer" if controller.observer is None else f"an observer of {len(controller.observer.C)} samples"
    if controller.planner is not None:
        own = controller.planner
        seen += f", a plan of {own.variables} variables and {own.count(0)} to {own.count(own.H)} rows"
    text = f"{path.name}: N = {controller.plant.N}, {seen}, a tick of {controller.period:g} s"
    console.print(text, soft_wrap=True, markup=False)
    files = [] if c is None else write_controller(controller, c)
    return files + ([] if fmu is None else [write_controller_fmu(controller, fmu)])


def _mujoco(path: Path, console: Console, c: Path | None, fmu: Path | None, file: Path, tick: float) -> Path:
    """File of the body for MuJoCo. Raises SceneError: the model is none in the frame of the hand."""
    from softgrasp.reduction.bridges import write_mujoco

    model = load(path) if path.suffix != ".npz" else None
    if not isinstance(model, TurningModel):
        raise SceneError(
            f"--mujoco {file}: {path} is no model in the frame of the hand; reduce a scene with effects.frame = 'hand'"
        )
    if c is not None or fmu is not None:
        raise SceneError(
            f"--mujoco {file}: a model in the frame of the hand is not written as C or FMU; drop --c, --fmu"
        )
    console.print(f"{path.name}: {model.name}, N = {model.N}, a step of {tick:g} s", soft_wrap=True, markup=False)
    return write_mujoco(model, file, tick)


def _model(path: Path, console: Console, c: Path | None, fmu: Path | None, tick: float) -> list[Path]:
    """Files of the C code and the FMU of a model. Raises SceneError: it is of finite strain."""
    model = load(path)
    if not isinstance(model, ReducedModel):
        raise SceneError(
            f"{path}: only linear reduced models are exported, of small angles and small strain; this one is a "
            f"{type(model).__name__}"
        )
    files = [] if c is None else write_c(model, c, tick)
    files += [] if fmu is None else [write_fmu(model, fmu, tick)]
    console.print(f"{path.name}: {model.name}, N = {model.N}, a tick of {tick:g} s", soft_wrap=True, markup=False)
    if model.structure == "none":
        console.print(
            "warning: this basis keeps no structure, so that the model may be unstable with other materials, which the "
            "C does not test; craig_bampton and the psd bases are stable with all",
            style="yellow", soft_wrap=True, markup=False,
        )  # fmt: skip
    return files
