/* What a model does in time: consistent starts, events, what steps leave behind, and runs. The functions are those that
   an FMU and plain C code share; model.c has the equations. */

/* What functions return; the message says more. */
enum { OK, DISCARD, FAILED };

/* --- messages ---------------------------------------------------------------------------------------------------- */

static void append(char *text, size_t room, const char *more) {
  const size_t used = strlen(text);
  if (used + 1 < room) strncat(text, more, room - used - 1);
}

static int failure(Model *m, int status, const char *before, const char *name, const char *after) {
  m->message[0] = 0;
  append(m->message, sizeof m->message, before);
  append(m->message, sizeof m->message, name);
  append(m->message, sizeof m->message, after);
  return status;
}

static int is_number(double x) { return x - x == 0; }

/* --- evaluation -------------------------------------------------------------------------------------------------- */

static char *work_of(Model *m) {
  return (char *)(((uintptr_t)m->work + 15) / 16 * 16);
}

/* A time that is nothing beside the run, but more than rounding. */
static double resolution(const State *s) {
  double largest = fabs(s->begin) > fabs(s->d[AT_T]) ? fabs(s->begin) : fabs(s->d[AT_T]);
  if (is_number(s->stop) && fabs(s->stop) > largest) largest = fabs(s->stop);
  if (is_number(s->stop) && s->stop - s->begin > largest) largest = s->stop - s->begin;
  return RESOLUTION * largest;
}

/* The run begins at this time; `stop` may be not-a-number, `tolerance` zero for that of the model. */
static void begin(Model *m, double t, double stop, double tolerance) {
  m->s.d[AT_T] = m->s.begin = m->s.last = t;
  m->s.stop = stop;
  if (tolerance > 0) m->s.tolerance = tolerance;
  m->valid = 0;
}

static int ensure_start(Model *m) {
  State *s = &m->s;
  if (s->started) return OK;
  double residual[ROOM(N_ROWS)], limit[ROOM(N_ROWS)];
  unsigned char fine = 0;
  p_start_of(s->d, resolution(s), &fine, residual, limit, work_of(m));
  m->valid = 0;
  for (int k = 0; k < N_ROWS; ++k)
    if (!(fabs(residual[k]) <= limit[k]))
      return failure(m, FAILED, "There is no consistent start with these values: this does not hold: ", ROWS[k], ".");
  if (!fine) return failure(m, FAILED, "There is no consistent start with these values.", "", "");
  s->started = 1;
  return OK;
}

static int check_unknowns(Model *m, int begin, int end) {
  for (int k = begin; k < end; ++k)
    if (!is_number(m->unknowns[k]))
      return failure(m, DISCARD, "The equations have no finite solution here: ", UNKNOWNS[k], " is not a number.");
  return OK;
}

static void reset(Model *m) {
  State *s = &m->s;
  memset(s, 0, sizeof *s);
  for (int k = 0; k < ND; ++k) s->d[k] = DEFAULTS[k];
  s->stop = NAN;
  s->tolerance = TOLERANCE;
  m->valid = 0;
}

#if HAS_EVENT

/* What an importer watches: a guard, moved by its rounding band so that one which rests at zero, or is below it, has a
   sign. Armed guards are positive. */
static double indicator(const Model *m, int k) {
  const double value = m->unknowns[NX + NY + k], *memory = m->s.d + AT_GUARDS;
  const double side = memory[k], band = BAND * memory[NG + k];
  if (side == ABOVE) return value;
  return side == RESTS ? value + band : value - band;
}

/* After a step: what it leaves behind, and whether an event is due. */
static int accepted(Model *m, int *wants_event) {
  State *s = &m->s;
  unsigned char wants = 0;
  memcpy(m->next, s->d, sizeof s->d);
  p_accept_of(s->d, resolution(s), s->tolerance * DRIFT, s->d[AT_T] - s->last, m->next, &wants, work_of(m));
  for (int k = 0; k < NZ; ++k)
    if (!is_number(m->next[AT_Z + k]))
      return failure(m, DISCARD, "The equations have no solution here: ", CARRIED[k], " is not a number.");
  memcpy(s->d, m->next, sizeof s->d);
  s->last = s->d[AT_T];
  *wants_event = wants;
  return OK;
}

typedef struct { int again, terminate, states, has_next; double next; } Update;

