/* training.h: what the commands of trainings share: a training with its curves, as far as they were
 * fetched. */
#ifndef MORPHOCTL_TRAINING_H
#define MORPHOCTL_TRAINING_H

#include <jansson.h>

#include "ctl.h"
#include "plot.h"

#define TRAINING_POINTS_MAX 4000 /* beyond, every other point is dropped */

struct training_curve {
  struct plot_point *points;
  size_t n, capacity;
};

struct training {
  char id[24];
  json_t *json; /* as the API last told it */
  struct training_curve losses, validations;
};

/* Fetches the training and what its curves have got since the last time. */
int training_load(struct ctl *ctl, struct training *training);
void training_free(struct training *training);

/* Adds a point. Those at or behind its x go: after a crash a training may go on from an earlier
 * step. False: no memory. */
bool training_add(struct training_curve *curve, double x, double y);

/* The plot of both curves (malloc), or NULL if there is none yet or no memory. */
char *training_plot(const struct ctl *ctl, const struct training *training, int width, int height);

/* "0:12:34", "3 d 04:05"; "–" for less than nothing. */
const char *duration_text(double seconds, char text[32]);
/* "%.4g" of a number, "–" for null or none. */
const char *real_text(const json_t *number, char text[32]);
/* "12.3 %" of a share. */
const char *share_text(const json_t *share, char text[32]);
/* Of one progress report: loss, gradient, rate, clipped share; "  164.6 bodies/s  0:12:34 left", as
 * far as they are known; both. */
void training_numbers_text(const json_t *progress, char *text, size_t size);
void training_pace_text(const json_t *progress, char *text, size_t size);
void training_progress_text(const json_t *progress, char *text, size_t size);
/* "0.2450 ± 0.0110 at step 1,200", with the diverged rollouts if there are any. */
void training_validation_text(const json_t *validation, char *text, size_t size);
/* "step 120 of 1,400" */
void training_step_text(int64_t step, int64_t steps, char *text, size_t size);

/* Two spaces and what a "training.…" event tells; nothing of others. */
void training_event_text(const char *type, const json_t *data, char *text, size_t size);

/* Follows a training to its end: a plot that redraws on a terminal, else lines. An interrupt leaves
 * it alone. */
int watch_training(struct ctl *ctl, const char *id);

/* STATUS_OK if it succeeded, else STATUS_NEGATIVE and a complaint. */
int training_outcome(const json_t *training);

#endif
