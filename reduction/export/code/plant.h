/* Hand and tissue from tick to tick: midpoint steps of E(theta) w' = A(theta) w + B u + f, y = C w.

   C99. No allocation, no input or output, no function of the C library. The caller owns the memory:

       static sg_plant plant;
       sg_plant_start(&plant);
       for (;;) { status = sg_plant_tick(&plant, u); sg_plant_outputs(&plant, y); }

   Sizes, and the names and units of u, y and theta, are in plant_size.h. */
#ifndef SG_PLANT_H
#define SG_PLANT_H

#include "plant_size.h"

enum { SG_PLANT_OK, SG_PLANT_NOT_FINITE, SG_PLANT_MATERIAL, SG_PLANT_SINGULAR, SG_PLANT_DIVERGED };

typedef struct {
    double w[SG_PLANT_N];                 /* state in energy coordinates */
    double A[SG_PLANT_N][SG_PLANT_N];     /* of the material, column by column */
    double step[SG_PLANT_N][SG_PLANT_N];  /* triangles of E - tick/2 A */
    int pivot[SG_PLANT_N];                /* rows that changed places in them */
#if SG_PLANT_VISCOUS_E
    double E[SG_PLANT_N][SG_PLANT_N];     /* triangles of E, which depends on the material */
    int pivot_E[SG_PLANT_N];
#endif
    double theta[SG_PLANT_THETA];         /* mu, lambda [Pa], beta [s] of every layer */
} sg_plant;

/* All functions but start return one of the numbers above; unless it is 0, nothing has changed. */

/* At rest with the hand at its origin (under gravity where the scene has it), with the material of the scene. */
void sg_plant_start(sg_plant *plant);

/* Another material from here on; the state stays. Some microseconds. */
int sg_plant_material(sg_plant *plant, const double theta[SG_PLANT_THETA]);

/* Advance by SG_PLANT_TICK under the load u, held over the tick. */
int sg_plant_tick(sg_plant *plant, const double u[SG_PLANT_INPUTS]);

/* y of the state. */
void sg_plant_outputs(const sg_plant *plant, double y[SG_PLANT_OUTPUTS]);

/* w' of the state under the load u, for solvers with steps of their own. */
int sg_plant_rate(const sg_plant *plant, const double u[SG_PLANT_INPUTS], double rate[SG_PLANT_N]);

/* What a number means, in one sentence. */
const char *sg_plant_message(int status);

#endif
