"""The solution that all settings are compared with, and how far it can be trusted itself.

    y* = y(m, S) + time part + space part,
    time part  = (y(m, S) - y(m, S/2)) / 3                       order 2 of the midpoint rule
    space part = L(M1, M2, M3) - y(m, s)

with a middle mesh m, many steps S, few steps s, and meshes M1 < M2 < M3, all P2, M3 the finest that the work allows.
Space and time are refined apart, since both at once would cost the product. The ends of the contact zone are singular,
so that every uniform mesh converges with the order p = 2 alpha of
:func:`softgrasp.study.precision.meshes.singular_order`, whatever
the elements: L is the limit of y + a h^p + b h^(p + 1) through the three. The order that the three show has to
agree with p, else L is y(M3, s) itself. The error estimate adds up

    space: |L - L'|, L' the limit of y + a h^p through the two finest (|y(M3, s) - L'| where L is not extrapolated)
    time:  the time part itself
    mixed: how much the time part changes from mesh m to one of half its cells, or of P1 where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.full import FullRuns
from softgrasp.study.precision.meshes import (
    WORK,
    edges,
    few_steps,
    fits,
    limit_weights,
    nested_meshes,
    observed_order,
    singular_order,
)
from softgrasp.study.precision.result import Limit, Truth
from softgrasp.study.precision.series import Series, largest
from softgrasp.study.precision.settings import Setting

ROUGH = 0.05  # error of a reference that is worth a warning
NEAR = 0.5  # between the order that meshes show and the one that the singular ends leave
APART = (0.5, 0.75)  # of the finest mesh, cells along an edge of the two others that show the order with it
STILL = 1e-12  # of the displacement: an output that moves less against the hand moves with it


def space_limit(sizes: list[float], values: list[Array], expected: float, d: int) -> Limit:
    """Limit of values on two meshes or more with cells of size h, coarse to fine."""
    two = sum(w * v for w, v in zip(limit_weights(sizes[-2:], [expected]), values[-2:], strict=True))
    shown = None
    if len(values) >= 3:
        changes = [largest(b - a, d)[0] for a, b in zip(values[-3:-1], values[-2:], strict=True)]
        shown = observed_order(sizes[-3:], changes)
    if shown is None or abs(shown - expected) > NEAR:
        return Limit(values[-1], two - values[-1], shown, expected, False)
    weights = limit_weights(sizes[-3:], [expected, expected + 1])
    limit = sum(w * v for w, v in zip(weights, values[-3:], strict=True))
    return Limit(np.asarray(limit), limit - two, shown, expected, True)


@dataclass(frozen=True)
class Plan:
    """Settings behind a reference.

    Attributes:
        space: meshes at few steps, coarse to fine.
        middle, below: meshes, at few steps, on which time is refined.
        base: the scene's steps.
    """

    space: tuple[Setting, ...]
    middle: Setting
    below: Setting
    base: int

    def at(self, mesh: Setting, multiple: int) -> Setting:
        """A mesh with a multiple of the scene's steps."""
        return Setting(mesh.cells, mesh.order, multiple * self.base)

    @property
    def settings(self) -> tuple[Setting, ...]:
        """All to run."""
        fine = (self.at(self.middle, 2), self.at(self.middle, 4), self.at(self.below, 4))
        return tuple(dict.fromkeys((*self.space, self.middle, self.below, *fine)))


def make_plan(scene: Scene) -> Plan:
    """Settings behind the reference of a scene."""
    few, meshes = few_steps(scene), nested_meshes(scene)
    if len(meshes) < 2:  # nothing to refine: P1 beside P2 tells what there is to know
        cells = meshes[0] if meshes else None
        low, high = Setting(cells, 1, few), Setting(cells, 2, few)
        return Plan((low, high), high, low, scene.time.steps)

    def coarser(cells: float) -> Setting:
        fit = [c for c in meshes if c[0] <= cells]
        return Setting(fit[-1] if fit else meshes[0], 2, few)

    fine = meshes[-1][0]
    space = tuple(dict.fromkeys((*(coarser(share * fine) for share in APART), coarser(fine))))
    middle, d = coarser(max(fine / 4, meshes[1][0])), len(meshes[0])
    if middle.unknowns(d) * 4 * scene.time.steps > WORK[d]:
        middle = coarser(fine / 4)
    cells = middle.cells or meshes[0]
    below = Setting(cells, 1, few) if cells == meshes[0] else coarser(cells[0] / 2)
    return Plan(space, middle, below, scene.time.steps)


