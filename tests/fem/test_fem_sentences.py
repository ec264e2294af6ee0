"""Sentences of `fem` that no other test asks for: the bad call, and the sentence that refuses it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import ufl
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.checksums import read_arrays, read_manifest
from softgrasp.fem.errors import Interrupted
from softgrasp.fem.fields import vtu
from softgrasp.fem.frame import balance
from softgrasp.fem.mesh.cells import check_straight
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.mesh.tissue_mesh import structured_mesh
from softgrasp.fem.model import contact
from softgrasp.fem.obstacles import small
from softgrasp.fem.obstacles.coulomb import Coulomb
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.run.contact import rest
from softgrasp.fem.run.contact.finite import FiniteContactMidpoint
from softgrasp.fem.run.frame.midpoint import LinearTurningStep
from softgrasp.fem.run.simulate import RunOptions
from softgrasp.fem.run.states import checkpoint
from softgrasp.fem.run.states import streamed as streamed_snapshots
from softgrasp.fem.scene.text import BYTES
from softgrasp.fem.solve import modes, solvers
from tests.helpers.sentences import refused
from tests.test_failed_solves import Failing, broken

pytestmark = pytest.mark.serial
Act = Callable[[Path, pytest.MonkeyPatch], Any]
SMALL = "tissue.cells=[2, 4]"
STEPS = "time.steps=4"


def scene(*keys: str, name: str = "paper_forward") -> Act:
    return lambda *_: sg.load_scene(name, list(keys))


def model(*keys: str, name: str = "paper_forward", **given: Any) -> sg.Model:
    return sg.build(name, [SMALL, *keys], **given)


def build(*keys: str, name: str = "paper_forward", **given: Any) -> Act:
    return lambda *_: model(*keys, name=name, **given)


def run(*keys: str, name: str = "paper_forward", force: Any = None) -> Act:
    return lambda *_: sg.simulate(model(*keys, name=name), force=force)


def materials(**values: Any) -> Act:
    return lambda *_: model().with_materials(**values)


def own(W: Callable[..., Any]) -> sg.Model:
    return model("tissue.parameters={a=1.0}", energy=W)


def solid(F: Any, p: Any) -> Any:
    return p.a * (ufl.tr(F.T * F) - 2 - 2 * ufl.ln(ufl.det(F)) + (ufl.det(F) - 1) ** 2)


def term(form: Callable[..., Any], value: float = 1.0) -> Act:
    return build(terms=[sg.Term("bed", form, value)])


def meshed(path: Path, *keys: str) -> sg.Model:
    without = [f"tissue.{key}=false" for key in ("size", "cells", "origin")]
    return sg.build("paper_forward", [*without, f"tissue.mesh='{path}'", *keys])


def written(path: Path, kind: str, *cells: list[int]) -> Path:
    meshio.write(path, meshio.Mesh(np.random.default_rng(0).random((6, 3)), [(kind, np.array(cells))]))
    return path


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def long(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(BYTES + 1)
    return path


def moved_by(content: str) -> Act:
    keys = ["motion.profile='csv'", "motion.target=false"]
    return lambda folder, _: sg.simulate(model(*keys, f"motion.csv='{text(folder / 'm.csv', content)}'"))


def posed(content: str) -> Act:
    keys = ["tissue.cells=[2, 2, 2]", "motion.profile='csv'", "motion.target=false", "effects.rotation=true"]
    return lambda folder, _: sg.simulate(
        sg.build("block_3d", [*keys, f"motion.csv='{text(folder / 'm.csv', content)}'"])
    )


def not_finite(*_: Any) -> np.ndarray:
    return np.full(2, np.nan)


def stopped(folder: Path, until: int = 2, *keys: str, **how: Any) -> None:
    with pytest.raises(Interrupted):
        sg.simulate(model(STEPS, *keys), RunOptions(folder, until=until, **how))


def changed_since(folder: Path, _: Any) -> None:
    stopped(folder)
    sg.simulate(model(STEPS, "tissue.material.mu=7.0"), RunOptions(folder, resume=True))


def until_before(folder: Path, _: Any) -> None:
    stopped(folder)
    sg.simulate(model(STEPS), RunOptions(folder, resume=True, until=1))


def streamed(damage: Callable[[Path], Any]) -> Act:
    def act(folder: Path, _: Any) -> None:
        stopped(folder, 2, "output.snapshots='hdf5'")
        damage(folder / "snapshots-rank0.h5")
        sg.simulate(model(STEPS, "output.snapshots='hdf5'"), RunOptions(folder, resume=True))

    return act


def no_room(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr("shutil.disk_usage", lambda _: type("Disk", (), {"free": 1000})())
    sg.simulate(model(STEPS, "output.snapshots='hdf5'"), RunOptions(folder))


def no_contact_in_c(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(small, "contact_library", lambda: None)
    small.SmallProblem("C")


def unbounded(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Coulomb, "_attempt", lambda *_: False)
    patch.setattr(Coulomb, "_pivot", lambda *_: False)
    patch.setattr(Coulomb, "_grow", lambda *_: False)
    Coulomb(1, "NumPy").solve(1, np.eye(2), -np.ones(2), np.ones(1), 1e-9)


def no_rest(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(rest, "MOST", 0)
    sg.simulate(model("tissue.cells=[6, 4]", name="push_disc"))


def bad_mode(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(modes, "RESIDUAL", -1.0)
    modes.lowest_modes(model().system, 2)


def at_rest(system: ReducedSystem) -> Act:
    return lambda *_: system.rest_at(np.zeros(1))


def changed_list(folder: Path, _: Any) -> None:
    vtu.Collection(folder / "a.pvd", "a run").add(0.5, folder / "a.vtu", "1:2")
    content = (folder / "a.pvd").read_text()
    vtu.Collection.read(text(folder / "a.pvd", content.replace("0.5", "0.7")))


def other_file(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["Z"]
        file["Z"] = np.zeros((1, 1))


def unsealed(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        Z = file["Z"][()]
        del file["Z"]
        file["Z"] = Z


def no_space(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def full_disk(module: Any, name: str, *keys: str, **how: Any) -> Act:
    """A run where this step of writing finds the disk full."""

    def act(folder: Path, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(module, name, no_space)
        sg.simulate(model(STEPS, *keys), RunOptions(folder, **how))

    return act


def in_the_way(name: str) -> Act:
    """A run that finds a folder in the place of its file."""

    def act(folder: Path, _: Any) -> None:
        (folder / name).mkdir()
        sg.simulate(model(STEPS, "output.snapshots='hdf5'"), RunOptions(folder))

    return act


def hinged(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Two squares that meet in a node, where no loose part may be."""
    patch.setattr(contact, "MOST_LOOSE", 0)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0]], dtype=float)
    triangles = np.array([[0, 1, 3], [0, 3, 2], [3, 4, 5]])
    meshio.write(folder / "a.vtu", meshio.Mesh(points, [("triangle", triangles)]))
    meshed(folder / "a.vtu", "contact.sides=['bottom']", "contact.box=false")


