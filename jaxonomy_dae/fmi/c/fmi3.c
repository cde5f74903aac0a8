/* Functional Mock-up Interface 3.0, Model Exchange and Co-Simulation: the functions that an importer calls, for any model.

   model.h has the sizes of the model, model.c its equations, run.h and run.c what it does in time, variables.c the table of its variables,
   token.h its identity. Nothing is allocated but instances and states. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3_types.h"
#include "model.h"
#include "run.h"
#include "token.h"

#include "model.c"
#include "run.c"

/* Modes of an instance. */
enum { INSTANTIATED, INITIALIZING, EVENT_MODE, CONTINUOUS_TIME, STEP_MODE, TERMINATED };

/* What a variable is: an entry of `d`, one of the unknowns (derivatives, outputs, guards), or an event indicator. */
typedef enum { STORED, UNKNOWN, INDICATOR } Kind;

/* When a variable may be set: never, until initialization ends, or at any time. */
typedef enum { NEVER, BEFORE, ALWAYS } Settable;

typedef struct {
  Kind kind;
  Settable settable;
  int place;     /* in `d`, among the unknowns, or among the indicators */
  int size;
  int start;     /* of a state with a start of its own: its place in `d`, else -1 */
  int known;     /* whether derivatives by it exist */
  double low, high;
  const char *name;
} Variable;

#include "variables.c"

typedef struct {
  Model m;   /* first: an instance is its model, too */
  int steps; /* whether the instance integrates by itself */
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
} Instance;

/* --- messages ---------------------------------------------------------------------------------------------------- */

/* Tells the importer what went wrong, if anything did. */
static fmi3Status logged(Model *m, int found) {
  const Instance *own = (const Instance *)m;
  const fmi3Status status = found == OK ? fmi3OK : found == DISCARD ? fmi3Discard : fmi3Error;
  if (found != OK && own->log)
    own->log(own->environment, status, found == DISCARD ? "logStatusDiscard" : "logStatusError", m->message);
  return status;
}

static fmi3Status say(Model *m, const char *before, const char *name, const char *after) {
  return logged(m, failure(m, FAILED, before, name, after));
}

static fmi3Status wrong_mode(Model *m, const char *function) {
  return say(m, function, "", " must not be called in this mode.");
}

/* Computes the unknowns. One that is no number means that the equations have no solution at this point. */
static void ensure_unknowns(Model *m) {
  if (m->valid) return;
  char *w = work_of(m);
  p_field_of(m->s.d, m->unknowns, w);
  p_outputs_of(m->s.d, m->unknowns + NX, w);
  p_guards_of(m->s.d, m->unknowns + NX + NY, w);
  m->valid = 1;
}

/* --- instances --------------------------------------------------------------------------------------------------- */

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t n, const fmi3String categories[]) {
  (void)i; (void)on; (void)n; (void)categories;
  return fmi3OK;
}

static Instance *instance(fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
  if (!token || strcmp(token, TOKEN)) {
    if (log)
      log(environment, fmi3Error, "logStatusError",
          "The instantiation token does not belong to this binary: it was made from another modelDescription.xml.");
    return NULL;
  }
  Instance *m = calloc(1, sizeof *m);
  if (!m) return NULL;
  reset(&m->m);
  m->log = log;
  m->environment = environment;
  return m;
}

EXPORT fmi3Instance fmi3InstantiateModelExchange(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
  (void)name; (void)path; (void)visible; (void)logging;
  return instance(token, environment, log);
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
  (void)name; (void)path; (void)visible; (void)logging; (void)early; (void)required; (void)n; (void)update;
  if (events || !HAS_STEP) {
    if (log)
      log(environment, fmi3Error, "logStatusError",
          events ? "This FMU handles its events itself in Co-Simulation." : "This FMU has Model Exchange only.");
    return NULL;
  }
  Instance *m = instance(token, environment, log);
  if (m) m->steps = 1;
  return m;
}

EXPORT fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) {
  (void)name; (void)token; (void)path; (void)visible; (void)logging; (void)update; (void)lock; (void)unlock;
  if (log) log(environment, fmi3Error, "logStatusError", "This FMU has no Scheduled Execution.");
  return NULL;
}

EXPORT void fmi3FreeInstance(fmi3Instance i) { free(i); }