/* What happens at the present instant. */
static int updated(Model *m, Update *u) {
  State *s = &m->s;
  memset(u, 0, sizeof *u);
  unsigned char fired = 0, fine = 0;
  memcpy(m->next, s->d, sizeof s->d);
  p_event_of(s->d, resolution(s), s->tolerance * DRIFT, m->next, &fired, &fine, work_of(m));
  m->valid = 0;
  const double *run = m->next + AT_RUN;
  const int stuck = (int)run[STUCK_AT];
  if (stuck >= 0 && stuck < N_EVENTS && run[ENDED_AT] == 0)
    return failure(m, FAILED, "This event happens again and again at one instant: ", EVENTS[stuck], ".");
  if (stuck < -1)
    return failure(m, FAILED, "Two events give one variable different values at one instant.", "", "");
  if (!fine) return failure(m, DISCARD, "After the events of this instant the equations have no finite solution.", "", "");
  /* Some importers begin their integration anew only if they are told that states have changed. They have to where a mode
     has, too: their method extrapolates from slopes of the equations before the event. */
  u->states = NX > 0 && (fired || memcmp(s->d + AT_X, m->next + AT_X, NX * sizeof *s->d) != 0);
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
  return OK;
}

#endif

/* --- runs ----------------------------------------------------------------------------------------------------------- */

#if HAS_STEP

/* How the next step follows from the error of the last one. */
static const double SAFETY = 0.9, LEAST = 0.2, MOST = 5.0;

static double weighted(const Model *m, const double *v, const double *x, const double *y) {
  double sum = 0;
  for (int k = 0; k < NX; ++k) {
    const double largest = fabs(x[k]) > fabs(y[k]) ? fabs(x[k]) : fabs(y[k]);
    const double part = v[k] / (m->s.tolerance * (largest + ABSOLUTE * NOMINALS[k]));
    sum += part * part;
  }
  return NX ? sqrt(sum / NX) : 0;
}

/* A first step (Hairer, Norsett and Wanner 1993, Solving Ordinary Differential Equations I, II.4). */
static double first_step(Model *m, double longest) {
  const double *x = m->s.d + AT_X;
  p_field_of(m->s.d, m->error, work_of(m));
  const double size = weighted(m, x, x, x), slope = weighted(m, m->error, x, x);
  const double h = size > 1e-5 && slope > 1e-5 ? 0.01 * size / slope : 1e-6 * longest;
  return h < longest ? h : longest;
}

/* The state at a part of the step from `begin_x` to `end_x`. */
static void inside(Model *m, double t0, double h, double part) {
  double *x = m->s.d + AT_X;
  const double *k = m->dense;
  m->s.d[AT_T] = t0 + part * h;
  for (int j = 0; j < NX; ++j)
    x[j] = part >= 1 ? m->end_x[j]
                     : (1 - part) * m->begin_x[j]
                           + part * (m->end_x[j] + (1 - part) * (k[j] + part * (k[NX + j] + part * k[2 * NX + j])));
  m->valid = 0;
}

static void look(Model *m, double *signs) {
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) signs[k] = indicator(m, k);
}

/* Whether an indicator has another sign than at the beginning of the step. */
static int turned(Model *m, double t0, double h, double part) {
  inside(m, t0, h, part);
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k)
    if ((indicator(m, k) > 0) != (m->signs[k] > 0)) return 1;
  return 0;
}

/* All events of this instant. */
static int happened(Model *m, int *terminate) {
  Update u;
  int status;
  do {
    status = updated(m, &u);
    if (status != OK) return status;
    *terminate |= u.terminate;
  } while (u.again && !*terminate);
  m->s.next_event = u.has_next ? u.next : INFINITY;
  look(m, m->signs);
  return OK;
}

static int advance(Model *m, double end, int *terminate) {
  State *s = &m->s;
  const double least = resolution(s);
  int status = happened(m, terminate); /* inputs may have jumped */
  while (status == OK && !*terminate && s->d[AT_T] < end) {
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
        return failure(m, DISCARD, "Steps have become too short, because of ", UNKNOWNS[worst], ".");
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
    if (status == OK && (event || wants || (s->next_event <= end && s->d[AT_T] >= s->next_event)))
      status = happened(m, terminate);
    else
      look(m, m->signs);
  }
  m->valid = 0;
  return status;
}

#endif
