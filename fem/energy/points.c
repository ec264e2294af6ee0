/* An own energy for LANES points at a time: what @..@ stands for is written by fem/energy/compiled.py from the
   operations of the energy. The layout of the points is that of fem/strain/force.c. */
#include "law.h"
#include <string.h>

enum { D = @D@, N = D * D };
typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long I __attribute__((vector_size(8 * LANES)));
#define EVEN(x) ((V){0} + (x))
#define EACHV(text) { V r; EACH r[l] = text; return r; }
INLINE V load(const double *x) { V v; memcpy(&v, x, sizeof v); return v; }
INLINE void store(double *x, V v) { memcpy(x, &v, sizeof v); }
INLINE V v_select(I c, V a, V b) { return (V)((c & (I)a) | (~c & (I)b)); }
INLINE V v_sqrt(V x) EACHV(sqrt(x[l]))
INLINE V v_ln(V x) EACHV(log(x[l]))
INLINE V v_exp(V x) EACHV(exp(x[l]))
INLINE V v_cos(V x) EACHV(cos(x[l]))
INLINE V v_sin(V x) EACHV(sin(x[l]))
INLINE V v_tan(V x) EACHV(tan(x[l]))
INLINE V v_cosh(V x) EACHV(cosh(x[l]))
INLINE V v_sinh(V x) EACHV(sinh(x[l]))
INLINE V v_tanh(V x) EACHV(tanh(x[l]))
INLINE V v_acos(V x) EACHV(acos(x[l]))
INLINE V v_asin(V x) EACHV(asin(x[l]))
INLINE V v_atan(V x) EACHV(atan(x[l]))
INLINE V v_erf(V x) EACHV(erf(x[l]))
INLINE V v_pow(V x, V y) EACHV(pow(x[l], y[l]))
INLINE V v_ramp(V x) EACHV(x[l] > 0 ? x[l] : 0)
INLINE V v_det(V a, V b, V c, V d, V e, V f, V g, V h, V i) {
  return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g);
}
INLINE V v_lnq(V x) {
  Lane y, q;
  store(y, x);
  log_quotient(y, q);
  return load(q);
}
/* (exp(x) - 1) / x without 0/0: its series near 0. */
INLINE V v_expq(V x) {
  V s = EVEN(1. / 6227020800);
  s = s * x + 1. / 479001600, s = s * x + 1. / 39916800, s = s * x + 1. / 3628800, s = s * x + 1. / 362880;
  s = s * x + 1. / 40320, s = s * x + 1. / 5040, s = s * x + 1. / 720, s = s * x + 1. / 120, s = s * x + 1. / 24;
  s = s * x + 1. / 6, s = s * x + 0.5, s = s * x + 1;
  EACH if (!(fabs(x[l]) < 0.25)) s[l] = expm1(x[l]) / x[l];
  return s;
}

/* ---- the operations: entries of H, of half its change, parameters and kept values of points q .. q + LANES */
#define B(i) (H0[i])
#define M(i) (h[i])
#define A(i) (load(par + (size_t)(i) * p + q))
#define K(i) (load(keep + (size_t)(i) * p + q))
INLINE void keep_values(const V *H0, const double *par, size_t p, size_t q, double *keep) {
  @KEEP@
}
INLINE void step_stress(const V *H0, const V *h, const double *par, const double *keep, size_t p, size_t q, V *P) {
  @STEP@
}
INLINE V energy_density(const V *H0, const double *par, size_t p, size_t q) {
  @ENERGY@
}

/* ---- for all points: H, h, P are (N, p), p a multiple of LANES */
#define ALL for (size_t q = 0; q < (size_t)p; q += LANES)
INLINE void entries(int p, size_t q, const double *H, V *x) {
  for (int c = 0; c < N; c++) x[c] = load(H + (size_t)c * p + q);
}

void softgrasp_energy(int p, const double *H, const double *par, double *W) {
  ALL {
    V x[N];
    entries(p, q, H, x);
    store(W + q, energy_density(x, par, p, q));
  }
}

void softgrasp_stress(int p, const double *H, const double *par, double *P) {
  ALL {
    V H0[N];
    entries(p, q, H, H0);
    @STRESS@
  }
}

/* The upper triangle of A, row by row: A[c][e] = dP_c / dF_e for e >= c. */
void softgrasp_tangent(int p, const double *H, const double *par, double *A) {
  ALL {
    V H0[N];
    entries(p, q, H, H0);
    @TANGENT@
  }
}

void softgrasp_step(int p, const double *H, const double *w, const double *par, double *keep, double *P) {
  ALL {
    V x[N], y[N], z[N];
    entries(p, q, H, x), entries(p, q, w, y);
    keep_values(x, par, p, q, keep);
    step_stress(x, y, par, keep, p, q, z);
    for (int c = 0; c < N; c++) store(P + (size_t)c * p + q, z[c]);
  }
}

void softgrasp_begin(int k, int p, const int *node, const double *G, const double *z, const double *par, double *H0,
                     double *j0, double *keep) {
  ALL {
    Lane H[9];
    V x[N];
    node_gradient(D, k, node, G, z, H);
    volume(D, H, j0 + q);
    for (int c = 0; c < N; c++) x[c] = load(H[c]), store(H0 + (size_t)c * p + q, x[c]);
    keep_values(x, par, p, q, keep);
    node += k * LANES, G += k * D * LANES;
  }
}

/* Force f (n,) over a step of 2 w, and J at its end; whether every point has J > 0 and a stress. */
int softgrasp_force(int k, int p, const int *node, const double *G, const double *vol, const double *par,
                    const double *H0, const double *keep, const double *w, int n, double *f, double *J) {
  int fine = 1;
  for (int i = 0; i < n; i++) f[i] = 0;
  ALL {
    Lane h[9], H1[9], s[9];
    V x[N], y[N], z[N], sum = EVEN(0.);
    node_gradient(D, k, node, G, w, h);
    for (int c = 0; c < N; c++) {
      x[c] = load(H0 + (size_t)c * p + q), y[c] = load(h[c]);
      store(H1[c], x[c] + 2 * y[c]);
    }
    volume(D, H1, J + q);
    EACH J[q + l] += 1;
    step_stress(x, y, par, keep, p, q, z);
    for (int c = 0; c < N; c++) sum += z[c] * 0.0;
    EACH fine &= (J[q + l] > 0) & (sum[l] == 0);
    if (fine) {
      for (int c = 0; c < N; c++) store(s[c], z[c] * load(vol + q));
      for (int a = 0; a < k; a++)
        for (int i = 0; i < D; i++) {
          Lane t = {0};
          for (int j = 0; j < D; j++) EACH t[l] += s[i * D + j][l] * G[(a * D + j) * LANES + l];
          EACH f[node[a * LANES + l] * D + i] += t[l];
        }
    }
    node += k * LANES, G += k * D * LANES;
  }
  return fine;
}
