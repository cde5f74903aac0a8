/* Functional Mock-up Interface 3.0, Model Exchange and Co-Simulation: the functions that an importer calls, for any model.
   instance.c has what all versions of the interface share. */

#include "fmi3_types.h"

typedef struct {
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
} Environment;

#include "instance.c"

static void tell(const Environment *to, int status, const char *category, const char *text) {
  if (to->log) to->log(to->environment, (fmi3Status)status, category, text);
}

/* --- instances --------------------------------------------------------------------------------------------------- */

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t n, const fmi3String categories[]) {
  (void)i; (void)on; (void)n; (void)categories;
  return fmi3OK;
}

EXPORT fmi3Instance fmi3InstantiateModelExchange(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
  const Environment to = {log, environment};
  (void)name; (void)path; (void)visible; (void)logging;
  return new_instance(token, &to, 0);
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
  const Environment to = {log, environment};
  (void)name; (void)path; (void)visible; (void)logging; (void)early; (void)required; (void)n; (void)update;
  if (events) {
    tell(&to, fmi3Error, "logStatusError", "This FMU handles its events itself in Co-Simulation.");
    return NULL;
  }
  return new_instance(token, &to, 1);
}

EXPORT fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) {
  const Environment to = {log, environment};
  (void)name; (void)token; (void)path; (void)visible; (void)logging; (void)update; (void)lock; (void)unlock;
  tell(&to, fmi3Error, "logStatusError", "This FMU has no Scheduled Execution.");
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

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance i) { return initialized(i, "fmi3ExitInitializationMode"); }

EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance i) {
  return say(i, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance i) {
  return say(i, "This FMU has no structural parameters.", "", "");
}

EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance i) { return enter(i, EVENT_MODE, "fmi3EnterEventMode"); }

EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i) {
  return enter(i, CONTINUOUS_TIME, "fmi3EnterContinuousTimeMode");
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

EXPORT fmi3Status fmi3GetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, fmi3Float64 values[], size_t n_values) {
  return get_values(i, r, n, values, n_values);
}

EXPORT fmi3Status fmi3SetFloat64(
    fmi3Instance i, const fmi3ValueReference r[], size_t n, const fmi3Float64 values[], size_t n_values) {
  return set_values(i, r, n, values, n_values);
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

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) { return get_state(i, state); }

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) { return set_state(i, state); }

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) {
  (void)i;
  free_state(state);
  return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *n) {
  (void)i; (void)state;
  *n = STATE_BYTES;
  return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t n) {
  return state_to_bytes(i, state, bytes, n);
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t n, fmi3FMUState *state) {
  return state_of_bytes(i, bytes, n, state);
}

/* --- derivatives ------------------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3GetDirectionalDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  return forward(i, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed, out, n_out);
}

EXPORT fmi3Status fmi3GetAdjointDerivative(
    fmi3Instance i, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 out[], size_t n_out) {
  return reverse(i, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed, out, n_out);
}

/* --- Model Exchange ---------------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 t) { return set_time(i, t); }

EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 x[], size_t n) {
  return set_states(i, x, n);
}

EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) { return get_states(i, x, n); }

EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
  return get_nominals(i, x, n);
}

EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 dx[], size_t n) {
  return get_slopes(i, dx, n);
}

EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 z[], size_t n) {
  return get_indicators(i, z, n);
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
  int wants;
  (void)final;
  const int status = completed(i, "fmi3CompletedIntegratorStep", &wants);
  *enter_event_mode = wants != 0;
  *terminate = false;
  return status;
}

EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance i) {
  (void)i;
  return fmi3OK;
}

EXPORT fmi3Status fmi3UpdateDiscreteStates(
    fmi3Instance i, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals, fmi3Boolean *states,
    fmi3Boolean *has_next, fmi3Float64 *next) {
  Update u;
  const int status = discrete(i, "fmi3UpdateDiscreteStates", &u);
  *again = u.again != 0;
  *terminate = u.terminate != 0;
  *nominals = false;
  *states = u.states != 0;
  *has_next = u.has_next != 0;
  *next = u.next;
  return status;
}

/* --- Co-Simulation ----------------------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3DoStep(
    fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate,
    fmi3Boolean *early, fmi3Float64 *last) {
  int ended;
  (void)final;
  const int status = step(i, "fmi3DoStep", t, h, &ended);
  *event = *early = false;
  *terminate = ended != 0;
  *last = ((const Model *)i)->s.d[AT_T];
  return status;
}

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
