#include "controller.h"

#include "controller_data.h"
#include "vector.h"

enum { N = SG_CONTROLLER_N, M = SG_CONTROLLER_INPUTS, TISSUE = N - 2 * M };

#if SG_CONTROLLER_OBSERVER || SG_CONTROLLER_PLAN
/* x becomes A x + B u + f. */
static void ahead(double x[N], const double u[M]) {
    double next[N];
    for (int i = 0; i < N; ++i) next[i] = LOAD[i];
    for (int j = 0; j < N; ++j) add(x[j], A[j], next, N);
    for (int j = 0; j < M; ++j) add(u[j], B[j], next, N);
    for (int i = 0; i < N; ++i) x[i] = next[i];
}
#endif

#if SG_CONTROLLER_PLAN
#include "plan_controller.h"

void sg_controller_interval(sg_controller *c, const double x[N], double u[M]) {
    begin_interval(&c->plan, c->ticks / SG_PLAN_EVERY, x);
    c->ticks += SG_PLAN_EVERY;
    for (int k = 0; k < SG_PLAN_EVERY; ++k) ahead(c->plan.nominal, c->plan.input);
    for (int i = 0; i < M; ++i) u[i] = c->plan.input[i];
}

void sg_controller_begin(double x[N]) {
    for (int i = 0; i < N; ++i) x[i] = PLAN_REST[i];
}

void sg_controller_ahead(double x[N], const double u[M]) { ahead(x, u); }

void sg_controller_samples(const double x[N], double *y) {
#if SG_CONTROLLER_OBSERVER
    double all[SG_CONTROLLER_SAMPLES] = {0};
    for (int j = 0; j < N; ++j) add(x[j], C[j], all, SG_CONTROLLER_SAMPLES);
    for (int i = 0; i < SG_CONTROLLER_OTHERS; ++i) y[i] = all[SG_CONTROLLER_HAND + i];
#else
    (void)x, (void)y;
#endif
}
#endif

/* Whether the squares of x and y add to a number. */
static int measured(const double *x, const double *y, int n) {
    double sum = 0;
    for (int i = 0; i < n; ++i) sum += x[i] * x[i] + y[i] * y[i];
    return defect(&sum, 1) == 0;
}

void sg_controller_start(sg_controller *controller) {
    static const sg_controller nothing;
    *controller = nothing;
    for (int i = 0; i < TISSUE; ++i) controller->x[2 * M + i] = REST[i];
#if SG_CONTROLLER_PLAN
    start_plan(&controller->plan);
#endif
}

/* u = clip(offset + K x), or what a plan asks for, made again only from a fresh x; 0 where it is not finite. */
static int command(sg_controller *c, const double x[N], int fresh, double u[M]) {
#if SG_CONTROLLER_PLAN
    follow_plan(&c->plan, c->ticks, x, fresh, u);
#else
    (void)c, (void)fresh;
    for (int i = 0; i < M; ++i) u[i] = OFFSET[i];
    for (int j = 0; j < N; ++j) add(x[j], K[j], u, M);
#endif
    if (defect(u, M) != 0) return 0;
#if SG_CONTROLLER_LIMITED
    for (int i = 0; i < M; ++i) u[i] = u[i] > LIMIT[i] ? LIMIT[i] : u[i] < -LIMIT[i] ? -LIMIT[i] : u[i];
#endif
    return 1;
}

#if SG_CONTROLLER_OBSERVER
enum { DELAY = SG_CONTROLLER_DELAY, HAND = SG_CONTROLLER_HAND, P = SG_CONTROLLER_SAMPLES };

/* x becomes x + M (s - C x), where samples that are not finite show nothing; returns their number. Where the result or
   its square is no number, none shows anything. */
static int correct(double x[N], const double *hand, const double *y) {
    double off[P] = {0}, before[N];
    int lost = 0;
    for (int i = 0; i < N; ++i) before[i] = x[i];
    for (int j = 0; j < N; ++j) add(-x[j], C[j], off, P);
    for (int i = 0; i < P; ++i) {
        double sample = i < HAND ? hand[i] : y ? y[i - HAND] : 0;
        if (defect(&sample, 1) != 0 || (i >= HAND && !y))
            off[i] = 0, ++lost;
        else
            off[i] += sample;
    }
    for (int j = 0; j < P; ++j) add(off[j], CORRECTION[j], x, N);
    if (!measured(x, x, N)) {
        for (int i = 0; i < N; ++i) x[i] = before[i];
        return P;
    }
    return lost;
}