def no_passes(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(small, "PASSES", 0)
    problem = small.DependentProblem("NumPy")
    problem.restart(np.eye(1), np.array([0]))
    problem.solve(1, np.eye(1), -np.ones(1), 1e-9)


def lacking(name: str, call: Callable[[], Any]) -> Act:
    """A call where an optional package is not installed."""

    def act(_: Path, patch: pytest.MonkeyPatch) -> None:
        patch.setitem(sys.modules, name, None)
        call()

    return act


def pressed(**parts: Any) -> Act:
    """A step with contact at finite strain, in this state."""
    law = SimpleNamespace(law=SimpleNamespace(name="stvk"))
    step: Any = SimpleNamespace(free_load=0.0, w_array=0.0, body=law, **parts)
    return lambda *_: FiniteContactMidpoint.press(step, np.zeros(1), np.zeros(1))


def no_root(_: Path, patch: pytest.MonkeyPatch) -> None:
    """A run in the frame of the hand in which Newton's method does not converge."""
    patch.setattr(LinearTurningStep, "_find", lambda *_: SimpleNamespace(iterations=-1, norm=1.0))
    sg.simulate(model("effects.finite_strain=false", name="turn_over"))


def wrong_solve(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(solvers.TissueSolver, "residual", lambda *_: 1.0)
    patch.setattr(solvers, "DIRECT_ERROR", -1.0)
    sg.simulate(model(STEPS))


def hand_does_not_settle(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(balance, "MOST", 0)
    sg.simulate(model(name="turn_over"), force=lambda *_: np.zeros(3))


def hash_of_a_folder(folder: Path, _: Any) -> None:
    keys = ["motion.profile='csv'", "motion.target=false", f"motion.csv='{folder}'"]
    scene_hash(sg.load_scene("paper_forward", keys))


E = np.eye(2)
PLANT = ReducedSystem(E, -E, np.ones((2, 1)), E, np.zeros(2), np.zeros((1, 2)), np.zeros((1, 2)))
LAYER = "tissue.layers.a={box=[[0, 0], [1, 1]], material='fat', beta=1.0}"
CSV = "0,0,0\n1,0,0\n"
SENTENCES: list[tuple[Act, str]] = [
    (scene("effects.damping={kind='rayleigh', alpha=1.0, beta=0.01, drag='space'}", name="turn_over"),
     "effects.damping.drag = 'space' cannot go with effects.frame yet; use drag = 'hand'"),
    (scene("tissue.refine={tolerance=0.01}", name="turn_over"),
     "tissue.refine.tolerance cannot go with effects.frame, as its estimate leaves out large rotations; drop it"),
    (scene("tissue.refine={tolerance=0.01}", name="set_down"),
     "tissue.refine.tolerance cannot go with effects.obstacles, as its estimate leaves them out; drop it"),
    (scene("time.solver='cg'", name="set_down"), "time.solver is 'cg'; effects.obstacles needs a factor, use 'auto'"),
    (build(terms="bed"), "terms is 'bed'; give a list of softgrasp.Term(name, form, value)"),
    (lambda *_: model("control.outputs=[{kind='region', name='far', box=[[8, 8], [9, 9]]}]").outputs,
     "control.outputs[0].box = [[8.0, 8.0], [9.0, 9.0]] has no free node of the body; move or enlarge it"),
    (lambda *_: sg.gradient(own(solid), lambda y: 0.0), "a gradient is by lambda, mu, rho and beta, and cannot go with "
     "tissue.energy or own terms yet"),
    (lambda folder, _: read_manifest(folder / "a.json", 1), "a.json does not exist; run once without --resume"),
    (lambda folder, _: read_manifest(text(folder / "a.json", "[]"), 1), "a.json is damaged: it has no table; "),
    (lambda folder, _: read_manifest(text(folder / "a.json", '{"format": 1}'), 1),
     "a.json is damaged: its SHA-256 is not that of its contents; "),
    (lambda folder, _: read_arrays(folder / "a.npz", ""), "a.npz cannot be read (No such file or directory); "),
    (lambda folder, _: read_arrays(text(folder / "a.npz", ""), ""), "its SHA-256 is not that of its manifest; "),
    (build(energy=3), "energy is 3; give a function W(F, p) that returns an energy in UFL"),
    (lambda *_: own(lambda F, p: p.a * ufl.ln(ufl.tr(F.T * F) - 2)), "stress and tangent at rest in the tissue are no "
     "numbers; check W near F = I"),
    (lambda *_: own(lambda F, p: 1 / 0), "the energy W(F, p) ended with ZeroDivisionError: division by zero"),
    (lambda folder, _: sg.load_scene(pipe(folder / "a.toml")), "(it is a pipe; write it to a file first)"),
    (lambda *_: check_straight(np.zeros((5, 2)), np.arange(5)[None], "triangle", "triangle5", "a.msh"),
     "a.msh has cells of type triangle5 with 5 nodes: export the mesh with linear cells."),
    (lambda folder, _: meshed(written(folder / "a.vtu", "line", [0, 1])), "has cells of type line: only triangles, "),
    (lambda *_: meshed(Path("nowhere.vtu")), "nowhere.vtu does not exist: tissue.mesh is relative to the scene file."),
    (lambda *_: structured_mesh(MPI.COMM_SELF, [0.0, 1.0], [2, 2]), "tissue.size [0.0, 1.0] and tissue.cells [2, 2] "
     "must be positive."),
    (build("tissue.cells=[1, 1]", "contact.box=[[0, 0], [1, 2]]"), "every node lies in the contact zone; make"),
    (materials(mu="x"), "mu = 'x' must be a number"),
    (materials(young=3.0), "young and poisson go together, without lam and mu; give one pair"),
    (build("contact.box=[[7, 7], [8, 8]]"), "No boundary facet of the structured mesh has its midpoint in the contact "
     "zone contact.sides = ['left', 'right'] and contact.box = [[7.0, 7.0], [8.0, 8.0]]: the boundary spans (0, 0) to"),
    (run("control.outputs=[{kind='node', point=[9.0, 9.0]}]", name="paper_lqr"), "control.outputs[0].point = [9.0, "
     "9.0] lies outside the body, which spans [0.0, 0.0] to"),
    (lambda *_: model("tissue.cells=[6, 4]", name="push_disc", terms=[sg.Term("bed", lambda u, v: u[0] * v[0] * ufl.dx,
     1.0, adds="mass")]), "the term bed adds a mass, which effects.obstacles cannot go with; leave one out"),
    (term(lambda u, v: ufl.inner(u, v) * ufl.ds(7)), "the term bed adds nothing to the stiffness; check its form, "),
    (term(lambda u, v: 1e300 * ufl.inner(u, v) * ufl.ds, 1e300), "the term bed adds no finite number to the "),
    (term(lambda u, v: u[0] * v[1] * ufl.ds), "the term bed is not symmetric in u and v; a spring has an energy"),
    (term(lambda u, v: v[0] * ufl.ds), "the term bed must be a bilinear form in u and v on cells (dx) or the boundary"),
    (unbounded, "no solution was found for the friction of 1 nodes"),
    (no_contact_in_c, "compiled contact is not available here; leave the engine out"),
    (at_rest(ReducedSystem(E, -E, np.zeros((2, 1)), E, np.zeros(2), np.zeros((1, 2)), np.zeros((1, 2)))),
     "the reduced plant has no unique state of rest for a position of the hand"),
    (lambda *_: PLANT.under(np.zeros((2, 2))),
     "the gain has the shape (2, 2); this plant needs finite numbers of shape"),
    (changed_since, "was written with tissue.material.mu = 50.0, this run has 7.0; resume with the same scene"),
    (until_before, "the run is at step 2 already; --until must be larger, not 1"),
    (streamed(Path.unlink), "snapshots-rank0.h5 cannot be read ("),
    (streamed(lambda path: text(path, "no HDF5")), "snapshots-rank0.h5 cannot be read ("),
    (no_room, "output.snapshots: 5 columns of "),
    (no_rest, "contact: no equilibrium with the obstacles after 0 rounds; move them, or set time.start = 'rest'"),
    (run("motion.drive='force'", force=not_finite), "the force on the hand is nan in x in step 1, at t = "),
    (run("tissue.cells=[2, 4]", name="turn_over", force=lambda *_: np.full(3, np.nan)),
     "the force on the hand is nan in step 1; it must be finite"),
    (run("effects.finite_strain={law='stvk'}", "motion.duration=1e-3", "time.end=2e-3", STEPS),
     ", where the law describes no solid; use effects.finite_strain.law = 'neo-hooke', a gentler motion or a stiffer "),
    (scene("control.R=[[1.0, 2.0], [2.0, 1.0]]", name="paper_lqr"), "control.R has the eigenvalue -1; all must be > 0"),
    (scene("control.R=0.0", name="paper_lqr"), "control.R is 0.0; it must be > 0"),
    (scene(LAYER), "tissue.layers.a.beta needs effects.damping; give it or drop beta"),
    (moved_by("0,0,0\n0.1,0,0\n"), "m.csv covers 0 to 0.1 s, the run needs 0 to "),
    (moved_by("0,0,0\n0.1,nan,0\n"), "has nan as column 2, at t = 0.1 s, in data row 2; give finite numbers"),
    (run("motion.profile='csv'", "motion.target=false", "motion.csv='nowhere.csv'"),
     "nowhere.csv cannot be read (No such file or directory); name an existing CSV file"),
    (lambda folder, _: sg.load_scene(long(folder / "a.toml")),
     "the scene file is larger than 64 MiB; give a text file"),
    (scene("tissue.material={young=1.0, rho=1.0}"),
     "tissue.material.poisson is missing; young and poisson go together"),
    (scene("tissue.material={young='a', poisson=0.1, rho=1.0}"), "tissue.material.young is 'a'; it must be a number"),
    (scene("tissue.material={young=inf, poisson=0.1, rho=1.0}"), "tissue.material.young is inf; it must be finite"),
    (scene("tissue.material={young=-1.0, poisson=0.1, rho=1.0}"), "tissue.material.young is -1.0; it must be > 0"),
    (scene("tissue.mesh='a.msh'", "tissue.size=false", "tissue.cells=false", "tissue.refine={method='lines'}"),
     "tissue.refine.method is 'lines'; a mesh file has no lines to move, use 'bisect'"),
    (scene("tissue.scale=2.0"), "tissue.scale needs tissue.mesh; a structured box has no use for it"),
    (scene("tissue.layers.a={tag=2, material='fat'}"), "layers.a.tag needs tissue.mesh; on a structured box give box"),
    (scene("obstacle=[{kind='polygon', name='a', points=[[0, 0, 0], [1, 1], [1, 0]]}]", name="push_disc"),
     "points[0] has 3 entries; it must have 2"),
    (lambda folder, _: vtu.Collection.read(text(folder / "a.pvd", "x")), "it is not whole"),
    (lambda folder, _: vtu.check_file(text(folder / "a", "xy"), "2:0"), "it is not what was written"),
    (hand_does_not_settle,
     "the hand's velocity in a step does not converge, where it turns by 0 rad; use more time.steps"),
    (hash_of_a_folder, "cannot be read (Is a directory)"),
    (hinged, "1 parts of a.vtu have no contact facet and hang on the rest by single nodes or edges: join the cells "),
    (no_passes, "contact: 0 passes leave the forces of 1 points open; lower obstacle.parts"),
    (lacking("pymor.models.iosys", lambda: model().to_pymor()),
     "pyMOR is not installed; `pip install pymor` brings it"),
    (lacking("control", PLANT.to_control), "python-control is not installed; `pip install control` brings it"),
    (pressed(jump=1), "contact at finite strain cannot act in a step that is divided into substeps; raise time.steps"),
    (pressed(jump=None, _find=lambda *_, **__: SimpleNamespace(iterations=-1)),
     "contact at finite strain (stvk): the step does not converge under the forces of the obstacles; raise "),
    (no_root, "the step does not converge, with |R| at "),
    (in_the_way("snapshots-rank0.h5"), "; choose another --out"),
    (in_the_way("snapshots.h5"), "; remove it or free the disk"),
    (streamed(other_file), "snapshots-rank0.h5 has (1, 1) numbers, this run needs (5, "),
    (streamed(unsealed), "snapshots-rank0.h5 is damaged (its numbers have no checksums); run again without --resume"),
    (full_disk(streamed_snapshots, "reserve_room", "output.snapshots='hdf5'"),
     "snapshots-rank0.h5 cannot be written ([Errno 28]"),
    (full_disk(checkpoint, "write_manifest", until=2),
     "checkpoint.json cannot be written ([Errno 28] No space left on "),
    (lambda *_: modes._solve(Failing(solve=broken), model().system, 2, [], []),  # type: ignore[arg-type]
     "modes: the iteration with the 22 x 22 stiffness failed (error code 76); check material, mesh and contact zone"),
    (wrong_solve, "the matrix is singular, indefinite or badly scaled: check material, mesh and contact zone"),
    (lambda *_: solvers._factor(Failing(setUp=broken), Failing(getSize=lambda: (4, 4)), "cholesky"),  # type: ignore[arg-type]
     "cholesky: the factorisation of the tissue matrix (n_e = 4) failed (PETSc error 76); check material and mesh"),
    (run("effects.finite_strain={law='stvk'}", "effects.gravity=[0.0, -1e5]", "time.start='equilibrium'", STEPS),
     "finite strain (stvk): no equilibrium beyond "),
    (bad_mode, "modes: mode 1 has the relative residual "),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong(act: Act, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(sentence):
        act(tmp_path, monkeypatch)
