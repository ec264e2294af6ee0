"""The small controller of a scene: the best certified a-priori gain as what a robot runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.petsc import Array
from softgrasp.lqr.design.feedback import Design, loop_words
from softgrasp.lqr.design.orders import BasisGains, fast_order, orders, reduce_gains
from softgrasp.lqr.design.scene import control_of
from softgrasp.lqr.loop.controller import Controller, layout_hash
from softgrasp.lqr.loop.small import galerkin, m_orthonormal
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import A_PRIORI
from softgrasp.lqr.reduced.riccati import norm
from softgrasp.lqr.spectrum.modal_loop import SampledRadius
from softgrasp.lqr.spectrum.sampled import Sampling

ROUNDING = 1e-12  # of the gain


class NoController(ControlError):
    """No small gain is certified to stabilise the scene."""


@dataclass(frozen=True)
class CertifiedController:
    """The small controller of a scene."""

    controller: Controller  # the controller that a robot runs
    method: str  # basis of its gain
    radius: SampledRadius  # spectral radius of the full loop at the period, step and delay of the scene


def make_controller(design: Design, order: int | None = None) -> Controller:
    """Controller u = u_bar + K (x - x_bar), K (n_s, N), the best certified a-priori one of a small order. Collective.

    Args:
        design: the optimal feedback of a scene.
        order: N of the reduced Riccati equation, the 2 n_s states of the hand included; None tries those of the scene
            up to :func:`softgrasp.lqr.design.orders.fast_order`.

    Raises:
        ControlError: no such order, or no gain that is certified to stabilise the plant.

    >>> import softgrasp as sg
    >>> controller = sg.make_controller(sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"])), order=8)
    >>> controller.K.shape
    (2, 8)
    """
    sizes = [order] if order is not None else orders(design)[0]
    (basis,) = reduce_gains(design, sizes, names=(A_PRIORI,), offered_only=order is None)
    if order is not None and basis.family is not None:
        basis.family.at(order)  # refuses what does not exist
    return certified_controller(design, basis, order).controller


def certified_controller(design: Design, basis: BasisGains | None, order: int | None = None) -> CertifiedController:
    """See :func:`make_controller`; with gains that are there already. Collective.

    The states are [q_s, v_s, eta, eta'] with z = V eta, V the modes of the basis. The gain that the filter W'z of these
    modes expands acts on them only, so that the small controller is the gain that was checked.

    Args:
        basis: the a-priori gains; None where there are none.
        order: N; None: that of the least cost up to :func:`softgrasp.lqr.design.orders.fast_order`.

    Raises NoController: no gain is certified.
    """
    problem, layout, scene = design.problem, design.problem.layout, design.model.scene
    method, gain, V = _gain(design, basis, order)
    plant, shapes = galerkin(problem, V)
    x_bar, u_bar = plant.rest_at(design.target.state.q_s)
    controller = Controller(
        shapes.reduce_gain(problem, gain),
        x_bar,
        u_bar,
        plant,
        1 / control_of(design.model).loop.rate,
        design.actuation.bound(layout.n_s),
        scene_hash(scene),
        layout_hash(layout),
        {"scene": scene.name, "method": method, "N": plant.N},
    )
    law = design.gain_check.law
    if law is None or not law.every:  # the scene's own law acts within the step, which no robot can
        law = Sampling(controller.period, 1)
    radius = design.gain_check.ticks.controller(controller, law)
    if not radius.value < design.largest_radius:
        raise NoController(
            f"{loop_words(law)}, its loop has the spectral radius {radius.value:.3g}, which must be below 1"
        )
    return CertifiedController(controller, method, radius)


def _gain(design: Design, basis: BasisGains | None, order: int | None) -> tuple[str, Gain, Array]:
    """Name, gain and shapes of the tissue, local rows (n_local, k). Collective."""
    layout, n = design.problem.layout, design.problem.layout.n_local
    if design.modal:
        # the factor spans the modes; what is dropped has 1e-12 of its largest column in X
        return "modal", design.gain, m_orthonormal(design.problem.system.M_ee, design.solution.factor.tall[n:], 1e-6)
    if blind(design):
        return "hand alone", design.gain, np.zeros((n, 0))
    least, most = (2 * layout.n_s + 2, fast_order(layout.n_s)) if order is None else (order, order)
    best = None if basis is None else basis.best(most, least)
    if basis is None or basis.family is None or best is None or best.gain is None:
        raise NoController("no a-priori gain of small order with tissue in it is certified to be stable")
    return basis.name, best.gain, basis.family.at(best.N).modes


def blind(design: Design) -> bool:
    """Whether the optimal gain is one of the hand alone: the outputs see nothing of the tissue. Collective."""
    K = design.gain_check.K
    return norm(design.problem, Block(np.zeros_like(K.hand), K.tall)) <= ROUNDING * norm(design.problem, K)
