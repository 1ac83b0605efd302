/* training_each.c: finetunes each design separately.
 *
 * Each design has its own finetuning run, with the settings, the seed and the parent of the job, so
 * that it ends with the same controller as a run on that design alone. A design counts as done when
 * its row is stored. A resumed run recomputes the design's first score. */
#include <string.h>

#include "jobs/training_run.h"

#define VARIOUS "various"

int mo_each_prepare(struct mo_training_run *run)
{
  int error = mo_held_out_load(run->jobs->store, &run->status, &run->held_out);
  if (error == MO_OK)
    error = mo_runner_load(run->runner, &run->status.job.controller_sha256, &run->parent);
  run->body.position = run->status.bodies_done;
  return error;
}

/* ---- the lineage of a controller ---- */

void mo_each_note_code(struct mo_training_run *run, const char *fingerprint)
{
  struct mo_training_lineage *code = &run->body_code;
  struct mo_training_code *last = code->n > 0 ? &code->codes[code->n - 1] : NULL;
  if (last != NULL &&
      (strcmp(last->fingerprint, fingerprint) == 0 || strcmp(last->fingerprint, VARIOUS) == 0))
    return;
  if (code->n == MO_LINEAGE_MAX) { /* as the store does */
    snprintf(last->fingerprint, sizeof(last->fingerprint), "%s", VARIOUS);
    return;
  }
  last = &code->codes[code->n++];
  last->from_step = mo_training_run_step(run);
  snprintf(last->fingerprint, sizeof(last->fingerprint), "%s", fingerprint);
}

/* Takes the lineage of the steps up to the checkpoint from that of the job. */
static void continue_code(struct mo_training_run *run)
{
  const struct mo_training_lineage *all = &run->status.code;
  const uint32_t before = mo_training_run_before(run), here = mo_training_run_step(run);
  struct mo_training_lineage *code = &run->body_code;
  code->n = 0;
  for (uint32_t i = 0; here > 0 && i < all->n && all->codes[i].from_step < before + here; i++) {
    if (all->codes[i].from_step <= before)
      code->n = 0;
    code->codes[code->n] = all->codes[i];
    code->codes[code->n].from_step -= code->n > 0 ? before : all->codes[i].from_step;
    code->n++;
  }
}

/* ---- scores ---- */

/* Scores the current design with a controller. */
static int score(struct mo_training_run *run, const struct mo_controller *controller, double *score,
                 uint32_t *diverged)
{
  struct mo_held_out one = run->held_out;
  struct mo_training_validation_row row;
  one.genotypes = &run->body.genotype;
  one.n_designs = 1;
  (void)mo_training_run_enter(run, MO_PHASE_VALIDATE);
  const int error = mo_held_out_score(run->runner, &one, controller, &run->status, &row);
  (void)mo_training_run_enter(run, MO_PHASE_LEARN);
  if (error == MO_OK) {
    *score = row.mean_score;
    *diverged = row.diverged;
  }
  return error;
}

/* ---- one design ---- */

int mo_each_begin(struct mo_training_run *run)
{
  struct mo_training_body *body = &run->body;
  body->genotype = run->held_out.genotypes[body->position];
  run->checkpoint_step = 0;
  int error = mo_training_run_begin(run);
  if (error != MO_OK)
    return error;
  continue_code(run);
  return score(run, run->parent, &body->zero_shot, &body->zero_shot_diverged);
}

struct ending {
  struct mo_training_run *run;
  const struct mo_learned *learned;
};

static int write_body(void *context)
{
  const struct ending *ending = context;
  const struct mo_training_run *run = ending->run;
  const struct mo_training_record *record = &run->status.record;
  char made[MO_MADE_BYTES];
  return mo_store_training_body(run->jobs->store, run->id, record, &run->body,
                                mo_result_name(&run->status.job, record->name, made),
                                ending->learned->bytes, ending->learned->size,
                                ending->learned->controller);
}

int mo_each_end(struct mo_training_run *run)
{
  const struct mo_training *training = run->learner.training;
  struct mo_training_body *body = &run->body;
  struct mo_learned learned = {.bytes = NULL};
  int error =
      score(run, mo_training_controller(training), &body->finetuned, &body->finetuned_diverged);
  if (error == MO_OK)
    error = mo_learned_create(run->jobs, &run->status.job, training, &run->body_code, &learned);
  if (error == MO_OK) {
    mo_sha256_of(learned.bytes, learned.size, &body->controller_sha256);
    (void)mo_training_run_enter(run, MO_PHASE_SAVE);
    error = mo_runner_persist(run->runner, write_body, &(struct ending){run, &learned},
                              "the scores of a design");
  }
  mo_learned_free(&learned);
  if (error != MO_OK)
    return error;
  run->status.job.attempts = 0;
  mo_memory_prove(run->jobs, run->id);
  mo_training_free(run->learner.training);
  run->learner.training = NULL;
  body->position++;
  return MO_OK;
}
