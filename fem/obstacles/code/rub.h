/* Newton's method with Coulomb friction, see friction.c: its data, its unknowns and the factor of its matrix.

   Of y = W x + q one side is unknown, u, and the other follows, v: forces x of pressed nodes, or, from W^-1, the slips y of
   slipping nodes and the gaps of open ones. What the sets say of u is known: no force of an open node, no slip of a
   sticking one, no gap of a pressed one, and the force of a slipping node along its direction e is mu times the normal
   one. The rest has one row of the matrix each. TANGENTS, the number m of a node, comes from Python, see compiled.py. */
#pragma once
#include "dense.h"

#define REAL double
#define VEC Vec_double
#define DOT dot_in_double
#define BACK back_in_double
#define TIMES times_in_double
#include "triangle.h"
#undef REAL
#undef VEC
#undef DOT
#undef BACK
#undef TIMES
#define REAL float
#define VEC Vec_float
#define DOT dot_in_float
#define BACK back_in_float
#define TIMES times_in_float
#include "triangle.h"

enum { OPEN, STICK, SLIP };
enum { HERE, OPENED, FIRST };
enum { SOLVED = 0, WANTED = 1, CYCLED = 2, DRIFTED = 3 }; /* the last: W^-1 is too inexact */
enum { KEPT = 24, DRIFTS = 3, PATIENCE = 25 }; /* steps of a round, refinements of W^-1, rounds without gain, at most */
static const double RIDGE_SINGLE = 1e-7; /* as RIDGE, of a factor in single precision */
static const double READ = 2e10, FLOPS = 5e10, CALL = 3e-5; /* bytes and operations per second, seconds of a call: what
                                                               steps and factors cost in proportion */
enum { LITTLE = 64 };                             /* unknowns up to which factors are made in C */
static const double EACH = 4e-6, SLOWER = 5e9;    /* then: seconds of a step beside, operations per second */

typedef struct {
  int k, ld;                 /* nodes, columns of W */
  const double *W, *mu;
  double *q, *base;          /* y without forces; while `based` is 1, y under the forces `base` */
  int based;
  const double *inverse;     /* of W, (K, K) with K = k (1 + m), or NULL */
  double sure;               /* error of W times it times numbers, over the largest of these */
  const float *low, *inverse_low; /* both in single precision, where steps use it, or NULL */
  double tol;                /* of gaps and slips */
  double *before, *before_y; /* x and y at the end of the step before the last (K) */
  double *x, *y;             /* forces, and W x + q (K) */
  int had, led;              /* whether that step had forces, and this solve continues them */
  int *kind;                 /* sets (k) */
  double *e;                 /* of a slipping node: direction of its force, and mu x_n over |x_t - y_t / W_tt| (k (1 + m)) */
  int slips;                 /* whether the unknowns are y */
  int rows, size;            /* K where there is a factor, else 0; its unknowns */
  int single;                /* whether the factor is in single precision */
  double *LU;                /* factor of the transpose, by columns (size, size), */
  float *LU_single;          /* or this one */
  int *pivot;
  int slips0, *kind0;        /* sides, sets and directions that it is of */
  double *e0;
  int age;                   /* steps that it led to, */
  double work;               /* and their cost [s] */
  int begun, taken, n;       /* whether a round is in work, its steps and unknowns */
  double left, target;       /* its residual, and where it ends */
  double vague;              /* what products in single precision may have changed residuals by since the last one in double */
  double *solved, *lacks;    /* unknowns of the round, and residual (K) */
  double *Z, *C, *V;         /* its steps, the matrix times them, and what follows from them (KEPT, K) */
  double *follows;           /* what follows from the unknowns (K) */
  double *room;              /* 8 K numbers */
  double best;               /* least residual of the rounds, but for a factor of 2, */
  int since;                 /* and its round */
  char *seen;                /* sets of the rounds (ROUNDS, k) */
  long *tally;               /* rounds, sweeps, and the round that wants a factor */
} Rub;

