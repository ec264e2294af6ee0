"""PETSc's own log counts the objects that effects make."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.study.effects.measure import counting, difference, objects_of
from tests.helpers.effects import GRAVITY, NEUTRAL, RAYLEIGH, VISCOUS, WEIGHT
from tests.helpers.models import LAYERS, make_scene


def objects_of_a_run(comm: MPI.Intracomm, **tables: Any) -> dict[str, int]:
    """What PETSc's own log counts as created by build and run, by class; it knows nothing of our bookkeeping."""
    with counting(comm) as made:
        simulate(build(make_scene(**tables), comm=comm))
    return made


def test_petsc_counts_the_same_objects_for_effects_that_are_off(comm: MPI.Intracomm) -> None:
    bare = objects_of_a_run(comm)
    assert bare["Matrix"] > 5  # three parts, M, K and S, and what assembly needs
    for effects in NEUTRAL:
        assert objects_of_a_run(comm, effects=effects) == bare, effects
    for effects in (GRAVITY, WEIGHT, {"reaction": True}):  # on, but they share what is there
        assert objects_of_a_run(comm, effects=effects) == bare, effects
    assert difference(objects_of_a_run(comm, effects=VISCOUS), bare) == {"Vector": 1}  # K z of the last step
    two = objects_of_a_run(comm, tissue={"layers": {"core": LAYERS["core"]}})
    assert two["Matrix"] > bare["Matrix"]  # the count can tell


def test_gravity_allocates_what_explain_says(comm: MPI.Intracomm) -> None:
    """Nothing, also where it is tried from equilibrium: that start has a solver of its own."""
    weighing = make_scene(effects=GRAVITY, time={"start": "equilibrium"})
    assert EFFECTS["gravity"].operators(weighing) == ()
    assert difference(objects_of_a_run(comm, effects=GRAVITY, time={"start": "equilibrium"}), objects_of_a_run(comm))
    assert objects_of(comm, weighing) == objects_of(comm, make_scene())


def test_petsc_counts_no_object_made_in_a_step(comm: MPI.Intracomm) -> None:
    """As many for twice the steps, with everything on and with everything off."""
    everything = GRAVITY | RAYLEIGH | {"reaction": True, "rotation": True}
    for effects in ({}, everything):
        short, long = (
            objects_of_a_run(comm, effects=effects, output={"snapshots": "none"}, time={"steps": n}) for n in (30, 60)
        )
        assert short == long
