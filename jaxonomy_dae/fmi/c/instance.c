/* An instance of an FMU, for every version of the interface: its modes, its variables, its state, its derivatives.

   The file of a version has included its types and defined `Environment`, what messages go to, and has a function
   `tell`. Functions return OK, DISCARD or FAILED as the interface numbers them. model.h has the sizes of the model,
   model.c its equations, run.h and run.c what it does in time, variables.c the table of its variables, token.h its
   identity. Nothing is allocated but instances and states. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"
#include "run.h"
#include "token.h"

#include "model.c"
#include "run.c"

/* Modes of an instance. */
enum { INSTANTIATED, INITIALIZING, EVENT_MODE, CONTINUOUS_TIME, STEP_MODE, TERMINATED };

/* What the interface has for OK, DISCARD and FAILED. */
enum { ALL_WELL = 0, DISCARDED = 2, ERROR_FOUND = 3 };

/* What a variable is: an entry of `d`, one of the unknowns (derivatives, outputs, guards), or an event indicator. */
typedef enum { STORED, UNKNOWN, INDICATOR } Kind;

/* When a variable may be set: never, until initialization ends, or at any time. */
typedef enum { NEVER, BEFORE, ALWAYS } Settable;

typedef struct {
  Kind kind;
  Settable settable;
  int place;     /* in `d`, among the unknowns, or among the indicators */
  int size;
  int step;      /* between the places of its entries */
  int start;     /* of a state with a start of its own: its place in `d`, else -1 */
  int known;     /* whether derivatives by it exist */
  double low, high;
  const char *name;
} Variable;

#include "variables.c"

typedef struct {
  Model m;   /* first: an instance is its model, too */
  int steps; /* whether the instance integrates by itself */
  Environment environment;
} Instance;

/* --- messages ---------------------------------------------------------------------------------------------------- */

/* Sends a message to the importer. */
static void tell(const Environment *to, int status, const char *category, const char *text);

/* Tells the importer what went wrong, if anything did. */
static int logged(Model *m, int found) {
  const int status = found == OK ? ALL_WELL : found == DISCARD ? DISCARDED : ERROR_FOUND;
  if (found != OK)
    tell(&((const Instance *)m)->environment, status, found == DISCARD ? "logStatusDiscard" : "logStatusError",
         m->message);
  return status;
}

static int say(Model *m, const char *before, const char *name, const char *after) {
  return logged(m, failure(m, FAILED, before, name, after));
}

static int wrong_mode(Model *m, const char *function) { return say(m, function, "", " must not be called in this mode."); }

/* Computes the unknowns. One that is no number means that the equations have no solution at this point. */
static void ensure_unknowns(Model *m) {
  if (m->valid) return;
  char *w = work_of(m);
  p_field_of(m->s.d, m->unknowns, w);
  p_outputs_of(m->s.d, m->unknowns + NX, w);
  p_guards_of(m->s.d, m->unknowns + NX + NY, w);
#if HAS_OPENED
  p_opened_of(m->s.d, m->unknowns + NX + NY + NG, w);
#endif
  m->valid = 1;
}

/* --- instances --------------------------------------------------------------------------------------------------- */

static Instance *new_instance(const char *token, const Environment *environment, int steps) {
  const char *wrong = NULL;
  if (!token || strcmp(token, TOKEN))
    wrong = "The token of the model does not belong to this binary: it was made from another modelDescription.xml.";
  else if (steps && !HAS_STEP)
    wrong = "This FMU has Model Exchange only.";
  Instance *i = wrong ? NULL : calloc(1, sizeof *i);
  if (!i) {
    tell(environment, ERROR_FOUND, "logStatusError", wrong ? wrong : "There is no memory for an instance.");
    return NULL;
  }
  reset(&i->m);
  i->steps = steps;
  i->environment = *environment;
  return i;
}

static int initialized(Model *m, const char *function) {
  if (m->s.mode != INITIALIZING) return wrong_mode(m, function);
  const int status = logged(m, ensure_start(m));
  if (status == ALL_WELL) m->s.mode = ((const Instance *)m)->steps ? STEP_MODE : EVENT_MODE;
  return status;
}

/* Between event mode and continuous time. */
static int enter(Model *m, int mode, const char *function) {
  if (m->s.mode != CONTINUOUS_TIME && m->s.mode != EVENT_MODE) return wrong_mode(m, function);
  m->s.mode = mode;
  return ALL_WELL;
}

/* --- variables --------------------------------------------------------------------------------------------------- */

typedef uint32_t Reference;

static const Variable *variable(Model *m, Reference r) {
  if (r < N_VARIABLES) return &VARIABLES[r];
  say(m, "There is no variable with this value reference.", "", "");
  return NULL;
}

