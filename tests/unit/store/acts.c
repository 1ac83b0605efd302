/* acts.c: what is asked of the store, and what it means for the model. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fixture.h"
#include "life.h"

const struct act life_script[SCRIPT] = {
    {ACT_PUT, 0, 9, 0, 1},
    {ACT_TRAIN, 0, 21, 0, 1},
    {ACT_TRAIN_START, 0, 0, 0, 1},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1}, /* COUNTED_FROM: power.c counts changes from here on */
    {ACT_PUT, 1, 10, 0, 1},
    {ACT_SUBMIT, 0, 1, 0, 1},
    {ACT_SAVE, 0, 0, 2, 2},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1},
    {ACT_CAMPAIGN, 0, 22, 0, 1}, /* one that learns */
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
    {ACT_CAMPAIGN, 1, 23, 0, 1}, /* one that does not */
    {ACT_CAMPAIGN_START, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
    {ACT_CAMPAIGN_PARK, 1, 0, 1, 1},
};

/* ---- choosing ---- */

int life_some(struct life *life, int n)
{
  return (int)(disk_random(life->disk) % (uint64_t)n);
}

/* A thing in a fitting state; −1: there is none. Of those that fit one of the newest. */
static int evaluation_in(const struct model *model, unsigned states)
{
  for (int i = model->n_evaluations - 1; i >= 0; i--)
    if ((states >> model->evaluations[i].state & 1u) != 0)
      return i;
  return -1;
}

static int training_in(const struct model *model, unsigned states)
{
  for (int i = 0; i < model->n_trainings; i++)
    if ((states >> model->trainings[i].state & 1u) != 0)
      return i;
  return -1;
}

#define IN(state) (1u << (state))

static bool fits(struct life *life, struct act *act)
{
  const struct model *model = &life->model;
  const unsigned queued = IN(MO_JOB_QUEUED), running = IN(MO_JOB_RUNNING),
                 paused = IN(MO_JOB_PAUSED);
  const struct evaluation_model *evaluation;
  const struct training_model *training;
  act->parts = 1;
  switch (act->kind) {
  case ACT_PUT: /* a quarter: what is there already, perhaps under another name */
    act->index = life_some(life, NAMES - 1) + 1;
    if (model->n_contents > 0 && life_some(life, 4) == 0)
      act->seed = model->contents[life_some(life, model->n_contents)];
    return model->n_contents < CONTENTS_MAX - TRAININGS_MAX;
  case ACT_REMOVE:
    act->index = life_some(life, NAMES - 1) + 1;
    return model->names[act->index].content >= 0;
  case ACT_SUBMIT: act->index = model->n_evaluations; return model->n_evaluations < EVALUATIONS_MAX;
  case ACT_SAVE:
    act->index = evaluation_in(model, queued | running);
    if (act->index < 0)
      return false;
    evaluation = &model->evaluations[act->index];
    act->parts = act->n =
        1 + (uint32_t)life_some(life, (int)(evaluation->n_designs - evaluation->saved));
    return true;
  case ACT_CHANGE:
    act->n = (uint32_t)(life_some(life, 3) == 0 ? MO_CHANGE_CANCEL : MO_CHANGE_PAUSE);
    act->index = evaluation_in(model, queued | running | paused);
    if (act->index >= 0 && model->evaluations[act->index].state == MO_JOB_PAUSED)
      act->n = MO_CHANGE_RESUME;
    return act->index >= 0;
  case ACT_TRAIN:
    act->index = model->n_trainings;
    return model->n_trainings < TRAININGS_MAX && training_in(model, queued | running) < 0;
  case ACT_TRAIN_START: act->index = training_in(model, queued); return act->index >= 0;
  case ACT_TRAIN_PROGRESS: act->n = 1 + (uint32_t)life_some(life, 20); break;
  case ACT_TRAIN_CHECKPOINT: act->n = 1 + (uint32_t)life_some(life, KEPT_MAX); break;
  case ACT_TRAIN_PARK: act->n = (uint32_t)life_some(life, 2); break;
  case ACT_TRAIN_FINISH: break;
  case ACT_TRAIN_REMOVE:
    if (model->n_trainings == 0)
      return false;
    act->index = life_some(life, model->n_trainings);
    training = &model->trainings[act->index];
    return training->n_checkpoints > (mo_job_state_is_final(training->state) ? 0 : 1);
  case ACT_REQUEUE:
  case ACT_KINDS: return false;
  default: return campaign_fits(life, act);
  }
  act->index = training_in(model, running);
  if (act->kind == ACT_TRAIN_CHECKPOINT && act->index >= 0 &&
      model->trainings[act->index].position == 0)
    return false;
  return act->index >= 0 && (act->kind != ACT_TRAIN_FINISH || life_some(life, 4) == 0);
}

