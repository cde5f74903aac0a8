
/* What a guard's change of sign is looked for in: guards that have fallen, or that rest at zero, are moved by their rounding. */
int plant_get_indicators(plant *m, double *z);

/* After each step of an integrator: notes on which side of zero guards are; `wants_event` if an event is due. */
int plant_completed_step(plant *m, int *wants_event);

/* What happens at this instant: changes states and discrete variables. Call it until nothing happens `again`. `next` is when a clock ticks,
   INFINITY for never. */
int plant_event(plant *m, int *again, int *terminate, double *next);