EXPORT fmi3Status fmi3EnterInitializationMode(
    fmi3Instance i, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 t, fmi3Boolean has_stop,
    fmi3Float64 stop) {
  Model *m = i;
  if (m->s.mode != INSTANTIATED) return wrong_mode(m, "fmi3EnterInitializationMode");
  if (!is_number(t)) return say(m, "The start time is not a number.", "", "");
  m->s.mode = INITIALIZING;
  begin(m, t, has_stop ? stop : NAN, has_tolerance ? tolerance : 0);
  return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance i) {
  Model *m = i;
  if (m->s.mode != INITIALIZING) return wrong_mode(m, "fmi3ExitInitializationMode");
  const fmi3Status status = logged(m, ensure_start(m));
  if (status == fmi3OK) m->s.mode = ((const Instance *)m)->steps ? STEP_MODE : EVENT_MODE;
  return status;
}

EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance i) {
  return say(i, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance i) {
  return say(i, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance i) {
  Model *m = i;
  if (m->s.mode != CONTINUOUS_TIME && m->s.mode != EVENT_MODE) return wrong_mode(m, "fmi3EnterEventMode");
  m->s.mode = EVENT_MODE;
  return fmi3OK;
}

EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i) {
  Model *m = i;
  if (m->s.mode != EVENT_MODE && m->s.mode != CONTINUOUS_TIME) return wrong_mode(m, "fmi3EnterContinuousTimeMode");
  m->s.mode = CONTINUOUS_TIME;
  return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance i) {
  ((Model *)i)->s.mode = TERMINATED;
  return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance i) {
  reset(i); /* to the mode of a new instance */
  return fmi3OK;
}

/* --- variables --------------------------------------------------------------------------------------------------- */

static const Variable *variable(Model *m, fmi3ValueReference r) {
  if (r < N_VARIABLES) return &VARIABLES[r];
  say(m, "There is no variable with this value reference.", "", "");
  return NULL;
}

EXPORT fmi3Status fmi3GetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Float64 values[], size_t n_values) {
  Model *m = i;
  size_t k = 0;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return fmi3Error;
    if (k + (size_t)v->size > n_values)
      return say(m, "There is no room for the values of ", v->name, ".");
    int place = v->place;
    if (m->s.mode == INSTANTIATED) {
      if (v->kind != STORED)
        return say(m, "", v->name, " has no value before initialization.");
      if (v->start >= 0) place = v->start;
    }
    if (m->s.mode == INITIALIZING && (v->kind != STORED || v->settable != ALWAYS || v->start >= 0)) {
      const fmi3Status status = logged(m, ensure_start(m));
      if (status != fmi3OK) return status;
    }
    if (v->kind != STORED) ensure_unknowns(m);
    for (int q = 0; q < v->size; ++q)
      values[k++] = v->kind == STORED      ? m->s.d[place + q]
                    : v->kind == UNKNOWN   ? m->unknowns[place + q]
                                           : indicator(m, place + q);
  }
  return k == n_values ? fmi3OK : say(m, "The number of values is not that of the variables.", "", "");
}

EXPORT fmi3Status fmi3SetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Float64 values[], size_t n_values) {
  Model *m = i;
  size_t k = 0;
  const int early = m->s.mode == INSTANTIATED || m->s.mode == INITIALIZING;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return fmi3Error;
    if (k + (size_t)v->size > n_values) return say(m, "There are too few values for ", v->name, ".");
    if (v->settable == NEVER) return say(m, "", v->name, " cannot be set.");
    if (v->settable == BEFORE && !early) return say(m, "", v->name, " can be set before the start only.");
    const int place = early && v->start >= 0 ? v->start : v->place;
    for (int q = 0; q < v->size; ++q) {
      const double value = values[k++];
      if (!is_number(value)) return say(m, "The value given for ", v->name, " is not a finite number.");
      if (value < v->low || value > v->high)
        return say(m, "The value given for ", v->name, " is out of its bounds.");
      m->s.d[place + q] = value;
    }
  }
  m->valid = 0;
  if (early) m->s.started = 0;
  return k == n_values ? fmi3OK : say(m, "The number of values is not that of the variables.", "", "");
}

