/* Sums that keep their digits. Products with K whose terms cancel: by the differences of neighbours, and in long double.
   Blocks of d x d, row by row; see fem/solve/differences.py and fem/run/energy.py. The displacement of a run: see
   fem/run/displacement.py. The product of fem/solve/smoother.py. */
#include <stddef.h>

#include "sum.h"

typedef float four_singles __attribute__((vector_size(16), aligned(4)));
typedef double four __attribute__((vector_size(32)));
#define WIDE(w) __builtin_convertvector(w, four)

#define INLINE static inline __attribute__((always_inline)) /* so that d is a constant in all loops */

/* y += K (z + low) for K = K': blocks of the nodes above the diagonal alone, and the sums R of the block rows. */
INLINE void pairs_as(const int d, const int two, int nodes, const int *first, const int *col, const double *K,
                     const double *R, const double *restrict z, const double *restrict low, double *restrict y) {
  for (int i = 0; i < nodes; i++, R += d * d) {
    double x[3], l[3], u[3], sum[3] = {0, 0, 0};
    for (int a = 0; a < d; a++) x[a] = z[(size_t)i * d + a];
    for (int a = 0; a < d; a++) l[a] = two ? low[(size_t)i * d + a] : 0;
    for (int a = 0; a < d; a++)
      for (int b = 0; b < d; b++) sum[a] += R[a * d + b] * (two ? x[b] + l[b] : x[b]);
    for (int e = first[i]; e < first[i + 1]; e++, K += d * d) {
      const size_t j = (size_t)col[e] * d;
      double *to = y + j, back[3] = {0, 0, 0};
      for (int a = 0; a < d; a++) u[a] = z[j + a] - x[a];
      for (int a = 0; two && a < d; a++) u[a] += low[j + a] - l[a];
      for (int a = 0; a < d; a++)
        for (int b = 0; b < d; b++) sum[a] += K[a * d + b] * u[b];
      for (int a = 0; a < d; a++)
        for (int b = 0; b < d; b++) back[b] += K[a * d + b] * u[a];
      for (int a = 0; a < d; a++) to[a] -= back[a];
    }
    for (int a = 0; a < d; a++) y[(size_t)i * d + a] += sum[a];
  }
}

/* y += the part of K (z + low) that comes from nodes of other ranks, which have `ghost` and `behind`. */
INLINE void beside_as(const int d, int nodes, const int *first, const int *col, const double *K,
                      const double *restrict ghost, const double *restrict behind, const double *restrict z,
                      const double *restrict low, double *restrict y) {
  for (int i = 0; i < nodes; i++)
    for (int e = first[i]; e < first[i + 1]; e++, K += d * d) {
      const size_t here = (size_t)i * d, there = (size_t)col[e] * d;
      for (int b = 0; b < d; b++) {
        double u = ghost[there + b] - z[here + b];
        if (low) u += behind[there + b] - low[here + b];
        for (int a = 0; a < d; a++) y[here + a] += K[a * d + b] * u;
      }
    }
}

#define OF_BOTH(name, ...) (d == 2 ? name(2, __VA_ARGS__) : name(3, __VA_ARGS__))

/* y += sum over the stars of R'W'W R x, W lower triangular in rows, four stars of one size beside each other. Nodes from
   `own` on are of other ranks: their x is in `ghost`, their part of y is added to `back`. */
INLINE void stars_as(const int d, int groups, const int *sizes, const int *node, const float *W, int own,
                     const double *restrict x, const double *restrict ghost, double *restrict y,
                     double *restrict back) {
  const four_singles *row = (const four_singles *)W;
  for (int g = 0; g < groups; g++) {
    const int m = sizes[g], n = d * m;
    four X[n], Y[n];
    for (int k = 0; k < 4 * m; k++) {
      const double *from = node[k] < own ? x + (size_t)node[k] * d : ghost + (size_t)(node[k] - own) * d;
      for (int a = 0; a < d; a++) X[k / 4 * d + a][k % 4] = from[a];
    }
    for (int i = 0; i < n; i++) Y[i] = (four){0};
    for (int i = 0; i < n; i += d) { /* the rows of a node: u = W x, y += W'u */
      const four_singles *w[3];
      four u[3];
      for (int a = 0; a < d; row += i + ++a) {
        w[a] = row;
        u[a] = (four){0};
        for (int j = i; j <= i + a; j++) u[a] += WIDE(row[j]) * X[j];
      }
      for (int j = 0; j < i; j++)
        for (int a = 0; a < d; a++) u[a] += WIDE(w[a][j]) * X[j];
      for (int j = 0; j < i; j++)
        for (int a = 0; a < d; a++) Y[j] += WIDE(w[a][j]) * u[a];
      for (int a = 0; a < d; a++)
        for (int j = i; j <= i + a; j++) Y[j] += WIDE(w[a][j]) * u[a];
    }
    for (int k = 0; k < 4 * m; k++) {
      double *to = node[k] < own ? y + (size_t)node[k] * d : back + (size_t)(node[k] - own) * d;
      for (int a = 0; a < d; a++) to[a] += Y[k / 4 * d + a][k % 4];
    }
    node += 4 * m;
  }
}

