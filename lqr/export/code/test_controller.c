/* Replays golden.log, which softgrasp wrote with its own controller, and tries bad samples: test_controller golden.log */
#include <string.h>

#include "controller.h"
#include "golden.h"
#include "vector.h"

enum { M = SG_CONTROLLER_INPUTS, Y = SG_CONTROLLER_OTHERS };

static sg_controller controller;
static long intervals, others; /* plans that were made, counts of their outcomes that differ */

/* Largest difference of a load over the largest one of its unit; -1 if the log is not whole. */
static double replay(FILE *log, long *ticks, double *tolerance) {
    double scale[M] = {0}, q[M], v[M], y[Y + 1], u[M] = {0}, golden[M], worst = 0;
    char word[16];
    while (fscanf(log, "%15s", word) == 1) {
        if (!strcmp(word, "tolerance")) {
            if (!numbers(log, tolerance, 1)) return -1;
        } else if (!strcmp(word, "scale")) {
            if (!numbers(log, scale, M)) return -1;
        } else if (!strcmp(word, "start")) {
            sg_controller_start(&controller);
        } else if (!strcmp(word, "tick")) {
            if (!numbers(log, q, M) || !numbers(log, v, M) || !numbers(log, y, Y) || !numbers(log, golden, M)) return -1;
            int status = sg_controller_tick(&controller, q, v, y, u);
            if (status > SG_CONTROLLER_LOST) return printf("%s\n", sg_controller_message(status)), -1;
            worst = larger(worst, u, golden, scale, M);
            ++*ticks;
#if SG_CONTROLLER_PLAN
        } else if (!strcmp(word, "interval")) {
            double x[SG_CONTROLLER_N];
            if (!numbers(log, x, SG_CONTROLLER_N) || !numbers(log, golden, M)) return -1;
            sg_controller_interval(&controller, x, u);
            for (int i = 0; i < M; ++i) {
                double difference = size(u[i] - golden[i]) / scale[i];
                if (!(difference <= worst)) worst = difference;
            }
            ++intervals;
        } else if (!strcmp(word, "outcomes")) { /* of the plans of these intervals */
            double outcomes[3];
            if (!numbers(log, outcomes, 3)) return -1;
            for (int i = 0; i < 3; ++i) others += controller.plan.outcomes[i] != (long)outcomes[i];
            others += controller.plan.limited != 0;
#endif
        } else {
            return -1;
        }
    }
    return *ticks ? worst : -1;
}

/* Whether a hand that is not measured is counted and never ends the loop. */
static int withstands(void) {
    double zero = 0, q[M] = {0}, v[M] = {0}, last[M], u[M] = {0};
    sg_controller_start(&controller);
    q[0] = zero / zero;
    if (sg_controller_tick(&controller, q, v, NULL, u) != SG_CONTROLLER_NO_HAND || controller.ticks) return 0;
    q[0] = 0;
    if (sg_controller_tick(&controller, q, v, NULL, last) > SG_CONTROLLER_LOST) return 0;
    long before = controller.lost + controller.held;
    q[0] = zero / zero;
    int status = sg_controller_tick(&controller, q, v, NULL, u);
    if (SG_CONTROLLER_OBSERVER ? status != SG_CONTROLLER_LOST && SG_CONTROLLER_DELAY == 0
                               : status != SG_CONTROLLER_HELD || memcmp(u, last, sizeof u))
        return 0;
    long counted = controller.lost + controller.held - before; /* with a delay a lost sample counts when it is used */
    int now = !SG_CONTROLLER_OBSERVER || SG_CONTROLLER_DELAY == 0;
    if (defect(u, M) != 0 || controller.ticks != 2 || counted < now) return 0;
#if SG_CONTROLLER_PLAN && !SG_CONTROLLER_OBSERVER
    double x[SG_CONTROLLER_N];
    sg_controller_start(&controller);
    sg_controller_begin(x);
    for (int k = 0; k < SG_PLAN_EVERY; ++k) { /* no plan begins from the state of a tick before */
        sg_controller_tick(&controller, x, x + M, NULL, u);
        sg_controller_ahead(x, u);
    }
    long old = controller.plan.outcomes[SG_PLAN_KEPT];
    if (sg_controller_tick(&controller, q, v, NULL, u) != SG_CONTROLLER_HELD) return 0;
    if (controller.plan.outcomes[SG_PLAN_KEPT] != old + 1 || defect(u, M) != 0) return 0;
#endif
    sg_controller_start(&controller); /* numbers whose squares are none leave nothing behind */
    q[0] = 0;
    sg_controller_tick(&controller, q, v, NULL, u);
    q[0] = 1e308, v[0] = -1e308;
    for (int k = 0; k < 40; ++k) sg_controller_tick(&controller, q, v, NULL, u);
    q[0] = v[0] = 0;
    for (int k = 0; k < 40; ++k) status = sg_controller_tick(&controller, q, v, NULL, u);
    if (status > SG_CONTROLLER_LOST || defect(u, M) != 0 || defect(controller.x, SG_CONTROLLER_N) != 0) return 0;
    return 1;
}

int main(int count, char **words) {
    long ticks = 0;
    double tolerance = 0, worst = replayed(count, words, replay, &ticks, &tolerance);
    if (worst < 0) return 2;
    long lost = controller.lost, held = controller.held;
    int good = withstands();
    printf("%ld ticks: largest relative difference of a load %.1e, allowed %.0e; ", ticks, worst, tolerance);
    printf("%ld with lost samples, %ld held; bad samples %s\n", lost, held, good ? "withstood" : "NOT withstood");
    if (intervals) printf("%ld plans, their outcomes %s\n", intervals, others ? "differ" : "the same");
    return others || !(worst <= tolerance && good && held == 0);
}
