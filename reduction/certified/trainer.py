"""Training of certified models of a scene: full runs where the greedy method needs them, their modes, sizes, mesh.

X = [z, tau v] of a full run, less its projection on Phi in K_r, gives its leading POD modes to Phi; tau makes both
halves equally long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.accuracy import estimate as accuracy
from softgrasp.fem.accuracy.krylov import krylov_model
from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array, on_root, times_columns, total
from softgrasp.reduction.certified.certificate import OfflineMeshEstimate
from softgrasp.reduction.certified.dual import OutputDuals, output_duals
from softgrasp.reduction.certified.greedy import REASONS, Greedy, GreedyStep, greedy, start
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.motion import Materials
from softgrasp.reduction.certified.residual import ResidualSpace
from softgrasp.reduction.certified.shared import TwoProcesses
from softgrasp.reduction.certified.training import certified_model, scene_drive
from softgrasp.reduction.certified.validation import measured_error
from softgrasp.reduction.parameters import box_of, materials_at, outside, run_with, thinned

COLUMNS = 200  # states of a full run that its modes are computed from
CACHED = 3e8  # entries of full runs that are kept, in case a point comes again: 2.4 GB over all ranks
SHARE = 0.5  # of the tolerance that the larger basis may use, so that the smaller one has the rest
RANDOM = 100  # parameters beside the grid where the finished model is looked at
ADDED = 10  # of these become points of the training at most, each as the worst one above what the grid has reached
PLACES = 4  # trained parameters at which the mesh is estimated
ROUNDING = 1e-11  # of a run's length: what is left of it below is rounding
WATCHED, WORST = 20, 4  # parameters by which the size of the smaller basis is found; of these looked at first
WORTH = 0.7  # of an output's bound, above which duals are not used: they lengthen every answer
DUAL_PLACES = 3  # values of each constant at which duals are made to be good
SEED = 20


@dataclass(frozen=True)
class Validation:
    """Full runs at random parameters against the estimate by two bases.

    Attributes:
        n: runs.
        factor: largest ratio of the true error to the estimate.
        worst: largest relative true error.
        share: of the box, in the measure of the sampling, above which the error exceeds ``factor`` times the estimate
            with a probability of 5 % at most.
    """

    n: int
    factor: float
    worst: float
    share: float


def motions_of(model: Model) -> list[Model]:
    """The scene's own motion, or one for every freedom of the hand: the tissue is linear in the motion.

    Raises:
        SceneError: unit motions of a motion that is no quintic one.
    """
    scene, n_s = model.scene, model.system.layout.n_s
    if scene.reduction.motions != "unit":
        return [model]
    target = np.zeros(n_s)
    if scene.motion.target is None or scene.motion.drive == "force":
        raise SceneError("reduction.motions = 'unit' needs a prescribed quintic motion; use 'own' here")
    target[: len(scene.motion.target)] = scene.motion.target
    result, size = [], float(np.abs(target).max())
    for j in range(n_s):
        turned = j >= model.system.layout.dimension
        own = [0.0] * n_s
        own[j] = float(target[j]) or (size / model.system.layout.extent if turned else size)
        other = scene.model_copy(update={"motion": scene.motion.model_copy(update={"target": own})})
        other._directory = scene._directory
        result.append(replace(model, scene=other))
    return result


class Trainer:
    """The full model of a scene, the basis grown from it, and the grid of its box. Collective.

    Args:
        model: of the scene; its table ``reduction`` has tolerance, box and method.
        earlier: a model with reconstruction, of the same :func:`train_key`, to go on from; None: none.

    Raises:
        SceneError: the scene's own material lies outside the box, or its motions cannot be trained.
        SolverError: a factorisation failed.
    """

    def __init__(self, model: Model, earlier: CertifiedModel | None = None) -> None:
        if reason := outside(model):
            raise SceneError(f"{reason}; a certified model needs its box around the scene's own material")
        model.scene.refuse_frame("a certified model")
        if (own := model.system.energy) is not None and own.certifiable:
            raise SceneError(f"the energy {own.law.name} has no certificate: {own.certifiable}; use another reduction")
        if model.scene._terms:
            raise SceneError("own terms have no certificate: their share of the stiffness has no known sign; drop them")
        if any(m.part for m in model.system.materials) and model.scene.reduction.layers == "apart":
            raise SceneError("reduction.layers = 'apart' cannot go with parameters of an own energy; use 'together'")
        if model.system.points is not None:
            raise SceneError("effects.finite_strain makes the tissue nonlinear; its bound needs linear tissue")
        self.model, self.models = model, motions_of(model)
        self.comm = model.system.layout.comm
        lam, mu = box_of(model)
        layers = model.scene.reduction.layers == "apart" and len(model.system.materials) > 1
        self.box = ParameterDomain((lam[0], lam[1]), (mu[0], mu[1]), layers)
        count = model.scene.reduction.grid
        axis = np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])
        draws = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        if layers:
            from scipy.stats import qmc  # half a second to import

            draws = qmc.Halton(2 * len(model.system.materials), scramble=False).random(count**2)
        self.parameters = self.at(draws)
        self.points = [(m[0].lam, m[0].mu) for m in self.parameters]
        self.reference = materials_at(model, float(np.sqrt(lam[0] * lam[1])), float(np.sqrt(mu[0] * mu[1])))
        self.space = ResidualSpace(model.system, self.reference)
        self.drives = [scene_drive(m.scene, m.system.M_hand, 1) for m in self.models]
        self._shared = TwoProcesses(self._own_bounds)
        self.Phi = np.zeros((model.system.layout.n_local, 0))
        self._runs: dict[int, list[Array]] = {}
        self.full_runs, self.added = 0, list[int]()
        if earlier is not None and earlier.fine.reconstruction is not None:
            hand = 2 * model.system.layout.n_s
            self._append(earlier.fine.reconstruction.L_q[:, hand : hand + earlier.k2])
            for i in earlier.training["added"]:
                self.add(i)

    def at(self, draws: Array) -> list[Materials]:
        """Materials of the box at coordinates of the unit cube, logarithmically, (n, layers or 1, 2)."""
        own = self.model.system.materials
        low, high = np.log([self.box.lam, self.box.mu]).T
        factors = np.exp(low + draws.reshape(len(draws), -1, 2) * (high - low)) / (own[0].lam, own[0].mu)
        factors = np.broadcast_to(factors, (len(draws), len(own), 2)).tolist()
        return [
            tuple(m if m.part else replace(m, lam=m.lam * a, mu=m.mu * b) for m, (a, b) in zip(own, each, strict=True))
            for each in factors
        ]

    def _append(self, Phi: Array) -> None:
        self.Phi = np.asfortranarray(np.hstack([self.Phi, Phi]))
        self.space.extend(Phi)
        self.certified = certified_model(
            self.model, self.Phi, space=self.space, box=self.box, drive=self.drives[0],
            norm=self.model.scene.reduction.norm,
        )  # fmt: skip

    def train(self, i: int) -> int:
        """Full runs at a point, and the modes that they add; the number of modes then. Collective.

        Raises:
            SolverError: a run failed.
        """
        if i not in self._runs:
            runs = [run_with(m, self.parameters[i]) for m in self.models]
            self.full_runs += len(runs)
            self._runs[i] = [thinned(run.snapshots, COLUMNS).Z for run in runs]
            entries = 2.0 * self.model.system.layout.n_e * COLUMNS * len(runs)
            while len(self._runs) * entries > CACHED and len(self._runs) > 1:
                self._runs.pop(next(iter(self._runs)))
        for Z in self._runs[i]:
            new = self._leading(Z, self.model.scene.reduction.add)
            if new.shape[1]:
                self._append(new)
        return self.Phi.shape[1]

    def _less(self, X: Array) -> Array:
        """X without its projection on Phi in K_r, twice. Collective."""
        K = self.space.system.K_ee
        for _ in range(2):
            if self.Phi.shape[1]:
                X = X - self.Phi @ total(self.comm, times_columns(K, self.Phi).T @ X)
        return np.asfortranarray(X)

    def _leading(self, Z: Array, count: int) -> Array:
        """Leading POD modes of the part of a run outside the span of Phi, orthonormal in K_r with Phi. Collective."""
        n = len(Z) // 2
        K = self.space.system.K_ee

        def length(x: Array) -> float:
            return float(np.sqrt(total(self.comm, (x * times_columns(K, x)).sum(axis=0)).sum()))

        left = [(x, length(x), length(Z_x)) for Z_x in (Z[:n], Z[n:]) for x in (self._less(Z_x),)]
        parts = [(x, own) for x, own, whole in left if own > ROUNDING * whole]  # the rest is rounding, not motion
        if not parts:
            return np.zeros((n, 0))
        X = np.hstack([x * (parts[0][1] / own) for x, own in parts])
        gram = total(self.comm, X.T @ times_columns(K, X))
        squares, V = on_root(self.comm, lambda: np.linalg.eigh((gram + gram.T) / 2))
        pick = [j for j in range(len(squares) - 1, -1, -1) if squares[j] > 1e-14 * squares[-1]][:count]
        modes = self._less(X @ (V[:, pick] / np.sqrt(squares[pick])))
        for j in range(len(pick)):  # what rounding left
            x = modes[:, j]
            x -= modes[:, :j] @ total(self.comm, modes[:, :j].T @ times_columns(K, x[:, None]))[:, 0]
            x /= np.sqrt(total(self.comm, (x[:, None] * times_columns(K, x[:, None])).sum(axis=0))[0])
        return modes

    def bound(self, indices: Sequence[int]) -> list[float]:
        """Relative bounds of the basis at some points of the grid, the largest of all motions. Collective."""
        return self.bounds_at([self.parameters[i] for i in indices], self.certified)

    def bounds_at(self, many: Sequence[Materials], model: CertifiedModel) -> list[float]:
        """The same at any materials and for any model; the ranks, or two processes, share the work. Collective."""
        values = np.zeros(len(many))
        parts = self.comm.allgather(self._shared(many[self.comm.rank :: self.comm.size], model))
        for rank, part in enumerate(parts):
            values[rank :: self.comm.size] = part
        return values.tolist()

    def _own_bounds(self, many: Sequence[Materials], model: CertifiedModel) -> list[float]:
        values = np.zeros(len(many))
        for drive in self.drives if many else ():
            own = np.array([certificate.reduction for certificate in model.certificates(many, drive)])
            np.maximum(values, own, out=values)
        return values.tolist()

    def add(self, i: int) -> None:
        """Make one of the random parameters a point of the training."""
        place = self.random(RANDOM, SEED)[i]
        self.added.append(i)
        self.parameters.append(place)
        self.points.append((place[0].lam, place[0].mu))

    def random(self, n: int, seed: int) -> list[Materials]:
        """Random materials of the box, the same on every rank."""
        width = len(self.model.system.materials) if self.box.independent_layers else 1
        return self.at(np.random.default_rng(seed).uniform(size=(n, width, 2)))

    def duals(self) -> OutputDuals:
        """Duals of the outputs for the basis as it is, at which the training ends. Collective."""
        axis = np.linspace(0.0, 1.0, DUAL_PLACES)
        draws = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        return output_duals(self.model, self.at(draws), self.space, self.Phi)

    def destroy(self) -> None:
        """Free the factors. Collective."""
        self._shared.end()
        self.space.destroy()


def train_key(model: Model) -> str:
    """What a training depends on: two of one key may go on from each other."""
    keys = model.scene.reduction.model_dump(
        include={"lambda_range", "mu_range", "grid", "layers", "add", "motions", "norm"}
    )
    others = ("name", "description", "reduction", "study", "output", "control")
    return f"{scene_hash(model.scene, others)} {sorted(keys.items())}"


def state_of(model: CertifiedModel) -> Greedy:
    """The greedy's state in a model that was saved on the way."""
    rounds = tuple(GreedyStep(**entry) for entry in model.training["rounds"])
    return Greedy(rounds, np.array(model.training["known"], dtype=float))


