/* Impulses with friction at the end of a step before half-spaces, see fem/run/contact/friction.py. `step` has the forces of
   all rows, `jolt` the impulses p = dt x + y of the pressed ones, from x, velocities and slips of the step. */
#pragma once
#include "flat.h"
#include "rub.h"

/* Whether the pressed rows are these. */
int softgrasp_stays(const void *flat, const int *rows, int count) {
  const Flat *f = flat;
  int found = 0;
  for (int j = 0; j < f->k; j++) {
    if (!(f->x[j - f->row[4 * j + 3]] > 0)) continue;
    if (found == count || rows[found] != j) return 0;
    found++;
  }
  return found == count;
}

/* Velocity of a row before the impulse, but along the tangents of a slipping node that of the step. */
static double before(const Flat *f, const Rub *step, int j) {
  const int s = 1 + TANGENTS;
  return j % s && step->kind[j / s] == SLIP ? 2 / f->dt * step->y[j] : -f->b[j];
}

/* The problem of the impulses on these rows from p = dt x, under which velocities are what they were. */
void softgrasp_jolt(const void *flat, const Rub *step, const int *rows, Rub *jolt) {
  const Flat *f = flat;
  const int K = jolt->k * (1 + TANGENTS);
  for (int r = 0; r < K; r++) {
    jolt->x[r] = jolt->base[r] = f->dt * f->x[rows[r]];
    jolt->y[r] = jolt->q[r] = before(f, step, rows[r]);
  }
  jolt->based = 1;
}

/* The impulses y that were found, the velocities A y that they stop, into b, and the energy that they take; where friction
   would not dissipate energy in the step, y = 0 and false. */
int softgrasp_jolted(const void *flat, const Rub *step, const int *rows, const Rub *jolt) {
  const Flat *f = flat;
  const int s = 1 + TANGENTS, K = jolt->k * s;
  double taken[2] = {0, 0};
  memset(f->y, 0, f->k * sizeof(double));
  for (int r = 0; r < K; r++) {
    const int j = rows[r];
    f->y[j] = jolt->x[r] - f->dt * f->x[j];
    taken[r % s > 0] += f->y[j] * (f->b[j] - (jolt->y[r] - before(f, step, j)) / 2);
  }
  if (taken[1] - f->rubbed < 0) {
    memset(f->y, 0, f->k * sizeof(double));
    return 0;
  }
  for (int r = 0; r < K; r++) f->b[rows[r]] = jolt->y[r] - before(f, step, rows[r]);
  f->energy[2] += taken[0];
  f->energy[3] += taken[1];
  return 1;
}
