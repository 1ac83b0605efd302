/* acts.c: the operations that a test runs on the store, and how they change the model. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fixture.h"
#include "life.h"
#include "store/score_blocks.h"

const struct act life_script[SCRIPT] = {
    {ACT_PUT, 0, 9, 0, 1},
    {ACT_TRAIN, 0, 21, 0, 1},
    {ACT_TRAIN_START, 0, 0, 0, 1},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1}, /* COUNTED_FROM: power.c counts changes from here */
    {ACT_PUT, 1, 10, 0, 1},
    {ACT_SUBMIT, 0, 1, 0, 1},
    {ACT_SAVE, 0, 0, 2, 2},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1},
    {ACT_CAMPAIGN, 0, 22, 0, 1}, /* a campaign that learns */
    {ACT_CAMPAIGN_START, 0, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 0, 0, 0, 1},
    {ACT_CAMPAIGN_LOSSES, 0, 0, 3, 1},
    {ACT_CAMPAIGN_CHECKPOINT, 0, 0, 2, 1},
    {ACT_TRAIN_PARK, 0, 0, 1, 1}, /* HELD */
    {ACT_TRAIN_START, 0, 0, 0, 1},
    {ACT_TRAIN_FINISH, 0, 17, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 0, 0, 0, 1},
    {ACT_CAMPAIGN_EXTEND, 0, 0, 2, 1},
    {ACT_CAMPAIGN_FINISH, 0, 18, 0, 1},
    {ACT_CAMPAIGN, 1, 23, 0, 1}, /* a campaign that does not learn */
    {ACT_CAMPAIGN_START, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
    {ACT_CAMPAIGN_PARK, 1, 0, 1, 1},
    {ACT_CAMPAIGN, 2, 25, 0, 1}, /* a study */
    {ACT_CAMPAIGN_TELL, 2, 0, 0, 1},
    {ACT_CAMPAIGN_START, 2, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 2, 0, 0, 1},
    {ACT_CAMPAIGN_TELL, 2, 0, 0, 1},
    {ACT_SCORES, 0, 26, 0, 1},
};

/* ---- choosing ---- */

static uint32_t n_designs_of(uint64_t seed)
{
  return 1 + (uint32_t)(seed % DESIGNS_MAX);
}

int life_some(struct life *life, int n)
{
  return (int)(disk_random(life->disk) % (uint64_t)n);
}

int life_job_in(const struct life *life, enum mo_job_kind kind, unsigned states, bool newest)
{
  int found = -1;
  for (int i = 0; i < life->n_jobs[kind] && (found < 0 || newest); i++)
    if ((states >> life->jobs[kind][i].state & 1u) != 0)
      found = i;
  return found;
}

#define IN(state) (1u << (state))

static bool fits_evaluation(struct life *life, struct act *act)
{
  const struct subject *evaluations = life->jobs[MO_JOB_EVALUATION];
  const unsigned open = IN(MO_JOB_QUEUED) | IN(MO_JOB_RUNNING);
  switch (act->kind) {
  case ACT_SUBMIT: act->index = life->n_jobs[MO_JOB_EVALUATION]; return act->index < JOBS_MAX;
  case ACT_SAVE:
    act->index = life_job_in(life, MO_JOB_EVALUATION, open, true);
    if (act->index >= 0)
      act->parts = act->n =
          1 + (uint32_t)life_some(life, (int)(n_designs_of(evaluations[act->index].seed) -
                                              evaluations[act->index].done));
    return act->index >= 0;
  default: /* change */
    act->n = (uint32_t)(life_some(life, 3) == 0 ? MO_CHANGE_CANCEL : MO_CHANGE_PAUSE);
    act->index = life_job_in(life, MO_JOB_EVALUATION, open | IN(MO_JOB_PAUSED), true);
    if (act->index >= 0 && evaluations[act->index].state == MO_JOB_PAUSED)
      act->n = MO_CHANGE_RESUME;
    return act->index >= 0;
  }
}

