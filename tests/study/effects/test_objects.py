"""PETSc's own log counts the objects that effects make."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.model.build import build
from softgrasp.fem.obstacles.mass import SweptMass
from softgrasp.fem.obstacles.swept import SweptResponses
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.study.effects.measure import counting, difference, memory_by_object, objects_of
from softgrasp.study.shell.timing import RepeatableRun
from tests.helpers.effects import GRAVITY, NEUTRAL, RAYLEIGH, VISCOUS, WEIGHT
from tests.helpers.models import LAYERS, make_scene

# a block that falls on a table from a gap that it closes in the third of 60 steps
LANDING = ["tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "time.steps=60",
           "time.end=0.6", "effects.obstacles=true",
           "obstacle=[{kind='halfspace', name='table', normal=[0, 1], offset=-0.002}]"]  # fmt: skip


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
            objects_of_a_run(comm, effects=effects, output={"snapshots": "none"}, time={"steps": n}) for n in (150, 300)
        )
        assert short == long


@pytest.mark.serial
def test_a_step_in_contact_makes_no_object_and_its_memory_counts(comm: MPI.Intracomm) -> None:
    scene = load_scene("paper_forward", LANDING)
    without = load_scene("paper_forward", [*LANDING[:-2], "effects.obstacles=false"])
    stepper = RepeatableRun(build(scene, comm=comm))
    stepper.seconds_per_step(11)
    contact = stepper.run.contact
    assert contact is not None
    assert contact.table.touching[:11].sum() > 1  # contact in more than one of the steps that are counted
    assert contact.table.impulse[1:11].any()
    sizes, mass = memory_by_object(stepper.run.model, stepper.run), contact.strike.reactions().mass
    assert isinstance(mass, SweptMass)
    assert isinstance(contact.responses, SweptResponses)
    assert sizes["contact.values"] == contact.responses.swept.values.nbytes
    assert sizes["contact.mass.values"] == mass.L.arrays["values"].nbytes
    assert sizes["contact.mass.kept.values"] == mass.kept.values.nbytes
    assert sizes["step.K2.above.values"] == stepper.run.midpoint.K2.above.values.nbytes
    stepper.destroy()
    at_first, in_steps = objects_of(comm, scene)
    assert in_steps == {}
    assert set(difference(at_first, objects_of(comm, without)[0])) == {"Vector"}


@pytest.mark.serial
def test_a_run_in_contact_that_is_taken_back_repeats_itself(comm: MPI.Intracomm) -> None:
    model = build("paper_forward", LANDING, comm)
    expected, stepper = simulate(model).final, RepeatableRun(model)
    stepper.seconds_per_step(100)  # ends in the middle of a second round
    stepper.seconds_per_step(60)
    # the set of pressed nodes is factored in another order
    assert np.abs(stepper.run.state.array - expected).max() <= 1e-9 * np.abs(expected).max()
    stepper.destroy()
