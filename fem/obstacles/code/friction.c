/* Coulomb's law at k nodes with m tangents each, see coulomb.py: Newton's method on the sets open, stick and slip, whose
   equations are solved by conjugate residuals from the factor of some earlier round. Rows of a node: its normal, then
   its tangents. */
#include "jolt.h"

static const double NEAR = 0.2, EXACT = 1e-14; /* by how much a round reduces its residual, in 3D and in 2D */
static const double SURELY = 1e-4, INEXACT = 0.5; /* of tol: what settling may change unseen, and the error of W^-1 */
static const double VAGUE = 1e-5, CLEAR = 10; /* error of a product in single precision, and how far above it a round goes on */

/* y = W x + q, or W (x - base) + q. */
static void evaluate(const Rub *f) {
  const int K = f->k * (1 + TANGENTS);
  for (int r = 0; f->based && r < K; r++) f->room[r] = f->x[r] - f->base[r];
  times_in_double(K, f->ld, f->W, f->based ? f->room : f->x, f->y);
  for (int r = 0; r < K; r++) f->y[r] += f->q[r];
}

/* Let q be y without forces. */
static void unbase(Rub *f) {
  const int K = f->k * (1 + TANGENTS);
  if (!f->based) return;
  times_in_double(K, f->ld, f->W, f->base, f->room);
  for (int r = 0; r < K; r++) f->q[r] -= f->room[r];
  f->based = 0;
}

/* Whether a node would meet without forces. */
static int meets(const Rub *f, int i) {
  const int K = f->k * (1 + TANGENTS), r = i * (1 + TANGENTS);
  return f->q[r] - (f->based ? dot(K, f->W + (size_t)r * f->ld, f->base) : 0) < 0;
}

/* New sets and directions from x and y; whether a set changed. */
static int classify(Rub *f) {
  const int s = 1 + TANGENTS;
  int changed = 0;
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s, *y = f->y + i * s, w = diagonal(f, i * s + 1);
    double *e = f->e + i * s, size = 0, against = 0;
    int kind = f->kind[i];
    if (kind == OPEN) {
      if (y[0] < -f->tol) kind = STICK;
    } else if (!(x[0] > 0)) {
      kind = OPEN;
    } else if (kind == STICK) {
      for (int a = 0; a < TANGENTS; a++) size += x[1 + a] * x[1 + a];
      size = sqrt(size);
      if (size > f->mu[i] * x[0]) {
        kind = SLIP;
        for (int a = 0; a < TANGENTS; a++) e[a] = x[1 + a] / size;
        e[TANGENTS] = f->mu[i] * x[0] / size;
      }
    } else {
      for (int a = 0; a < TANGENTS; a++) against += y[1 + a] * e[a];
      if (TANGENTS > 1) {
        double z[2];
        for (int a = 0; a < TANGENTS; a++) z[a] = x[1 + a] - y[1 + a] / w, size += z[a] * z[a];
        size = sqrt(size);
        if (size > 0)
          for (int a = 0; a < TANGENTS; a++) e[a] = z[a] / size;
        e[TANGENTS] = size > 0 ? fmin(1, f->mu[i] * x[0] / size) : 0;
      }
      /* without friction a node slips whatever its velocity */
      if (f->mu[i] > 0 && against > f->tol && (TANGENTS == 1 || size < f->mu[i] * x[0])) kind = STICK;
    }
    changed |= kind != f->kind[i];
    f->kind[i] = kind;
  }
  return changed;
}

/* y as the sets say, and x with it, where y is unknown; `all`: x from y alone. */
static void adapt(Rub *f, int all) {
  const int s = 1 + TANGENTS, K = f->k * s;
  double *u = f->room, *v = u + K;
  int some = all;
  for (int r = 0; r < K; r++) {
    const int kind = f->kind[r / s];
    u[r] = kind == STICK || (kind == SLIP && r % s == 0) ? -f->y[r] : 0;
    some |= u[r] != 0;
    f->y[r] += u[r];
    if (all) u[r] = f->y[r] - f->q[r];
  }
  if (!some) return;
  times(f, 1, u, v, NULL);
  for (int r = 0; r < K; r++) f->x[r] = (!all ? f->x[r] : f->based ? f->base[r] : 0) + v[r];
}

/* Whether slips are the unknowns, as W^-1 is there and few enough nodes are open; a change costs a factor. */
static int choose(const Rub *f) {
  int open = 0, pressed = 0;
  for (int i = 0; i < f->k; i++) {
    open += 2 * (f->kind[i] == OPEN);
    pressed += f->kind[i] == STICK ? 2 : f->kind[i] == SLIP;
  }
  return f->inverse && open <= (f->slips ? 2 : 1) * pressed;
}

