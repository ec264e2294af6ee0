/* The step before half-spaces: gaps of all boundary nodes, forces of those that ever touched, what they do, and the impulse
   at its end. The small problem is that of pivots.h. */
#include "flat.h"

#include "pivots.h"
#include "sum.h"

static const double *along(const Flat *f, const int *row) {
  return f->along + (size_t)(row[0] * (1 + f->m) + row[3]) * f->d;
}

/* Gaps at the end of the step into `after` and `least`; the largest coordinate. */
double softgrasp_look(const Flat *f) {
  const int size = f->p * f->d, d = f->d;
  double most[4] = {0}, *x = f->places;
  memset(x, 0, size * sizeof(double));
  for (int k = 0; k < f->n_s; k++) {
    const double *T = f->modes + (size_t)k * size, q = f->q[k];
    for (int u = 0; u < size; u++) x[u] += T[u] * q;
  }
  if (f->whole)
    for (int u = 0; u < size; u++) f->moved[u] = f->w[f->at[u]];
  for (int u = 0; u < size; u++) {
    x[u] = f->X[u] + (f->z[u] + (2 * f->moved[u] + f->low[u]) + x[u]);
    if (fabs(x[u]) > most[u % 4]) most[u % 4] = fabs(x[u]);
  }
  for (int o = 0; o < f->obstacles; o++) {
    const double *n = f->along + (size_t)o * (1 + f->m) * d;
    double *to = f->after + (size_t)o * f->p, least = INFINITY;
    for (int i = 0; i < f->p; i++) {
      double g = -f->level[o];
      for (int a = 0; a < d; a++) g += n[a] * x[i * d + a];
      to[i] = g;
      if (!isnan(least) && !(g >= least)) least = g; /* so that what is no number is the least */
    }
    f->least[o] = least;
  }
  return fmax(fmax(most[0], most[1]), fmax(most[2], most[3]));
}

/* Half the gap of a row at the end of the step, or half its slip in the step. */
static double value(const Flat *f, int j) {
  const int *row = f->row + 4 * j;
  if (row[3] == 0) return f->after[(size_t)row[0] * f->p + row[1]] / 2;
  const double *t = along(f, row);
  double slip = 0;
  for (int a = 0; a < f->d; a++) {
    const int u = row[1] * f->d + a;
    double way = 2 * f->moved[u] - f->slide[row[0] * f->d + a];
    for (int k = 0; k < f->n_s; k++) way += f->T[(size_t)u * f->n_s + k] * (f->q[k] - f->q0[k]);
    slip += t[a] * way;
  }
  return slip / 2;
}

/* Pairs without a row that end deeper than tol; the largest gap of pressed rows into `reached`. */
static int missing(const Flat *f, double tol, double *reached) {
  int count = 0;
  for (int i = 0; i < f->obstacles * f->p; i++) count += f->after[i] < -tol && !f->entered[i];
  *reached = 0;
  for (int j = 0; j < f->k; j += 1 + f->m)
    if (f->x[j] > 0) *reached = fmax(*reached, fabs(f->after[(size_t)f->row[4 * j] * f->p + f->row[4 * j + 1]]));
  return count;
}

/* Half gaps and slips of the rows at the end of the step that is in w. */
void softgrasp_values(const Flat *f, double *to) {
  for (int j = 0; j < f->k; j++) to[j] = value(f, j);
}

/* Half gaps and slips of the rows without their forces, from those with them. */
void softgrasp_refresh(const Flat *f) {
  softgrasp_values(f, f->free);
  for (int j = 0; j < f->k; j++) f->free[j] -= dot(f->k, f->W + (size_t)j * f->ld, f->x);
}

/* Right-hand side of the small problem from the end of a step without forces. */
static void begin(const Flat *f) {
  softgrasp_values(f, f->free);
  memset(f->x, 0, f->k * sizeof(double));
}

