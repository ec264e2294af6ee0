"""The iteration of a step with a free hand in C: `free.c`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.compiled import library
from softgrasp.fem.frame.balance import MOST as CORRECTIONS
from softgrasp.fem.frame.balance import ROUNDING, HandBalance
from softgrasp.fem.obstacles.compiled import HEADERS, RIDGE
from softgrasp.fem.petsc import Array

SOURCE = Path(__file__).with_name("free.c")
FUNCTION = "int softgrasp_free(const Free *t);"


class FreeStep:
    """The struct of `free.c` with the matrices of a run.

    ``compiled``: ffi and functions of the library; ``steps`` (`TurningSteps`) and ``balance`` have the matrices;
    ``most`` and ``tol`` are those of the iteration.
    """

    def __init__(self, compiled: Any, steps: Any, balance: HandBalance, most: int, tol: float) -> None:
        self._ffi, self._code = compiled
        self._struct, self._arrays = self._ffi.new("Free *"), dict[str, Array]()
        small, k, d = steps.small, len(steps.a), steps.d
        sizes = {"k": k, "d": d, "n_s": small.G.shape[1], "most": most, "corrections": CORRECTIONS, "h": steps.dt}
        for name, value in (sizes | {"tol": tol, "rounding": ROUNDING}).items():
            setattr(self._struct, name, value)
        self._free = np.array(balance.free, dtype=np.intc)
        self._struct.free = self._ffi.from_buffer("int[]", self._free)
        self._set(
            still=steps.still, K=small.K, G=small.G, S=small.S, E=small.E, inverse=steps.inverse, M=balance.M,
            heavy=balance.heavy, g=balance.g, scale=np.zeros(1), held=np.zeros(d * d * k), moved=np.zeros(d * d * k),
            end=np.zeros(k), right=np.zeros(k), R=np.zeros(k),
        )  # fmt: skip

    @classmethod
    def of(cls, steps: Any, balance: HandBalance, most: int, tol: float) -> FreeStep | None:
        """For a run whose matrices are there; None, with a warning, without a compiler."""
        code = SOURCE.read_text()
        declaration = code[code.index("typedef struct {") : code.index("} Free;")] + "} Free;\n" + FUNCTION
        otherwise = "reduced models of a free hand that turns are stepped in NumPy, more slowly"
        compiled = library(SOURCE, declaration, otherwise, HEADERS, (f"RIDGE={RIDGE!r}",))
        return None if compiled is None else cls(compiled, steps, balance, most, tol)

    def _set(self, **arrays: Array) -> None:
        for name, array in arrays.items():
            self._arrays[name] = np.ascontiguousarray(array, dtype=float)
            setattr(self._struct, name, self._ffi.from_buffer("double[]", self._arrays[name]))

    def solve(self, w: Array, xi: Array, **start: Array) -> int:
        """Turn the trials w (k,) and xi (6,) into a step from ``start``; corrections, or -1 without convergence."""
        self._set(w=w, xi=xi, **start)
        return int(self._code.softgrasp_free(self._struct))
