"""Sentences for what hardly ever happens: a lack of memory, another run at the same moment, an iteration without end.

The failure is made by hand below the call that has to name it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any

import dolfinx
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import softgrasp as sg
from softgrasp.fem import owned
from softgrasp.fem.energy.rest import affine_parameters
from softgrasp.fem.errors import SoftgraspError, SolverError
from softgrasp.fem.mesh import foreign
from softgrasp.fem.solve import cholesky
from softgrasp.fem.strain.laws import LAWS
from softgrasp.lqr.constrained import online as program
from softgrasp.lqr.design import observer
from softgrasp.lqr.design import online as planned
from softgrasp.lqr.spectrum import certificate
from softgrasp.reduction.strain import stepper
from softgrasp.reduction.strain.model import ReducedStrainSystem
from softgrasp.study.reduce.contact import measure as contact
from softgrasp.study.reduce.strain import measure as strain
from softgrasp.study.serve.run import make_server
from softgrasp.study.shell.folder import _settle
from tests.helpers.sentences import refused

pytestmark = pytest.mark.serial
Act = Callable[[Path, pytest.MonkeyPatch], Any]
E = np.eye(2)
DAMPED = "effects.damping={kind='kelvin-voigt', beta=0.002}"


def raised(error: Exception) -> Callable[..., Any]:
    """A function that fails."""

    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


def no_tangent(*_: Any) -> None:
    law: Any = SimpleNamespace(name="own", parameters=(), at_rest=lambda *_: np.full((2, 2), np.nan))
    affine_parameters(law, {})


def dead_reader(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """A mesh whose format kills the process that reads it."""
    path = folder / "a.med"
    path.write_text("")
    patch.setattr("subprocess.run", lambda *_, **__: SimpleNamespace(returncode=-11))
    foreign.read_foreign(path)


def no_tags(*_: Any) -> None:
    """A mesh without cell tags."""
    tissue = {"mesh": "given", "size": False, "cells": False, "layers": {"a": {"tag": 7, "material": "fat"}}}
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 2, 2)
    sg.build("paper_forward", mesh=mesh, tissue=tissue, contact={"sides": ["left"], "box": False})


def raced(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Another machine locks the folder between two system calls."""
    patch.setattr(owned, "_held", None)
    patch.setattr(owned, "_check_ended", lambda *_: None)
    handle = os.open

    def taken(path: Any, flags: int, *mode: int) -> int:
        if flags & os.O_EXCL:
            raise FileExistsError
        return handle(path, flags, *mode)

    patch.setattr("os.open", taken)
    owned.hold(folder / "out")


def no_memory(*_: Any) -> None:
    """PETSc's error 55, as a factor that does not fit raises it."""
    cholesky.make_factor(SimpleNamespace(setUp=raised(PETSc.Error(55))), False)


def sagging(force: float, slope: float = 0.0, tangent: float = 1.0) -> Act:
    """Newton's method on a body whose force is ``force`` + ``slope`` times its place."""
    potential = SimpleNamespace(force=lambda a: force + slope * a, tangent=lambda _: np.array([[tangent]]))
    own: Any = SimpleNamespace(
        problem=SimpleNamespace(potential=potential), model=SimpleNamespace(G=np.eye(1)), fall=lambda _: np.ones(1)
    )
    return lambda *_: ReducedStrainSystem.equilibrium(own)


def no_room(*_: Any) -> None:
    """The compiled steps find no memory."""
    ffi = SimpleNamespace(new=lambda _: [0, 0, 0], cast=lambda *_: 0)
    lib = SimpleNamespace(softgrasp_march=lambda *_: -1)
    cells = SimpleNamespace(law=next(iter(LAWS)))
    potential = SimpleNamespace(packed=[E, E], cells=cells, d=2, rounding=0.0)
    problem: Any = SimpleNamespace(potential=potential, S=E, dt=0.1)
    try:
        stepper._march_c((ffi, lib), problem, E, E, 0.1, E, E, E, E)
    except MemoryError as error:
        raise SoftgraspError(str(error)) from error


def never_safe(_: Path, patch: pytest.MonkeyPatch) -> None:
    """Plans that break the bounds of each program made from the one before."""

    class Begins(SimpleNamespace):
        def __replace__(self, **_: Any) -> Begins:
            return self

    begins = Begins(c=np.zeros(2), start=0, solve=lambda *_: (np.zeros(2),), judge=lambda *_: "a node comes too near")
    patch.setattr(program, "_program", lambda *_: begins)
    patch.setattr(program, "replace", lambda old, **_: old)
    plan: Any = SimpleNamespace(
        horizon=SimpleNamespace(plant=SimpleNamespace(grid=0.1)), depth=0.0, gap=0.0, unsafe="", inputs=np.ones((1, 1)),
        task=SimpleNamespace(limits=SimpleNamespace(force=None), places=np.zeros((1, 2))),
    )  # fmt: skip
    program.make_program(plan, E, np.zeros(2), None, 0.1)  # type: ignore[arg-type]


def unstable(abscissa: float) -> Act:
    """Observers none of which leaves the full plant stable."""

    def act(_: Path, patch: pytest.MonkeyPatch) -> None:
        design = sg.design(
            sg.build("paper_lqr", ["tissue.cells=[2, 4]", "control.observer={N=10, noise={force=1e-3}}", DAMPED])
        )
        judged = SimpleNamespace(stable=False, abscissa=abscissa, small_gain=3.0)
        patch.setattr(observer, "judge", lambda *_: judged)
        observer.observe(design, SimpleNamespace(stage=lambda _: nullcontext()))  # type: ignore[arg-type]

    return act


