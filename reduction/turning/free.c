/* The iteration of a step with a free hand, which reduction/turning/stepper.py and fem/frame/balance.py have in NumPy:
   names are theirs. Vectors and matrices of the hand are those in space; what the plane does not have is zero. */
#include <math.h>
#include <string.h>

#include "dense.h"

typedef struct {
  int k, d, n_s, most, corrections;
  double h, tol, rounding;
  const int *free;                              /* (n_s) */
  const double *still, *K, *G, *S, *E, *inverse; /* (k, k) twice, (k, n_s), (k, d d), (d d, k, k), (k, k) */
  const double *M, *heavy, *g;                  /* (6, 6) twice, (3) */
  const double *a, *Y;                          /* (k), (d d, k) at the start of the step */
  const double *Q, *start, *before, *drift, *first, *B, *force; /* (3, 3), (6), (6), (6), (3), (3, 3), (6) there */
  double *w, *xi, *scale;                       /* (k), (6), (1): trial and result; largest right-hand side so far */
  double *held, *moved, *end, *right, *R;       /* room: (d d, k) twice, (k) thrice */
} Free;

static void cross(const double *v, double f, double *H, int ld) { /* H += f [v]x */
  H[1] -= f * v[2], H[2] += f * v[1], H[ld + 2] -= f * v[0];
  H[ld] += f * v[2], H[2 * ld] -= f * v[1], H[2 * ld + 1] += f * v[0];
}

static void times(const double *A, const double *x, double *y) { /* y += A x, A (6, 6) */
  for (int i = 0; i < 6; i++)
    for (int j = 0; j < 6; j++) y[i] += A[6 * i + j] * x[j];
}

static void coadjoint(const double *xi, double f, double *ad) { /* f ad*(xi) */
  memset(ad, 0, 36 * sizeof(double));
  cross(xi + 3, -f, ad, 6), cross(xi + 3, -f, ad + 21, 6), cross(xi, -f, ad + 18, 6);
}

/* Inverse of J in the hand's freedoms, by Gauss and Jordan with pivots; zero elsewhere. Whether there is one. */
static int invert(int n, const int *free, const double *J, double *inverse) {
  double T[6][12];
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) T[i][j] = J[6 * free[i] + free[j]], T[i][n + j] = i == j;
  for (int c = 0; c < n; c++) {
    int p = c;
    for (int i = c + 1; i < n; i++)
      if (fabs(T[i][c]) > fabs(T[p][c])) p = i;
    if (!(fabs(T[p][c]) > 0) || !isfinite(T[p][c])) return 0;
    for (int j = 0; j < 2 * n; j++) {
      double t = T[p][j];
      T[p][j] = T[c][j], T[c][j] = t;
    }
    for (int j = 2 * n - 1; j >= c; j--) T[c][j] /= T[c][c];
    for (int i = 0; i < n; i++)
      if (i != c)
        for (int j = 2 * n - 1; j >= c; j--) T[i][j] -= T[i][c] * T[c][j];
  }
  memset(inverse, 0, 36 * sizeof(double));
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) inverse[6 * free[i] + free[j]] = T[i][n + j];
  return 1;
}

