/* SPDX-License-Identifier: Apache-2.0 */
/*
 * What the two versions of FMI have in common: one twin, its inputs and outputs, and the walk from one communication
 * point to the next. model.c beside this file holds the equations and the constants of the twin.
 *
 * An input is held over a step, unless the importer says how it runs on: by its derivative (FMI 2) or by its value at
 * the end of each step of the integration (FMI 3). Then it is linear in between.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.c"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { HEIGHTS = 4, MOTIONS = 6, INPUTS = HEIGHTS + MOTIONS, OUTPUTS = 34, FIRST_OUTPUT = 100 };

/* Everything that changes. */
typedef struct {
    double w[ROWS];
    double input[INPUTS];   /* as it is at the communication point */
    double rate[INPUTS];    /* its derivatives over the next step */
    double output[OUTPUTS];
    double time;
    int stale;              /* the start has to be computed anew */
} State;

static void state_reset(State *s)
{
    memset(s, 0, sizeof *s);
    memcpy(s->w, INITIAL, sizeof s->w);
    s->stale = 1;
}

static int all_finite(const double *values, int count)
{
    int i;
    for (i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

/* Static equilibrium under the inputs as they are; 0 if there is none. */
static int state_start(State *s)
{
    memcpy(s->w, INITIAL, sizeof s->w);
    if (!all_finite(s->input, INPUTS))
        return 0;
    twin_start(s->w, s->input, s->input + HEIGHTS);
    twin_read(s->w, s->input + HEIGHTS, s->output);
    s->stale = 0;
    return s->w[FAILED] == 0.0 && all_finite(s->output, OUTPUTS);
}

/* Number of steps of the integration in an interval. */
static int steps_in(double interval)
{
    double steps = ceil(interval / MAX_STEP - 2e-3);
    return steps < 1.0 ? 1 : steps > 1e9 ? 1000000000 : (int)steps;
}

/* n steps of h seconds, inputs running linearly from those of the state to `to`; 0 if the model diverges. */
static int state_walk(State *s, int n, double h, double *to)
{
    if (!all_finite(to, INPUTS))
        return 0;
    twin_advance(s->w, n, h, s->input, to, s->input + HEIGHTS, to + HEIGHTS);
    memcpy(s->input, to, sizeof s->input);
    twin_read(s->w, s->input + HEIGHTS, s->output);
    return s->w[FAILED] == 0.0 && all_finite(s->output, OUTPUTS);
}

/* One input or output by its value reference; NULL if there is none. */
static double *state_variable(State *s, unsigned reference)
{
    if (reference < INPUTS)
        return s->input + reference;
    if (reference >= FIRST_OUTPUT && reference < FIRST_OUTPUT + OUTPUTS)
        return s->output + (reference - FIRST_OUTPUT);
    return NULL;
}
