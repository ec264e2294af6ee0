/* Processor time of a tick and of a new material: medians of blocks, so that other programs count little. */
#define _POSIX_C_SOURCE 200809L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "plant.h"

enum { BLOCKS = 1001, TICKS = 200, MATERIALS = 20 };

static sg_plant plant;
static double seconds[BLOCKS];

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int order(const void *a, const void *b) {
    double difference = *(const double *)a - *(const double *)b;
    return (difference > 0) - (difference < 0);
}

static double median(int repeats) {
    qsort(seconds, BLOCKS, sizeof *seconds, order);
    return 1e6 * seconds[BLOCKS / 2] / repeats;
}

int main(void) {
    double u[SG_PLANT_INPUTS] = {0}, y[SG_PLANT_OUTPUTS], theta[SG_PLANT_THETA], sum = 0;
    sg_plant_start(&plant);
    for (int b = 0; b < BLOCKS; ++b) {
        double begin = now();
        for (int i = 0; i < TICKS; ++i) {
            u[0] = (i & 1) ? -1 : 1;
            sg_plant_tick(&plant, u);
            sg_plant_outputs(&plant, y);
            sum += y[0];
        }
        seconds[b] = now() - begin;
    }
    printf("N = %d: a tick takes %.3f us, ", SG_PLANT_N, median(TICKS));
    for (int b = 0; b < BLOCKS; ++b) {
        double begin = now();
        for (int i = 0; i < MATERIALS; ++i) {
            for (int j = 0; j < SG_PLANT_THETA; ++j) theta[j] = plant.theta[j];
            theta[0] *= (i & 1) ? 1.1 : 1 / 1.1;
            sg_plant_material(&plant, theta);
        }
        seconds[b] = now() - begin;
    }
    printf("a new material %.2f us (sum of outputs %g)\n", median(MATERIALS), sum);
    return 0;
}
