/* live.h: shows one job, or watches it to its end: a view that is redrawn in place on a terminal,
 * else a line per event. */
#ifndef MORPHOCTL_LIVE_H
#define MORPHOCTL_LIVE_H

#include <jansson.h>

#include "ctl.h"

struct live;

/* The differences between kinds of jobs. Functions get the `struct live` that their own structure
 * starts with, and exit on an error. */
struct live_kind {
  size_t size;                     /* size of its own structure */
  const char *noun, *command;      /* "training", "train" */
  const char *accepted;            /* template of the line about a newly started job */
  double ask_s;                    /* the state is fetched after this long without an event */
  void (*load)(struct live *live); /* fetches what belongs to the job, after the job itself */
  void (*print)(struct live *live);
  void (*write)(const struct live *live, FILE *file, int columns, int rows); /* draws the view */
  void (*begin)(struct live *live); /* prints the initial state */
  /* Handles an event; *draw: redraw the view at once. Returns false to continue even if the job has
   * ended. `reset` means that events were missed; the job was fetched again. */
  bool (*event)(struct live *live, const char *type, json_t *event, bool *draw);
  /* Prints what changed when the state was fetched without an event. */
  void (*changed)(const struct live *live, const char *phase, const char *reason);
  void (*finish)(struct live *live); /* prints the result */
};

extern const struct live_kind training_kind, campaign_kind;

struct live {
  const struct live_kind *kind;
  struct ctl *ctl;
  const char *id;
  json_t *job;            /* the latest reply of the API */
  bool is_drawn;          /* standard output is a terminal that supports escapes */
  int n_lines, n_columns; /* currently drawn lines, and the width they were drawn for */
  double drawn_s;
  double event_s; /* time of the last relevant event, or of the last fetch of the state */
  bool finished;
};

/* For the command's kind of jobs. Posts a job, and prints its id, or watches it with --watch. */
void live_start(struct ctl *ctl, const json_t *request);

/* Fetches the job. */
void live_load(struct live *live);
/* Prints a line with the time of an event (NULL: now; JSON null: unknown), if the view is not
 * drawn: `text`, or a template filled with JSON. */
void live_line(const struct live *live, const json_t *at, const char *text);
void live_words(const struct live *live, const json_t *at, const json_t *json, const char *words);
/* Write lines of a view, each cut to the width: those of a text, or a filled template. */
void view_lines(FILE *file, int columns, const char *text);
void view_words(FILE *file, int columns, const json_t *json, const char *words);

/* Returns the template of an event's line (cmd_watch.c). */
const char *event_words(const char *type);

/* ---- how parts of progress are printed: templates (table.h) of values below a place, such as
 * "progress." ---- */

#define STEP_WORDS(place) "step {" place "step:,} of {" place "steps:,}"
#define NUMBER_WORDS(place)                                                                        \
  "loss {" place "mean_loss:.4f}  gradient {" place "gradient_norm:.4g}  rate {" place             \
  "rate:.4g}  clipped {" place "clipped_share:.1%}"
#define PACE_WORDS(place)                                                                          \
  "[  {" place "bodies_per_s:.4g} bodies/s][  {" place "seconds_left:duration} left]"
/* "0.2450 ± 0.0110 at step 1,200", with the diverged rollouts if there are any. */
#define VALIDATION_WORDS(place)                                                                    \
  "[[{" place "mean_score:.4f}|–] ± [{" place "standard_error:.4f}|–] at step {" place             \
  "step:,}|–][, {" place "diverged>0} of {" place "rollouts} rollouts diverged]"
/* "generation 12 of 30" */
#define GENERATION_WORDS(place)                                                                    \
  "[generation {" place "generation:,}|before generation 0] of {" place "generations:,}"
/* "generation 12: scoring 34 of 64 designs  210 rollouts/s  0:03:12 left"; nothing when the
 * campaign is not running. */
#define CAMPAIGN_NOW_WORDS                                                                         \
  "[{phase!=idle:-}[generation {progress.under_way:,}: ]{phase}"                                   \
  "[{phase=scoring}" DONE_WORDS " designs|{phase=learning}" DONE_WORDS " steps"                    \
  "|{phase=preparing}" DONE_WORDS " pretraining bodies]"                                           \
  "[  {progress.rollouts_per_s>0:.0f} rollouts/s]"                                                 \
  "[  {progress.seconds_left:duration}"                                                            \
  "[{phase!=preparing:-} left|{progress.generation>0:-} left| until they are drawn]]]"
/* The ranges of "vary" that vary. place: what has them. */
#define VARY_FACTOR_WORDS(place, name)                                                             \
  "[{" place name                                                                                  \
  ".0!=1:-}" VARY_RANGE_WORDS(place, name) "|{" place name                                         \
                                           ".1!=1:-}" VARY_RANGE_WORDS(place, name) "]"
#define VARY_RANGE_WORDS(place, name) ", " name " {" place name ".0:.3g} to {" place name ".1:.3g}"
#define VARY_WORDS(place)                                                                          \
  "[{" place "mass.0:-}in each step" VARY_FACTOR_WORDS(place, "stiffness")                         \
      VARY_FACTOR_WORDS(place, "mass") VARY_FACTOR_WORDS(place, "drag")                            \
          VARY_FACTOR_WORDS(place, "gravity") VARY_FACTOR_WORDS(place, "actuation")                \
              VARY_FACTOR_WORDS(place, "friction") "[" VARY_RANGE_WORDS(                           \
                  place, "drop_m") "][" VARY_RANGE_WORDS(place, "slope_degrees") "]]"
#define DONE_WORDS "{progress.total>0:-} {progress.done:,} of {progress.total:,}"

#endif
