/* The load on the hand from tick to tick: u = clip(u_bar + K (x - x_bar)), x the hand and the tissue as a model or an
   observer carries it; with a plan past obstacles u = clip(u_nom + K (x - x_nom)).

   C99. No allocation, no input or output, no function of the C library. The caller owns the memory:

       static sg_controller controller;
       sg_controller_start(&controller);
       every SG_CONTROLLER_PERIOD seconds: status = sg_controller_tick(&controller, q, v, y, u);

   Sizes, and the names and units of q, v, y and u, are in controller_size.h. */
#ifndef SG_CONTROLLER_H
#define SG_CONTROLLER_H

#include "controller_size.h"

enum { SG_CONTROLLER_OK, SG_CONTROLLER_LOST, SG_CONTROLLER_HELD, SG_CONTROLLER_NO_HAND };

#if SG_CONTROLLER_PLAN
enum { SG_PLAN_NEW, SG_PLAN_KEPT, SG_PLAN_SOFT };

/* The plan, made again at the first tick of every SG_PLAN_EVERY: NEW from the estimate, certain to keep every gap and
   limit; KEPT, the last one goes on, which is too (so it does where the hand was not measured at that tick and there is
   no observer); SOFT, after a push, not certain, gaps have a price. */
typedef struct {
    double x[SG_PLAN_N], now[SG_PLAN_VARIABLES]; /* state of the plan at the next interval, its deviations from there */
    double nominal[SG_CONTROLLER_N], input[SG_CONTROLLER_INPUTS];
    long outcomes[3]; /* intervals that began with NEW, KEPT, SOFT */
    long limited;     /* programs that took more than SG_PLAN_STEPS changes of the active set; the last plan went on */
    int steps;        /* changes in the last program */
    int warm[SG_PLAN_VARIABLES + SG_PLAN_SLACKS], warm_count; /* rows to begin the next program with */
    double coefficients[SG_PLAN_VARIABLES][SG_PLAN_ROWS], size[SG_PLAN_ROWS], bend[SG_PLAN_ROWS]; /* of all rows, made at the
                                                                                                start */
    int first[SG_PLAN_INTERVALS], offset[SG_PLAN_INTERVALS + 1], count;       /* the program at hand */
    short at[SG_PLAN_LARGEST];
    double h[SG_PLAN_LARGEST], violation[SG_PLAN_LARGEST];
    double looked[SG_PLAN_VARIABLES], most[SG_PLAN_INTERVALS]; /* c at which all rows were looked at, what was found */
    int whole;                                                 /* whether it is the last c */
    int row[SG_PLAN_VARIABLES + SG_PLAN_SLACKS]; /* its active set: rows, triangle, basis, right-hand sides */
    double R[SG_PLAN_VARIABLES + SG_PLAN_SLACKS][SG_PLAN_VARIABLES + SG_PLAN_SLACKS];
    double Q[SG_PLAN_VARIABLES + SG_PLAN_SLACKS][SG_PLAN_VARIABLES + SG_PLAN_SLACKS];
    double right[SG_PLAN_VARIABLES + SG_PLAN_SLACKS], multiplier[SG_PLAN_VARIABLES + SG_PLAN_SLACKS];
    double c[SG_PLAN_VARIABLES + SG_PLAN_SLACKS];
} sg_plan;
#endif

typedef struct {
    double x[SG_CONTROLLER_N];  /* [q, v, tissue]; with an observer the estimate before the samples of its time */
    double u[SG_CONTROLLER_INPUTS];
    long ticks;
    long lost;                  /* ticks with samples that were no finite numbers */
    long held;                  /* ticks at which the load of the tick before was given again */
#if SG_CONTROLLER_PLAN
    sg_plan plan;
#endif
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

#if SG_CONTROLLER_PLAN
/* An interval at once, from the state x instead of samples; u is the load of its plan. For tests. */
void sg_controller_interval(sg_controller *controller, const double x[SG_CONTROLLER_N], double u[SG_CONTROLLER_INPUTS]);

/* The controller's own plant: the state where the plan begins, a tick later, and its samples. For tests. */
void sg_controller_begin(double x[SG_CONTROLLER_N]);
void sg_controller_ahead(double x[SG_CONTROLLER_N], const double u[SG_CONTROLLER_INPUTS]);
void sg_controller_samples(const double x[SG_CONTROLLER_N], double *y);
#endif

/* What a number means, in one sentence. */
const char *sg_controller_message(int status);

#endif
