"""Reduced models of a scene from full runs, linear or at finite strain: how they are made, replayed and compared."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import TYPE_CHECKING, overload

from softgrasp.fem.errors import shortened
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.reduction.bases.basis import Basis, ReductionError
from softgrasp.reduction.bases.engines import EngineName
from softgrasp.reduction.bases.inner import InnerName
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import BasisError, States
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.contact.model import ContactModel, ContactRun
from softgrasp.reduction.contact.replay import ContactErrors, errors_contact, replay_contact
from softgrasp.reduction.errors import ModelErrors
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.origin import origin_of
from softgrasp.reduction.projection import project
from softgrasp.reduction.replay import FullRun, as_full, errors_linear, replay_linear
from softgrasp.reduction.turning.model import TurningModel, TurningRun

if TYPE_CHECKING:  # only scenes with finite strain pay for its models
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.model.outputs import Output
    from softgrasp.reduction.strain.model import StrainModel, StrainRun
    from softgrasp.reduction.strain.training import StrainErrors


def reduce(
    model: Model,
    runs: Trajectory | FullRun | Sequence[Trajectory | FullRun],
    method: str | None = None,
    N: int | Truncation | None = 14,
    *,
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> ReducedModel | StrainModel | TurningModel:
    """Reduced model of a scene, from the snapshots of one full run or of several. Collective.

        E x' = A x + B u + F g, y = C x                            linear elasticity, x = V'X of the method's basis
        a'' + D a' + dW_r/da = -G (a_s - g), y = C_z a + C_s q_s   effects.finite_strain, z = Phi a on sampled cells
        M a'' + D a' + K a = -G (A - g) + loads of the turn        effects.frame, see `reduction.turning.model`

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "psd_fixed", N=14)
    >>> rom.N, rom.split, rom.at().stable
    (14, (10,), True)
    >>> strained = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100", "effects.finite_strain={}"])
    >>> rom = sg.reduce(strained, sg.simulate(strained), N=14)
    >>> rom.N, rom.cells.count < 64
    (14, True)

    Which method: on the paper's scene "craig_bampton", which needs no snapshots, has the least error of the deformation
    from N = 10 on; "psd_svd_like" and "componentwise_pod" come next, and the paper's "psd_fixed" needs about twice the
    columns. The symplectic ones and "craig_bampton" are stable at every N. `softgrasp reduce` compares all on a scene.

    Args:
        model: scene. A linear reduced model is affine in its materials, see
            :meth:`softgrasp.reduction.model.ReducedModel.at`; one at finite strain answers inside the box of materials
            and motions of its runs, see :meth:`softgrasp.reduction.strain.model.StrainModel.at`; one in the frame of
            the hand at all materials, turns and forces, see :meth:`softgrasp.reduction.turning.model.TurningModel.at`.
        runs: full run of the scene, or several, with the snapshots in memory.
        method: "global_pod", "componentwise_pod", "pod_fixed", "componentwise_pod_fixed", "psd", "psd_fixed",
            "psd_cotangent_lift", "psd_svd_like" and their "_fixed" and "_relative" forms, or "craig_bampton"; all keys
            in :data:`softgrasp.reduction.bases.registry.METHODS`. None is the paper's PSD with fixed solid modes
            "psd_fixed" [SBRH21]; at finite strain there is one basis only, the cotangent lift. With effects.frame it is
            "craig_bampton" (None too) or "psd_cotangent_lift_fixed_relative"; both effects: no method, a led hand, see
            :class:`softgrasp.reduction.turning.strained.TurningStrainModel`.
        N: dimension, the hand's 2 n_s included. Linear models also accept a rule, and None, which keeps 99.9 % of the
            energy as the paper does.
        inner: inner product of the snapshots, see :func:`softgrasp.reduction.bases.registry.make_basis`; linear only.
        engine: factorisation of the snapshots, see the same function; linear only.

    Returns:
        The small matrices, or the sampled cells with their weights, and the outputs of the scene; ``at`` gives the
        model at other materials, :func:`replay` runs it under the same motion.

    Raises:
        SceneError: a run kept no snapshots, or the body is at rest in all of them.
        BasisError: the method is unknown, or it has no basis of N columns.
        ReductionError: a model at finite strain with a linear one's options, or no weights reach their tolerance.
        SolverError: a factorisation failed, or a reduced run did not converge.
    """
    model.scene.refuse_contact("a basis of sg.reduce, unlike sg.contact_model,")
    if not (N is None or isinstance(N, Truncation | Integral)) or isinstance(N, bool):
        raise BasisError(f"N = {shortened(repr(N))} is no dimension; give a whole number, a Truncation or None")
    if not isinstance(runs, Trajectory | FullRun | Sequence):
        raise ReductionError(f"{shortened(repr(runs))} is no run; give what softgrasp.simulate returns, or a list")
    fulls = [as_full(model, run) for run in ([runs] if isinstance(runs, Trajectory | FullRun) else runs)]
    if model.system.frame is not None and model.system.points is None:
        from softgrasp.reduction.turning.projection import reduce_turning

        return reduce_turning(model, fulls, method or "craig_bampton", N, inner, engine)
    if model.system.points is None:
        return reduce_linear(model, fulls, method or "psd_fixed", N, inner, engine)
    from softgrasp.reduction.strain.training import train

    if method is not None or inner is not None or engine != "tsqr" or not isinstance(N, Integral):
        raise ReductionError(
            f"scene {model.scene.name} has effects.finite_strain, whose models have one basis; give N alone"
        )
    if model.system.frame is not None:
        from softgrasp.reduction.turning.strained_training import train_turning

        return train_turning(model, fulls, int(N)).reduce(int(N))
    return train(model, fulls, int(N)).reduce(int(N))


@overload
def replay(rom: ReducedModel, model: Model, run: Trajectory | FullRun, *, allow: bool = ...) -> ReducedTrajectory: ...
@overload
def replay(rom: StrainModel, model: Model, run: Trajectory | FullRun, *, allow: bool = ...) -> StrainRun: ...
@overload
def replay(rom: TurningModel, model: Model, run: Trajectory | FullRun, *, allow: bool = ...) -> TurningRun: ...
@overload
def replay(rom: ContactModel, model: Model, run: Trajectory | FullRun, *, allow: bool = ...) -> ContactRun: ...
def replay(
    rom: ReducedModel | StrainModel | TurningModel | ContactModel,
    model: Model,
    run: Trajectory | FullRun,
    *,
    allow: bool = False,
) -> ReducedTrajectory | StrainRun | TurningRun | ContactRun:
    """E x' = A x + B u + F g by the midpoint rule [HLW06], under the hand of a full run. Collective.

    The hand moves as it did where the basis keeps it apart (fixed solid modes), else it feels the force that gave its
    motion. The materials are those of ``model``: a model with others replays a new parameter, and nothing of full order
    is solved.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> run = sg.simulate(model)
    >>> rom = sg.reduce(model, run, "psd_fixed", N=14)
    >>> sg.replay(rom, model, run).x.shape  # steps + 1, N
    (101, 14)

    Args:
        rom: reduced model.
        model: gives the materials; all else that is neither motion nor time must be as in the scene of ``rom``.
        run: the full run; a :class:`softgrasp.reduction.replay.FullRun` is at materials of its own, a trajectory at
            those of ``model`` or, without effects.reaction, at any.
        allow: run a linear model with growing modes, or one at finite strain outside its training, all the same.

    Raises:
        SceneError: see :func:`softgrasp.reduction.replay.full_run`.
        UnstableModelError: the reduced model has growing modes there.
        ModelError: the scene of ``model``, or of a full run, differs from that of ``rom`` in more than materials,
            motion and time; or the reduced model cannot represent the materials, it has no run or no equilibrium to
            start in, or the run lies outside the training box.
        SolverError: a step at finite strain did not converge.
    """
    if isinstance(rom, ReducedModel):
        return replay_linear(rom, model, run, allow_unstable=allow)
    if isinstance(rom, TurningModel):
        from softgrasp.reduction.turning.projection import replay_turning

        return replay_turning(rom, as_full(model, run), model)
    if isinstance(rom, ContactModel):
        return replay_contact(rom, as_full(model, run), model)
    from softgrasp.reduction.strain.training import replay_strain

    return replay_strain(rom, as_full(model, run), model, outside=allow)


@overload
def errors(
    rom: ReducedModel, reduced_run: ReducedTrajectory, model: Model, run: Trajectory | FullRun
) -> ModelErrors: ...
@overload
def errors(rom: StrainModel, reduced_run: StrainRun, model: Model, run: Trajectory | FullRun) -> StrainErrors: ...
@overload
def errors(rom: TurningModel, reduced_run: TurningRun, model: Model, run: Trajectory | FullRun) -> StrainErrors: ...
@overload
def errors(rom: ContactModel, reduced_run: ContactRun, model: Model, run: Trajectory | FullRun) -> ContactErrors: ...
def errors(
    rom: ReducedModel | StrainModel | TurningModel | ContactModel,
    reduced_run: ReducedTrajectory | ContactRun,
    model: Model,
    run: Trajectory | FullRun,
) -> ModelErrors | StrainErrors | ContactErrors:
    """|X - X_r| / |X| over the snapshots X of a full run [SBRH21]: states, deformation, energy. Collective.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> run = sg.simulate(model)
    >>> rom = sg.reduce(model, run, "psd_fixed", N=40)
    >>> sg.errors(rom, sg.replay(rom, model, run), model, run).error_deformation < 0.01
    True

    Args:
        rom: reduced model, with its reconstruction.
        reduced_run: its run on the time grid of the full one, at the materials of ``model``.
        model: scene at the materials of both runs.
        run: the full run.

    Raises:
        SceneError: see :func:`softgrasp.reduction.replay.full_run`.
        ModelError: the reduced run is shorter than the full one, or the model was loaded without its reconstruction.
    """
    full = as_full(model, run)
    if isinstance(rom, ContactModel):
        assert isinstance(reduced_run, ContactRun)
        return errors_contact(rom, reduced_run, full)
    assert not isinstance(reduced_run, ContactRun)
    if isinstance(rom, ReducedModel):
        return errors_linear(rom, reduced_run, full)
    if isinstance(rom, TurningModel):
        from softgrasp.reduction.turning.projection import errors_turning

        assert isinstance(reduced_run, TurningRun)
        return errors_turning(rom, reduced_run, full)
    from softgrasp.reduction.strain.training import errors_strain

    return errors_strain(rom, reduced_run, full)


def reduce_linear(
    model: Model,
    runs: Sequence[FullRun],
    method: str = "psd_fixed",
    N: int | Truncation | None = 14,
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> ReducedModel:
    """A linear model, see :func:`reduce`. Collective."""
    _check_linear(model)
    states = States(model.system, tuple((run.model.system, run.snapshots) for run in runs))
    return project_scene(make_basis(method, states, N, inner, engine), model)


def project_scene(basis: Basis, model: Model, outputs: Sequence[Output] | None = None) -> ReducedModel:
    """Projection of a scene with its outputs, see :func:`softgrasp.reduction.projection.project`. Collective.

    ``outputs``: those of the scene where they are made already.

    Raises:
        SolverError: the mass matrix cannot be factored.
        ReductionError: the scene has finite strain.
    """
    _check_linear(model)
    outputs = model.outputs if outputs is None else outputs
    return project(basis, model.system, outputs, model.scene_hash, origin_of(model.scene_keys))


def _check_linear(model: Model) -> None:
    model.scene.refuse_frame("a reduced model")
    if model.system.points is not None:
        raise ReductionError(
            f"scene {model.scene.name} has effects.finite_strain, and this model would be linear; "
            "softgrasp.reduce(model, runs, N=N) makes its reduced models"
        )
