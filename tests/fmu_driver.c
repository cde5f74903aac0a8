/* Drives an FMU by Euler's method, with events, derivatives, and states that are saved and restored: for sanitizers. */
#include "fmi3.c"

#include <stdio.h>

#define CHECK(call) do { if ((call) != fmi3OK) { printf("failed: %s\n", #call); return 1; } } while (0)

static void told(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m) {
  (void)e;
  printf("%d %s %s\n", (int)s, c, m);
}

#if HAS_STEP
/* The same by the FMU's own solver. */
static int itself(int steps, double h) {
  fmi3Instance m =
      fmi3InstantiateCoSimulation("two", TOKEN, "", false, false, false, false, NULL, 0, NULL, told, NULL);
  fmi3Boolean event, terminate = false, early;
  double last = 0;
  if (!m) return 1;
  CHECK(fmi3EnterInitializationMode(m, true, 1e-6, 0, false, 0));
  CHECK(fmi3ExitInitializationMode(m));
  for (int k = 0; k < steps && !terminate; ++k) CHECK(fmi3DoStep(m, k * h, h, true, &event, &terminate, &early, &last));
  fmi3FreeInstance(m);
  return 0;
}
#endif

int main(int argc, char **argv) {
  const int steps = argc > 1 ? atoi(argv[1]) : 1000;
  const double h = argc > 2 ? atof(argv[2]) : 1e-3;
#if HAS_STEP
  if (itself(steps > 1000 ? 1000 : steps, h)) return 1;
#endif
  fmi3Instance m = fmi3InstantiateModelExchange("one", TOKEN, "", false, false, NULL, told);
  static double x[ROOM(NX)], dx[ROOM(NX)], z[ROOM(NG)], old[ROOM(NG)];
  static fmi3Byte bytes[sizeof TOKEN + sizeof(State)];
  fmi3Boolean again, terminate, nominals, states, has_next, event, entered;
  fmi3FMUState saved = NULL, other = NULL;
  double next = 0, t = 0;
  long events = 0;
  if (!m) return 1;
  CHECK(fmi3EnterInitializationMode(m, false, 0, 0, true, steps * h));
  CHECK(fmi3ExitInitializationMode(m));
  do CHECK(fmi3UpdateDiscreteStates(m, &again, &terminate, &nominals, &states, &has_next, &next)); while (again);
  CHECK(fmi3EnterContinuousTimeMode(m));
  CHECK(fmi3GetContinuousStates(m, x, NX));
  CHECK(fmi3GetEventIndicators(m, old, NG));
  for (int k = 0; k < steps && !terminate; ++k) {
    CHECK(fmi3GetContinuousStateDerivatives(m, dx, NX));
    for (int j = 0; j < NX; ++j) x[j] += h * dx[j];
    t += h;
    CHECK(fmi3SetTime(m, t));
    CHECK(fmi3SetContinuousStates(m, x, NX));
    CHECK(fmi3GetEventIndicators(m, z, NG));
    CHECK(fmi3CompletedIntegratorStep(m, true, &entered, &terminate));
    event = entered || (has_next && t >= next);
    for (int j = 0; j < NG; ++j) event = event || (z[j] > 0) != (old[j] > 0);
    if (event) {
      ++events;
      CHECK(fmi3EnterEventMode(m));
      do CHECK(fmi3UpdateDiscreteStates(m, &again, &terminate, &nominals, &states, &has_next, &next)); while (again);
      CHECK(fmi3EnterContinuousTimeMode(m));
      CHECK(fmi3GetContinuousStates(m, x, NX));
    }
    CHECK(fmi3GetEventIndicators(m, old, NG));
    if (k % 100 == 50) {
      size_t n = 0;
      CHECK(fmi3GetFMUState(m, &saved));
      CHECK(fmi3SerializedFMUStateSize(m, saved, &n));
      CHECK(fmi3SerializeFMUState(m, saved, bytes, n));
      CHECK(fmi3DeserializeFMUState(m, bytes, n, &other));
      CHECK(fmi3SetFMUState(m, other));
      for (fmi3ValueReference r = 0; r < N_VARIABLES; ++r) {
        static double values[ND + ROOM(N_UNKNOWNS)], seed[ROOM(N_UNKNOWNS)];
        CHECK(fmi3GetFloat64(m, &r, 1, values, (size_t)VARIABLES[r].size));
        if (!VARIABLES[r].known || !NX) continue;
        const fmi3ValueReference slope = 1 + NX;
        seed[0] = 1;
        CHECK(fmi3GetAdjointDerivative(m, &slope, 1, &r, 1, seed, 1, values, (size_t)VARIABLES[r].size));
        for (int q = 0; q < VARIABLES[r].size; ++q) values[q] = 1;
        CHECK(fmi3GetDirectionalDerivative(m, &slope, 1, &r, 1, values, (size_t)VARIABLES[r].size, seed, 1));
      }
    }
  }
  for (int j = 0; j < NX; ++j) printf("%.17g ", x[j]);
  printf("events %ld\n", events);
  CHECK(fmi3FreeFMUState(m, &saved));
  CHECK(fmi3FreeFMUState(m, &other));
  CHECK(fmi3Terminate(m));
  fmi3FreeInstance(m);
  return 0;
}
