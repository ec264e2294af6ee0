"""Certified models of a scene: bases in V = blkdiag(I, Phi, Phi), projected with their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import Profile
from softgrasp.reduction.bases.basis import Basis
from softgrasp.reduction.certified.dual import output_duals
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import FINER, Drive, Materials
from softgrasp.reduction.certified.residual import ResidualSpace
from softgrasp.reduction.reduce import project_scene

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.scene.scene import Scene


def second_order_basis(model: Model, Phi: Array, name: str = "certified") -> Basis:
    """V = blkdiag(I, Phi, Phi) in (q, v) relative to the hand, of modes Phi, local rows (n_local, k)."""
    layout = model.system.layout
    zero, hand = np.zeros((layout.n_local, 2 * layout.n_s)), 2 * layout.n_s
    V_q, V_v = (np.asfortranarray(np.hstack(x)) for x in ([zero, Phi, 0 * Phi], [zero, 0 * Phi, Phi]))
    one = np.eye(hand, V_q.shape[1])
    return Basis(
        name, layout, one[: hand // 2], one[hand // 2 :], V_q, V_v, "qv", "relative", "second_order", True,
        split=(2 * Phi.shape[1],),
    )  # fmt: skip


def scene_drive(scene: Scene, M_hand: Array, finer: int = FINER) -> Drive:
    """The scene's motion of the hand, or the force on it, and the same at a step ``finer`` times smaller (1: none).

    Raises:
        SceneError: a CSV file does not fit.
    """
    return Drive.along(Profile.of(scene, len(M_hand)), scene.time.steps, M_hand, scene.time.start, finer)


def certified_model(
    model: Model,
    Phi: Array,
    k: int | None = None,
    space: ResidualSpace | None = None,
    places: Sequence[Materials] = (),
    **about: Any,
) -> CertifiedModel:
    """A certified model of a scene from modes Phi of its displacement, leading ones first. Collective.

    >>> import softgrasp as sg
    >>> from softgrasp.reduction.certified.training import certified_model
    >>> from softgrasp.fem.solve.modes import lowest_modes
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> certified = certified_model(model, lowest_modes(model.system, 24)[1], k=8)
    >>> certified.run().certificate.proved
    True

    Args:
        model: the scene.
        Phi: local rows (n_local, k2).
        k: modes of the answer; None: all, with one basis.
        space: residuals of these modes; None makes them at the materials of the scene.
        places: parameters at which duals of the outputs are to be good; none: no duals.
        about: other fields of :class:`softgrasp.reduction.certified.model.CertifiedModel`.

    Raises:
        SolverError: a factorisation failed.
    """
    own = space is None
    space = space or ResidualSpace(model.system, model.system.materials)
    try:
        if own:
            space.extend(Phi)
        rom = project_scene(second_order_basis(model, Phi), model)
        norms, compliance = space.norms(), space.compliance(model.output_columns)
        if places:
            about["duals"] = output_duals(model, places, space, Phi)
    finally:
        if own:
            space.destroy()
    about.setdefault("drive", scene_drive(model.scene, model.system.M_hand))
    return CertifiedModel(rom, k or Phi.shape[1], norms, compliance, **about)