static double diagonal(const Rub *f, int r) { return f->W[(size_t)r * f->ld + r]; }

/* Unknowns of a node. */
static int width(const Rub *f, int slips, int kind) {
  if (kind == SLIP) return TANGENTS;
  return (kind == OPEN) == slips ? 1 + TANGENTS : 0;
}

/* Row r of a node as coefficients of its v and u. */
static void row_of(const Rub *f, int slips, int i, int kind, const double *e, int r, double *of_v, double *of_u) {
  const int first = i * (1 + TANGENTS);
  const double w = diagonal(f, first + 1), c = TANGENTS > 1 ? e[TANGENTS] : 0;
  for (int b = 0; b <= TANGENTS; b++) of_v[b] = of_u[b] = 0;
  if (kind == OPEN) {
    of_v[r] = diagonal(f, first + r);
  } else if (!slips && (kind == STICK || r == 0)) {
    of_v[r] = 1;
  } else if (!slips) { /* across e, with two tangents */
    of_v[1] = -c * e[1], of_v[2] = c * e[0];
    of_u[1] = -w * (1 - c) * e[1], of_u[2] = w * (1 - c) * e[0];
  } else {
    of_v[0] = -w * f->mu[i] * e[r];
    for (int b = 0; b < TANGENTS; b++) {
      of_u[1 + b] = c * ((r == b) - e[r] * e[b]);
      of_v[1 + b] = w * ((r == b) - of_u[1 + b]);
    }
  }
}

/* Numbers of a node from its u or from its row of the matrix (times the numbers): its unknowns. */
static int shorten(const Rub *f, int slips, int i, int kind, const double *e, const double *v, double *to) {
  const int s = 1 + TANGENTS;
  if (kind != SLIP) {
    const int count = width(f, slips, kind);
    for (int b = 0; b < count; b++) to[b] = v[b];
    return count;
  }
  if (slips) {
    for (int b = 1; b < s; b++) to[b - 1] = v[b];
  } else {
    to[0] = v[0];
    for (int b = 1; b < s; b++) to[0] += f->mu[i] * e[b - 1] * v[b];
    if (TANGENTS > 1) to[1] = e[0] * v[2] - e[1] * v[1];
  }
  return TANGENTS;
}

/* u of a node of its unknowns. */
static int lengthen(const Rub *f, int slips, int i, int kind, const double *e, const double *c, double *u) {
  const int s = 1 + TANGENTS, count = width(f, slips, kind);
  for (int b = 0; b < s; b++) u[b] = 0;
  if (kind != SLIP) {
    for (int b = 0; b < count; b++) u[b] = c[b];
  } else if (slips) {
    for (int b = 1; b < s; b++) u[b] = c[b - 1];
  } else {
    u[0] = c[0];
    for (int b = 1; b < s; b++) u[b] = f->mu[i] * c[0] * e[b - 1];
    if (TANGENTS > 1) u[1] -= c[1] * e[1], u[2] += c[1] * e[0];
  }
  return count;
}

/* v = W u, or W^-1 u; `exact` in double precision. Room for 2 K numbers of type float behind v. */
static void times(const Rub *f, int exact, const double *u, double *v, float *room) {
  const int K = f->k * (1 + TANGENTS), ld = f->slips ? K : f->ld;
  const float *low = f->slips ? f->inverse_low : f->low;
  if (exact || !low) {
    times_in_double(K, ld, f->slips ? f->inverse : f->W, u, v);
    return;
  }
  for (int r = 0; r < K; r++) room[r] = (float)u[r];
  times_in_float(K, K, low, room, room + K);
  for (int r = 0; r < K; r++) v[r] = room[K + r];
}