static void add_to_r(const Flat *f, int j, double t) {
  const int *row = f->row + 4 * j;
  for (int a = 0; a < f->d; a++) {
    int at = f->at[row[1] * f->d + a];
    if (at >= 0) f->r[at] += t * along(f, row)[a];
  }
}

/* The same right-hand side from the first sweep of a step without forces; whether a row has a negative gap. */
static int foresee(const Flat *f) {
  int negative = 0;
  memset(f->x, 0, f->k * sizeof(double));
  softgrasp_scale(f->swept, f->swept->y);
  for (int k = 0; k < f->count_columns; k++) f->change[k] = softgrasp_times(f->swept, k);
  for (int j = 0; j < f->k; j++) {
    const int *row = f->row + 4 * j, o = row[0];
    const double *e = along(f, row);
    double way = row[3] == 0 ? -f->level[o] : 0;
    for (int a = 0; a < f->d; a++) {
      const int u = row[1] * f->d + a;
      double x = row[3] == 0 ? f->X[u] + f->z[u] : -f->slide[o * f->d + a];
      for (int k = 0; k < f->n_s; k++) x += f->T[(size_t)u * f->n_s + k] * (f->q[k] - (row[3] == 0 ? 0 : f->q0[k]));
      way += e[a] * x;
    }
    f->free[j] = way / 2 + f->change[row[2]];
    negative |= row[3] == 0 && f->free[j] < 0;
  }
  return negative;
}

/* Take forces x instead of those before into r; by how much they change into `change`. Returns how many do. */
static int take(const Flat *f, const double *x) {
  int changes = 0;
  memset(f->change, 0, f->count_columns * sizeof(double));
  for (int j = 0; j < f->k; j++) {
    double more = x[j] - f->x[j];
    f->x[j] = x[j];
    if (more == 0) continue;
    changes++;
    add_to_r(f, j, more);
    f->change[f->row[4 * j + 2]] += more;
  }
  return changes;
}

/* Take these changes into w, four columns in a pass, or into y. */
static void apply(const Flat *f) {
  for (int k = 0; f->swept && k < f->count_columns; k++)
    if (f->change[k] != 0) softgrasp_add(f->swept, k, f->change[k], f->swept->y);
  if (f->swept) return;
  const double *c[4];
  double t[4];
  int m = 0;
  for (int k = 0; k <= f->count_columns; k++) {
    if (k < f->count_columns && f->change[k] != 0) {
      c[m] = f->columns + (size_t)k * f->n;
      t[m++] = f->change[k];
    }
    if (m == 4)
      for (int i = 0; i < f->n; i++) f->w[i] += (t[0] * c[0][i] + t[1] * c[1][i]) + (t[2] * c[2][i] + t[3] * c[3][i]);
    else if (k == f->count_columns)
      for (; m > 0; m--)
        for (int i = 0; i < f->n; i++) f->w[i] += t[m - 1] * c[m - 1][i];
    if (m == 4) m = 0;
  }
}

/* Tables of step n: force and number of pressed nodes of each half-space, T'N'x, and energies. */
static void account(Flat *f, int n) {
  double *force = f->force + (size_t)n * f->obstacles * f->d, *touching = f->touching + (size_t)n * f->obstacles;
  double *hand = f->hand + (size_t)n * f->n_s, energy[4] = {0}; /* of the step, or rounding of the sums would add up */
  f->rubbed = 0;
  for (int j = 0; j < f->k; j++) {
    const int *row = f->row + 4 * j, o = row[0], i = row[1];
    if (!(f->x[j - row[3]] > 0)) continue;
    const double *e = along(f, row);
    if (row[3] == 0) touching[o] += 1;
    for (int a = 0; a < f->d; a++) {
      double x = f->x[j] * e[a];
      force[o * f->d + a] += x;
      for (int k = 0; k < f->n_s; k++) hand[k] += f->T[(size_t)(i * f->d + a) * f->n_s + k] * x;
      energy[0] += 2 * x * f->moved[i * f->d + a];
    }
    const double rubbed = row[3] == 0 ? 0 : f->x[j] * 2 * value(f, j);
    if (row[3] == 0) energy[1] += f->x[j] * f->gap[(size_t)o * f->p + i];
    energy[3] -= rubbed;
    if (row[3] != 0 && f->kind[j / (1 + f->m)] == 2) f->rubbed += rubbed;
  }
  for (int k = 0; k < 4; k++) f->energy[k] += energy[k];
}