/* Mean velocity xi for a travel of the tissue, as HandBalance.velocity. Whether it converged. */
static int velocity(const Free *t, const double *fall, const double *work, const double *Bw, const double *turning,
                    const double *C) {
  const double h = t->h, s = 2 / h, *M = t->M, *v = t->start;
  double A[36], b[6], value[6] = {0}, slope[36] = {0}, first[3], m[3], lever[9], sum[9];
  const double trace = t->B[0] + t->B[4] + t->B[8] + 2 * (Bw[0] + Bw[4] + Bw[8]);
  const double other = t->B[0] + t->B[4] + t->B[8] + Bw[0] + Bw[4] + Bw[8] + C[0] + C[4] + C[8];
  for (int i = 0; i < 3; i++) first[i] = t->first[i] + 2 * work[i], m[i] = t->first[i] + work[i];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int ij = 3 * i + j, ji = 3 * j + i;
      lever[ij] = (i == j) * trace - t->B[ji] - 2 * Bw[ji];
      sum[ij] = lever[ij] + (i == j) * other - t->B[ij] - Bw[ij] - C[ji];
    }
  for (int i = 0; i < 36; i++) A[i] = 2 * M[i];
  cross(m, -2, A + 3, 6), cross(first, 2, A + 18, 6);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) A[6 * (3 + i) + 3 + j] += 2 * sum[3 * i + j];
  for (int i = 0; i < 6; i++) {
    b[i] = 2 * s * work[i] - t->drift[i];
    for (int j = 0; j < 6; j++) b[i] -= M[6 * i + j] * v[j];
  }
  for (int i = 0; i < 3; i++) {
    const int j = (i + 1) % 3, l = (i + 2) % 3;
    b[3 + i] += turning[i] - first[j] * v[l] + first[l] * v[j] - dot(3, lever + 3 * i, v + 3);
  }
  double axes[9] = {0}, falls[9] = {0}; /* force, torque and g in the hand's axes; h/2 [g]x */
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      axes[i] += t->force[j] * t->Q[3 * j + i];
      axes[3 + i] += t->force[3 + j] * t->Q[3 * j + i];
      axes[6 + i] = fall[i];
    }
  cross(fall, h / 2, falls, 3), cross(axes, h / 2, slope + 3, 6), cross(axes + 3, h / 2, slope + 21, 6);
  for (int i = 0; i < 6; i++) {
    double arm[3] = {t->heavy[6 * i], t->heavy[6 * i + 1], t->heavy[6 * i + 2]};
    if (i >= 3) arm[(i + 1) % 3] -= m[(i + 2) % 3], arm[(i + 2) % 3] += m[(i + 1) % 3]; /* of weight beside the torque */
    value[i] = axes[i];
    for (int j = 0; j < 3; j++) {
      value[i] += arm[j] * fall[j];
      for (int c = 0; c < 3; c++) slope[6 * i + 3 + c] += arm[j] * falls[3 * j + c];
    }
  }
  for (int n = 0; n < t->corrections; n++) {
    double mu[6], both[36] = {0}, ad[36], J[36], R[6], inverse[36], change[6] = {0}, moved[6] = {0}, left[6] = {0};
    memcpy(mu, b, sizeof b);
    times(A, t->xi, mu);
    for (int i = 0; i < 6; i++) R[i] = mu[i] - t->before[i] - h * value[i], mu[i] += t->before[i];
    cross(mu, h / 2, both + 3, 6), cross(mu, h / 2, both + 18, 6), cross(mu + 3, h / 2, both + 21, 6);
    coadjoint(t->xi, h / 2, ad);
    for (int i = 0; i < 6; i++)
      for (int j = 0; j < 6; j++) {
        double product = 0;
        for (int l = 0; l < 6; l++) product += ad[6 * i + l] * A[6 * l + j];
        both[6 * i + j] += h * slope[6 * i + j];
        J[6 * i + j] = A[6 * i + j] - product - both[6 * i + j];
        R[i] -= both[6 * i + j] * t->xi[j];
      }
    if (!invert(t->n_s, t->free, J, inverse)) return 0;
    times(inverse, R, change);
    for (int i = 0; i < 6; i++) t->xi[i] -= change[i];
    times(A, change, moved);
    coadjoint(change, h / 2, ad);
    times(ad, moved, left);
    int fine = 1;
    for (int i = 0; i < 6; i++) {
      double rest = 0, limit = 0;
      for (int j = 0; j < 6; j++) {
        double size = fabs(b[j]) + fabs(t->before[j]);
        for (int l = 0; l < 6; l++) size += fabs(A[6 * j + l] * t->xi[l]);
        rest += inverse[6 * i + j] * left[j], limit += fabs(inverse[6 * i + j]) * size;
      }
      fine = fine && fabs(rest) <= t->rounding * limit;
    }
    if (fine) return 1;
  }
  return 0;
}

