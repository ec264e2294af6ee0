/* plant.h behind the functions of FMI 3.0, for co-simulation (whole ticks) and model exchange (w'). */
#include <stdlib.h>
#include <string.h>

#include "fmi3.h"
#include "plant.h"
#include "token.h"

#ifdef _WIN32
#define FMI3(type) __declspec(dllexport) type
#else
#define FMI3(type) type
#endif

/* value references: the time, then from these numbers on inputs, outputs, constants, states, and their rates */
enum { TIME = 0, INPUT = 1000, OUTPUT = 2000, CONSTANT = 3000, STATE = 4000, RATE = 5000 };

static const double WHOLE = 1e-6; /* of a tick: rounding of the times of an importer */

typedef struct {
    sg_plant plant;
    double u[SG_PLANT_INPUTS], theta[SG_PLANT_THETA], time; /* theta may differ from the plant's until it is needed */
} state;

typedef struct {
    state now;
    int exchange;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} instance;

static fmi3Status fail(const instance *it, const char *message) {
    if (it->log) it->log(it->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

static fmi3Status check(const instance *it, int status) {
    return status == SG_PLANT_OK ? fmi3OK : fail(it, sg_plant_message(status));
}

static int finite_number(double x) { return x - x == 0; }

/* Take over constants that were set. */
static fmi3Status settle(instance *it) {
    if (!memcmp(it->now.theta, it->now.plant.theta, sizeof it->now.theta)) return fmi3OK;
    return check(it, sg_plant_material(&it->now.plant, it->now.theta));
}

static void start(instance *it) {
    memset(&it->now, 0, sizeof it->now);
    sg_plant_start(&it->now.plant);
    memcpy(it->now.theta, it->now.plant.theta, sizeof it->now.theta);
}

static fmi3Instance make(fmi3String token, int exchange, fmi3InstanceEnvironment environment,
                         fmi3LogMessageCallback log) {
    instance *it = token && !strcmp(token, TOKEN) ? malloc(sizeof *it) : NULL;
    if (it) {
        it->exchange = exchange, it->environment = environment, it->log = log;
        start(it);
    } else if (log) {
        log(environment, fmi3Error, "logStatusError",
            "no instance: the token is not that of modelDescription.xml, or the memory is full");
    }
    return it;
}

FMI3(fmi3Instance)
fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                            fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                            const fmi3ValueReference wanted[], size_t count, fmi3InstanceEnvironment environment,
                            fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name, (void)path, (void)visible, (void)logging, (void)events, (void)early;
    (void)wanted, (void)count, (void)update;
    return make(token, 0, environment, log);
}

FMI3(fmi3Instance)
fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                             fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)name, (void)path, (void)visible, (void)logging;
    return make(token, 1, environment, log);
}

FMI3(void) fmi3FreeInstance(fmi3Instance c) { free(c); }
FMI3(const char *) fmi3GetVersion(void) { return "3.0"; }

FMI3(fmi3Status) fmi3Reset(fmi3Instance c) {
    start(c);
    return fmi3OK;
}

FMI3(fmi3Status)
fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerant, fmi3Float64 tolerance, fmi3Float64 begin,
                            fmi3Boolean ends, fmi3Float64 end) {
    (void)tolerant, (void)tolerance, (void)ends, (void)end;
    if (!finite_number(begin)) return fail(c, "the start time is not a finite number");
    ((instance *)c)->now.time = begin;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3ExitInitializationMode(fmi3Instance c) { return settle(c); }

/* The place of a number that may be set, or NULL. */
static double *place(state *s, fmi3ValueReference r) {
    if (r >= INPUT && r < INPUT + SG_PLANT_INPUTS) return s->u + (r - INPUT);
    if (r >= CONSTANT && r < CONSTANT + SG_PLANT_THETA) return s->theta + (r - CONSTANT);
    if (r >= STATE && r < STATE + SG_PLANT_N) return s->plant.w + (r - STATE);
    return NULL;
}

FMI3(fmi3Status)
fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3Float64 values[],
               size_t count) {
    instance *it = c;
    if (count != n) return fail(it, "as many values as references are needed");
    for (size_t i = 0; i < n; ++i) {
        if (!finite_number(values[i])) return fail(it, "a value is not a finite number; nothing has changed");
        if (!place(&it->now, references[i])) return fail(it, "a value reference is of nothing that can be set");
    }
    for (size_t i = 0; i < n; ++i) *place(&it->now, references[i]) = values[i];
    return fmi3OK;
}