/* What stays in a run, as a call takes as long as some of its arguments. */
typedef struct {
  long d, nodes;
  const int *first, *col;
  const double *K, *R;
} Pairs;

/* `low` may be 0, here and below. */
void softgrasp_pairs(const Pairs *of, const double *z, const double *low, double *y) {
  const long d = of->d;
  if (low)
    OF_BOTH(pairs_as, 1, of->nodes, of->first, of->col, of->K, of->R, z, low, y);
  else
    OF_BOTH(pairs_as, 0, of->nodes, of->first, of->col, of->K, of->R, z, z, y);
}

void softgrasp_beside(int d, int nodes, const int *first, const int *col, const double *K, const double *ghost,
                      const double *behind, const double *z, const double *low, double *y) {
  OF_BOTH(beside_as, nodes, first, col, K, ghost, behind, z, low, y);
}

void softgrasp_stars(int d, int groups, const int *sizes, const int *node, const float *W, int own, const double *x,
                     const double *ghost, double *y, double *back) {
  OF_BOTH(stars_as, groups, sizes, node, W, own, x, ghost, y, back);
}

/* Sums R (nodes, d, d) of the blocks of each row. */
void softgrasp_sums(int d, int nodes, const int *first, const double *K, double *R) {
  for (int i = 0; i < nodes; i++, R += d * d) {
    long double sum[9] = {0};
    for (int e = first[i]; e < first[i + 1]; e++, K += d * d)
      for (int c = 0; c < d * d; c++) sum[c] += K[c];
    for (int c = 0; c < d * d; c++) R[c] = (double)sum[c];
  }
}

/* y = A x for rows in single entries. */
void softgrasp_wide(int rows, const int *first, const int *col, const double *A, const double *x, long double *y) {
  for (int i = 0; i < rows; i++) {
    long double sum = 0;
    for (int e = first[i]; e < first[i + 1]; e++) sum += (long double)A[e] * x[col[e]];
    y[i] = sum;
  }
}

INLINE void move_as(const int d, int rows, int count, const long *nodes, double *z, const double *w, double *low,
                    double s, const double *old, double *new) {
  const size_t n = (size_t)count * d;
  if (!nodes) {
#pragma GCC ivdep
    for (size_t i = 0; i < n; i++) {
      new[i] = exact_sum(old[i], 2 * w[i] + low[i], low + i);
      new[n + i] = 2 * s * w[i] - old[n + i];
    }
    return;
  }
#pragma GCC ivdep
  for (int i = 0; i < rows; i++) z[i] = exact_sum(z[i], 2 * w[i] + low[i], low + i);
#pragma GCC ivdep
  for (int i = 0; i < count; i++)
    for (int a = 0; a < d; a++) {
      new[(size_t)i * d + a] = z[nodes[i] * d + a];
      new[n + (size_t)i * d + a] = 2 * s * w[nodes[i] * d + a] - old[n + (size_t)i * d + a];
    }
}

typedef struct {
  long d, rows, count;
  const long *nodes;
  double *z;
  const double *w;
  double *low;
} Step;

/* [z; v] of `count` nodes at the end of a step, whose rows are those here, or are `nodes` of all rows z. */
void softgrasp_move(const Step *of, double s, const double *old, double *new) {
  const long d = of->d;
  OF_BOTH(move_as, of->rows, of->count, of->nodes, of->z, of->w, of->low, s, old, new);
}
