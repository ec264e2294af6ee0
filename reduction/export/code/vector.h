/* What the exported programs do with vectors. */
#ifndef SG_VECTOR_H
#define SG_VECTOR_H

#ifdef __FAST_MATH__
#error "compile without -ffast-math: it removes the tests for numbers that are not finite"
#endif

static inline double size(double x) { return x < 0 ? -x : x; }

/* 0 for finite numbers, else not a number */
static inline double defect(const double *x, int n) {
    double sum = 0;
    for (int i = 0; i < n; ++i) sum += 0 * x[i];
    return sum;
}

static inline void add(double factor, const double *restrict x, double *restrict y, int n) {
    for (int i = 0; i < n; ++i) y[i] += factor * x[i];
}

#endif
