/* Numbers of a log in hexadecimal. */
#ifndef SG_GOLDEN_H
#define SG_GOLDEN_H

#include <stdio.h>

static inline int numbers(FILE *log, double *x, int n) {
    for (int i = 0; i < n; ++i)
        if (fscanf(log, "%la", x + i) != 1) return 0;
    return 1;
}

#endif