struct act life_choose(struct life *life)
{
  struct act act = {.kind = ACT_PUT, .parts = 1};
  if (life->model.names[0].content < 0) { /* what evaluations score with */
    act.seed = disk_random(life->disk) >> 12 | 8;
    return act;
  }
  do {
    act = (struct act){.kind = (enum act_kind)life_some(life, ACT_KINDS),
                       .seed = disk_random(life->disk) >> 12};
  } while (!fits(life, &act));
  return act;
}

/* ---- what an act means ---- */

int model_content(struct model *model, uint64_t seed)
{
  int i = 0;
  while (i < model->n_contents && model->contents[i] != seed)
    i++;
  if (i == model->n_contents)
    model->contents[model->n_contents++] = seed;
  return i;
}

static void apply_put(struct model *model, const struct act *act)
{
  const int content = model_content(model, act->seed);
  if (model->names[act->index].content == content)
    return;
  model->names[act->index].version =
      model->names[act->index].content < 0 ? 1 : model->names[act->index].version + 1;
  model->names[act->index].content = content;
  model->events++;
}

static void apply_checkpoint(struct training_model *training, uint32_t keep)
{
  uint32_t n = 0;
  if (training->n_checkpoints == 0 ||
      training->position > training->checkpoints[training->n_checkpoints - 1])
    training->attempts = 0;
  while (n < training->n_checkpoints && training->checkpoints[n] < training->position)
    n++;
  if (n == KEPT_MAX) {
    memmove(training->checkpoints, training->checkpoints + 1, (KEPT_MAX - 1) * sizeof(uint32_t));
    n--;
  }
  training->checkpoints[n] = training->position;
  training->n_checkpoints = n + 1;
  if (training->n_checkpoints > keep) {
    memmove(training->checkpoints, training->checkpoints + training->n_checkpoints - keep,
            keep * sizeof(uint32_t));
    training->n_checkpoints = keep;
  }
}

static bool validates(const struct training_model *training, const struct act *act)
{
  return act->seed % 3 == 0 && training->position + act->n > training->last_validation;
}

static void apply_training(struct model *model, const struct act *act)
{
  struct training_model *training = &model->trainings[act->index];
  model->events += act->kind != ACT_TRAIN_REMOVE;
  switch (act->kind) {
  case ACT_TRAIN_REMOVE:
    if (mo_job_state_is_final(training->state))
      training->n_checkpoints = 0;
    else
      training->checkpoints[0] = training->checkpoints[training->n_checkpoints - 1];
    training->n_checkpoints = training->n_checkpoints > 0;
    break;
  case ACT_TRAIN_START: /* from its newest checkpoint */
    training->state = MO_JOB_RUNNING;
    training->position =
        training->n_checkpoints > 0 ? training->checkpoints[training->n_checkpoints - 1] : 0;
    break;
  case ACT_TRAIN_PROGRESS:
    if (validates(training, act)) {
      training->last_validation = training->position + act->n;
      training->n_validations++;
      model->events++;
    }
    training->position += act->n;
    if (training->position > training->step)
      training->step = training->position;
    break;
  case ACT_TRAIN_CHECKPOINT: apply_checkpoint(training, act->n); break;
  case ACT_TRAIN_PARK:
    training->attempts += act->n;
    training->state = training->attempts >= 3 ? MO_JOB_FAILED : MO_JOB_QUEUED;
    break;
  default: /* finish */
    training->state = MO_JOB_SUCCEEDED;
    training->result = model_content(model, act->seed);
    model->events++;
    break;
  }
}

