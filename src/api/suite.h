/* suite.h: scores of an evaluation in a suite, per design and task. */
#ifndef MORPHO_API_SUITE_H
#define MORPHO_API_SUITE_H

#include "base/text.h"
#include "store/evaluations.h"

/* The scores of one design, or their means over designs. */
struct mo_suite_scores {
  double losses[MO_SUITE_TASKS], values[MO_SUITE_TASKS]; /* means; NaN: a rollout diverged, or the
                                                            design was skipped */
  uint32_t n[MO_SUITE_TASKS];                            /* number of rollouts that diverged; in
                                                            means: number of designs */
  double mean_loss;    /* over the tasks that have a loss; NaN: no task has one */
  uint32_t n_left_out; /* tasks without a loss */
};

/* Returns the number of a job's suite, or −1. */
int mo_suite_of(const struct mo_job *job);
/* Computes the scores of design d. environments: those of the job. */
struct mo_suite_scores mo_suite_scores(const struct mo_evaluation_results *results, uint32_t d,
                                       const struct mo_environment *environments);
/* Computes the means over the designs: for each task, over those that have a loss in it. */
struct mo_suite_scores mo_suite_means(const struct mo_evaluation_results *results,
                                      const struct mo_environment *environments);
/* Returns the objective of a task. */
enum mo_objective mo_suite_objective(const struct mo_evaluation_results *results, uint32_t task,
                                     const struct mo_environment *environments);

/* Writes the members "tasks" and "tasks_mean" of design d. */
void mo_suite_write_design(struct mo_text *text, const struct mo_evaluation_results *results,
                           uint32_t d, const struct mo_environment *environments);
/* Writes the member "suite" of an evaluation: its tasks, with the means over designs. results NULL:
 * without the means. */
void mo_suite_write(struct mo_text *text, int suite, const struct mo_evaluation_results *results,
                    const struct mo_environment *environments);

/* ---- evaluations.c ---- */

/* Returns whether the results of a job are few enough to be read at once. */
bool mo_results_fit(const struct mo_job *job);

/* ---- suite_picture.c ---- */

struct mo_suite_axis {
  const char *unit; /* "": a share */
  double maximum;   /* value at the end of the axis */
};
/* A design in the picture. */
struct mo_suite_polygon {
  char name[64];
  struct mo_suite_scores scores;
};
#define MO_SUITE_POLYGONS_MAX 6
/* Draws an axis for each task, and a polygon for each design, as SVG. */
void mo_suite_draw(struct mo_text *text, const char *title, const struct mo_suite_polygon *polygons,
                   uint32_t n, const struct mo_suite_axis axes[MO_SUITE_TASKS], uint32_t width_px,
                   bool is_dark);

#endif
