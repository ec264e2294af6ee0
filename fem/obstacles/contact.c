/* 0 <= x, W x + q >= 0, x'(W x + q) = 0 for a symmetric W >= 0 by block principal pivoting [JP94]: all rows of a wrong
   sign change sides at once; after RETRIES rounds that leave as many of them, the last one alone, which is finite. The
   Cholesky factor of W_AA (1 + RIDGE on the diagonal, so that equal rows share their force) follows the set A by rows.
   Below it, the step before half-spaces: gaps of all boundary nodes, forces of those that ever touched, what they do. */
#include "dense.h"

/* One more row of the factor; 0 where its pivot is not positive. */
static int append(int ld, const double *W, int *m, int *order, double *L, int row) {
  double *l = L + (size_t)*m * ld;
  const double *w = W + (size_t)row * ld;
  for (int k = 0; k < *m; k++) l[k] = (w[order[k]] - dot(k, L + (size_t)k * ld, l)) / L[(size_t)k * ld + k];
  double pivot = w[row] * (1 + RIDGE) - dot(*m, l, l);
  if (!(pivot > 0)) return 0;
  l[*m] = sqrt(pivot);
  order[(*m)++] = row;
  return 1;
}

/* The factor without its k-th row: the rest takes up the column that goes, by rotations. */
static void leave(int ld, int *m, int *order, double *L, int k, double *c, double *s) {
  int last = *m - 1;
  for (int i = k; i < last; i++) {
    double *to = L + (size_t)i * ld;
    const double *from = to + ld;
    double x = from[k];
    order[i] = order[i + 1];
    memcpy(to, from, k * sizeof(double));
    memcpy(to + k, from + k + 1, (i - k + 1) * sizeof(double));
    for (int j = k; j < i; j++) {
      double y = to[j];
      to[j] = c[j] * y + s[j] * x;
      x = c[j] * x - s[j] * y;
    }
    double r = hypot(to[i], x);
    c[i] = to[i] / r;
    s[i] = x / r;
    to[i] = r;
  }
  *m = last;
}

static void solve(int ld, int m, const double *L, double *y) {
  for (int i = 0; i < m; i++) y[i] = (y[i] - dot(i, L + (size_t)i * ld, y)) / L[(size_t)i * ld + i];
  for (int i = m - 1; i >= 0; i--) {
    const double *l = L + (size_t)i * ld, t = y[i] /= l[i];
    for (int k = 0; k < i; k++) y[k] -= l[k] * t;
  }
}

/* Row numbers and factor of A come in and go out by count, order and L; W and L have ld columns. Room: 5 ld numbers. Adds
   rounds and changes of the set to tally. Returns 0, -1 after `most` rounds, -2 where a pivot is not positive. */
int softgrasp_complement(int p, int ld, const double *W, const double *q, double tol, int most, int *count, int *order,
                         double *L, double *x, int *side, double *room, long *tally) {
  double *y = room, *c = room + ld, *s = room + 2 * ld, *full = room + 3 * ld;
  int m = *count, best = p + 1, tries = RETRIES;
  for (int round = 0; round < most; round++) {
    tally[0]++;
    memset(side, 0, p * sizeof(int));
    memset(full, 0, p * sizeof(double));
    for (int i = 0; i < m; i++) {
      y[i] = -q[order[i]];
      side[order[i]] = 1;
    }
    solve(ld, m, L, y);
    for (int i = 0; i < m; i++) full[order[i]] = y[i];
    int wrong = 0, last = -1;
    for (int i = 0; i < p; i++)
      if (side[i] ? full[i] < 0 : q[i] + dot(p, W + (size_t)i * ld, full) < -tol) {
        side[i] |= 2;
        wrong++;
        last = i;
      }
    if (!wrong) {
      memcpy(x, full, p * sizeof(double));
      *count = m;
      return 0;
    }
    if (wrong < best) {
      best = wrong;
      tries = RETRIES;
    } else if (tries > 0) {
      tries--;
    } else {
      for (int i = 0; i < last; i++) side[i] &= 1;
      wrong = 1;
    }
    tally[1] += wrong;
    if (wrong > m / 3 + 4) { /* a new factor is cheaper */
      m = 0;
      for (int i = 0; i < p; i++)
        if ((side[i] == 1 || side[i] == 2) && !append(ld, W, &m, order, L, i)) return *count = 0, -2;
      continue;
    }
    for (int i = m - 1; i >= 0; i--)
      if (side[order[i]] == 3) leave(ld, &m, order, L, i, c, s);
    for (int i = 0; i < p; i++)
      if (side[i] == 2 && !append(ld, W, &m, order, L, i)) return *count = 0, -2;
  }
  *count = 0;
  return -1;
}

