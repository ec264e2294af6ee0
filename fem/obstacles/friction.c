/* Coulomb's law at k nodes with m tangents each, see coulomb.py: Newton's method on the sets open, stick and slip, whose
   factor stays while few rows of its matrix change. Rows of a node: its normal, then its tangents. */
#include "rub.h"

/* Gaussian elimination with pivots of a small matrix by rows; b becomes the solution. */
static void eliminate(int n, double *A, int ld, double *b) {
  for (int j = 0; j < n; j++) {
    int p = j;
    for (int i = j + 1; i < n; i++)
      if (fabs(A[i * ld + j]) > fabs(A[p * ld + j])) p = i;
    if (p != j) {
      double t = b[p];
      b[p] = b[j];
      b[j] = t;
      for (int c = 0; c < n; c++) {
        t = A[p * ld + c];
        A[p * ld + c] = A[j * ld + c];
        A[j * ld + c] = t;
      }
    }
    for (int i = j + 1; i < n; i++) {
      const double t = A[i * ld + j] / A[j * ld + j];
      for (int c = j; c < n; c++) A[i * ld + c] -= t * A[j * ld + c];
      b[i] -= t * b[j];
    }
  }
  for (int j = n - 1; j >= 0; j--) {
    for (int c = j + 1; c < n; c++) b[j] -= A[j * ld + c] * b[c];
    b[j] /= A[j * ld + j];
  }
}

/* Rows of the matrix that are not those of the factor; 0 where they are too many. */
static int compare(Rub *f) {
  const int s = 1 + f->m, K = f->k * s;
  int count = 0;
  for (int i = 0; i < f->k; i++)
    for (int a = 0; a < s; a++) {
      const int one = f->kind[i], two = f->kind0[i];
      int differs = a == 0 ? (one == OPEN) != (two == OPEN) : one != two;
      if (a > 0 && f->m == 1 && one == SLIP && two == SLIP) differs = f->e[i * s] != f->e0[i * s];
      if (!differs) continue;
      if (count == f->most) return 0;
      const int r = i * s + a;
      int j = count;
      while (j < f->count && f->other[j] != r) j++;
      if (j < f->count) { /* its unit is solved for already: move it here */
        for (int c = 0; c < K && j != count; c++) {
          const double t = f->Z[(size_t)j * K + c];
          f->Z[(size_t)j * K + c] = f->Z[(size_t)count * K + c];
          f->Z[(size_t)count * K + c] = t;
        }
        f->other[j] = f->other[count];
      } else {
        if (count < f->count) { /* keep the one that was here, if there is room */
          if (f->count < f->most) {
            memcpy(f->Z + (size_t)f->count * K, f->Z + (size_t)count * K, K * sizeof(double));
            f->other[f->count++] = f->other[count];
          }
        } else {
          f->count++;
        }
        double *z = f->Z + (size_t)count * K;
        memset(z, 0, K * sizeof(double));
        z[r] = 1;
        back(f, z);
      }
      f->other[count] = r;
      double *v = f->V + (size_t)count * K;
      row_of(f, i, a, two, f->e0 + i * s, f->room);
      row_of(f, i, a, one, f->e + i * s, v);
      for (int c = 0; c < K; c++) v[c] -= f->room[c];
      count++;
    }
  return 1 + count;
}

/* The units of the rows that are not those of the factor, solved for anew. */
void softgrasp_units(Rub *f) {
  for (int j = 0; j < f->count; j++) {
    double *z = f->Z + (size_t)j * f->rows;
    memset(z, 0, f->rows * sizeof(double));
    z[f->other[j]] = 1;
    back(f, z);
  }
}