void life_apply(struct model *model, const struct act *act, uint32_t parts)
{
  if (parts == 0)
    return;
  struct evaluation_model *evaluation = &model->evaluations[act->index];
  switch (act->kind) {
  case ACT_REQUEUE:
    for (int i = 0; i < model->n_evaluations; i++)
      if (model->evaluations[i].state == MO_JOB_RUNNING)
        model->evaluations[i].state = MO_JOB_QUEUED;
    for (int i = 0; i < model->n_trainings; i++)
      if (model->trainings[i].state == MO_JOB_RUNNING)
        model->trainings[i].state = MO_JOB_QUEUED;
    for (int i = 0; i < model->n_campaigns; i++)
      if (model->campaigns[i].state == MO_JOB_RUNNING)
        model->campaigns[i].state = MO_JOB_QUEUED;
    break;
  case ACT_PUT: apply_put(model, act); break;
  case ACT_REMOVE:
    model->names[act->index].content = -1;
    model->events++;
    break;
  case ACT_SUBMIT:
    *evaluation = (struct evaluation_model){.id = ++model->jobs,
                                            .seed = act->seed,
                                            .n_designs = 1 + (uint32_t)(act->seed % DESIGNS_MAX),
                                            .state = MO_JOB_QUEUED};
    model->n_evaluations++;
    model->events++;
    break;
  case ACT_SAVE:
    model->events += parts + (evaluation->state == MO_JOB_QUEUED);
    evaluation->saved += parts;
    evaluation->state =
        evaluation->saved == evaluation->n_designs ? MO_JOB_SUCCEEDED : MO_JOB_RUNNING;
    break;
  case ACT_CHANGE:
    evaluation->state = act->n == MO_CHANGE_CANCEL  ? MO_JOB_CANCELLED
                        : act->n == MO_CHANGE_PAUSE ? MO_JOB_PAUSED
                                                    : MO_JOB_QUEUED;
    model->events++;
    break;
  case ACT_TRAIN:
    model->trainings[act->index] = (struct training_model){
        .id = ++model->jobs, .seed = act->seed, .state = MO_JOB_QUEUED, .result = -1};
    model->n_trainings++;
    model->events++;
    break;
  default:
    if (act->kind >= ACT_CAMPAIGN)
      campaign_apply(model, act);
    else
      apply_training(model, act);
    break;
  }
}

/* ---- doing it ---- */

static int do_put(struct life *life, const struct act *act)
{
  struct mo_controller_record record;
  struct put put;
  char name[16];
  bool created;
  put_start(&put, act->seed);
  life_name(act->index, name);
  int error = mo_store_controller_put(life->store, name, put.bytes, put.size, &put.controller,
                                      &record, &created);
  put_end(&put);
  return error;
}

static int do_submit(struct life *life, const struct act *act)
{
  const size_t first = (size_t)act->index * DESIGNS_MAX;
  struct mo_submission submission = fixture_submission(life->forms + first, life->genotypes + first,
                                                       1 + (uint32_t)(act->seed % DESIGNS_MAX));
  char key[32];
  int64_t id = 0;
  bool replayed;
  life_key('e', act->index, key);
  submission.record = MO_RECORD_COM;
  submission.idempotency_key = key;
  mo_sha256_of(&act->seed, sizeof(act->seed), &submission.body_sha256);
  int error = mo_store_submit(life->store, &submission, &id, &replayed);
  if (error == MO_OK && (replayed || id != life->model.jobs + 1))
    life_found(life, "a submission became job %lld, not %lld", (long long)id, life->model.jobs + 1);
  return error;
}

