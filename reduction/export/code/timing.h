/* Times of many repeats in order. */
#define _POSIX_C_SOURCE 200809L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static inline double now(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec; /* [us] */
}

static inline int order(const void *a, const void *b) {
    double difference = *(const double *)a - *(const double *)b;
    return (difference > 0) - (difference < 0);
}

static inline double quantile(double *times, long n, double share) {
    qsort(times, (size_t)n, sizeof *times, order);
    return times[(long)(share * (double)(n - 1))];
}