FMI3(fmi3Status)
fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3Float64 values[], size_t count) {
    instance *it = c;
    double y[SG_PLANT_OUTPUTS], rate[SG_PLANT_N];
    int rated = 0;
    if (count != n) return fail(it, "as many values as references are needed");
    sg_plant_outputs(&it->now.plant, y);
    for (size_t i = 0; i < n; ++i) {
        fmi3ValueReference r = references[i];
        const double *found = place(&it->now, r);
        if (r == TIME) found = &it->now.time;
        if (r >= OUTPUT && r < OUTPUT + SG_PLANT_OUTPUTS) found = y + (r - OUTPUT);
        if (r >= RATE && r < RATE + SG_PLANT_N) {
            if (!rated && (settle(it) || check(it, sg_plant_rate(&it->now.plant, it->now.u, rate)))) return fmi3Error;
            rated = 1;
            found = rate + (r - RATE);
        }
        if (!found) return fail(it, "a value reference is of nothing in modelDescription.xml");
        values[i] = *found;
    }
    return fmi3OK;
}

FMI3(fmi3Status)
fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean final, fmi3Boolean *event,
           fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    instance *it = c;
    double ticks = step / SG_PLANT_TICK, begin = it->now.time;
    (void)final;
    *event = *terminate = *early = false;
    *last = begin;
    if (it->exchange) return fail(it, "this instance is for model exchange and takes no steps of its own");
    if (!(ticks > 0.5 && ticks < 1e9)) return fail(it, "the step must be a whole number of ticks, from 1 to 1e9");
    long whole = (long)(ticks + 0.5);
    if (!(ticks - (double)whole < WHOLE && (double)whole - ticks < WHOLE))
        return fail(it, "the step is no multiple of the tick, fixedInternalStepSize in modelDescription.xml");
    double off = (time - begin) / SG_PLANT_TICK;
    if (!(off < 0.5 && off > -0.5)) return fail(it, "the step does not begin where the last one ended");
    if (settle(it)) return fmi3Error;
    for (long k = 0; k < whole; ++k) {
        if (check(it, sg_plant_tick(&it->now.plant, it->now.u))) return fmi3Error;
        *last = it->now.time = time + (double)(k + 1) * SG_PLANT_TICK;
    }
    *last = it->now.time = time + step;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3SetTime(fmi3Instance c, fmi3Float64 time) {
    if (!finite_number(time)) return fail(c, "the time is not a finite number");
    ((instance *)c)->now.time = time;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 w[], size_t n) {
    if (n != SG_PLANT_N) return fail(c, "the model has another number of states");
    for (size_t i = 0; i < n; ++i)
        if (!finite_number(w[i])) return fail(c, "a state is not a finite number; nothing has changed");
    memcpy(((instance *)c)->now.plant.w, w, n * sizeof *w);
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 w[], size_t n) {
    if (n != SG_PLANT_N) return fail(c, "the model has another number of states");
    memcpy(w, ((instance *)c)->now.plant.w, n * sizeof *w);
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 rate[], size_t n) {
    instance *it = c;
    if (n != SG_PLANT_N) return fail(it, "the model has another number of states");
    return settle(it) ? fmi3Error : check(it, sg_plant_rate(&it->now.plant, it->now.u, rate));
}

FMI3(fmi3Status) fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t n) {
    (void)c;
    for (size_t i = 0; i < n; ++i) nominals[i] = 1;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
    (void)c, *n = SG_PLANT_N;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
    (void)c, *n = 0;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n) {
    (void)indicators;
    return n ? fail(c, "the model has no event indicators") : fmi3OK;
}

FMI3(fmi3Status)
fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate) {
    (void)c, (void)final;
    *event = *terminate = false;
    return fmi3OK;
}

FMI3(fmi3Status)
fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                         fmi3Boolean *values, fmi3Boolean *defined, fmi3Float64 *next) {
    (void)c;
    *again = *terminate = *nominals = *values = *defined = false;
    *next = 0;
    return fmi3OK;
}

FMI3(fmi3Status) fmi3GetFMUState(fmi3Instance c, fmi3FMUState *copy) {
    if (!*copy && !(*copy = malloc(sizeof(state)))) return fail(c, "the memory is full");
    memcpy(*copy, &((instance *)c)->now, sizeof(state));
    return fmi3OK;
}

FMI3(fmi3Status) fmi3SetFMUState(fmi3Instance c, fmi3FMUState copy) {
    memcpy(&((instance *)c)->now, copy, sizeof(state));
    return fmi3OK;
}

FMI3(fmi3Status) fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *copy) {
    (void)c;
    free(*copy);
    *copy = NULL;
    return fmi3OK;
}

/* Modes that change nothing here. */
#define MODE(name) FMI3(fmi3Status) fmi3##name(fmi3Instance c) { return (void)c, fmi3OK; }
MODE(EnterEventMode)
MODE(EnterStepMode)
MODE(EnterContinuousTimeMode)
MODE(EnterConfigurationMode)
MODE(ExitConfigurationMode)
MODE(EvaluateDiscreteStates)
MODE(Terminate)

FMI3(fmi3Status) fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)c, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

#include "fmi3_unused.h"
