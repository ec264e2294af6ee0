/* Replays golden.log, which softgrasp wrote with its own controller, and tries bad samples: test_controller golden.log */
#include <string.h>

#include "controller.h"
#include "golden.h"
#include "vector.h"

enum { M = SG_CONTROLLER_INPUTS, Y = SG_CONTROLLER_OTHERS };

static sg_controller controller;

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
            for (int i = 0; i < M; ++i) {
                double difference = size(u[i] - golden[i]) / scale[i];
                if (!(difference <= worst)) worst = difference;
            }
            ++*ticks;
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
    return defect(u, M) == 0 && controller.ticks == 2 && counted >= now;
}

int main(int count, char **words) {
    FILE *log = count == 2 ? fopen(words[1], "r") : NULL;
    long ticks = 0;
    double tolerance = 0, worst = log ? replay(log, &ticks, &tolerance) : -1;
    if (log) fclose(log);
    if (worst < 0) return printf("name the golden.log beside this program; it must be whole\n"), 2;
    long lost = controller.lost, held = controller.held;
    int good = withstands();
    printf("%ld ticks: largest relative difference of a load %.1e, allowed %.0e; ", ticks, worst, tolerance);
    printf("%ld with lost samples, %ld held; bad samples %s\n", lost, held, good ? "withstood" : "NOT withstood");
    return !(worst <= tolerance && good && held == 0);
}