static int get_values(Model *m, const Reference r[], size_t n, double values[], size_t n_values) {
  size_t k = 0;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_values)
      return say(m, "There is no room for the values of ", v->name, ".");
    int place = v->place;
    if (m->s.mode == INSTANTIATED) {
      if (v->kind != STORED)
        return say(m, "", v->name, " has no value before initialization.");
      if (v->start >= 0) place = v->start;
    }
    if (m->s.mode == INITIALIZING && (v->kind != STORED || v->settable != ALWAYS || v->start >= 0)) {
      const int status = logged(m, ensure_start(m));
      if (status != ALL_WELL) return status;
    }
    if (v->kind != STORED) ensure_unknowns(m);
    for (int q = 0; q < v->size; ++q)
      values[k++] = v->kind == STORED      ? m->s.d[place + q * v->step]
                    : v->kind == UNKNOWN   ? m->unknowns[place + q * v->step]
                                           : indicator(m, place + q * v->step);
  }
  return k == n_values ? ALL_WELL : say(m, "The number of values is not that of the variables.", "", "");
}

static int set_values(Model *m, const Reference r[], size_t n, const double values[], size_t n_values) {
  size_t k = 0;
  const int early = m->s.mode == INSTANTIATED || m->s.mode == INITIALIZING;
  for (size_t j = 0; j < n; ++j) {
    const Variable *v = variable(m, r[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_values) return say(m, "There are too few values for ", v->name, ".");
    if (v->settable == NEVER) return say(m, "", v->name, " cannot be set.");
    if (v->settable == BEFORE && !early) return say(m, "", v->name, " can be set before the start only.");
    const int place = early && v->start >= 0 ? v->start : v->place;
    for (int q = 0; q < v->size; ++q) {
      const double value = values[k++];
      if (!is_number(value)) return say(m, "The value given for ", v->name, " is not a finite number.");
      if (value < v->low || value > v->high)
        return say(m, "The value given for ", v->name, " is out of its bounds.");
      m->s.d[place + q * v->step] = value;
    }
  }
  m->valid = 0;
  if (early) m->s.started = 0;
  return k == n_values ? ALL_WELL : say(m, "The number of values is not that of the variables.", "", "");
}

/* --- the state of the FMU ---------------------------------------------------------------------------------------- */

#define STATE_BYTES (sizeof TOKEN + sizeof(State))

static int get_state(Model *m, void **state) {
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(m, "There is no memory for a state.", "", "");
  memcpy(*state, &m->s, sizeof(State));
  return ALL_WELL;
}

static int set_state(Model *m, const void *state) {
  if (!state) return say(m, "There is no such state.", "", "");
  memcpy(&m->s, state, sizeof(State));
  m->valid = 0;
  return ALL_WELL;
}

static void free_state(void **state) {
  if (!state) return;
  free(*state);
  *state = NULL;
}

static int state_to_bytes(Model *m, const void *state, unsigned char bytes[], size_t n) {
  if (!state) return say(m, "There is no such state.", "", "");
  if (n < STATE_BYTES) return say(m, "There is no room for the state.", "", "");
  memcpy(bytes, TOKEN, sizeof TOKEN);
  memcpy(bytes + sizeof TOKEN, state, sizeof(State));
  return ALL_WELL;
}

static int state_of_bytes(Model *m, const unsigned char bytes[], size_t n, void **state) {
  if (n != STATE_BYTES || memcmp(bytes, TOKEN, sizeof TOKEN))
    return say(m, "These bytes are not a state of this FMU.", "", "");
  if (!*state) *state = malloc(sizeof(State));
  if (!*state) return say(m, "There is no memory for a state.", "", "");
  memcpy(*state, bytes + sizeof TOKEN, sizeof(State));
  return ALL_WELL;
}

/* --- derivatives ------------------------------------------------------------------------------------------------- */

static int may_differentiate(Model *m) {
  if (m->s.mode == EVENT_MODE || m->s.mode == CONTINUOUS_TIME || m->s.mode == STEP_MODE) return ALL_WELL;
  return say(m, "Derivatives exist after initialization.", "", "");
}

static const Variable *known(Model *m, Reference r) {
  const Variable *v = variable(m, r);
  if (v && !v->known) say(m, "There is no derivative by ", v->name, ".");
  return v && v->known ? v : NULL;
}

/* An unknown is computed, or it is a state, whose derivative by itself is one. */
static const Variable *unknown(Model *m, Reference r) {
  const Variable *v = variable(m, r);
  const int is_state = v && v->kind == STORED && v->place >= AT_X && v->place < AT_X + NX;
  if (v && v->kind != UNKNOWN && !is_state) say(m, "There is no derivative of ", v->name, ".");
  return v && (v->kind == UNKNOWN || is_state) ? v : NULL;
}

static int forward(
    Model *m, const Reference unknowns[], size_t n_unknowns, const Reference knowns[], size_t n_knowns,
    const double seed[], size_t n_seed, double out[], size_t n_out) {
  const int status = may_differentiate(m);
  if (status != ALL_WELL) return status;
  size_t k = 0;
  memset(m->along, 0, sizeof m->along);
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_seed) return say(m, "The number of seeds is not that of the knowns.", "", "");
    for (int q = 0; q < v->size; ++q) m->along[v->place + q * v->step] += seed[k++];
  }
  if (k != n_seed) return say(m, "The number of seeds is not that of the knowns.", "", "");
  p_forward_of(m->s.d, m->along, m->weight, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_unknowns; ++j) {
    const Variable *v = unknown(m, unknowns[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_out) return say(m, "The number of sensitivities is not that of the unknowns.", "", "");
    for (int q = 0; q < v->size; ++q)
      out[k++] = v->kind == UNKNOWN ? m->weight[v->place + q * v->step] : m->along[v->place + q * v->step];
  }
  return k == n_out ? ALL_WELL : say(m, "The number of sensitivities is not that of the unknowns.", "", "");
}

