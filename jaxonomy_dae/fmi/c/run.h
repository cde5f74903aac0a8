/* A model at one instant of its run. All numbers stand in one array `d` in the order of model.h, so that its state is
   copied as a whole. */
#ifndef RUN_H
#define RUN_H

#include <stdint.h>

#include "model.h"

#define ROOM(n) ((n) > 0 ? (n) : 1)

typedef struct {
  double d[ND];
  double begin, stop, tolerance;
  double last;             /* the time of the last accepted step */
  double next_event, step; /* of a run: when a clock ticks next, and the length of the next step */
  int mode, started;
} State;

typedef struct {
  State s;
  int valid; /* whether `unknowns` belongs to `s` */
  double unknowns[ROOM(N_UNKNOWNS)];
  double along[ND], weight[ROOM(N_UNKNOWNS)]; /* directions and weights of derivatives */
  double next[ND];
  double begin_x[ROOM(NX)], end_x[ROOM(NX)], error[ROOM(NX)], dense[ROOM(3 * NX)];
  double signs[ROOM(NG)];
  char message[512]; /* what went wrong last */
  double work[WORK / 8 + 2];
} Model;

#endif