/* Trial travel w and velocity xi become those of the step. Corrections of w, or -1 where they do not converge. */
int softgrasp_free(const Free *t) {
  const int k = t->k, d = t->d, dd = d * d, n_s = t->n_s;
  const double h = t->h, s = 2 / h;
  double fall[3] = {0};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) fall[i] += t->g[j] * t->Q[3 * j + i];
  for (int p = 0; p < dd * k; p++) t->held[p] = dot(k, t->E + (size_t)p * k, t->a);
  for (int count = 0; count < t->most; count++) {
    double work[6] = {0}, B[9] = {0}, X[9] = {0}, C[9] = {0}, W[9] = {0}, W2[9] = {0}, rate[6], size = 0, norm = 0, terms = 0;
    for (int i = 0; i < k; i++) {
      t->end[i] = t->a[i] + 2 * t->w[i];
      for (int c = 0; c < n_s; c++) work[t->free[c]] += t->G[i * n_s + c] * t->w[i];
    }
    for (int p = 0; p < dd; p++) {
      const int at = 3 * (p / d) + p % d;
      for (int i = 0; i < k; i++) {
        const int q = p * k + i;
        t->moved[q] = dot(k, t->E + (size_t)q * k, t->w);
        X[at] += (2 * s * t->moved[q] - t->Y[q]) * t->end[i];
        C[at] += (t->held[q] + t->moved[q]) * t->end[i];
        B[at] += t->S[i * dd + p] * t->w[i];
      }
    }
    const double turning[3] = {X[5] - X[7], X[6] - X[2], X[1] - X[3]};
    if (!velocity(t, fall, work, B, turning, C)) return -1;
    cross(t->xi + 3, 1, W, 3);
    for (int i = 0; i < 9; i++)
      for (int j = 0; j < 3; j++) W2[i] += W[3 * (i / 3) + j] * W[3 * j + i % 3];
    for (int i = 0; i < 6; i++) {
      rate[i] = s * (t->xi[i] - t->start[i]) - (i < 3 ? fall[i] : 0);
      for (int j = 0; i < 3 && j < 3; j++) rate[i] += W[3 * i + j] * (t->xi[j] + h / 2 * fall[j]);
    }
    for (int i = 0; i < k; i++) {
      double left = dot(k, t->still + (size_t)i * k, t->w), right = -dot(k, t->K + (size_t)i * k, t->a);
      double term = 0;
      for (int j = 0; j < k; j++) term += fabs(t->still[(size_t)i * k + j] * t->w[j]);
      for (int c = 0; c < n_s; c++) {
        const int f = t->free[c];
        right -= t->G[i * n_s + c] * rate[f];
        term += s * fabs(t->G[i * n_s + c]) * (fabs(t->xi[f]) + fabs(t->start[f]));
      }
      for (int p = 0; p < dd; p++) {
        const int at = 3 * (p / d) + p % d, q = p * k + i;
        if (p / d == p % d) right += s * t->Y[q];
        right -= t->S[i * dd + p] * W2[at] + (s * W[at] + W2[at]) * t->held[q];
        left += (2 * s * W[at] + W2[at]) * t->moved[q];
      }
      t->right[i] = right, t->R[i] = left - right;
      size += right * right, terms += term * term, norm += t->R[i] * t->R[i];
    }
    *t->scale = fmax(*t->scale, sqrt(size));
    if (sqrt(norm) <= fmax(t->tol * *t->scale, t->rounding * sqrt(terms))) return count;
    if (!isfinite(norm)) return -1;
    for (int i = 0; i < k; i++) t->w[i] -= dot(k, t->inverse + (size_t)i * k, t->R);
  }
  return -1;
}
