/* FMI 3.0 of a scene, for co-simulation and model exchange, by the functions of the scene in C.

   Value references: 0 is the time; then, with N coordinates, positions q, velocities v and accelerations from FIRST_Q, FIRST_V and
   FIRST_A; the integrated state from FIRST_STATE and its derivatives from FIRST_RATE; the parameters, then the inputs, from
   FIRST_VALUE; and further outputs from FIRST_MEASURE. In model exchange the integrated state drifts from the constraints by the importer's errors. The FMU evaluates
   the equations at its projection, so that drift does not act on the motion, and q and v are always closed. */

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "fmi3.h"
#include "model.h"

#pragma GCC diagnostic ignored "-Wunused-parameter" /* FMI prescribes parameters that this FMU does not need */

enum { INSTANTIATED = 1, INITIALIZATION = 2, EVENT = 4, CONTINUOUS = 8, STEP = 16, TERMINATED = 32, ANY = 63 };
enum { BEFORE = INSTANTIATED | INITIALIZATION };
enum { FIRST_Q = 1, FIRST_V = FIRST_Q + N, FIRST_A = FIRST_V + N, FIRST_STATE = FIRST_A + N, FIRST_RATE = FIRST_STATE + 2 * N,
    FIRST_VALUE = FIRST_RATE + 2 * N, FIRST_MEASURE = FIRST_VALUE + VALUES, END = FIRST_MEASURE + MEASURES };

#define SAME_TIME 1e-9 /* of a communication point, relative: nearer ones are the same up to rounding */
#define DRIFT 1e-6 /* of the state, over its nominal values, beyond which it returns to the constraints in an event */

typedef struct {
    double t, state[2 * N], values[VALUES + 1], numbers[NUMBERS];
    double given[2 * N]; /* start values that the importer has set, else NAN */
    int mode;
    int stale; /* whether `numbers` lack changes of `values` */
    int open;  /* whether the state is a guess that has to be closed */
} State;