/* b <- J^-1 b for the matrix of the present sets, with `count` rows that are not those of the factor. */
static void solve(Rub *f, int count, double *b, double *t) {
  const int K = f->rows;
  back(f, b);
  if (!count) return;
  for (int i = 0; i < count; i++) {
    const double *v = f->V + (size_t)i * K;
    for (int j = 0; j < count; j++) f->C[i * f->most + j] = (i == j) + dot(K, v, f->Z + (size_t)j * K);
    t[i] = dot(K, v, b);
  }
  eliminate(count, f->C, f->most, t);
  for (int i = 0; i < count; i++)
    for (int c = 0; c < K; c++) b[c] -= t[i] * f->Z[(size_t)i * K + c];
}

/* y = W x + q; W is larger than the caches, so that only its lower half is read. */
static void evaluate(const Rub *f) {
  const int K = f->k * (1 + f->m);
  const double *x = f->x;
  double *restrict y = f->y;
  memcpy(y, f->q, K * sizeof(double));
  for (int r = 0; r < K; r++) {
    const double *w = f->W + (size_t)r * f->ld, t = x[r];
    double s[8] = {0};
    int j = 0;
    for (; j + 8 <= r; j += 8)
      for (int l = 0; l < 8; l++) {
        s[l] += w[j + l] * x[j + l];
        y[j + l] += w[j + l] * t;
      }
    for (; j < r; j++) {
      s[0] += w[j] * x[j];
      y[j] += w[j] * t;
    }
    y[r] += w[r] * t + (((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7])));
  }
}

/* New sets and directions from x and y; whether a set changed. */
static int classify(Rub *f) {
  const int s = 1 + f->m;
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
      for (int a = 0; a < f->m; a++) size += x[1 + a] * x[1 + a];
      size = sqrt(size);
      if (size > f->mu[i] * x[0]) {
        kind = SLIP;
        for (int a = 0; a < f->m; a++) e[a] = x[1 + a] / size;
        e[f->m] = f->mu[i] * x[0] / size;
      }
    } else {
      for (int a = 0; a < f->m; a++) against += y[1 + a] * e[a];
      if (f->m > 1) {
        double z[2];
        for (int a = 0; a < f->m; a++) size += (z[a] = x[1 + a] - y[1 + a] / w) * z[a];
        size = sqrt(size);
        if (size > 0)
          for (int a = 0; a < f->m; a++) e[a] = z[a] / size;
        e[f->m] = size > 0 ? fmin(1, f->mu[i] * x[0] / size) : 0;
      }
      /* without friction a node slips whatever its velocity */
      if (f->mu[i] > 0 && against > f->tol && (f->m == 1 || size < f->mu[i] * x[0])) kind = STICK;
    }
    changed |= kind != f->kind[i];
    f->kind[i] = kind;
  }
  return changed;
}

/* Forces that continue those of the last two steps, with their sets and directions; those of the last step into `before`. */
void softgrasp_lead(Rub *f) {
  const int s = 1 + f->m, K = f->k * s;
  for (int r = 0; r < K; r++) {
    const double x = f->x[r];
    f->x[r] = f->kind[r / s] == OPEN ? 0 : 2 * x - f->before[r];
    f->before[r] = x;
  }
  evaluate(f);
  classify(f);
}