/* Where rounds begin. HERE: as x and sets are; OPENED: nodes that would meet without forces stick; FIRST: besides, from
   forces or slips that continue those of the last two steps, if these had any. `known`: whether y is W x + q. */
void softgrasp_begin(Rub *f, int where, int known) {
  const int s = 1 + TANGENTS, K = f->k * s;
  const int had = f->had;
  f->begun = 0;
  f->vague = 0;
  if (where == FIRST) f->had = 0;
  for (int r = 0; where == FIRST && r < K; r++) f->had |= f->x[r] != 0;
  f->led = where == FIRST && had && f->had;
  for (int i = 0; where != HERE && !f->led && i < f->k; i++)
    if (f->kind[i] == OPEN && meets(f, i)) f->kind[i] = STICK;
  f->slips = choose(f);
  for (int r = 0; where == FIRST && r < K; r++) {
    const double x = f->x[r], y = f->y[r];
    if (f->led && f->slips) f->y[r] = 2 * y - f->before_y[r];
    else if (f->led) f->x[r] = f->kind[r / s] == OPEN ? 0 : 2 * x - f->before[r];
    f->before[r] = x, f->before_y[r] = y;
  }
  if (!known && !(f->led && f->slips)) evaluate(f);
  if (f->slips) adapt(f, f->led);
  if (f->led) classify(f);
}

/* Residual of the equations of the present sets into b; the largest. */
static double residual(const Rub *f, double *b) {
  const int s = 1 + TANGENTS;
  double most = 0;
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s, *y = f->y + i * s, *e = f->e + i * s, w = diagonal(f, i * s + 1);
    for (int a = 0; a < s; a++) {
      const int r = i * s + a;
      b[r] = f->kind[i] == OPEN                ? diagonal(f, r) * x[a]
             : a == 0 || f->kind[i] == STICK ? y[a]
                                               : w * (x[a] - f->mu[i] * x[0] * e[a - 1]);
      if (!(fabs(b[r]) <= most)) most = fabs(b[r]);
    }
  }
  return most;
}

/* What a set says of forces, exactly. */
static void settle(const Rub *f) {
  const int s = 1 + TANGENTS;
  for (int i = 0; i < f->k; i++) {
    double *x = f->x + i * s;
    for (int a = 0; a < s; a++)
      if (f->kind[i] == OPEN) x[a] = 0;
      else if (a > 0 && f->kind[i] == SLIP && TANGENTS == 1) x[a] = f->mu[i] * x[0] * f->e[i * s];
  }
}

static char side(const Rub *f, int i) {
  return (char)(f->kind[i] == SLIP && f->e[i * (1 + TANGENTS)] < 0 ? 3 : f->kind[i]);
}

/* Rows of the matrix of the present sets times u and v. */
static void rows_times(const Rub *f, const double *u, const double *v, double *to) {
  const int s = 1 + TANGENTS;
  double of_v[3], of_u[3];
  for (int i = 0; i < f->k; i++, u += s, v += s)
    for (int a = 0; a < width(f, f->slips, f->kind[i]); a++, to++) {
      row_of(f, f->slips, i, f->kind[i], f->e + i * s, a, of_v, of_u);
      *to = 0;
      for (int b = 0; b < s; b++) *to += of_v[b] * v[b] + of_u[b] * u[b];
    }
}

static void spread(const Rub *f, const double *c, double *u) {
  const int s = 1 + TANGENTS;
  for (int i = 0; i < f->k; i++) c += lengthen(f, f->slips, i, f->kind[i], f->e + i * s, c, u + i * s);
}

/* Changes of u that the present sets say into u; whether there are any. */
static int say(const Rub *f, double *u) {
  const int s = 1 + TANGENTS;
  int some = 0;
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s, *y = f->y + i * s, *e = f->e + i * s;
    double *own = u + i * s, along = f->mu[i] * x[0];
    for (int a = 0; a < s; a++) own[a] = 0;
    if (!f->slips && f->kind[i] == OPEN)
      for (int a = 0; a < s; a++) own[a] = -x[a];
    if (f->slips && f->kind[i] != OPEN) own[0] = -y[0];
    for (int a = 1; a < s; a++) along -= e[a - 1] * x[a];
    for (int a = 1; a < s; a++)
      if (f->slips && f->kind[i] == STICK) own[a] = -y[a];
      else if (!f->slips && f->kind[i] == SLIP) own[a] = along * e[a - 1];
    for (int a = 0; a < s; a++) some |= own[a] != 0;
  }
  return some;
}