typedef struct {
    State now;
    double closed[2 * N], a[N], measured[2 * MEASURES + 1], stop;
    int has_closed, has_a, has_measured, is_model_exchange;
    double *memory;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

/* --- messages and checks */

static fmi3Status report(const Instance *m, fmi3Status status, const char *form, ...)
{
    char text[512];
    va_list given;
    va_start(given, form);
    vsnprintf(text, sizeof text, form, given);
    va_end(given);
    if (m->log) m->log(m->environment, status, status == fmi3Discard ? "logStatusDiscard" : "logStatusError", text);
    return status;
}

static fmi3Status check_mode(const Instance *m, int allowed, const char *function)
{
    static const char *const modes[] = {"instantiated", "initialization mode", "event mode", "continuous-time mode", "step mode",
        "terminated"};
    int k = 0;
    if (!m) return fmi3Error;
    if (m->now.mode & allowed) return fmi3OK;
    while (!(m->now.mode >> k & 1)) k++;
    return report(m, fmi3Error, "%s must not be called in the state: %s", function, modes[k]);
}

#define REQUIRE(allowed) \
    Instance *m = instance; \
    if (check_mode(m, allowed, __func__)) return fmi3Error

#define SIMPLE(name, allowed, action) FMI fmi3Status name(fmi3Instance instance) { REQUIRE(allowed); action; return fmi3OK; }
#define COUNT(name, count) FMI fmi3Status name(fmi3Instance instance, size_t *n) { REQUIRE(ANY); *n = count; return fmi3OK; }
#define REFUSED(name, allowed, text) \
    FMI fmi3Status name(fmi3Instance instance) { REQUIRE(allowed); return report(m, fmi3Error, "%s: " text, __func__); }

static void forget(Instance *m) { m->has_closed = m->has_a = m->has_measured = 0; }

/* --- the scene */

/* Take the scene's guess for states that are not given, if it depends on changed parameters. */
static void begin_at_guess(State *s)
{
    int moved = 0;
    for (int k = 0; k < 2 * N; k++) moved |= s->numbers[guess[k]] != scene_numbers[guess[k]];
    for (int k = 0; k < 2 * N; k++)
        if (moved && isnan(s->given[k])) s->state[k] = s->numbers[guess[k]];
}

/* Bring numbers up to date, and close a guess. */
static fmi3Status settle(Instance *m)
{
    State *s = &m->now;
    if (s->stale) scene_set_parameters(s->values, s->numbers);
    if (s->stale && s->mode & BEFORE) begin_at_guess(s);
    s->stale = 0;
#ifdef SCENE_CLOSE
    if (s->open) {
        double q[2 * N], left;
        memcpy(q, s->state, sizeof q);
        left = SCENE_CLOSE(s->numbers, s->t, q, q + N, m->memory);
        if (!(left < CLOSED))
            return report(m, fmi3Error, "the mechanism cannot be closed near its start values with these parameters: "
                "a constraint is violated by %.3g; change them", left);
        memcpy(s->state, q, sizeof q);
    }
#endif
    s->open = 0;
    return fmi3OK;
}

/* Find the closed state. */
static fmi3Status find_closed(Instance *m)
{
    if (settle(m)) return fmi3Error;
    if (m->has_closed) return fmi3OK;
    memcpy(m->closed, m->now.state, sizeof m->closed);
#ifdef SCENE_PROJECT
    if (m->is_model_exchange) SCENE_PROJECT(m->now.numbers, m->now.t, m->closed, m->closed + N, m->memory);
#endif
    for (int k = 0; k < 2 * N; k++)
        if (!isfinite(m->closed[k])) return report(m, fmi3Discard, "%s is not finite at %g s", names[k], m->now.t);
    m->has_closed = 1;
    return fmi3OK;
}

static fmi3Status find_accelerations(Instance *m)
{
    const fmi3Status status = find_closed(m);
    if (status || m->has_a) return status;
#ifdef SCENE_ACCELERATIONS
    SCENE_ACCELERATIONS(m->now.numbers, m->now.t, m->closed, m->closed + N, m->a, m->memory);
    for (int k = 0; k < N; k++)
        if (!isfinite(m->a[k])) return report(m, fmi3Discard, "the acceleration of %s is not finite at %g s", names[k], m->now.t);
#else
    return report(m, fmi3Error, "the FMU has no accelerations");
#endif
    m->has_a = 1;
    return fmi3OK;
}

/* Find the measures, and their changes along changes d of the closed state and of values, at their value references. */
static fmi3Status find_measures(Instance *m, const double *d)
{
    const fmi3Status status = find_closed(m);
    if (status || (m->has_measured && !d)) return status;
#ifdef SCENE_MEASURE
    double at[2 * (VALUES + 2 * N)] = {0};
    memcpy(at, m->now.values, VALUES * sizeof *at);
    memcpy(at + VALUES, m->closed, sizeof m->closed);
    if (d) memcpy(at + VALUES + 2 * N, d + FIRST_VALUE, VALUES * sizeof *at);
    if (d) memcpy(at + 2 * VALUES + 2 * N, d + FIRST_Q, sizeof m->closed);
    SCENE_MEASURE(at, m->measured);
#endif
    m->has_measured = 1;
    return fmi3OK;
}

/* Return the derivative of an integrated state: the drift decays, and its decay does not change the projection. */
static double rate_of(const Instance *m, int k)
{
    return (k < N ? m->closed[N + k] : m->a[k - N]) + DECAY * (m->closed[k] - m->now.state[k]);
}

/* --- life */

FMI const char *fmi3GetVersion(void) { return "3.0"; }

FMI fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    REQUIRE(ANY);
    return fmi3OK;
}

static void reset(Instance *m)
{
    memset(&m->now, 0, sizeof m->now);
    memcpy(m->now.state, scene_q0, N * sizeof *scene_q0);
    memcpy(m->now.state + N, scene_v0, N * sizeof *scene_v0);
    memcpy(m->now.numbers, scene_numbers, sizeof m->now.numbers);
    memcpy(m->now.values, start_values, VALUES * sizeof *start_values);
    m->now.t = START_TIME;
    m->now.mode = INSTANTIATED;
    for (int k = 0; k < 2 * N; k++) m->now.given[k] = NAN;
    m->stop = INFINITY;
    forget(m);
}

static void *refuse(fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, const char *text)
{
    if (log) log(environment, fmi3Error, "logStatusError", text);
    return NULL;
}