static int do_train(struct life *life, const struct act *act)
{
  struct mo_training_submission submission = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                 .checkpoint_every_steps = 12,
                 .checkpoints_kept = 2}};
  char key[32];
  int64_t id = 0;
  bool replayed;
  life_key('t', act->index, key);
  submission.record.settings.seed = act->seed;
  submission.record.settings.n_steps = 100000;
  submission.idempotency_key = key;
  mo_sha256_of(&act->seed, sizeof(act->seed), &submission.body_sha256);
  int error = mo_store_submit_training(life->store, &submission, &id, &replayed);
  if (error == MO_OK && (replayed || id != life->model.jobs + 1))
    life_found(life, "a training became job %lld, not %lld", (long long)id, life->model.jobs + 1);
  return error;
}

static int do_training(struct life *life, const struct act *act)
{
  const struct training_model *training = &life->model.trainings[act->index];
  struct mo_training_step_row rows[20];
  struct mo_training_validation_row validation = {
      .step = training->position + act->n, .rollouts = 4, .mean_score = 0.5};
  struct mo_checkpoints_removed removed;
  struct put put;
  uint8_t *bytes = NULL;
  size_t size;
  char name[32];
  int error;
  switch (act->kind) {
  case ACT_TRAIN_REMOVE:
    return mo_store_checkpoints_remove(life->store, training->id, MO_JOB_TRAINING, 0, &removed);
  case ACT_TRAIN_START: return mo_store_run_start(life->store, training->id);
  case ACT_TRAIN_PROGRESS:
    for (uint32_t i = 0; i < act->n; i++)
      rows[i] = life_step(training->seed, training->position + i + 1);
    return mo_store_training_progress(life->store, training->id, rows, act->n,
                                      validates(training, act) ? &validation : NULL, "{}");
  case ACT_TRAIN_CHECKPOINT:
    size = life_checkpoint(training->seed, training->position, &bytes);
    error = mo_store_training_checkpoint(life->store, training->id, training->position, bytes, size,
                                         act->n);
    free(bytes);
    return error;
  case ACT_TRAIN_PARK:
    return mo_store_run_park(life->store, training->id, act->n > 0 ? MO_ERR_NO_MEMORY : MO_OK,
                             act->n > 0 ? "out of memory" : NULL, 3, NULL);
  default: /* finish */
    put_start(&put, act->seed);
    snprintf(name, sizeof(name), "training-%lld", training->id);
    error = mo_store_training_finish(life->store, training->id, name, put.bytes, put.size,
                                     &put.controller);
    put_end(&put);
    return error;
  }
}

/* ---- saving, several at once in one commit ---- */

struct saving {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  bool all_queued;
  uint32_t answers, acknowledged; /* in order */
  int error;
};

/* Of the first, which saves nothing: the writer waits until the others are queued, and takes them
 * together. */
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
  struct mo_saved_score scores[MO_PAPER_TEST_COUNT];
  struct mo_saved_trajectory trajectory;
  double com_m[9];
  struct mo_saved_design design;
  struct mo_job_update updates[2];
};

static void make_part(struct life *life, const struct act *act, const struct mo_work *work,
                      uint32_t n, uint64_t *diverged, struct saving *saving, struct part *part)
{
  const struct evaluation_model *evaluation = &life->model.evaluations[act->index];
  const uint32_t design = evaluation->saved + n;
  const uint64_t total = (uint64_t)evaluation->n_designs * MO_PAPER_TEST_COUNT;
  size_t n_updates = 0;
  memset(part, 0, sizeof(*part));
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
    struct mo_saved_score *score = &part->scores[k];
    *score = (struct mo_saved_score){.genotype = work->genotype_rows[design],
                                     .controller = work->controller,
                                     .physics = work->physics,
                                     .environment = work->environment_rows[k],
                                     .fingerprint = life->fingerprint};
    score->loss = life_loss(evaluation->seed, design, k, &score->diverged_step);
    *diverged += score->diverged_step != 0;
  }
  for (int i = 0; i < 9; i++)
    part->com_m[i] = design + i * 0.125;
  part->trajectory =
      (struct mo_saved_trajectory){.job = evaluation->id,
                                   .design_position = design,
                                   .frames = 3,
                                   .n_masses = 8,
                                   .recording = {.stride = 10, .com_m = part->com_m}};
  part->design =
      (struct mo_saved_design){work->genotype_rows[design], work->controller,  work->physics,
                               work->environment_set,       life->fingerprint, life->fingerprint};
  if (evaluation->state == MO_JOB_QUEUED && n == 0)
    part->updates[n_updates++] = (struct mo_job_update){.job = evaluation->id,
                                                        .step = MO_STEP_START,
                                                        .fingerprint = life->fingerprint,
                                                        .workers = life->fingerprint};
  part->updates[n_updates++] = (struct mo_job_update){
      .job = evaluation->id,
      .step = design + 1 == evaluation->n_designs ? MO_STEP_SUCCEED : MO_STEP_PROGRESS,
      .total = total,
      .done = (uint64_t)(design + 1) * MO_PAPER_TEST_COUNT,
      .diverged = *diverged};
  part->save = (struct mo_save){.scores = part->scores,
                                .n_scores = MO_PAPER_TEST_COUNT,
                                .trajectories = &part->trajectory,
                                .n_trajectories = 1,
                                .designs = &part->design,
                                .n_designs = 1,
                                .updates = part->updates,
                                .n_updates = n_updates,
                                .done = answered,
                                .context = saving};
}

