/* Newton's method with Coulomb friction, see friction.c: its data, its matrix and the factor of that. Of a slipping node
   the row along its direction e is w (d_t'e - mu d_n) alone, w a number: the factor is without it. */
#pragma once
#include "dense.h"

enum { OPEN, STICK, SLIP };
enum { SOLVED = 0, WANTED = 1, CYCLED = 2 };
enum { LATE = 2, PAST = 15 };        /* steps that are kept, at most */
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
  double *LU;            /* factor, by columns (size, size) */
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
static void shorten(const Rub *f, const double *v, double *to, int step) {
  const int s = 1 + f->m;
  for (int j = 0; j < f->k; j++, v += s) {
    const double *e = f->e0 + j * s;
    if (f->kind0[j] == OPEN) continue;
    double n = v[0];
    for (int b = 0; f->kind0[j] == SLIP && b < f->m; b++) n += f->mu[j] * e[b] * v[1 + b];
    *to = n;
    to += step;
    if (f->kind0[j] == STICK)
      for (int b = 0; b < f->m; b++, to += step) *to = v[1 + b];
    else if (f->m > 1) *to = e[0] * v[2] - e[1] * v[1], to += step;
  }
}

/* The matrix of the present sets without what single rows say, by columns, into LU. */
void softgrasp_matrix(Rub *f) {
  const int s = 1 + f->m, K = f->k * s;
  double *v = f->room, *v2 = v + K;
  memcpy(f->kind0, f->kind, f->k * sizeof(int));
  memcpy(f->e0, f->e, (size_t)f->k * s * sizeof(double));
  f->rows = K;
  f->count = f->size = 0;
  for (int i = 0; i < f->k; i++) f->size += f->kind[i] == OPEN ? 0 : f->kind[i] == STICK ? s : f->m;
  for (int i = 0, r = 0; i < f->k; i++)
    for (int a = 0; a < (f->kind[i] == OPEN ? 0 : f->kind[i] == STICK ? s : f->m); a++, r++) {
      const double *e = f->e + i * s;
      row_of(f, i, a, f->kind[i], e, v);
      if (a > 0 && f->kind[i] == SLIP) { /* across e alone */
        row_of(f, i, 2, SLIP, e, v2);
        for (int j = 0; j < K; j++) v[j] = e[0] * v2[j] - e[1] * v[j];
      }
      shorten(f, v, f->LU + r, f->size);
    }
}

/* b <- LU^-1 b. */
static void factor_back(const Rub *f, double *restrict b) {
  const int K = f->size;
  for (int j = 0; j < K; j++) {
    const double t = b[f->pivot[j]];
    b[f->pivot[j]] = b[j];
    b[j] = t;
  }
  int j = 0;
  for (; j + 4 <= K; j += 4) { /* four columns in a pass */
    const double *l = f->LU + (size_t)j * K, *l1 = l + K, *l2 = l1 + K, *l3 = l2 + K, t0 = b[j];
    const double t1 = b[j + 1] -= l[j + 1] * t0;
    const double t2 = b[j + 2] -= l[j + 2] * t0 + l1[j + 2] * t1;
    const double t3 = b[j + 3] -= l[j + 3] * t0 + l1[j + 3] * t1 + l2[j + 3] * t2;
    for (int i = j + 4; i < K; i++) b[i] -= (l[i] * t0 + l1[i] * t1) + (l2[i] * t2 + l3[i] * t3);
  }
  for (; j < K; j++)
    for (int i = j + 1; i < K; i++) b[i] -= f->LU[(size_t)j * K + i] * b[j];
  for (j = K; j > K / 4 * 4;) {
    const double *u = f->LU + (size_t)--j * K, t = b[j] /= u[j];
    for (int i = 0; i < j; i++) b[i] -= u[i] * t;
  }
  while (j > 0) {
    j -= 4;
    const double *u = f->LU + (size_t)j * K, *u1 = u + K, *u2 = u1 + K, *u3 = u2 + K, t3 = b[j + 3] /= u3[j + 3];
    const double t2 = b[j + 2] = (b[j + 2] - u3[j + 2] * t3) / u2[j + 2];
    const double t1 = b[j + 1] = (b[j + 1] - u3[j + 1] * t3 - u2[j + 1] * t2) / u1[j + 1];
    const double t0 = b[j] = (b[j] - u3[j] * t3 - u2[j] * t2 - u1[j] * t1) / u[j];
    for (int i = 0; i < j; i++) b[i] -= (u[i] * t0 + u1[i] * t1) + (u2[i] * t2 + u3[i] * t3);
  }
}

/* b <- J^-1 b for the J that the factor is of. Rows of open nodes, and those of slipping nodes along e, say what they are
   without the others, d_e = mu d_n + b_e / w; W takes it into the others' right-hand side. */
static void back(const Rub *f, double *restrict b) {
  const int s = 1 + f->m, K = f->rows;
  double *g = f->room + 3 * K + f->most, *c = g + K, *known = c + K;
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
  factor_back(f, c);
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
