/* SPDX-License-Identifier: Apache-2.0 */
/* Seconds of processor time that an FMU of version 2.0 takes for a drive: fmu_speed LIBRARY GUID STEP SECONDS. */
#include <dlfcn.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

typedef void *(*Instantiate)(const char *, int, const char *, const char *, const void *, int, int);
typedef int (*Simple)(void *);
typedef int (*Set)(void *, const unsigned *, size_t, const double *);
typedef int (*Get)(void *, const unsigned *, size_t, double *);
typedef int (*Step)(void *, double, double, int);

static void *symbol(void *library, const char *name)
{
    void *found = dlsym(library, name);
    if (!found) {
        fprintf(stderr, "no %s\n", name);
        exit(1);
    }
    return found;
}

int main(int count, char **arguments)
{
    unsigned inputs[10], outputs[34], k;
    double in[10] = {0}, out[34], step, seconds;
    long n, j;
    void *library, *component;
    Set set;
    Get get;
    Step advance;
    clock_t begin;
    if (count != 5 || !(library = dlopen(arguments[1], RTLD_NOW)))
        return 1;
    step = atof(arguments[3]);
    seconds = atof(arguments[4]);
    for (k = 0; k < 10; k++)
        inputs[k] = k;
    for (k = 0; k < 34; k++)
        outputs[k] = 100 + k;
    component = ((Instantiate)symbol(library, "fmi2Instantiate"))("twin", 1, arguments[2], NULL, NULL, 0, 0);
    set = (Set)symbol(library, "fmi2SetReal");
    get = (Get)symbol(library, "fmi2GetReal");
    advance = (Step)symbol(library, "fmi2DoStep");
    if (!component || ((Simple)symbol(library, "fmi2EnterInitializationMode"))(component) ||
        ((Simple)symbol(library, "fmi2ExitInitializationMode"))(component))
        return 1;
    n = lround(seconds / step);
    begin = clock();
    for (j = 0; j < n; j++) {
        double t = j * step;
        for (k = 0; k < 4; k++) /* a wave of 2 cm at 2 Hz, and turning */
            in[k] = 0.02 * sin(12.566 * t + k);
        in[5] = 2.0 * sin(t);
        in[6] = 0.2 * sin(t);
        in[8] = 10.0;
        if (set(component, inputs, 10, in) || advance(component, t, step, 1) || get(component, outputs, 34, out))
            return 1;
    }
    printf("%.9g %.9g\n", (double)(clock() - begin) / CLOCKS_PER_SEC, out[0]);
    return 0;
}
