"""The compiled half of contact, `contact.c`: the small problem, and the step before half-spaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softgrasp.fem.strain.compiled import library

SOURCE = Path(__file__).with_name("contact.c")


def contact_library() -> Any:
    """(ffi, library), or None with a warning where it cannot be compiled."""
    code = SOURCE.read_text()
    struct = code[code.index("typedef struct {") : code.index("} Flat;")] + "} Flat;\n"
    return library(SOURCE, struct + DECLARATIONS, "contact is solved in NumPy, more slowly")


DECLARATIONS = """
int softgrasp_complement(int p, int ld, const double *W, const double *q, double tol, int most,
  int *count, int *order, double *L, double *x, int *side, double *room, long *tally);
double softgrasp_look(const Flat *f);
int softgrasp_missing(const Flat *f, double tol, double *reached);
void softgrasp_begin(const Flat *f);
void softgrasp_apply(const Flat *f, int columns, const double *x);
void softgrasp_account(const Flat *f, int n);
void softgrasp_carry(const Flat *f, int n, int pressed);
double softgrasp_rates(const Flat *f, double *fastest);
"""
