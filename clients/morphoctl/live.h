/* live.h: watches one job to its end: a view that is redrawn in place on a terminal, else a line
 * per event. */
#ifndef MORPHOCTL_LIVE_H
#define MORPHOCTL_LIVE_H

#include <jansson.h>

#include "ctl.h"
#include "screen.h"

struct live;

/* What differs between kinds of jobs. Functions get the `struct live` with which their own begins,
 * and return an exit status where they return one. */
struct live_kind {
  const char *noun, *command;     /* "training", "train" */
  double ask_s;                   /* without an event for this long, the state is fetched */
  int (*load)(struct live *live); /* fetches the job into `job`, and what belongs to it */
  void (*write)(void *live, FILE *file, int columns, int rows); /* draws the view */
  void (*begin)(struct live *live);                             /* prints what is known at first */
  /* Takes an event; *draw: the view is to be redrawn at once. −1: goes on, even if the job has
   * ended. `reset` says that events were missed; the job was fetched again. */
  int (*event)(struct live *live, const char *type, const json_t *at, const json_t *data,
               bool *draw);
  /* Prints what changed when the state was fetched without an event. */
  void (*changed)(const struct live *live, const char *phase, const char *reason);
  int (*finish)(struct live *live); /* prints the result */
};

struct live {
  const struct live_kind *kind;
  struct ctl *ctl;
  const char *id;
  json_t *job; /* the latest reply of the API; belongs to what loads it */
  struct screen screen;
  double told_s; /* time of the last event that counts, or when the state was last fetched */
  bool finished;
};

/* Fetches the job. */
int live_load(struct live *live);
/* Prints a line with the time of an event (NULL: now), if the view is not drawn. */
void live_line(const struct live *live, const json_t *at, const char *words);
/* Follows the job to its end. An interrupt ends only the command, not the job. */
int live_watch(struct live *live);
/* Prints the controller that a job made, if it made one. */
void live_print_controller(const struct live *live, const json_t *controller);

#endif