/* Whether the factor is that of the present sets, in 2D. */
static int fits(const Rub *f) {
  if (TANGENTS > 1 || f->slips0 != f->slips) return 0;
  for (int i = 0; i < f->k; i++)
    if (f->kind[i] != f->kind0[i] || (f->kind[i] == SLIP && f->e[2 * i] != f->e0[2 * i])) return 0;
  return 1;
}

/* Whether factors are made here: of few slips. */
static int little(const Rub *f, int n) { return f->slips && !f->single && n <= LITTLE; }

/* The factor of LU in place, with the pivots of LAPACK. */
static void eliminate(int n, double *LU, int *pivot) {
  for (int k = 0; k < n; k++) {
    double *column = LU + (size_t)k * n;
    int p = k;
    for (int i = k + 1; i < n; i++)
      if (fabs(column[i]) > fabs(column[p])) p = i;
    pivot[k] = p;
    for (int j = 0; p != k && j < n; j++) {
      const double t = LU[(size_t)j * n + k];
      LU[(size_t)j * n + k] = LU[(size_t)j * n + p];
      LU[(size_t)j * n + p] = t;
    }
    for (int i = k + 1; i < n; i++) column[i] /= column[k];
    for (int j = k + 1; j < n; j++) {
      double *to = LU + (size_t)j * n;
      const double t = to[k];
      for (int i = k + 1; i < n; i++) to[i] -= t * column[i];
    }
  }
}

/* Row of_v of the node i of W or W^-1 into v, at the nodes between each two that `run` has. */
static void combine(const Rub *f, int i, const double *of_v, const int *run, int count, double *v) {
  const int s = 1 + TANGENTS, K = f->k * s, ld = f->slips ? K : f->ld;
  const double *rows = (f->slips ? f->inverse : f->W) + (size_t)i * s * ld;
  const float *low = f->slips ? f->inverse_low : f->low;
  if (low) low += (size_t)i * s * K;
  for (int g = 0; g < count; g += 2) {
    for (int j = run[g] * s; low && TANGENTS > 1 && j < run[g + 1] * s; j++)
      v[j] = of_v[0] * low[j] + of_v[1] * low[K + j] + of_v[2] * low[2 * (size_t)K + j];
    for (int j = run[g] * s; !low && j < run[g + 1] * s; j++) {
      v[j] = of_v[0] * rows[j] + of_v[1] * rows[ld + j];
      if (TANGENTS > 1) v[j] += of_v[2] * rows[2 * (size_t)ld + j];
    }
  }
}

/* The matrix of the present sets by rows, into LU; whether it is factored there. */
int softgrasp_matrix(Rub *f) {
  const int s = 1 + TANGENTS, K = f->k * s;
  double *v = f->room, *row = v + K, of_v[3], of_u[3];
  memcpy(f->kind0, f->kind, f->k * sizeof(int));
  memcpy(f->e0, f->e, (size_t)f->k * s * sizeof(double));
  f->slips0 = f->slips;
  f->rows = K;
  f->size = f->age = 0;
  f->work = 0;
  int *run = f->pivot, count = 0, in = 0; /* first nodes of runs with unknowns, and nodes behind them */
  for (int i = 0; i < f->k; i++) {
    const int own = width(f, f->slips, f->kind[i]);
    if (in != (own > 0)) run[count++] = i;
    in = own > 0;
    f->size += own;
  }
  if (in) run[count++] = f->k;
  for (int i = 0, r = 0; i < f->k; i++)
    for (int a = 0; a < width(f, f->slips, f->kind[i]); a++, r++) {
      row_of(f, f->slips, i, f->kind[i], f->e + i * s, a, of_v, of_u);
      combine(f, i, of_v, run, count, v);
      for (int b = 0; b < s; b++) v[i * s + b] += of_u[b];
      if (!f->slips && (a == 0 || f->kind[i] == STICK)) v[i * s + a] *= 1 + (f->single ? RIDGE_SINGLE : RIDGE);
      double *to = f->single ? row : f->LU + (size_t)r * f->size;
      for (int g = 0; g < count; g += 2)
        for (int j = run[g]; j < run[g + 1]; j++) to += shorten(f, f->slips, j, f->kind[j], f->e + j * s, v + j * s, to);
      for (int j = 0; f->single && j < f->size; j++) f->LU_single[(size_t)r * f->size + j] = (float)row[j];
    }
  if (little(f, f->size)) eliminate(f->size, f->LU, f->pivot);
  return little(f, f->size);
}

