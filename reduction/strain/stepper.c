/* Whole runs of a reduced model of tissue at finite strain; see reduction/strain/stepper.py, which has it in NumPy too.

   S w + f_alg(a, w) = h,  h = s v + l,  S = s^2 I + s D,  s = 2/dt,   a_1 = a + 2 w,  v_1 = 2 s w - v
   f_alg = sum_q weight_q B_q' P_alg(H_0, H_0 + 2 B_q w): the discrete gradient of W(F) = mu/2 |F|^2 + g(J), or of
   St. Venant-Kirchhoff. Points lie next to each other in every array, p of them with the padding: B[component][i][p]. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { NEO_HOOKE, NEO_HOOKE_QUADRATIC, STVK };

typedef struct {
  int law, d, k, p;
  const double *B, *weight, *lam, *mu;
  double *H0, *h, *P, *E0, *j0, *l0;
  long evaluations, bad;
} Body;

static void gradient(const Body *b, const double *a, double *H) {
  const int p = b->p;
  for (int c = 0; c < b->d * b->d; c++) {
    double *restrict out = H + c * p;
    for (int e = 0; e < p; e++) out[e] = 0;
    for (int i = 0; i < b->k; i++) {
      const double t = a[i], *restrict in = b->B + (c * b->k + i) * p;
      for (int e = 0; e < p; e++) out[e] += t * in[e];
    }
  }
}

static void back(const Body *b, double *restrict f) {
  const int p = b->p, k = b->k;
  for (int i = 0; i < k; i++) {
    double sum = 0;
    for (int c = 0; c < b->d * b->d; c++) {
      const double *restrict in = b->B + (c * k + i) * p, *restrict P = b->P + c * p;
#pragma omp simd reduction(+ : sum)
      for (int e = 0; e < p; e++) sum += in[e] * P[e];
    }
    f[i] = sum;
  }
}

static inline void cofactor(int d, const double *F, double *C) {
  if (d == 2) {
    C[0] = F[3], C[1] = -F[2], C[2] = -F[1], C[3] = F[0];
    return;
  }
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) {
      const int a = 3 * ((i + 1) % 3), m = 3 * ((i + 2) % 3), n = (k + 1) % 3, o = (k + 2) % 3;
      C[3 * i + k] = F[a + n] * F[m + o] - F[a + o] * F[m + n];
    }
}

/* J - 1 of I + H: trace, principal minors and determinant of H lose no digit. */
static inline double volume(int d, const double *H) {
  double C[9];
  if (d == 2) return H[0] + H[3] + (H[0] * H[3] - H[1] * H[2]);
  cofactor(3, H, C);
  return H[0] + H[4] + H[8] + (C[0] + C[4] + C[8] + (H[0] * C[0] + H[1] * C[1] + H[2] * C[2]));
}

static inline void strain(int d, const double *H, double *E) {
  for (int i = 0; i < d; i++)
    for (int k = 0; k < d; k++) {
      double e = H[i * d + k] + H[k * d + i];
      for (int m = 0; m < d; m++) e += H[m * d + i] * H[m * d + k];
      E[i * d + k] = e / 2;
    }
}

/* log1p(x) / x without 0/0: 2 artanh(u) / x with u = x / (2 + x). */
static inline double log_quotient(double x) {
  if (fabs(x) > 0.25) return log1p(x) / x;
  const double u = x / (2 + x), t = u * u;
  return 2 / (2 + x) * (1 + t * (1. / 3 + t * (1. / 5 + t * (1. / 7 + t * (1. / 9 + t * (1. / 11 + t * (1. / 13 +
         t * (1. / 15 + t / 17))))))));
}

/* J - 1 and ln J, or the strain, at the start of a step. */
static inline void begin_as(const Body *b, int d) {
  const int p = b->p, n = d * d;
  for (int e = 0; e < p; e++) {
    double H[9], E[9];
    for (int c = 0; c < n; c++) H[c] = b->H0[c * p + e];
    if (b->law == STVK) {
      strain(d, H, E);
      for (int c = 0; c < n; c++) b->E0[c * p + e] = E[c];
    } else
      b->j0[e] = volume(d, H), b->l0[e] = log1p(b->j0[e]);
  }
}

