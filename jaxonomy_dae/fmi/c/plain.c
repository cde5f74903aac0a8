/* The functions of plant.h. */

int plant_place(const char *name) {
  for (int k = 0; k < N_PLACES; ++k)
    if (!strcmp(PLACES[k].name, name)) return PLACES[k].place;
  return -1;
}

void plant_reset(plant *m) {
  reset(m);
  m->message[0] = 0;
}

static int copied(plant *m, int begin, int end, double *out) {
  for (int k = begin; k < end; ++k) out[k - begin] = m->unknowns[k];
  return check_unknowns(m, begin, end);
}

int plant_get_field(plant *m, double *dx) {
  p_field_of(m->s.d, m->unknowns, work_of(m));
  return copied(m, 0, NX, dx);
}

int plant_get_outputs(plant *m, double *y) {
  p_outputs_of(m->s.d, m->unknowns + NX, work_of(m));
  return copied(m, NX, NX + NY, y);
}

int plant_get_guards(plant *m, double *g) {
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  return copied(m, NX + NY, N_UNKNOWNS, g);
}

#if HAS_FORWARD

void plant_get_forward(plant *m, const double *along, double *derivatives) {
  p_forward_of(m->s.d, along, derivatives, work_of(m));
}

void plant_get_reverse(plant *m, const double *weights, double *derivatives) {
  memset(derivatives, 0, ND * sizeof *derivatives);
  p_reverse_of(m->s.d, weights, derivatives, work_of(m));
}

#endif

int plant_start(plant *m, double t, double stop, double tolerance) {
  begin(m, t, stop, tolerance);
  m->s.started = 0;
  m->s.step = 0;
  return ensure_start(m);
}

#if HAS_EVENT

int plant_get_indicators(plant *m, double *z) {
  p_guards_of(m->s.d, m->unknowns + NX + NY, work_of(m));
  for (int k = 0; k < NG; ++k) z[k] = indicator(m, k);
  return check_unknowns(m, NX + NY, N_UNKNOWNS);
}

int plant_completed_step(plant *m, int *wants_event) {
  *wants_event = 0;
  return accepted(m, wants_event);
}

int plant_event(plant *m, int *again, int *terminate, double *next) {
  Update u;
  const int status = updated(m, &u);
  *again = u.again;
  *terminate = u.terminate;
  *next = u.has_next ? u.next : INFINITY;
  return status;
}

#endif

#if HAS_STEP

int plant_run(plant *m, double until, int *terminate) {
  *terminate = 0;
  return advance(m, until, terminate);
}

#endif
