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

/* A factor L with ones on its diagonal, in blocks of neighbouring columns with the same rows: (D; V), D on the diagonal and V
   below, becomes (D^-1; -V D^-1), so that a block is one product in both sweeps. Values of a block by rows, each in `wide`
   numbers, whole groups of four. */
typedef struct {
  int count;        /* blocks */
  const int *begin; /* column with which each begins (count + 1) */
  const int *first; /* its first row below, by its place in `rows` (count + 1) */
  const int *rows;
  const long *at;   /* its values (count) */
  double *values;
  double *room;     /* two of the longest columns, and four numbers */
} Lower;

typedef double Four __attribute__((vector_size(32)));

static Four load(const double *from) {
  Four v;
  memcpy(&v, from, sizeof v);
  return v;
}

static int wide(const Lower *L, int s) { return (L->begin[s + 1] - L->begin[s] + 3) / 4 * 4; }

/* Invert the blocks: a row t of the result has t D = -v without the one on the diagonal. */
void softgrasp_invert(const Lower *L) {
  for (int s = 0; s < L->count; s++) {
    const int m = L->begin[s + 1] - L->begin[s], r = L->first[s + 1] - L->first[s], width = wide(L, s);
    double *v = L->values + L->at[s];
    for (int i = m + r - 1; i > 0; i--) { /* upwards, as it reads the rows above */
      double *row = v + (size_t)i * width;
      for (int j = (i < m ? i : m) - 1; j >= 0; j--) {
        const double t = row[j] = -row[j], *above = v + (size_t)j * width;
        for (int k = 0; k < j; k++) row[k] += t * above[k];
      }
    }
  }
}

/* L^-1 x in place. */
void softgrasp_ahead(const Lower *L, double *x) {
  for (int s = 0; s < L->count; s++) {
    const int m = L->begin[s + 1] - L->begin[s], r = L->first[s + 1] - L->first[s], width = wide(L, s);
    const int *rows = L->rows + L->first[s];
    const double *v = L->values + L->at[s];
    double *y = x + L->begin[s], *old = L->room;
    int on = 0;
    for (int k = 0; k < width; k++) on |= (old[k] = k < m ? y[k] : 0) != 0;
    if (!on) continue;
    for (int i = 0; i < m + r; i++, v += width) {
      Four sum = {0};
      for (int k = 0; k < width; k += 4) sum += load(v + k) * load(old + k);
      *(i < m ? y + i : x + rows[i - m]) += (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }
  }
}

/* L^-T x in place, of `several` x of n numbers, two of them in one pass. */
void softgrasp_back(const Lower *L, int several, int n, double *x) {
  for (int s = L->count - 1; s >= 0; s--) {
    const int m = L->begin[s + 1] - L->begin[s], r = L->first[s + 1] - L->first[s], width = wide(L, s);
    const int *rows = L->rows + L->first[s];
    for (int j = 0; j < several; j += 2) {
      const int both = j + 1 < several;
      double *y = x + (size_t)j * n + L->begin[s], *z = both ? y + n : y, *a = L->room, *b = a + m + r;
      memcpy(a, y, m * sizeof(double));
      memcpy(b, z, m * sizeof(double));
      for (int i = 0; i < r; i++) a[m + i] = (y - L->begin[s])[rows[i]], b[m + i] = (z - L->begin[s])[rows[i]];
      for (int g = 0; g < m; g += 4) {
        const double *v = L->values + L->at[s] + g;
        Four of_a = {0}, of_b = {0}, more = {0}, other = {0};
        int i = g + 1; /* rows above have zeros there */
        for (; i + 1 < m + r; i += 2) {
          const Four one = load(v + (size_t)i * width), two = load(v + (size_t)(i + 1) * width);
          of_a += one * a[i], of_b += one * b[i];
          more += two * a[i + 1], other += two * b[i + 1];
        }
        for (; i < m + r; i++) of_a += load(v + (size_t)i * width) * a[i], of_b += load(v + (size_t)i * width) * b[i];
        of_a += more, of_b += other;
        for (int k = 0; k < 4 && g + k < m; k++) y[g + k] += of_a[k];
        for (int k = 0; both && k < 4 && g + k < m; k++) z[g + k] += of_b[k];
      }
    }
  }
}
