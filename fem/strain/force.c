/* The force of a step without the matrix B: H = grad z in every point from its nodes, P_alg, and B' (vol P_alg) to them.
   By chunks of LANES points: node[chunk][a][lane], G[chunk][a][j][lane] = dN_a / dX_j; what fills up the last chunk, and
   nodes that follow the hand, have G = 0. Arrays of p points, p a multiple of LANES; H0 is (d d, p). See body.py. */
#include "law.h"

INLINE void start_as(int d, int k, int p, const int *node, const double *G, const double *z, double *H0, double *j0,
                     double *l0) {
  for (int q = 0; q < p; q += LANES, node += k * LANES, G += k * d * LANES) {
    Lane H[9], x;
    node_gradient(d, k, node, G, z, H);
    volume(d, H, j0 + q);
    log_quotient(j0 + q, x);
    EACH l0[q + l] = x[l] * j0[q + l];
    for (int c = 0; c < d * d; c++) EACH H0[(size_t)c * p + q + l] = H[c][l];
  }
}

INLINE int force_as(int law, int d, int k, int p, const int *node, const double *G, const double *vol, const double *lam,
                    const double *mu, const double *H0, const double *j0, const double *l0, const double *w, int n,
                    double *f, double *J) {
  int fine = 1;
  for (int i = 0; i < n; i++) f[i] = 0;
  for (int q = 0; q < p; q += LANES, node += k * LANES, G += k * d * LANES) {
    Lane h[9], H[9], P[9];
    node_gradient(d, k, node, G, w, h);
    for (int c = 0; c < d * d; c++) EACH H[c][l] = H0[(size_t)c * p + q + l];
    if (stress(law, d, H, j0 + q, l0 + q, h, lam + q, mu + q, P, J + q) < LANES) fine = 0;
    if (!fine) continue; /* only J is of interest */
    for (int c = 0; c < d * d; c++) EACH P[c][l] *= vol[q + l];
    for (int a = 0; a < k; a++)
      for (int i = 0; i < d; i++) {
        Lane x = {0};
        for (int j = 0; j < d; j++) EACH x[l] += P[i * d + j][l] * G[(a * d + j) * LANES + l];
        EACH f[node[a * LANES + l] * d + i] += x[l];
      }
  }
  return fine;
}

void softgrasp_start(int d, int k, int p, const int *node, const double *G, const double *z, double *H0, double *j0,
                     double *l0) {
  if (d == 2) k == 3 ? start_as(2, 3, p, node, G, z, H0, j0, l0) : start_as(2, k, p, node, G, z, H0, j0, l0);
  else start_as(3, k, p, node, G, z, H0, j0, l0);
}

/* f (n,) is the force; whether J_1 > 0 in all points. */
int softgrasp_force(int law, int d, int k, int p, const int *node, const double *G, const double *vol, const double *lam,
                    const double *mu, const double *H0, const double *j0, const double *l0, const double *w, int n,
                    double *f, double *J) {
  if (d == 2 && k == 3) return force_as(law, 2, 3, p, node, G, vol, lam, mu, H0, j0, l0, w, n, f, J);
  if (d == 2) return force_as(law, 2, k, p, node, G, vol, lam, mu, H0, j0, l0, w, n, f, J);
  return force_as(law, 3, k, p, node, G, vol, lam, mu, H0, j0, l0, w, n, f, J);
}
