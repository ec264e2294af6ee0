"""The controller that a robot runs: a few numbers in, the hand load out, a thousand times a second."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.checksums import write_arrays
from softgrasp.fem.columns import hand_of
from softgrasp.fem.errors import no_pipe, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import ReducedSystem, midpoint_map
from softgrasp.fem.shown import Card, Shown, amount, counted, listed
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState

if TYPE_CHECKING:
    from softgrasp.lqr.loop.filter import Filter
    from softgrasp.lqr.program.program import Program

ABSURD = 1e150  # of a sample of the hand: squares of what follows from it are no numbers
FORMAT = 1
PLANNED = 2  # format of a controller with a plan, which a reader without plans must not take for its gain alone
PLANT = ("E", "A", "B", "C", "f", "S_q", "S_v")  # arrays of the reduced plant in a file
FILTER = ("A", "B", "f", "C", "M")  # of the observer


def layout_hash(layout: BlockLayout) -> str:
    """SHA-256 of sizes, reference point and all free nodes in sorted order: the same on any rank count. Collective."""
    sorted_ = _sorted(layout)
    return str(layout.comm.bcast(sorted_ and sorted_[1]))


def _sorted(layout: BlockLayout) -> tuple[NDArray[np.int64], str] | None:
    """Permutation of the free dofs to nodes sorted by coordinates, and the hash; None off rank 0. Collective."""
    parts = layout.comm.gather(np.array(layout.nodes))
    if parts is None:
        return None
    nodes, d = np.concatenate(parts), layout.dimension
    scale = float(np.abs(nodes).max(initial=0.0)) or 1.0
    # rounded, so that the last bits of another mesh generator do not count; + 0.0 turns -0 into 0
    rounded = np.round(np.vstack([layout.reference, nodes]) / scale, 9)
    order = np.lexsort(rounded[1:].T[::-1])
    digest = hashlib.sha256(json.dumps([d, layout.n_s, layout.n_e]).encode())
    digest.update((np.vstack([rounded[:1], rounded[1:][order]]) + 0.0).tobytes())
    return np.asarray((order[:, None] * d + np.arange(d)).ravel()), digest.hexdigest()


@dataclass(repr=False)
class Controller(Shown):
    """u = clip(u_bar + K (x - x_bar)) for x = [q_s, v_s, eta, eta'], with eta = W'z a few numbers of the tissue.

    A robot measures its hand, not the tissue. Without an observer ``step`` therefore carries eta itself: the tissue
    hangs on the hand, so the measured hand motion drives the model's tissue by the midpoint rule,

        M eta'' + D eta' + K eta = -G (a - g) [- alpha G v],   a = (v_k - v_{k-1}) / period,

    ([...] where damping drags in space), and what is wrong at the start decays with the tissue's own damping. With an
    observer the samples y of a tick correct the whole state. Nothing here talks to MPI or PETSc.

    Raises:
        ControlError: a shape is wrong, the plant does not begin with the hand, or the period is not positive.

    >>> import softgrasp as sg
    >>> controller = sg.make_controller(sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"])), order=8)
    >>> controller.step([0.0, 0.0], [0.0, 0.0]).shape
    (2,)
    """

    K: Array
    """Gain on the reduced state, (n_s, N)."""
    x_bar: Array
    """Reduced state at the target, (N,)."""
    u_bar: Array
    """Steady input at the target [N, N m], (n_s,)."""
    plant: ReducedSystem
    """Reduced plant that K was made for."""
    period: float = 1e-3
    """Time between two calls of ``step`` [s]."""
    limits: Array | None = None
    """Bounds on |u|, inf for none of one input [N, N m], (n_s,); None for none."""
    scene_hash: str = ""
    """Digest of the scene; empty when unknown."""
    layout_hash: str = ""
    """Digest of the mesh's free nodes; empty when unknown."""
    about: dict[str, Any] = field(default_factory=dict)
    """Method, weights and output names, as free text."""
    observer: Filter | None = None
    """Kalman filter of the reduced plant at the period; None where nothing but the hand is measured."""
    planner: Program | None = None
    """Plan past obstacles and its quadratic program, solved again at every interval; None where there is no plan."""

    def card(self) -> Card:
        """Dimension, rate, limits and target."""
        hand = hand_of(len(self.u_bar), self.plant.names)
        limits = () if self.limits is None else (amount(x, c.load_unit) for x, c in zip(self.limits, hand, strict=True))
        rows = (
            ("dimension", f"N = {self.plant.N}, {counted(len(self.u_bar), 'input')}"),
            ("rate", f"{1 / self.period:.4g} Hz"),
            ("limits", listed(limits)),
            ("hand at rest", listed(amount(x, c.unit) for x, c in zip(self.x_bar, hand, strict=False))),
        )
        return Card("Controller u = u_bar + K (x - x_bar)", rows)

    def __post_init__(self) -> None:
        n_s, N = self.plant.B.shape[1], self.plant.N
        shapes = {"K": (n_s, N), "x_bar": (N,), "u_bar": (n_s,), "limits": (n_s,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and (value.shape != shape or (name != "limits" and not np.isfinite(value).all())):
                raise ControlError(f"{name} of the controller must be finite and of shape {shape}, not {value.shape}")
        if not self.plant.hand_first:
            raise ControlError(
                "the plant of a controller must begin with q_s and v_s; make it with lqr.loop.small.galerkin"
            )
        if not self.period > 0:
            raise ControlError(f"period = {self.period} s of the controller must be positive")
        self._offset = self.u_bar - self.K @ self.x_bar
        self._lower = np.full(n_s, -np.inf) if self.limits is None else -self.limits
        self._upper = -self._lower
        if self.observer is not None and self.observer.B.shape != (N, n_s):
            raise ControlError(f"the observer has {len(self.observer.A)} states, the plant of the controller {N}")
        if self.planner is not None and self.planner.T.shape[1] != N:
            raise ControlError(f"the plan has {self.planner.T.shape[1]} states, the plant of the controller has {N}")
        self.model = _tissue_step(self.plant, self.period)
        self.reset()

    @property
    def n_s(self) -> int:
        """Degrees of freedom of the hand."""
        return int(self.plant.B.shape[1])

    def reset(self, tissue: Array | None = None) -> None:
        """Start anew with the tissue at [eta, eta'], (N - 2 n_s,); by default at rest."""
        n_s = self.n_s
        self._x = np.zeros(self.plant.N)
        self._x[2 * n_s :] = self.plant.rest_at(np.zeros(n_s))[0][2 * n_s :] if tissue is None else tissue
        self._fresh = True
        if self.planner is not None:
            from softgrasp.lqr.program.replan import Replanner  # of controllers with a plan

            self.replanner = Replanner(self.planner, self.K, self.x_bar, self.u_bar)

    def command(self, x: Array) -> Array:
        """Load for a known reduced state x (N,) [N, N m], (n_s,)."""
        u = self.K @ x
        u += self._offset
        return self._within(u)

    def _within(self, u: Array) -> Array:
        """The load within its limits."""
        return np.minimum(np.maximum(u, self._lower), self._upper)

    def step(self, q_s: Array, v_s: Array, y: Array | None = None) -> Array:
        """Load after one tick of the tissue [N, N m], (n_s,), from the measured hand q_s [m, rad] and v_s, (n_s,).

        ``y``: samples of the observer beside those of the hand [m, N], in the order of its names; an entry that is no
        number, or None for all, is lost. Where the hand is not measured, or its samples are absurdly large, a
        controller without observer gives the load of the tick before again; a plan goes on.

        Raises ControlError: there is no observer for y, q_s, v_s or y has another number of entries, or the hand is not
        measured at the first tick.
        """
        if len(q_s) != len(self.u_bar) or len(v_s) != len(self.u_bar):
            raise ControlError(f"q_s and v_s have {len(q_s)} and {len(v_s)} entries; this hand has {self.n_s} each")
        if self.observer is not None:
            return self._observed(q_s, v_s, y)
        if y is not None:
            raise ControlError("this controller has no observer that uses y; leave it out, or give the scene one")
        if not hypot(*q_s, *v_s) < ABSURD:
            return self._again()
        n_s, x = self.n_s, self._x
        step, accelerated, dragged, constant = self.model
        if not self._fresh:
            old = x[n_s : 2 * n_s]
            tissue = step @ x[2 * n_s :]
            tissue += accelerated @ (v_s - old)
            if dragged is not None:
                tissue += dragged @ (v_s + old)
            x[2 * n_s :] = tissue + constant
        self._fresh = False
        x[:n_s], x[n_s : 2 * n_s] = q_s, v_s
        self._last = self._load(x)
        return self._last.copy()

    def _again(self) -> Array:
        """The load of the tick before, where the hand is not measured."""
        if self._fresh:
            raise ControlError("the first samples of the hand must be finite; begin when q_s and v_s are measured")
        if self.planner is not None:
            self.replanner.command(np.full(len(self._x), np.nan))
        return self._last.copy()

    def _load(self, x: Array) -> Array:
        """Load of a tick for the state x, of the plan where there is one."""
        return self.command(x) if self.planner is None else self._within(self.replanner.command(x.copy()))

    def _observed(self, q_s: Array, v_s: Array, y: Array | None) -> Array:
        """One tick with an observer."""
        if self._fresh:
            from softgrasp.lqr.loop.filter import Estimate  # of controllers with an observer

            assert self.observer is not None
            self._x[: self.n_s], self._x[self.n_s : 2 * self.n_s] = q_s, v_s
            self._estimate, self._fresh = Estimate(self.observer, self._x.copy()), False
        self._x = self._estimate.correct(q_s, v_s, y)
        u = self._load(self._x)
        self._estimate.apply(u)
        return u

    @property
    def tissue(self) -> Array:
        """Current [eta, eta'] of the tissue, (N - 2 n_s,)."""
        return self._x[2 * self.n_s :].copy()

    def towards(self, q_bar: Array) -> Controller:
        """The same gain with another target of the hand.

        Raises ControlError: the target has another number of entries, the plant has no state of rest there, or the
        controller follows a plan.
        """
        if self.planner is not None:
            raise ControlError("this controller follows a plan to its own target; make another plan for another target")
        if np.shape(q_bar) != (self.n_s,) or not np.isfinite(q_bar).all():
            raise ControlError(f"the target must be {self.n_s} finite numbers, one for each motion of the hand")
        x_bar, u_bar = self.plant.rest_at(q_bar)
        return replace(self, x_bar=x_bar, u_bar=u_bar)

    def save(self, path: str | Path) -> Path:
        """Write everything into one .npz file, which NumPy alone reads. Not collective: call it on one rank.

        Arrays: ``K`` (n_s, N), ``x_bar`` (N,), ``u_bar`` (n_s,), the plant's matrices as ``plant_E``, ``plant_A`` and
        so on, ``limits`` (n_s,) where there are any, ``observer_...`` and ``plan_...`` with an observer or a plan. The
        text ``meta`` is JSON: format, names of the outputs, period [s], hashes of scene and mesh, origin.

        Raises ControlError: the file cannot be written.
        """
        meta = {key: getattr(self, key) for key in ("period", "scene_hash", "layout_hash", "about")}
        meta |= {"format": FORMAT if self.planner is None else PLANNED, "names": list(self.plant.names)}
        arrays = {f"plant_{key}": getattr(self.plant, key) for key in PLANT}
        arrays |= {"K": self.K, "x_bar": self.x_bar, "u_bar": self.u_bar}
        if self.limits is not None:
            arrays["limits"] = self.limits
        if self.observer is not None:
            arrays |= {f"observer_{key}": getattr(self.observer, key) for key in FILTER}
            meta["observer"] = {key: getattr(self.observer, key) for key in ("names", "speed", "delay")}
        if self.planner is not None:
            arrays |= {f"plan_{key}": np.asarray(value) for key, value in self.planner.arrays().items()}
        return write_npz(Path(path), meta, arrays)

    @classmethod
    def load(cls, path: str | Path, scene_hash: str | None = None, layout_hash: str | None = None) -> Controller:
        """Read a file of :meth:`save`.

        ``scene_hash``, ``layout_hash``: refuse a controller that was made for another scene or mesh.

        Raises ControlError: the file is missing, damaged, or made for something else.
        """
        meta, arrays = read_npz(Path(path), {"scene_hash": scene_hash, "layout_hash": layout_hash})
        if "tissue" in arrays:
            raise ControlError(f"{path} is a gain of full order, for lqr.load_gain; controller.npz has the controller")
        try:
            plant = ReducedSystem(**{key: arrays[f"plant_{key}"] for key in PLANT}, names=tuple(meta["names"]))
            about = {key: meta[key] for key in ("period", "scene_hash", "layout_hash", "about")}
            about |= {"limits": arrays.get("limits"), "observer": _filter(meta, arrays), "planner": _planner(arrays)}
            return cls(arrays["K"], arrays["x_bar"], arrays["u_bar"], plant, **about)
        except KeyError as error:
            raise ControlError(f"{path} has no controller ({error} is missing); save it again") from error


def _filter(meta: dict[str, Any], arrays: dict[str, Array]) -> Filter | None:
    """The observer of a file; None where it has none. Raises KeyError: an array is missing."""
    if "observer" not in meta:
        return None
    from softgrasp.lqr.loop.filter import Filter

    A, B, f, C, M = (arrays[f"observer_{key}"] for key in FILTER)
    names, speed, delay = (meta["observer"][key] for key in ("names", "speed", "delay"))
    return Filter(A, B, f, C, M, tuple(names), speed, delay)


def _planner(arrays: dict[str, Array]) -> Program | None:
    """The plan of a file; None where it has none. Raises KeyError: an array is missing."""
    if "plan_F" not in arrays:
        return None
    from softgrasp.lqr.program.program import Program

    return Program.of({key.removeprefix("plan_"): value for key, value in arrays.items() if key.startswith("plan_")})


def _tissue_step(plant: ReducedSystem, period: float) -> tuple[Array, Array, Array | None, Array]:
    """Matrices of the midpoint rule of the tissue, y = [eta, eta'], for a hand whose velocity is known.

    y_{k+1} = step y_k + accelerated (v_{k+1} - v_k) [+ dragged (v_{k+1} + v_k)] + constant
    """
    n_s = plant.B.shape[1]
    e, v = slice(2 * n_s, None), slice(n_s, 2 * n_s)
    loads = np.hstack([-plant.E[e, v] / period, plant.A[e, v] / 2, plant.f[e, None]])
    k = len(loads)
    moved = midpoint_map(plant.E[e, e], plant.A[e, e], loads, period)
    parts = np.split(moved, [k, k + n_s, k + 2 * n_s], axis=1)
    step, accelerated, dragged, constant = (np.ascontiguousarray(part) for part in parts)
    return step, accelerated, dragged if plant.A[e, v].any() else None, constant[:, 0].copy()


def save_gain(path: Path, gain: Gain, target: PlantState, layout: BlockLayout, scene_hash: str) -> Path:
    """Write a full-order gain and its target into one .npz file, rows in the order of the nodes. Collective.

    Raises ControlError: the file cannot be written.
    """
    sorted_ = _sorted(layout)
    parts = layout.comm.gather(np.column_stack([gain.K_z, gain.K_v, target.z, target.v_z]))
    with raise_on_all_ranks(layout.comm):
        if parts is not None and sorted_ is not None:
            meta = {"format": FORMAT, "scene_hash": scene_hash, "layout_hash": sorted_[1]}
            arrays = {"K_s": gain.K_s, "q_s": target.q_s, "v_s": target.v_s}
            write_npz(path, meta, arrays | {"tissue": np.concatenate(parts)[sorted_[0]]})
    return _named(path)


def load_gain(path: Path, layout: BlockLayout, scene_hash: str | None = None) -> tuple[Gain, PlantState]:
    """Read a file of :func:`save_gain` on any number of ranks; gain and target. Collective.

    Raises ControlError: the file is missing or damaged, or belongs to another mesh (or scene).
    """
    sorted_, ranges = _sorted(layout), layout.comm.gather((layout.start, layout.start + layout.n_local))
    pieces: list[tuple[Array, ...]] | None = None  # each rank is sent its own rows
    with raise_on_all_ranks(layout.comm):
        if sorted_ is not None and ranges is not None:
            _, arrays = read_npz(path, {"layout_hash": sorted_[1], "scene_hash": scene_hash})
            try:
                rows = np.empty_like(arrays["tissue"])
                rows[sorted_[0]] = arrays["tissue"]
                hand = (arrays["K_s"], arrays["q_s"], arrays["v_s"])
                pieces = [(*hand, np.array(rows[a:b])) for a, b in ranges]
            except (KeyError, IndexError, ValueError) as error:
                raise ControlError(f"{path} has no full-order gain ({error}); save it again") from error
    K_s, q_s, v_s, rows = layout.comm.scatter(pieces)
    K_z, K_v = (np.asfortranarray(part) for part in np.split(rows[:, :-2], 2, axis=1))
    return Gain(K_s, K_z, K_v), PlantState(q_s, v_s, rows[:, -2].copy(), rows[:, -1].copy())


def _named(path: Path) -> Path:
    """The name with .npz that NumPy would make of it."""
    return path if path.suffix == ".npz" else path.with_name(path.name + ".npz")


def write_npz(path: Path, meta: dict[str, Any], arrays: dict[str, Array]) -> Path:
    """Write arrays and their description; a torn file never replaces a good one. Returns the path, with .npz.

    Raises ControlError: the folder cannot be written.
    """
    path = _named(path)
    fresh = path.with_name("new-" + path.name)
    try:
        note(path)
        write_arrays(fresh, {"meta": np.array(json.dumps(meta)), **arrays})
        fresh.replace(path)
    except OSError as error:
        raise ControlError(f"{path} cannot be written ({error}); free the disk or choose another folder") from error
    return path


def read_npz(path: Path, expected: dict[str, str | None]) -> tuple[dict[str, Any], dict[str, Array]]:
    """Description and arrays of a file of :func:`write_npz`; ``expected``: hashes that the description must have.

    Raises ControlError: the file is missing or damaged, or a hash differs.
    """
    try:
        with np.load(no_pipe(path), allow_pickle=False) as file:
            meta: dict[str, Any] = json.loads(str(file["meta"]))
            arrays = {key: np.asarray(file[key]) for key in file.files if key != "meta"}
    except FileNotFoundError:
        raise ControlError(f"{path} does not exist; save the controller first") from None
    except Exception as error:  # zip, json and numpy have errors of their own for damaged files
        raise ControlError(f"{path} is damaged or no controller ({error}); save it again") from error
    if meta.get("format") not in (FORMAT, PLANNED):
        raise ControlError(
            f"{path} has the format {meta.get('format')}, this version reads {FORMAT} and {PLANNED}; save it again"
        )
    kinds = {"layout_hash": "mesh or hand", "scene_hash": "scene"}
    for key, value in expected.items():
        if value is not None and meta.get(key) != value:
            raise ControlError(
                f"{path} was made for another {kinds[key]} ({key} {str(meta.get(key))[:12]}..., here {value[:12]}...); "
                "design the controller again for this one"
            )
    return meta, arrays
