/* Whole runs of a reduced model of tissue at finite strain; see reduction/strain/stepper.py, which has it in NumPy too.

   S w + f_alg(a, w) = h,  h = s v + l,  S = s^2 I + s D,  s = 2/dt,   a_1 = a + 2 w,  v_1 = 2 s w - v
   f_alg = sum_q weight_q B_q' P_alg(H_0, H_0 + 2 B_q w), P_alg of fem/strain/law.h. The B of LANES points stays in the
   nearest cache: B[chunk][i][component][lane], and of p points in all those that fill up the last chunk weigh nothing. */
#include "law.h"
#include <stdlib.h>
#include <string.h>

typedef struct {
  int law, d, k, p;
  const double *B, *weight, *lam, *mu;
  Lane *H0, *j0, *l0, *f; /* by chunk: d d components, or one; f by coordinate */
  long evaluations, bad;
} Body;

INLINE void gradient(const Body *b, int n, int chunk, const double *a, Lane *H) {
  const double *B = b->B + (size_t)chunk * b->k * n * LANES;
  Lane sum[9] = {{0}};
  for (int i = 0; i < b->k; i++)
    for (int c = 0; c < n; c++) EACH sum[c][l] += a[i] * B[(i * n + c) * LANES + l];
  for (int c = 0; c < n; c++) EACH H[c][l] = sum[c][l];
}

/* Gradient, J - 1 and ln J at the start of a step. */
INLINE void begin_as(Body *b, int d, const double *a) {
  const int n = d * d;
  for (int e = 0; e < b->p / LANES; e++) {
    gradient(b, n, e, a, b->H0 + e * n);
    volume(d, b->H0 + e * n, b->j0[e]);
    EACH b->l0[e][l] = log1p(b->j0[e][l]);
  }
}

/* f = f_alg(w) by lanes; 0 where a point would have J <= 0. */
INLINE int force_as(Body *b, int d, const double *w) {
  const int n = d * d, k = b->k;
  for (int i = 0; i < k; i++) EACH b->f[i][l] = 0;
  for (int e = 0; e < b->p / LANES; e++) {
    const double *B = b->B + (size_t)e * k * n * LANES, *weight = b->weight + e * LANES;
    Lane h[9], P[9], J;
    gradient(b, n, e, w, h);
    const double *lam = b->lam + e * LANES, *mu = b->mu + e * LANES;
    const int bad = stress(b->law, d, b->H0 + e * n, b->j0[e], b->l0[e], h, lam, mu, P, J);
    if (bad < LANES) return b->bad = e * LANES + bad, 0;
    for (int c = 0; c < n; c++) EACH P[c][l] *= weight[l];
    for (int i = 0; i < k; i++) {
      Lane sum = {0};
      for (int c = 0; c < n; c++) EACH sum[l] += B[(i * n + c) * LANES + l] * P[c][l];
      EACH b->f[i][l] += sum[l];
    }
  }
  return 1;
}

/* R = S w + f_alg(w) - h; 0 where a point would have J <= 0. */
static int residual(Body *b, const double *S, const double *h, const double *w, double *R) {
  const int k = b->k;
  b->evaluations++;
  if (!(b->d == 2 ? force_as(b, 2, w) : force_as(b, 3, w))) return 0;
  for (int i = 0; i < k; i++) {
    double t = -h[i];
    EACH t += b->f[i][l];
    for (int j = 0; j < k; j++) t += S[i * k + j] * w[j];
    R[i] = t;
  }
  return 1;
}

static double norm(int k, const double *x) {
  double t = 0;
  for (int i = 0; i < k; i++) t += x[i] * x[i];
  return sqrt(t);
}

/* X = A^-1 by Gauss and Jordan with pivots; A is overwritten. */
static int invert(int k, double *A, double *X) {
  memset(X, 0, sizeof(double) * k * k);
  for (int i = 0; i < k; i++) X[i * k + i] = 1;
  for (int c = 0; c < k; c++) {
    int r = c;
    for (int i = c + 1; i < k; i++)
      if (fabs(A[i * k + c]) > fabs(A[r * k + c])) r = i;
    if (!(fabs(A[r * k + c]) > 0)) return 0;
    for (int j = 0; j < k; j++) {
      double t = A[c * k + j];
      A[c * k + j] = A[r * k + j], A[r * k + j] = t;
      t = X[c * k + j], X[c * k + j] = X[r * k + j], X[r * k + j] = t;
    }
    const double pivot = 1 / A[c * k + c];
    for (int j = 0; j < k; j++) A[c * k + j] *= pivot, X[c * k + j] *= pivot;
    for (int i = 0; i < k; i++) {
      const double t = A[i * k + c];
      if (i != c && t != 0)
        for (int j = 0; j < k; j++) A[i * k + j] -= t * A[c * k + j], X[i * k + j] -= t * X[c * k + j];
    }
  }
  return 1;
}