def swinging(_: Path, patch: pytest.MonkeyPatch) -> None:
    """A loop around a plan that grows from tick to tick."""
    small = SimpleNamespace(reduce_gain=lambda *_: E)
    plant = SimpleNamespace(N=4, rest_at=lambda _: (E, E))
    patch.setattr(planned, "galerkin", lambda *_: (plant, small))
    patch.setattr(planned, "scene_hash", lambda _: "")
    patch.setattr(planned, "layout_hash", lambda _: "")
    patch.setattr(planned, "Controller", lambda *_: SimpleNamespace(period=0.1))
    design: Any = SimpleNamespace(
        problem=SimpleNamespace(layout=SimpleNamespace(n_s=2)), gain=E,
        model=SimpleNamespace(scene=SimpleNamespace(name="a")),
        target=SimpleNamespace(state=SimpleNamespace(q_s=E)),
        gain_check=SimpleNamespace(ticks=SimpleNamespace(controller=lambda *_: SimpleNamespace(value=1.5))),
    )  # fmt: skip
    plan: Any = SimpleNamespace(horizon=SimpleNamespace(plant=SimpleNamespace(tissue=SimpleNamespace(of=E))))
    planned.planned_controller(design, plan, E, rate=10.0)


def nothing_converges(_: Path, patch: pytest.MonkeyPatch) -> None:
    """One restart for a hundred eigenvalues in a row, to a tolerance below rounding."""
    patch.setattr(certificate, "ITERATIONS", 1)
    patch.setattr(certificate, "TOLERANCE", 1e-300)
    matrix = PETSc.Mat().createDense((100, 100), array=np.diag(np.arange(1.0, 101)), comm=PETSc.COMM_SELF)
    layout = SimpleNamespace(states=100, nodes=np.arange(50))
    own: Any = SimpleNamespace(comm=PETSc.COMM_SELF, shell=matrix, layout=layout, extra=0)
    certificate.Resolvent.nearest(own, 1)


def no_contact_model(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(contact, "_models", lambda _, refused, __: refused.update(nodes="no force at rest") or {})
    full: Any = SimpleNamespace(model=SimpleNamespace(system=SimpleNamespace(layout=SimpleNamespace(comm=None))))
    contact.measure_contact(full, None, lambda *_: None)  # type: ignore[arg-type]


def failed_run(module: Any, run: str, call: Callable[[], Any]) -> Act:
    """A full run elsewhere that fails."""

    def act(_: Path, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(module, "moved_to", lambda model, _: model)
        patch.setattr(module, run, raised(SolverError("no step")))
        call()

    return act


def without_length(*_: Any) -> None:
    """A request of unknown length, sent in pieces."""
    server = make_server(SimpleNamespace(), "127.0.0.1", 0)  # type: ignore[arg-type]
    thread = Thread(target=server.handle_request, daemon=True)
    thread.start()
    line = HTTPConnection("127.0.0.1", server.server_address[1], timeout=9)
    line.putrequest("POST", "/Evaluate")
    line.endheaders()
    answer = line.getresponse().read().decode()
    line.close()
    thread.join()
    server.server_close()
    raise SoftgraspError(answer)


def foreign_files(folder: Path, _: Any) -> None:
    (folder / "thesis.txt").write_text("")
    _settle(folder, ("simulate", "a"), [], empty=True)


HELD: Any = SimpleNamespace(model=None)
SENTENCES: list[tuple[Act, str]] = [
    (no_tangent, "own: the tangent at rest is no number; check the energy at F = I and its parameters"),
    (dead_reader, "its process ended with status -11"),
    (no_tags, "A layer has tag = 7, but the "),
    (raced, "out: another run has just begun there; name another folder"),
    (no_memory, "cholesky: PETSc gave up the factorisation of the tissue matrix with error 55 (55 is out of memory); "),
    (sagging(np.inf), "the reduced body folds on the way to its equilibrium under gravity"),
    (sagging(9.0), "Newton's method found no equilibrium of the reduced body under gravity"),
    (sagging(0.0, -1.0, -1.0), "the equilibrium of the reduced body under gravity is unstable: it buckles"),
    (no_room, "the reduced run does not fit into memory"),
    (never_safe, "the plan is not safe with the coarser bounds of a program online: a node comes too near"),
    (unstable(0.5), "no observer of 10 states leaves the full plant stable, the last one has the abscissa 0.5/s; "),
    (unstable(-0.5), "the last one has the small gain 3, not below "),
    (swinging, "the loop from tick to tick is not stable, its spectral radius is 1.5"),
    (nothing_converges, "closed-loop spectrum: none of 1 eigenvalues converged in 1 iterations; judge the gain by "),
    (no_contact_model, "no reduced model with contact: nodes: no force at rest"),
    (failed_run(contact, "simulate", lambda: contact._try_motion(HELD, {}, "far", [1.0], {})),
     "full run of the held-out motion to [1.0]: no step"),
    (failed_run(strain, "run_at", partial(strain._full, None, (2.0, 3.0, 4.0), [1.0])),  # type: ignore[arg-type]
     "full run at lambda = 2, mu = 3 Pa, target [1.0]: no step; narrow reduction.lambda_range, mu_range or motions"),
    (without_length, "the request must say its length, at most "),
    (foreign_files, "--empty removes the files that the list softgrasp.files of a run names, but there is no such "),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_failed(act: Act, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(sentence):
        act(tmp_path, monkeypatch)