static Instance *instantiate(const char *token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, int exchange)
{
    Instance *m;
    if (!token || strcmp(token, TOKEN))
        return refuse(environment, log, "the instantiation token is not that of modelDescription.xml");
    m = calloc(1, sizeof *m);
    if (m) m->memory = calloc(MEMORY, sizeof(double));
    if (!m || !m->memory) {
        free(m);
        return refuse(environment, log, "no memory for an instance");
    }
    m->environment = environment;
    m->log = log;
    m->is_model_exchange = exchange;
    reset(m);
    return m;
}

#define IDENTITY \
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging
#define ENVIRONMENT fmi3InstanceEnvironment environment, fmi3LogMessageCallback log

FMI fmi3Instance fmi3InstantiateCoSimulation(IDENTITY, fmi3Boolean events, fmi3Boolean early,
    const fmi3ValueReference required[], size_t n, ENVIRONMENT, fmi3IntermediateUpdateCallback update)
{
    return instantiate(token, environment, log, 0);
}

FMI fmi3Instance fmi3InstantiateModelExchange(IDENTITY, ENVIRONMENT)
{
#ifndef MODEL_EXCHANGE
    return refuse(environment, log, "this FMU is for co-simulation only");
#else
    return instantiate(token, environment, log, 1);
#endif
}

FMI fmi3Instance fmi3InstantiateScheduledExecution(IDENTITY, ENVIRONMENT, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return refuse(environment, log, "this FMU has no scheduled execution");
}

FMI void fmi3FreeInstance(fmi3Instance instance)
{
    Instance *m = instance;
    if (!m) return;
    free(m->memory);
    free(m);
}

FMI fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
    fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    REQUIRE(INSTANTIATED);
    if (!isfinite(start) || (has_stop && !(stop > start)))
        return report(m, fmi3Error, "the times of a run must be finite and increase, not from %g to %g s", start, stop);
    m->now.open |= start != m->now.t;
    m->now.t = start;
    m->stop = has_stop ? stop : INFINITY;
    m->now.mode = INITIALIZATION;
    forget(m);
    return fmi3OK;
}

FMI fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    REQUIRE(INITIALIZATION);
    if (settle(m)) return fmi3Error;
    m->now.mode = m->is_model_exchange ? EVENT : STEP;
    return fmi3OK;
}

SIMPLE(fmi3Terminate, EVENT | CONTINUOUS | STEP, m->now.mode = TERMINATED)
SIMPLE(fmi3Reset, ANY, reset(m))

/* --- variables */

static const char *name_of(fmi3ValueReference k)
{
    return k == 0 ? "time" : k < FIRST_STATE ? names[k - FIRST_Q] : k < FIRST_RATE ? names[k - FIRST_STATE]
        : k < FIRST_VALUE ? names[k - FIRST_RATE + N] : value_names[k - FIRST_VALUE];
}

FMI fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Float64 values[],
    size_t count)
{
    REQUIRE(ANY);
    if (n != count) return report(m, fmi3Error, "fmi3GetFloat64: %u values of %u variables", (unsigned)count, (unsigned)n);
    for (size_t i = 0; i < n; i++) {
        const fmi3ValueReference k = references[i];
        fmi3Status status = fmi3OK;
        if (k >= END) return report(m, fmi3Error, "fmi3GetFloat64: there is no variable %u", (unsigned)k);
        if ((k >= FIRST_A && k < FIRST_STATE) || (k >= FIRST_RATE && k < FIRST_VALUE)) status = find_accelerations(m);
        else if (k >= FIRST_MEASURE) status = find_measures(m, NULL);
        else if (k != 0 && k < FIRST_VALUE) status = find_closed(m);
        if (status) return status;
        values[i] = k == 0 ? m->now.t : k < FIRST_A ? m->closed[k - FIRST_Q] : k < FIRST_STATE ? m->a[k - FIRST_A]
            : k < FIRST_RATE ? m->now.state[k - FIRST_STATE] : k < FIRST_VALUE ? rate_of(m, k - FIRST_RATE)
            : k < FIRST_MEASURE ? m->now.values[k - FIRST_VALUE] : m->measured[k - FIRST_MEASURE];
    }
    return fmi3OK;
}

