"""Hard cases of the estimated error of the mesh: meshes of a few cells, materials far from the scene's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from softgrasp.fem.accuracy.estimate import estimate
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from tests.hardcases.cases import Family, HardCase, Outcome, here, make, textbook, thin

STEPS = "time.steps=150"
FINE = ("tissue.cells=[32, 64]", "tissue.order=2")  # of the true error: 16 times finer and of the next order
HELD = {
    "at the top": (
        "contact={sides=['top'], box=[[0.0, 1.9], [1.0, 2.0]]}", "control.outputs=[{kind='node', point=[1.0, 0.0]}]"),
    "on both sides": (
        "contact={sides=['left', 'right'], box=[[0.0, 0.0], [1.0, 2.0]]}",
        "control.outputs=[{kind='node', point=[0.5, 1.0]}]"),
}  # fmt: skip
REASON = "the bound must not lie below the true error, which a mesh of the next order and 32 x 64 cells tells"


def deformation(model: Model) -> Array:
    """Outputs against the hand over the run, (steps + 1, p) [m]."""
    run = simulate(model)
    return np.asarray(run.outputs - run.outputs_rigid)


def _largest(y: Array) -> float:
    return float(np.abs(y).max())


def over_bound(model: Model, truth: Array) -> float:
    """True error over the bound of the estimate, both over the largest deformation."""
    return _largest(deformation(model) - truth) / _largest(truth) / estimate(model).bound


def over_index(model: Model, halved: Model, truth: Array) -> Outcome:
    """True error over the grid convergence index of two meshes [R94], and in words over the bare change by halving.

    With the formal order p of displacements the index of the coarse one is 3 |change| 2^p / (2^p - 1).
    """
    y, r = deformation(model), 2.0 ** (model.scene.tissue.order + 1)
    change, error = _largest(y - deformation(halved)), _largest(y - truth)
    return Outcome(error / (3 * change * r / (r - 1)), f"over the change alone {error / change:.1f}")


def tiny_rows(quick: bool) -> Iterator[HardCase]:
    """Meshes of one to four cells a side, which have fewer unknowns than the estimate likes to take columns."""
    cases = [("at the top", 1, 1, 1), ("at the top", 1, 2, 2), ("at the top", 2, 2, 1), ("on both sides", 2, 2, 1)]
    if not quick:
        cases += [("at the top", 1, 1, 2), ("at the top", 1, 2, 1), ("at the top", 2, 2, 2), ("on both sides", 2, 2, 2)]
    truths = {where: deformation(make("paper_forward", STEPS, *HELD[where], *FINE)) for where in HELD}
    for i, (where, nx, ny, order) in enumerate(cases):
        scene = (STEPS, *HELD[where], f"tissue.order={order}")
        model = make("paper_forward", *scene, f"tissue.cells=[{nx}, {ny}]")
        halved = make("paper_forward", *scene, f"tissue.cells=[{2 * nx}, {2 * ny}]")
        ways = here(over_bound, model, truths[where]), textbook(over_index, model, halved, truths[where])
        yield HardCase(f"{nx} x {ny} cells of P{order}, held {where}", i + 1, *ways, 1.0, REASON)


def far_rows(quick: bool) -> Iterator[HardCase]:
    """The same motion of a body from a hundredth to ten thousand times as stiff as the scene's."""
    mesh = "tissue.cells=[8, 16]"
    model, halved = make("paper_forward", STEPS, mesh), make("paper_forward", STEPS, "tissue.cells=[16, 32]")
    fine = make("paper_forward", STEPS, *FINE)
    for power in thin([-2, -1, 0, 1, 2, 4], quick):
        k = 50 * 10.0**power
        far, half, truth = (m.with_materials(lam=k, mu=k) for m in (model, halved, fine))
        exact = deformation(truth)
        ways = here(over_bound, far, exact), textbook(over_index, far, half, exact)
        yield HardCase(f"{10.0**power:g} times as stiff", 10.0**power, *ways, 1.0, REASON)


FAMILIES = (
    Family("tiny", "Estimates on meshes of a few cells", "mesh", "true error / bound of the estimate",
           "grid convergence index of two meshes",
           "The change by halving the cells is a part of the error only; with its order and a safety factor of three "
           "it holds too, at the price of a run with four times the cells. The estimate makes no second run.",
           tiny_rows, axis="listed"),
    Family("far", "Estimates at materials far from those of the scene", "stiffness over the scene's",
           "true error / bound of the estimate", "grid convergence index of two meshes",
           "The error of a mesh depends on the material, by a factor of fifteen here; the estimate is that of the "
           "model at hand, as is the index, which needs two runs at each of them.",
           far_rows),
)  # fmt: skip
