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
  double *room;         /* of the longest column */
} Lower;

/* The rows of a block below it into the room, zeros after them; their number in whole groups. */
static int fetch(const Lower *L, int s, const double *x) {
  const int *rows = L->rows + L->first[s], r = L->first[s + 1] - L->first[s];
  int i = 0;
  for (; i < r; i++) L->room[i] = x[rows[i]];
  for (; i % 4; i++) L->room[i] = 0;
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
    const int r = fetch(L, s, x);
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

/* L^-T x in place. */
void softgrasp_back(const Lower *L, double *x) {
  for (int s = L->count - 1; s >= 0; s--) {
    const int m = L->begin[s + 1] - L->begin[s], width = (m + 3) / 4 * 4, r = fetch(L, s, x);
    const double *v = L->values + L->at[s];
    double *y = x + L->begin[s];
    for (int k = 0; r && k < m; k++) y[k] -= dot(r, v + (size_t)k * (width + r) + width, L->room);
    for (int k = m - 2; k >= 0; k--) y[k] -= dot(m - 1 - k, v + (size_t)k * (width + r) + k + 1, y + k + 1);
  }
}
