/* Time of a tick: a million, each by itself, with samples of a hand that moves. */
#include "timing.h" /* first: it asks for clocks */

#include "controller.h"

enum { TICKS = 1000000, M = SG_CONTROLLER_INPUTS, Y = SG_CONTROLLER_OTHERS };

static sg_controller controller;
static double times[TICKS];

int main(void) {
    double q[M] = {0}, v[M] = {0}, y[Y + 1] = {0}, u[M], sum = 0;
    unsigned long state = 1;
    sg_controller_start(&controller);
    for (long k = 0; k < TICKS; ++k) {
        for (int i = 0; i < M; ++i) {
            state = state * 1103515245UL + 12345UL;
            v[i] = 0.99 * v[i] + 1e-3 * ((double)(state >> 8 & 1023) / 512 - 1);
            q[i] = 0.99 * q[i] + SG_CONTROLLER_PERIOD * v[i];
        }
        for (int i = 0; i < Y; ++i) y[i] = q[i % M];
        double begin = now(CLOCK_MONOTONIC);
        sg_controller_tick(&controller, q, v, y, u);
        times[k] = now(CLOCK_MONOTONIC) - begin;
        sum += u[0];
    }
    printf("N = %d: a tick takes %.2f us in the median, 99 %% of them %.2f us, 99.9 %% %.2f us, all %.0f us; ",
           SG_CONTROLLER_N, quantile(times, TICKS, 0.5), quantile(times, TICKS, 0.99), quantile(times, TICKS, 0.999),
           quantile(times, TICKS, 1.0));
    printf("%ld held (sum of loads %g)\n", controller.held, sum);
    return 0;
}