FMI fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n, const fmi3Float64 values[],
    size_t count)
{
    REQUIRE(ANY & ~TERMINATED);
    if (n != count) return report(m, fmi3Error, "fmi3SetFloat64: %u values of %u variables", (unsigned)count, (unsigned)n);
    for (size_t i = 0; i < n; i++) { /* nothing changes unless all are right */
        const fmi3ValueReference k = references[i];
        const int is_state = k >= FIRST_STATE && k < FIRST_RATE, is_value = k >= FIRST_VALUE && k < FIRST_MEASURE;
        if (!is_state && !is_value) return report(m, fmi3Error, "fmi3SetFloat64: variable %u cannot be set", (unsigned)k);
        if (!isfinite(values[i])) return report(m, fmi3Error, "%s must be finite, not %g", name_of(k), values[i]);
        if (is_value && (least[k - FIRST_VALUE] == POSITIVE ? values[i] <= 0 : least[k - FIRST_VALUE] && values[i] < 0))
            return report(m, fmi3Error, "%s must be %s 0, not %g", name_of(k), least[k - FIRST_VALUE] == POSITIVE ? ">" : ">=",
                values[i]);
        if ((is_state || k < FIRST_VALUE + VALUES - INPUTS) && !(m->now.mode & BEFORE))
            return report(m, fmi3Error, "%s can be set before the run only; make it an input at export", name_of(k));
    }
    for (size_t i = 0; i < n; i++) {
        const fmi3ValueReference k = references[i];
        double *to = k < FIRST_RATE ? m->now.state + (k - FIRST_STATE) : m->now.values + (k - FIRST_VALUE);
        if (k < FIRST_RATE) m->now.given[k - FIRST_STATE] = values[i];
        if (*to == values[i]) continue;
        *to = values[i];
        m->now.open |= k < FIRST_VALUE + VALUES - INPUTS; /* an input moves no pose */
        m->now.stale |= k >= FIRST_VALUE;
    }
    forget(m);
    return fmi3OK;
}

#define NO_VARIABLES_OF(access, type, T) \
    FMI fmi3Status access(fmi3Instance instance, const fmi3ValueReference references[], size_t n, T values[], size_t count) \
    { \
        REQUIRE(ANY); \
        return n || count ? report(m, fmi3Error, "the FMU has no variables of type " #type) : fmi3OK; \
    }
#define NO_VARIABLES(type, T) NO_VARIABLES_OF(fmi3Get##type, type, T) NO_VARIABLES_OF(fmi3Set##type, type, const T)
NO_VARIABLES(Float32, fmi3Float32)
NO_VARIABLES(Int8, fmi3Int8)
NO_VARIABLES(UInt8, fmi3UInt8)
NO_VARIABLES(Int16, fmi3Int16)
NO_VARIABLES(UInt16, fmi3UInt16)
NO_VARIABLES(Int32, fmi3Int32)
NO_VARIABLES(UInt32, fmi3UInt32)
NO_VARIABLES(Int64, fmi3Int64)
NO_VARIABLES(UInt64, fmi3UInt64)
NO_VARIABLES(Boolean, fmi3Boolean)
NO_VARIABLES(String, fmi3String)

#define UNSUPPORTED(name, ...) \
    FMI fmi3Status name(fmi3Instance instance, __VA_ARGS__) \
    { \
        Instance *m = instance; \
        return m ? report(m, fmi3Error, "%s: the FMU does not support it", __func__) : fmi3Error; \
    }

/* --- the state of the FMU */

static fmi3Status keep_state(const Instance *m, const State *s, fmi3FMUState *state)
{
    if (!*state) *state = malloc(sizeof *s);
    if (!*state) return report(m, fmi3Error, "no memory for a state");
    memcpy(*state, s, sizeof *s);
    return fmi3OK;
}

FMI fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    REQUIRE(ANY);
    return keep_state(m, &m->now, state);
}

FMI fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    REQUIRE(ANY);
    if (!state) return report(m, fmi3Error, "fmi3SetFMUState: there is no state");
    memcpy(&m->now, state, sizeof(State));
    forget(m);
    return fmi3OK;
}

FMI fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

/* A serialized state is the token and the bytes of the state: it is for FMUs of the same binary. */
#define SERIALIZED (sizeof TOKEN + sizeof(State))

