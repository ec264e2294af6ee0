/* The small algebra of a step of tissue on a body of MuJoCo; see reduction/bridges/mujoco.py, which has it in NumPy too. */
#include "dense.h"

typedef struct {
  int k, nv, nq, entries, keeps;
  double h;
  const double *E, *sums, *G, *K, *D, *inverse;   /* (9, k, k), (k, 12), (k, 6); K; D + h/2 K; S^-1: (k, k) */
  const double *rigid;                            /* mass matrix of rigid tissue, (6, 6) */
  const double *J, *Jd, *Q, *qpos, *qvel;         /* (6, nv) twice in space; axes (3, 3) and state of MuJoCo */
  double *M, *applied;                            /* of MuJoCo: lower triangle of the mass matrix, forces (nv) */
  const int *rows, *columns;                      /* of the entries of M */
  double *a, *e, *past, *rate;                    /* state, last change of e, last angular acceleration */
  double *inertia, *force, *wrench;               /* (6, 6), (6), (6) */
  double *due, *reached;                          /* momentum due in space (3), in which state (1 + nq + nv + 2 k) */
  double *known, *pulled, *turned, *pairs;        /* right-hand side (k), G_a (k, 6), G_a'S^-1 (6, k), (9, k, 2) */
  double *six, *product, *b, *before, *user;      /* J in the axes of the body (6, nv), (6, nv), (6), (nv), (nv) */
} Tissue;

static void multiply(const double *A, const double *B, double *C) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) C[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
}

/* Rows of MuJoCo's Jacobian in the axes of the body. */
static void turn(const double *Q, int nv, const double *J, double *to) {
  for (int r = 0; r < 6; r += 3)
    for (int i = 0; i < 3; i++)
      for (int n = 0; n < nv; n++) {
        double t = 0;
        for (int c = 0; c < 3; c++) t += Q[3 * c + i] * J[(size_t)(r + c) * nv + n];
        to[(size_t)(r + i) * nv + n] = t;
      }
}

/* Integrals at the middle of the step: pairs with every mode, int rho z and int rho z_k r_l of z and of its rate in x
   and y (12), int rho z_k z_l in C and int rho z_k e_l in F. */
static void integrals(const Tissue *t, const double *a, const double *e, double *x, double *y, double *C, double *F) {
  const int k = t->k;
  memset(x, 0, 12 * sizeof(double));
  memset(y, 0, 12 * sizeof(double));
  for (int i = 0; i < k; i++)
    for (int c = 0; c < 12; c++) {
      x[c] += t->sums[12 * i + c] * a[i];
      y[c] += t->sums[12 * i + c] * e[i];
    }
  for (int p = 0; p < 9; p++) {
    C[p] = F[p] = 0;
    for (int i = 0; i < k; i++) {
      const double *row = t->E + (size_t)(p * k + i) * k, u = dot(k, row, a), v = dot(k, row, e);
      t->pairs[2 * (p * k + i)] = u;
      t->pairs[2 * (p * k + i) + 1] = v;
      C[p] += a[i] * u;
      F[p] += a[i] * v;
    }
  }
}

/* Right-hand side and G_a of the modes, under free fall g at the angular velocity of W, whose square is W2. */
static void modes(const Tissue *t, const double *g, const double *W, const double *W2) {
  const int k = t->k;
  for (int i = 0; i < k; i++) {
    const double *s = t->sums + 12 * i;
    double r = s[0] * g[0] + s[1] * g[1] + s[2] * g[2], at[9];
    for (int p = 0; p < 9; p++) {
      at[p] = t->pairs[2 * (p * k + i)];
      r -= W2[p] * (s[3 + p] + at[p]) + 2 * W[p] * t->pairs[2 * (p * k + i) + 1];
    }
    t->known[i] = r - dot(k, t->K + (size_t)i * k, t->a) - dot(k, t->D + (size_t)i * k, t->e);
    double *G = t->pulled + 6 * i;
    memcpy(G, t->G + 6 * i, 6 * sizeof(double));
    G[3] += at[7] - at[5];
    G[4] += at[2] - at[6];
    G[5] += at[3] - at[1];
  }
}

