/* A log of hexadecimal numbers and its replay. */
#ifndef SG_GOLDEN_H
#define SG_GOLDEN_H

#include <stdio.h>

static inline int numbers(FILE *log, double *x, int n) {
    for (int i = 0; i < n; ++i)
        if (fscanf(log, "%la", x + i) != 1) return 0;
    return 1;
}

/* The larger of worst and |x - golden| / scale; not a number once one of them is none. */
static inline double larger(double worst, const double *x, const double *golden, const double *scale, int n) {
    for (int i = 0; i < n; ++i) {
        double difference = (x[i] > golden[i] ? x[i] - golden[i] : golden[i] - x[i]) / scale[i];
        if (!(difference <= worst)) worst = difference;
    }
    return worst;
}

/* Largest difference in the log that the command line names; -1 and a sentence if there is none or it is not whole. */
static inline double replayed(int count, char **words, double (*replay)(FILE *, long *, double *), long *ticks,
                              double *tolerance) {
    FILE *log = count == 2 ? fopen(words[1], "r") : NULL;
    double worst = log ? replay(log, ticks, tolerance) : -1;
    if (log) fclose(log);
    if (worst < 0) printf("name the golden.log beside this program; it must be whole\n");
    return worst;
}

#endif
