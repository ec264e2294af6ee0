/* 0 <= x, W x + q >= 0, x'(W x + q) = 0 for a symmetric W >= 0 by block principal pivoting [JP94]: all rows of a wrong
   sign change sides at once; after RETRIES rounds that leave as many of them, the last one alone, which is finite. The
   Cholesky factor of W_AA (1 + RIDGE on the diagonal, so that equal rows share their force) follows the set A by rows. */
#include "dense.h"

/* One more row of the factor of W with a share more on its diagonal; 0 where its pivot is not positive. */
static int append(int ld, const double *W, int *m, int *order, double *L, int row, double ridge) {
  double *l = L + (size_t)*m * ld;
  const double *w = W + (size_t)row * ld;
  for (int k = 0; k < *m; k++) l[k] = (w[order[k]] - dot(k, L + (size_t)k * ld, l)) / L[(size_t)k * ld + k];
  double pivot = w[row] * (1 + ridge) - dot(*m, l, l);
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
        if ((side[i] == 1 || side[i] == 2) && !append(ld, W, &m, order, L, i, RIDGE)) return *count = 0, -2;
      continue;
    }
    for (int i = m - 1; i >= 0; i--)
      if (side[order[i]] == 3) leave(ld, &m, order, L, i, c, s);
    for (int i = 0; i < p; i++)
      if (side[i] == 2 && !append(ld, W, &m, order, L, i, RIDGE)) return *count = 0, -2;
  }
  *count = 0;
  return -1;
}