def make_truth(scene: Scene, runs: FullRuns) -> Truth:
    """Run the reference meshes and steps. Collective.

    Raises:
        SolverError: a run failed.
        SceneError: the outputs move with the hand, so that there is no deformation to measure.
    """
    plan = make_plan(scene)
    series = {s: runs.run(s, 1).series for s in plan.settings}
    d = series[plan.middle].dimension
    values = [series[s].values for s in plan.space]
    if plan.space[0].order == 1:
        limit = Limit(values[-1], values[-1] - values[0], None, None, False)
    else:
        sizes = [1.0 / s.cells[0] for s in plan.space if s.cells]
        limit = space_limit(sizes, values, singular_order(scene), d)
    return combine(scene, plan, series, limit)


def combine(scene: Scene, plan: Plan, series: dict[Setting, Series], limit: Limit) -> Truth:
    """y* and its error estimate from the runs.

    Raises:
        SceneError: the outputs move with the hand.
    """
    middle, below = series[plan.middle], series[plan.below]
    fine, half = series[plan.at(plan.middle, 4)], series[plan.at(plan.middle, 2)]
    d, t, few = middle.dimension, fine.times, middle.times
    time_part = (fine.values - half.at(t)) / 3
    total = fine.values + time_part + Series(few, limit.values - middle.values, d).at(t)
    change = fine.at(few) - middle.values
    lower = series[plan.at(plan.below, 4)].at(few) - below.values
    scale = largest(total, d)
    if not scale[0] > STILL * max(scale[1], 1e-300):
        raise SceneError(
            "control.outputs: no output moves against the hand, so that there is no deformation whose error could be "
            "told; name a point of the tissue, in a scene that moves"
        )

    def relative(values: Array) -> tuple[float, float]:
        return tuple(g / s if s > 0 else 0.0 for g, s in zip(largest(values, d), scale, strict=True))  # type: ignore[return-value]

    truth = Truth(
        Series(t, total, d), relative(limit.gap), relative(time_part), relative(change - lower), limit,
        tuple(series), "",
    )  # fmt: skip
    return replace(truth, note=_note(scene, plan, truth))


def _note(scene: Scene, plan: Plan, truth: Truth) -> str:
    """What the reference is built from, how good it is, and what is wrong with it."""
    limit, meshes = truth.limit, [s.mesh for s in plan.space]
    seen = "no order" if limit.order is None else f"the order {limit.order:.2f}"
    if limit.expected is None:
        how = f"from {' to '.join(meshes)}, whose difference is all that is known in space, since the mesh is given"
    elif limit.extrapolated:
        how = (
            f"extrapolated in space from {', '.join(meshes)} with the order {limit.expected:.2f} that the ends of the "
            f"contact zone leave; these meshes show {seen}"
        )
    else:
        how = (
            f"from {meshes[-1]}, not extrapolated, since {', '.join(meshes)} show {seen} instead of "
            f"{limit.expected:.2f}"
        )
    words = (
        f"Reference: {how}; in time with {4 * plan.base} steps on {plan.middle.mesh}. Its own relative error of the "
        f"deformation is estimated as {truth.error:.1e} (displacement {truth.error_displacement:.1e}); the "
        "measured errors may be wrong by as much either way."
    )
    if truth.error > ROUGH:
        part = truth.largest_part
        words += f" That is too much to judge by: most of it is the {part} part, and would need {truth.need}."
    if not all(fits(n, shares) for n, shares in zip(scene.tissue.cells or (), edges(scene), strict=False)):
        words += " The scene's own mesh has no lines at the ends of its contact zone or layers, which adds error."
    return words
