/* SPDX-License-Identifier: Apache-2.0 */
/* A twin behind the interface of FMI 3.0 for co-simulation. */
#include <stdbool.h>
#include <stdint.h>

#include "component.h"

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef uint32_t Reference;
typedef void (*Logger)(void *, Status, const char *, const char *);
typedef void (*IntermediateUpdate)(void *, double, bool, bool, bool, bool, bool *, double *);

typedef enum { INSTANTIATED, INITIALIZING, STEPPING, UPDATING, TERMINATED, FAILED_STEP } Phase;

enum { TIME = 1000 };

typedef struct {
    State state;
    double next[INPUTS]; /* inputs at the end of the step of the integration under way */
    Phase phase;
    Logger logger;
    IntermediateUpdate update;
    void *environment;
} Instance;

static Status complain(Instance *c, const char *text)
{
    if (c && c->logger)
        c->logger(c->environment, ERROR, "logStatusError", text);
    return ERROR;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT Status fmi3SetDebugLogging(void *instance, bool on, size_t count, const char *const categories[])
{
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                         bool logging, bool events, bool early, const Reference required[],
                                         size_t count, void *environment, Logger logger, IntermediateUpdate update)
{
    Instance *c;
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)count;
    if (!token || strcmp(token, GUID) != 0)
        return NULL;
    c = calloc(1, sizeof *c);
    if (!c)
        return NULL;
    c->logger = logger;
    c->update = update;
    c->environment = environment;
    state_reset(&c->state);
    return c;
}

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
                                          bool logging, void *environment, Logger logger)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    return NULL;
}

EXPORT void *fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *resources,
                                               bool visible, bool logging, void *environment, Logger logger,
                                               void (*clock)(void *), void (*lock)(void), void (*unlock)(void))
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    (void)clock, (void)lock, (void)unlock;
    return NULL;
}

EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT Status fmi3EnterInitializationMode(void *instance, bool tolerance_given, double tolerance, double start,
                                          bool stop_given, double stop)
{
    Instance *c = instance;
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    c->phase = INITIALIZING;
    c->state.time = start;
    return OK;
}

static Status start(Instance *c)
{
    return state_start(&c->state) ? OK : complain(c, "no static equilibrium under these inputs");
}

EXPORT Status fmi3ExitInitializationMode(void *instance)
{
    Instance *c = instance;
    c->phase = STEPPING;
    return start(c);
}

EXPORT Status fmi3Terminate(void *instance)
{
    ((Instance *)instance)->phase = TERMINATED;
    return OK;
}

EXPORT Status fmi3Reset(void *instance)
{
    Instance *c = instance;
    state_reset(&c->state);
    c->phase = INSTANTIATED;
    return OK;
}

EXPORT Status fmi3GetFloat64(void *instance, const Reference references[], size_t count, double values[],
                             size_t size)
{
    Instance *c = instance;
    size_t i;
    if (size != count)
        return complain(c, "variables are scalars");
    if (c->phase == INITIALIZING && c->state.stale && start(c) != OK)
        return ERROR;
    for (i = 0; i < count; i++) {
        double *found = references[i] == TIME ? &c->state.time : state_variable(&c->state, references[i]);
        if (!found)
            return complain(c, "there is no variable of this value reference");
        values[i] = *found;
    }
    return OK;
}

EXPORT Status fmi3SetFloat64(void *instance, const Reference references[], size_t count, const double values[],
                             size_t size)
{
    Instance *c = instance;
    size_t i;
    if (size != count)
        return complain(c, "variables are scalars");
    for (i = 0; i < count; i++) {
        if (references[i] >= INPUTS)
            return complain(c, "only inputs can be set");
        (c->phase == UPDATING ? c->next : c->state.input)[references[i]] = values[i];
    }
    c->state.stale = 1;
    return OK;
}

EXPORT Status fmi3EnterStepMode(void *instance) { return (void)instance, OK; }

