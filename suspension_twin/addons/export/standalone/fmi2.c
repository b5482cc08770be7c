/* SPDX-License-Identifier: Apache-2.0 */
/* A twin behind the interface of FMI 2.0 for co-simulation. */
#include "component.h"

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } Status;
typedef void (*Logger)(void *, const char *, Status, const char *, const char *, ...);

typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*free)(void *);
    void (*step_finished)(void *, Status);
    void *environment;
} Callbacks;

typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED, FAILED_STEP } Phase;

typedef struct {
    State state;
    Phase phase;
    Logger logger;
    void *environment;
    char *name;
} Component;

static Status complain(Component *c, Status status, const char *text)
{
    if (c->logger)
        c->logger(c->environment, c->name, status, status == DISCARD ? "logStatusDiscard" : "logStatusError", text);
    return status;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT Status fmi2SetDebugLogging(void *component, int on, size_t count, const char *const categories[])
{
    (void)component, (void)on, (void)count, (void)categories;
    return OK;
}

EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                             const Callbacks *callbacks, int visible, int logging)
{
    Component *c;
    (void)resources, (void)visible, (void)logging;
    if (type != 1 || !guid || strcmp(guid, GUID) != 0)
        return NULL;
    c = calloc(1, sizeof *c);
    if (!c)
        return NULL;
    c->name = calloc(strlen(name ? name : "") + 1, 1);
    if (!c->name) {
        free(c);
        return NULL;
    }
    strcpy(c->name, name ? name : "");
    if (callbacks) {
        c->logger = callbacks->logger;
        c->environment = callbacks->environment;
    }
    state_reset(&c->state);
    return c;
}

EXPORT void fmi2FreeInstance(void *component)
{
    Component *c = component;
    if (c) {
        free(c->name);
        free(c);
    }
}

EXPORT Status fmi2SetupExperiment(void *component, int tolerance_given, double tolerance, double start, int stop_given,
                                  double stop)
{
    Component *c = component;
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    c->state.time = start;
    return OK;
}

EXPORT Status fmi2EnterInitializationMode(void *component)
{
    ((Component *)component)->phase = INITIALIZING;
    return OK;
}

static Status start(Component *c)
{
    return state_start(&c->state) ? OK : complain(c, ERROR, "no static equilibrium under these inputs");
}

EXPORT Status fmi2ExitInitializationMode(void *component)
{
    Component *c = component;
    c->phase = STEPPING;
    return start(c);
}

EXPORT Status fmi2Terminate(void *component)
{
    ((Component *)component)->phase = TERMINATED;
    return OK;
}

EXPORT Status fmi2Reset(void *component)
{
    Component *c = component;
    state_reset(&c->state);
    c->phase = INSTANTIATED;
    return OK;
}

EXPORT Status fmi2GetReal(void *component, const unsigned references[], size_t count, double values[])
{
    Component *c = component;
    size_t i;
    if (c->phase == INITIALIZING && c->state.stale && start(c) != OK)
        return ERROR;
    for (i = 0; i < count; i++) {
        double *found = state_variable(&c->state, references[i]);
        if (!found)
            return complain(c, ERROR, "there is no variable of this value reference");
        values[i] = *found;
    }
    return OK;
}

EXPORT Status fmi2SetReal(void *component, const unsigned references[], size_t count, const double values[])
{
    Component *c = component;
    size_t i;
    for (i = 0; i < count; i++) {
        if (references[i] >= INPUTS)
            return complain(c, ERROR, "only inputs can be set");
        c->state.input[references[i]] = values[i];
    }
    c->state.stale = 1;
    return OK;
}

EXPORT Status fmi2SetRealInputDerivatives(void *component, const unsigned references[], size_t count,
                                          const int order[], const double values[])
{
    Component *c = component;
    size_t i;
    for (i = 0; i < count; i++) {
        if (references[i] >= INPUTS)
            return complain(c, ERROR, "only inputs have derivatives that can be set");
        if (order[i] == 1)
            c->state.rate[references[i]] = values[i];
    }
    return OK;
}

EXPORT Status fmi2DoStep(void *component, double point, double size, int no_set_before)
{
    Component *c = component;
    State *s = &c->state;
    double to[INPUTS];
    int i, n = steps_in(size);
    (void)no_set_before;
    if (c->phase != STEPPING)
        return complain(c, ERROR, "a step before the initialization, or after an error");
    if (!(size >= 0.0 && isfinite(size)))
        return complain(c, ERROR, "a step backwards in time, or one that is not finite");
    for (i = 0; i < INPUTS; i++)
        to[i] = s->input[i] + size * s->rate[i];
    memset(s->rate, 0, sizeof s->rate);
    s->time = point + size;
    if (size == 0.0)
        return OK;
    if (!state_walk(s, n, size / n, to)) {
        c->phase = FAILED_STEP;
        return complain(c, ERROR, "an input is not finite, or the model diverges: are road heights in m?");
    }
    return OK;
}

