/* Functional Mock-up Interface 3.0, Model Exchange and Co-Simulation: the functions that an importer calls, for any model.

   model.h has the sizes of the model, model.c its tables and equations, token.h its identity. All numbers of an instance stand in one array
   `d` in the order of model.h, so that its state is copied as a whole. Nothing is allocated but instances and states. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3_types.h"
#include "model.h"
#include "token.h"

#define N_UNKNOWNS (NX + NY + NG)
#define ROOM(n) ((n) > 0 ? (n) : 1)

typedef enum { INSTANTIATED, INITIALIZING, EVENT_MODE, CONTINUOUS_TIME, STEP_MODE, TERMINATED } Mode;

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

typedef struct {
  double d[ND];
  double begin, stop, tolerance;
  double last;           /* the time of the last accepted step */
  double next_event, step; /* of Co-Simulation: when a clock ticks next, and the length of the next step */
  int mode, started;
} State;

typedef struct {
  State s;
  int valid;   /* whether `unknowns` belongs to `s` */
  int steps;   /* whether the instance integrates by itself */
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
  double unknowns[ROOM(N_UNKNOWNS)];
  double along[ND], weight[ROOM(N_UNKNOWNS)]; /* directions and weights of derivatives */
  double next[ND];
  double begin_x[ROOM(NX)], end_x[ROOM(NX)], error[ROOM(NX)], dense[ROOM(3 * NX)];
  double signs[ROOM(NG)];
  double work[WORK / 8 + 2];
} Instance;

#include "model.c"

/* --- messages ---------------------------------------------------------------------------------------------------- */

static void append(char *text, size_t room, const char *more) {
  const size_t used = strlen(text);
  if (used + 1 < room) strncat(text, more, room - used - 1);
}

static fmi3Status say(Instance *m, fmi3Status status, const char *before, const char *name, const char *after) {
  char text[1024] = "";
  append(text, sizeof text, before);
  append(text, sizeof text, name);
  append(text, sizeof text, after);
  if (m->log) m->log(m->environment, status, status == fmi3Discard ? "logStatusDiscard" : "logStatusError", text);
  return status;
}

static fmi3Status wrong_mode(Instance *m, const char *function) {
  return say(m, fmi3Error, function, "", " must not be called in this mode.");
}

static int is_number(double x) { return x - x == 0; }

/* --- evaluation -------------------------------------------------------------------------------------------------- */

static char *work_of(Instance *m) {
  return (char *)(((uintptr_t)m->work + 15) / 16 * 16);
}

/* A time that is nothing beside the run, but more than rounding. */
static double resolution(const State *s) {
  double largest = fabs(s->begin) > fabs(s->d[AT_T]) ? fabs(s->begin) : fabs(s->d[AT_T]);
  if (is_number(s->stop) && fabs(s->stop) > largest) largest = fabs(s->stop);
  if (is_number(s->stop) && s->stop - s->begin > largest) largest = s->stop - s->begin;
  return RESOLUTION * largest;
}

static fmi3Status ensure_start(Instance *m) {
  State *s = &m->s;
  if (s->started) return fmi3OK;
  double residual[ROOM(N_ROWS)], limit[ROOM(N_ROWS)];
  unsigned char fine = 0;
  p_start_of(s->d, resolution(s), &fine, residual, limit, work_of(m));
  m->valid = 0;
  for (int k = 0; k < N_ROWS; ++k)
    if (!(fabs(residual[k]) <= limit[k]))
      return say(m, fmi3Error, "There is no consistent start with these values: this does not hold: ", ROWS[k], ".");
  if (!fine) return say(m, fmi3Error, "There is no consistent start with these values.", "", "");
  s->started = 1;
  return fmi3OK;
}

/* Computes the unknowns. One that is no number means that the equations have no solution at this point. */
static fmi3Status ensure_unknowns(Instance *m) {
  if (m->valid) return fmi3OK;
  char *w = work_of(m);
  p_field_of(m->s.d, m->unknowns, w);
  p_outputs_of(m->s.d, m->unknowns + NX, w);
  p_guards_of(m->s.d, m->unknowns + NX + NY, w);
  m->valid = 1;
  return fmi3OK;
}