typedef struct {
  int p, d, n_s, obstacles; /* boundary nodes, axes, freedoms of the hand, half-spaces */
  int m;                    /* tangents with friction */
  int n, whole, k;          /* rows here of the step, whether they are all rows, contact rows */
  const double *X, *T;      /* places at rest (p, d), modes of the hand (p d, n_s) */
  const double *along;      /* normals of the half-spaces, each before its tangents (obstacles, 1 + m, d) */
  const int *at;            /* row here of each unknown of the boundary, -1 where another rank has it (p d) */
  double *w, *r;            /* half the change of z in the step, and its right-hand side (n) */
  double *z, *moved, *v;    /* displacement, its half change and velocity of the boundary (p d) */
  double *q, *qdot;         /* hand at the end of the step and its velocity there (n_s) */
  const double *q0, *slide; /* hand at the start of it (n_s), way of the half-spaces in it (obstacles, d) */
  double *level, *rate;     /* n.x of the half-spaces at the end of the step (obstacles), velocities (obstacles, d) */
  double *gap, *after;      /* gaps before and at the end of the step (obstacles, p) */
  char *entered;            /* whether a pair has a row (obstacles, p) */
  double *least;            /* least gaps at the end (obstacles) */
  const int *row;           /* obstacle, node, column and direction of each contact row, 0 for the normal (k, 4) */
  const int *kind;          /* sets of the pairs, see friction.c; 0 without friction */
  const double *columns;    /* S^-1 N' on the rows here, a column after the other (.., n) */
  double *free, *x, *b;     /* right-hand side of the small problem, forces, velocities to stop (k) */
  double *change;           /* what the last `softgrasp_apply` added to the force of each column */
  double *force, *touching, *hand, *gaps; /* tables of the run, see Tables */
  double *energy;           /* work, energy dissipated at first touch, by impulses, by friction (4) */
} Flat;

static const double *along(const Flat *f, const int *row) {
  return f->along + (size_t)(row[0] * (1 + f->m) + row[3]) * f->d;
}

/* Gaps at the end of the step into `after` and `least`; the largest coordinate. */
double softgrasp_look(const Flat *f) {
  double most = 0, x[3] = {0, 0, 0};
  for (int o = 0; o < f->obstacles; o++) f->least[o] = INFINITY;
  for (int i = 0; i < f->p; i++) {
    for (int a = 0; a < f->d; a++) {
      int u = i * f->d + a;
      const double *T = f->T + (size_t)u * f->n_s;
      if (f->whole) f->moved[u] = f->w[f->at[u]];
      double rigid = 0;
      for (int k = 0; k < f->n_s; k++) rigid += T[k] * f->q[k];
      x[a] = f->X[u] + (f->z[u] + 2 * f->moved[u] + rigid);
      most = fmax(most, fabs(x[a]));
    }
    for (int o = 0; o < f->obstacles; o++) {
      const double *n = f->along + (size_t)o * (1 + f->m) * f->d;
      double g = -f->level[o];
      for (int a = 0; a < f->d; a++) g += n[a] * x[a];
      f->after[(size_t)o * f->p + i] = g;
      if (!(g >= f->least[o])) f->least[o] = g; /* so that what is no number is the least */
    }
  }
  return most;
}

/* Half the gap of a row at the end of the step, or half its slip in the step. */
static double value(const Flat *f, int j) {
  const int *row = f->row + 4 * j;
  if (row[3] == 0) return f->after[(size_t)row[0] * f->p + row[1]] / 2;
  const double *t = along(f, row);
  double slip = 0;
  for (int a = 0; a < f->d; a++) {
    const int u = row[1] * f->d + a;
    double way = 2 * f->moved[u] - f->slide[row[0] * f->d + a];
    for (int k = 0; k < f->n_s; k++) way += f->T[(size_t)u * f->n_s + k] * (f->q[k] - f->q0[k]);
    slip += t[a] * way;
  }
  return slip / 2;
}

/* Pairs without a row that end deeper than tol; the largest gap of pressed rows into `reached`. */
int softgrasp_missing(const Flat *f, double tol, double *reached) {
  int missing = 0;
  for (int i = 0; i < f->obstacles * f->p; i++) missing += f->after[i] < -tol && !f->entered[i];
  *reached = 0;
  for (int j = 0; j < f->k; j += 1 + f->m)
    if (f->x[j] > 0) *reached = fmax(*reached, fabs(f->after[(size_t)f->row[4 * j] * f->p + f->row[4 * j + 1]]));
  return missing;
}