static uint32_t do_save(struct life *life, const struct act *act, int *error)
{
  const struct evaluation_model *evaluation = &life->model.evaluations[act->index];
  struct saving saving = {.all_queued = false};
  struct mo_save gate = {.done = wait_for_all, .context = &saving};
  struct part parts[DESIGNS_MAX];
  struct mo_work *work = NULL;
  uint32_t queued = 0;
  uint64_t diverged = 0;
  int32_t step;
  *error =
      mo_store_load_work(life->store, evaluation->id, fixture_classes(life->fingerprint), &work);
  if (*error != MO_OK)
    return 0;
  for (uint32_t design = 0; design < evaluation->saved; design++)
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      (void)life_loss(evaluation->seed, design, k, &step);
      diverged += step != 0;
    }
  pthread_mutex_init(&saving.mutex, NULL);
  pthread_cond_init(&saving.changed, NULL);
  *error = mo_store_save(life->store, &gate);
  queued += *error == MO_OK;
  for (uint32_t n = 0; n < act->n && *error == MO_OK; n++) {
    make_part(life, act, work, n, &diverged, &saving, &parts[n]);
    *error = mo_store_save(life->store, &parts[n].save);
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

void life_settle(struct life *life)
{
  struct saving saving = {.all_queued = true};
  struct mo_save save = {.done = wait_for_all, .context = &saving};
  pthread_mutex_init(&saving.mutex, NULL);
  pthread_cond_init(&saving.changed, NULL);
  if (mo_store_save(life->store, &save) == MO_OK) {
    pthread_mutex_lock(&saving.mutex);
    while (saving.answers == 0)
      pthread_cond_wait(&saving.changed, &saving.mutex);
    pthread_mutex_unlock(&saving.mutex);
  }
  pthread_mutex_destroy(&saving.mutex);
  pthread_cond_destroy(&saving.changed);
}

uint32_t life_do(struct life *life, const struct act *act, int *error)
{
  char text[512];
  switch (act->kind) {
  case ACT_REQUEUE:
    *error = mo_store_requeue(life->store, 0, 3, NULL);
    if (*error == MO_OK)
      *error = mo_store_fingerprint(life->store, "a test", &life->fingerprint);
    break;
  case ACT_PUT: *error = do_put(life, act); break;
  case ACT_REMOVE:
    life_name(act->index, text);
    *error = mo_store_controller_remove(life->store, text);
    break;
  case ACT_SUBMIT: *error = do_submit(life, act); break;
  case ACT_SAVE: return do_save(life, act, error);
  case ACT_CHANGE:
    *error = mo_store_change_job(life->store, life->model.evaluations[act->index].id,
                                 (enum mo_job_change)act->n, NULL);
    break;
  case ACT_TRAIN: *error = do_train(life, act); break;
  default:
    *error = act->kind >= ACT_CAMPAIGN ? campaign_do(life, act) : do_training(life, act);
    break;
  }
  return *error == MO_OK;
}
