/* What the compiled halves of contact share. RIDGE: share of the diagonal that makes equal rows share their force; it
   comes from Python, see compiled.py. */
#pragma once
#include <math.h>
#include <stddef.h>
#include <string.h>

static inline double dot(int n, const double *a, const double *b) {
  double s[8] = {0, 0, 0, 0, 0, 0, 0, 0}, r = 0;
  int i = 0;
  for (; i + 8 <= n; i += 8)
    for (int k = 0; k < 8; k++) s[k] += a[i + k] * b[i + k];
  for (; i < n; i++) r += a[i] * b[i];
  return r + ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
}
