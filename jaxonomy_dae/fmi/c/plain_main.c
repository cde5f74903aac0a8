/* Prints a run of plant as a table: plant [last time [rows [relative tolerance]]]. */

#include <stdio.h>
#include <stdlib.h>

#include "plant.h"

static plant m; /* not on the stack, which may be small */

static int failed(int status) {
  if (status != PLANT_OK) fprintf(stderr, "%s\n", m.message);
  return status != PLANT_OK;
}

static int row(void) {
  static double y[PLANT_NY + 1];
  const int status = plant_get_outputs(&m, y);
  printf("%.17g", m.s.d[0]);
  for (int k = 0; k < PLANT_NX; ++k) printf(",%.17g", m.s.d[PLANT_AT_X + k]);
  for (int k = 0; k < PLANT_NQ; ++k) printf(",%.17g", m.s.d[PLANT_AT_Q + k]);
  for (int k = 0; k < PLANT_NY; ++k) printf(",%.17g", y[k]);
  printf("\n");
  return failed(status);
}

int main(int argc, char **argv) {
  const double last = argc > 1 ? atof(argv[1]) : STOP_TIME;
  const int rows = argc > 2 ? atoi(argv[2]) : 50;
  const double tolerance = argc > 3 ? atof(argv[3]) : 0;
  int terminate = 0;
  plant_reset(&m);
  if (failed(plant_start(&m, 0, last, tolerance))) return 1;
  printf("time");
  for (int k = 0; k < PLANT_NX; ++k) printf(",\"%s\"", plant_states[k]);
  for (int k = 0; k < PLANT_NQ; ++k) printf(",\"%s\"", plant_discretes[k]);
  for (int k = 0; k < PLANT_NY; ++k) printf(",\"%s\"", plant_outputs[k]);
  printf("\n");
  if (row()) return 1;
#if PLANT_RUNS
  for (int k = 1; k <= rows && !terminate; ++k)
    if (failed(plant_run(&m, last * k / rows, &terminate)) || row()) return 1;
#else
  (void)rows; /* an integrator of your own goes here */
  (void)terminate;
#endif
  return 0;
}
