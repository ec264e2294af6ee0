"""A reduced model of a scene from one full run: basis, then projection with the outputs of the scene."""

from __future__ import annotations

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.reduction.bases.basis import Basis, ReductionError
from softgrasp.reduction.bases.engines import EngineName
from softgrasp.reduction.bases.inner import InnerName
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import States
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.projection import project
from softgrasp.reduction.replay import FullRun, full_run


def reduce(
    model: Model,
    run: Trajectory | FullRun,
    method: str = "psd_fixed",
    N: int | Truncation | None = 14,
    *,
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> ReducedModel:
    """Reduced model E x' = A x + B u + F g, y = C x of a scene, from the snapshots of a full run. Collective.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "psd_fixed", N=14)
    >>> rom.N, rom.split, rom.at().stable
    (14, (10,), True)

    Which method: on the paper's scene "craig_bampton", which needs no snapshots, has the least error of the deformation
    from N = 10 on; "psd_svd_like" and "componentwise_pod" come next, and the paper's "psd_fixed" needs about twice the
    columns. The symplectic ones and "craig_bampton" are stable at every N. `softgrasp reduce` compares all on a scene.

    Args:
        model: scene; the reduced model is affine in its materials, see
            :meth:`softgrasp.reduction.model.ReducedModel.at`.
        run: a run of it with the snapshots in memory.
        method: "global_pod", "componentwise_pod", "pod_fixed", "componentwise_pod_fixed", "psd", "psd_fixed",
            "psd_cotangent_lift", "psd_svd_like" and their "_fixed" and "_relative" forms, or "craig_bampton"; all keys
            in :data:`softgrasp.reduction.bases.registry.METHODS`. "psd_fixed" is the paper's PSD with fixed solid modes
            [SBRH21].
        N: columns of V, the hand's included; or a rule; None keeps 99.9 % of the energy, as the paper does.
        inner, engine: see :func:`softgrasp.reduction.bases.registry.make_basis`.

    Returns:
        A :class:`softgrasp.reduction.model.ReducedModel` with V, the N x N blocks and the hand's coupling; ``at`` gives
        it at other materials, :func:`softgrasp.reduction.replay.replay` runs it under the same motion.

    Raises:
        SceneError: the run kept no snapshots, or the body is at rest in all of them.
        ReductionError: finite strain, see :func:`softgrasp.reduction.strain.training.reduce_strain`.
        BasisError: the method is unknown, or it has no basis of N columns.
        SolverError: a factorisation failed.
    """
    _check_linear(model)
    full = run if isinstance(run, FullRun) else full_run(model, run)
    states = States(model.system, ((full.model.system, full.snapshots),))
    return project_scene(make_basis(method, states, N, inner, engine), model)


def project_scene(basis: Basis, model: Model) -> ReducedModel:
    """Projection of a scene with its outputs, see :func:`softgrasp.reduction.projection.project`. Collective.

    Raises:
        SolverError: the mass matrix cannot be factored.
        ReductionError: the scene has finite strain.
    """
    _check_linear(model)
    return project(basis, model.system, make_outputs(model.scene, model.system), scene_hash(model.scene))


def _check_linear(model: Model) -> None:
    if model.system.points is not None:
        raise ReductionError(
            f"scene {model.scene.name} has effects.finite_strain, and this model would be linear; "
            "softgrasp.reduce_strain(model, runs, N) makes its reduced models"
        )