/* Half gaps and slips of the rows at the end of the step that is in w. */
void softgrasp_values(const Flat *f, double *to) {
  for (int j = 0; j < f->k; j++) to[j] = value(f, j);
}

/* Right-hand side of the small problem from the end of a step without forces. */
void softgrasp_begin(const Flat *f) {
  softgrasp_values(f, f->free);
  memset(f->x, 0, f->k * sizeof(double));
}

static void add_to_r(const Flat *f, int j, double t) {
  const int *row = f->row + 4 * j;
  for (int a = 0; a < f->d; a++) {
    int at = f->at[row[1] * f->d + a];
    if (at >= 0) f->r[at] += t * along(f, row)[a];
  }
}

/* Take forces x instead of those before into w and r, four columns in a pass. */
void softgrasp_apply(const Flat *f, int columns, const double *x) {
  const double *c[4];
  double t[4];
  int m = 0;
  memset(f->change, 0, columns * sizeof(double));
  for (int j = 0; j < f->k; j++) {
    double more = x[j] - f->x[j];
    f->x[j] = x[j];
    if (more == 0) continue;
    add_to_r(f, j, more);
    f->change[f->row[4 * j + 2]] += more;
  }
  for (int k = 0; k <= columns; k++) {
    if (k < columns && f->change[k] != 0) {
      c[m] = f->columns + (size_t)k * f->n;
      t[m++] = f->change[k];
    }
    if (m == 4)
      for (int i = 0; i < f->n; i++) f->w[i] += (t[0] * c[0][i] + t[1] * c[1][i]) + (t[2] * c[2][i] + t[3] * c[3][i]);
    else if (k == columns)
      for (; m > 0; m--)
        for (int i = 0; i < f->n; i++) f->w[i] += t[m - 1] * c[m - 1][i];
    if (m == 4) m = 0;
  }
}

/* Tables of step n: force and number of pressed nodes of each half-space, T'N'x, and energies. */
void softgrasp_account(const Flat *f, int n) {
  double *force = f->force + (size_t)n * f->obstacles * f->d, *touching = f->touching + (size_t)n * f->obstacles;
  double *hand = f->hand + (size_t)n * f->n_s;
  for (int j = 0; j < f->k; j++) {
    const int *row = f->row + 4 * j, o = row[0], i = row[1];
    if (!(f->x[j - row[3]] > 0)) continue;
    const double *e = along(f, row);
    if (row[3] == 0) touching[o] += 1;
    for (int a = 0; a < f->d; a++) {
      double x = f->x[j] * e[a];
      force[o * f->d + a] += x;
      for (int k = 0; k < f->n_s; k++) hand[k] += f->T[(size_t)(i * f->d + a) * f->n_s + k] * x;
      f->energy[0] += 2 * x * f->moved[i * f->d + a];
    }
    if (row[3] == 0) f->energy[1] += f->x[j] * f->gap[(size_t)o * f->p + i];
    else f->energy[3] -= f->x[j] * 2 * value(f, j);
  }
}

/* Carry the boundary on to the end of step n; with `pressed`, r takes N'x once more, as it takes G c. */
void softgrasp_carry(const Flat *f, int n, int pressed) {
  for (int u = 0; u < f->p * f->d; u++) f->z[u] += 2 * f->moved[u];
  memcpy(f->gap, f->after, sizeof(double) * f->obstacles * f->p);
  memcpy(f->gaps + (size_t)(n + 1) * f->obstacles, f->least, sizeof(double) * f->obstacles);
  for (int j = 0; pressed && j < f->k; j++)
    if (f->x[j] != 0) add_to_r(f, j, f->x[j]);
}

/* Velocities b = -N v of the rows of pressed pairs, in their order; the largest along normals and the tangents of nodes
   that stick, and the largest of any component. */
double softgrasp_rates(const Flat *f, double *fastest) {
  double most = 0;
  for (int j = 0, k = 0; j < f->k; j++) {
    const int *row = f->row + 4 * j, o = row[0], i = row[1];
    if (!(f->x[j - row[3]] > 0)) continue;
    double b = 0;
    for (int a = 0; a < f->d; a++) {
      int u = i * f->d + a;
      double v = f->v[u] - f->rate[o * f->d + a];
      for (int k = 0; k < f->n_s; k++) v += f->T[(size_t)u * f->n_s + k] * f->qdot[k];
      *fastest = fmax(*fastest, fabs(v));
      b -= along(f, row)[a] * v;
    }
    f->b[k++] = b;
    if (row[3] == 0 || f->kind[j / (1 + f->m)] == 1) most = fmax(most, fabs(b));
  }
  return most;
}