/* M_a - G_a'S^-1 G_a and G_a'S^-1 r + v. */
static void body(const Tissue *t, const double *g, const double *W, const double *W2, const double *x, const double *y,
                 const double *C, const double *F) {
  const int k = t->k;
  for (int c = 0; c < 6; c++)
    for (int i = 0; i < k; i++) {
      double s = 0;
      for (int j = 0; j < k; j++) s += t->pulled[6 * j + c] * t->inverse[(size_t)j * k + i];
      t->turned[(size_t)c * k + i] = s;
    }
  for (int c = 0; c < 6; c++) {
    t->force[c] = dot(k, t->turned + (size_t)c * k, t->known);
    for (int j = 0; j < 6; j++) {
      double s = 0;
      for (int i = 0; i < k; i++) s += t->turned[(size_t)c * k + i] * t->pulled[6 * i + j];
      t->inertia[6 * c + j] = -s;
    }
  }
  const double lever[9] = {0, -x[2], x[1], x[2], 0, -x[0], -x[1], x[0], 0};
  double whole[9], moving[9], V[9], U[9];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      whole[3 * i + j] = x[3 + 3 * i + j] + x[3 + 3 * j + i] + C[3 * i + j];
      moving[3 * i + j] = 2 * (y[3 + 3 * i + j] + F[3 * j + i]);
    }
  const double trace = whole[0] + whole[4] + whole[8];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int p = 3 * i + j;
      t->inertia[6 * i + 3 + j] -= lever[p];
      t->inertia[6 * (3 + i) + j] += lever[p];
      t->inertia[6 * (3 + i) + 3 + j] += (i == j ? trace : 0) - whole[p];
      t->force[i] += W2[p] * x[j] + 2 * W[p] * y[j];
      t->force[3 + i] -= lever[p] * g[j];
    }
  multiply(W2, whole, V);
  multiply(W, moving, U);
  for (int p = 0; p < 9; p++) V[p] += U[p];
  t->force[3] += V[7] - V[5];
  t->force[4] += V[2] - V[6];
  t->force[5] += V[3] - V[1];
}

/* Linear momentum of all tissue at the velocity xi of the body, in its axes. */
static void momentum(const Tissue *t, const double *xi, double *p) {
  const double *w = xi + 3;
  double m[3] = {0};
  for (int c = 0; c < 3; c++) {
    p[c] = dot(6, t->rigid + 6 * c, xi);
    for (int i = 0; i < t->k; i++) {
      m[c] += t->sums[12 * i + c] * t->a[i];
      p[c] += t->sums[12 * i + c] * t->e[i];
    }
  }
  p[0] += w[1] * m[2] - w[2] * m[1];
  p[1] += w[2] * m[0] - w[0] * m[2];
  p[2] += w[0] * m[1] - w[1] * m[0];
}

/* Whether MuJoCo and the tissue are where the last step left them; a quaternion may have been normalised again. */
static int goes_on(const Tissue *t) {
  const double *r = t->reached, *parts[4] = {t->qpos, t->qvel, t->a, t->e};
  const int sizes[4] = {t->nq, t->nv, t->k, t->k};
  if (!t->keeps || *r++ == 0) return 0;
  for (int p = 0; p < 4; p++)
    for (int i = 0; i < sizes[p]; i++, r++)
      if (!(fabs(parts[p][i] - *r) <= 1e-14 * fabs(*r))) return 0;
  return 1;
}

/* From the body what the momentum held is above that due; and that due next, but for the part of the accelerations. */
static void settle_momentum(const Tissue *t, const double *xi) {
  const double *w = xi + 3;
  double p[3], whirl[3], held[3], late[3];
  momentum(t, xi, p);
  for (int c = 0; c < 3; c++) whirl[c] = dot(3, t->rigid + 6 * c + 3, w);
  const double given[3] = {t->force[0] + w[1] * whirl[2] - w[2] * whirl[1],
                           t->force[1] + w[2] * whirl[0] - w[0] * whirl[2],
                           t->force[2] + w[0] * whirl[1] - w[1] * whirl[0]};
  const int on = goes_on(t);
  for (int c = 0; c < 3; c++) {
    held[c] = dot(3, t->Q + 3 * c, p);
    late[c] = (held[c] - t->due[c]) / t->h;
    t->due[c] = held[c] + t->h * dot(3, t->Q + 3 * c, given);
  }
  for (int c = 0; on && c < 3; c++) t->force[c] += t->Q[c] * late[0] + t->Q[3 + c] * late[1] + t->Q[6 + c] * late[2];
}

