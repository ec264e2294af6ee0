"""Every basis at every N against the full run: errors, times, stability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np
from mpi4py import MPI

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.scene.control import Reduction
from softgrasp.reduction.bases import registry
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.bases.states import BasisError, States
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.errors import Comparison
from softgrasp.reduction.model import ModelError, ReducedModel
from softgrasp.reduction.online import run
from softgrasp.reduction.projection import project
from softgrasp.reduction.replay import FullRun, comparison_of, replay_inputs
from softgrasp.study.reduce.result import MethodSweep, Point, kept_points
from softgrasp.study.shell.timing import median_seconds

FURTHER = ("psd_svd_like", "psd_svd_like_fixed", "psd_cotangent_lift_fixed", "psd_fixed_relative", "craig_bampton")
REPEATS, SETUPS = 15, 7  # behind each median of the online time and of the set-up

Progress = Callable[[str, int, int], None]
"""Called with the method, what is done and what there is."""


def chosen_methods(options: Reduction) -> tuple[str, ...]:
    """Methods of the scene, or the paper's six and further ones. Raises BasisError: a name is unknown."""
    names = tuple(options.methods) or (*registry.PAPER_METHODS, *FURTHER)
    for name in names:
        registry.find_method(name)
    return names


def bases_of(
    name: str, states: States, sizes: list[int], options: Reduction, refused: dict[int, str]
) -> tuple[tuple[Basis, ...], int | None]:
    """Bases at all sizes that the snapshots carry, and the columns that keep the scene's share of the energy.

    What does not fit is put into ``refused`` by its N, with the reason. Collective.
    """
    method = registry.METHODS[name]
    inner = None if options.inner == "auto" or not method.snapshots else options.inner
    rule = [Truncation(energy=options.energy)] if method.snapshots else []
    sizes = list(sizes)
    while sizes or rule:
        try:
            bases = registry.make_bases(name, states, [*sizes, *rule], inner, options.engine)
        except BasisError as error:
            most = error.most
            larger = [N for N in sizes if most is not None and most < N]
            if not larger and rule:
                rule = []  # it may be the share that fails; what fails in general fails again
                continue
            limit = "the snapshots carry above rounding" if method.snapshots else "this mesh has modes for"
            reason = f"more than {limit}; ask for N <= {most}" if larger else error.reason
            refused |= dict.fromkeys(larger or sizes, reason)
            sizes = [N for N in sizes if larger and N not in larger]
        else:
            return bases[: len(sizes)], bases[-1].N if rule else None
    return (), None


def measure(model: ReducedModel, full: FullRun, comparison: Comparison | None = None) -> Point:
    """Run one reduced model at the scene's own parameter and compare. Collective.

    ``comparison``: of the largest model of the family; None prepares one for this model alone.

    Raises ModelError: E or A is singular, so that the model has no run or no equilibrium to start in.
    """
    layout = full.model.system.layout
    comparison = comparison or comparison_of(model, full)
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        small = model.at()
        step, drive = replay_inputs(model, small, full)
        errors = comparison.errors(model, small, run(step, allow_unstable=True, **drive))
        setup = median_seconds(layout.comm, lambda: replay_inputs(model, model.at(), full)[0].stable, SETUPS)
        online = median_seconds(layout.comm, lambda: run(step, allow_unstable=True, **drive), REPEATS)
    return Point(
        N=model.N,
        N_tissue=model.N - (2 * layout.n_s if model.fixed_solid else 0),
        split=model.split,
        **asdict(errors),
        projection_error_deformation=comparison.projection_error("deformation", model, small),
        projection_error=comparison.projection_error("velocities", model, small),
        time_offline=float(layout.comm.allreduce(sum(model.seconds.values()), MPI.MAX)),
        time_setup=setup,
        time_online=online,
        spectral_abscissa=small.spectral_abscissa,
        stable=small.stable,
    )


def sweep(name: str, full: FullRun, options: Reduction, progress: Progress | None = None) -> MethodSweep:
    """One method at all its N. Collective. Raises SolverError: a factorisation failed."""
    scene, system, method = full.model.scene, full.model.system, registry.METHODS[name]
    states = States(system, ((system, full.snapshots),))
    refused = registry.impossible_sizes(method, system.layout.n_s, options.N)
    bases, kept = bases_of(
        name, states, registry.possible_sizes(method, system.layout.n_s, options.N), options, refused
    )
    outputs, key = make_outputs(scene, system), scene_hash(scene)
    points: list[Point] = []
    models: dict[int, ReducedModel] = {}
    # smaller bases are leading columns of the largest: one factorisation gives the errors of all
    comparison = comparison_of(project(bases[-1], system, outputs, key), full) if bases else None
    for i, basis in enumerate(bases):
        if progress is not None:
            progress(name, i, len(bases))
        model = project(basis, system, outputs, key)
        try:
            points.append(measure(model, full, comparison))
        except ModelError as error:
            refused[basis.N] = error.reason
            continue
        models[len(points) - 1] = model
        models = {j: models[j] for j in models if j in kept_points(points)}
    return MethodSweep(
        method=method,
        points=tuple(points),
        models=models,
        sigma=bases[0].sigma if bases else (),
        refused=dict(sorted(refused.items())),
        N_energy=kept,
        inner=bases[0].inner if bases else "",
    )
