/* The small algebra of a step of tissue on a body of MuJoCo; see reduction/bridges/mujoco.py and flight.py, which
   have it in NumPy too. PASSES comes from there. */
#include "dense.h"

typedef struct {
  int k, nv, entries, free, place;                /* first velocity and coordinate of a root that is free, or -1 */
  double h;
  const double *E, *sums, *G, *K, *D, *inverse;   /* (9, k, k), (k, 12), (k, 6); K; D + h/2 K; S^-1: (k, k) */
  const double *J, *Jd, *Q, *R;                   /* (6, nv) twice in space; axes of body and root (3, 3) */
  double *qpos, *qvel, *M, *applied;              /* of MuJoCo: state, lower triangle of the mass matrix, forces (nv) */
  const double *smooth, *bias;                    /* forces of MuJoCo: all but constraints, and those of motion (nv) */
  const double *own_M, *own_J, *own_Q, *own_v;    /* as M, J, Q, qvel, with the root at rest in the axes of space */
  const int *rows, *columns;                      /* of the entries of M */
  double *a, *e, *past, *rate;                    /* state, last change of e, last angular acceleration */
  double *inertia, *force, *wrench;               /* (6, 6), (6), (6) */
  double *begun, *given;                          /* the root at the start of a step (28), force on it of the tissue (6) */
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

static void cross(const double *a, const double *b, double *c) {
  for (int i = 0; i < 3; i++) c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

/* M_a, added to a mass matrix (6, 6), from integrals x and C of the deformation. */
static void added(const double *x, const double *C, double *inertia) {
  const double lever[9] = {0, -x[2], x[1], x[2], 0, -x[0], -x[1], x[0], 0};
  const double trace = 2 * (x[3] + x[7] + x[11]) + C[0] + C[4] + C[8];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int p = 3 * i + j;
      inertia[6 * i + 3 + j] -= lever[p];
      inertia[6 * (3 + i) + j] += lever[p];
      inertia[6 * (3 + i) + 3 + j] += (i == j ? trace : 0) - x[3 + p] - x[3 + 3 * j + i] - C[p];
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
  double whole[9], moving[9], V[9], U[9], lever[3];
  added(x, C, t->inertia);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int p = 3 * i + j;
      whole[p] = x[3 + p] + x[3 + 3 * j + i] + C[p];
      moving[p] = 2 * (y[3 + p] + F[3 * j + i]);
      t->force[i] += W2[p] * x[j] + 2 * W[p] * y[j];
    }
  multiply(W2, whole, V);
  multiply(W, moving, U);
  cross(x, g, lever);
  for (int p = 0; p < 9; p++) V[p] += U[p];
  for (int i = 0; i < 3; i++) t->force[3 + i] -= lever[i];
  t->force[3] += V[7] - V[5];
  t->force[4] += V[2] - V[6];
  t->force[5] += V[3] - V[1];
}

static void against(const double *R, const double *x, double *y) {
  for (int i = 0; i < 3; i++) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

static void axes(const double *q, double *R) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double all[9] = {w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z};
  memcpy(R, all, sizeof all);
}

/* x := A^-1 x, A (6, 6) positive definite, of which the lower triangle becomes its factor. */
static void solve(double *A, double *x) {
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      const double rest = A[6 * i + j] - dot(j, A + 6 * i, A + 6 * j);
      A[6 * i + j] = i == j ? sqrt(rest) : rest / A[6 * j + j];
    }
    x[i] = (x[i] - dot(i, A + 6 * i, x)) / A[7 * i];
  }
  for (int i = 5; i >= 0; i--) {
    for (int j = i + 1; j < 6; j++) x[i] -= A[6 * j + i] * x[j];
    x[i] /= A[7 * i];
  }
}

/* With the root of the tree at rest in the axes of space, as MuJoCo has it in `own`: mass matrix (6, 6) of its first six
   velocities, momenta (6) about its origin, centre of mass (3). */
static void momenta(const Tissue *t, double *mass, double *p, double *centre) {
  const int nv = t->nv, first = t->free;
  double x[12], y[12], C[9], F[9], inertia[36] = {0}, xi[6], mu[6];
  turn(t->own_Q, nv, t->own_J, t->product);
  for (int r = 0; r < 6; r++) xi[r] = dot(nv, t->product + (size_t)r * nv, t->own_v);
  integrals(t, t->a, t->e, x, y, C, F);
  added(x, C, inertia);
  for (int r = 0; r < 6; r++) {
    mu[r] = dot(6, inertia + 6 * r, xi) + (r < 3 ? y[r] : 0);
    for (int i = 0; r > 2 && i < t->k; i++) mu[r] += t->G[6 * i + r] * t->e[i];
  }
  mu[3] += F[5] - F[7];
  mu[4] += F[6] - F[2];
  mu[5] += F[1] - F[3];
  memset(p, 0, 6 * sizeof(double));
  for (int n = 0; n < t->entries; n++) {
    const int i = t->rows[n] - first, j = t->columns[n] - first;
    if (j < 0 || j > 5) continue;
    p[j] += t->own_M[n] * t->own_v[t->rows[n]];
    if (i < 6) mass[6 * i + j] = mass[6 * j + i] = t->own_M[n];
  }
  for (int i = 0; i < 6; i++)
    for (int r = 0; r < 6; r++) {
      const double *J = t->product + first, f = J[(size_t)r * nv + i];
      p[i] += f * mu[r];
      for (int c = 0; c < 6; c++)
        for (int j = 0; j < 6; j++) mass[6 * i + j] += f * inertia[6 * r + c] * J[(size_t)c * nv + j];
    }
  centre[0] = mass[11] / mass[0];
  centre[1] = mass[15] / mass[0];
  centre[2] = mass[4] / mass[0];
}