static bool fits_training(struct life *life, struct act *act)
{
  const struct subject *trainings = life->jobs[MO_JOB_TRAINING];
  const int n = life->n_jobs[MO_JOB_TRAINING],
            queued = life_job_in(life, MO_JOB_TRAINING, IN(MO_JOB_QUEUED), false),
            running = life_job_in(life, MO_JOB_TRAINING, IN(MO_JOB_RUNNING), false);
  act->index = running;
  switch (act->kind) {
  case ACT_TRAIN: act->index = n; return n < TRAININGS_MAX && queued < 0 && running < 0;
  case ACT_TRAIN_START: act->index = queued; break;
  case ACT_TRAIN_PROGRESS: act->n = 1 + (uint32_t)life_some(life, 20); break;
  case ACT_TRAIN_CHECKPOINT:
    act->n = 1 + (uint32_t)life_some(life, KEPT_MAX);
    return running >= 0 && trainings[running].done > 0;
  case ACT_TRAIN_PARK: act->n = (uint32_t)life_some(life, 2); break;
  case ACT_TRAIN_REMOVE:
    act->index = n > 0 ? life_some(life, n) : 0;
    return n > 0 && trainings[act->index].n_checkpoints >
                        (mo_job_state_is_final(trainings[act->index].state) ? 0 : 1);
  default: return running >= 0 && life_some(life, 4) == 0; /* finish */
  }
  return act->index >= 0;
}

static bool fits(struct life *life, struct act *act)
{
  switch (act->kind) {
  case ACT_REQUEUE:
  case ACT_KINDS: return false;
  case ACT_SCORES: return true;
  case ACT_PUT: /* a quarter of them store existing content, perhaps under another name */
    act->index = life_some(life, NAMES - 1) + 1;
    if (life->n_puts > 0 && life_some(life, 4) == 0)
      act->seed = life->puts[life_some(life, life->n_puts)];
    return life->n_puts < PUTS_MAX;
  case ACT_REMOVE: act->index = life_some(life, NAMES - 1) + 1; return life->named[act->index];
  default:
    return act->kind >= ACT_CAMPAIGN ? campaign_fits(life, act)
           : act->kind >= ACT_TRAIN  ? fits_training(life, act)
                                     : fits_evaluation(life, act);
  }
}

struct act life_choose(struct life *life)
{
  struct act act = {.kind = ACT_PUT, .parts = 1};
  if (!life->named[0]) { /* evaluations score with this controller */
    act.seed = disk_random(life->disk) >> 12 | 8;
    return act;
  }
  do {
    act = (struct act){.kind = (enum act_kind)life_some(life, ACT_KINDS),
                       .seed = disk_random(life->disk) >> 12,
                       .parts = 1};
  } while (!fits(life, &act));
  return act;
}

/* ---- the promise ---- */

/* Reads a job as promised, except for the steps of a training run: the store also lists those of
 * earlier runs. */
static void look(struct life *life, enum mo_job_kind kind, struct subject *subject)
{
  static struct mo_training_status training;
  static struct mo_campaign_status campaign;
  struct mo_checkpoint_row rows[KEPT_MAX + 1];
  struct mo_store *of = life->promised;
  struct mo_job job;
  int error = mo_store_job(of, subject->id, &job);
  const int64_t n = mo_store_checkpoints(of, subject->id, rows, KEPT_MAX + 1);
  if (error == MO_OK && kind == MO_JOB_TRAINING)
    error = mo_store_training(of, subject->id, &training);
  if (error == MO_OK && kind == MO_JOB_CAMPAIGN)
    error = mo_store_campaign(of, subject->id, &campaign);
  if (error != MO_OK || n < 0) {
    life_found(life, "job %lld as promised: error %d", (long long)subject->id, error);
    return;
  }
  subject->n_checkpoints = (uint32_t)n;
  if (kind == MO_JOB_EVALUATION)
    subject->done = (uint32_t)(job.rollouts_done / MO_PAPER_TEST_COUNT);
  if (kind == MO_JOB_TRAINING && subject->state == MO_JOB_QUEUED && job.state == MO_JOB_RUNNING)
    subject->done = n > 0 ? rows[0].step : 0;
  if (kind == MO_JOB_TRAINING)
    subject->validated = training.validation.step;
  if (kind == MO_JOB_CAMPAIGN) {
    subject->done = campaign.scored;
    subject->generation = campaign.generation;
    subject->told = campaign.told;
    subject->until = campaign.record.settings.generations;
    subject->inside = n > 0 && rows[0].generation == campaign.generation + 1 ? rows[0].step : 0;
  }
  subject->state = job.state;
}

