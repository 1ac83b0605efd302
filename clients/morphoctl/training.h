/* training.h: what the training commands share: a training with its curves, as far as they were
 * fetched. */
#ifndef MORPHOCTL_TRAINING_H
#define MORPHOCTL_TRAINING_H

#include <jansson.h>

#include "ctl.h"
#include "plot.h"

#define TRAINING_POINTS_MAX 4000 /* above this, every other point is dropped */

struct training_curve {
  struct plot_point *points;
  size_t n, capacity;
};

struct training {
  char id[24];
  json_t *json; /* the latest reply of the API */
  struct training_curve losses, validations;
};

/* Fetches the training and the rows of its curves since the last fetch. */
int training_load(struct ctl *ctl, struct training *training);
void training_free(struct training *training);

/* Adds a point, and removes earlier points at or beyond its x: after a crash a training may resume
 * from an earlier step. False: no memory. */
bool training_add(struct training_curve *curve, double x, double y);

/* Plots both curves (malloc). NULL: there are none yet, or no memory. */
char *training_plot(const struct ctl *ctl, const struct training *training, int width, int height);

/* Writes a duration: "0:12:34", "3 d 04:05"; "–" for a negative one. */
const char *duration_text(double seconds, char text[32]);
/* Writes a number as "%.4g", "–" for null or none. */
const char *real_text(const json_t *number, char text[32]);
/* Writes a share as "12.3 %". */
const char *share_text(const json_t *share, char text[32]);
/* Write parts of a progress report, as far as they are known: the numbers (loss, gradient, rate,
 * clipped share), the pace ("  164.6 bodies/s  0:12:34 left"), or both. */
void training_numbers_text(const json_t *progress, char *text, size_t size);
void training_pace_text(const json_t *progress, char *text, size_t size);
void training_progress_text(const json_t *progress, char *text, size_t size);
/* Writes "0.2450 ± 0.0110 at step 1,200", with the diverged rollouts if there are any. */
void training_validation_text(const json_t *validation, char *text, size_t size);
/* Writes "step 120 of 1,400". */
void training_step_text(int64_t step, int64_t steps, char *text, size_t size);

/* Writes two spaces and the content of a "training.…" event; nothing for other events. */
void training_event_text(const char *type, const json_t *data, char *text, size_t size);

/* Follows a training to its end: a plot that is redrawn on a terminal, else lines. An interrupt
 * ends only the command, not the training. */
int watch_training(struct ctl *ctl, const char *id);

#endif