FMI fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    REQUIRE(ANY);
    *size = SERIALIZED;
    return fmi3OK;
}

FMI fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    REQUIRE(ANY);
    if (!state || size < SERIALIZED) return report(m, fmi3Error, "a serialized state has %u bytes", (unsigned)SERIALIZED);
    memcpy(bytes, TOKEN, sizeof TOKEN);
    memcpy(bytes + sizeof TOKEN, state, sizeof(State));
    return fmi3OK;
}

FMI fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    REQUIRE(ANY);
    State s = {0};
    if (size == SERIALIZED) memcpy(&s, bytes + sizeof TOKEN, sizeof s);
    if (size != SERIALIZED || memcmp(bytes, TOKEN, sizeof TOKEN) || !(s.mode & ANY) || s.mode & (s.mode - 1))
        return report(m, fmi3Error, "the bytes are not a serialized state of this FMU");
    return keep_state(m, &s, state);
}

/* --- co-simulation */

REFUSED(fmi3EnterStepMode, STEP, "the FMU has no event mode in co-simulation")

FMI fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 t, fmi3Float64 dt, fmi3Boolean no_set_state, fmi3Boolean *event,
    fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached)
{
    REQUIRE(STEP);
    int result;
    *event = *terminate = *early = false;
    *reached = m->now.t;
    if (!(dt > 0) || !isfinite(dt)) return report(m, fmi3Error, "a step must be finite and > 0 s, not %g", dt);
    if (!(fabs(t - m->now.t) <= SAME_TIME * (fabs(t) + dt)))
        return report(m, fmi3Error, "a step from %.17g s, but the FMU is at %.17g s", t, m->now.t);
    if (t + dt > m->stop + SAME_TIME * (fabs(t) + dt))
        return report(m, fmi3Error, "a step to %.17g s, beyond the stop time %.17g s", t + dt, m->stop);
    if (settle(m)) return fmi3Error;
    result = scene_step(m->now.numbers, t, dt, m->now.state, m->now.state + N, m->memory);
    if (result)
        return report(m, fmi3Discard, "no step from %g s over %g s: %s; try a shorter one", t, dt, scene_result_name(result));
    *reached = m->now.t = t + dt;
    forget(m);
    return fmi3OK;
}

/* --- model exchange */

SIMPLE(fmi3EnterEventMode, CONTINUOUS, m->now.mode = EVENT)
SIMPLE(fmi3EnterContinuousTimeMode, EVENT, m->now.mode = CONTINUOUS)
SIMPLE(fmi3EvaluateDiscreteStates, EVENT | INITIALIZATION, (void)m)
COUNT(fmi3GetNumberOfContinuousStates, 2 * N)
COUNT(fmi3GetNumberOfEventIndicators, 0)

/* Return whether the state has drifted so far that it has to return to the constraints. */
static int has_drifted(const Instance *m)
{
    for (int k = 0; k < 2 * N; k++)
        if (fabs(m->closed[k] - m->now.state[k]) > DRIFT * nominal[k]) return 1;
    return 0;
}

FMI fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *more, fmi3Boolean *terminate, fmi3Boolean *nominals,
    fmi3Boolean *changed, fmi3Boolean *has_next, fmi3Float64 *next)
{
    REQUIRE(EVENT);
    const fmi3Status status = find_closed(m);
    *more = *terminate = *nominals = *changed = *has_next = false;
    *next = 0.0;
    if (status) return status;
    if (has_drifted(m)) {
        memcpy(m->now.state, m->closed, sizeof m->closed);
        *changed = true;
    }
    for (int k = BREAKS - 1; k >= 0; k--) /* times at which the motion is not smooth */
        if (breaks[k] > m->now.t + SAME_TIME * (1 + fabs(m->now.t))) {
            *has_next = true;
            *next = breaks[k];
        }
    return fmi3OK;
}

FMI fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean no_set_state, fmi3Boolean *event,
    fmi3Boolean *terminate)
{
    REQUIRE(CONTINUOUS);
    const fmi3Status status = find_closed(m);
    *terminate = false;
    *event = !status && has_drifted(m);
    return status;
}

FMI fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 t)
{
    REQUIRE(CONTINUOUS | EVENT);
    if (!isfinite(t)) return report(m, fmi3Error, "the time must be finite");
    m->now.t = t;
    forget(m);
    return fmi3OK;
}

