/* Functional Mock-up Interface 2.0, Model Exchange and Co-Simulation: the functions that an importer calls, for any model.
   instance.c has what all versions of the interface share. */

#include "fmi2_types.h"

#define NAME_LENGTH 128

typedef struct {
  fmi2CallbackFunctions functions;
  char name[NAME_LENGTH]; /* of the instance, for messages */
  int ended;              /* whether an event has ended the run */
} Environment;

#include "instance.c"

static void tell(const Environment *to, int status, const char *category, const char *text) {
  /* The text is an argument: it may hold a percent sign. */
  if (to->functions.logger)
    to->functions.logger(to->functions.componentEnvironment, to->name, (fmi2Status)status, category, "%s", text);
}

/* --- instances --------------------------------------------------------------------------------------------------- */

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }

EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component i, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  (void)i; (void)on; (void)n; (void)categories;
  return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(
    fmi2String name, fmi2Type type, fmi2String token, fmi2String path, const fmi2CallbackFunctions *functions,
    fmi2Boolean visible, fmi2Boolean logging) {
  Environment to;
  (void)path; (void)visible; (void)logging;
  memset(&to, 0, sizeof to);
  if (functions) to.functions = *functions;
  if (name) append(to.name, sizeof to.name, name);
  return new_instance(token, &to, type == fmi2CoSimulation);
}

EXPORT void fmi2FreeInstance(fmi2Component i) { free(i); }

EXPORT fmi2Status fmi2SetupExperiment(
    fmi2Component i, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real t, fmi2Boolean has_stop, fmi2Real stop) {
  Model *m = i;
  if (m->s.mode != INSTANTIATED) return wrong_mode(m, "fmi2SetupExperiment");
  if (!is_number(t)) return say(m, "The start time is not a number.", "", "");
  begin(m, t, has_stop ? stop : NAN, has_tolerance ? tolerance : 0);
  return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component i) {
  Model *m = i;
  if (m->s.mode != INSTANTIATED) return wrong_mode(m, "fmi2EnterInitializationMode");
  m->s.mode = INITIALIZING;
  return fmi2OK;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component i) { return initialized(i, "fmi2ExitInitializationMode"); }

EXPORT fmi2Status fmi2EnterEventMode(fmi2Component i) { return enter(i, EVENT_MODE, "fmi2EnterEventMode"); }

EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component i) {
  return enter(i, CONTINUOUS_TIME, "fmi2EnterContinuousTimeMode");
}

EXPORT fmi2Status fmi2Terminate(fmi2Component i) {
  ((Model *)i)->s.mode = TERMINATED;
  return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component i) {
  ((Instance *)i)->environment.ended = 0;
  reset(i); /* to the mode of a new instance */
  return fmi2OK;
}

/* --- variables --------------------------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2GetReal(fmi2Component i, const fmi2ValueReference r[], size_t n, fmi2Real values[]) {
  return get_values(i, r, n, values, n);
}

EXPORT fmi2Status fmi2SetReal(fmi2Component i, const fmi2ValueReference r[], size_t n, const fmi2Real values[]) {
  return set_values(i, r, n, values, n);
}

#define NOT_OF_TYPE(T)                                                                                        \
  EXPORT fmi2Status fmi2Get##T(fmi2Component i, const fmi2ValueReference r[], size_t n, fmi2##T v[]) {        \
    (void)r; (void)v;                                                                                         \
    return n ? say(i, "All variables of this FMU are of type Real, not " #T ".", "", "") : fmi2OK;            \
  }                                                                                                           \
  EXPORT fmi2Status fmi2Set##T(fmi2Component i, const fmi2ValueReference r[], size_t n, const fmi2##T v[]) {  \
    (void)r; (void)v;                                                                                         \
    return n ? say(i, "All variables of this FMU are of type Real, not " #T ".", "", "") : fmi2OK;            \
  }
NOT_OF_TYPE(Integer)
NOT_OF_TYPE(Boolean)
NOT_OF_TYPE(String)

/* --- the state of the FMU ---------------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component i, fmi2FMUstate *state) { return get_state(i, state); }

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component i, fmi2FMUstate state) {
  ((Instance *)i)->environment.ended = 0; /* no step begins where a run has ended */
  return set_state(i, state);
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component i, fmi2FMUstate *state) {
  (void)i;
  free_state(state);
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component i, fmi2FMUstate state, size_t *n) {
  (void)i; (void)state;
  *n = STATE_BYTES;
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component i, fmi2FMUstate state, fmi2Byte bytes[], size_t n) {
  return state_to_bytes(i, state, (unsigned char *)bytes, n);
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component i, const fmi2Byte bytes[], size_t n, fmi2FMUstate *state) {
  return state_of_bytes(i, (const unsigned char *)bytes, n, state);
}