static fmi3Status check_unknowns(Instance *m, int begin, int end) {
  for (int k = begin; k < end; ++k)
    if (!is_number(m->unknowns[k]))
      return say(m, fmi3Discard, "The equations have no finite solution here: ", UNKNOWNS[k], " is not a number.");
  return fmi3OK;
}

/* What an importer watches: a guard, moved by its rounding band so that one which rests at zero, or is below it, has a
   sign. Armed guards are positive. */
static double indicator(const Instance *m, int k) {
  const double value = m->unknowns[NX + NY + k], *memory = m->s.d + AT_GUARDS;
  const double side = memory[k], band = BAND * memory[NG + k];
  if (side == ABOVE) return value;
  return side == RESTS ? value + band : value - band;
}

/* --- instances --------------------------------------------------------------------------------------------------- */

static void reset(Instance *m) {
  State *s = &m->s;
  memset(s, 0, sizeof *s);
  for (int k = 0; k < ND; ++k) s->d[k] = DEFAULTS[k];
  s->stop = NAN;
  s->tolerance = TOLERANCE;
  s->mode = INSTANTIATED;
  m->valid = 0;
}

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
  reset(m);
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
  if (events || !CO_SIMULATION) {
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
    fmi3Instance i, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 begin, fmi3Boolean has_stop,
    fmi3Float64 stop) {
  Instance *m = i;
  if (m->s.mode != INSTANTIATED) return wrong_mode(m, "fmi3EnterInitializationMode");
  if (!is_number(begin)) return say(m, fmi3Error, "The start time is not a number.", "", "");
  m->s.mode = INITIALIZING;
  m->s.d[AT_T] = m->s.begin = m->s.last = begin;
  m->s.stop = has_stop ? stop : NAN;
  if (has_tolerance && tolerance > 0) m->s.tolerance = tolerance;
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance i) {
  Instance *m = i;
  if (m->s.mode != INITIALIZING) return wrong_mode(m, "fmi3ExitInitializationMode");
  const fmi3Status status = ensure_start(m);
  if (status == fmi3OK) m->s.mode = m->steps ? STEP_MODE : EVENT_MODE;
  return status;
}

EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance i) {
  return say(i, fmi3Error, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance i) {
  return say(i, fmi3Error, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance i) {
  Instance *m = i;
  if (m->s.mode != CONTINUOUS_TIME && m->s.mode != EVENT_MODE) return wrong_mode(m, "fmi3EnterEventMode");
  m->s.mode = EVENT_MODE;
  return fmi3OK;
}

EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i) {
  Instance *m = i;
  if (m->s.mode != EVENT_MODE && m->s.mode != CONTINUOUS_TIME) return wrong_mode(m, "fmi3EnterContinuousTimeMode");
  m->s.mode = CONTINUOUS_TIME;
  return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance i) {
  ((Instance *)i)->s.mode = TERMINATED;
  return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance i) {
  reset(i);
  return fmi3OK;
}

/* --- variables --------------------------------------------------------------------------------------------------- */

static const Variable *variable(Instance *m, fmi3ValueReference r) {
  if (r < N_VARIABLES) return &VARIABLES[r];
  say(m, fmi3Error, "There is no variable with this value reference.", "", "");
  return NULL;
}

EXPORT fmi3Status fmi3GetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Float64 values[], size_t n_values) {
  Instance *m = i;
  size_t k = 0;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return fmi3Error;
    if (k + (size_t)v->size > n_values)
      return say(m, fmi3Error, "There is no room for the values of ", v->name, ".");
    int place = v->place;
    if (m->s.mode == INSTANTIATED) {
      if (v->kind != STORED)
        return say(m, fmi3Error, "", v->name, " has no value before initialization.");
      if (v->start >= 0) place = v->start;
    }
    if (m->s.mode == INITIALIZING && (v->kind != STORED || v->settable != ALWAYS || v->start >= 0)) {
      const fmi3Status status = ensure_start(m);
      if (status != fmi3OK) return status;
    }
    if (v->kind != STORED) ensure_unknowns(m);
    for (int q = 0; q < v->size; ++q)
      values[k++] = v->kind == STORED      ? m->s.d[place + q]
                    : v->kind == UNKNOWN   ? m->unknowns[place + q]
                                           : indicator(m, place + q);
  }
  return k == n_values ? fmi3OK : say(m, fmi3Error, "The number of values is not that of the variables.", "", "");
}

