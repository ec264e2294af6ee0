/* A controller behind the interface of plant.h, so that fmi3.c serves it too: q, v and samples go in, the load comes
   out; no constants and no states for solvers. */
#ifndef SG_PLANT_H
#define SG_PLANT_H

#include "controller.h"

enum { SG_PLANT_OK, SG_PLANT_NO_HAND };
enum { SG_PLANT_INPUTS = 2 * SG_CONTROLLER_INPUTS + SG_CONTROLLER_OTHERS, SG_PLANT_OUTPUTS = SG_CONTROLLER_INPUTS };
enum { SG_PLANT_N = 1, SG_PLANT_THETA = 1 }; /* C knows no empty arrays */
#define SG_PLANT_TICK SG_CONTROLLER_PERIOD

typedef struct {
    sg_controller controller;
    double u[SG_PLANT_OUTPUTS], w[SG_PLANT_N], theta[SG_PLANT_THETA];
} sg_plant;

void sg_plant_start(sg_plant *plant);
int sg_plant_material(sg_plant *plant, const double theta[SG_PLANT_THETA]);
int sg_plant_tick(sg_plant *plant, const double seen[SG_PLANT_INPUTS]);
void sg_plant_outputs(const sg_plant *plant, double u[SG_PLANT_OUTPUTS]);
int sg_plant_rate(const sg_plant *plant, const double seen[SG_PLANT_INPUTS], double rate[SG_PLANT_N]);
const char *sg_plant_message(int status);

#endif
