"""The compiled half of contact: `contact.c`, the small problem and the step before half-spaces, and what else is C."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.compiled import library

CODE = Path(__file__).with_name("code")
SOURCE = CODE / "contact.c"
HEADERS = tuple(sorted(CODE.glob("*.h")))
RIDGE = 1e-13  # share of the diagonal that makes equal rows share their force [1]
RETRIES = 3  # rounds without progress before rows change sides one by one
KINDS = {
    np.dtype(float): "double[]", np.dtype(np.float32): "float[]", np.dtype(np.intc): "int[]", np.dtype(bool): "char[]",
    np.dtype(np.int8): "char[]", np.dtype(np.int64): "long[]",
}  # fmt: skip
"""Types of arrays in C."""
DEFINED = (f"RIDGE={RIDGE!r}", f"RETRIES={RETRIES}")


def compiled(source: Path, declaration: str, *defined: str) -> Any:
    """(ffi, library) of a source that includes `dense.h`, or None with a warning where it cannot be compiled."""
    return library(source, declaration, "contact is solved in NumPy, more slowly", HEADERS, DEFINED + defined)


def contact_library() -> Any:
    """See `compiled`, of `contact.c`."""
    return compiled(SOURCE, _struct("swept.h", "Swept") + _struct("flat.h", "Flat") + DECLARATIONS)


def friction_library(tangents: int) -> Any:
    """See `compiled`, of `friction.c` for nodes with so many tangents."""
    return compiled(CODE / "friction.c", _struct("rub.h", "Rub") + RUB_DECLARATIONS, f"TANGENTS={tangents}")


def _struct(header: str, name: str) -> str:
    code, end = (CODE / header).read_text(), f"}} {name};\n"
    return code[code.index("typedef struct {") : code.index(end)] + end


DONE, TAKE, ENTER, BALANCE, SOLVE, SWEEP, UNSOLVED, UNSETTLED = range(8)  # what a step needs before it goes on
DECLARATIONS = """
int softgrasp_complement(int p, int ld, const double *W, const double *q, double tol, int most,
  int *count, int *order, double *L, double *x, int *side, double *room, long *tally);
double softgrasp_look(const Flat *f);
void softgrasp_products(const Swept *s, int j, double *to);
void softgrasp_combine(const Swept *s, const double *t, double *to);
void softgrasp_values(const Flat *f, double *to);
void softgrasp_refresh(const Flat *f);
int softgrasp_step(Flat *f, int n);
int softgrasp_finish(Flat *f, int n, const double *v);
int softgrasp_strike(Flat *f, int n, double *v);
void softgrasp_jump(const Flat *f, double *v);
int softgrasp_stop(Flat *f);
"""
RUB_DECLARATIONS = """
int softgrasp_matrix(Rub *f);
void softgrasp_begin(Rub *f, int where, int known);
int softgrasp_rub(Rub *f, int begin, int rounds);
void softgrasp_sweep(Rub *f, int sweeps, double still);
double softgrasp_wrong(Rub *f);
int softgrasp_stays(const void *flat, const int *rows, int count);
void softgrasp_jolt(const void *flat, const Rub *step, const int *rows, Rub *jolt);
int softgrasp_jolted(const void *flat, const Rub *step, const int *rows, const Rub *jolt);
"""
