/* Whole runs of a reduced model of tissue at finite strain; see reduction/strain/stepper.py, which has it in NumPy too.

   S w + f_alg(a, w) = h,  h = s v + l,  S = s^2 I + s D,  s = 2/dt,   a_1 = a + 2 w,  v_1 = 2 s w - v
   f_alg = sum_q weight_q B_q' P_alg(H_0, H_0 + 2 B_q w): the discrete gradient of W(F) = mu/2 |F|^2 + g(J), or of
   St. Venant-Kirchhoff, by the formulas of fem/strain/laws.py. LANES points at a time stay in registers and their B in the
   nearest cache: B[chunk][i][component][lane], and of p points in all those that fill up the last chunk weigh nothing. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { NEO_HOOKE, NEO_HOOKE_QUADRATIC, STVK };
enum { LANES = 8 };
#define EACH for (int l = 0; l < LANES; l++)
#define INLINE static inline __attribute__((always_inline)) /* so that d is a constant in all loops */

typedef double Lane[LANES];
typedef struct {
  int law, d, k, p;
  const double *B, *weight, *lam, *mu;
  Lane *H0, *E0, *j0, *l0, *f; /* by chunk: d d components, or one; f by coordinate */
  long evaluations, bad;
} Body;

/* Component by component, row by row: H[i * d + j] = dz_i / dX_j. */
INLINE void gradient(const Body *b, int n, int chunk, const double *a, Lane *H) {
  const double *B = b->B + (size_t)chunk * b->k * n * LANES;
  Lane sum[9] = {{0}};
  for (int i = 0; i < b->k; i++)
    for (int c = 0; c < n; c++) EACH sum[c][l] += a[i] * B[(i * n + c) * LANES + l];
  for (int c = 0; c < n; c++) EACH H[c][l] = sum[c][l];
}

INLINE void cofactor(int d, const Lane *F, Lane *C) {
  if (d == 2) {
    EACH C[0][l] = F[3][l], C[1][l] = -F[2][l], C[2][l] = -F[1][l], C[3][l] = F[0][l];
    return;
  }
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) {
      const int a = 3 * ((i + 1) % 3), m = 3 * ((i + 2) % 3), n = (k + 1) % 3, o = (k + 2) % 3;
      EACH C[3 * i + k][l] = F[a + n][l] * F[m + o][l] - F[a + o][l] * F[m + n][l];
    }
}

/* J - 1 of I + H: trace, principal minors and determinant of H lose no digit. */
INLINE void volume(int d, const Lane *H, double *j) {
  Lane C[9];
  if (d == 2) {
    EACH j[l] = H[0][l] + H[3][l] + (H[0][l] * H[3][l] - H[1][l] * H[2][l]);
    return;
  }
  cofactor(3, H, C);
  EACH j[l] = H[0][l] + H[4][l] + H[8][l] +
              (C[0][l] + C[4][l] + C[8][l] + (H[0][l] * C[0][l] + H[1][l] * C[1][l] + H[2][l] * C[2][l]));
}

INLINE void strain(int d, const Lane *H, Lane *E) {
  for (int i = 0; i < d; i++)
    for (int k = 0; k < d; k++) {
      Lane e;
      EACH e[l] = H[i * d + k][l] + H[k * d + i][l];
      for (int m = 0; m < d; m++) EACH e[l] += H[m * d + i][l] * H[m * d + k][l];
      EACH E[i * d + k][l] = e[l] / 2;
    }
}

/* log1p(x) / x without 0/0: 2 artanh(u) / x with u = x / (2 + x). */
INLINE void log_quotient(const double *x, double *q) {
  EACH {
    const double u = x[l] / (2 + x[l]), t = u * u;
    q[l] = 2 / (2 + x[l]) * (1 + t * (1. / 3 + t * (1. / 5 + t * (1. / 7 + t * (1. / 9 + t * (1. / 11 + t * (1. / 13 +
           t * (1. / 15 + t / 17))))))));
  }
  EACH if (!(fabs(x[l]) < 0.25)) q[l] = log1p(x[l]) / x[l];
}

/* Gradient, J - 1 and ln J, or the strain, at the start of a step. */
INLINE void begin_as(Body *b, int d, const double *a) {
  const int n = d * d;
  for (int e = 0; e < b->p / LANES; e++) {
    gradient(b, n, e, a, b->H0 + e * n);
    if (b->law == STVK) strain(d, b->H0 + e * n, b->E0 + e * n);
    else {
      volume(d, b->H0 + e * n, b->j0[e]);
      EACH b->l0[e][l] = log1p(b->j0[e][l]);
    }
  }
}

INLINE void stress_stvk(const Body *b, int d, int e, const Lane *h, Lane *P) {
  const int n = d * d;
  const double *lam = b->lam + e * LANES, *mu = b->mu + e * LANES;
  Lane H1[9], F[9], S[9], trace = {0};
  for (int c = 0; c < n; c++)
    EACH F[c][l] = b->H0[e * n + c][l] + h[c][l] + (c % (d + 1) == 0), H1[c][l] = b->H0[e * n + c][l] + 2 * h[c][l];
  strain(d, H1, S);
  for (int c = 0; c < n; c++) EACH S[c][l] = (S[c][l] + b->E0[e * n + c][l]) / 2;
  for (int i = 0; i < d; i++) EACH trace[l] += S[i * (d + 1)][l];
  for (int c = 0; c < n; c++) EACH S[c][l] = 2 * mu[l] * S[c][l] + (c % (d + 1) == 0) * lam[l] * trace[l];
  for (int i = 0; i < d; i++)
    for (int k = 0; k < d; k++) {
      EACH P[i * d + k][l] = 0;
      for (int m = 0; m < d; m++) EACH P[i * d + k][l] += F[i * d + m][l] * S[m * d + k][l];
    }
}

