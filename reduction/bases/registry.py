"""All bases by key: what each is, what the paper calls it, how to make one or a sweep; and Craig-Bampton's own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import get_args

import numpy as np

from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.bases.basis import Basis, Coordinates, Frame, Structure
from softgrasp.reduction.bases.engines import EngineName
from softgrasp.reduction.bases.inner import INNERS, InnerName
from softgrasp.reduction.bases.pod import PartsRequest, componentwise_parts, joint_parts
from softgrasp.reduction.bases.psd import complex_svd_parts, cotangent_lift_parts, svd_like_parts
from softgrasp.reduction.bases.states import BasisError, Columns, States
from softgrasp.reduction.bases.truncation import PAPER_ENERGY, Part, Truncation, counts_of


def craig_bampton_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Clamped modes K_ee phi = omega^2 M_ee phi by SLEPc, used for z and for v_z: V_e = blkdiag(Phi, Phi) [CB68].

    No snapshots. The static modes -K_ee^-1 K_es are T, the rigid motion of the hand, because K_ee T + K_es = 0. In the
    hand-relative frame they are the hand's own unit columns and z = Phi a. Phi' M_ee Phi = I and
    Phi' K_ee Phi = diag(omega^2): V is orthonormal in the mass product. Collective.
    """
    system, layout = request.states.system, request.states.layout

    def columns(k: int) -> tuple[Columns, ...]:
        Phi = lowest_modes(system, k)[1] if k else np.zeros((layout.n_local, 0))
        zero, hand = np.zeros_like(Phi), np.zeros((layout.n_s, k))
        return Columns(hand, hand, Phi, zero), Columns(hand, hand, zero, Phi)

    return (Part("clamped modes", np.zeros(0), 1.0, layout.n_e, columns),)


@dataclass(frozen=True)
class Method:
    """One basis of the registry."""

    key: str  # name in scenes and results
    title: str  # name in tables and figures
    paper: str | None  # name in the paper; None for those beyond it
    preserving: bool  # the reduced model keeps the Hamiltonian or the second-order structure
    build: Callable[[PartsRequest], tuple[Part, ...]]  # function that makes the parts from the snapshots
    coordinates: Coordinates  # "qv" with velocities, "qp" with momenta
    frame: Frame  # frame of the tissue rows: absolute, or relative to the rigid motion of the hand
    structure: Structure  # structure that V or its tissue columns keep
    fixed: bool  # the hand's unit columns are kept apart from the decomposition
    pairs: bool  # units are pairs of columns, so N is even
    snapshots: bool = True  # whether it needs any
    inner: InnerName = "euclidean"  # inner product it is built in unless another is requested

    @property
    def short_title(self) -> str:
        """Title for a legend, a narrow column or a sentence."""
        return self.title.replace(", fixed solid modes", ", fixed")


def _methods() -> dict[str, Method]:
    solid, gpsd = "with fixed solid modes", "Global Proper Symplectic Decomposition (GPSD)"
    table: list[tuple[str, str, str | None, str | None, Callable[[PartsRequest], tuple[Part, ...]], bool]] = [
        ("global_pod", "global POD", "Global POD", f"POD {solid}", joint_parts, False),
        ("componentwise_pod", "componentwise POD", "Componentwise POD", f"Componentwise POD {solid}",
         componentwise_parts, False),
        ("psd", "PSD complex SVD", gpsd, f"PSD {solid}", complex_svd_parts, True),
        ("psd_cotangent_lift", "PSD cotangent lift", None, None, cotangent_lift_parts, True),
        ("psd_svd_like", "PSD SVD-like", None, None, svd_like_parts, True),
    ]  # fmt: skip
    result: dict[str, Method] = {}
    for stem, title, whole, apart, build, pairs in table:
        for suffix, fixed, paper in (("", False, whole), ("_fixed", True, apart)):
            key = "pod_fixed" if stem + suffix == "global_pod_fixed" else stem + suffix
            words = ("POD" if key == "pod_fixed" else title) + (", fixed solid modes" if fixed else "")
            for canonical, frame in product((True, False) if pairs else (False,), get_args(Frame)):
                tail, title_tail = ("_qv", " in (q, v)") if pairs and not canonical else ("", "")
                own = paper if frame == "absolute" else None
                if frame == "relative":
                    tail, title_tail = f"{tail}_relative", f"{title_tail}, hand-relative"
                # SVD-like pairs hardly depend on the product; the paper's are Euclidean
                inner: InnerName = "energy" if canonical and stem != "psd_svd_like" and not own else "euclidean"
                result[key + tail] = Method(
                    key + tail, words + title_tail, own, canonical, build, "qp" if canonical else "qv", frame,
                    "symplectic" if canonical else "none", fixed, pairs, inner=inner,
                )  # fmt: skip
    result["craig_bampton"] = Method(
        "craig_bampton", "Craig-Bampton", None, True, craig_bampton_parts,
        "qv", "relative", "second_order", True, True, snapshots=False, inner="mass",
    )  # fmt: skip
    return result


