/* SPDX-License-Identifier: Apache-2.0
 *
 * A car that shares no code with this project's models: seven degrees of freedom, linear springs, dampers and tyres,
 * classical Runge-Kutta steps, as a co-simulation FMU of FMI 2.0 whose variables have names of its own.
 * "limit" is the largest suspension travel in m: beyond it a step fails. */
#include "fmi2Functions.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { ZR = 0, AX = 4, AY, TURN, KF, KR, CF, CR, KT, MS, MU, IX, IY, LIMIT, IN_END };
enum { OUT = 100, Z = 100, PHI, THETA, WX, WY, ZDD, PHIDD, THETADD, D = 108, F = 112, OUT_END = 116 };
enum { N = 7 }; /* heave, roll, pitch, four wheels */

static const double G = 9.80665, FRONT = 2.85 - 2359.5 / 1565, REAR = 2359.5 / 1565, HALF = 0.8, AHEAD = 1.5, HEIGHT = 0.55;

typedef struct {
    double v[IN_END], x[2 * N], a[N], t;
    fmi2CallbackFunctions calls;
    char name[64];
} Car;

static void say(Car *c, const char *text) {
    if (c->calls.logger) c->calls.logger(c->calls.componentEnvironment, c->name, fmi2Error, "error", text);
}

static double arm_x(int i) { return i < 2 ? FRONT : -REAR; }
static double arm_y(int i) { return i % 2 ? -HALF : HALF; }
static double rest(const Car *c, int i) { return 0.5 * c->v[MS] * G * (i < 2 ? REAR : FRONT) / (FRONT + REAR); }

static void forces(const Car *c, const double *x, double *strut, double *tyre) {
    for (int i = 0; i < 4; i++) {
        double k = c->v[i < 2 ? KF : KR], d = c->v[i < 2 ? CF : CR];
        double gap = x[3 + i] - (x[0] + arm_y(i) * x[1] - arm_x(i) * x[2]);
        double rate = x[N + 3 + i] - (x[N] + arm_y(i) * x[N + 1] - arm_x(i) * x[N + 2]);
        strut[i] = rest(c, i) + k * gap + d * rate;
        tyre[i] = rest(c, i) + c->v[MU] * G + c->v[KT] * (c->v[ZR + i] - x[3 + i]);
    }
}

static void accelerations(const Car *c, const double *x, double *a) {
    double strut[4], tyre[4], mass = c->v[MS] + 4 * c->v[MU];
    forces(c, x, strut, tyre);
    a[0] = -G;
    a[1] = mass * HEIGHT * (c->v[AY] + AHEAD * c->v[TURN]) / c->v[IX];
    a[2] = -mass * HEIGHT * c->v[AX] / c->v[IY];
    for (int i = 0; i < 4; i++) {
        a[0] += strut[i] / c->v[MS];
        a[1] += arm_y(i) * strut[i] / c->v[IX];
        a[2] -= arm_x(i) * strut[i] / c->v[IY];
        a[3 + i] = (tyre[i] - strut[i]) / c->v[MU] - G;
    }
}

static void slopes(const Car *c, const double *x, double *out) {
    memcpy(out, x + N, N * sizeof *out);
    accelerations(c, x, out + N);
}

