"""One name for the gradients of reduced and of full runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, overload

from softgrasp.fem.adjoint.result import Loss, RunGradient
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.reduction.gradient.reduced import reduced_gradient
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:  # a reduced model loads no mesh
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.run.states.trajectory import Trajectory


@overload
def gradient(
    model: ReducedModel,
    loss: Loss,
    dt: float,
    *,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    materials: tuple[LayerMaterial, ...] | None = None,
    x0: Array | Literal["equilibrium"] | None = None,
) -> RunGradient[ReducedTrajectory]: ...


@overload
def gradient(
    model: Model,
    loss: Loss,
    *,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    materials: tuple[LayerMaterial, ...] | None = None,
) -> RunGradient[Trajectory]: ...


def gradient(
    model: Model | ReducedModel,
    loss: Loss,
    dt: float | None = None,
    *,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    materials: tuple[LayerMaterial, ...] | None = None,
    x0: Array | Literal["equilibrium"] | None = None,
) -> RunGradient[ReducedTrajectory] | RunGradient[Trajectory]:
    """J(y) of a run and all its derivatives by the adjoint, the midpoint rule backwards [HLW06].

        (E - h/2 A)' l_n = C' r_{n+1} + (E + h/2 A)' l_{n+1},   dJ/dtheta = sum_n h l_n' A_theta x_{n+1/2} ..

    Of a full model the transposed step has the matrix of the step, which is symmetric, and its factor. Either costs
    two to three runs whatever the number of derivatives.
    Collective for a full model; not for a reduced one.

    >>> import numpy as np, softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> run = sg.simulate(model)
    >>> misfit = lambda y: (((y - 0.9 * run.outputs) ** 2).sum() / 2, y - 0.9 * run.outputs)
    >>> exact = sg.gradient(model, misfit)
    >>> rom = sg.reduce(model, run, "craig_bampton", N=30)
    >>> found = sg.gradient(rom, misfit, run.times[1], hand=(run.q_s, run.v_s))
    >>> found.mu.shape, found.hand[1].shape, bool(abs(found.mu / exact.mu - 1) < 1e-2)
    ((1,), (101, 2), True)

    Args:
        model: full model, linear and without obstacles, or linear reduced model.
        loss: gives J and dJ/dy of the outputs; of a full model it is called on rank 0.
        dt: step [s] of a reduced run; that of a full one is its scene's.
        force: u on the hand at the step midpoints, (steps, n_s) [N, N m]. A reduced model needs it or ``hand``; a full
            one takes the drive of its scene without both.
        hand: q_s and v_s of a prescribed hand, (steps + 1, n_s) each, instead of a force.
        materials: one a layer; None: those of the model.
        x0: initial state (N,) of a reduced run, or "equilibrium", that under gravity, which moves with the materials;
            None is zero. A full run starts as its scene says.

    Raises:
        ModelError: arguments are those of the other kind of model, or shapes do not fit.
        UnstableModelError: the reduced model has growing modes there.
        SceneError: the full model has finite strain or obstacles, or shapes do not fit.
        ResourceError: the states of the full run fit neither in memory nor on the disk of temporary files.
        SolverError: a solve of the full run fails.
    """
    if isinstance(model, ReducedModel):
        if dt is None:
            raise ModelError("the gradient of a reduced model needs the step dt [s]")
        return reduced_gradient(model, loss, dt, force=force, hand=hand, materials=materials, x0=x0)
    from softgrasp.fem.adjoint.full import full_gradient  # only full models pay for it

    if dt is not None or x0 is not None:
        raise ModelError("the gradient of a full model has the steps and the start of its scene; leave out dt and x0")
    return full_gradient(model, loss, force=force, hand=hand, materials=materials)