EXPORT fmi3Status fmi3SetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Float64 values[], size_t n_values) {
  Instance *m = i;
  size_t k = 0;
  const int early = m->s.mode == INSTANTIATED || m->s.mode == INITIALIZING;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return fmi3Error;
    if (k + (size_t)v->size > n_values) return say(m, fmi3Error, "There are too few values for ", v->name, ".");
    if (v->settable == NEVER) return say(m, fmi3Error, "", v->name, " cannot be set.");
    if (v->settable == BEFORE && !early) return say(m, fmi3Error, "", v->name, " can be set before the start only.");
    const int place = early && v->start >= 0 ? v->start : v->place;
    for (int q = 0; q < v->size; ++q) {
      const double value = values[k++];
      if (!is_number(value)) return say(m, fmi3Error, "The value given for ", v->name, " is not a finite number.");
      if (value < v->low || value > v->high)
        return say(m, fmi3Error, "The value given for ", v->name, " is out of its bounds.");
      m->s.d[place + q] = value;
    }
  }
  m->valid = 0;
  if (early) m->s.started = 0;
  return k == n_values ? fmi3OK : say(m, fmi3Error, "The number of values is not that of the variables.", "", "");
}

#define NOT_OF_TYPE(T)                                                                                              \
  EXPORT fmi3Status fmi3Get##T(fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3##T v[], size_t k) {     \
    (void)r; (void)v; (void)k;                                                                                      \
    return n ? say(i, fmi3Error, "All variables of this FMU are of type Float64, not " #T ".", "", "") : fmi3OK;    \
  }                                                                                                                 \
  EXPORT fmi3Status fmi3Set##T(fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3##T v[],           \
                               size_t k) {                                                                          \
    (void)r; (void)v; (void)k;                                                                                      \
    return n ? say(i, fmi3Error, "All variables of this FMU are of type Float64, not " #T ".", "", "") : fmi3OK;    \
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
  return n ? say(i, fmi3Error, "This FMU has no binary variables.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3SetBinary(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const size_t sizes[], const fmi3Binary v[], size_t k) {
  (void)r; (void)sizes; (void)v; (void)k;
  return n ? say(i, fmi3Error, "This FMU has no binary variables.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3GetClock(fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Clock v[]) {
  (void)r; (void)v;
  return n ? say(i, fmi3Error, "This FMU has no clocks.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3SetClock(fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Clock v[]) {
  (void)r; (void)v;
  return n ? say(i, fmi3Error, "This FMU has no clocks.", "", "") : fmi3OK;
}

EXPORT fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance i, fmi3ValueReference r, size_t *n) {
  (void)r; (void)n;
  return say(i, fmi3Error, "modelDescription.xml lists all dependencies.", "", "");
}

EXPORT fmi3Status fmi3GetVariableDependencies(
    fmi3Instance i, fmi3ValueReference r, size_t entries[], fmi3ValueReference independents[], size_t others[],
    fmi3DependencyKind kinds[], size_t n) {
  (void)r; (void)entries; (void)independents; (void)others; (void)kinds; (void)n;
  return say(i, fmi3Error, "modelDescription.xml lists all dependencies.", "", "");
}

/* --- the state of the FMU ---------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) {
  Instance *m = i;
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(m, fmi3Error, "There is no memory for a state.", "", "");
  memcpy(*state, &m->s, sizeof(State));
  return fmi3OK;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) {
  Instance *m = i;
  if (!state) return say(m, fmi3Error, "There is no such state.", "", "");
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
  if (n < sizeof TOKEN + sizeof(State)) return say(i, fmi3Error, "There is no room for the state.", "", "");
  memcpy(bytes, TOKEN, sizeof TOKEN);
  memcpy(bytes + sizeof TOKEN, state, sizeof(State));
  return fmi3OK;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t n, fmi3FMUState *state) {
  if (n != sizeof TOKEN + sizeof(State) || memcmp(bytes, TOKEN, sizeof TOKEN))
    return say(i, fmi3Error, "These bytes are not a state of this FMU.", "", "");
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(i, fmi3Error, "There is no memory for a state.", "", "");
  memcpy(*state, bytes + sizeof TOKEN, sizeof(State));
  return fmi3OK;
}

/* --- derivatives ------------------------------------------------------------------------------------------------- */

static fmi3Status may_differentiate(Instance *m) {
  if (m->s.mode == EVENT_MODE || m->s.mode == CONTINUOUS_TIME || m->s.mode == STEP_MODE) return fmi3OK;
  return say(m, fmi3Error, "Derivatives exist after initialization.", "", "");
}

static const Variable *known(Instance *m, fmi3ValueReference r) {
  const Variable *v = variable(m, r);
  if (v && !v->known) say(m, fmi3Error, "There is no derivative by ", v->name, ".");
  return v && v->known ? v : NULL;
}

/* An unknown is computed, or it is a state, whose derivative by itself is one. */
static const Variable *unknown(Instance *m, fmi3ValueReference r) {
  const Variable *v = variable(m, r);
  const int is_state = v && v->kind == STORED && v->place >= AT_X && v->place < AT_X + NX;
  if (v && v->kind != UNKNOWN && !is_state) say(m, fmi3Error, "There is no derivative of ", v->name, ".");
  return v && (v->kind == UNKNOWN || is_state) ? v : NULL;
}

EXPORT fmi3Status fmi3GetDirectionalDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  Instance *m = i;
  const fmi3Status status = may_differentiate(m);
  if (status != fmi3OK) return status;
  size_t k = 0;
  memset(m->along, 0, sizeof m->along);
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v || k + (size_t)v->size > n_seed) return fmi3Error;
    for (int q = 0; q < v->size; ++q) m->along[v->place + q] += seed[k++];
  }
  if (k != n_seed) return say(m, fmi3Error, "The number of seeds is not that of the knowns.", "", "");
  p_forward_of(m->s.d, m->along, m->weight, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_unknowns; ++j) {
    const Variable *v = unknown(m, unknowns[j]);
    if (!v || k + (size_t)v->size > n_out) return fmi3Error;
    for (int q = 0; q < v->size; ++q)
      out[k++] = v->kind == UNKNOWN ? m->weight[v->place + q] : m->along[v->place + q];
  }
  return k == n_out ? fmi3OK : say(m, fmi3Error, "The number of sensitivities is not that of the unknowns.", "", "");
}

