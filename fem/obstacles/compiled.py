"""The compiled half of contact: `contact.c`, the small problem and the step before half-spaces, and what else is C."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softgrasp.fem.strain.compiled import library

SOURCE = Path(__file__).with_name("contact.c")
HEADER = SOURCE.with_name("dense.h")
RIDGE = 1e-13  # share of the diagonal that makes equal rows share their force [1]
RETRIES = 3  # rounds without progress before rows change sides one by one
DEFINED = (f"RIDGE={RIDGE!r}", f"RETRIES={RETRIES}")


def compiled(source: Path, declaration: str) -> Any:
    """(ffi, library) of a source that includes `dense.h`, or None with a warning where it cannot be compiled."""
    return library(source, declaration, "contact is solved in NumPy, more slowly", HEADER, DEFINED)


def contact_library() -> Any:
    """See `compiled`, of `contact.c`."""
    code = SOURCE.read_text()
    struct = code[code.index("typedef struct {") : code.index("} Flat;")] + "} Flat;\n"
    return compiled(SOURCE, struct + DECLARATIONS)


DECLARATIONS = """
int softgrasp_complement(int p, int ld, const double *W, const double *q, double tol, int most,
  int *count, int *order, double *L, double *x, int *side, double *room, long *tally);
double softgrasp_look(const Flat *f);
int softgrasp_missing(const Flat *f, double tol, double *reached);
void softgrasp_values(const Flat *f, double *to);
void softgrasp_begin(const Flat *f);
void softgrasp_apply(const Flat *f, int columns, const double *x);
void softgrasp_account(const Flat *f, int n);
void softgrasp_carry(const Flat *f, int n, int pressed);
double softgrasp_rates(const Flat *f, double *fastest);
"""