#if HAS_REVERSE

static int reverse(
    Model *m, const Reference unknowns[], size_t n_unknowns, const Reference knowns[], size_t n_knowns,
    const double seed[], size_t n_seed, double out[], size_t n_out) {
  const int status = may_differentiate(m);
  if (status != ALL_WELL) return status;
  size_t k = 0;
  memset(m->weight, 0, sizeof m->weight);
  memset(m->next, 0, sizeof m->next); /* the weights of states that are unknowns themselves */
  for (size_t j = 0; j < n_unknowns; ++j) {
    const Variable *v = unknown(m, unknowns[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_seed) return say(m, "The number of seeds is not that of the unknowns.", "", "");
    for (int q = 0; q < v->size; ++q) {
      const int place = v->place + q * v->step;
      *(v->kind == UNKNOWN ? &m->weight[place] : &m->next[place]) += seed[k++];
    }
  }
  if (k != n_seed) return say(m, "The number of seeds is not that of the unknowns.", "", "");
  p_reverse_of(m->s.d, m->weight, m->along, work_of(m));
  k = 0;
  for (size_t j = 0; j < n_knowns; ++j) {
    const Variable *v = known(m, knowns[j]);
    if (!v) return ERROR_FOUND;
    if (k + (size_t)v->size > n_out) return say(m, "The number of sensitivities is not that of the knowns.", "", "");
    for (int q = 0; q < v->size; ++q) {
      const int place = v->place + q * v->step;
      out[k++] = m->along[place] + m->next[place];
    }
  }
  return k == n_out ? ALL_WELL : say(m, "The number of sensitivities is not that of the knowns.", "", "");
}

#endif

/* --- Model Exchange ---------------------------------------------------------------------------------------------- */

static int set_time(Model *m, double t) {
  if (!is_number(t)) return say(m, "The time is not a number.", "", "");
  m->s.d[AT_T] = t;
  m->valid = 0;
  return ALL_WELL;
}

static int set_states(Model *m, const double x[], size_t n) {
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k)
    if (!is_number(x[k]))
      return logged(m, failure(m, DISCARD, "The state that follows ", UNKNOWNS[k], " is not a number."));
  if (NX) memcpy(m->s.d + AT_X, x, NX * sizeof *x);
  m->valid = 0;
  return ALL_WELL;
}

static int get_states(Model *m, double x[], size_t n) {
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  if (m->s.mode == INITIALIZING || m->s.mode == INSTANTIATED) {
    const int status = logged(m, ensure_start(m));
    if (status != ALL_WELL) return status;
  }
  if (NX) memcpy(x, m->s.d + AT_X, NX * sizeof *x);
  return ALL_WELL;
}

static int get_nominals(Model *m, double x[], size_t n) {
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  for (int k = 0; k < NX; ++k) x[k] = NOMINALS[k];
  return ALL_WELL;
}

static int get_slopes(Model *m, double dx[], size_t n) {
  if (n != NX) return say(m, "The number of states is another one.", "", "");
  /* An integrator asks for derivatives far more often than for anything else. */
  if (!m->valid) p_field_of(m->s.d, m->unknowns, work_of(m));
  if (NX) memcpy(dx, m->unknowns, NX * sizeof *dx);
  return logged(m, check_unknowns(m, 0, NX));
}

static int get_indicators(Model *m, double z[], size_t n) {
  if (n != NG) return say(m, "The number of event indicators is another one.", "", "");
  if (!m->valid) p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) z[k] = indicator(m, k);
  return logged(m, check_unknowns(m, NX + NY, NX + NY + NG));
}

static int completed(Model *m, const char *function, int *enter_event_mode) {
  *enter_event_mode = 0;
  if (m->s.mode != CONTINUOUS_TIME) return wrong_mode(m, function);
  return logged(m, accepted(m, enter_event_mode));
}

static int discrete(Model *m, const char *function, Update *u) {
  memset(u, 0, sizeof *u);
  if (m->s.mode != EVENT_MODE) return wrong_mode(m, function);
  return logged(m, updated(m, u));
}

/* --- Co-Simulation ----------------------------------------------------------------------------------------------- */

static int step(Model *m, const char *function, double t, double h, int *terminate) {
  *terminate = 0;
  if (m->s.mode != STEP_MODE) return wrong_mode(m, function);
  if (!is_number(t) || !is_number(h) || !(h > 0)) return say(m, "The step is not positive.", "", "");
  if (fabs(t - m->s.d[AT_T]) > 1e-9 * (fabs(t) + h))
    return say(m, "The communication point is not where the last step ended.", "", "");
#if HAS_STEP
  return logged(m, advance(m, t + h, terminate));
#else
  return say(m, "This FMU has Model Exchange only.", "", "");
#endif
}