EXPORT fmi3Status fmi3GetAdjointDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  Instance *m = i;
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
  if (k != n_seed) return say(m, fmi3Error, "The number of seeds is not that of the unknowns.", "", "");
  p_reverse_of(m->s.d, m->weight, m->along, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v || k + (size_t)v->size > n_out) return fmi3Error;
    for (int q = 0; q < v->size; ++q) {
      out[k++] = m->along[v->place + q] + m->next[v->place + q];
    }
  }
  return k == n_out ? fmi3OK : say(m, fmi3Error, "The number of sensitivities is not that of the knowns.", "", "");
}

/* --- Model Exchange ---------------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 t) {
  Instance *m = i;
  if (!is_number(t)) return say(m, fmi3Error, "The time is not a number.", "", "");
  m->s.d[AT_T] = t;
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 x[], size_t n) {
  Instance *m = i;
  if (n != NX) return say(m, fmi3Error, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k)
    if (!is_number(x[k])) return say(m, fmi3Discard, "The state that follows ", UNKNOWNS[k], " is not a number.");
  if (NX) memcpy(m->s.d + AT_X, x, NX * sizeof *x);
  m->valid = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
  Instance *m = i;
  if (n != NX) return say(m, fmi3Error, "The number of states is another one.", "", "");
  if (m->s.mode == INITIALIZING || m->s.mode == INSTANTIATED) {
    const fmi3Status status = ensure_start(m);
    if (status != fmi3OK) return status;
  }
  if (NX) memcpy(x, m->s.d + AT_X, NX * sizeof *x);
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
  if (n != NX) return say(i, fmi3Error, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k) x[k] = NOMINALS[k];
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 dx[], size_t n) {
  Instance *m = i;
  if (n != NX) return say(m, fmi3Error, "The number of states is another one.", "", "");
  /* An integrator asks for derivatives far more often than for anything else. */
  if (!m->valid) p_field_of(m->s.d, m->unknowns, work_of(m));
  if (NX) memcpy(dx, m->unknowns, NX * sizeof *dx);
  return check_unknowns(m, 0, NX);
}

EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 z[], size_t n) {
  Instance *m = i;
  if (n != NG) return say(m, fmi3Error, "The number of event indicators is another one.", "", "");
  if (!m->valid) p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) z[k] = indicator(m, k);
  return check_unknowns(m, NX + NY, N_UNKNOWNS);
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

/* After a step: what it leaves behind, and whether an event is due. */
static fmi3Status accepted(Instance *m, int *wants_event) {
  State *s = &m->s;
  unsigned char wants = 0;
  memcpy(m->next, s->d, sizeof s->d);
  p_accept_of(s->d, resolution(s), s->tolerance * DRIFT, s->d[AT_T] - s->last, m->next, &wants, work_of(m));
  for (int k = 0; k < NZ; ++k)
    if (!is_number(m->next[AT_Z + k]))
      return say(m, fmi3Discard, "The equations have no solution here: ", CARRIED[k], " is not a number.");
  memcpy(s->d, m->next, sizeof s->d);
  s->last = s->d[AT_T];
  *wants_event = wants;
  return fmi3OK;
}

typedef struct { int again, terminate, states, has_next; double next; } Update;

/* What happens at the present instant. */
static fmi3Status updated(Instance *m, Update *u) {
  State *s = &m->s;
  memset(u, 0, sizeof *u);
  unsigned char fired = 0, fine = 0;
  memcpy(m->next, s->d, sizeof s->d);
  p_event_of(s->d, resolution(s), s->tolerance * DRIFT, m->next, &fired, &fine, work_of(m));
  m->valid = 0;
  const double *run = m->next + AT_RUN;
  const int stuck = (int)run[STUCK_AT];
  if (stuck >= 0 && stuck < N_EVENTS && run[ENDED_AT] == 0)
    return say(m, fmi3Error, "This event happens again and again at one instant: ", EVENTS[stuck], ".");
  if (stuck < -1)
    return say(m, fmi3Error, "Two events give one variable different values at one instant.", "", "");
  if (!fine) return say(m, fmi3Discard, "After the events of this instant the equations have no finite solution.", "", "");
  u->states = NX > 0 && memcmp(s->d + AT_X, m->next + AT_X, NX * sizeof *s->d) != 0;
  memcpy(s->d, m->next, sizeof s->d);
  s->last = s->d[AT_T];
  u->again = fired;
  u->terminate = run[ENDED_AT] > 0;
  for (int k = 0; k < NC; ++k) {
    const double due = s->d[AT_CLOCKS + NC + k];
    if (is_number(due) && (!u->has_next || due < u->next)) {
      u->has_next = 1;
      u->next = due;
    }
  }
  return fmi3OK;
}

