/* M x = b for the mass M of one component (CSR) and a b that few nodes have: conjugate gradients with the diagonal, on
   the nodes that the iteration has reached. A round reaches one more layer of neighbours, and all others are zero, so
   that this is the iteration on the whole mesh. */
#include "dense.h"

/* The nodes of b come in as the first `count` of `order`, b in x; nodes reached and solution go out the same way.
   Zero at the start and again at the end: x elsewhere, room (3 n numbers) and in (n). Returns their number, or -1 after
   `most` rounds. */
int softgrasp_mass(int n, const int *ptr, const int *col, const double *M, const double *inverse, int most, double rtol,
                   int *order, int count, double *x, double *room, char *in) {
  double *r = room, *p = r + n, *q = p + n, rho = 0, least;
  int front = 0, round = 0;
  for (int k = 0; k < count; k++) {
    const int i = order[k];
    r[i] = x[i];
    p[i] = inverse[i] * r[i];
    rho += r[i] * p[i];
    x[i] = 0;
    in[i] = 1;
  }
  least = rtol * rtol * rho;
  for (; rho > least && round < most; round++) {
    for (const int end = count; front < end; front++)
      for (int e = ptr[order[front]]; e < ptr[order[front] + 1]; e++)
        if (!in[col[e]]) in[order[count++] = col[e]] = 1;
    double pq = 0, next = 0;
    for (int k = 0; k < count; k++) {
      const int i = order[k];
      double t = 0;
      for (int e = ptr[i]; e < ptr[i + 1]; e++) t += M[e] * p[col[e]];
      q[i] = t;
      pq += p[i] * t;
    }
    const double step = rho / pq;
    for (int k = 0; k < count; k++) {
      const int i = order[k];
      x[i] += step * p[i];
      r[i] -= step * q[i];
      next += inverse[i] * r[i] * r[i];
    }
    for (int k = 0; k < count; k++) {
      const int i = order[k];
      p[i] = inverse[i] * r[i] + next / rho * p[i];
    }
    rho = next;
  }
  for (int k = 0; k < count; k++) r[order[k]] = p[order[k]] = q[order[k]] = in[order[k]] = 0;
  return rho > least ? -1 : count;
}

/* The columns of a factor L below ones on its diagonal, in blocks of neighbouring columns with the same rows: those of the
   block in `width` numbers, from the first, then the rows below, in whole groups of four. */
typedef struct {
  int count;            /* blocks */
  const int *begin;     /* column with which each begins (count + 1) */
  const int *first;     /* its first row below, by its place in `rows` (count + 1) */
  const int *rows;
  const long *at;       /* its values (count) */
  const double *values; /* a column after the other */
  double *room;         /* of the longest column, for each of several x */
} Lower;

/* The rows of a block below it into a room, zeros after them; their number in whole groups. */
static int fetch(const Lower *L, int s, const double *x, double *room) {
  const int *rows = L->rows + L->first[s], r = L->first[s + 1] - L->first[s];
  int i = 0;
  for (; i < r; i++) room[i] = x[rows[i]];
  for (; i % 4; i++) room[i] = 0;
  return i;
}

/* L^-1 x in place. */
void softgrasp_ahead(const Lower *L, double *x) {
  for (int s = 0; s < L->count; s++) {
    const int m = L->begin[s + 1] - L->begin[s], width = (m + 3) / 4 * 4, *rows = L->rows + L->first[s];
    double *y = x + L->begin[s];
    int on = 0;
    for (int k = 0; k < m; k++) on |= y[k] != 0;
    if (!on) continue;
    const int r = fetch(L, s, x, L->room);
    const double *v = L->values + L->at[s];
    for (int k = 0; k < m; k++, v += width + r) {
      const double t = y[k];
      if (t == 0) continue;
      for (int i = k + 1; i < m; i++) y[i] -= v[i] * t;
      for (int i = 0; i < r; i++) L->room[i] -= v[width + i] * t;
    }
    for (int i = 0; i < L->first[s + 1] - L->first[s]; i++) x[rows[i]] = L->room[i];
  }
}

/* Products of v with a and b, of whole groups of four. */
static void dots(int n, const double *v, const double *a, const double *b, double *of_a, double *of_b) {
  double s[8] = {0}, t[8] = {0};
  int i = 0;
  for (; i + 8 <= n; i += 8)
    for (int k = 0; k < 8; k++) s[k] += v[i + k] * a[i + k], t[k] += v[i + k] * b[i + k];
  for (int k = 0; i < n && k < 4; k++) s[k] += v[i + k] * a[i + k], t[k] += v[i + k] * b[i + k];
  *of_a = ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
  *of_b = ((t[0] + t[4]) + (t[1] + t[5])) + ((t[2] + t[6]) + (t[3] + t[7]));
}

/* L^-T x in place, of `several` x of n numbers, two of them in one pass over L. */
void softgrasp_back(const Lower *L, int several, int n, double *x) {
  for (int s = L->count - 1; s >= 0; s--) {
    const int m = L->begin[s + 1] - L->begin[s], width = (m + 3) / 4 * 4, r = (L->first[s + 1] - L->first[s] + 3) / 4 * 4;
    const double *v = L->values + L->at[s];
    for (int j = 0; j < several; j++) fetch(L, s, x + (size_t)j * n, L->room + j * r);
    for (int j = 0; j < several; j += 2) {
      double *y = x + (size_t)j * n + L->begin[s], *z = y + n, *a = L->room + j * r, more, other;
      for (int k = 0; j + 1 < several && r && k < m; k++) {
        dots(r, v + (size_t)k * (width + r) + width, a, a + r, &more, &other);
        y[k] -= more, z[k] -= other;
      }
      for (int k = 0; j + 1 == several && r && k < m; k++) y[k] -= dot(r, v + (size_t)k * (width + r) + width, a);
    }
    for (int j = 0; j < several; j++) {
      double *y = x + (size_t)j * n + L->begin[s];
      for (int k = m - 2; k >= 0; k--) y[k] -= dot(m - 1 - k, v + (size_t)k * (width + r) + k + 1, y + k + 1);
    }
  }
}