/* P_alg = mu F_m + (g(J_1) - g(J_0)) / (J_1 - J_0) C with C : (F_1 - F_0) = J_1 - J_0; 0 where some J_1 <= 0. */
INLINE int stress_j(Body *b, int d, int e, const Lane *h, Lane *P) {
  const int n = d * d;
  const double *lam = b->lam + e * LANES, *mu = b->mu + e * LANES, *j0 = b->j0[e], *l0 = b->l0[e];
  Lane F[9], C[9], dj = {0}, x, q, slope;
  for (int c = 0; c < n; c++) EACH F[c][l] = b->H0[e * n + c][l] + h[c][l] + (c % (d + 1) == 0);
  cofactor(d, F, C);
  if (d == 3) {
    Lane more[9];
    cofactor(3, h, more);
    for (int c = 0; c < n; c++) EACH C[c][l] += more[c][l] / 3;
  }
  for (int c = 0; c < n; c++) EACH dj[l] += 2 * C[c][l] * h[c][l];
  EACH x[l] = dj[l] / (1 + j0[l]);
  EACH if (!(x[l] > -1)) {
    b->bad = e * LANES + l;
    return 0;
  }
  log_quotient(x, q);
  if (b->law == NEO_HOOKE) EACH slope[l] = q[l] / (1 + j0[l]) * (lam[l] * (l0[l] + q[l] * x[l] / 2) - mu[l]);
  else EACH slope[l] = lam[l] * (j0[l] + dj[l] / 2) - mu[l] * q[l] / (1 + j0[l]);
  for (int c = 0; c < n; c++) EACH P[c][l] = mu[l] * F[c][l] + slope[l] * C[c][l];
  return 1;
}

/* f = f_alg(w) by lanes; 0 where a point would have J <= 0. */
INLINE int force_as(Body *b, int d, const double *w) {
  const int n = d * d, k = b->k;
  for (int i = 0; i < k; i++) EACH b->f[i][l] = 0;
  for (int e = 0; e < b->p / LANES; e++) {
    const double *B = b->B + (size_t)e * k * n * LANES, *weight = b->weight + e * LANES;
    Lane h[9], P[9];
    gradient(b, n, e, w, h);
    if (b->law == STVK) stress_stvk(b, d, e, h, P);
    else if (!stress_j(b, d, e, h, P)) return 0;
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
static int solve(Body *b, const double *S, const double *h, double tol, double floor, double *scale, double *J,
                 double *w, double *at, long *restarts) {
  const int k = b->k, most = 15;
  double *R = at, *Rt = at + k, *p = at + 2 * k, *y = at + 3 * k, *wt = at + 4 * k, *more = at + 5 * k;
  if (!residual(b, S, h, w, R)) {
    memset(w, 0, sizeof(double) * k);
    if (!residual(b, S, h, w, R)) return 0;
  }
  double size = norm(k, R);
  *scale = fmax(*scale, *scale > 0 ? norm(k, h) : fmax(norm(k, h), size)); /* at rest h is zero */
  const double goal = fmax(tol * *scale, floor);
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

/* counts: evaluations, restarts, point with J <= 0 of a failure. Returns 0, step + 1 that failed, or -1 without memory. */
int softgrasp_march(int law, int d, int k, int p, const double *B, const double *weight, const double *lam,
                    const double *mu, const double *S, double s, const double *load, int steps, double tol, double floor,
                    double *J, double *A, double *V, long *counts) {
  const int n = d * d, chunks = p / LANES;
  Lane *lanes = calloc((size_t)((2 * n + 2) * chunks + k), sizeof(Lane));
  double *room = calloc((size_t)(11 * k + k * k), sizeof(double));
  if (!room || !lanes) return free(room), free(lanes), -1;
  Body b = {law, d, k, p, B, weight, lam, mu, lanes, lanes + n * chunks, lanes + 2 * n * chunks,
            lanes + (2 * n + 1) * chunks, lanes + (2 * n + 2) * chunks, 0, -1};
  double *h = room, *w = h + k, *older = w + k, *old = older + k, *at = old + k, scale = 0;
  int failed = 0;
  for (int t = 0; t < steps && !failed; t++) {
    const double *a = A + t * k, *v = V + t * k;
    double *a1 = A + (t + 1) * k, *v1 = V + (t + 1) * k;
    if (d == 2) begin_as(&b, 2, a);
    else begin_as(&b, 3, a);
    for (int i = 0; i < k; i++) h[i] = s * v[i] + load[t * k + i], w[i] = 2 * old[i] - older[i];
    if (!solve(&b, S, h, tol, floor, &scale, J, w, at, counts + 1)) failed = t + 1;
    for (int i = 0; i < k; i++) {
      a1[i] = a[i] + 2 * w[i], v1[i] = 2 * s * w[i] - v[i];
      older[i] = old[i], old[i] = w[i];
    }
  }
  counts[0] = b.evaluations, counts[2] = b.bad;
  free(room), free(lanes);
  return failed;
}