EXPORT fmi3Status fmi3CompletedIntegratorStep(
    fmi3Instance i, fmi3Boolean final, fmi3Boolean *enter_event_mode, fmi3Boolean *terminate) {
  Instance *m = i;
  int wants = 0;
  (void)final;
  *enter_event_mode = *terminate = false;
  if (m->s.mode != CONTINUOUS_TIME) return wrong_mode(m, "fmi3CompletedIntegratorStep");
  const fmi3Status status = accepted(m, &wants);
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
  Instance *m = i;
  Update u;
  *again = *terminate = *nominals = *states = *has_next = false;
  *next = 0;
  if (m->s.mode != EVENT_MODE) return wrong_mode(m, "fmi3UpdateDiscreteStates");
  const fmi3Status status = updated(m, &u);
  *again = u.again != 0;
  *terminate = u.terminate != 0;
  *states = u.states != 0;
  *has_next = u.has_next != 0;
  *next = u.next;
  return status;
}

/* --- Co-Simulation ----------------------------------------------------------------------------------------------- */

#if CO_SIMULATION

/* How the next step follows from the error of the last one. */
static const double SAFETY = 0.9, LEAST = 0.2, MOST = 5.0;

static double weighted(const Instance *m, const double *v, const double *x, const double *y) {
  double sum = 0;
  for (int k = 0; k < NX; ++k) {
    const double largest = fabs(x[k]) > fabs(y[k]) ? fabs(x[k]) : fabs(y[k]);
    const double part = v[k] / (m->s.tolerance * (largest + ABSOLUTE * NOMINALS[k]));
    sum += part * part;
  }
  return NX ? sqrt(sum / NX) : 0;
}

/* A first step (Hairer, Norsett and Wanner 1993, Solving Ordinary Differential Equations I, II.4). */
static double first_step(Instance *m, double longest) {
  const double *x = m->s.d + AT_X;
  p_field_of(m->s.d, m->error, work_of(m));
  const double size = weighted(m, x, x, x), slope = weighted(m, m->error, x, x);
  const double h = size > 1e-5 && slope > 1e-5 ? 0.01 * size / slope : 1e-6 * longest;
  return h < longest ? h : longest;
}

/* The state at a part of the step from `begin_x` to `end_x`. */
static void inside(Instance *m, double t0, double h, double part) {
  double *x = m->s.d + AT_X;
  const double *k = m->dense;
  m->s.d[AT_T] = t0 + part * h;
  for (int j = 0; j < NX; ++j)
    x[j] = part >= 1 ? m->end_x[j]
                     : (1 - part) * m->begin_x[j]
                           + part * (m->end_x[j] + (1 - part) * (k[j] + part * (k[NX + j] + part * k[2 * NX + j])));
  m->valid = 0;
}

static void look(Instance *m, double *signs) {
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) signs[k] = indicator(m, k);
}

/* Whether an indicator has another sign than at the beginning of the step. */
static int turned(Instance *m, double t0, double h, double part) {
  inside(m, t0, h, part);
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k)
    if ((indicator(m, k) > 0) != (m->signs[k] > 0)) return 1;
  return 0;
}

/* All events of this instant. */
static fmi3Status happened(Instance *m, int *terminate) {
  Update u;
  fmi3Status status;
  do {
    status = updated(m, &u);
    if (status != fmi3OK) return status;
    *terminate |= u.terminate;
  } while (u.again && !*terminate);
  m->s.next_event = u.has_next ? u.next : INFINITY;
  look(m, m->signs);
  return fmi3OK;
}