static fmi3Status check_count(const Instance *m, size_t n, const char *function)
{
    return n == 2 * N ? fmi3OK : report(m, fmi3Error, "%s: there are %d continuous states", function, 2 * N);
}

FMI fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t n)
{
    REQUIRE(CONTINUOUS);
    if (check_count(m, n, __func__)) return fmi3Error;
    for (int k = 0; k < 2 * N; k++)
        if (!isfinite(states[k])) return report(m, fmi3Discard, "the state %s is not finite", names[k]);
    memcpy(m->now.state, states, sizeof m->now.state);
    forget(m);
    return fmi3OK;
}

FMI fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t n)
{
    REQUIRE(ANY);
    if (check_count(m, n, __func__) || settle(m)) return fmi3Error;
    memcpy(states, m->now.state, sizeof m->now.state);
    return fmi3OK;
}

FMI fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 rates[], size_t n)
{
    REQUIRE(ANY & ~INSTANTIATED);
    if (check_count(m, n, __func__)) return fmi3Error;
    const fmi3Status status = find_accelerations(m);
    if (status) return status;
    for (int k = 0; k < 2 * N; k++) rates[k] = rate_of(m, k);
    return fmi3OK;
}

FMI fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t n)
{
    REQUIRE(ANY);
    if (check_count(m, n, __func__)) return fmi3Error;
    memcpy(nominals, nominal, sizeof nominal);
    return fmi3OK;
}

FMI fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 values[], size_t n)
{
    REQUIRE(ANY);
    return n ? report(m, fmi3Error, "the FMU has no event indicators") : fmi3OK;
}

/* --- derivatives */

#ifdef MODEL_EXCHANGE
/* Turn changes d of the state and of values, at their value references, into those of all unknowns. Before the run, the state is
   the guess, closed; in model exchange it is projected; in co-simulation it stays until the next step. */
static fmi3Status push(Instance *m, double *d)
{
    State *s = &m->now;
    const fmi3Status status = find_accelerations(m);
    double values[2 * VALUES + 1], numbers[NUMBERS], guessed[2 * N], changes[2 * N], *change = d + FIRST_STATE;
    if (status) return status;
    memcpy(values, s->values, VALUES * sizeof *values);
    memcpy(values + VALUES, d + FIRST_VALUE, VALUES * sizeof *values);
    SCENE_SET_ALONG(values, numbers);
    memcpy(guessed, m->closed, sizeof guessed);
    memcpy(changes, change, sizeof changes);
    for (int k = 0; k < 2 * N && s->mode & BEFORE; k++) {
        const int is_given = !isnan(s->given[k]);
        guessed[k] = is_given ? s->given[k] : s->numbers[guess[k]];
        changes[k] += is_given ? 0.0 : numbers[guess[k]];
    }
    if (m->is_model_exchange || s->mode & BEFORE)
        SCENE_CLOSE_ALONG(s->numbers, s->t, guessed, guessed + N, numbers, changes, changes + N, d + FIRST_Q, m->memory);
    else
        memcpy(d + FIRST_Q, changes, sizeof changes);
    if (s->mode & BEFORE) memcpy(change, d + FIRST_Q, sizeof changes);
    SCENE_ACCELERATIONS_ALONG(s->numbers, s->t, m->closed, m->closed + N, numbers, d + FIRST_Q, d + FIRST_V, guessed, d + FIRST_A,
        m->memory);
    find_measures(m, d);
    for (int k = 0; k < MEASURES; k++) d[FIRST_MEASURE + k] = m->measured[MEASURES + k];
    for (int k = 0; k < 2 * N; k++) d[FIRST_RATE + k] = d[FIRST_V + k] + DECAY * (d[FIRST_Q + k] - change[k]);
    return fmi3OK;
}