EXPORT Status fmi3DoStep(void *instance, double point, double size, bool no_set_before, bool *event, bool *terminate,
                         bool *early, double *last)
{
    Instance *c = instance;
    State *s = &c->state;
    int j, n = steps_in(size);
    double h = size / n;
    (void)no_set_before;
    *event = *terminate = *early = false;
    *last = point;
    if (c->phase != STEPPING)
        return complain(c, "a step before the initialization, or after an error");
    if (!(size >= 0.0 && isfinite(size)))
        return complain(c, "a step backwards in time, or one that is not finite");
    memcpy(c->next, s->input, sizeof c->next);
    for (j = 0; size > 0.0 && j < n; j++) {
        double now = j + 1 < n ? point + (j + 1) * h : point + size;
        bool ask = false;
        double until = now;
        int steps = c->update ? 1 : n;
        if (c->update) {
            c->phase = UPDATING;
            c->update(c->environment, now, true, false, false, false, &ask, &until);
            c->phase = STEPPING;
        }
        if (!state_walk(s, steps, h, c->next)) {
            c->phase = FAILED_STEP;
            return complain(c, "an input is not finite, or the model diverges: are road heights in m?");
        }
        j += steps - 1;
    }
    s->time = *last = point + size;
    return OK;
}

/* The state is one piece of memory without addresses in it. */
EXPORT Status fmi3GetFMUState(void *instance, void **state)
{
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return complain(instance, "out of memory");
    memcpy(*state, &((Instance *)instance)->state, sizeof(State));
    return OK;
}

EXPORT Status fmi3SetFMUState(void *instance, void *state)
{
    Instance *c = instance;
    memcpy(&c->state, state, sizeof(State));
    if (c->phase == FAILED_STEP)
        c->phase = STEPPING;
    return OK;
}