/* P, L about the centre of mass, its place, its lever, axes (3, 3), spin, quaternion of the root, before a step. */
void softgrasp_tissue_depart(const Tissue *t) {
  const double *v = t->qvel + t->free, *place = t->qpos + t->place;
  double mass[36], p[6], c[3], own[6], lever[3], *was = t->begun;
  momenta(t, mass, p, c);
  memcpy(was + 12, t->R, 9 * sizeof(double));
  memcpy(was + 21, v + 3, 3 * sizeof(double));
  const double length = sqrt(dot(4, place + 3, place + 3));
  for (int i = 0; i < 4; i++) was[24 + i] = length > 1e-15 ? place[3 + i] / length : i == 0; /* as MuJoCo */
  against(t->R, v, own);
  memcpy(own + 3, v + 3, 3 * sizeof(double));
  for (int i = 0; i < 6; i++) p[i] += dot(6, mass + 6 * i, own);
  cross(c, p, lever);
  for (int i = 0; i < 3; i++) p[3 + i] -= lever[i];
  for (int i = 0; i < 3; i++) {
    was[i] = dot(3, t->R + 3 * i, p);
    was[3 + i] = dot(3, t->R + 3 * i, p + 3);
    was[9 + i] = dot(3, t->R + 3 * i, c);
    was[6 + i] = place[i] + was[9 + i];
  }
}

/* After it, where no constraint acted on the tree from outside: place, axes and velocity of the root for which the
   momenta are those before the step and what forces and gravity gave, and the centre of mass went on by its velocity. */
void softgrasp_tissue_keep(const Tissue *t, const double *gravity) {
  const double h = t->h, *was = t->begun, *R0 = was + 12, *q0 = was + 24;
  double *place = t->qpos + t->place, *v = t->qvel + t->free;
  double mass[36], rest[6], c[3], P[3], L[3], lever[3], R[9], xi[6], T[36], q[4], force[6];
  momenta(t, mass, rest, c);
  for (int i = 0; i < 6; i++) { /* MuJoCo's bias has the weight, too */
    const int n = t->free + i;
    force[i] = t->smooth[n] + t->bias[n] - t->given[i];
  }
  cross(was + 9, force, lever);
  for (int i = 0; i < 3; i++) {
    P[i] = was[i] + h * (force[i] + mass[0] * gravity[i]);
    L[i] = was[3 + i] + h * (dot(3, R0 + 3 * i, force + 3) - lever[i]);
  }
  memcpy(q, place + 3, sizeof q);
  for (int pass = 0;; pass++) {
    double p[3], u[3];
    axes(q, R);
    against(R, P, p);
    against(R, L, xi + 3);
    cross(c, p, lever);
    for (int i = 0; i < 3; i++) xi[i] = p[i] - rest[i], xi[3 + i] += lever[i] - rest[3 + i];
    memcpy(T, mass, sizeof T);
    solve(T, xi);
    if (pass == PASSES) break;
    for (int i = 0; i < 3; i++) u[i] = h / 4 * (was[21 + i] + xi[3 + i]); /* half of the turn at the mean velocity */
    const double size = sqrt(dot(3, u, u)), f = size > 0 ? sin(size) / size : 1, z = cos(size);
    q[0] = q0[0] * z - f * (q0[1] * u[0] + q0[2] * u[1] + q0[3] * u[2]);
    q[1] = q0[1] * z + f * (q0[0] * u[0] + q0[2] * u[2] - q0[3] * u[1]);
    q[2] = q0[2] * z + f * (q0[0] * u[1] + q0[3] * u[0] - q0[1] * u[2]);
    q[3] = q0[3] * z + f * (q0[0] * u[2] + q0[1] * u[1] - q0[2] * u[0]);
    const double length = sqrt(dot(4, q, q));
    for (int i = 0; i < 4; i++) q[i] /= length;
  }
  memcpy(place + 3, q, sizeof q);
  for (int i = 0; i < 3; i++) {
    place[i] = was[6 + i] + h * P[i] / mass[0] - dot(3, R + 3 * i, c);
    v[i] = dot(3, R + 3 * i, xi);
    v[3 + i] = xi[3 + i];
  }
}

/* Before MuJoCo solves: inertia into its mass matrix, forces into the applied ones. Room: 2 k numbers. */
void softgrasp_tissue_begin(const Tissue *t, const double *gravity, double *room) {
  const int k = t->k, nv = t->nv;
  double *a = room, *e = room + k, w[3], g[3], W2[9], x[12], y[12], C[9], F[9], load[6];
  turn(t->Q, nv, t->J, t->six);
  turn(t->Q, nv, t->Jd, t->product);
  for (int r = 0; r < 6; r++) t->b[r] = dot(nv, t->product + (size_t)r * nv, t->qvel);
  for (int c = 0; c < 3; c++) {
    w[c] = dot(nv, t->six + (size_t)(3 + c) * nv, t->qvel) + t->h / 2 * t->rate[c];
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
  double A[6];
  for (int i = 0; t->free >= 0 && i < 6; i++) t->given[i] = t->applied[t->free + i] - t->user[t->free + i];
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
  return finite;
}
