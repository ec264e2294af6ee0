/* Replays golden.log, which softgrasp wrote with its own steps, and tries what must be refused: test_plant golden.log */
#include <string.h>

#include "golden.h"
#include "plant.h"
#include "vector.h"

static sg_plant plant;

/* Largest difference of an output over the largest value of its unit; -1 if the log is not whole. */
static double replay(FILE *log, long *ticks, double *tolerance) {
    double scale[SG_PLANT_OUTPUTS] = {0}, y[SG_PLANT_OUTPUTS], golden[SG_PLANT_OUTPUTS], worst = 0;
    double u[SG_PLANT_INPUTS], theta[SG_PLANT_THETA];
    char word[16];
    while (fscanf(log, "%15s", word) == 1) {
        int status = SG_PLANT_OK;
        if (!strcmp(word, "tolerance")) {
            if (!numbers(log, tolerance, 1)) return -1;
        } else if (!strcmp(word, "scale")) {
            if (!numbers(log, scale, SG_PLANT_OUTPUTS)) return -1;
        } else if (!strcmp(word, "start")) {
            sg_plant_start(&plant);
        } else if (!strcmp(word, "material")) {
            if (!numbers(log, theta, SG_PLANT_THETA)) return -1;
            status = sg_plant_material(&plant, theta);
        } else if (!strcmp(word, "tick")) {
            if (!numbers(log, u, SG_PLANT_INPUTS) || !numbers(log, golden, SG_PLANT_OUTPUTS)) return -1;
            status = sg_plant_tick(&plant, u);
            sg_plant_outputs(&plant, y);
            worst = larger(worst, y, golden, scale, SG_PLANT_OUTPUTS);
            ++*ticks;
        } else {
            return -1;
        }
        if (status != SG_PLANT_OK) return printf("%s\n", sg_plant_message(status)), -1;
    }
    return *ticks ? worst : -1;
}

/* Whether what is no number and no material changes nothing. */
static int refuses(void) {
    double zero = 0, u[SG_PLANT_INPUTS] = {0}, theta[SG_PLANT_THETA];
    sg_plant before = plant;
    u[SG_PLANT_INPUTS - 1] = zero / zero;
    if (sg_plant_tick(&plant, u) != SG_PLANT_NOT_FINITE) return 0;
    for (int i = 0; i < SG_PLANT_THETA; ++i) theta[i] = plant.theta[i];
    theta[0] = -theta[0];
    if (sg_plant_material(&plant, theta) != SG_PLANT_MATERIAL) return 0;
    theta[0] = 1 / zero;
    if (sg_plant_material(&plant, theta) != SG_PLANT_NOT_FINITE) return 0;
    return !memcmp(&before, &plant, sizeof plant);
}

int main(int count, char **words) {
    long ticks = 0;
    double tolerance = 0, worst = replayed(count, words, replay, &ticks, &tolerance);
    if (worst < 0) return 2;
    int refused = refuses();
    printf("%ld ticks: largest relative difference of an output %.1e, allowed %.0e; ", ticks, worst, tolerance);
    printf("bad inputs %s\n", refused ? "refused" : "NOT refused");
    return !(worst <= tolerance && refused);
}
