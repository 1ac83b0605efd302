/* training.c: the state of a training run from its creation to its last step. */
#include "learning/internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

int mo_training_design_is_placed(const uint64_t *design)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  uint64_t placed[MO_DEFAULT_WORDS];
  if (design[MO_DEFAULT_WORDS - 1] >> (MO_DEFAULT_VOXELS % 64) != 0)
    return 0;
  memcpy(placed, design, sizeof(placed));
  mo_genotype_place(workspace, placed);
  return memcmp(placed, design, sizeof(placed)) == 0 ? mo_genotype_is_contiguous(workspace, design)
                                                     : 0;
}

int mo_training_blank(const struct mo_training_settings *settings,
                      struct mo_controller **controller)
{
  const double period_s = settings->physics.scheme.control_period_s;
  int r = mo_controller_create(MO_DEFAULT_WORKSPACE, settings->sensor, controller);
  if (r == MO_OK && period_s > 0)
    r = mo_controller_set_period(*controller, period_s);
  return r;
}

int mo_training_allocate(const struct mo_training_settings *settings, uint32_t n_designs,
                         struct mo_training **training)
{
  struct mo_training *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->settings = *settings;
  made->n_designs = n_designs;
  made->n_threads = 1;
  made->draws_worlds = true;
  int r = mo_training_blank(settings, &made->controller);
  if (r == MO_OK) {
    made->adam.first = calloc(made->controller->n_parameters, sizeof(double));
    made->adam.second = calloc(made->controller->n_parameters, sizeof(double));
    if (n_designs > 0)
      made->designs = calloc(n_designs, MO_DEFAULT_WORDS * sizeof(uint64_t));
    if (made->adam.first == NULL || made->adam.second == NULL ||
        (n_designs > 0 && made->designs == NULL))
      r = MO_ERR_NO_MEMORY;
  }
  if (r < 0) {
    mo_training_free(made);
    return r;
  }
  mo_adam_count(&made->adam, settings, 0);
  *training = made;
  return MO_OK;
}

int mo_training_create(const struct mo_training_settings *settings,
                       const struct mo_controller *parent, const uint64_t *designs,
                       size_t n_designs, struct mo_training **training)
{
  struct mo_training_settings completed = *settings;
  if (parent != NULL && !mo_workspace_equal(parent->workspace, MO_DEFAULT_WORKSPACE))
    return MO_ERR_UNSUPPORTED; /* already stored, for example by an older import */
  if (parent != NULL)
    completed.sensor = parent->sensor;
  struct mo_training *made = NULL;
  const int r = mo_training_allocate(&completed, (uint32_t)n_designs, &made);
  if (r < 0)
    return r;
  if (parent != NULL)
    memcpy(made->controller->parameters, parent->parameters, parent->n_parameters * sizeof(float));
  else
    mo_controller_randomize(made->controller, settings->seed);
  if (n_designs > 0)
    memcpy(made->designs, designs, n_designs * MO_DEFAULT_WORDS * sizeof(uint64_t));
  *training = made;
  return MO_OK;
}

int mo_training_set_designs(struct mo_training *training, const uint64_t *designs, size_t n)
{
  uint64_t *copy = calloc(n, MO_DEFAULT_WORDS * sizeof(*copy));
  if (copy == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(copy, designs, n * MO_DEFAULT_WORDS * sizeof(*copy));
  mo_training_forget_designs(training);
  free(training->designs);
  training->designs = copy;
  training->n_designs = (uint32_t)n;
  return MO_OK;
}

int mo_training_set_steps(struct mo_training *training, uint32_t n_steps)
{
  const struct mo_training_settings *settings = &training->settings;
  if (n_steps < 1 || n_steps < training->step || n_steps > MO_TRAINING_STEPS_MAX ||
      (settings->kind == MO_TRAINING_PRETRAIN &&
       (uint64_t)n_steps * settings->batch > MO_TRAINING_BODIES_MAX))
    return MO_ERR_RANGE;
  if (settings->learning.schedule.kind == MO_SCHEDULE_COSINE && n_steps != settings->n_steps)
    return MO_ERR_UNSUPPORTED;
  training->settings.n_steps = n_steps;
  return MO_OK;
}

void mo_training_free(struct mo_training *training)
{
  if (training == NULL)
    return;
  mo_training_draw_free(training);
  mo_controller_free(training->controller);
  free(training->adam.first);
  free(training->adam.second);
  free(training->designs);
  mo_environments_free(training->environments, training->n_environments);
  free(training);
}

uint32_t mo_training_step(const struct mo_training *training)
{
  return training->step;
}

uint32_t mo_training_skipped(const struct mo_training *training)
{
  return training->skipped;
}

const struct mo_training_settings *mo_training_settings_of(const struct mo_training *training)
{
  return &training->settings;
}

const struct mo_controller *mo_training_controller(const struct mo_training *training)
{
  return training->controller;
}

static double share(uint64_t part, uint64_t whole)
{
  return whole > 0 ? (double)part / (double)whole : 0.0;
}

static struct mo_training_report report_of(const struct mo_training *training,
                                           const struct mo_outcome *outcomes,
                                           const struct mo_gradient_counts *counts)
{
  const struct mo_training_settings *settings = &training->settings;
  struct mo_training_report report = {
      .step = training->step + 1,
      .rate = mo_schedule_rate(&settings->learning.schedule, training->step, settings->n_steps),
      .clipped_share = share(counts->clipped_steps, counts->steps),
      .clipped_robots_share = share(counts->clipped_robots, counts->robots),
      .zeroed = (uint32_t)counts->zeroed_robots,
  };
  double sum = 0.0;
  for (uint32_t i = 0; i < settings->batch; i++)
    if (outcomes[i].diverged_step != 0 || !isfinite(outcomes[i].loss))
      report.diverged++;
    else
      sum += outcomes[i].loss;
  const uint32_t sound = settings->batch - report.diverged;
  report.mean_loss = sound > 0 ? sum / sound : NAN;
  return report;
}

int mo_training_apply(struct mo_training *training, const double *d_parameters,
                      const struct mo_outcome *outcomes, const struct mo_gradient_counts *counts,
                      struct mo_training_report *report)
{
  const struct mo_training_settings *settings = &training->settings;
  const struct mo_hand *hand = mo_training_hand(training, training->step);
  if (hand == NULL || training->step >= settings->n_steps)
    return MO_ERR_CONFLICT;
  struct mo_training_report made = report_of(training, outcomes, counts);
  struct mo_controller *controller = training->controller;
  const double norm = mo_gradient_norm(d_parameters, controller->n_parameters);
  const double limit = settings->learning.norm_limit;
  const double scale = limit > 0.0 && norm > limit ? limit / norm : 1.0;
  made.skipped = !isfinite(norm) || (uint64_t)made.diverged + made.zeroed >= settings->batch ||
                 !mo_adam_update(&training->adam, settings, made.rate, scale, d_parameters,
                                 controller->parameters, controller->n_parameters,
                                 training->n_threads, &made.bounded);
  made.gradient_norm = made.skipped ? 0.0 : norm;
  training->skipped += made.skipped;
  training->draws = hand->draws;
  mo_training_forget_robots(training);
  training->step++;
  if (report != NULL)
    *report = made;
  return MO_OK;
}
