/* Rows n'w = (F n)'D y of the second sweep w = B y of a solve before it, and forces into y: S^-1 = B F, see sweeps.py.
   F n is in runs of consecutive entries. The mass of one component has such columns too, with blocks of one entry. */
#pragma once
#include "dense.h"

typedef struct {
  int d, columns;       /* rows of a node; columns F n */
  const int *first;     /* run with which each column begins (columns + 1) */
  const int *runs;      /* entry with which each run begins, and its length (.., 2) */
  const long *at;       /* value with which each column begins (columns + 1) */
  const double *values;
  int reached;          /* nodes on which a column has entries */
  const int *nodes;     /* which (reached) */
  const double *D;      /* blocks of all nodes (.., d, d) */
  double *y, *z;        /* first sweep, and room that is zero elsewhere (n) */
} Swept;

/* z = D x. */
static void softgrasp_scale(const Swept *s, const double *from) {
  const int d = s->d;
  for (int i = 0; i < s->reached; i++) {
    const double *x = from + (size_t)s->nodes[i] * d, *D = s->D + (size_t)s->nodes[i] * d * d;
    double *z = s->z + (size_t)s->nodes[i] * d, t[3] = {0, 0, 0};
    for (int a = 0; a < d; a++)
      for (int b = 0; b < d; b++) t[a] += D[a * d + b] * x[b];
    for (int a = 0; a < d; a++) z[a] = t[a];
  }
}

/* Column k times z. */
static double softgrasp_times(const Swept *s, int k) {
  const double *v = s->values + s->at[k];
  double sum = 0;
  for (int i = s->first[k]; i < s->first[k + 1]; i++) {
    sum += dot(s->runs[2 * i + 1], v, s->z + s->runs[2 * i]);
    v += s->runs[2 * i + 1];
  }
  return sum;
}

/* Add t times column k. */
static void softgrasp_add(const Swept *s, int k, double t, double *to) {
  const double *v = s->values + s->at[k];
  for (int i = s->first[k]; i < s->first[k + 1]; i++) {
    double *y = to + s->runs[2 * i];
    for (int j = 0; j < s->runs[2 * i + 1]; j++) y[j] += t * v[j];
    v += s->runs[2 * i + 1];
  }
}

/* Add columns t. */
void softgrasp_combine(const Swept *s, const double *t, double *to) {
  for (int k = 0; k < s->columns; k++)
    if (t[k] != 0) softgrasp_add(s, k, t[k], to);
}

/* Products of column j with those up to it. */
void softgrasp_products(const Swept *s, int j, double *to) {
  for (int i = 0; i < s->reached; i++)
    for (int a = 0; a < s->d; a++) s->z[s->nodes[i] * s->d + a] = 0;
  softgrasp_add(s, j, 1, s->z);
  softgrasp_scale(s, s->z);
  for (int k = 0; k <= j; k++) to[k] = softgrasp_times(s, k);
}