/* Before MuJoCo solves: inertia into its mass matrix, forces into the applied ones. Room: 2 k numbers. */
void softgrasp_tissue_begin(const Tissue *t, const double *gravity, double *room) {
  const int k = t->k, nv = t->nv;
  double *a = room, *e = room + k, w[3], g[3], W2[9], x[12], y[12], C[9], F[9], load[6], xi[6];
  turn(t->Q, nv, t->J, t->six);
  turn(t->Q, nv, t->Jd, t->product);
  for (int r = 0; r < 6; r++) t->b[r] = dot(nv, t->product + (size_t)r * nv, t->qvel);
  for (int r = 0; r < 6; r++) xi[r] = dot(nv, t->six + (size_t)r * nv, t->qvel);
  for (int c = 0; c < 3; c++) {
    w[c] = xi[3 + c] + t->h / 2 * t->rate[c];
    g[c] = t->Q[c] * gravity[0] + t->Q[3 + c] * gravity[1] + t->Q[6 + c] * gravity[2];
  }
  const double W[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
  multiply(W, W, W2);
  for (int i = 0; i < k; i++) {
    e[i] = t->e[i] + t->past[i] / 2;
    a[i] = t->a[i] + t->h / 2 * t->e[i] + t->h / 4 * t->past[i];
  }
  integrals(t, a, e, x, y, C, F);
  modes(t, g, W, W2);
  body(t, g, W, W2, x, y, C, F);
  settle_momentum(t, xi);
  for (int r = 0; r < 6; r++) {
    load[r] = t->force[r] + dot(6, t->inertia + 6 * r, t->b);
    for (int n = 0; n < nv; n++) {
      double s = 0;
      for (int c = 0; c < 6; c++) s += t->inertia[6 * r + c] * t->six[(size_t)c * nv + n];
      t->product[(size_t)r * nv + n] = s;
    }
  }
  for (int n = 0; n < t->entries; n++)
    for (int r = 0; r < 6; r++) t->M[n] += t->six[(size_t)r * nv + t->rows[n]] * t->product[(size_t)r * nv + t->columns[n]];
  memcpy(t->before, t->qvel, nv * sizeof(double));
  memcpy(t->user, t->applied, nv * sizeof(double));
  for (int n = 0; n < nv; n++)
    for (int r = 0; r < 6; r++) t->applied[n] -= t->six[(size_t)r * nv + n] * load[r];
}

/* After it: the state at the end of the step, from the velocity that was reached. Returns 0 where it is not finite. */
int softgrasp_tissue_end(const Tissue *t, double *room) {
  const int k = t->k, nv = t->nv;
  int finite = 1;
  double A[6], force[3];
  memcpy(t->applied, t->user, nv * sizeof(double));
  for (int n = 0; n < nv; n++) t->before[n] = (t->qvel[n] - t->before[n]) / t->h;
  for (int r = 0; r < 6; r++) A[r] = t->b[r] + dot(nv, t->six + (size_t)r * nv, t->before);
  for (int i = 0; i < k; i++) room[i] = t->known[i] - dot(6, t->pulled + 6 * i, A);
  for (int i = 0; i < k; i++) {
    const double change = t->h * dot(k, t->inverse + (size_t)i * k, room);
    finite &= isfinite(change) != 0;
    t->a[i] += t->h * (t->e[i] + change / 2);
    t->e[i] += change;
    t->past[i] = change;
  }
  memcpy(t->rate, A + 3, 3 * sizeof(double));
  for (int r = 0; r < 6; r++) t->wrench[r] = -(t->force[r] + dot(6, t->inertia + 6 * r, A));
  for (int c = 0; c < 3; c++) force[c] = dot(6, t->inertia + 6 * c, A) + dot(6, t->rigid + 6 * c, A);
  for (int c = 0; c < 3; c++) t->due[c] += t->h * dot(3, t->Q + 3 * c, force);
  double *r = t->reached;
  *r = 1;
  memcpy(r + 1, t->qpos, t->nq * sizeof(double));
  memcpy(r + 1 + t->nq, t->qvel, nv * sizeof(double));
  memcpy(r + 1 + t->nq + nv, t->a, k * sizeof(double));
  memcpy(r + 1 + t->nq + nv + k, t->e, k * sizeof(double));
  return finite;
}