#define NOT_OF_TYPE(T)                                                                                              \
  EXPORT fmi3Status fmi3Get##T(fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3##T v[], size_t k) {     \
    (void)r; (void)v; (void)k;                                                                                      \
    return n ? say(i, "All variables of this FMU are of type Float64, not " #T ".", "", "") : fmi3OK;    \
  }                                                                                                                 \
  EXPORT fmi3Status fmi3Set##T(fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3##T v[],           \
                               size_t k) {                                                                          \
    (void)r; (void)v; (void)k;                                                                                      \
    return n ? say(i, "All variables of this FMU are of type Float64, not " #T ".", "", "") : fmi3OK;    \
  }
NOT_OF_TYPE(Float32)
NOT_OF_TYPE(Int8)
NOT_OF_TYPE(UInt8)
NOT_OF_TYPE(Int16)
NOT_OF_TYPE(UInt16)
NOT_OF_TYPE(Int32)
NOT_OF_TYPE(UInt32)
NOT_OF_TYPE(Int64)
NOT_OF_TYPE(UInt64)
NOT_OF_TYPE(Boolean)
NOT_OF_TYPE(String)

EXPORT fmi3Status fmi3GetBinary(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, size_t sizes[], fmi3Binary v[], size_t k) {
  (void)r; (void)sizes; (void)v; (void)k;
  return n ? say(i, "This FMU has no binary variables.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3SetBinary(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const size_t sizes[], const fmi3Binary v[], size_t k) {
  (void)r; (void)sizes; (void)v; (void)k;
  return n ? say(i, "This FMU has no binary variables.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3GetClock(fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Clock v[]) {
  (void)r; (void)v;
  return n ? say(i, "This FMU has no clocks.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3SetClock(fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Clock v[]) {
  (void)r; (void)v;
  return n ? say(i, "This FMU has no clocks.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance i, fmi3ValueReference r, size_t *n) {
  (void)r; (void)n;
  return say(i, "modelDescription.xml lists all dependencies.", "", "");
}

EXPORT fmi3Status fmi3GetVariableDependencies(
    fmi3Instance i, fmi3ValueReference r, size_t entries[], fmi3ValueReference independents[], size_t others[],
    fmi3DependencyKind kinds[], size_t n) {
  (void)r; (void)entries; (void)independents; (void)others; (void)kinds; (void)n;
  return say(i, "modelDescription.xml lists all dependencies.", "", "");
}

/* --- the state of the FMU ---------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) {
  Model *m = i;
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(m, "There is no memory for a state.", "", "");
  memcpy(*state, &m->s, sizeof(State));
  return fmi3OK;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) {
  Model *m = i;
  if (!state) return say(m, "There is no such state.", "", "");
  memcpy(&m->s, state, sizeof(State));
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) {
  (void)i;
  if (state) {
    free(*state);
    *state = NULL;
  }
  return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *n) {
  (void)i; (void)state;
  *n = sizeof TOKEN + sizeof(State);
  return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t n) {
  if (n < sizeof TOKEN + sizeof(State)) return say(i, "There is no room for the state.", "", "");
  memcpy(bytes, TOKEN, sizeof TOKEN);
  memcpy(bytes + sizeof TOKEN, state, sizeof(State));
  return fmi3OK;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t n, fmi3FMUState *state) {
  if (n != sizeof TOKEN + sizeof(State) || memcmp(bytes, TOKEN, sizeof TOKEN))
    return say(i, "These bytes are not a state of this FMU.", "", "");
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(i, "There is no memory for a state.", "", "");
  memcpy(*state, bytes + sizeof TOKEN, sizeof(State));
  return fmi3OK;
}

/* --- derivatives ------------------------------------------------------------------------------------------------- */

static fmi3Status may_differentiate(Model *m) {
  if (m->s.mode == EVENT_MODE || m->s.mode == CONTINUOUS_TIME || m->s.mode == STEP_MODE) return fmi3OK;
  return say(m, "Derivatives exist after initialization.", "", "");
}

static const Variable *known(Model *m, fmi3ValueReference r) {
  const Variable *v = variable(m, r);
  if (v && !v->known) say(m, "There is no derivative by ", v->name, ".");
  return v && v->known ? v : NULL;
}

/* An unknown is computed, or it is a state, whose derivative by itself is one. */
static const Variable *unknown(Model *m, fmi3ValueReference r) {
  const Variable *v = variable(m, r);
  const int is_state = v && v->kind == STORED && v->place >= AT_X && v->place < AT_X + NX;
  if (v && v->kind != UNKNOWN && !is_state) say(m, "There is no derivative of ", v->name, ".");
  return v && (v->kind == UNKNOWN || is_state) ? v : NULL;
}

EXPORT fmi3Status fmi3GetDirectionalDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  Model *m = i;
  const fmi3Status status = may_differentiate(m);
  if (status != fmi3OK) return status;
  size_t k = 0;
  memset(m->along, 0, sizeof m->along);
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v || k + (size_t)v->size > n_seed) return fmi3Error;
    for (int q = 0; q < v->size; ++q) m->along[v->place + q] += seed[k++];
  }
  if (k != n_seed) return say(m, "The number of seeds is not that of the knowns.", "", "");
  p_forward_of(m->s.d, m->along, m->weight, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_unknowns; ++j) {
    const Variable *v = unknown(m, unknowns[j]);
    if (!v || k + (size_t)v->size > n_out) return fmi3Error;
    for (int q = 0; q < v->size; ++q)
      out[k++] = v->kind == UNKNOWN ? m->weight[v->place + q] : m->along[v->place + q];
  }
  return k == n_out ? fmi3OK : say(m, "The number of sensitivities is not that of the unknowns.", "", "");
}

EXPORT fmi3Status fmi3GetAdjointDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  Model *m = i;
  const fmi3Status status = may_differentiate(m);
  if (status != fmi3OK) return status;
  size_t k = 0;
  memset(m->weight, 0, sizeof m->weight);
  memset(m->next, 0, sizeof m->next); /* the weights of states that are unknowns themselves */
  for (size_t j = 0; j < n_unknowns; ++j) {
    const Variable *v = unknown(m, unknowns[j]);
    if (!v || k + (size_t)v->size > n_seed) return fmi3Error;
    for (int q = 0; q < v->size; ++q) *(v->kind == UNKNOWN ? &m->weight[v->place + q] : &m->next[v->place + q]) += seed[k++];
  }
  if (k != n_seed) return say(m, "The number of seeds is not that of the unknowns.", "", "");
  p_reverse_of(m->s.d, m->weight, m->along, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v || k + (size_t)v->size > n_out) return fmi3Error;
    for (int q = 0; q < v->size; ++q) {
      out[k++] = m->along[v->place + q] + m->next[v->place + q];
    }
  }
  return k == n_out ? fmi3OK : say(m, "The number of sensitivities is not that of the knowns.", "", "");
}

