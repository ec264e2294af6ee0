/* The load on the hand from tick to tick: u = clip(u_bar + K (x - x_bar)), x the hand and the tissue as a model or an
   observer carries it.

   C99. No allocation, no input or output, no function of the C library. The caller owns the memory:

       static sg_controller controller;
       sg_controller_start(&controller);
       every SG_CONTROLLER_PERIOD seconds: status = sg_controller_tick(&controller, q, v, y, u);

   Sizes, and the names and units of q, v, y and u, are in controller_size.h. */
#ifndef SG_CONTROLLER_H
#define SG_CONTROLLER_H

#include "controller_size.h"

enum { SG_CONTROLLER_OK, SG_CONTROLLER_LOST, SG_CONTROLLER_HELD, SG_CONTROLLER_NO_HAND };

typedef struct {
    double x[SG_CONTROLLER_N];  /* [q, v, tissue]; with an observer the estimate before the samples of its time */
    double u[SG_CONTROLLER_INPUTS];
    long ticks;
    long lost;                  /* ticks with samples that were no finite numbers */
    long held;                  /* ticks at which the load of the tick before was given again */
#if SG_CONTROLLER_DELAY
    double hand[SG_CONTROLLER_DELAY + 1][SG_CONTROLLER_HAND]; /* samples of the hand, the latest last */
    double loads[SG_CONTROLLER_DELAY][SG_CONTROLLER_INPUTS];  /* since the samples that come now */
#endif
} sg_controller;

/* The tissue hangs at rest; the hand is measured at the first tick. */
void sg_controller_start(sg_controller *controller);

/* One tick. y: samples of the observer beside the hand's; NULL where all are lost, or where there is no observer.

   OK: u is the load. LOST: some samples were not finite; u is the load without them. HELD: the hand was not measured
   and the load of the last tick is given again, or the load was not finite. NO_HAND: the first tick needs a measured
   hand; u is not written and nothing has changed. */
int sg_controller_tick(sg_controller *controller, const double q[SG_CONTROLLER_INPUTS],
                       const double v[SG_CONTROLLER_INPUTS], const double *y, double u[SG_CONTROLLER_INPUTS]);

/* What a number means, in one sentence. */
const char *sg_controller_message(int status);

#endif
