"""Bases of a user: displacements from a file that a scene names join the registry."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.pod import PartsRequest
from softgrasp.reduction.bases.registry import METHODS, OWN_METHODS, Method
from softgrasp.reduction.bases.states import BasisError, Columns, States
from softgrasp.reduction.bases.truncation import Part

Displacements = Callable[[States, int], Array]
"""Makes k or more displacements relative to the hand, local rows (n_local, k), the important ones first. Collective."""

DEPENDENT = 1e-7  # of a column's norm that the columns before it leave: less is rounding, as for the Cholesky factor


def displacement_method(key: str, title: str, displacements: Displacements) -> Method:
    """A second-order basis z = Phi a, v_z = Phi a' of displacements beside the hand's own columns, V' E V > 0.

    Its models keep symmetry and definiteness of M and K, so they are stable at every N. The columns are made
    orthonormal in the mass product, in their order.

    Args:
        key: name in ``reduction.methods``.
        title: one line for tables and figures.
        displacements: makes them; it may use snapshots, ``states.columns("qv", "relative").e_q``.
    """

    def parts(request: PartsRequest) -> tuple[Part, ...]:
        layout = request.states.layout

        def columns(k: int) -> tuple[Columns, ...]:
            with raise_on_all_ranks(layout.comm):
                X = np.asarray(displacements(request.states, k), dtype=np.float64)
                if X.shape[0] != layout.n_local or X.ndim != 2 or X.shape[1] < k or not np.isfinite(X).all():
                    raise BasisError(
                        f"the file gave displacements of shape {X.shape}; it must give finite ones of shape "
                        f"({layout.n_local}, {k}) or with more columns",
                        key,
                    )
            Phi = mass_orthonormal(request.states.system, X[:, :k], key)
            zero, hand = np.zeros_like(Phi), np.zeros((layout.n_s, k))
            return Columns(hand, hand, Phi, zero), Columns(hand, hand, zero, Phi)

        return (Part("displacements", np.zeros(0), 1.0, layout.n_e, columns),)

    return Method(key, title, None, True, parts, "qv", "relative", "second_order", True, True, False, "mass")


def mass_orthonormal(system: BlockSystem, X: Array, name: str = "") -> Array:
    """Phi with Phi' M_ee Phi = I and the same leading spans as X, local rows (n_local, k), Fortran order. Collective.

    Raises BasisError: a column lies in the span of those before it; the message names it.
    """
    Q = np.asfortranarray(X / np.sqrt(_gram(system, X).diagonal().clip(1e-300)))
    for _ in range(2):  # twice is enough
        try:
            R = np.linalg.cholesky(_gram(system, Q)).T
        except np.linalg.LinAlgError:
            R = np.zeros((1, 1))
        if not R.any() or R.diagonal().min() < DEPENDENT:
            raise BasisError(f"{X.shape[1]} displacements are linearly dependent to rounding; give fewer", name)
        Q = np.asfortranarray(np.linalg.solve(R.T, Q.T).T)
    return Q


def _gram(system: BlockSystem, X: Array) -> Array:
    return total(system.layout.comm, X.T @ times_columns(system.M_ee, np.asfortranarray(X)))


def load_plugins(files: Sequence[Path]) -> tuple[str, ...]:
    """Run each file and enter its ``METHODS`` into the registry; their keys. Collective.

    A file is a Python program of the user: it may do what its user may do.

    Raises BasisError: a file is missing, fails, has no METHODS, or uses the name of a shipped basis.
    """
    keys = []
    for file in files:
        if not file.is_file():
            raise BasisError(f"{file}: there is no such file; plugins are Python files, from the scene's folder")
        try:
            found = runpy.run_path(str(file), run_name=f"softgrasp_plugin_{file.stem}").get("METHODS")
        except Exception as error:
            raise BasisError(f"{file}: it ended with {type(error).__name__}: {error}") from error
        if not isinstance(found, list | tuple) or not found or not all(isinstance(m, Method) for m in found):
            raise BasisError(f"{file}: it must set METHODS, a list of softgrasp.reduction.bases.plugins' methods")
        for method in found:
            if method.key in METHODS:
                raise BasisError(f"{file}: '{method.key}' is the name of a shipped basis; use another")
            OWN_METHODS[method.key] = method
            keys.append(method.key)
    return tuple(keys)