EXPORT Status fmi2CancelStep(void *component) { return (void)component, ERROR; }

/* There are no variables but real ones. */
#define NO_VARIABLES(name, type)                                                                        \
    EXPORT Status fmi2Get##name(void *component, const unsigned references[], size_t count, type values[]) \
    {                                                                                                   \
        (void)references, (void)values;                                                                 \
        return count ? complain(component, ERROR, "there are no such variables") : OK;                  \
    }                                                                                                   \
    EXPORT Status fmi2Set##name(void *component, const unsigned references[], size_t count, const type values[]) \
    {                                                                                                   \
        (void)references, (void)values;                                                                 \
        return count ? complain(component, ERROR, "there are no such variables") : OK;                  \
    }
NO_VARIABLES(Integer, int)
NO_VARIABLES(Boolean, int)
typedef const char *Text;
EXPORT Status fmi2GetString(void *component, const unsigned references[], size_t count, Text values[])
{
    (void)references, (void)values;
    return count ? complain(component, ERROR, "there are no such variables") : OK;
}
EXPORT Status fmi2SetString(void *component, const unsigned references[], size_t count, const Text values[])
{
    (void)references, (void)values;
    return count ? complain(component, ERROR, "there are no such variables") : OK;
}

/* The state is one piece of memory without addresses in it. */
EXPORT Status fmi2GetFMUstate(void *component, void **state)
{
    Component *c = component;
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return complain(c, ERROR, "out of memory");
    memcpy(*state, &c->state, sizeof(State));
    return OK;
}

EXPORT Status fmi2SetFMUstate(void *component, void *state)
{
    Component *c = component;
    memcpy(&c->state, state, sizeof(State));
    if (c->phase == FAILED_STEP)
        c->phase = STEPPING;
    return OK;
}

EXPORT Status fmi2FreeFMUstate(void *component, void **state)
{
    (void)component;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT Status fmi2SerializedFMUstateSize(void *component, void *state, size_t *size)
{
    (void)component, (void)state;
    *size = sizeof(State);
    return OK;
}

EXPORT Status fmi2SerializeFMUstate(void *component, void *state, char bytes[], size_t size)
{
    if (size < sizeof(State))
        return complain(component, ERROR, "too little room for the state");
    memcpy(bytes, state, sizeof(State));
    return OK;
}

EXPORT Status fmi2DeSerializeFMUstate(void *component, const char bytes[], size_t size, void **state)
{
    if (size < sizeof(State))
        return complain(component, ERROR, "no state of this model");
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return complain(component, ERROR, "out of memory");
    memcpy(*state, bytes, sizeof(State));
    return OK;
}

EXPORT Status fmi2GetDirectionalDerivative(void *component, const unsigned unknown[], size_t unknowns,
                                           const unsigned known[], size_t knowns, const double of_known[],
                                           double of_unknown[])
{
    (void)unknown, (void)unknowns, (void)known, (void)knowns, (void)of_known, (void)of_unknown;
    return complain(component, ERROR, "directional derivatives are not provided");
}

EXPORT Status fmi2GetRealOutputDerivatives(void *component, const unsigned references[], size_t count,
                                           const int order[], double values[])
{
    (void)references, (void)count, (void)order, (void)values;
    return complain(component, ERROR, "derivatives of outputs are not provided");
}

EXPORT Status fmi2GetStatus(void *component, int kind, Status *value)
{
    (void)component, (void)kind, (void)value;
    return DISCARD;
}

EXPORT Status fmi2GetRealStatus(void *component, int kind, double *value)
{
    if (kind != 2)
        return DISCARD;
    *value = ((Component *)component)->state.time;
    return OK;
}

EXPORT Status fmi2GetIntegerStatus(void *component, int kind, int *value)
{
    (void)component, (void)kind, (void)value;
    return DISCARD;
}

EXPORT Status fmi2GetBooleanStatus(void *component, int kind, int *value)
{
    (void)component;
    if (kind != 3)
        return DISCARD;
    *value = 0;
    return OK;
}

EXPORT Status fmi2GetStringStatus(void *component, int kind, const char **value)
{
    (void)component, (void)kind, (void)value;
    return DISCARD;
}
