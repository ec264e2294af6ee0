/* Whole runs of a reduced model with contact; see reduction/contact/stepper.py, which has it in NumPy too. */
#include "dense.h"

typedef int (*Complement)(int p, int ld, const double *W, const double *q, double tol, int most, int *count, int *order,
                          double *L, double *x, int *side, double *room, long *tally);

/* y with U_AA y = b for the m rows of A, by Cholesky with a ridge for equal rows. */
static int impulse(int m, int p, const int *rows, const double *U, const double *b, double *L, double *y) {
  for (int i = 0; i < m; i++) {
    double *l = L + (size_t)i * m;
    for (int j = 0; j <= i; j++) {
      double t = U[(size_t)rows[i] * p + rows[j]] * (i == j ? 1 + RIDGE : 1) - dot(j, l, L + (size_t)j * m);
      if (i == j && !(t > 0)) return 0;
      l[j] = i == j ? sqrt(t) : t / L[(size_t)j * m + j];
    }
    y[i] = (b[i] - dot(i, l, y)) / l[i];
  }
  for (int i = m - 1; i >= 0; i--) {
    const double t = y[i] /= L[(size_t)i * m + i];
    for (int k = 0; k < i; k++) y[k] -= L[(size_t)i * m + k] * t;
  }
  return 1;
}

/* Room: p p for the factor of the set and as much for that of the impulse, then 10 p and 3 k numbers. Returns the number
   of the step that has no solution, or -1. */
int softgrasp_contact_march(void *complement, int k, int p, int steps, const double *inverse, const double *stiffness,
                            const double *N, const double *Y, const double *W, const double *U,
                            const double *load, const double *gap, const double *rate, double s, double tol,
                            double still, double *A, double *V, double *X, double *J, int *sets, double *room,
                            long *tally) {
  const Complement solve = (Complement)complement;
  int *order = sets, *side = sets + p, *rows = sets + 2 * p, count = 0;
  double *L = room, *F = L + (size_t)p * p, *q = F + (size_t)p * p, *small = q + p, *b = small + 5 * p, *y = b + p;
  double *w = y + p, *h = w + k, *middle = h + k, fastest = 0;
  for (int n = 0; n < steps; n++) {
    const double *a = A + (size_t)n * k, *v = V + (size_t)n * k;
    double *a1 = A + (size_t)(n + 1) * k, *v1 = V + (size_t)(n + 1) * k, *x = X + (size_t)n * p, *jump = J + (size_t)n * p;
    int touched = 0, m = 0;
    for (int i = 0; i < k; i++) h[i] = s * v[i] - stiffness[i] * a[i] + load[(size_t)n * k + i];
    for (int i = 0; i < k; i++) {
      w[i] = dot(k, inverse + (size_t)i * k, h);
      middle[i] = w[i] + a[i] / 2;
    }
    for (int i = 0; i < p; i++) {
      q[i] = gap[(size_t)(n + 1) * p + i] / 2 + dot(k, N + (size_t)i * k, middle);
      touched |= q[i] < 0;
    }
    if (touched) {
      if (solve(p, p, W, q, tol, 40 * p, &count, order, L, x, side, small, tally)) return n;
      for (int i = 0; i < p; i++)
        if (x[i] > 0) {
          rows[m++] = i;
          for (int j = 0; j < k; j++) w[j] += Y[(size_t)i * k + j] * x[i];
        }
    }
    for (int i = 0; i < k; i++) {
      a1[i] = a[i] + 2 * w[i];
      v1[i] = 2 * s * w[i] - v[i];
    }
    double largest = 0;
    for (int r = 0; r < m; r++) {
      b[r] = -dot(k, N + (size_t)rows[r] * k, v1) - rate[(size_t)(n + 1) * p + rows[r]];
      largest = fmax(largest, fabs(b[r]));
    }
    fastest = fmax(fastest, largest);
    if (largest <= still * fastest) continue;
    if (!impulse(m, p, rows, U, b, F, y)) return n;
    for (int r = 0; r < m; r++) {
      jump[rows[r]] = y[r];
      for (int j = 0; j < k; j++) v1[j] += N[(size_t)rows[r] * k + j] * y[r];
    }
  }
  return -1;
}