/* Carry the boundary on to the end of step n; r takes N'x once more, as it takes G c. */
static void carry(const Flat *f, int n) {
  for (int u = 0; u < f->p * f->d; u++) f->z[u] = exact_sum(f->z[u], 2 * f->moved[u] + f->low[u], f->low + u);
  memcpy(f->gap, f->after, sizeof(double) * f->obstacles * f->p);
  memcpy(f->gaps + (size_t)(n + 1) * f->obstacles, f->least, sizeof(double) * f->obstacles);
  for (int j = 0; f->pressed && j < f->k; j++)
    if (f->x[j] != 0) add_to_r(f, j, f->x[j]);
}

/* Count rows whose touching takes back in step n its change in the step before; rows that never met do not touch. */
static void count_back(const Flat *f, int n) {
  for (int j = 0; j < f->k; j += 1 + f->m) {
    const int *row = f->row + 4 * j, on = f->pressed && f->x[j] > 0;
    char *lately = f->lately + (size_t)row[0] * f->p + row[1];
    const int changes = on != (*lately & 1);
    f->chattering[(size_t)n * f->obstacles + row[0]] += changes && *lately & 2;
    *lately = on | changes << 1;
  }
}

/* Let a hand that feels the tissue feel the forces that the step has taken in. */
static void push(const Flat *f, int n) {
  double a[MODES] = {0}, b[MODES] = {0};
  const int m = f->n_s;
  for (int k = 0; k < f->count_columns; k++)
    if (f->change[k] != 0)
      for (int i = 0; i < m; i++) b[i] += f->B[(size_t)k * m + i] * f->change[k];
  for (int i = 0; i < m; i++) a[i] = dot(m, f->inverse + i * m, b);
  for (int i = 0; i < m; i++) {
    const double c = f->kappa * a[i], *Y = f->Y + (size_t)i * f->n, *G = f->G + (size_t)i * f->n;
    double *w = f->swept ? f->swept->y : f->w;
    for (int u = 0; u < f->n; u++) w[u] -= Y[u] * c;
    for (int u = 0; u < f->n; u++) f->r[u] -= G[u] * c;
    f->cs[(size_t)n * m + i] -= c;
    f->vs[(size_t)(n + 1) * m + i] += f->dt * a[i];
    f->qs[(size_t)(n + 1) * m + i] += f->dt * f->dt / 2 * a[i];
  }
}

/* The step n from where it is on: it says what it needs before it goes on from there, or that it is done. */
int softgrasp_step(Flat *f, int n) {
  double reached;
  for (;;) switch (f->stage) {
      case BEGIN:
        f->q0 = f->qs + (size_t)n * f->n_s;
        f->q = f->q0 + f->n_s;
        f->stage = UNTOUCHED;
        f->round = f->pressed = 0;
        if (f->ahead) {
          f->tol = f->rounding * (f->largest + f->extent);
          f->pressed = foresee(f);
          if (!f->pressed) return SWEEP;
          f->stage = ROWS;
          break;
        }
        if (!f->whole) return TAKE;
        break;
      case UNTOUCHED:
        f->tol = f->rounding * ((f->largest = softgrasp_look(f)) + f->extent);
        for (int o = 0; o < f->obstacles; o++) f->pressed |= f->least[o] < 0;
        if (!f->pressed) return DONE;
        begin(f);
        f->stage = ROWS;
        f->depth = 0;
        if (missing(f, 0, &reached)) return ENTER;
        break;
      case ROWS:
        f->stage = FORCES;
        if (!f->compiled) return BALANCE;
        if (softgrasp_complement(f->k, f->ld, f->W, f->free, f->tol / 4, f->most_each * f->k, f->count, f->order, f->L,
                                 f->to, f->side, f->room, f->tally))
          return UNSOLVED;
        break;
      case FORCES:
        f->stage = TAKEN;
        if ((double)take(f, f->to) * f->n > f->entries && !f->swept) return SOLVE;
        apply(f);
        break;
      case TAKEN:
        if (f->feels) push(f, n);
        f->stage = AFTER;
        if (f->swept) return SWEEP;
        if (!f->whole) return TAKE;
        break;
      default:
        f->largest = softgrasp_look(f);
        f->stage = ROWS;
        f->depth = f->tol;
        const int more = missing(f, f->tol, &reached);
        if (!more && reached <= f->tol) return account(f, n), DONE;
        f->reached = reached;
        if (++f->round == f->most) return UNSETTLED;
        if (more) return ENTER;
        softgrasp_refresh(f); /* what rounding left */
    }
}

