"""Affine operators for pyMOR: sums of matrices with products of parameters, whose names hold the units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SoftgraspError

UNITS = {"mu": "Pa", "lambda": "Pa", "rho": "kg/m3", "beta": "s"}
Factors = tuple[str, ...]
"""Parameters that multiply a matrix, of one layer; none for a constant matrix."""
Term = tuple[Factors, int, Any]
"""Parameters, number of their layer, and matrix, dense or sparse."""


def pymor_models() -> Any:
    """The module of pyMOR's models.

    Raises SoftgraspError: pyMOR is not installed, or the program runs on several ranks.
    """
    if MPI.COMM_WORLD.size > 1:  # importing pyMOR would put all ranks but the first into an event loop of its own
        raise SoftgraspError(
            f"to_pymor runs on one rank, not on {MPI.COMM_WORLD.size}; save the model and load it there"
        )
    try:
        import pymor.models.iosys as models
    except ImportError as error:
        raise SoftgraspError("pyMOR is not installed; `pip install pymor` brings it") from error
    return models


def operator(terms: Sequence[Term], layers: int, name: str) -> Any:
    """Sum over terms of (product of parameters) matrix, as an operator of pyMOR; zero matrices are left out.

    A parameter has one entry a layer, in pyMOR's ``mu`` under its name in `UNITS`.
    """
    from pymor.operators.constructions import LincombOperator
    from pymor.operators.numpy import NumpyMatrixOperator
    from pymor.parameters.functionals import ProductParameterFunctional, ProjectionParameterFunctional

    def factor(names: Factors, layer: int) -> Any:
        each = [ProjectionParameterFunctional(p, layers, layer, name=f"{p}_{layer + 1} [{UNITS[p]}]") for p in names]
        return each[0] if len(each) == 1 else ProductParameterFunctional(each)

    kept = [term for term in terms if abs(term[2]).max() > 0] or list(terms[:1])
    matrices = [NumpyMatrixOperator(matrix) for _, _, matrix in kept]
    if not any(names for names, _, _ in kept):
        total = matrices[0] if len(matrices) == 1 else NumpyMatrixOperator(sum(matrix for _, _, matrix in kept))
        return total.with_(name=name)
    factors = [factor(names, layer) if names else 1.0 for names, layer, _ in kept]
    return LincombOperator(matrices, factors, name=name)


def port(matrix: np.ndarray, names: Sequence[str]) -> Any:
    """Inputs or outputs, whose names and units are the name of the operator: "force_x [N], force_y [N]"."""
    return operator([((), 0, matrix)], 1, ", ".join(names))