static enum mo_job_kind kind_of(const struct act *act)
{
  return act->kind >= ACT_CAMPAIGN ? MO_JOB_CAMPAIGN
         : act->kind >= ACT_TRAIN  ? MO_JOB_TRAINING
                                   : MO_JOB_EVALUATION;
}

static int64_t jobs_of(const struct life *life)
{
  int64_t n = 0;
  for (int kind = 0; kind < KINDS; kind++)
    n += life->n_jobs[kind];
  return n;
}

void life_apply(struct life *life, struct act *act, uint32_t parts)
{
  const enum mo_job_kind kind = kind_of(act);
  struct act done = *act;
  int error;
  if (parts == 0)
    return;
  act->parts -= parts;
  if (act->kind == ACT_SAVE) {
    act->n -= parts;
    done.n = parts;
  }
  if (life_do(life, life->promised, &done, &error) != parts)
    life_found(life, "act %d as promised: error %d", (int)act->kind, error);
  life_wait_for_writer(life->promised);
  switch (act->kind) {
  case ACT_REQUEUE:
    for (int k = 0; k < KINDS; k++)
      for (int i = 0; i < life->n_jobs[k]; i++)
        look(life, (enum mo_job_kind)k, &life->jobs[k][i]);
    return;
  case ACT_PUT: life->puts[life->n_puts++] = act->seed;
  /* fall through */
  case ACT_REMOVE: life->named[act->index] = act->kind == ACT_PUT; return;
  case ACT_SCORES: return;
  case ACT_SUBMIT:
  case ACT_TRAIN:
  case ACT_CAMPAIGN:
    life->jobs[kind][act->index] = (struct subject){.id = jobs_of(life) + 1, .seed = act->seed};
    life->n_jobs[kind]++;
    break;
  case ACT_TRAIN_PROGRESS: life->jobs[kind][act->index].done += act->n; break;
  default: break;
  }
  look(life, kind, &life->jobs[kind][act->index]);
}

/* ---- the operations ---- */

static int do_put(struct mo_store *of, const struct act *act)
{
  struct mo_controller_record record;
  struct put put;
  char name[16];
  bool created;
  put_start(&put, act->seed);
  life_name(act->index, name);
  int error =
      mo_store_controller_put(of, name, put.bytes, put.size, &put.controller, &record, &created);
  put_end(&put);
  return error;
}

/* Stores scores of bodies, with a controller that nothing else uses. */
static int do_scores(const struct life *life, struct mo_store *of, const struct act *act)
{
  static struct mo_score_block block;
  static struct mo_scores_imported entered;
  struct mo_scored_condition *condition = &block.conditions[0];
  struct put put;
  put_start(&put, act->seed);
  block.store = 7;
  block.host[0] = 'x';
  condition->physics = mo_paper_physics();
  mo_sha256_of(put.bytes, put.size, &condition->controller);
  block.weights = put.bytes;
  block.weights_size = put.size;
  block.weights_sha256 = condition->controller;
  block.controller = &put.controller;
  block.environments[1].light_xy_m[0] = (double)(1 + act->seed % 50);
  block.n_conditions = 1;
  block.n_environments = 2;
  block.n_designs = block.n_scores = DESIGNS_MAX;
  for (uint32_t i = 0; i < DESIGNS_MAX; i++) {
    const size_t body = (size_t)(life_hash(act->seed, i) % BODIES);
    struct mo_campaign_score *score = &block.scores[i];
    block.designs[i] =
        (struct mo_scored_design){mo_genotype_of(MO_DEFAULT_WORKSPACE, &life->genotypes[body]),
                                  mo_genotype_of(MO_DEFAULT_WORKSPACE, &life->forms[body])};
    *score = (struct mo_campaign_score){.number = i,
                                        .fingerprint = "another class",
                                        .origin = "y@x",
                                        .n = 2,
                                        .environments = {0, 1}};
    for (uint32_t k = 0; k < 2; k++) {
      int32_t step;
      score->losses[k] = life_loss(act->seed, i, k, &step);
      score->diverged_steps[k] = (uint32_t)step;
    }
  }
  const int error = mo_store_scores_import(of, &block, &entered, NULL);
  put_end(&put);
  return error;
}