def history(trainer: Trainer, state: Greedy) -> dict[str, Any]:
    """What a greedy did, as :attr:`softgrasp.reduction.certified.model.CertifiedModel.training` keeps it."""
    return {
        "key": train_key(trainer.model),
        "rounds": [asdict(r) for r in state.rounds],
        "known": state.known.tolist(),
        "points": trainer.points,
        "added": trainer.added,
        "chosen": [trainer.points[r.at] for r in state.rounds],
        "reason": state.reason,
        "full_runs": trainer.full_runs,
    }


def build_certified(
    trainer: Trainer,
    tolerance: float,
    state: Greedy | None = None,
    progress: Callable[[Greedy, CertifiedModel], None] = lambda state, model: None,
) -> CertifiedModel:
    """Run the greedy to a tolerance, and choose the small basis. Collective.

    Where the grid has reached the tolerance and a random parameter has not, that becomes a point of the training too.

    Args:
        trainer: at the basis of ``state``.
        tolerance: relative.
        state: of an earlier training to go on from.
        progress: called after every round with the model so far, which can be saved and gone on from.

    Returns:
        The model; ``training["reason"]`` is why the training ended, ``training["proved"]`` the largest bound over the
        grid and random parameters. It has the tolerance whether or not that was reached: what is above is refused.
    """
    options, count = trainer.model.scene.reduction, len(trainer.points)
    hand = 2 * trainer.model.system.layout.n_s
    middle = (options.grid // 2) * (options.grid + 1)

    def after(state: Greedy) -> None:
        progress(state, replace(trainer.certified, training=history(trainer, state)))

    goal = tolerance if options.certify == "proof" else SHARE * tolerance
    most = max(1, (options.max_N - hand) // 2)
    state, random = state or start(count), trainer.random(RANDOM, SEED)
    while True:
        state = greedy(trainer.train, trainer.bound, state, middle, goal, most, after)
        bounds = trainer.bounds_at(random, trainer.certified)
        worst = int(np.argmax(bounds))
        if not state.reached or bounds[worst] <= goal or len(trainer.added) == ADDED:
            break
        trainer.add(worst)
        last = replace(state.rounds[-1], bound=bounds[worst], worst=len(state.known))
        state = Greedy((*state.rounds[:-1], last), np.append(state.known, bounds[worst]))
    model = replace(trainer.certified, training=history(trainer, state), tolerance=tolerance)
    many, known = [*trainer.parameters, *random], [*state.known, *bounds]
    if options.certify == "proof":
        proved = trainer.bounds_at(many, model)
    else:
        model, proved = smallest(trainer, model, many, known, tolerance)
    about = {"proved": max(proved), "checked": len(many), "why": REASONS[state.reason]}
    drive = scene_drive(trainer.model.scene, trainer.model.system.M_hand)
    certify = "estimate" if options.certify == "estimate" and model.certify == "two" else model.certify
    model = replace(model, training={**model.training, **about}, drive=drive, certify=certify)
    if certify == "estimate":
        return model
    with_duals = replace(model, duals=trainer.duals())
    pair = [m.run(drive=drive, allow=True).certificate.outputs.largest for m in (with_duals, model)]
    # the same on every rank: small arrays and no part of the mesh
    return with_duals if (pair[0] < WORTH * pair[1]).any() else model


def smallest(
    trainer: Trainer, model: CertifiedModel, many: Sequence[Materials], known: Sequence[float], tolerance: float
) -> tuple[CertifiedModel, list[float]]:
    """The same with the least leading basis whose certificate is within the tolerance everywhere, and its bounds.

    Bisection with the parameters of the largest ``known`` bounds; all are looked at where it ends, and those above the
    tolerance join. Where no basis will do, all modes make the answer, with one basis and its own bound. Collective.
    """
    watched = [int(i) for i in np.argsort(-np.array(known), kind="stable")[:WATCHED]]
    low, high = 0, model.k2

    def enough(k: int) -> bool:
        part = replace(model, k=k, certify="two")
        places = ([many[i] for i in some] for some in (watched[:WORST], watched[WORST:]))
        return all(max(trainer.bounds_at(each, part), default=0.0) <= tolerance for each in places)

    while True:
        while high - low > 1:
            k = (low + high) // 2
            low, high = (low, k) if enough(k) else (k, high)
        part = replace(model, k=high, certify="two") if high < model.k2 else model
        bounds = trainer.bounds_at(many, part)
        above = [i for i, bound in enumerate(bounds) if bound > tolerance]
        if not above or high == model.k2:
            return part, bounds
        watched += [i for i in above if i not in watched]
        low, high = high, model.k2


def offline_mesh_estimate(model: Model, places: Sequence[Materials]) -> OfflineMeshEstimate:
    """Estimate of the error of the mesh at some parameters, relative to the deformation. Collective.

    Raises:
        SoftgraspError: the mesh has no estimate.
    """
    scene = model.scene
    if scene.tissue.refine is not None:
        other = accuracy.next_order(model)
    else:
        other = build(accuracy.comparison(scene, accuracy.COMPARED[2][0]), comm=model.system.layout.comm)
    estimates = []
    for place in places:
        systems = ((m, m.system.with_materials(place)) for m in (model, other))
        pair = [krylov_model(replace(m, system=system)) for m, system in systems]
        estimates.append(accuracy.difference(pair[0], pair[1])[0])
    return OfflineMeshEstimate(tuple((place[0].lam, place[0].mu) for place in places), tuple(estimates))


def validate(trainer: Trainer, model: CertifiedModel, n: int) -> Validation:
    """Full runs at n random parameters: error of the estimate, and its confidence. Collective.

    With c the largest ratio seen, the share of the box where the error exceeds c times the estimate is at most
    1 - 0.05^(1/n) with a confidence of 95 %.
    """
    modes, tests = trainer.Phi[:, : model.k], []
    for place in trainer.random(n, SEED + 1):
        full = run_with(trainer.models[0], place)
        tests.append(measured_error(full, model.run(place, trainer.drives[0], allow=True), modes))
    factor, worst = max(t.truth / t.estimate if t.estimate else np.inf for t in tests), max(t.truth for t in tests)
    return Validation(n, factor, worst, float(1 - 0.05 ** (1 / n)))