/* Inverse of the tangent at w by differences of the residual. */
static int fresh(Body *b, const double *S, const double *h, double *w, const double *R, double *J, double *T,
                 double *Rt) {
  const int k = b->k;
  const double step = 1e-7 * (norm(k, w) + 1e-3);
  for (int j = 0; j < k; j++) {
    const double kept = w[j];
    w[j] = kept + step;
    const int good = residual(b, S, h, w, Rt);
    w[j] = kept;
    if (!good) return 0;
    for (int i = 0; i < k; i++) T[i * k + j] = (Rt[i] - R[i]) / step;
  }
  return invert(k, T, J);
}

/* Broyden's update of the inverse for the step p that changed the residual by y. */
static void update(int k, double *J, const double *p, const double *y, double *Jy, double *pJ) {
  double den = 0;
  for (int i = 0; i < k; i++) Jy[i] = pJ[i] = 0;
  for (int i = 0; i < k; i++) {
    for (int j = 0; j < k; j++) Jy[i] += J[i * k + j] * y[j], pJ[j] += p[i] * J[i * k + j];
    den += p[i] * Jy[i];
  }
  if (!(fabs(den) > 0.1 * norm(k, p) * norm(k, p))) return;
  for (int i = 0; i < k; i++)
    for (int j = 0; j < k; j++) J[i * k + j] += (p[i] - Jy[i]) * pJ[j] / den;
}

/* Solve one step from the guess in w; 0 when it does not converge. */
static int solve(Body *b, const double *S, const double *h, double tol, double rounding, double *scale, double *J,
                 double *w, double *at, long *restarts) {
  const int k = b->k, most = 15;
  double *R = at, *Rt = at + k, *p = at + 2 * k, *y = at + 3 * k, *wt = at + 4 * k, *more = at + 5 * k;
  if (!residual(b, S, h, w, R)) {
    memset(w, 0, sizeof(double) * k);
    if (!residual(b, S, h, w, R)) return 0;
  }
  double size = norm(k, R);
  *scale = fmax(*scale, *scale > 0 ? norm(k, h) : fmax(norm(k, h), size)); /* at rest h is zero */
  const double goal = fmax(tol * *scale, rounding);
  for (int it = 0, renewed = 0; !(size <= goal); it++) {
    double share, found = 0;
    int good = 0;
    for (int i = 0; i < k; i++) {
      p[i] = 0;
      for (int j = 0; j < k; j++) p[i] -= J[i * k + j] * R[j];
    }
    for (share = 1; it % most != most - 1 && share > 1e-3; share /= 2) {
      for (int i = 0; i < k; i++) wt[i] = w[i] + share * p[i];
      good = residual(b, S, h, wt, Rt) && (found = norm(k, Rt)) < 4 * size;
      if (good || !renewed) break; /* an old inverse is renewed before its corrections are halved */
    }
    if (!good) {
      if (renewed == 3 || !fresh(b, S, h, w, R, J, more, Rt)) return 0;
      renewed++, ++*restarts;
      continue;
    }
    for (int i = 0; i < k; i++) p[i] *= share, y[i] = Rt[i] - R[i], w[i] = wt[i], R[i] = Rt[i];
    update(k, J, p, y, more, more + k);
    size = found;
  }
  return 1;
}

/* past: scale of the residual, w of the last step and of the one before, kept from call to call.
   counts: evaluations, restarts, point with J <= 0 of a failure. Returns 0, step + 1 that failed, or -1 without memory. */
int softgrasp_march(int law, int d, int k, int p, const double *B, const double *weight, const double *lam,
                    const double *mu, const double *S, double s, const double *load, int steps, double tol,
                    double rounding, double *J, double *A, double *V, double *past, long *counts) {
  const int n = d * d, chunks = p / LANES;
  Lane *lanes = calloc((size_t)((n + 2) * chunks + k), sizeof(Lane));
  double *room = calloc((size_t)(9 * k + k * k), sizeof(double));
  if (!room || !lanes) return free(room), free(lanes), -1;
  Body b = {law, d, k, p, B, weight, lam, mu, lanes, lanes + n * chunks, lanes + (n + 1) * chunks,
            lanes + (n + 2) * chunks, 0, -1};
  double *h = room, *w = h + k, *at = w + k, *old = past + 1, *older = old + k;
  int failed = 0;
  for (int t = 0; t < steps && !failed; t++) {
    const double *a = A + t * k, *v = V + t * k;
    double *a1 = A + (t + 1) * k, *v1 = V + (t + 1) * k;
    if (d == 2) begin_as(&b, 2, a);
    else begin_as(&b, 3, a);
    for (int i = 0; i < k; i++) h[i] = s * v[i] + load[t * k + i], w[i] = 2 * old[i] - older[i];
    if (!solve(&b, S, h, tol, rounding, past, J, w, at, counts + 1)) failed = t + 1;
    for (int i = 0; i < k; i++) {
      a1[i] = a[i] + 2 * w[i], v1[i] = 2 * s * w[i] - v[i];
      older[i] = old[i], old[i] = w[i];
    }
  }
  counts[0] = b.evaluations, counts[2] = b.bad;
  free(room), free(lanes);
  return failed;
}
