/* learning.h: what the benchmarks of learning share: one training after another, saved and resumed,
 * reported in a CSV file. */
#ifndef MORPHO_BENCH_LEARNING_H
#define MORPHO_BENCH_LEARNING_H

#include "bench.h"

#include <morpho/learning.h>

#define LEARNING_KEY_BYTES 160

/* One curve: key is the beginning of its rows in the CSV file, and names it. */
struct learning_run {
  struct mo_training_settings settings;
  char key[LEARNING_KEY_BYTES];
  double *loss;    /* (settings.n_steps + 1) mean loss of step 1 …; NaN where it is not known */
  double *seconds; /* the same, of a step */
  uint32_t known;  /* steps in the file */
};

struct learning_machine {
  struct mo_compute *compute;
  enum mo_back_end back_end;
  struct mo_gradient_state *gradients;
  double *d_parameters;        /* (n_parameters) */
  struct mo_outcome *outcomes; /* (batch) */
};
void learning_machine_create(struct learning_machine *machine, const struct bench_options *options,
                             uint32_t batch);
void learning_machine_free(struct learning_machine *machine);
/* One step: draw, gradient, apply. Ends the program if it fails. */
struct mo_training_report learning_step(struct learning_machine *machine,
                                        struct mo_training *training);

/* One figure of `x` values against several curves of loss, one panel per title. Every run is a thin
 * line, and the mean of the runs of a group a thick one. */
struct curves_group {
  char name[80];
  const struct learning_run *runs;
  size_t n_runs;
};
struct curves_panel {
  const char *title;
  const struct curves_group *groups[5];
  size_t n_groups;
};
int bench_draw_curves(const char *path, uint32_t n_steps, const struct curves_panel *panels,
                      size_t n_panels);

int bench_finetune(const struct bench_options *options, const struct mo_training_settings *settings,
                   uint32_t n_designs, uint32_t n_environments);

#endif
