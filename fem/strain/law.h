/* The laws of fem/strain/laws.py for LANES points at a time, which stay in registers: used by fem/strain/force.c and
   reduction/strain/stepper.c. Component by component, row by row: H[i * d + j] = dz_i / dX_j. */
#include <math.h>
#include <stddef.h>

enum { NEO_HOOKE, NEO_HOOKE_QUADRATIC, STVK };
#define EACH for (int l = 0; l < LANES; l++)
#define INLINE static inline __attribute__((always_inline)) /* so that d is a constant in all loops */

typedef double Lane[LANES];
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

/* H = grad z of the nodes of LANES points; the layout is that of fem/strain/force.c. */
INLINE void node_gradient(int d, int k, const int *node, const double *G, const double *z, Lane *H) {
  for (int c = 0; c < d * d; c++) EACH H[c][l] = 0;
  for (int a = 0; a < k; a++, node += LANES, G += d * LANES)
    for (int i = 0; i < d; i++) {
      Lane x;
      EACH x[l] = z[node[l] * d + i];
      for (int j = 0; j < d; j++) EACH H[i * d + j][l] += x[l] * G[j * LANES + l];
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

INLINE int stress_stvk(int d, const Lane *H0, const Lane *h, const double *lam, const double *mu, Lane *P, double *J) {
  const int n = d * d;
  Lane H1[9], F[9], E0[9], S[9], trace = {0};
  for (int c = 0; c < n; c++) EACH F[c][l] = H0[c][l] + h[c][l] + (c % (d + 1) == 0), H1[c][l] = H0[c][l] + 2 * h[c][l];
  strain(d, H0, E0);
  strain(d, H1, S);
  volume(d, H1, J);
  EACH J[l] += 1;
  for (int c = 0; c < n; c++) EACH S[c][l] = (S[c][l] + E0[c][l]) / 2;
  for (int i = 0; i < d; i++) EACH trace[l] += S[i * (d + 1)][l];
  for (int c = 0; c < n; c++) EACH S[c][l] = 2 * mu[l] * S[c][l] + (c % (d + 1) == 0) * lam[l] * trace[l];
  for (int i = 0; i < d; i++)
    for (int k = 0; k < d; k++) {
      EACH P[i * d + k][l] = 0;
      for (int m = 0; m < d; m++) EACH P[i * d + k][l] += F[i * d + m][l] * S[m * d + k][l];
    }
  return LANES;
}

/* P_alg from H0 (J - 1 = j0, ln J = l0) to H0 + 2 h, and J_1; the first lane with J_1 <= 0, LANES where there is none.
   P_alg = mu F_m + (g(J_1) - g(J_0)) / (J_1 - J_0) C with C : (F_1 - F_0) = J_1 - J_0. */
INLINE int stress(int law, int d, const Lane *H0, const double *j0, const double *l0, const Lane *h, const double *lam,
                  const double *mu, Lane *P, double *J) {
  const int n = d * d;
  Lane F[9], C[9], dj = {0}, x, q, slope;
  if (law == STVK) return stress_stvk(d, H0, h, lam, mu, P, J);
  for (int c = 0; c < n; c++) EACH F[c][l] = H0[c][l] + h[c][l] + (c % (d + 1) == 0);
  cofactor(d, F, C);
  if (d == 3) {
    Lane more[9];
    cofactor(3, h, more);
    for (int c = 0; c < n; c++) EACH C[c][l] += more[c][l] / 3;
  }
  for (int c = 0; c < n; c++) EACH dj[l] += 2 * C[c][l] * h[c][l];
  EACH J[l] = 1 + j0[l] + dj[l], x[l] = dj[l] / (1 + j0[l]);
  EACH if (!(x[l] > -1)) return l;
  log_quotient(x, q);
  if (law == NEO_HOOKE) EACH slope[l] = q[l] / (1 + j0[l]) * (lam[l] * (l0[l] + q[l] * x[l] / 2) - mu[l]);
  else EACH slope[l] = lam[l] * (j0[l] + dj[l] / 2) - mu[l] * q[l] / (1 + j0[l]);
  for (int c = 0; c < n; c++) EACH P[c][l] = mu[l] * F[c][l] + slope[l] * C[c][l];
  return LANES;
}