/* --- Model Exchange ---------------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 t) {
  Model *m = i;
  if (!is_number(t)) return say(m, "The time is not a number.", "", "");
  m->s.d[AT_T] = t;
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 x[], size_t n) {
  Model *m = i;
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k)
    if (!is_number(x[k]))
      return logged(m, failure(m, DISCARD, "The state that follows ", UNKNOWNS[k], " is not a number."));
  if (NX) memcpy(m->s.d + AT_X, x, NX * sizeof *x);
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
  Model *m = i;
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  if (m->s.mode == INITIALIZING || m->s.mode == INSTANTIATED) {
    const fmi3Status status = logged(m, ensure_start(m));
    if (status != fmi3OK) return status;
  }
  if (NX) memcpy(x, m->s.d + AT_X, NX * sizeof *x);
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
  if (n != NX) return say(i, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k) x[k] = NOMINALS[k];
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 dx[], size_t n) {
  Model *m = i;
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  /* An integrator asks for derivatives far more often than for anything else. */
  if (!m->valid) p_field_of(m->s.d, m->unknowns, work_of(m));
  if (NX) memcpy(dx, m->unknowns, NX * sizeof *dx);
  return logged(m, check_unknowns(m, 0, NX));
}

EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 z[], size_t n) {
  Model *m = i;
  if (n != NG) return say(m, "The number of event indicators is another one.", "", "");
  if (!m->valid) p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) z[k] = indicator(m, k);
  return logged(m, check_unknowns(m, NX + NY, N_UNKNOWNS));
}

EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance i, size_t *n) {
  (void)i;
  *n = NG;
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance i, size_t *n) {
  (void)i;
  *n = NX;
  return fmi3OK;
}

