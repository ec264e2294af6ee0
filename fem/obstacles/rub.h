/* Newton's method with Coulomb friction, see friction.c: its data, its matrix and the factor of that. Of a slipping node
   the row along its direction e is w (d_t'e - mu d_n) alone, w a number: the factor is without it. */
#pragma once
#include "dense.h"

#define REAL double
#define DOT dot_in_double
#define BACK back_in_double
#include "triangle.h"
#undef REAL
#undef DOT
#undef BACK
#define REAL float
#define DOT dot_in_float
#define BACK back_in_float
#include "triangle.h"

enum { OPEN, STICK, SLIP };
enum { SOLVED = 0, WANTED = 1, CYCLED = 2 };
enum { LATE = 2, PAST = 15 };        /* steps that are kept, at most */
static const double RIDGE_SINGLE = 1e-7; /* as RIDGE, of a factor in single precision */
static const double SLOW = 0.3; /* by how much a round should reduce the residual */

typedef struct {
  int k, m, ld;          /* nodes, tangents, columns of W */
  const double *W, *q, *mu;
  double tol;            /* of gaps and slips */
  double *before;        /* forces of the step before the last (k (1 + m)) */
  double *x, *y;         /* forces, and W x + q (k (1 + m)) */
  int *kind;             /* sets (k) */
  double *e;             /* of a slipping node: direction of its force, and mu x_n over |x_t - y_t / W_tt| (k (m + 1)) */
  int rows, size;        /* K = k (1 + m) where there is a factor, else 0; its unknowns */
  int single;            /* whether the factor is in single precision */
  double *LU;            /* factor of the transpose, by columns (size, size), */
  float *LU_single;      /* or this one */
  int *pivot;
  int *kind0;            /* sets and directions that it is of */
  double *e0;
  int most, count;       /* rows of the matrix that may be others than those of the factor, and that are */
  int *other;            /* these rows (most) */
  double *Z, *V, *C;     /* factor^-1 of their units, what they are more (most, K); small matrix (most, most) */
  double *room;          /* 6 K + most numbers */
  double *past;          /* steps of rounds in which no set changed (PAST + 1, K) */
  char *seen;            /* sets of the rounds (ROUNDS, k) */
  long *tally;           /* rounds, sweeps */
} Rub;

static double diagonal(const Rub *f, int r) { return f->W[(size_t)r * f->ld + r]; }

static void row_of(const Rub *f, int i, int a, int kind, const double *e, double *v) {
  const int s = 1 + f->m, K = f->k * s, r = i * s + a;
  memset(v, 0, K * sizeof(double));
  if (kind == OPEN) {
    v[r] = diagonal(f, r);
  } else if (a == 0 || kind == STICK) {
    memcpy(v, f->W + (size_t)r * f->ld, K * sizeof(double));
    v[r] *= 1 + RIDGE;
  } else {
    const double w = diagonal(f, i * s + 1), c = f->m > 1 ? e[f->m] : 0;
    for (int b = 0; b < f->m; b++) {
      const double P = (a - 1 == b) - e[a - 1] * e[b];
      if (c != 0) {
        const double *W = f->W + (size_t)(i * s + 1 + b) * f->ld;
        for (int j = 0; j < K; j++) v[j] += c * P * W[j];
      }
      v[i * s + 1 + b] += w * ((a - 1 == b) - c * P);
    }
    v[i * s] -= w * f->mu[i] * e[a - 1];
  }
}

/* A row v (K) of J times d, d the unknowns of the factor: (n, t..) of a sticking node, n of a slipping one and, with two
   tangents, the way p across its direction e; d_t = (mu d_n) e + d_p p, and open nodes have none. */
static void shorten(const Rub *f, const double *v, double *to) {
  const int s = 1 + f->m;
  for (int j = 0; j < f->k; j++, v += s) {
    const double *e = f->e0 + j * s;
    if (f->kind0[j] == OPEN) continue;
    if (f->kind0[j] == STICK) {
      for (int b = 0; b < s; b++) *to++ = v[b];
    } else if (f->m == 1) {
      *to++ = v[0] + f->mu[j] * e[0] * v[1];
    } else {
      *to++ = v[0] + f->mu[j] * (e[0] * v[1] + e[1] * v[2]);
      *to++ = e[0] * v[2] - e[1] * v[1];
    }
  }
}

/* The row of a slipping node across its direction, with two tangents. */
static void across(const Rub *f, int i, const double *e, double *restrict v) {
  const int K = 3 * f->k, r = 3 * i + 1;
  const double *W = f->W + (size_t)r * f->ld, *W2 = W + f->ld, own = diagonal(f, r) * (1 - e[2]);
  for (int j = 0; j < K; j++) v[j] = e[2] * (e[0] * W2[j] - e[1] * W[j]);
  v[r] -= own * e[1];
  v[r + 1] += own * e[0];
}

