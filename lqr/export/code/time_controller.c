/* Time of a tick: a million, each by itself, with samples of a hand that moves. */
#include "timing.h" /* first: it asks for clocks */

#include "controller.h"

enum { TICKS = 1000000, M = SG_CONTROLLER_INPUTS, Y = SG_CONTROLLER_OTHERS };

static sg_controller controller;
static double times[TICKS];

#if SG_CONTROLLER_PLAN
enum { INTERVALS = SG_PLAN_INTERVALS + 10, MOST = TICKS / SG_PLAN_EVERY + 1 };
static double plans[MOST];

static double noise(double largest) {
    static unsigned long state = 1;
    state = state * 1103515245UL + 12345UL;
    return largest * ((double)(state >> 8 & 1023) / 512 - 1);
}

/* The controller's own plant under it, with noise of the hand, from the start of the plan again and again. */
int main(void) {
    double x[SG_CONTROLLER_N], y[Y + 1] = {0}, q[M], v[M], u[M], begin;
    long outcomes[3] = {0}, limited = 0, held = 0, count = 0, ticks = 0;
    for (long k = 0; k < TICKS; ++k) {
        if (k % ((long)INTERVALS * SG_PLAN_EVERY) == 0) {
            for (int i = 0; i < 3; ++i) outcomes[i] += controller.plan.outcomes[i];
            limited += controller.plan.limited, held += controller.held;
            sg_controller_start(&controller);
            sg_controller_begin(x);
        }
        for (int i = 0; i < M; ++i) q[i] = x[i] + noise(SG_TIME_POSE), v[i] = x[M + i] + noise(SG_TIME_POSE);
        sg_controller_samples(x, y);
        for (int i = 0; i < Y; ++i) y[i] += noise(SG_TIME_SAMPLE);
        int plans_now = controller.ticks % SG_PLAN_EVERY == 0;
        begin = now(CLOCK_THREAD_CPUTIME_ID);
        sg_controller_tick(&controller, q, v, y, u);
        double took = now(CLOCK_THREAD_CPUTIME_ID) - begin;
        if (plans_now)
            plans[count++] = took;
        else
            times[ticks++] = took;
        sg_controller_ahead(x, u);
    }
    for (int i = 0; i < 3; ++i) outcomes[i] += controller.plan.outcomes[i];
    limited += controller.plan.limited, held += controller.held;
    printf("N = %d, %d variables, %d to %d rows: a tick with a plan takes %.0f us in the median, 99 %% of them %.0f us, all "
           "%.0f us; ", SG_CONTROLLER_N, SG_PLAN_VARIABLES, SG_PLAN_FEWEST, SG_PLAN_LARGEST, quantile(plans, count, 0.5),
           quantile(plans, count, 0.99), quantile(plans, count, 1.0));
    printf("the others %.2f, %.2f and %.0f us\n", quantile(times, ticks, 0.5), quantile(times, ticks, 0.99),
           quantile(times, ticks, 1.0));
    printf("%ld plans: %ld new, %ld kept, %ld soft, %ld at the limit of steps; %ld held\n", count, outcomes[0],
           outcomes[1], outcomes[2], limited, held);
    return limited || held;
}
#else
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
#endif
