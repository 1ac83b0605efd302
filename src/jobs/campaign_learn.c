/* campaign_learn.c: how the controller of a campaign learns between generations.
 *
 * Few-shot: each generation has its own training run, which starts from the pretrained weights and
 * takes parent_steps on the parents, then child_steps on the children. Simultaneous: one training
 * run takes the same steps and continues throughout the campaign. Generation 0 has no parents and
 * takes child_steps on the initial population. Robots learn in random environments or, if the
 * campaign requests it, in the campaign's own environments, which checkpoints then contain.
 *
 * A checkpoint is written when it is due, at a pause or stop, and at the end of a generation's
 * learning, so that an interruption of scoring does not lose what was learned. A generation commits
 * with the learning state that scored it. */
#include <math.h>
#include <stdlib.h>

#include "jobs/campaign_run.h"

#include "base/clock.h"

static uint32_t parent_steps(const struct mo_campaign_run *run)
{
  return run->generation == 0 ? 0 : run->settings->parent_steps;
}

void mo_campaign_free_learning(struct mo_campaign_learning *learning)
{
  mo_learner_free(&learning->learner);
  free(learning->steps);
  learning->steps = NULL;
}

/* ---- checkpoints ---- */

static int write_checkpoint(void *context)
{
  struct mo_campaign_run *run = context;
  struct mo_campaign_learning *learning = &run->learning;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_training_encode(learning->learner.training, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_campaign_checkpoint(run->jobs->store, run->id, run->generation, learning->step,
                                         bytes, size, learning->steps + learning->steps_saved,
                                         learning->step - learning->steps_saved);
  free(bytes);
  if (error == MO_OK) {
    learning->steps_saved = learning->step;
    learning->checkpoint_us = mo_clock_us();
    run->status.job.attempts = 0;
    mo_memory_prove(run->jobs, run->id);
  }
  return error;
}

int mo_campaign_save_learning(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  char what[96];
  if (learning->steps == NULL || learning->steps_saved == learning->step)
    return MO_OK;
  snprintf(what, sizeof(what), "the checkpoint of generation %u, step %u",
           (unsigned)run->generation, (unsigned)learning->step);
  return mo_campaign_persist(run, write_checkpoint, run, what);
}

/* Reads the newest checkpoint of a generation. MO_ERR_NOT_FOUND: no checkpoint exists.
 * MO_ERR_CORRUPT: the checkpoint is unusable. */
static int read_checkpoint(struct mo_campaign_run *run, uint32_t generation, uint32_t *step)
{
  struct mo_message message = {.text = "it is missing, or its bytes have changed"};
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error =
      mo_store_campaign_checkpoint_of(run->jobs->store, run->id, generation, step, &bytes, &size);
  if (error == MO_OK)
    error = mo_training_decode(bytes, size, &run->learning.learner.training, &message);
  free(bytes);
  if (error != MO_ERR_CORRUPT && error != MO_ERR_IO && error != MO_ERR_FORMAT)
    return error;
  snprintf(run->runner->text, sizeof(run->runner->text),
           "the checkpoint of generation %u cannot be used (%.100s); restore its file from a "
           "backup of campaigns/ and resume the campaign, or start another one",
           (unsigned)generation, error == MO_ERR_IO ? "it cannot be read" : message.text);
  return MO_ERR_CORRUPT;
}

int mo_campaign_load_learning(struct mo_campaign_run *run)
{
  uint32_t step = 0;
  int error = read_checkpoint(run, run->generation - 1, &step);
  return error == MO_ERR_NOT_FOUND
             ? mo_runner_fail(run->runner, MO_ERR_CORRUPT,
                              "the learning state of the last generation is missing")
             : error;
}

/* ---- what is due between steps ---- */

static bool checkpoint_is_due(const struct mo_campaign_run *run)
{
  return mo_checkpoint_is_due(&run->status.job, run->learning.checkpoint_us,
                              run->status.record.checkpoint_every_s);
}

static int write_what_is_due(void *context)
{
  struct mo_campaign_run *run = context;
  const int error = checkpoint_is_due(run) ? mo_campaign_save_learning(run) : MO_OK;
  return error == MO_OK ? mo_campaign_report(run) : error;
}

/* ---- where learning begins ---- */

static const uint64_t *children(const struct mo_campaign_run *run)
{
  return run->rows->bits[run->n_parents].words;
}

static int begin_training(struct mo_campaign_run *run)
{
  struct mo_training_settings settings = mo_campaign_training(run->settings, run->generation);
  struct mo_controller *random = NULL;
  int error = MO_OK;
  if (run->controller == NULL) {
    error = mo_controller_create(run->jobs->lattice->workspace, settings.sensor, &random);
    if (error == MO_OK)
      mo_controller_randomize(random, settings.seed);
  }
  if (error == MO_OK)
    error = mo_training_create(&settings, random != NULL ? random : run->controller, children(run),
                               run->n_children, &run->learning.learner.training);
  struct mo_training *training = run->learning.learner.training;
  if (error == MO_OK && run->status.record.worlds == MO_WORLDS_ENVIRONMENTS)
    error = mo_training_set_environments(training, run->environments, run->n_environments);
  else if (error == MO_OK && run->status.record.worlds == MO_WORLDS_TASKS)
    error = mo_training_set_tasks(training, run->environments, run->n_environments);
  mo_controller_free(random);
  return error;
}

/* Loads the learning state that an earlier process reached in this generation. MO_ERR_NOT_FOUND:
 * there is no usable checkpoint. */
static int restore(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  int error = read_checkpoint(run, run->generation, &learning->step);
  if (error == MO_OK)
    learning->steps_saved = learning->step;
  if (error != MO_ERR_CORRUPT)
    return error;
  mo_runner_warn(
      run->runner, error,
      "a checkpoint within a generation is damaged; the generation's learning is repeated");
  run->runner->text[0] = '\0';
  return MO_ERR_NOT_FOUND;
}

/* Prepares the training run at the step where this generation's learning continues. */
static int prepare_training(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  const bool inherits = run->mode->inherits_learning && run->generation > 0;
  const bool is_new = learning->learner.training == NULL; /* in this process */
  int error = MO_OK;
  learning->step = learning->steps_saved = 0;
  if (is_new || !inherits) {
    mo_training_free(learning->learner.training);
    learning->learner.training = NULL;
    error = is_new ? restore(run) : MO_ERR_NOT_FOUND;
    if (error == MO_ERR_NOT_FOUND)
      error = inherits ? mo_campaign_load_learning(run) : begin_training(run);
  }
  if (error == MO_OK && run->mode->inherits_learning) /* generations may have been added */
    error = mo_training_set_steps(learning->learner.training,
                                  mo_campaign_training(run->settings, 0).n_steps);
  if (error == MO_OK)
    error = mo_learner_prepare(&learning->learner, run->runner, &run->status.job, write_what_is_due,
                               run);
  return error;
}

/* Reads the first and the last loss from the steps that an earlier process stored. */
static int read_losses(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  struct mo_campaign_step row;
  int64_t n = mo_store_campaign_steps(run->jobs->store, run->id, run->generation, 0, &row, 1);
  if (n == 1 && row.generation == run->generation)
    learning->first_loss = row.report.mean_loss;
  if (n >= 0)
    n = mo_store_campaign_steps(run->jobs->store, run->id, run->generation, learning->step - 1,
                                &row, 1);
  if (n == 1 && row.generation == run->generation && row.step == learning->step)
    learning->last_loss = row.report.mean_loss;
  return n < 0 ? (int)n : MO_OK;
}

/* ---- steps ---- */

static int set_designs(struct mo_campaign_run *run)
{
  const bool on_children = run->learning.step >= parent_steps(run);
  return mo_learner_set_designs(&run->learning.learner,
                                on_children ? children(run) : run->rows->bits[0].words,
                                on_children ? run->n_children : run->n_parents);
}

static int step(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  struct mo_campaign_step *row = &learning->steps[learning->step];
  const struct mo_robot *robots = NULL;
  int error = mo_training_draw(learning->learner.training, NULL, NULL, &robots);
  if (error == MO_OK)
    error = mo_learner_gradient(&learning->learner, robots);
  if (error == MO_OK)
    error = mo_learner_apply(&learning->learner, &row->report, &row->seconds);
  if (error != MO_OK)
    return error;
  row->generation = run->generation;
  row->on_children = learning->step >= parent_steps(run);
  row->step = ++learning->step;
  if (row->step == 1)
    learning->first_loss = row->report.mean_loss;
  learning->last_loss = row->report.mean_loss;
  atomic_fetch_add(&run->jobs->campaign_steps, 1);
  return MO_OK;
}

uint64_t mo_campaign_n_steps(const struct mo_campaign_run *run)
{
  return parent_steps(run) + run->settings->child_steps;
}

int mo_campaign_learn(struct mo_campaign_run *run)
{
  struct mo_campaign_learning *learning = &run->learning;
  const uint32_t n_steps = (uint32_t)mo_campaign_n_steps(run);
  learning->first_loss = learning->last_loss = NAN;
  free(learning->steps);
  learning->steps = calloc((size_t)n_steps + 1, sizeof(*learning->steps));
  int error = learning->steps == NULL ? MO_ERR_NO_MEMORY : prepare_training(run);
  if (error == MO_OK && learning->step > 0)
    error = read_losses(run);
  if (error == MO_OK && n_steps > learning->step)
    error = set_designs(run);
  learning->checkpoint_us = mo_clock_us();
  while (error == MO_OK && learning->step < n_steps) {
    mo_campaign_advance(run, learning->step, 0);
    if (mo_runner_is_interrupted(run->runner))
      return MO_ERR_CANCELLED;
    error = step(run);
    if (error == MO_OK && learning->step < n_steps && learning->step == parent_steps(run))
      error = set_designs(run);
  }
  return error == MO_OK ? mo_campaign_save_learning(run) : error;
}

int mo_campaign_check_learned(struct mo_campaign_run *run)
{
  const struct mo_training *training = run->learning.learner.training;
  bool any = run->generation > 0 || training == NULL || mo_training_step(training) == 0 ||
             mo_training_skipped(training) < mo_training_step(training);
  for (uint32_t i = 0; i < run->n_children && !any; i++)
    any = isfinite(run->rows->scores[i]);
  return any ? MO_OK
             : mo_runner_give_up(run->runner, MO_ERR_RANGE,
                                 "every robot of generation 0 diverged, both while learning and "
                                 "while being scored; choose a smaller dt_s or stiffness_n_per_m");
}