EXPORT Status fmi3FreeFMUState(void *instance, void **state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT Status fmi3SerializedFMUStateSize(void *instance, void *state, size_t *size)
{
    (void)instance, (void)state;
    *size = sizeof(State);
    return OK;
}

EXPORT Status fmi3SerializeFMUState(void *instance, void *state, uint8_t bytes[], size_t size)
{
    if (size < sizeof(State))
        return complain(instance, "too little room for the state");
    memcpy(bytes, state, sizeof(State));
    return OK;
}

EXPORT Status fmi3DeserializeFMUState(void *instance, const uint8_t bytes[], size_t size, void **state)
{
    if (size < sizeof(State))
        return complain(instance, "no state of this model");
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return complain(instance, "out of memory");
    memcpy(*state, bytes, sizeof(State));
    return OK;
}

/* There are no variables but numbers of 64 bits. */
#define NO_VARIABLES(name, type)                                                                                  \
    EXPORT Status fmi3Get##name(void *c, const Reference r[], size_t count, type values[], size_t size)           \
    {                                                                                                             \
        (void)r, (void)values, (void)size;                                                                        \
        return count ? complain(c, "there are no such variables") : OK;                                           \
    }                                                                                                             \
    EXPORT Status fmi3Set##name(void *c, const Reference r[], size_t count, const type values[], size_t size)     \
    {                                                                                                             \
        (void)r, (void)values, (void)size;                                                                        \
        return count ? complain(c, "there are no such variables") : OK;                                           \
    }
typedef const char *Text;
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
NO_VARIABLES(String, Text)

EXPORT Status fmi3GetBinary(void *c, const Reference r[], size_t count, size_t sizes[], const uint8_t *values[],
                            size_t size)
{
    (void)r, (void)sizes, (void)values, (void)size;
    return count ? complain(c, "there are no such variables") : OK;
}

EXPORT Status fmi3SetBinary(void *c, const Reference r[], size_t count, const size_t sizes[],
                            const uint8_t *const values[], size_t size)
{
    (void)r, (void)sizes, (void)values, (void)size;
    return count ? complain(c, "there are no such variables") : OK;
}

EXPORT Status fmi3GetClock(void *c, const Reference r[], size_t count, bool values[])
{
    (void)r, (void)values;
    return count ? complain(c, "there are no clocks") : OK;
}

EXPORT Status fmi3SetClock(void *c, const Reference r[], size_t count, const bool values[])
{
    (void)r, (void)values;
    return count ? complain(c, "there are no clocks") : OK;
}

/* Not provided: modelDescription.xml announces none of these. */
#define NOT_PROVIDED(name, ...) \
    EXPORT Status fmi3##name(void *c, __VA_ARGS__) { return complain(c, "fmi3" #name " is not provided"); }
#define NOT_PROVIDED_ALONE(name) \
    EXPORT Status fmi3##name(void *c) { return complain(c, "fmi3" #name " is not provided"); }
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
NOT_PROVIDED_ALONE(EnterEventMode)
NOT_PROVIDED_ALONE(EnterConfigurationMode)
NOT_PROVIDED_ALONE(ExitConfigurationMode)
NOT_PROVIDED_ALONE(EvaluateDiscreteStates)
NOT_PROVIDED_ALONE(EnterContinuousTimeMode)
NOT_PROVIDED(GetNumberOfVariableDependencies, Reference r, size_t *count)
NOT_PROVIDED(GetVariableDependencies, Reference r, size_t of[], Reference on[], size_t with[], int kinds[], size_t n)
NOT_PROVIDED(GetDirectionalDerivative, const Reference u[], size_t us, const Reference k[], size_t ks,
             const double seed[], size_t seeds, double found[], size_t size)
NOT_PROVIDED(GetAdjointDerivative, const Reference u[], size_t us, const Reference k[], size_t ks,
             const double seed[], size_t seeds, double found[], size_t size)
NOT_PROVIDED(GetIntervalDecimal, const Reference r[], size_t n, double intervals[], int qualifiers[])
NOT_PROVIDED(GetIntervalFraction, const Reference r[], size_t n, uint64_t c1[], uint64_t c2[], int qualifiers[])
NOT_PROVIDED(GetShiftDecimal, const Reference r[], size_t n, double shifts[])
NOT_PROVIDED(GetShiftFraction, const Reference r[], size_t n, uint64_t c1[], uint64_t c2[])
NOT_PROVIDED(SetIntervalDecimal, const Reference r[], size_t n, const double intervals[])
NOT_PROVIDED(SetIntervalFraction, const Reference r[], size_t n, const uint64_t c1[], const uint64_t c2[])
NOT_PROVIDED(SetShiftDecimal, const Reference r[], size_t n, const double shifts[])
NOT_PROVIDED(SetShiftFraction, const Reference r[], size_t n, const uint64_t c1[], const uint64_t c2[])
NOT_PROVIDED(UpdateDiscreteStates, bool *again, bool *terminate, bool *nominals, bool *values, bool *defined,
             double *next)
NOT_PROVIDED(CompletedIntegratorStep, bool no_set, bool *event, bool *terminate)
NOT_PROVIDED(SetTime, double time)
NOT_PROVIDED(SetContinuousStates, const double x[], size_t n)
NOT_PROVIDED(GetContinuousStates, double x[], size_t n)
NOT_PROVIDED(GetContinuousStateDerivatives, double dx[], size_t n)
NOT_PROVIDED(GetEventIndicators, double z[], size_t n)
NOT_PROVIDED(GetNominalsOfContinuousStates, double x[], size_t n)
NOT_PROVIDED(GetNumberOfEventIndicators, size_t *n)
NOT_PROVIDED(GetNumberOfContinuousStates, size_t *n)
NOT_PROVIDED(GetOutputDerivatives, const Reference r[], size_t n, const int32_t orders[], double values[], size_t size)
NOT_PROVIDED(ActivateModelPartition, Reference clock, double time)