static inline void stress_stvk(const Body *b, int d) {
  const int p = b->p, n = d * d;
  for (int e = 0; e < p; e++) {
    double H1[9], F[9], S[9], trace = 0;
    for (int c = 0; c < n; c++) {
      const double h = b->h[c * p + e];
      F[c] = b->H0[c * p + e] + h + (c % (d + 1) == 0);
      H1[c] = b->H0[c * p + e] + 2 * h;
    }
    strain(d, H1, S);
    for (int c = 0; c < n; c++) S[c] = (S[c] + b->E0[c * p + e]) / 2;
    for (int i = 0; i < d; i++) trace += S[i * (d + 1)];
    for (int c = 0; c < n; c++) S[c] = 2 * b->mu[e] * S[c] + (c % (d + 1) == 0) * b->lam[e] * trace;
    for (int i = 0; i < d; i++)
      for (int k = 0; k < d; k++) {
        double t = 0;
        for (int m = 0; m < d; m++) t += F[i * d + m] * S[m * d + k];
        b->P[(i * d + k) * p + e] = b->weight[e] * t;
      }
  }
}

/* P_alg = mu F_m + (g(J_1) - g(J_0)) / (J_1 - J_0) C with C : (F_1 - F_0) = J_1 - J_0; the laws are those of
   fem/strain/laws.py. Returns the first point with J_1 <= 0, or -1. */
static inline long stress_j(const Body *b, int d) {
  const int p = b->p, n = d * d;
  long bad = -1;
  for (int e = 0; e < p; e++) {
    double F[9], h[9], C[9], dj = 0, slope;
    for (int c = 0; c < n; c++) h[c] = b->h[c * p + e], F[c] = b->H0[c * p + e] + h[c] + (c % (d + 1) == 0);
    cofactor(d, F, C);
    if (d == 3) {
      double more[9];
      cofactor(3, h, more);
      for (int c = 0; c < n; c++) C[c] += more[c] / 3;
    }
    for (int c = 0; c < n; c++) dj += 2 * C[c] * h[c];
    const double j0 = b->j0[e], x = dj / (1 + j0), q = log_quotient(x);
    if (!(x > -1) && bad < 0) bad = e;
    if (b->law == NEO_HOOKE) slope = q / (1 + j0) * (b->lam[e] * (b->l0[e] + q * x / 2) - b->mu[e]);
    else slope = b->lam[e] * (j0 + dj / 2) - b->mu[e] * q / (1 + j0);
    for (int c = 0; c < n; c++) b->P[c * p + e] = b->weight[e] * (b->mu[e] * F[c] + slope * C[c]);
  }
  return bad;
}

static void begin(Body *b, const double *a) {
  gradient(b, a, b->H0);
  if (b->d == 2) begin_as(b, 2);
  else begin_as(b, 3);
}

/* R = S w + f_alg(w) - h; 0 where a point would have J <= 0. */
static int residual(Body *b, const double *S, const double *h, const double *w, double *R) {
  const int k = b->k;
  long bad = -1;
  b->evaluations++;
  gradient(b, w, b->h);
  if (b->law == STVK) {
    if (b->d == 2) stress_stvk(b, 2);
    else stress_stvk(b, 3);
  } else bad = b->d == 2 ? stress_j(b, 2) : stress_j(b, 3);
  if (bad >= 0) {
    b->bad = bad;
    return 0;
  }
  back(b, R);
  for (int i = 0; i < k; i++) {
    double t = R[i] - h[i];
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
  const int n = d * d;
  double *room = calloc((size_t)(4 * n + 2) * p + (size_t)(11 * k + k * k), sizeof(double));
  if (!room) return -1;
  Body b = {law, d, k, p, B, weight, lam, mu, room, room + n * p, room + 2 * n * p, room + 3 * n * p,
            room + 4 * n * p, room + (4 * n + 1) * p, 0, -1};
  double *h = room + (4 * n + 2) * p, *w = h + k, *older = w + k, *old = older + k, *at = old + k, scale = 0;
  int failed = 0;
  for (int t = 0; t < steps && !failed; t++) {
    const double *a = A + t * k, *v = V + t * k;
    double *a1 = A + (t + 1) * k, *v1 = V + (t + 1) * k;
    begin(&b, a);
    for (int i = 0; i < k; i++) h[i] = s * v[i] + load[t * k + i], w[i] = 2 * old[i] - older[i];
    if (!solve(&b, S, h, tol, floor, &scale, J, w, at, counts + 1)) failed = t + 1;
    for (int i = 0; i < k; i++) {
      a1[i] = a[i] + 2 * w[i], v1[i] = 2 * s * w[i] - v[i];
      older[i] = old[i], old[i] = w[i];
    }
  }
  counts[0] = b.evaluations, counts[2] = b.bad;
  free(room);
  return failed;
}