/* Carry step n on; whether rows are to stop that are pressed. v: velocities on the rows here, or 0: they are in f->v. */
int softgrasp_finish(Flat *f, int n, const double *v) {
  double most = 0;
  carry(f, n);
  count_back(f, n);
  if (!f->pressed) return 0;
  const double *qdot = f->vs + (size_t)(n + 1) * f->n_s;
  for (int u = 0; v && u < f->p * f->d; u++) f->v[u] = v[f->rows[u]];
  for (int j = 0; j < f->k; j++) {
    const int *row = f->row + 4 * j, o = row[0], i = row[1];
    if (!(f->x[j - row[3]] > 0)) continue;
    double b = 0;
    for (int a = 0; a < f->d; a++) {
      const int u = i * f->d + a;
      double speed = f->v[u] - f->rate[o * f->d + a];
      for (int k = 0; k < f->n_s; k++) speed += f->T[(size_t)u * f->n_s + k] * qdot[k];
      f->fastest = fmax(f->fastest, fabs(speed));
      b -= along(f, row)[a] * speed;
    }
    f->b[j] = b;
    if (row[3] == 0 || f->kind[j / (1 + f->m)] == 1) most = fmax(most, fabs(b));
  }
  f->still = fmax(f->at_rest * f->fastest, f->s * f->tol);
  return most > f->still;
}

/* Impulses y of the pressed rows at the end of step n: tables, momentum, hand, and what is to be solved for the jump of the
   velocities v on the rows here. Returns the number of axes that it has. */
int softgrasp_strike(Flat *f, int n, double *v) {
  const int d = f->d, m = f->n_s, own = f->feels;
  double *impulse = f->impulse + (size_t)n * f->obstacles * d, *force = f->force + (size_t)n * f->obstacles * d;
  double *kick = f->kick + (size_t)n * m, a[MODES] = {0}, b[MODES] = {0}, wrench[MODES] = {0}, work = 0;
  int last = -1;
  f->ways = 1;
  for (int j = 0; j < f->k; j++) {
    if (f->y[j] == 0) continue;
    const double *e = along(f, f->row + 4 * j);
    if (last >= 0 && f->only != e) f->ways = d;
    f->only = e;
    last = j;
  }
  memset(f->given, 0, sizeof(double) * f->ways * f->nodes);
  for (int j = 0; j <= last; j++) {
    if (f->y[j] == 0) continue;
    const int *row = f->row + 4 * j, o = row[0];
    const double *e = along(f, row), *S = f->starts + (size_t)row[1] * d * m;
    for (int i = 0; own && i < m; i++) b[i] += f->reach[(size_t)j * m + i] * f->y[j];
    for (int c = 0; c < f->ways; c++) {
      const double t = f->ways == 1 ? f->y[j] : f->y[j] * e[c];
      double *to = f->given + (size_t)c * f->nodes;
      if (!f->mass) to[f->column[j]] += t;
      else if (t != 0) softgrasp_add(f->mass, f->column[j], t, to);
    }
    for (int c = 0; c < d; c++) {
      const int u = row[1] * d + c;
      const double y = f->y[j] * e[c];
      impulse[o * d + c] += y;
      force[o * d + c] += y / f->dt;
      work += y * f->v[u];
      for (int i = 0; i < m; i++) {
        wrench[i] += f->T[(size_t)u * m + i] * y;
        kick[i] += S[c * m + i] * y;
      }
    }
    work += f->y[j] * f->b[j] / 2; /* A y = b */
    add_to_r(f, j, f->s * f->y[j]);
  }
  for (int i = 0; own && i < m; i++) {
    a[i] = dot(m, f->H + i * m, b);
    f->vs[(size_t)(n + 1) * m + i] += a[i];
    const double *G = f->G + (size_t)i * f->n, *X = f->X_hand + (size_t)i * f->here;
    for (int u = 0; u < f->n; u++) f->r[u] -= f->s * a[i] * G[u];
    for (int u = 0; u < f->here; u++) v[u] -= X[u] * a[i];
    work -= wrench[i] * a[i] / 2;
  }
  for (int i = 0; i < m; i++) {
    if (own) kick[i] -= dot(m, f->GX + i * m, a);
    f->hand[(size_t)n * m + i] += wrench[i] / f->dt;
    if (own) work -= a[i] * (f->pulled[i] + kick[i] / 2);
  }
  f->energy[0] += work;
  return f->ways;
}