/* The state now from the samples of a tick; returns how many were lost. */
static int estimate(sg_controller *c, const double *q, const double *v, const double *y, double x[N]) {
    double hand[HAND];
    for (int i = 0; i < HAND; ++i) hand[i] = i < M ? q[i] : v[i - M];
#if SG_CONTROLLER_DELAY
    int lost = 0;
    long first = c->ticks < DELAY ? DELAY - c->ticks : 0; /* there is no load before the first tick */
    for (int k = 0; k < DELAY; ++k)
        for (int i = 0; i < HAND; ++i) c->hand[k][i] = c->hand[k + 1][i];
    for (int i = 0; i < HAND; ++i) c->hand[DELAY][i] = hand[i];
    if (!first) {
        lost = correct(c->x, c->hand[0], y);
        ahead(c->x, c->loads[0]);
        first = 1;
    }
    for (int i = 0; i < N; ++i) x[i] = c->x[i];
    for (long k = first; k < DELAY; ++k) ahead(x, c->loads[k]);
#else
    int lost = correct(c->x, hand, y);
    for (int i = 0; i < N; ++i) x[i] = c->x[i];
#endif
    return lost;
}

/* The load that acts until the next tick. */
static void apply(sg_controller *c, const double u[M]) {
#if SG_CONTROLLER_DELAY
    for (int k = 0; k + 1 < DELAY; ++k)
        for (int i = 0; i < M; ++i) c->loads[k][i] = c->loads[k + 1][i];
    for (int i = 0; i < M; ++i) c->loads[DELAY - 1][i] = u[i];
#else
    ahead(c->x, u);
#endif
}
#else
/* The tissue a tick later, driven by the measured hand. */
static void carry(sg_controller *c, const double *q, const double *v) {
    double tissue[TISSUE + 1];
    if (c->ticks) {
        for (int i = 0; i < TISSUE; ++i) tissue[i] = CONSTANT[i];
        for (int j = 0; j < TISSUE; ++j) add(c->x[2 * M + j], STEP[j], tissue, TISSUE);
        for (int j = 0; j < M; ++j) add(v[j] - c->x[M + j], ACCELERATED[j], tissue, TISSUE);
#if SG_CONTROLLER_DRAGGED
        for (int j = 0; j < M; ++j) add(v[j] + c->x[M + j], DRAGGED[j], tissue, TISSUE);
#endif
        for (int i = 0; i < TISSUE; ++i) c->x[2 * M + i] = tissue[i];
    }
    for (int i = 0; i < M; ++i) c->x[i] = q[i], c->x[M + i] = v[i];
}
#endif

int sg_controller_tick(sg_controller *c, const double q[M], const double v[M], const double *y, double u[M]) {
    double load[M], x[N];
    int hand = measured(q, v, M), lost = 0;
    if (!c->ticks && !hand) return SG_CONTROLLER_NO_HAND;
#if SG_CONTROLLER_OBSERVER
    if (!c->ticks)
        for (int i = 0; i < M; ++i) c->x[i] = q[i], c->x[M + i] = v[i];
    lost = estimate(c, q, v, y, x);
#else
    (void)y;
    if (hand) carry(c, q, v);
    for (int i = 0; i < N; ++i) x[i] = c->x[i];
#endif
    int good = command(c, x, SG_CONTROLLER_OBSERVER || hand, load);
#if !SG_CONTROLLER_OBSERVER
    good = good && hand;
#endif
    if (good)
        for (int i = 0; i < M; ++i) c->u[i] = load[i];
#if SG_CONTROLLER_OBSERVER
    apply(c, c->u);
#endif
    ++c->ticks;
    c->lost += lost > 0;
    c->held += !good;
    for (int i = 0; i < M; ++i) u[i] = c->u[i];
    return !good ? SG_CONTROLLER_HELD : lost ? SG_CONTROLLER_LOST : SG_CONTROLLER_OK;
}

const char *sg_controller_message(int status) {
    switch (status) {
    case SG_CONTROLLER_OK: return "done";
    case SG_CONTROLLER_LOST: return "a sample is not a finite number; the load is that of the others";
    case SG_CONTROLLER_HELD: return "the hand was not measured; the load of the tick before is given again";
    case SG_CONTROLLER_NO_HAND: return "the first tick needs finite q and v; nothing has changed";
    default: return "no number of this controller";
    }
}