static int do_submit(const struct life *life, struct mo_store *of, const struct act *act,
                     int64_t *id)
{
  const size_t first = (size_t)act->index * DESIGNS_MAX;
  struct mo_evaluation_request submission =
      fixture_submission(life->forms + first, life->genotypes + first, n_designs_of(act->seed));
  char key[32];
  bool replayed;
  life_key('e', act->index, key);
  submission.record = MO_RECORD_COM;
  submission.job.key.text = key;
  mo_sha256_of(&act->seed, sizeof(act->seed), &submission.job.key.sha256);
  return mo_store_submit(of, &submission, id, &replayed);
}

static int do_train(struct mo_store *of, const struct act *act, int64_t *id)
{
  struct mo_training_request submission = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                 .checkpoint_every_steps = 12,
                 .checkpoints_kept = 2}};
  char key[32];
  bool replayed;
  life_key('t', act->index, key);
  submission.record.settings.seed = act->seed;
  submission.record.settings.n_steps = 100000;
  submission.job.key.text = key;
  mo_sha256_of(&act->seed, sizeof(act->seed), &submission.job.key.sha256);
  return mo_store_submit_training(of, &submission, id, &replayed);
}

static struct mo_training_step_row step_of(uint64_t seed, uint32_t step)
{
  const uint64_t own = life_hash(seed, UINT64_C(1000000) + step);
  return (struct mo_training_step_row){.report = {.step = step,
                                                  .mean_loss = (double)(own >> 11) * 0x1p-53,
                                                  .rate = 1e-3,
                                                  .gradient_norm = (double)(own & 0xffff),
                                                  .zeroed = (uint32_t)(own & 7)},
                                       .seconds = 0.25};
}

static int do_training(struct life *life, struct mo_store *of, const struct act *act)
{
  const struct subject *training = &life->jobs[MO_JOB_TRAINING][act->index];
  struct mo_training_step_row rows[20];
  struct mo_training_validation_row validation = {
      .step = training->done + act->n, .rollouts = 4, .mean_score = 0.5};
  const bool validates = act->seed % 3 == 0 && validation.step > training->validated;
  struct mo_checkpoints_removed removed;
  struct put put;
  uint8_t *bytes = NULL;
  size_t size;
  char name[32];
  int error;
  switch (act->kind) {
  case ACT_TRAIN_REMOVE:
    return mo_store_checkpoints_remove(of, training->id, MO_JOB_TRAINING, 0, &removed);
  case ACT_TRAIN_START: return mo_store_run_start(of, training->id);
  case ACT_TRAIN_PROGRESS:
    for (uint32_t i = 0; i < act->n; i++)
      rows[i] = step_of(training->seed, training->done + i + 1);
    return mo_store_training_progress(of, training->id, rows, act->n,
                                      validates ? &validation : NULL, "{}");
  case ACT_TRAIN_CHECKPOINT:
    size = life_checkpoint(training->seed, training->done, &bytes);
    error = mo_store_training_checkpoint(of, training->id, training->done, bytes, size, act->n);
    free(bytes);
    return error;
  case ACT_TRAIN_PARK:
    return mo_store_run_park(of, training->id, act->n > 0 ? MO_ERR_NO_MEMORY : MO_OK,
                             act->n > 0 ? "out of memory" : NULL, 3, NULL);
  default: /* finish */
    put_start(&put, act->seed);
    snprintf(name, sizeof(name), "training-%lld", (long long)training->id);
    error = mo_store_training_finish(of, training->id, name, put.bytes, put.size, &put.controller);
    put_end(&put);
    return error;
  }
}