EXPORT fmi3Status fmi3CompletedIntegratorStep(
    fmi3Instance i, fmi3Boolean final, fmi3Boolean *enter_event_mode, fmi3Boolean *terminate) {
  Model *m = i;
  int wants = 0;
  (void)final;
  *enter_event_mode = *terminate = false;
  if (m->s.mode != CONTINUOUS_TIME) return wrong_mode(m, "fmi3CompletedIntegratorStep");
  const fmi3Status status = logged(m, accepted(m, &wants));
  *enter_event_mode = wants != 0;
  return status;
}

EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance i) {
  (void)i;
  return fmi3OK;
}

EXPORT fmi3Status fmi3UpdateDiscreteStates(
    fmi3Instance i, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals, fmi3Boolean *states,
    fmi3Boolean *has_next, fmi3Float64 *next) {
  Model *m = i;
  Update u;
  *again = *terminate = *nominals = *states = *has_next = false;
  *next = 0;
  if (m->s.mode != EVENT_MODE) return wrong_mode(m, "fmi3UpdateDiscreteStates");
  const fmi3Status status = logged(m, updated(m, &u));
  *again = u.again != 0;
  *terminate = u.terminate != 0;
  *states = u.states != 0;
  *has_next = u.has_next != 0;
  *next = u.next;
  return status;
}

/* --- Co-Simulation ----------------------------------------------------------------------------------------------- */

#if HAS_STEP

EXPORT fmi3Status fmi3DoStep(
    fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate,
    fmi3Boolean *early, fmi3Float64 *last) {
  Model *m = i;
  int ended = 0;
  (void)final;
  *event = *terminate = *early = false;
  *last = m->s.d[AT_T];
  if (m->s.mode != STEP_MODE) return wrong_mode(m, "fmi3DoStep");
  if (!is_number(t) || !is_number(h) || !(h > 0)) return say(m, "The step is not positive.", "", "");
  if (fabs(t - m->s.d[AT_T]) > 1e-9 * (fabs(t) + h))
    return say(m, "The communication point is not where the last step ended.", "", "");
  const fmi3Status status = logged(m, advance(m, t + h, &ended));
  *terminate = ended != 0;
  *last = m->s.d[AT_T];
  return status;
}

#else

EXPORT fmi3Status fmi3DoStep(
    fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate,
    fmi3Boolean *early, fmi3Float64 *last) {
  (void)t; (void)h; (void)final; (void)event; (void)terminate; (void)early; (void)last;
  return say(i, "This FMU has Model Exchange only.", "", "");
}

#endif

/* --- what this FMU has not --------------------------------------------------------------------------------------- */

static fmi3Status no_clocks(fmi3Instance i) { return say(i, "This FMU has no clocks.", "", ""); }

EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance i) {
  return say(i, "This FMU handles its events itself in Co-Simulation.", "", "");
}

EXPORT fmi3Status fmi3GetOutputDerivatives(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Int32 orders[], fmi3Float64 v[], size_t k) {
  (void)r; (void)orders; (void)v; (void)k;
  return n ? say(i, "This FMU has no derivatives of outputs by time.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3ActivateModelPartition(fmi3Instance i, fmi3ValueReference r, fmi3Float64 t) {
  (void)r; (void)t;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3GetIntervalDecimal(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Float64 v[], fmi3IntervalQualifier q[]) {
  (void)r; (void)n; (void)v; (void)q;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3GetIntervalFraction(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[]) {
  (void)r; (void)n; (void)a; (void)b; (void)q;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3GetShiftDecimal(fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Float64 v[]) {
  (void)r; (void)n; (void)v;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3GetShiftFraction(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3UInt64 a[], fmi3UInt64 b[]) {
  (void)r; (void)n; (void)a; (void)b;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3SetIntervalDecimal(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Float64 v[]) {
  (void)r; (void)n; (void)v;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3SetIntervalFraction(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]) {
  (void)r; (void)n; (void)a; (void)b;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3SetShiftDecimal(fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Float64 v[]) {
  (void)r; (void)n; (void)v;
  return no_clocks(i);
}

EXPORT fmi3Status fmi3SetShiftFraction(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]) {
  (void)r; (void)n; (void)a; (void)b;
  return no_clocks(i);
}