static fmi3Status check_variables(const Instance *m, const fmi3ValueReference unknowns[], size_t n_unknowns,
    const fmi3ValueReference knowns[], size_t n_knowns)
{
    for (size_t i = 0; i < n_unknowns; i++)
        if (unknowns[i] == 0 || (unknowns[i] >= FIRST_VALUE && unknowns[i] < FIRST_MEASURE) || unknowns[i] >= END)
            return report(m, fmi3Error, "there is no derivative of variable %u", (unsigned)unknowns[i]);
    for (size_t i = 0; i < n_knowns; i++)
        if (knowns[i] < FIRST_STATE || (knowns[i] >= FIRST_RATE && knowns[i] < FIRST_VALUE) || knowns[i] >= FIRST_MEASURE)
            return report(m, fmi3Error, "there is no derivative with respect to variable %u", (unsigned)knowns[i]);
    return fmi3OK;
}

#define DERIVATIVE(name, seeds, results) \
    FMI fmi3Status name(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns, \
        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[], \
        size_t n_sensitivity) \
    { \
        double d[END] = {0}; \
        REQUIRE(ANY & ~INSTANTIATED); \
        if (n_seed != seeds || n_sensitivity != results) return report(m, fmi3Error, "%s: wrong count of numbers", __func__); \
        if (check_variables(m, unknowns, n_unknowns, knowns, n_knowns)) return fmi3Error;

DERIVATIVE(fmi3GetDirectionalDerivative, n_knowns, n_unknowns)
    for (size_t i = 0; i < n_knowns; i++) d[knowns[i]] += seed[i];
    const fmi3Status status = push(m, d);
    for (size_t i = 0; i < n_unknowns; i++) sensitivity[i] = d[unknowns[i]];
    return status;
}

/* By the directional derivative along each known. */
DERIVATIVE(fmi3GetAdjointDerivative, n_unknowns, n_knowns)
    for (size_t j = 0; j < n_knowns; j++) {
        memset(d, 0, sizeof d);
        d[knowns[j]] = 1.0;
        const fmi3Status status = push(m, d);
        if (status) return status;
        sensitivity[j] = 0.0;
        for (size_t i = 0; i < n_unknowns; i++) sensitivity[j] += seed[i] * d[unknowns[i]];
    }
    return fmi3OK;
}
#endif

/* --- what the FMU lacks */

REFUSED(fmi3EnterConfigurationMode, ANY, "the FMU has no structural parameters")
REFUSED(fmi3ExitConfigurationMode, ANY, "the FMU has no structural parameters")

#define REFERENCES const fmi3ValueReference references[], size_t n
UNSUPPORTED(fmi3GetBinary, REFERENCES, size_t sizes[], fmi3Binary values[], size_t count)
UNSUPPORTED(fmi3SetBinary, REFERENCES, const size_t sizes[], const fmi3Binary values[], size_t count)
UNSUPPORTED(fmi3GetClock, REFERENCES, fmi3Clock values[])
UNSUPPORTED(fmi3SetClock, REFERENCES, const fmi3Clock values[])
UNSUPPORTED(fmi3GetNumberOfVariableDependencies, fmi3ValueReference reference, size_t *n)
UNSUPPORTED(fmi3GetVariableDependencies, fmi3ValueReference dependent, size_t elements[], fmi3ValueReference independents[],
    size_t others[], fmi3DependencyKind kinds[], size_t n)
#ifndef MODEL_EXCHANGE
#define SEEDS const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 found[]
UNSUPPORTED(fmi3GetDirectionalDerivative, REFERENCES, SEEDS, size_t count)
UNSUPPORTED(fmi3GetAdjointDerivative, REFERENCES, SEEDS, size_t count)
#endif
UNSUPPORTED(fmi3GetOutputDerivatives, REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[], size_t count)
UNSUPPORTED(fmi3GetIntervalDecimal, REFERENCES, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
UNSUPPORTED(fmi3GetIntervalFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
    fmi3IntervalQualifier qualifiers[])
UNSUPPORTED(fmi3GetShiftDecimal, REFERENCES, fmi3Float64 shifts[])
UNSUPPORTED(fmi3GetShiftFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
UNSUPPORTED(fmi3SetIntervalDecimal, REFERENCES, const fmi3Float64 intervals[])
UNSUPPORTED(fmi3SetIntervalFraction, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
UNSUPPORTED(fmi3SetShiftDecimal, REFERENCES, const fmi3Float64 shifts[])
UNSUPPORTED(fmi3SetShiftFraction, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
UNSUPPORTED(fmi3ActivateModelPartition, fmi3ValueReference clock, fmi3Float64 time)
