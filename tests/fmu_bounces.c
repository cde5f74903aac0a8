/* Drives a ball by events alone: as many bounces as are asked for, at one place. For tools that watch memory. */
#include "fmi3.c"

#include <stdio.h>

static void told(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m) {
  (void)e;
  printf("%d %s %s\n", (int)s, c, m);
}

int main(int argc, char **argv) {
  const int bounces = argc > 1 ? atoi(argv[1]) : 100;
  fmi3Instance m = fmi3InstantiateModelExchange("one", TOKEN, "", false, false, NULL, told);
  fmi3Boolean again, terminate, nominals, states, has_next, entered;
  fmi3FMUState saved = NULL; /* kept from bounce to bounce */
  double next, x[2], count = 0;
  if (!m) return 1;
  fmi3EnterInitializationMode(m, false, 0, 0, false, 0);
  fmi3ExitInitializationMode(m);
  do fmi3UpdateDiscreteStates(m, &again, &terminate, &nominals, &states, &has_next, &next); while (again);
  for (int k = 0; k < bounces; ++k) {
    fmi3EnterContinuousTimeMode(m);
    x[0] = -1e-12;
    x[1] = -1.0 - 1e-3 * k;
    fmi3SetTime(m, 1e-3 * (k + 1));
    fmi3SetContinuousStates(m, x, 2);
    fmi3CompletedIntegratorStep(m, true, &entered, &terminate);
    fmi3EnterEventMode(m);
    if (fmi3GetFMUState(m, &saved) != fmi3OK || fmi3SetFMUState(m, saved) != fmi3OK) return 2;
    do
      if (fmi3UpdateDiscreteStates(m, &again, &terminate, &nominals, &states, &has_next, &next) != fmi3OK) return 3;
    while (again);
  }
  for (fmi3ValueReference r = 0; r < N_VARIABLES; ++r)
    if (!strcmp(VARIABLES[r].name, "b.n")) fmi3GetFloat64(m, &r, 1, &count, 1);
  printf("bounces %g\n", count);
  fmi3FreeFMUState(m, &saved);
  fmi3Terminate(m);
  fmi3FreeInstance(m);
  return 0;
}
