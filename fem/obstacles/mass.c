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