/* ---- several saves in one commit ---- */

struct saving {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  bool all_queued;
  uint32_t answers, acknowledged; /* in order */
  int error;
};

/* Callback of the first save, which stores nothing: the writer waits here until the others are
 * queued, then commits them together. */
static void wait_for_all(struct mo_save *save, int status)
{
  struct saving *saving = save->context;
  pthread_mutex_lock(&saving->mutex);
  while (!saving->all_queued)
    pthread_cond_wait(&saving->changed, &saving->mutex);
  saving->error = status;
  saving->answers++;
  pthread_cond_signal(&saving->changed);
  pthread_mutex_unlock(&saving->mutex);
}

static void answered(struct mo_save *save, int status)
{
  struct saving *saving = save->context;
  pthread_mutex_lock(&saving->mutex);
  if (status == MO_OK && saving->error == MO_OK)
    saving->acknowledged++;
  else
    saving->error = status;
  saving->answers++;
  pthread_cond_signal(&saving->changed);
  pthread_mutex_unlock(&saving->mutex);
}

struct part {
  struct mo_save save;
  struct mo_saved_block blocks[MO_PAPER_TEST_COUNT];
  struct mo_saved_trajectory trajectory;
  double com_m[9];
  double measures[MO_PAPER_TEST_COUNT][MO_MEASURES];
  struct mo_saved_design design;
  struct mo_job_update updates[2];
};

static void make_part(struct life *life, const struct act *act, const struct mo_work *work,
                      uint32_t n, uint64_t *diverged, struct saving *saving, struct part *part)
{
  const struct subject *evaluation = &life->jobs[MO_JOB_EVALUATION][act->index];
  const uint32_t design = evaluation->done + n;
  const uint64_t total = (uint64_t)n_designs_of(evaluation->seed) * MO_PAPER_TEST_COUNT;
  size_t n_updates = 0;
  memset(part, 0, sizeof(*part));
  part->save.blocks = part->blocks;
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
    int32_t step;
    const double loss = life_loss(evaluation->seed, design, k, &step);
    fixture_loss(&part->save, work, design, k, life->fingerprint, loss, step);
    *diverged += step != 0;
    for (unsigned m = 0; m < MO_MEASURES; m++)
      part->measures[k][m] = step != 0 ? (double)NAN : k + m / mo_measure_info[m].steps_in_one;
  }
  if (evaluation->seed % 2 == 1) /* of other evaluations, the same losses have none */
    part->blocks[0].measures = part->measures;
  for (int i = 0; i < 9; i++)
    part->com_m[i] = design + i * 0.125;
  part->trajectory =
      (struct mo_saved_trajectory){.job = evaluation->id,
                                   .design_position = design,
                                   .frames = 3,
                                   .n_masses = 8,
                                   .recording = {.stride = 10, .com_m = part->com_m}};
  part->design = (struct mo_saved_design){work->genotype_rows[design], work->controller,
                                          work->physics_rows[0],       work->sets[0],
                                          life->fingerprint,           life->fingerprint};
  if (evaluation->state == MO_JOB_QUEUED && n == 0)
    part->updates[n_updates++] = (struct mo_job_update){.job = evaluation->id,
                                                        .step = MO_STEP_START,
                                                        .fingerprint = life->fingerprint,
                                                        .workers = life->fingerprint};
  part->updates[n_updates++] = (struct mo_job_update){
      .job = evaluation->id,
      .step = design + 1 == n_designs_of(evaluation->seed) ? MO_STEP_SUCCEED : MO_STEP_PROGRESS,
      .total = total,
      .done = (uint64_t)(design + 1) * MO_PAPER_TEST_COUNT,
      .diverged = *diverged};
  part->save = (struct mo_save){.blocks = part->blocks,
                                .n_blocks = part->save.n_blocks,
                                .trajectories = &part->trajectory,
                                .n_trajectories = 1,
                                .designs = &part->design,
                                .n_designs = 1,
                                .updates = part->updates,
                                .n_updates = n_updates,
                                .done = answered,
                                .context = saving};
}