METHODS: dict[str, Method] = _methods()
"""Every shipped basis by key."""

OWN_METHODS: dict[str, Method] = {}
"""Bases of a user by key, see :mod:`softgrasp.reduction.bases.plugins`."""

PAPER_METHODS = ("global_pod", "componentwise_pod", "pod_fixed", "componentwise_pod_fixed", "psd", "psd_fixed")
"""The six of the paper, in its order."""

PAPER_PLAIN = ("global_pod", "componentwise_pod")
"""Those of the six that the paper counts as not structure-preserving; fixed solid modes keep its block structure."""


def find_method(name: str) -> Method:
    """Look a basis up. Raises BasisError: there is none of this name."""
    known = METHODS | OWN_METHODS
    if name not in known:
        some = dict.fromkeys((*PAPER_METHODS, "psd_svd_like", "craig_bampton", *OWN_METHODS))
        raise BasisError(
            f"basis '{name}' is unknown; choose one of {', '.join(some)}, or another key of softgrasp.reduction.METHODS"
        )
    return known[name]


def make_basis(
    name: str,
    states: States,
    size: int | Truncation | None = None,
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> Basis:
    """V of shape (2n, N) from snapshots X: POD minimises |X - V V^+ X|_F, PSD does under V' J V = J. Collective.

    Sources: the six of :data:`PAPER_METHODS` [SBRH21]; complex SVD and cotangent lift [PM16]; SVD-like pairs [BBH19];
    inner products [AH19]; Craig-Bampton [CB68], which needs no snapshots.

    Args:
        name: key of :data:`METHODS`.
        states: system and snapshots: z and v_z (2 n_local, m) [m, m/s] with the hand (n_s, m) of every run.
        size: N of the whole basis, the hand's columns included, or a rule; None keeps 99.9 % of the energy, as the
            paper does.
        inner: inner product; None: energy on graded meshes, else that of the method: Euclidean for the paper's six
            and all in (q, v), energy for canonical bases beyond them, where it is ten times better. SVD-like pairs
            depend on it little.
        engine: engine of the tall factorisation.

    Raises:
        BasisError: unknown name, unusable snapshots, or N that does not fit.
        SolverError: the factorisation fails.
    """
    return make_bases(name, states, (Truncation(energy=PAPER_ENERGY) if size is None else size,), inner, engine)[0]


def make_bases(
    name: str,
    states: States,
    sizes: Sequence[int | Truncation],
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> tuple[Basis, ...]:
    """Build the bases of a sweep with one factorisation: smaller ones are leading columns of the larger. Collective.

    Args and errors as in :func:`make_basis`; one basis for each of ``sizes``.
    """
    method = find_method(name)
    metric = _inner_of(method, inner, states.system.graded)
    rules = [Truncation(N=size) if isinstance(size, int | np.integer) else size for size in sizes]
    clock = [time.thread_time()]
    n_s = states.layout.n_s
    if method.pairs and not method.fixed and method.frame == "relative" and states.system.two_way:
        raise BasisError(
            "with two-way coupling M_ee v_z is no canonical momentum beside that of the hand; "
            f"use {name.replace('_relative', '')} or a basis with fixed solid modes",
            name,
        )
    hand, tissue = np.zeros((n_s, 0)), np.zeros((states.layout.n_local, 0))
    snapshots = Columns(hand, hand, tissue, tissue)
    if method.snapshots:
        snapshots = states.columns(method.coordinates, method.frame)
    clock.append(time.thread_time())
    count = max((rule.N for rule in rules if rule.N is not None), default=None)
    share = min((rule.share for rule in rules if rule.N is None), default=None)
    request = PartsRequest(states, snapshots, not method.fixed, method.coordinates, metric, engine, count, share)
    parts = method.build(request)
    if not method.snapshots and share is not None:
        raise BasisError(f"{name} uses no snapshots, so it has no energy to keep; give N")
    fixed = 2 * n_s if method.fixed else 0
    counts = [counts_of(parts, 2 if method.pairs else 1, fixed, rule, name) for rule in rules]
    clock.append(time.thread_time())
    columns = [part.columns(max(c[i] for c in counts)) for i, part in enumerate(parts)]
    clock.append(time.thread_time())
    seconds = dict(zip(("snapshots", "factor", "vectors"), np.diff(clock).tolist(), strict=True))
    # offline times of a method are those of the method alone
    seconds["snapshots"] = snapshots.kept.setdefault("seconds", seconds["snapshots"]) + states.condensing
    seconds["factor"] += sum(request.spared)
    whole = Basis(
        method.key, states.layout, *(np.zeros((0, 0)),) * 4, method.coordinates, method.frame, method.structure,
        method.fixed, metric, parts[0].rate, method.pairs,
        tuple(part.scale * part.sigma for part in parts if len(part.sigma)), (), seconds,
    )  # fmt: skip
    return tuple(_cut(whole, columns, c) for c in counts)


def _inner_of(method: Method, inner: InnerName | None, graded: bool) -> InnerName:
    if inner is not None and inner not in INNERS:
        raise BasisError(f"inner product '{inner}' is unknown; choose one of {', '.join(INNERS)}")
    if not method.snapshots and inner not in (None, method.inner):
        raise BasisError(f"{method.key} is orthonormal in the mass product by definition; leave inner out")
    return inner or ("energy" if graded and method.snapshots else method.inner)


def _cut(whole: Basis, columns: Sequence[tuple[Columns, ...]], counts: tuple[int, ...]) -> Basis:
    """Hand columns if fixed, then the leading units of every part, first halves before second halves."""
    n_s, n = whole.layout.n_s, whole.layout.n_local
    sets = [half.first(k) for halves, k in zip(columns, counts, strict=True) for half in halves]
    if whole.fixed_solid:
        tissue = np.zeros((n, 2 * n_s))
        sets.insert(0, Columns(np.eye(n_s, 2 * n_s), np.eye(n_s, 2 * n_s, k=n_s), tissue, tissue))

    V, split = Columns.beside(sets), tuple((2 if whole.pairs else 1) * k for k in counts)
    return replace(
        whole, V_sq=V.s_q, V_sv=V.s_p, V_q=V.e_q, V_p=V.e_p, split=split, seconds=dict(whole.seconds)
    )  # fmt: skip


def impossible_sizes(method: Method, n_s: int, sizes: Sequence[int]) -> dict[int, str]:
    """The N among ``sizes`` that this method cannot have whatever the snapshots are, each with the reason."""
    step = 2 if method.pairs else 1
    hand = 2 * n_s if method.fixed else 0
    least = hand + step
    reasons = {N: f"the {hand} columns of the hand count; request N >= {least}" for N in sizes if least > N}
    return reasons | {N: "only even N exist for this basis" for N in sizes if N % step}


def possible_sizes(method: Method, n_s: int, sizes: Sequence[int]) -> list[int]:
    """The N among ``sizes`` that this method can have, ascending; the hand's 2 n_s columns count."""
    return sorted(set(sizes) - impossible_sizes(method, n_s, sizes).keys())