/* The matrix of the present sets without what single rows say, by rows, into LU. */
void softgrasp_matrix(Rub *f) {
  const int s = 1 + f->m, K = f->k * s;
  double *v = f->room, *row = v + K;
  memcpy(f->kind0, f->kind, f->k * sizeof(int));
  memcpy(f->e0, f->e, (size_t)f->k * s * sizeof(double));
  f->rows = K;
  f->count = f->size = 0;
  for (int i = 0; i < f->k; i++) f->size += f->kind[i] == OPEN ? 0 : f->kind[i] == STICK ? s : f->m;
  for (int i = 0, r = 0; i < f->k; i++)
    for (int a = 0; a < (f->kind[i] == OPEN ? 0 : f->kind[i] == STICK ? s : f->m); a++, r++) {
      if (a > 0 && f->kind[i] == SLIP) across(f, i, f->e + i * s, v);
      else row_of(f, i, a, f->kind[i], f->e + i * s, v);
      if (f->single && (a == 0 || f->kind[i] == STICK)) v[i * s + a] *= 1 + RIDGE_SINGLE;
      shorten(f, v, f->single ? row : f->LU + (size_t)r * f->size);
      for (int j = 0; f->single && j < f->size; j++) f->LU_single[(size_t)r * f->size + j] = (float)row[j];
    }
}

/* b <- J^-1 b for the J that the factor is of. Rows of open nodes, and those of slipping nodes along e, say what they are
   without the others, d_e = mu d_n + b_e / w; W takes it into the others' right-hand side. */
static void back(const Rub *f, double *restrict b) {
  const int s = 1 + f->m, K = f->rows;
  double *g = f->room + 3 * K + f->most, *c = g + K, *known = c + K;
  float *low = (float *)g;
  int some = 0, r = 0;
  memset(g, 0, K * sizeof(double));
  memset(known, 0, K * sizeof(double));
  for (int i = 0; i < f->k; i++) {
    const double *e = f->e0 + i * s, w = diagonal(f, i * s + 1);
    double *own = known + i * s, along = 0;
    if (f->kind0[i] == STICK) continue;
    if (f->kind0[i] == OPEN)
      for (int a = 0; a < s; a++) own[a] = b[i * s + a] / diagonal(f, i * s + a);
    for (int a = 0; f->kind0[i] == SLIP && a < f->m; a++) along += e[a] * b[i * s + 1 + a] / w;
    for (int a = 0; f->kind0[i] == SLIP && a < f->m; a++) own[1 + a] = along * e[a];
    for (int a = 0; a < s; a++) {
      if (own[a] == 0) continue;
      const double *W = f->W + (size_t)(i * s + a) * f->ld, t = own[a];
      for (int j = 0; j < K; j++) g[j] += t * W[j];
      some = 1;
    }
  }
  for (int i = 0; i < f->k; i++) {
    const double *e = f->e0 + i * s, *h = b + i * s, *G = g + i * s;
    if (f->kind0[i] == OPEN) continue;
    c[r++] = some ? h[0] - G[0] : h[0];
    if (f->kind0[i] == STICK)
      for (int a = 1; a < s; a++) c[r++] = h[a] - G[a];
    else if (f->m > 1) c[r++] = e[0] * h[2] - e[1] * h[1] - e[2] * (e[0] * G[2] - e[1] * G[1]);
  }
  if (f->single) {
    for (int j = 0; j < f->size; j++) low[j] = (float)c[j];
    back_in_float(f->size, f->LU_single, f->pivot, low);
    for (int j = 0; j < f->size; j++) c[j] = low[j];
  } else {
    back_in_double(f->size, f->LU, f->pivot, c);
  }
  r = 0;
  for (int i = 0; i < f->k; i++) {
    const double *e = f->e0 + i * s, *own = known + i * s;
    double *to = b + i * s;
    memcpy(to, own, s * sizeof(double));
    if (f->kind0[i] == OPEN) continue;
    to[0] = c[r++];
    if (f->kind0[i] == STICK)
      for (int a = 1; a < s; a++) to[a] = c[r++];
    else
      for (int a = 0; a < f->m; a++) to[1 + a] += f->mu[i] * to[0] * e[a];
    if (f->kind0[i] == SLIP && f->m > 1) to[1] -= c[r] * e[1], to[2] += c[r++] * e[0];
  }
}
