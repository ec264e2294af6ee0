"""Simulate a rigid robot hand that holds soft tissue, reduce the model, and control it optimally.

    import softgrasp as sg
    model = sg.build("paper_forward")
    run = sg.simulate(model)
    rom = sg.reduce(model, run, "psd", N=14)

The names below are loaded when they are used first; until then neither MPI nor DOLFINx is.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softgrasp.fem.accuracy.adapt import build as build
    from softgrasp.fem.model.build import Model as Model
    from softgrasp.fem.model.terms import Term as Term
    from softgrasp.fem.run.simulate import simulate as simulate
    from softgrasp.fem.scene.file import load_scene as load_scene
    from softgrasp.fem.scene.scene import Scene as Scene
    from softgrasp.lqr.design import design as design
    from softgrasp.lqr.design import make_controller as make_controller
    from softgrasp.lqr.design import problem as problem
    from softgrasp.lqr.loop.controller import Controller as Controller
    from softgrasp.lqr.loop.full import ClosedLoop as ClosedLoop
    from softgrasp.lqr.riccati import solve as solve
    from softgrasp.lqr.spectrum.certificate import abscissa as abscissa
    from softgrasp.reduction.archive import load as load
    from softgrasp.reduction.archive import save as save
    from softgrasp.reduction.contact.make import contact_model as contact_model
    from softgrasp.reduction.gradient.face import gradient as gradient
    from softgrasp.reduction.identify.identify import identify as identify
    from softgrasp.reduction.identify.suggest import suggest_markers as suggest_markers
    from softgrasp.reduction.reduce import errors as errors
    from softgrasp.reduction.reduce import reduce as reduce
    from softgrasp.reduction.reduce import replay as replay
    from softgrasp.study.reduce.linear.table import compare_bases as compare_bases
    from softgrasp.study.runs.sweep import sweep as sweep

if "numpy" in sys.modules and "OPENBLAS_NUM_THREADS" not in os.environ:
    import_module("softgrasp._threads").one_thread()
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy: ranks share the cores
    os.environ.setdefault(_variable, "1")
# Before PETSc, whose own handler aborts the program when the reader of its output has gone (`| head`).
if "-no_signal_handler" not in (_given := os.environ.get("PETSC_OPTIONS", "")).split():
    os.environ["PETSC_OPTIONS"] = f"{_given} -no_signal_handler".strip()

__version__ = "0.2.0"
"""Version of this code; `pyproject.toml` reads it here."""

PACKAGE = Path(__file__).parent
"""Folder of the package; in a checkout its subpackages are links to the folders beside it."""

_FACE = {
    "Scene": "fem.scene.scene",
    "load_scene": "fem.scene.file",
    "Term": "fem.model.terms",
    "Model": "fem.model.build",
    "build": "fem.accuracy.adapt",
    "simulate": "fem.run.simulate",
    "reduce": "reduction.reduce",
    "replay": "reduction.reduce",
    "errors": "reduction.reduce",
    "gradient": "reduction.gradient.face",
    "identify": "reduction.identify.identify",
    "suggest_markers": "reduction.identify.suggest",
    "contact_model": "reduction.contact.make",
    "save": "reduction.archive",
    "load": "reduction.archive",
    "problem": "lqr.design",
    "design": "lqr.design",
    "solve": "lqr.riccati",
    "abscissa": "lqr.spectrum.certificate",
    "ClosedLoop": "lqr.loop.full",
    "make_controller": "lqr.design",
    "Controller": "lqr.loop.controller",
    "sweep": "study.runs.sweep",
    "compare_bases": "study.reduce.linear.table",
}
"""What a user imports -> the module that has it."""

__all__ = sorted(_FACE)


def __getattr__(name: str) -> Any:
    if name in _FACE:
        value = getattr(import_module(f"softgrasp.{_FACE[name]}"), name)
        globals()[name] = value
        return value
    if name == "bridges":
        return import_module("softgrasp.reduction.bridges")
    if name in ("fem", "reduction", "lqr", "study"):
        return import_module(f"softgrasp.{name}")
    raise AttributeError(f"module 'softgrasp' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
