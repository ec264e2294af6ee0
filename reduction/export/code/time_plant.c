/* Processor time of a tick and of a new material: medians of blocks, so that other programs count little. */
#include "timing.h" /* first: it asks for clocks */

#include "plant.h"

enum { BLOCKS = 1001, TICKS = 200, MATERIALS = 20 };

static sg_plant plant;
static double times[BLOCKS];

static double median(int repeats) { return quantile(times, BLOCKS, 0.5) / repeats; }

int main(void) {
    double u[SG_PLANT_INPUTS] = {0}, y[SG_PLANT_OUTPUTS], theta[SG_PLANT_THETA], sum = 0;
    sg_plant_start(&plant);
    for (int b = 0; b < BLOCKS; ++b) {
        double begin = now(CLOCK_THREAD_CPUTIME_ID);
        for (int i = 0; i < TICKS; ++i) {
            u[0] = (i & 1) ? -1 : 1;
            sg_plant_tick(&plant, u);
            sg_plant_outputs(&plant, y);
            sum += y[0];
        }
        times[b] = now(CLOCK_THREAD_CPUTIME_ID) - begin;
    }
    printf("N = %d: a tick takes %.3f us, ", SG_PLANT_N, median(TICKS));
    for (int b = 0; b < BLOCKS; ++b) {
        double begin = now(CLOCK_THREAD_CPUTIME_ID);
        for (int i = 0; i < MATERIALS; ++i) {
            for (int j = 0; j < SG_PLANT_THETA; ++j) theta[j] = plant.theta[j];
            theta[0] *= (i & 1) ? 1.1 : 1 / 1.1;
            sg_plant_material(&plant, theta);
        }
        times[b] = now(CLOCK_THREAD_CPUTIME_ID) - begin;
    }
    printf("a new material %.2f us (sum of outputs %g)\n", median(MATERIALS), sum);
    return 0;
}