/* A round: Newton's equations of the present sets, whose residual is in the room. */
static void begin_round(Rub *f) {
  const int s = 1 + TANGENTS, K = f->k * s;
  double *b = f->room, *u = b + K, *v = u + K, *to = f->lacks;
  const int some = say(f, u);
  if (some) times(f, 0, u, v, (float *)(v + K));
  else memset(v, 0, K * sizeof(double));
  memcpy(f->follows, v, K * sizeof(double));
  rows_times(f, u, v, f->solved);
  f->n = 0;
  for (int i = 0; i < f->k; i++) {
    const double *h = b + i * s, *e = f->e + i * s;
    const int count = width(f, f->slips, f->kind[i]);
    for (int a = 0; a < count; a++)
      to[a] = -(f->kind[i] != SLIP || (!f->slips && a == 0) ? h[a] : f->slips ? h[1 + a] : e[0] * h[2] - e[1] * h[1]);
    to += count;
    f->n += count;
  }
  for (int j = 0; j < f->n; j++) f->lacks[j] -= f->solved[j];
  memset(f->solved, 0, K * sizeof(double));
  f->left = sqrt(dot(f->n, f->lacks, f->lacks));
  f->target = fmax(TANGENTS > 1 ? NEAR * f->left : EXACT * f->left, 0.01 * f->tol);
  f->taken = 0;
  f->begun = 1;
}

/* Steps of generalized conjugate residuals [EES83] to the end of the round. WANTED: a factor that costs less than more
   steps from this one. */
static int descend(Rub *f) {
  const int K = f->k * (1 + TANGENTS), n = f->n, wide = f->single ? 4 : 8;
  double *u = f->room;
  double step = wide * (0.5 * n * K + (double)n * n) / READ, factor = CALL + 2.0 / 3 * n * n * n / FLOPS * wide / 4;
  if (little(f, n)) step += EACH, factor = 8.0 * n * K / READ + 2.0 / 3 * n * n * n / SLOWER;
  while (f->left > f->target && f->taken < KEPT) {
    if ((!f->rows || f->slips0 != f->slips || (f->age && f->work > factor && !fits(f))) && !(little(f, n) && softgrasp_matrix(f)))
      return WANTED;
    double *z = f->Z + (size_t)f->taken * K, *c = f->C + (size_t)f->taken * K, *v = f->V + (size_t)f->taken * K;
    f->work += step;
    f->age++;
    precondition(f, f->lacks, z);
    spread(f, z, u);
    times(f, 0, u, v, (float *)(u + K));
    rows_times(f, u, v, c);
    const double whole = dot(n, c, c);
    for (int j = 0; j < f->taken; j++) {
      const double *C = f->C + (size_t)j * K, *Z = f->Z + (size_t)j * K, *V = f->V + (size_t)j * K, t = dot(n, C, c);
      for (int r = 0; r < n; r++) c[r] -= t * C[r], z[r] -= t * Z[r];
      for (int r = 0; r < K; r++) v[r] -= t * V[r];
    }
    const double own = dot(n, c, c), size = sqrt(own), share = dot(n, c, f->lacks) / size;
    if (!(own > 1e-28 * whole)) break; /* rounding */
    for (int r = 0; r < n; r++) {
      c[r] /= size, z[r] /= size;
      f->lacks[r] -= share * c[r];
      f->solved[r] += share * z[r];
    }
    for (int r = 0; r < K; r++) f->follows[r] += share * (v[r] /= size);
    f->left = sqrt(dot(n, f->lacks, f->lacks));
    f->taken++;
  }
  return SOLVED;
}

static void end_round(Rub *f) {
  const int s = 1 + TANGENTS, K = f->k * s;
  double *u = f->room, *known = u + K, *own = f->slips ? f->y : f->x, *other = f->slips ? f->x : f->y, most = 0;
  say(f, known);
  spread(f, f->solved, u);
  f->begun = 0;
  for (int r = 0; r < K; r++) {
    own[r] += u[r] + known[r], other[r] += f->follows[r];
    most = fmax(most, fabs(f->follows[r]) * (f->slips ? diagonal(f, r) : 1));
  }
  if (f->slips ? f->inverse_low != 0 : f->low != 0) f->vague += VAGUE * most;
  if (f->slips) return;
  settle(f);
  if (!f->low) evaluate(f);
}

/* y or x, whichever follows, in double precision. */
static void clear(Rub *f) {
  if (f->slips) adapt(f, 1);
  else evaluate(f);
  f->vague = 0;
}

/* The largest number of what forces do. */
static double largest(const Rub *f) {
  double most = 0;
  for (int r = 0; r < f->k * (1 + TANGENTS); r++) most = fmax(most, fabs(f->y[r] - f->q[r]));
  return most;
}