static void advance(Car *c, double h) {
    double k[4][2 * N], y[2 * N];
    static const double share[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    for (int s = 0; s < 4; s++) {
        for (int j = 0; j < 2 * N; j++) y[j] = c->x[j] + (s ? share[s] * h * k[s - 1][j] : 0.0);
        slopes(c, y, k[s]);
    }
    for (int j = 0; j < 2 * N; j++)
        for (int s = 0; s < 4; s++) c->x[j] += h / 6.0 * weight[s] * k[s][j];
}

static double output(const Car *c, unsigned r) {
    double strut[4], tyre[4], a[N];
    forces(c, c->x, strut, tyre);
    accelerations(c, c->x, a);
    if (r >= F) return tyre[r - F];
    if (r >= D) {
        int i = (int)(r - D);
        double gap = c->x[3 + i] - (c->x[0] + arm_y(i) * c->x[1] - arm_x(i) * c->x[2]);
        return gap + rest(c, i) / c->v[i < 2 ? KF : KR];
    }
    if (r >= ZDD) return a[r - ZDD];
    return r >= WX ? c->x[N + 1 + (r - WX)] : c->x[r - Z];
}

static void initial(Car *c) {
    static const double start[IN_END] = {[KF] = 2e4, [KR] = 2e4, [CF] = 2e3, [CR] = 2e3, [KT] = 2.1e5,
        [MS] = 1565, [MU] = 40, [IX] = 550, [IY] = 2600, [LIMIT] = 1.0};
    memcpy(c->v, start, sizeof start);
    memset(c->x, 0, sizeof c->x);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String where,
                              const fmi2CallbackFunctions *calls, fmi2Boolean visible, fmi2Boolean logging) {
    Car *c = calloc(1, sizeof *c);
    (void)where; (void)visible; (void)logging;
    if (!c || type != fmi2CoSimulation || strcmp(guid, "{other-car}")) { free(c); return NULL; }
    c->calls = *calls;
    snprintf(c->name, sizeof c->name, "%s", name);
    initial(c);
    return c;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2SetReal(fmi2Component p, const fmi2ValueReference r[], size_t n, const fmi2Real v[]) {
    Car *c = p;
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= IN_END) return fmi2Error;
        if (r[i] >= KF && !(v[i] > 0.0)) { say(c, "a parameter must be above 0"); return fmi2Error; }
        c->v[r[i]] = v[i];
    }
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component p, const fmi2ValueReference r[], size_t n, fmi2Real v[]) {
    Car *c = p;
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= OUT_END || (r[i] >= IN_END && r[i] < OUT)) return fmi2Error;
        v[i] = r[i] < OUT ? c->v[r[i]] : output(c, r[i]);
    }
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component p, fmi2Real t, fmi2Real h, fmi2Boolean last) {
    Car *c = p;
    int n = (int)ceil(h / 5e-4);
    (void)t; (void)last;
    for (int i = 0; i < n; i++) advance(c, h / n);
    for (int i = 0; i < 4; i++)
        if (!(fabs(output(c, D + (unsigned)i) - rest(c, i) / c->v[i < 2 ? KF : KR]) < c->v[LIMIT])) {
            say(c, "the suspension is at its stop");
            return fmi2Error;
        }
    return fmi2OK;
}

/* what a simulation by Real numbers alone does not need */
#define UNUSED(name, ...) fmi2Status name(__VA_ARGS__) { return fmi2Error; }
#define NOTHING(name, ...) fmi2Status name(__VA_ARGS__) { return fmi2OK; }
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }
NOTHING(fmi2SetDebugLogging, fmi2Component c, fmi2Boolean on, size_t n, const fmi2String k[])
NOTHING(fmi2SetupExperiment, fmi2Component c, fmi2Boolean d, fmi2Real e, fmi2Real t, fmi2Boolean s, fmi2Real end)
NOTHING(fmi2EnterInitializationMode, fmi2Component c)
NOTHING(fmi2ExitInitializationMode, fmi2Component c)
NOTHING(fmi2Terminate, fmi2Component c)
fmi2Status fmi2Reset(fmi2Component c) { initial(c); return fmi2OK; }
UNUSED(fmi2GetInteger, fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Integer v[])
UNUSED(fmi2GetBoolean, fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Boolean v[])
UNUSED(fmi2GetString, fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2String v[])
UNUSED(fmi2SetInteger, fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer v[])
UNUSED(fmi2SetBoolean, fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Boolean v[])
UNUSED(fmi2SetString, fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2String v[])
UNUSED(fmi2GetFMUstate, fmi2Component c, fmi2FMUstate *s)
UNUSED(fmi2SetFMUstate, fmi2Component c, fmi2FMUstate s)
UNUSED(fmi2FreeFMUstate, fmi2Component c, fmi2FMUstate *s)
UNUSED(fmi2SerializedFMUstateSize, fmi2Component c, fmi2FMUstate s, size_t *n)
UNUSED(fmi2SerializeFMUstate, fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n)
UNUSED(fmi2DeSerializeFMUstate, fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
UNUSED(fmi2GetDirectionalDerivative, fmi2Component c, const fmi2ValueReference u[], size_t m,
       const fmi2ValueReference k[], size_t n, const fmi2Real d[], fmi2Real v[])
UNUSED(fmi2SetRealInputDerivatives, fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer o[],
       const fmi2Real v[])
UNUSED(fmi2GetRealOutputDerivatives, fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer o[],
       fmi2Real v[])
UNUSED(fmi2CancelStep, fmi2Component c)
UNUSED(fmi2GetStatus, fmi2Component c, const fmi2StatusKind k, fmi2Status *v)
UNUSED(fmi2GetRealStatus, fmi2Component c, const fmi2StatusKind k, fmi2Real *v)
UNUSED(fmi2GetIntegerStatus, fmi2Component c, const fmi2StatusKind k, fmi2Integer *v)
UNUSED(fmi2GetBooleanStatus, fmi2Component c, const fmi2StatusKind k, fmi2Boolean *v)
UNUSED(fmi2GetStringStatus, fmi2Component c, const fmi2StatusKind k, fmi2String *v)