/* Residual of the equations of the present sets into b; the largest. */
static double residual(const Rub *f, double *b) {
  const int s = 1 + f->m;
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

static char side(const Rub *f, int i) {
  return (char)(f->kind[i] == SLIP && f->e[i * (1 + f->m)] < 0 ? 3 : f->kind[i]);
}

/* Step b of the method from that of the kept factor, with the last `taken` steps, since which no set has changed: Broyden's
   update [Broyden65] by the steps alone. They are in `past`, and b is put behind them. */
static void accelerate(const Rub *f, int taken, double *b) {
  const int K = f->rows;
  double *last = f->past + (size_t)taken * K;
  for (int j = 0; j < taken; j++) {
    const double *s = f->past + (size_t)j * K, *next = s + K, share = dot(K, s, b) / dot(K, s, s);
    if (j + 1 < taken)
      for (int r = 0; r < K; r++) b[r] += share * next[r];
    else if (fabs(share) < 0.9)
      for (int r = 0; r < K; r++) b[r] /= 1 - share;
  }
  memcpy(last, b, K * sizeof(double));
}

/* Rounds from round `begin` on. WANTED: call softgrasp_matrix, factor LU, and call again with the round in tally[2]. */
int softgrasp_rub(Rub *f, int begin, int rounds) {
  const int s = 1 + f->m, K = f->k * s;
  int slow = 0;
  double *b = f->room + K, *t = b + K, last = INFINITY;
  evaluate(f);
  for (int round = begin, taken = 0; round < rounds; round++) {
    int count = f->rows == K ? compare(f) : 0;
    f->tally[2] = round;
    if (!count) return WANTED;
    f->tally[0]++;
    for (int i = 0; i < f->k; i++) f->seen[(size_t)round * f->k + i] = side(f, i);
    residual(f, b);
    solve(f, count - 1, b, t);
    for (int r = 0; r < K; r++) b[r] = -b[r];
    if (f->m > 1) accelerate(f, taken, b);
    for (int r = 0; r < K; r++) f->x[r] += b[r];
    for (int i = 0; i < f->k; i++) { /* what a set says, exactly */
      double *x = f->x + i * s;
      for (int a = 0; a < s; a++)
        if (f->kind[i] == OPEN) x[a] = 0;
        else if (a > 0 && f->kind[i] == SLIP && f->m == 1) x[a] = f->mu[i] * x[0] * f->e[i * s];
    }
    evaluate(f);
    const int changed = classify(f);
    const double left = residual(f, b);
    if (!changed && left <= f->tol) return SOLVED;
    if (!(left < INFINITY)) return CYCLED;
    if (changed && f->m == 1)
      for (int p = 0; p <= round; p++) {
        int same = 1;
        for (int i = 0; i < f->k && same; i++)
          same = f->seen[(size_t)p * f->k + i] == side(f, i);
        if (same) return CYCLED;
      }
    taken = changed ? 0 : taken + 1;
    slow = (f->m > 1 || !changed) && left > SLOW * last ? slow + 1 : 0;
    if (slow == LATE || taken == PAST) f->rows = slow = 0; /* directions have turned: factor anew */
    last = f->m == 1 && changed ? INFINITY : left;
  }
  return CYCLED;
}

/* Sweeps of projected Gauss-Seidel over the nodes until forces change by less than `still` of the largest; sets. */
void softgrasp_sweep(Rub *f, int sweeps, double still) {
  const int s = 1 + f->m, K = f->k * s;
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
      if (f->m > 1) w += fabs(f->W[(size_t)(i * s + 1) * f->ld + i * s + 2]);
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
    for (int a = 0; a < f->m; a++) e[a] = size > 0 ? x[1 + a] / size : a == 0;
    e[f->m] = 0;
  }
  evaluate(f);
  if (f->m > 1) classify(f);
}

/* How far x is from the law, as a gap [m]. */
double softgrasp_wrong(Rub *f) {
  const int s = 1 + f->m;
  double most = 0;
  evaluate(f);
  for (int i = 0; i < f->k; i++) {
    const double *x = f->x + i * s, *y = f->y + i * s, n = diagonal(f, i * s), w = diagonal(f, i * s + 1);
    double z[2], size = 0, bound = f->mu[i] * fmax(x[0], 0);
    most = fmax(most, fabs(x[0] - fmax(0, x[0] - y[0] / n)) * n);
    for (int a = 0; a < f->m; a++) size += (z[a] = x[1 + a] - y[1 + a] / w) * z[a];
    size = sqrt(size);
    for (int a = 0; a < f->m; a++) most = fmax(most, fabs(x[1 + a] - (size > bound ? z[a] * bound / size : z[a])) * w);
  }
  return most;
}