static fmi3Status advance(Instance *m, double end, int *terminate) {
  State *s = &m->s;
  const double least = resolution(s);
  fmi3Status status = happened(m, terminate); /* inputs may have jumped */
  while (status == fmi3OK && !*terminate && s->d[AT_T] < end) {
    const double t0 = s->d[AT_T], until = s->next_event < end ? s->next_event : end;
    if (until - t0 <= least) { /* a tick at the end of this step, or at its beginning */
      s->d[AT_T] = until;
      if (s->next_event <= end) status = happened(m, terminate);
      continue;
    }
    if (!(s->step > 0)) s->step = first_step(m, until - t0);
    const int cut = s->step > SAFETY * (until - t0);
    const double h = cut ? until - t0 : s->step;
    memcpy(m->begin_x, s->d + AT_X, sizeof m->begin_x * (NX > 0));
    p_step_of(s->d, h, m->end_x, m->error, m->dense, work_of(m));
    const double norm = weighted(m, m->error, m->begin_x, m->end_x);
    double factor = norm > 0 ? SAFETY * pow(norm, -1.0 / 5) : MOST;
    factor = !(factor > LEAST) ? LEAST : factor > MOST ? MOST : factor; /* the least for what is not a number */
    if (!(norm <= 1)) {
      s->step = h * factor;
      if (s->step <= least) {
        int worst = 0;
        for (int k = 1; k < NX; ++k)
          if (!(fabs(m->error[k]) / NOMINALS[k] <= fabs(m->error[worst]) / NOMINALS[worst])) worst = k;
        return say(m, fmi3Discard, "Steps have become too short, because of ", UNKNOWNS[worst], ".");
      }
      continue;
    }
    double begin = 0, part = 1;
    int event = 0;
    if (NG > 0)
      for (int k = 1; k <= LOOKS && !event; ++k) {
        part = (double)k / LOOKS;
        event = turned(m, t0, h, part);
        if (!event) begin = part;
      }
    if (event) { /* the first change of a sign, to the resolution of time */
      while ((part - begin) * h > 0.25 * least) {
        const double middle = 0.5 * (begin + part);
        if (middle <= begin || middle >= part) break;
        if (turned(m, t0, h, middle)) part = middle;
        else begin = middle;
      }
    }
    inside(m, t0, h, part);
    if (part >= 1 && cut) s->d[AT_T] = until;
    if (!cut || factor < 1) s->step = h * factor;
    int wants = 0;
    status = accepted(m, &wants);
    if (status == fmi3OK && (event || wants || (s->next_event <= end && s->d[AT_T] >= s->next_event)))
      status = happened(m, terminate);
    else
      look(m, m->signs);
  }
  m->valid = 0;
  return status;
}

EXPORT fmi3Status fmi3DoStep(
    fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate,
    fmi3Boolean *early, fmi3Float64 *last) {
  Instance *m = i;
  int ended = 0;
  (void)final;
  *event = *terminate = *early = false;
  *last = m->s.d[AT_T];
  if (m->s.mode != STEP_MODE) return wrong_mode(m, "fmi3DoStep");
  if (!is_number(t) || !is_number(h) || !(h > 0)) return say(m, fmi3Error, "The step is not positive.", "", "");
  if (fabs(t - m->s.d[AT_T]) > 1e-9 * (fabs(t) + h))
    return say(m, fmi3Error, "The communication point is not where the last step ended.", "", "");
  const fmi3Status status = advance(m, t + h, &ended);
  *terminate = ended != 0;
  *last = m->s.d[AT_T];
  return status;
}

#else

EXPORT fmi3Status fmi3DoStep(
    fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate,
    fmi3Boolean *early, fmi3Float64 *last) {
  (void)t; (void)h; (void)final; (void)event; (void)terminate; (void)early; (void)last;
  return say(i, fmi3Error, "This FMU has Model Exchange only.", "", "");
}

#endif

/* --- what this FMU has not --------------------------------------------------------------------------------------- */

static fmi3Status no_clocks(fmi3Instance i) { return say(i, fmi3Error, "This FMU has no clocks.", "", ""); }

EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance i) {
  return say(i, fmi3Error, "This FMU handles its events itself in Co-Simulation.", "", "");
}

EXPORT fmi3Status fmi3GetOutputDerivatives(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Int32 orders[], fmi3Float64 v[], size_t k) {
  (void)r; (void)orders; (void)v; (void)k;
  return n ? say(i, fmi3Error, "This FMU has no derivatives of outputs by time.", "", "") : fmi3OK;
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
