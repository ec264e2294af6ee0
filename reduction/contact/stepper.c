/* Whole runs of a reduced model with contact; see reduction/contact/stepper.py, which has it in NumPy too. */
#include "dense.h"

#define FAINT 1e-250 /* of a force that fades, before its digits are lost and slow [N] */

typedef int (*Complement)(int p, int ld, const double *W, const double *q, double tol, int most, int *count, int *order,
                          double *L, double *x, int *side, double *room, long *tally);

/* Factor L of U_AA for the m rows of A, with a ridge for equal rows; whether it is definite. */
static int factored(int m, int p, const int *rows, const double *U, double *L) {
  for (int i = 0; i < m; i++) {
    double *l = L + (size_t)i * m;
    for (int j = 0; j <= i; j++) {
      double t = U[(size_t)rows[i] * p + rows[j]] * (i == j ? 1 + RIDGE : 1) - dot(j, l, L + (size_t)j * m);
      if (i == j && !(t > 0)) return 0;
      l[j] = i == j ? sqrt(t) : t / L[(size_t)j * m + j];
    }
  }
  return 1;
}

/* y with L L'y = b. */
static void solved(int m, const double *L, const double *b, double *y) {
  for (int i = 0; i < m; i++) y[i] = (b[i] - dot(i, L + (size_t)i * m, y)) / L[(size_t)i * m + i];
  for (int i = m - 1; i >= 0; i--) {
    const double *l = L + (size_t)i * m, t = y[i] /= l[i];
    for (int k = 0; k < i; k++) y[k] -= l[k] * t;
  }
}

/* Room: p p for the factor of the set and as much for that of the impulse, then 10 p and 3 k numbers. Returns the number
   of the step that has no solution, or -1. */
int softgrasp_contact_march(void *complement, int k, int p, int steps, const double *inverse, const double *stiffness,
                            const double *N, const double *Y, const double *W, const double *U, const double *F,
                            double follow, double keep, const double *load, const double *gap, const double *rate,
                            double s, double tol, double still, double *A, double *V, double *X, double *J, double *M,
                            int *sets, double *room, long *tally) {
  const Complement solve = (Complement)complement;
  int *order = sets, *side = sets + p, *rows = sets + 2 * p, *last = sets + 3 * p, count = 0;
  int lasts = 0; /* rows of the factor R */
  double *L = room, *R = L + (size_t)p * p, *q = R + (size_t)p * p, *small = q + p, *b = small + 5 * p, *y = b + p;
  double *w = y + p, *h = w + k, *middle = h + k, fastest = 0;
  for (int n = 0; n < steps; n++) {
    const double *a = A + (size_t)n * k, *v = V + (size_t)n * k;
    double *a1 = A + (size_t)(n + 1) * k, *v1 = V + (size_t)(n + 1) * k, *x = X + (size_t)n * p, *jump = J + (size_t)n * p;
    double *mu = M + (size_t)(n + 1) * p;
    int touched = 0, m = 0, followed = 0;
    for (int i = 0; i < p; i++) {
      mu[i] = keep * mu[i - p];
      if (mu[i] < FAINT) mu[i] = 0;
      followed |= mu[i] > 0;
    }
    for (int i = 0; i < k; i++) h[i] = s * v[i] - stiffness[i] * a[i] + load[(size_t)n * k + i];
    for (int i = 0; i < k; i++) {
      w[i] = dot(k, inverse + (size_t)i * k, h);
      middle[i] = w[i] + a[i] / 2;
    }
    for (int i = 0; i < p; i++) {
      q[i] = gap[(size_t)(n + 1) * p + i] / 2 + dot(k, N + (size_t)i * k, middle);
      if (followed) q[i] += dot(p, F + (size_t)i * p, mu) / 2;
      touched |= q[i] < 0;
    }
    if (touched) {
      if (solve(p, p, W, q, tol, 40 * p, &count, order, L, x, side, small, tally)) return n;
      for (int i = 0; i < p; i++)
        if (x[i] > 0) {
          rows[m++] = i;
          mu[i] += follow * x[i];
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
    if (m != lasts || memcmp(rows, last, m * sizeof(int))) {
      if (!factored(m, p, rows, U, R)) return n;
      memcpy(last, rows, m * sizeof(int));
      lasts = m;
    }
    solved(m, R, b, y);
    for (int r = 0; r < m; r++) {
      jump[rows[r]] = y[r];
      for (int j = 0; j < k; j++) v1[j] += N[(size_t)rows[r] * k + j] * y[r];
    }
  }
  return -1;
}
