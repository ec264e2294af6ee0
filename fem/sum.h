/* The sum of two numbers with what its rounding loses. */
#pragma once

/* a + b as rounded; what that loses into `lost` [Knuth97]. */
static inline __attribute__((always_inline)) double exact_sum(double a, double b, double *lost) {
  const double sum = a + b, share = sum - a;
  *lost = (a - (sum - share)) + (b - share);
  return sum;
}