/* Rounds from round `begin` on. WANTED: call softgrasp_matrix, factor LU, and call again with the round in tally[2]. */
int softgrasp_rub(Rub *f, int begin, int rounds) {
  double *b = f->room;
  for (int round = begin, drifts = 0;; round++) {
    if (!f->begun) {
      double left = round || f->led ? 0 : residual(f, b);
      int changed = 0;
      if (left <= f->tol) changed = classify(f), left = residual(f, b);
      if (f->vague && left <= fmax(f->tol, CLEAR * f->vague)) {
        clear(f);
        changed |= classify(f);
        left = residual(f, b);
      }
      if (!changed && left <= f->tol) {
        if (!f->slips) return SOLVED;
        settle(f);
        if (left <= SURELY * f->tol && f->sure * largest(f) <= INEXACT * f->tol) return SOLVED;
        evaluate(f);
        changed = classify(f);
        left = residual(f, b);
        if (!changed && left <= f->tol) return SOLVED;
        if (++drifts > DRIFTS) return DRIFTED;
      }
      if (!round || left < f->best / 2) f->best = left, f->since = round;
      if (!(left < INFINITY) || round >= rounds || (TANGENTS > 1 && round - f->since > PATIENCE)) return CYCLED;
      for (int p = 0; changed && TANGENTS == 1 && p < round; p++) {
        int same = 1;
        for (int i = 0; i < f->k && same; i++) same = f->seen[(size_t)p * f->k + i] == side(f, i);
        if (same) return CYCLED;
      }
      for (int i = 0; i < f->k; i++) f->seen[(size_t)round * f->k + i] = side(f, i);
      f->tally[0]++;
      begin_round(f);
    }
    f->tally[2] = round;
    if (descend(f) == WANTED) return WANTED;
    end_round(f);
  }
}

/* Sweeps of projected Gauss-Seidel over the nodes until forces change by less than `still` of the largest; sets. */
void softgrasp_sweep(Rub *f, int sweeps, double still) {
  const int s = 1 + TANGENTS, K = f->k * s;
  unbase(f);
  for (int i = 0; i < f->k; i++) {
    double *x = f->x + i * s;
    if (!(x[0] > 0)) memset(x, 0, s * sizeof(double));
    for (int a = 0; a < s; a++)
      if (!isfinite(x[a])) x[a] = 0;
  }
  for (int sweep = 0; sweep < sweeps; sweep++) {
    double most = 0, change = 0;
    f->tally[1]++;
    for (int i = 0; i < f->k; i++) {
      double *x = f->x + i * s, old[3], size = 0, w = 0;
      memcpy(old, x, s * sizeof(double));
      x[0] = fmax(0, x[0] - (f->q[i * s] + dot(K, f->W + (size_t)i * s * f->ld, f->x)) / diagonal(f, i * s));
      for (int a = 1; a < s; a++) w = fmax(w, diagonal(f, i * s + a));
      if (TANGENTS > 1) w += fabs(f->W[(size_t)(i * s + 1) * f->ld + i * s + 2]);
      double slip[2];
      for (int a = 1; a < s; a++) slip[a - 1] = f->q[i * s + a] + dot(K, f->W + (size_t)(i * s + a) * f->ld, f->x);
      for (int a = 1; a < s; a++) size += (x[a] -= slip[a - 1] / w) * x[a];
      size = sqrt(size);
      const double bound = f->mu[i] * x[0];
      if (size > bound)
        for (int a = 1; a < s; a++) x[a] *= bound / size;
      most = fmax(most, x[0]);
      for (int a = 0; a < s; a++) change = fmax(change, fabs(x[a] - old[a]));
    }
    if (change <= still * most) break;
  }
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s;
    double *e = f->e + i * s, size = 0;
    for (int a = 1; a < s; a++) size += x[a] * x[a];
    size = sqrt(size);
    f->kind[i] = !(x[0] > 0) ? OPEN : size < f->mu[i] * x[0] * (1 - 1e-9) ? STICK : SLIP;
    for (int a = 0; a < TANGENTS; a++) e[a] = size > 0 ? x[1 + a] / size : a == 0;
    e[TANGENTS] = 0;
  }
  evaluate(f);
  if (TANGENTS > 1) classify(f);
}

/* How far x is from the law, as a gap [m]. */
double softgrasp_wrong(Rub *f) {
  const int s = 1 + TANGENTS;
  double most = 0;
  evaluate(f);
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s, *y = f->y + i * s, n = diagonal(f, i * s), w = diagonal(f, i * s + 1);
    double z[2], size = 0, bound = f->mu[i] * fmax(x[0], 0);
    most = fmax(most, fabs(x[0] - fmax(0, x[0] - y[0] / n)) * n);
    for (int a = 0; a < TANGENTS; a++) z[a] = x[1 + a] - y[1 + a] / w, size += z[a] * z[a];
    size = sqrt(size);
    for (int a = 0; a < TANGENTS; a++) most = fmax(most, fabs(x[1 + a] - (size > bound ? z[a] * bound / size : z[a])) * w);
  }
  return most;
}