static uint32_t do_save(struct life *life, struct mo_store *of, const struct act *act, int *error)
{
  const struct subject *evaluation = &life->jobs[MO_JOB_EVALUATION][act->index];
  struct saving saving = {.all_queued = false};
  struct mo_save gate = {.done = wait_for_all, .context = &saving};
  struct part parts[DESIGNS_MAX];
  struct mo_work *work = NULL;
  uint32_t queued = 0;
  uint64_t diverged = 0;
  int32_t step;
  *error = mo_store_load_work(of, evaluation->id, fixture_classes(life->fingerprint), &work);
  if (*error != MO_OK)
    return 0;
  for (uint32_t design = 0; design < evaluation->done; design++)
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      (void)life_loss(evaluation->seed, design, k, &step);
      diverged += step != 0;
    }
  pthread_mutex_init(&saving.mutex, NULL);
  pthread_cond_init(&saving.changed, NULL);
  *error = mo_store_save(of, &gate);
  queued += *error == MO_OK;
  for (uint32_t n = 0; n < act->n && *error == MO_OK; n++) {
    make_part(life, act, work, n, &diverged, &saving, &parts[n]);
    *error = mo_store_save(of, &parts[n].save);
    queued += *error == MO_OK;
  }
  pthread_mutex_lock(&saving.mutex);
  saving.all_queued = true;
  pthread_cond_broadcast(&saving.changed);
  while (saving.answers < queued)
    pthread_cond_wait(&saving.changed, &saving.mutex);
  pthread_mutex_unlock(&saving.mutex);
  pthread_mutex_destroy(&saving.mutex);
  pthread_cond_destroy(&saving.changed);
  mo_work_free(work);
  if (*error == MO_OK)
    *error = saving.error;
  return saving.acknowledged;
}

void life_wait_for_writer(struct mo_store *of)
{
  struct saving saving = {.all_queued = true};
  struct mo_save save = {.done = wait_for_all, .context = &saving};
  pthread_mutex_init(&saving.mutex, NULL);
  pthread_cond_init(&saving.changed, NULL);
  if (mo_store_save(of, &save) == MO_OK) {
    pthread_mutex_lock(&saving.mutex);
    while (saving.answers == 0)
      pthread_cond_wait(&saving.changed, &saving.mutex);
    pthread_mutex_unlock(&saving.mutex);
  }
  pthread_mutex_destroy(&saving.mutex);
  pthread_cond_destroy(&saving.changed);
}

uint32_t life_do(struct life *life, struct mo_store *of, const struct act *act, int *error)
{
  const int64_t expected = jobs_of(life) + 1;
  int64_t id = expected;
  char name[16];
  switch (act->kind) {
  case ACT_REQUEUE:
    *error = mo_store_requeue(of, 0, 3, NULL);
    if (*error == MO_OK)
      *error = mo_store_fingerprint(of, "a test", &life->fingerprint);
    break;
  case ACT_PUT: *error = do_put(of, act); break;
  case ACT_REMOVE:
    life_name(act->index, name);
    *error = mo_store_controller_remove(of, name);
    break;
  case ACT_SCORES: *error = do_scores(life, of, act); break;
  case ACT_SUBMIT: *error = do_submit(life, of, act, &id); break;
  case ACT_SAVE: return do_save(life, of, act, error);
  case ACT_CHANGE:
    *error = mo_store_change_job(of, life->jobs[MO_JOB_EVALUATION][act->index].id,
                                 (enum mo_job_change)act->n, NULL);
    break;
  case ACT_TRAIN: *error = do_train(of, act, &id); break;
  default:
    *error =
        act->kind >= ACT_CAMPAIGN ? campaign_do(life, of, act, &id) : do_training(life, of, act);
    break;
  }
  if (*error == MO_OK && id != expected)
    life_found(life, "a submission became job %lld, not %lld", (long long)id, (long long)expected);
  return *error == MO_OK;
}
