/* A copy of a `plant` is the plant at that moment; many of them may be used at once. Functions return PLANT_OK, PLANT_DISCARD where the
   equations have no finite solution (take a shorter step), or PLANT_FAILED; `message` says what went wrong. */
enum { PLANT_OK, PLANT_DISCARD, PLANT_FAILED };

/* The names of states, outputs and discrete variables in their order, and the conditions of guards. */
extern const char *const plant_states[], *const plant_outputs[], *const plant_discretes[], *const plant_guards[];
extern const double plant_nominals[]; /* typical sizes of states */

/* Where the numbers of this name begin in `s.d`: "time", a state, an input, a discrete variable, a parameter, the weights of a network, or
   the start of a state, "start(name)". -1: there is no such name. */
int plant_place(const char *name);

/* Gives parameters, inputs and starts their values: the first thing to call. */
void plant_reset(plant *m);

/* Derivatives of states, outputs and guards at the present time, states, inputs, parameters: arrays of PLANT_NX, PLANT_NY and PLANT_NG. */
int plant_get_field(plant *m, double *dx);
int plant_get_outputs(plant *m, double *y);
int plant_get_guards(plant *m, double *g);

/* Computes a consistent start at time t. `stop` is the last time, NAN if it is not known; `tolerance` is relative, 0 for the default. */
int plant_start(plant *m, double t, double stop, double tolerance);