/* --- derivatives ------------------------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2GetDirectionalDerivative(
    fmi2Component i, const fmi2ValueReference unknowns[], size_t n_unknowns, const fmi2ValueReference knowns[],
    size_t n_knowns, const fmi2Real seed[], fmi2Real out[]) {
  return forward(i, unknowns, n_unknowns, knowns, n_knowns, seed, n_knowns, out, n_unknowns);
}

/* --- Model Exchange ---------------------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2SetTime(fmi2Component i, fmi2Real t) { return set_time(i, t); }

EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component i, const fmi2Real x[], size_t n) {
  return set_states(i, x, n);
}

EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component i, fmi2Real x[], size_t n) { return get_states(i, x, n); }

EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component i, fmi2Real x[], size_t n) {
  return get_nominals(i, x, n);
}

EXPORT fmi2Status fmi2GetDerivatives(fmi2Component i, fmi2Real dx[], size_t n) { return get_slopes(i, dx, n); }

EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component i, fmi2Real z[], size_t n) { return get_indicators(i, z, n); }

EXPORT fmi2Status fmi2CompletedIntegratorStep(
    fmi2Component i, fmi2Boolean final, fmi2Boolean *enter_event_mode, fmi2Boolean *terminate) {
  (void)final;
  *terminate = 0;
  return completed(i, "fmi2CompletedIntegratorStep", enter_event_mode);
}

EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component i, fmi2EventInfo *info) {
  Update u;
  const int status = discrete(i, "fmi2NewDiscreteStates", &u);
  info->newDiscreteStatesNeeded = u.again;
  info->terminateSimulation = u.terminate;
  info->nominalsOfContinuousStatesChanged = 0;
  info->valuesOfContinuousStatesChanged = u.states;
  info->nextEventTimeDefined = u.has_next;
  info->nextEventTime = u.next;
  return status;
}

/* --- Co-Simulation ----------------------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2DoStep(fmi2Component i, fmi2Real t, fmi2Real h, fmi2Boolean final) {
  int *const ended = &((Instance *)i)->environment.ended;
  (void)final;
  const int status = step(i, "fmi2DoStep", t, h, ended);
  return status == ALL_WELL && *ended ? fmi2Discard : (fmi2Status)status; /* `fmi2Terminated` says that it has ended */
}

EXPORT fmi2Status fmi2SetRealInputDerivatives(
    fmi2Component i, const fmi2ValueReference r[], size_t n, const fmi2Integer orders[], const fmi2Real v[]) {
  (void)r; (void)orders; (void)v;
  return n ? say(i, "This FMU holds its inputs in a step, without derivatives.", "", "") : fmi2OK;
}

EXPORT fmi2Status fmi2GetRealOutputDerivatives(
    fmi2Component i, const fmi2ValueReference r[], size_t n, const fmi2Integer orders[], fmi2Real v[]) {
  (void)r; (void)orders; (void)v;
  return n ? say(i, "This FMU has no derivatives of outputs by time.", "", "") : fmi2OK;
}

static fmi2Status never_pending(fmi2Component i) {
  return say(i, "The steps of this FMU end before fmi2DoStep returns.", "", "");
}

EXPORT fmi2Status fmi2CancelStep(fmi2Component i) { return never_pending(i); }

EXPORT fmi2Status fmi2GetStatus(fmi2Component i, const fmi2StatusKind kind, fmi2Status *value) {
  (void)kind; (void)value;
  return never_pending(i);
}

EXPORT fmi2Status fmi2GetRealStatus(fmi2Component i, const fmi2StatusKind kind, fmi2Real *value) {
  if (kind != fmi2LastSuccessfulTime) return never_pending(i);
  *value = ((const Model *)i)->s.d[AT_T];
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component i, const fmi2StatusKind kind, fmi2Integer *value) {
  (void)kind; (void)value;
  return never_pending(i);
}

EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component i, const fmi2StatusKind kind, fmi2Boolean *value) {
  if (kind != fmi2Terminated) return never_pending(i);
  *value = ((const Instance *)i)->environment.ended;
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetStringStatus(fmi2Component i, const fmi2StatusKind kind, fmi2String *value) {
  (void)kind; (void)value;
  return never_pending(i);
}
