"""Sentences that calls, files and options are refused with and no other test asks for: the call and its sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dolfinx
import h5py
import numpy as np
import pytest
import ufl
from markupsafe import Markup
from mpi4py import MPI
from petsc4py import PETSc

import softgrasp as sg
from softgrasp.fem import compiled, pymor
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.fields import vtu
from softgrasp.fem.run.make import make_midpoint
from softgrasp.fem.run.simulate import Run
from softgrasp.fem.scene.table import read_csv
from softgrasp.fem.solve.cholesky import Dissection
from softgrasp.lqr.dense import care
from softgrasp.lqr.design import controller as controllers
from softgrasp.lqr.design import feedback
from softgrasp.lqr.loop import touching
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.lowrank import adjoint, compress
from softgrasp.lqr.lowrank.shifted import DistributedTissue
from softgrasp.lqr.observer import judge
from softgrasp.lqr.observer.full import full_filter
from softgrasp.lqr.observer.reduced import reduced_filter
from softgrasp.lqr.plant.second_order import second_order
from softgrasp.lqr.plant.target import hand_target
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.lqr.spectrum.sampled import Sampling
from softgrasp.reduction.archive import load, read_reconstruction
from softgrasp.reduction.bases.plugins import displacement_method
from softgrasp.reduction.bases.states import _check
from softgrasp.reduction.bases.truncation import Part, Truncation, counts_of
from softgrasp.reduction.bridges import mujoco
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.contact.model import ContactModel
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import run as run_online
from softgrasp.reduction.strain.model import ReducedStrainSystem, StrainModel
from softgrasp.reduction.strain.training import Training
from softgrasp.study.query.request import read_batch
from softgrasp.study.query.run import _full_model
from softgrasp.study.report.document import Page, Section
from softgrasp.study.report.page import write_report
from softgrasp.study.runs.start import new_scene
from softgrasp.study.serve import run as serving
from softgrasp.study.shell import processes
from softgrasp.study.shell.options import parse_tolerance
from tests.helpers.sentences import refused

pytestmark = pytest.mark.serial
Act = Callable[[Path, pytest.MonkeyPatch], Any]
E = np.eye(2)


@cache
def model(name: str = "paper_forward", *keys: str) -> sg.Model:
    return sg.build(name, ["tissue.cells=[2, 4]", "time.steps=4", "output.snapshots='memory'", *keys])


@cache
def made() -> tuple[Any, Any, Any]:
    """A scene, its run, and a reduced model of it."""
    full = model()
    run = sg.simulate(full)
    return full, run, sg.reduce(full, run, "craig_bampton", 8)


@cache
def plant() -> Any:
    return sg.problem(model("paper_lqr"))


def scene(*keys: str, name: str = "paper_forward") -> Act:
    return lambda *_: sg.load_scene(name, list(keys))


def given(mesh: Callable[[], Any]) -> Act:
    without = {"mesh": "given", "size": False, "cells": False}
    return lambda *_: sg.build("paper_forward", mesh=mesh(), tissue=without, contact={"sides": ["left"], "box": False})


def surface() -> dolfinx.mesh.Mesh:
    """Two triangles in space."""
    element = ufl.Mesh(__import__("basix.ufl", fromlist=["element"]).element("P", "triangle", 1, shape=(3,)))
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1.0]])
    return dolfinx.mesh.create_mesh(MPI.COMM_SELF, np.array([[0, 1, 2], [1, 2, 3]]), element, points)


def single() -> dolfinx.mesh.Mesh:
    return dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 2, 2, dtype=np.float32)


def own_energy(content: str, name: str) -> Act:
    def act(folder: Path, _: Any) -> Any:
        (folder / "law.py").write_text(content)
        return sg.build("paper_forward", [f"tissue.energy='{folder / 'law.py'}:{name}'", "effects.finite_strain={}"])

    return act


def batch(content: str) -> Act:
    return lambda folder, _: read_batch(written(folder / "b.csv", content))


def written(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def patched(target: Any, name: str, value: Any, call: Callable[[], Any]) -> Act:
    def act(_: Path, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(target, name, value)
        call()

    return act


def no_compiler(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.delenv("CC", raising=False)
    patch.setattr("shutil.which", lambda _: None)
    try:
        compiled._shared(Path("a.c"), (), ())
    except OSError as error:
        raise SoftgraspError(str(error)) from error


def longer(folder: Path, _: Any) -> None:
    path = written(folder / "a", "xy")
    vtu.check_file(path, vtu._check(b"x"))


def other_line(folder: Path, _: Any) -> None:
    vtu.Collection(folder / "a.pvd", "a run").add(0.5, folder / "a.vtu", "1:2")
    content = (folder / "a.pvd").read_text()
    vtu.Collection.read(written(folder / "a.pvd", content.replace("0.5", "0.7")))


def elsewhere(folder: Path, _: Any) -> None:
    """A reduced model whose nodes are not those of the mesh."""
    full, _, rom = made()
    sg.save(rom, folder / "a.h5")
    with h5py.File(folder / "a.h5", "r+") as file:
        name = next(key for key in ("reconstruction", "strain/reconstruction") if key in file)
        file[f"{name}/nodes"][...] += 7.0
        read_reconstruction(file, full.system.layout)


def short(*_: Any) -> None:
    """A reduced run of fewer steps than the snapshots."""
    full, run, rom = made()
    sg.errors(rom, replace(sg.replay(rom, full, run), x=np.zeros((2, rom.N))), full, run)


def two_parts(*_: Any) -> None:
    part = Part("displacements", np.zeros(0), 0.0, 0, lambda k: ())
    counts_of([part], 1, 0, Truncation(tol=0.1), "pod")


def of_shape(X: np.ndarray) -> Act:
    def act(*_: Any) -> None:
        full = made()[0]
        method = displacement_method("own", "own", lambda states, k: X)
        request: Any = SimpleNamespace(states=SimpleNamespace(layout=full.system.layout, system=full.system))
        method.build(request)[0].columns(2)

    return act


def matrix(array: np.ndarray) -> PETSc.Mat:
    return PETSc.Mat().createDense(array.shape, array=array, comm=PETSc.COMM_SELF)


def filtered(*_: Any) -> None:
    modes: Any = SimpleNamespace(omega=np.ones(6), D=np.zeros((6, 6)))
    reduced_filter(plant(), modes, None, None, 10, 0.01)  # type: ignore[arg-type]


def met(*_: Any) -> None:
    """A loop at finite strain that meets an obstacle."""
    layout = SimpleNamespace(n_e=1, n_s=2)
    other: Any = SimpleNamespace(
        scene=SimpleNamespace(effects=SimpleNamespace(obstacles=True)), system=SimpleNamespace(layout=layout)
    )
    own: Any = SimpleNamespace(system=SimpleNamespace(layout=layout, points=[]))
    touching.touching_drive(other, SimpleNamespace(plant=own), 1)  # type: ignore[arg-type]


def no_scene(folder: Path, _: Any) -> None:
    _full_model(None, None, folder / "a" / "m.h5", None, None, None)  # type: ignore[arg-type]


def outside(folder: Path, _: Any) -> None:
    equation: Any = SimpleNamespace(html=lambda: Markup("<script src=b>"))
    write_report(folder / "a.html", Page("a", [], [Section("", equation=equation)]))


def restored(*_: Any) -> None:
    """A restart file of another numbering."""
    store = SimpleNamespace(restore=lambda *_: None)
    layout = SimpleNamespace(comm=MPI.COMM_SELF)
    run: Any = SimpleNamespace(midpoint=SimpleNamespace(r_array=np.zeros(3)), ledger=None, layout=layout, store=store)
    saved: Any = SimpleNamespace(step=1, snapshots=None, run=None, r=np.zeros(2))
    Run.restore(run, saved)


def other_model(key: str, value: str, **given: Any) -> Act:
    """A file of a reduced model with another attribute, or for another scene."""

    def act(folder: Path, _: Any) -> None:
        sg.save(made()[2], folder / "a.h5")
        if value:
            with h5py.File(folder / "a.h5", "r+") as file:
                file.attrs[key] = value
        load(folder / "a.h5", **given)

    return act


def refused_by_lapack(module: Any, call: Callable[[], Any]) -> Act:
    """A call whose LAPACK routine finds its arguments wrong."""
    return patched(module.scipy.linalg, "get_lapack_funcs", lambda *_: (lambda *_, **__: (E, 1.0, -1),), call)


def not_sorted(*_: Any, **__: Any) -> None:
    raise np.linalg.LinAlgError("reordering failed")


def sampled(*_: Any) -> None:
    """A design whose loop grows from tick to tick, whatever its rate."""
    ticks = SimpleNamespace(stable_rate=lambda *_: None)
    gain_check = SimpleNamespace(law=Sampling(0.1, 1), ticks=ticks, K=E)
    time_end = SimpleNamespace(scene=SimpleNamespace(time=SimpleNamespace(steps=4), time_end=1.0))
    radius = SimpleNamespace(value=1.5)
    design: Any = SimpleNamespace(gain_check=gain_check, quality=SimpleNamespace(sampled=radius), model=time_end)
    design.largest_radius = 1.0
    feedback._require_sampled(design)


def unmixed(*_: Any) -> None:
    """A canonical model of two layers, one of which is to be denser."""
    one = made()[2].materials[0]
    own: Any = SimpleNamespace(materials=(one, one), damped=False, coordinates="qp", gravity=None)
    ReducedModel.parameters(own, (one, replace(one, rho=2.0)))


def other_density(*_: Any) -> None:
    one = made()[2].materials[0]
    own: Any = SimpleNamespace(materials=(one,))
    StrainModel.at(own, 0.1, (replace(one, rho=2.0),))


def endless(*_: Any) -> None:
    own: Any = SimpleNamespace(model=SimpleNamespace(G=np.zeros((1, 2))), problem=SimpleNamespace(dt=0.1))
    ReducedStrainSystem.run(own, (np.full((3, 2), np.inf), np.zeros((3, 2))))


def blind(_: Path, patch: pytest.MonkeyPatch) -> None:
    """A controller where no gain of small order has passed."""
    patch.setattr(controllers, "blind", lambda _: False)
    layout = SimpleNamespace(n_local=4, n_s=2)
    controllers._gain(SimpleNamespace(problem=SimpleNamespace(layout=layout), modal=False), None, None)  # type: ignore[arg-type]


def patterns(*_: Any) -> None:
    own: Any = SimpleNamespace(indptr=np.zeros(3), columns=np.zeros(2), comm=MPI.COMM_SELF)
    DistributedTissue._values(own, matrix(E).convert("aij"))


def dissected(*_: Any) -> None:
    own: Any = SimpleNamespace(order=SimpleNamespace(d=1), before=(np.array([0, 9, 9]), np.zeros(1)))
    Dissection.blocks(own, matrix(E).convert("aij"))


WRONG_SHAPES: Any = SimpleNamespace(Z=np.zeros((3, 2)), q_s=np.zeros((2, 2)), v_s=np.zeros((2, 2)))
ONE: Any = np.ones((1, 1))
REFINED = ["tissue.refine={method='lines'}", "tissue.mesh='a.msh'", "tissue.size=false", "tissue.cells=false"]
FRICTION = "obstacle=[{kind='halfspace', name='a', normal=[0, 1], offset=-1.0, friction=0.1, parts=2}]"
TWICE = "control.outputs=[{kind='hand', name='a'}, {kind='hand', name='a'}]"
SENTENCES: list[tuple[Act, str]] = [
    (own_energy("x = 1", "W"), "law.py: it has no function 'W', which tissue.energy = '"),
    (lambda *_: sg.build("paper_forward", ["tissue.energy='given'"]), "the energy was a Python function; build the "),
    (lambda *_: sg.build("paper_forward", terms=[sg.Term("bed", lambda u, v: u[0] * v[0] * ufl.dx(scheme="no"), 1.0)]),
     "the term bed: its form(u, v) cannot be compiled, "),
    (given(surface), "The given mesh is a surface in space (gdim 3); make a plane mesh with gdim = 2."),
    (given(single), "The given mesh has coordinates of float32; make it with float64."),
    (lambda *_: model().with_materials(young=-1.0, poisson=0.3), "young = -1.0, poisson = 0.3: young must be > 0, "),
    (lambda *_: make_midpoint(model().system, 0.1, "cg", touching=True), "contact needs a factor of the step, and 'c"),
    (restored, "the restart file contains 2 rows of the right-hand side, this run 3; "),
    (longer, "it is longer than what was written"),
    (other_line, "a line is not what was written"),
    (no_compiler, "there is no C compiler"),
    (scene("reduction.mu_range=[3.0, 2.0]"), "reduction.mu_range is [3.0, 2.0]; the first must not exceed the second"),
    (scene(TWICE, name="paper_lqr"), "control.outputs[0] and outputs[1] are both named a; name one anew"),
    (scene("effects.obstacles=true", FRICTION), "parts cannot go with friction, which acts on nodes alone; drop one"),
    (scene("motion.target=false"), "motion.target is missing; the quintic profile needs it (profile = 'hold' fo"),
    (scene("motion.profile='hold'"), "motion.target cannot go with profile = 'hold'; only 'quintic' has it"),
    (scene("motion.csv='a.csv'"), "motion.csv and profile = 'csv' go together; give both or neither"),
    (scene("tissue.material={young=1.0, poisson=0.5, rho=1.0}"), "poisson is 0.5; it must lie between -1 and 0.5, "),
    (scene("tissue.refine={tolerance=0.01, grading='off'}"), "grading is 'off'; a tolerance needs graded cells, drop"),
    (scene("tissue.layers.tissue={box=[[0, 0], [1, 1]], material='fat'}"), "layers.tissue is the name of the cells "),
    (scene(*REFINED), "tissue.refine.method is 'lines'; a mesh file has no lines to move, use 'bisect'"),
    (scene("tissue.parameters={a=1.0}"), "parameters needs tissue.energy; give the energy that has them, or drop them"),
    (lambda folder, _: read_csv(written(folder / "m.csv", "0,1,2\n"), 2), "m.csv has 1 rows of numbers; it must have "),
    (lambda folder, _: read_csv(written(folder / "m.csv", "0,1\n1,2\n"), 2), " (time, then one per hand degree of "),
    (patched(pymor, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=2)), pymor.pymor_models),
     "to_pymor runs on one rank, not on 2; save the model and load it there"),
    (elsewhere, "a.h5 belongs to another mesh: its nodes lie elsewhere; load it with its own scene"),
    (of_shape(np.zeros((3, 1))), "the file gave displacements of shape (3, 1); it must give finite ones of shape ("),
    (lambda *_: sg.reduce(*made()[:2], "craig_bampton", Truncation(tol=0.1)), "uses no snapshots, so it has no "),
    (two_parts, "the snapshots of the displacements are zero"),
    (lambda *_: CertifiedModel._given(SimpleNamespace(drive=None, fine=SimpleNamespace(name="a")), None),  # type: ignore[arg-type]
     "give the motion of the hand, or the force on it; the model has none"),
    (lambda *_: ContactModel.deformation(SimpleNamespace(V=None), None),  # type: ignore[arg-type]
     "the contact model was loaded without its columns on the mesh; load it with the layout"),
    (short, "the reduced run has 1 steps, the snapshots reach step "),
    (lambda *_: sg.gradient(made()[0], lambda y: 0.0, dt=0.1), "the gradient of a full model has the steps and the "),
    (lambda *_: run_online(made()[2].at(), dt=0.1), "give either the force on the hand or the motion of the hand"),
    (lambda *_: run_online(made()[2].at(), dt=0.1, force=np.zeros((3, 9))), "the force has the shape (3, 9); it must "),
    (lambda *_: Training.leading(SimpleNamespace(whole=SimpleNamespace(k=3)), 4),  # type: ignore[arg-type]
     "k = 4 must lie between 1 and the 3 columns of the basis"),
    (lambda *_: sg.reduce(*made()[:2], "global_pod", 4).at().equilibrium(), "an equilibrium needs a basis with fixed "),
    (lambda folder, patch: (patch.setitem(__import__("sys").modules, "mujoco", None), mujoco._mujoco()),
     "MuJoCo is not installed; pip install 'softgrasp[mujoco]'"),
    (lambda *_: care.care(E, E, E, E, E, np.zeros((2, 2))), "E is singular to working precision (reciprocal co"),
    (lambda *_: Actuation(delay=1).ticks(0.1), "delay = 1 needs a rate: continuous feedback has no tick to wait for"),
    (lambda *_: Actuation(rate=7.0).ticks(0.1), "rate = 7 Hz means ticks of 0.142857 s, which is no multiple of the "),
    (lambda *_: full_filter(plant(), SimpleNamespace(markers=slice(0, 0)), None, 0.1),  # type: ignore[arg-type]
     "a filter of the full tissue needs markers; give control.observer.markers"),
    (filtered, "the mode at 1/s has no damping; an observer needs it"),
    (met, "a loop at finite strain cannot meet obstacles yet; set one of the two effects to false"),
    (lambda *_: second_order((matrix(E), matrix(np.eye(3)), matrix(E)), E, E), "D is (3, 3) with rows (0, 3); it must"),
    (lambda *_: second_order((matrix(E), matrix(E), matrix(E)), np.eye(3), E), "B and C have 3 and 2 local rows; this"),
    (lambda *_: hand_target(plant(), [1.0, 2.0, 3.0]), "] of the hand must have 2 finite entries"),
    (lambda *_: nearest(E, np.ones(2), limit=0), "the active set of a plan did not settle in 0 steps"),
    (batch("mu\n"), "b.csv: it has no row of numbers below its first line"),
    (batch("mu\nx\n"), "b.csv: row 1: 'x' is not a number"),
    (batch("mu\n1e60\n"), "b.csv: row 1: give a finite number between 1e-50 and 1e50"),
    (batch("mu\n" + 200_000 * "1"), "b.csv: field larger than field limit (131072)"),
    (scene("'a$b'=1"), "is no key; a key has 1 to "),
    (dissected, "the matrix does not have the pattern that was dissected"),
    (other_model("format", "softgrasp 0"), "a.h5 is no reduced model of this version; reduce the scene again"),
    (other_model("", "", scene_hash="0" * 64), "a.h5 was made for another scene (hash "),
    (lambda *_: _check(made()[0].system.layout, made()[0].system, WRONG_SHAPES), "snapshots have the shapes (3, 2), "),
    (unmixed, "a canonical model contains M_ee^-1 and accepts densities that all change by one factor; "),
    (other_density, "a model at finite strain keeps the densities it was made with; reduce the scene again"),
    (endless, "the hand's tables contain numbers that are not finite"),
    (lambda *_: care.riccati_schur(ONE, 0 * ONE, ONE), "the stable subspace of the Hamiltonian matrix gives no sol"),
    (patched(care, "newton_polish", lambda A, G, H, X: (X, np.array([1.0 + 0j]), 1),
             lambda: care.riccati_schur(ONE, ONE, ONE)), "the closed loop computed has the abscissa 1.0e+00, not be"),
    (patched(care.scipy.linalg, "schur", not_sorted, lambda: care.riccati_schur(ONE, ONE, ONE)),
     "the stable eigenvalues of the Hamiltonian matrix cannot be separated from the others (reordering failed): Q"),
    (lambda *_: care.check_seen(0 * ONE, 0 * ONE, 0 * ONE, 0.0), "the reduced equation of order 1 has a solution by "),
    (refused_by_lapack(care, lambda: care.lyapunov(E, E, E)), "the Lyapunov equation of order 2 was refused by LAPACK"),
    (refused_by_lapack(judge, lambda: judge._covariance(E, E, E)), "the Lyapunov equation of order 2 was refused by "),
    (patched(compress.scipy.linalg.lapack, "dpstrf", lambda *_, **__: (E, 0, 0, -3), lambda: compress._leading(E, 0.1)),
     "the Gram matrix of order 2 was refused by LAPACK (info -3)"),
    (lambda *_: adjoint._solve_small(0j * E, 0j * E), "a matrix of order 2 of the feedback or the hand is singular "),
    (blind, "no a-priori gain of small order with tissue in it is certified to be stable"),
    (sampled, "is unstable: its spectral radius from tick to tick is 1.5, which must be below 1; no rate makes it "),
    (patterns, "mass, stiffness and damping have different sparsity patterns; assemble them on one"),
    (lambda *_: sg.abscissa(SimpleNamespace(layout=SimpleNamespace(n_s=0)), SimpleNamespace(block=None)),  # type: ignore[arg-type]
     "the certified abscissa belongs to a hand; without one use softgrasp.lqr.spectrum.modal_loop.ModalLoop"),
    (no_scene, "--fallback full: no scene.toml beside "),
    (outside, "the page needs more than itself: <script src=b"),
    (lambda *_: new_scene(Path("a.tml")), "a.tml: a scene is a TOML file; name it a.toml"),
    (patched(serving, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=2)),
             lambda: serving.run_serve(Path("a"), None, host="", port=0, inputs="mu")),  # type: ignore[arg-type]
     "serve answers on one rank; start it without mpiexec"),
    (lambda *_: parse_tolerance("2"), "--tolerance 2: it must be a number between 0 and 1, such as 1e-3"),
    (patched(processes, "find_mpiexec", lambda: None, lambda: processes.run_ranks([], 2, 1.0)),
     "no mpiexec found; `softgrasp doctor` says what to do"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong(act: Act, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(sentence):
        act(tmp_path, monkeypatch)