/* z: unknowns that the rows g ask for if the sets were those of the factor; those of other sets from their own node. */
static void precondition(const Rub *f, const double *g, double *z) {
  const int s = 1 + TANGENTS, K = f->k * s, slips = f->slips;
  double *c = f->room + 6 * K, full[3], own[2][2], of_v[3], of_u[3];
  float *low = (float *)(c + K);
  const double *from = g;
  int r = 0;
  for (int i = 0; i < f->k; i++) { /* rows of the factor, from those of the node */
    const double *e = f->e + i * s;
    const int kind = f->kind[i], count = width(f, slips, kind);
    full[0] = full[1] = full[2] = 0;
    if (kind != SLIP || TANGENTS == 1)
      for (int b = 0; b < count; b++) full[kind == SLIP && slips ? 1 + b : b] = from[b];
    else if (slips)
      full[1] = from[0], full[2] = from[1];
    else
      full[0] = from[0], full[1] = -from[1] * e[1], full[2] = from[1] * e[0];
    from += count;
    if (f->kind0[i] == SLIP && !slips) {
      const double *e0 = f->e0 + i * s;
      c[r++] = full[0];
      if (TANGENTS > 1) c[r++] = e0[0] * full[2] - e0[1] * full[1];
    } else {
      const int skip = f->kind0[i] == SLIP;
      for (int b = 0; b < width(f, slips, f->kind0[i]); b++) c[r++] = full[skip + b];
    }
  }
  if (f->single) {
    for (int j = 0; j < r; j++) low[j] = (float)c[j];
    back_in_float(r, f->LU_single, f->pivot, low);
    for (int j = 0; j < r; j++) c[j] = low[j];
  } else {
    back_in_double(r, f->LU, f->pivot, c);
  }
  for (int i = 0; i < f->k; i++) {
    const double *e = f->e + i * s;
    const int kind = f->kind[i], count = width(f, slips, kind), had = lengthen(f, slips, i, f->kind0[i], f->e0 + i * s, c, full);
    c += had;
    if (had && kind == SLIP && !slips) {
      z[0] = full[0];
      if (TANGENTS > 1) z[1] = e[0] * full[2] - e[1] * full[1];
    } else if (had) {
      for (int b = 0; b < count; b++) z[b] = full[b + (kind == SLIP)];
    } else if (!slips || kind == OPEN) {
      for (int b = 0; b < count; b++) {
        const int a = i * s + (kind == SLIP && b ? 1 : b);
        z[b] = g[b] / (slips ? diagonal(f, a) * f->inverse[(size_t)a * K + a] : diagonal(f, a));
      }
    } else {
      for (int a = 0; a < TANGENTS; a++) {
        row_of(f, slips, i, kind, e, a, of_v, of_u);
        for (int b = 0; b < TANGENTS; b++) {
          own[a][b] = of_u[1 + b];
          for (int d = 0; d < s; d++) own[a][b] += of_v[d] * f->inverse[(size_t)(i * s + d) * K + i * s + 1 + b];
        }
      }
      const double det = TANGENTS > 1 ? own[0][0] * own[1][1] - own[0][1] * own[1][0] : own[0][0];
      z[0] = TANGENTS > 1 ? (own[1][1] * g[0] - own[0][1] * g[1]) / det : g[0] / det;
      if (TANGENTS > 1) z[1] = (own[0][0] * g[1] - own[1][0] * g[0]) / det;
    }
    g += count;
    z += count;
  }
}
