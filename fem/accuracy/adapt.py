"""A mesh that reaches `tissue.refine.tolerance`: graded a priori, estimated, and refined where the outputs need it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.accuracy.estimate import estimate, marked_cells, next_order
from softgrasp.fem.accuracy.krylov import KrylovModel, krylov_model
from softgrasp.fem.errors import SceneError, raise_on_all_ranks
from softgrasp.fem.mesh.grading import bisect, distribute
from softgrasp.fem.mesh.tissue_mesh import TissueMesh, Whole
from softgrasp.fem.model.build import MeshEstimate, Model
from softgrasp.fem.model.build import build as build_on
from softgrasp.fem.model.refined import by_lines, refined_mesh, unknowns
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.file import as_overrides, load_scene_collective
from softgrasp.fem.shown import percent

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene
    from softgrasp.fem.scene.tissue import Refine

# Estimate over tolerance that is let pass. Estimates are 0.5 to 1 of the error: where they lie is known after a pass,
# when the corrected outputs of the new mesh give the error of the old one.
ACCEPTED, SEEN, MOST_ACCEPTED = 0.45, 0.65, 0.8  # unseen; least and most after a pass: what was seen on shipped scenes
MISSED = 2.0  # that of an a-priori mesh which missed its tolerance: there, nothing was promised to the percent
GUESSED = 0.7  # least reduction that a pass aims at: too many cells need more time than another pass
LINE_TRIES, LINE_STEP = 12, 0.7  # the number of lines grows with a small power of the tolerance


def _with_own(scene: Scene, comm: MPI.Intracomm, mesh: Any, tags: tuple[Any, Any], energy: Any, terms: Any) -> Scene:
    """The scene with what `build` was given in Python, whose modules are loaded only then. Collective."""
    if mesh is not None and not isinstance(mesh, TissueMesh):
        from softgrasp.fem.mesh.given import with_given_mesh

        scene = with_given_mesh(scene, comm, mesh, *tags)
    if energy is not None:
        from softgrasp.fem.energy.own import with_energy

        with raise_on_all_ranks(comm):
            scene = with_energy(scene, energy)
    if terms:
        from softgrasp.fem.model.terms import with_terms

        with raise_on_all_ranks(comm):
            scene = with_terms(scene, terms)
    return scene


def build(
    scene: Scene | str | Path,
    overrides: Sequence[str] = (),
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    *,
    mesh: TissueMesh | Any = None,
    cell_tags: Any = None,
    facet_tags: Any = None,
    energy: Any = None,
    terms: Sequence[Any] = (),
    steps: bool = True,
    **tables: Any,
) -> Model:
    """M q'' + D q' + K q = f + B_u u for q = [q_s; q_e], as in [SBRH21]: mesh, assemble, couple. Collective.

    Where the scene has ``tissue.refine.tolerance`` its mesh is refined until the outputs of its run reach it, and
    ``accuracy`` says what is left; with ``passes = 0`` the mesh is the a-priori one, which nothing estimates here.

    Args:
        scene: a scene, the path of its file, or the name of one that ships.
        overrides: "section.key=value" each, as after ``--set``; for a file or a name.
        tables: the same by sections, ``tissue={"cells": [4, 8]}``.
        mesh: a DOLFINx mesh, or what `dolfinx.io.gmsh.model_to_mesh` returns, in the place of the scene's box or file
            (:func:`softgrasp.fem.mesh.given.with_given_mesh`); a `TissueMesh` as it is; None makes that of the scene.
        cell_tags: marks of the cells of a DOLFINx mesh, (`dolfinx.mesh.MeshTags`), for ``tissue.layers.NAME.tag``.
        facet_tags: marks of its facets, for ``contact.facet_tag``.
        energy: W(F, p), energy per volume of the rest state [J/m^3] in UFL, instead of ``tissue.energy``: F is the
            deformation gradient, p has ``mu`` and ``lam`` of the material, the names of ``tissue.parameters``, the
            place ``x`` at rest and the dimension ``d``. Its tangent at rest is K; with ``effects.finite_strain`` it
            is the law.
        terms: own terms of stiffness, damping, mass and load, :class:`softgrasp.fem.model.terms.Term` each.
        steps: whether the time steps have to carry the tolerance too: those of the scene's own run.

    Raises:
        SceneError, MeshError: with one sentence that names the key or the file; the time step leaves more than the
            tolerance.
        SolverError: a static solve of the estimate fails.
        ResourceError: see :func:`softgrasp.fem.model.build.build`.

    >>> import softgrasp as sg
    >>> sg.build("paper_forward").states
    1916
    >>> sg.build("paper_forward", tissue={"cells": [4, 8]}).states
    160
    """
    begin = time.perf_counter()
    keys = [*overrides, *as_overrides(tables)]
    given = mesh is not None and not isinstance(mesh, TissueMesh)
    if given or energy is not None or terms:
        if isinstance(scene, str | Path):  # else keys are refused below, as beside every scene that is loaded
            # without an energy the parameters of one are refused
            named = [] if energy is None else ['tissue.energy="given"']
            scene, keys = load_scene_collective(comm, scene, [*keys, *named]), []
        scene, mesh = _with_own(scene, comm, mesh, (cell_tags, facet_tags), energy, terms), None if given else mesh
    model = build_on(scene, keys, comm, mesh=mesh)
    scene, refine = model.scene, model.scene.tissue.refine
    if refine is None or refine.tolerance is None or refine.passes == 0 or mesh is not None:
        return model
    passes, aim, accepted = 0, refine.tolerance, ACCEPTED
    last: tuple[Array, Array] | None = None
    while True:
        small, finer = krylov_model(model), krylov_model(next_order(model))
        result, outputs = estimate(model, small, finer), small.run.deformation
        if last is not None:
            accepted = _effectivity(last[1], outputs + result.delta - last[0], result.delta)
        last = outputs, result.delta
        if passes == 0 and steps:
            _check_steps(scene, refine.tolerance, result.time_error)
        reached = result.estimate <= accepted * refine.tolerance
        obstacle = "" if reached else f"tissue.refine.passes = {refine.passes} are used up"
        if not reached and passes < refine.passes:
            factor = 0.9 * max(accepted, GUESSED) * refine.tolerance / result.estimate
            aim *= factor
            mesh = _finer(small, finer, refine, aim, factor)
            if mesh is None:
                obstacle = f"tissue.refine.most = {refine.most} unknowns allow no finer mesh"
        if mesh is None:
            spent = comm.allreduce(time.perf_counter() - begin, MPI.MAX)
            model.watch.seconds["mesh"] = spent - model.watch.seconds["assembly"]  # with all passes and estimates
            return replace(
                model, accuracy=replace(result, tolerance=refine.tolerance, passes=passes, obstacle=obstacle)
            )
        model, passes, mesh = build_on(scene, comm=comm, mesh=mesh), passes + 1, None


def adapted_mesh(model: Model) -> TissueMesh | None:
    """The mesh that the tolerance of a scene led to, for variants of the scene; None where each makes its own."""
    return None if model.accuracy is None else model.space.mesh


def _effectivity(old: Array, error: Array, new: Array) -> float:
    """Estimate over error, e, from the estimates on two meshes, within what has been seen.

    The corrected outputs of the new mesh still miss the share 1 - e of its error, and measure m = old / error =
    e / (1 - (1 - e) r) with r = new / old; solved for e.
    """
    a, b, c = (float(np.linalg.norm(part, axis=1).max()) for part in (old, error, new))
    m, r = a / max(b, 1e-300), c / max(a, 1e-300)
    value = m * (1 - r) / (1 - m * r) if m < 1 and r < 1 else 1.0
    return float(np.clip(value, SEEN, MOST_ACCEPTED))


def estimated(model: Model, *, surplus: bool = False, cells: list[int] | None = None) -> MeshEstimate:
    """The estimate of a model that was built without one, against the tolerance of its scene if it has one. Collective.

    Raises SolverError, SceneError, MeshError: see :func:`softgrasp.fem.accuracy.estimate.estimate`.
    """
    result, refine = estimate(model, surplus=surplus, cells=cells), model.scene.tissue.refine
    if refine is None or refine.tolerance is None:
        return result
    limit, cause = (
        (MISSED, "tissue.refine.passes = 0 allow no better mesh")
        if refine.passes == 0
        else (ACCEPTED, "its mesh is not one that was refined for this model")
    )
    obstacle = cause if result.estimate > limit * refine.tolerance else ""
    return replace(result, tolerance=refine.tolerance, obstacle=obstacle)


def _check_steps(scene: Scene, tolerance: float, error: float) -> None:
    if error > tolerance:
        steps = int(scene.time.steps * (2 * error / tolerance) ** 0.5) + 1
        raise SceneError(
            f"tissue.refine.tolerance = {tolerance:g} is below the error of {percent(error)} that "
            f"time.steps = {scene.time.steps} leave on any mesh: use at least {steps} steps or a larger tolerance."
        )


def _finer(small: KrylovModel, finer: KrylovModel, refine: Refine, aim: float, factor: float) -> TissueMesh | None:
    """The next mesh, or None if it has too many unknowns. Collective."""
    model = small.model
    comm, scene = model.system.layout.comm, model.scene
    if by_lines(scene):
        return _more_lines(model, aim)
    marked = marked_cells(small, finer, factor)
    whole: Whole | None = None
    with raise_on_all_ranks(comm):
        if model.space.mesh.whole is not None and marked is not None:
            whole = bisect(model.space.mesh.whole, marked)
            if unknowns(whole, scene.tissue.order) > refine.most:
                whole = None
    if not comm.bcast(whole is not None):
        return None
    return distribute(comm, whole)


def _more_lines(model: Model, aim: float) -> TissueMesh | None:
    """The first box with more lines for an aim that falls, or None if it has too many unknowns. Collective."""
    comm, scene, d = model.system.layout.comm, model.scene, model.space.mesh.dimension
    cells = model.space.mesh.mesh.topology.index_map(d).size_global
    for _ in range(LINE_TRIES):
        mesh = refined_mesh(comm, scene, aim)
        if mesh.mesh.topology.index_map(d).size_global > cells:
            return mesh
        aim *= LINE_STEP
    return None