/* Add the jump that was found to the velocities v on the rows here. */
void softgrasp_jump(const Flat *f, double *v) {
  const int d = f->d;
  for (int c = 0; c < d; c++) {
    const double *u = f->found + (f->ways == 1 ? 0 : (size_t)c * f->nodes), t = f->ways == 1 ? f->only[c] : 1;
    for (int k = 0; t != 0 && k < f->here / d; k++) v[k * d + c] += t * u[f->place[k]];
  }
}

/* The inelastic impulse y at the end of a step. Factor and set of pressed rows are kept; where a pivot of A is small, a
   ridge makes equal rows share their impulse. ENTER: rows lack their columns. */
int softgrasp_stop(Flat *f) {
  int count = 0, same = 1;
  double taken = 0, *b = f->room, *y = f->room + f->ld;
  for (int j = 0; j < f->k; j++) {
    if (!(f->x[j] > 0)) continue;
    if (j >= f->struck) return ENTER;
    f->side[count++] = j;
  }
  same = count == f->stopping;
  for (int i = 0; same && i < count; i++) same = f->side[i] == f->stopped[i];
  for (double ridge = 0; !same; ridge = ridge > 0 ? 100 * ridge : RIDGE) {
    f->ridged = ridge > 0;
    same = 1;
    for (f->stopping = 0; same && f->stopping < count;) {
      const int row = f->side[f->stopping];
      const size_t at = (size_t)f->stopping * (f->ld + 1);
      same = append(f->ld, f->A, &f->stopping, f->stopped, f->LA, row, ridge);
      if (same && !f->ridged) same = f->LA[at] * f->LA[at] > SURE * f->A[(size_t)row * (f->ld + 1)];
    }
  }
  for (int i = 0; i < count; i++) y[i] = f->b[f->stopped[i]];
  solve(f->ld, count, f->LA, y);
  memset(f->y, 0, f->k * sizeof(double));
  for (int i = 0; i < count; i++) f->y[f->stopped[i]] = y[i];
  for (int i = 0; f->ridged && i < count; i++) /* without the ridge's error */
    b[i] = f->b[f->stopped[i]] - dot(f->k, f->A + (size_t)f->stopped[i] * f->ld, f->y);
  if (f->ridged) solve(f->ld, count, f->LA, b);
  for (int i = 0; i < count; i++) {
    if (f->ridged) f->y[f->stopped[i]] += b[i];
    taken += f->y[f->stopped[i]] * f->b[f->stopped[i]] / 2;
  }
  f->energy[2] += taken;
  return DONE;
}
