"""A reduced model that answers with a certificate: two nested bases, residual norms, the box that it was trained in.

    |u - u_k| <= |u_k2 - u_k| + bound(k2):

the run of the small basis is the answer, the larger one measures it, and its own static bound proves the rest [HORU19].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import isclose
from typing import Any, Literal

import numpy as np

from softgrasp.fem.material import scaled
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, listed
from softgrasp.reduction.certified import bounds
from softgrasp.reduction.certified.certificate import (
    Bound,
    Certificate,
    CertifiedRun,
    OfflineMeshEstimate,
    ToleranceError,
)
from softgrasp.reduction.certified.dual import OutputDuals, corrected
from softgrasp.reduction.certified.motion import (
    Drive,
    Materials,
    Motion,
    hand_inertia,
    known_hand,
    leading,
    modal_motions,
    padded,
    stepped_motion,
)
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.residual import ResidualNorms
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.system import ModelError

Certify = Literal["two", "proof", "estimate"]
TOGETHER = 4_000_000  # entries of the states of a batch that march at once: 32 MB


@dataclass(frozen=True)
class ParameterDomain:
    """Ranges of lambda and mu for which a model was trained, at the densities of the projection."""

    lam: tuple[float, float]  # least and largest lambda of the first layer [Pa]
    mu: tuple[float, float]  # least and largest mu of the first layer [Pa]
    independent_layers: bool = False  # every layer varies by itself within these factors; else all keep their ratios


@dataclass(frozen=True, repr=False)
class CertifiedModel(Shown):
    """A reduced model with everything that a certified run needs; small arrays, equal on every rank. Not collective.

    Attributes:
        fine: model of the larger basis k2; its leading k modes make the answer.
        k: modes of the answer; k2 when there is one basis.
        norms: residual norms of the larger basis.
        compliance: sqrt(c' K_r^-1 c) of every output component, (p,).
        box: materials of the training; None: it was not trained.
        tolerance: relative error above which a run is refused; None: never.
        certify: "two" bases, the "proof" of one, or the "estimate" of two.
        norm: of the tolerance, "energy" or "output".
        mesh: estimates of the mesh's error at some parameters.
        drive: the motion of the scene.
        training: steps, sizes and end of the training, for archive and reports.
        duals: dual problems of the outputs, for sharper bounds; None: outputs have the bound of the energy norm alone.
    """

    fine: ReducedModel
    k: int
    norms: ResidualNorms
    compliance: Array
    box: ParameterDomain | None = None
    tolerance: float | None = None
    certify: Certify = "two"
    norm: str = "energy"
    mesh: OfflineMeshEstimate | None = None
    drive: Drive | None = None
    training: dict[str, Any] = field(default_factory=dict)
    duals: OutputDuals | None = None

    def __post_init__(self) -> None:
        fine, k2 = self.fine, self.norms.k
        if not (fine.fixed_solid and fine.frame == "relative" and fine.structure == "second_order"):
            raise ModelError(
                "a certificate needs a second-order basis with fixed solid modes relative to the hand", fine.name
            )
        if not 0 < self.k <= k2:
            raise ModelError(f"k = {self.k}; it must be between 1 and {k2}", fine.name)
        if self.certify != "proof" and self.k == k2:
            object.__setattr__(self, "certify", "proof")

    def card(self) -> Card:
        """Modes, box of the materials, tolerance and how it is certified."""
        box, tolerance = self.box, self.tolerance
        trained = "nowhere"
        if box is not None:
            trained = f"lambda {box.lam[0]:g} to {box.lam[1]:g} Pa, mu {box.mu[0]:g} to {box.mu[1]:g} Pa"
        rows = (
            ("modes", f"{self.k}, checked by {self.k2}"),
            ("trained for", trained),
            ("tolerance", "none" if tolerance is None else f"{100 * tolerance:g} % in the {self.norm} norm"),
            ("certificate", {"two": "proof, two bases", "proof": "proof", "estimate": "estimate"}[self.certify]),
            ("outputs", listed(self.fine.outputs.names)),
        )
        return Card(f"CertifiedModel {self.fine.name}", rows)

    @property
    def k2(self) -> int:
        """Modes of the larger basis."""
        return self.norms.k

    def with_sizes(self, k: int, k2: int) -> CertifiedModel:
        """The same with fewer modes in both bases: leading blocks, no new work."""
        if k2 == self.k2:
            return replace(self, k=k)
        return replace(self, fine=leading(self.fine, k2), k=k, norms=self.norms.leading(k2), duals=None)

    @cached_property
    def coarse(self) -> ReducedModel:
        """Model of the leading k modes, whose run is the answer."""
        return self.fine if self.k == self.k2 else leading(self.fine, self.k)

    @cached_property
    def _blocks(self) -> dict[int, SecondOrder]:
        return {k: SecondOrder.of(m) for k, m in ((self.k2, self.fine), (self.k, self.coarse))}

    def materials(self, lam: float, mu: float, rho: float | None = None) -> Materials:
        """Materials with these numbers in the first layer [Pa, kg/m^3]; the others keep their ratios to it."""
        first = self.fine.materials[0]
        a, b, c = lam / first.lam, mu / first.mu, 1.0 if rho is None else rho / first.rho
        return scaled(self.fine.materials, a, b, c)

    def inside(self, materials: Materials) -> bool:
        """Whether these lie in the box: a motion depends on lambda / rho and mu / rho alone, one-way."""
        if self.box is None:
            return True
        own, first = self.fine.materials, self.fine.materials[0]
        pairs = list(zip(materials, own, strict=True))
        ratios = [(m.lam / o.lam, m.mu / o.mu, m.rho / o.rho) for m, o in pairs if not m.part]
        alike = slice(2 if self.box.independent_layers else 0, 3)
        near = all(isclose(x, y) for r in ratios for x, y in list(zip(r, ratios[0], strict=True))[alike])
        near = near and all(isclose(m.beta, o.beta) for m, o in pairs)
        near = near and all(isclose(m.mu / o.mu, m.rho / o.rho) for m, o in pairs if m.part)
        limits = [
            (low * (1 - 1e-9) <= x / r[2] * base <= high * (1 + 1e-9))
            for r in ratios
            for x, base, (low, high) in ((r[0], first.lam, self.box.lam), (r[1], first.mu, self.box.mu))
        ]
        return near and all(limits)

    def run(
        self,
        materials: Materials | None = None,
        drive: Drive | None = None,
        *,
        tolerance: float | None = None,
        gravity: Array | None = None,
        allow: bool = False,
        prove_time_step: bool = False,
    ) -> CertifiedRun:
        """A run of the small basis with its certificate. Online; not collective.

        Args:
            materials: one per layer; None: those of the projection.
            drive: what moves the hand; None: the scene's motion.
            tolerance: relative; None: that of the model.
            gravity: acceleration of free fall (n_s,) [m/s^2]; None: that of the scene.
            allow: return a run above the tolerance too.
            prove_time_step: prove the error of the step as well, by a second certified run at the finer step.

        Raises:
            ToleranceError: the error is above the tolerance; it carries the run.
            ModelError: materials or tables do not fit.
        """
        (run,) = self.run_batch(
            [self.fine.materials if materials is None else materials], drive,
            tolerance=tolerance, gravity=gravity, prove_time_step=prove_time_step,
        )  # fmt: skip
        certificate = run.certificate
        if not (allow or certificate.passed):
            first, claim = (materials or self.fine.materials)[0], certificate.claim(f"{certificate.reduction:.2g}")
            raise ToleranceError(
                f"the error at lambda = {first.lam:g}, mu = {first.mu:g} Pa {claim}, above the tolerance "
                f"{certificate.tolerance:g}; run the full model, or allow it",
                run,
            )
        return run

    def run_batch(
        self,
        many: Sequence[Materials],
        drive: Drive | None = None,
        *,
        tolerance: float | None = None,
        gravity: Array | None = None,
        prove_time_step: bool = False,
    ) -> list[CertifiedRun]:
        """Runs at many parameters under one motion, refused or not: the modes of all march in one product.

        Args and errors as in :meth:`run`, without the refusal.
        """
        drive, names = self._given(drive), self.fine.outputs.names
        found = self._each(many, drive, tolerance, gravity, prove_time_step)
        runs = []
        for materials, (answer, certificate) in zip(many, found, strict=True):
            run = answer.trajectory(drive.dt, names)
            model = self.coarse if run.x.shape[1] == self.coarse.N else self.fine
            runs.append(CertifiedRun(replace(run, system=partial(model.at, materials)), certificate))
        return runs

    def certificates(self, many: Sequence[Materials], drive: Drive | None = None) -> list[Certificate]:
        """Certificates of :meth:`run_batch`, without the states."""
        return [certificate for _, certificate in self._each(many, self._given(drive))]

    def _given(self, drive: Drive | None) -> Drive:
        """The drive, or the scene's motion. Raises ModelError: there is neither."""
        drive = self.drive if drive is None else drive
        if drive is None:
            raise ModelError("give the motion of the hand, or the force on it; the model has none", self.fine.name)
        return drive

    def _each(
        self,
        many: Sequence[Materials],
        drive: Drive,
        tolerance: float | None = None,
        gravity: Array | None = None,
        prove_time_step: bool = False,
    ) -> Iterator[tuple[Motion, Certificate]]:
        """Answer and certificate at every parameter."""
        tolerance = self.tolerance if tolerance is None else tolerance
        g = self.fine.gravity if gravity is None else np.asarray(gravity, dtype=float)
        g = np.zeros(len(self.fine.parts["M_hand"])) if g is None else g
        chunk = max(1, TOGETHER // (2 * self.k2 * (drive.steps + 1)))
        for at in range(0, len(many), chunk):
            for materials, answer, certificate in self._certified(many[at : at + chunk], drive, g):
                if prove_time_step and drive.finer is not None and certificate.time_step is not None:
                    ((_, _, finer),) = self._certified([materials], replace(drive.finer, finer=None), g)
                    both = certificate.energy.largest + finer.energy.largest
                    proof = certificate.time_step + float(both) / certificate.energy.size
                    certificate = replace(certificate, time_step_proof=proof)
                yield answer, replace(certificate, tolerance=tolerance, mesh=self.mesh, norm=self.norm)

    def _motions(self, k: int, many: Sequence[Materials], drive: Drive, g: Array, residual: bool) -> list[Motion]:
        """Runs of the leading k modes at every parameter, with their residuals where these are needed."""
        model = self.fine if k == self.k2 else self.coarse
        norms = self.norms if residual else None
        hand = known_hand(model, drive, g)
        alike = all(len({m.beta for m in materials}) == 1 for materials in many)
        if hand is not None and alike:
            return modal_motions(model, self._blocks[k], norms, many, drive, g, hand)
        return [stepped_motion(model, norms, materials, drive, g) for materials in many]

    def _certified(
        self, many: Sequence[Materials], drive: Drive, g: Array
    ) -> list[tuple[Materials, Motion, Certificate]]:
        """Answer and certificate at every parameter."""
        two, proved = self.k < self.k2, self.certify != "estimate"
        answers = self._motions(self.k, many, drive, g, proved and not two)
        fines = self._motions(self.k2, many, drive, g, proved) if two else answers
        refined: list[Motion | None] = [None] * len(many)
        if drive.finer is not None:
            refined = list(self._motions(self.k, many, drive.finer, g, False))
        result = []
        for materials, answer, fine, finer in zip(many, answers, fines, refined, strict=True):
            certificate = self._certificate(materials, answer, fine, drive, g)
            if finer is not None and drive.finer is not None:
                step = self._time_step(materials, answer, finer, drive, drive.finer)
                certificate = replace(certificate, time_step=step)
            result.append((materials, answer, certificate))
        return result

    def _certificate(self, materials: Materials, answer: Motion, fine: Motion, drive: Drive, g: Array) -> Certificate:
        """Bounds and estimates of the answer from the run of the larger basis."""
        size, rigid = answer.size, answer.q_s @ self.fine.outputs.C_s.T
        deformation = float(bounds.lengths((answer.outputs - rigid).T).max())
        estimate = wide = sharper = None
        if fine is not answer:
            estimate = Bound(self._difference(materials, answer, fine, drive), size, "estimate")
            wide = Bound(np.abs(fine.outputs - answer.outputs), deformation, "estimate")
        inside = self.inside(materials)
        if self.certify == "estimate" and estimate is not None and wide is not None:
            return Certificate(estimate, wide, inside=inside)
        own = self._bound(fine, materials, drive)
        outputs = self._output_bound(own, materials, drive)
        if self.duals is not None and fine.modes is not None:
            compliance, most = self.norms.static_factor(materials) * self.compliance, outputs.max(axis=0)
            sharper = corrected(self.duals, self.fine, self.norms, fine, materials, drive, g, compliance, most)
        outputs += 0.0 if wide is None else wide.values
        if sharper is not None:
            outputs = np.minimum(outputs, np.abs(fine.outputs + sharper[0] - answer.outputs) + sharper[1])
        effectivity = np.inf
        if estimate is not None and estimate.largest > own.max():
            effectivity = float((estimate.largest + own.max()) / (estimate.largest - own.max()))
        return Certificate(
            energy=Bound(own if estimate is None else estimate.values + own, size, "proof"),
            outputs=Bound(outputs, deformation, "proof"),
            estimate=estimate,
            outputs_estimate=wide,
            effectivity_at_most=effectivity,
            inside=inside,
        )

    def _coupled(self, drive: Drive) -> bool:
        """Whether the hand's own motion has an error."""
        return self.fine.two_way and drive.hand is None

    def _difference(self, materials: Materials, answer: Motion, fine: Motion, drive: Drive) -> Array:
        """|u_k2 - u_k|_E at every step, (steps + 1,)."""
        if fine.modes is not None and answer.modes is not None and fine.w is not None and answer.w is not None:
            change = fine.modes.inverse[:, : self.k] @ answer.modes.X  # modes of the answer in those of the larger one
            d = fine.w.copy()
            d[:, 0] -= (fine.modes.omega[:, None] * change / answer.modes.omega) @ answer.w[:, 0]
            d[:, 1] -= change @ answer.w[:, 1]
            return bounds.lengths(d.reshape(-1, d.shape[2]))
        n_s = answer.q_s.shape[1]
        d = fine.states(drive.dt) - padded(answer.states(drive.dt), self.fine.N, n_s)
        return self._energy(self.fine, materials, d, drive)

    def _energy(self, model: ReducedModel, materials: Materials, d: Array, drive: Drive) -> Array:
        """Energy norm |d|_E of states (steps + 1, N), (steps + 1,)."""
        small = model.at(materials)
        energy = small.total_energy(d) if self._coupled(drive) else small.energy(d)
        return np.asarray(np.sqrt(np.maximum(2 * energy, 0.0)))

    def _bound(self, motion: Motion, materials: Materials, drive: Drive) -> Array:
        """Static bound of the energy norm of a run's error, (steps + 1,)."""
        r = motion.residual
        assert r is not None
        kernel, betas = None, {m.beta for m in materials}
        if not self._coupled(drive) and len(betas) == 1 and self.fine.damped:
            low, high = self.norms.frequencies(materials)
            kernel = bounds.decay(low, high, self.fine.alpha, betas.pop(), drive.dt, drive.steps)
        return bounds.static_bound(r.nodes, r.rest, drive.dt, drive.start == "equilibrium", kernel)

    def _output_bound(self, bound: Array, materials: Materials, drive: Drive) -> Array:
        """Bound of every output component from one of the energy, (steps + 1, p)."""
        reach = bound[:, None] * (self.norms.static_factor(materials) * self.compliance)
        if self._coupled(drive):
            # the hand's velocity error is at most S^(-1/2) |e|, its displacement error the integral of that
            scale = max(1.0, self.norms.mass_factor(materials))
            hand = scale * np.linalg.norm(self.fine.outputs.C_s @ hand_inertia(self.fine, self.norms)[1], axis=1)
            reach += np.outer(drive.dt * np.concatenate([[0.0], np.cumsum((bound[1:] + bound[:-1]) / 2)]), hand)
        return np.asarray(reach)

    def _time_step(self, materials: Materials, answer: Motion, finer: Motion, drive: Drive, fine_drive: Drive) -> float:
        """Difference of the same run at a finer step, and what dt -> 0 adds to it by its second order; relative."""
        many = fine_drive.steps // drive.steps
        if answer.size <= 0:
            return 0.0
        if finer.w is not None and answer.w is not None:
            d = finer.w[:, :, ::many] - answer.w
            error = bounds.lengths(d.reshape(-1, d.shape[2]))
        else:
            x = finer.states(fine_drive.dt)[::many] - answer.states(drive.dt)
            if not self._coupled(drive):
                x[:, : 2 * answer.q_s.shape[1]] = 0.0
            error = self._energy(self.coarse, materials, x, drive)
        return float(error.max() / answer.size * many**2 / (many**2 - 1))
