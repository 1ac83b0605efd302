/* campaign_acts.c: campaigns on a disk that loses power: generations that depend only on a seed,
 * and the operations on campaigns. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "campaign_fixture.h"
#include "life.h"
#include "store/studies.h"

/* ---- generations ---- */

struct population {
  uint32_t n, numbers[MEMBERS];
  double scores[MEMBERS];
};

/* A generation as its runner commits it. It depends only on the campaign's seed and the
 * generation's number. */
struct generation {
  struct mo_birth births[MEMBERS];
  double child_scores[MEMBERS], parent_scores[MEMBERS];
  struct mo_campaign_loss losses[MEMBERS];
  struct mo_campaign_step steps[LEARNING];
  struct mo_design_size sizes[MEMBERS];
  uint32_t survivors[MEMBERS];
  struct population before, after;
};

static bool learns(const struct subject *campaign) /* otherwise zero-shot */
{
  return campaign->seed % 2 == 0;
}

static bool is_study(const struct subject *campaign)
{
  return campaign->seed % 4 == 1;
}

static double number(uint64_t hash)
{
  return (double)(hash >> 11) * 0x1p-53;
}

static uint64_t seed_of(const struct subject *campaign, uint32_t generation)
{
  return life_hash(campaign->seed, UINT64_C(5000) + generation);
}

static struct mo_campaign_step learned(const struct subject *campaign, uint32_t generation,
                                       uint32_t step)
{
  const uint64_t own = life_hash(seed_of(campaign, generation), 70 + (uint64_t)step);
  return (struct mo_campaign_step){
      .generation = generation,
      .step = step,
      .on_children = step > LEARNING / 2,
      .report = {.step = generation * LEARNING + step, .mean_loss = number(own), .rate = 1e-3},
      .seconds = 0.5};
}

static double score_at(const struct generation *generation, uint32_t place)
{
  return place < generation->before.n ? generation->parent_scores[place]
                                      : generation->child_scores[place - generation->before.n];
}

/* Selects the best of parents and children; older designs win ties. */
static void select_survivors(struct generation *generation, uint32_t first_child)
{
  uint32_t places[2 * MEMBERS];
  const uint32_t n_parents = generation->before.n;
  for (uint32_t i = 0; i < n_parents + MEMBERS; i++) {
    uint32_t at = i;
    while (at > 0 && score_at(generation, places[at - 1]) > score_at(generation, i)) {
      places[at] = places[at - 1];
      at--;
    }
    places[at] = i;
  }
  generation->after.n = MEMBERS;
  for (uint32_t i = 0; i < MEMBERS; i++) {
    generation->survivors[i] = places[i];
    generation->after.scores[i] = score_at(generation, places[i]);
    generation->after.numbers[i] = places[i] < n_parents ? generation->before.numbers[places[i]]
                                                         : first_child + places[i] - n_parents;
  }
}

static void make_generation(const struct subject *campaign, uint32_t number_of,
                            const struct population *before, struct generation *generation)
{
  const uint64_t seed = seed_of(campaign, number_of);
  memset(generation, 0, sizeof(*generation));
  if (before != NULL)
    generation->before = *before;
  for (uint32_t i = 0; i < generation->before.n; i++)
    generation->parent_scores[i] =
        learns(campaign) ? number(life_hash(seed, 50 + (uint64_t)i)) : generation->before.scores[i];
  for (uint32_t i = 0; i < MEMBERS; i++) {
    double sum = 0;
    generation->births[i] = (struct mo_birth){MO_BORN_RANDOM, {MO_NO_PARENT, MO_NO_PARENT}, 1};
    if (generation->before.n > 0 && i % 2 == 0)
      generation->births[i] = (struct mo_birth){MO_BORN_MUTATION, {i, MO_NO_PARENT}, 1};
    else if (generation->before.n > 0)
      generation->births[i] = (struct mo_birth){MO_BORN_CROSSOVER, {i, (i + 1) % MEMBERS}, 2};
    generation->losses[i].place = i;
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      generation->losses[i].losses[k] =
          life_loss(seed, i, k, &generation->losses[i].diverged_steps[k]);
      sum += generation->losses[i].losses[k];
    }
    generation->child_scores[i] =
        learns(campaign) ? number(life_hash(seed, 60 + (uint64_t)i)) : sum / MO_PAPER_TEST_COUNT;
    generation->sizes[i] = (struct mo_design_size){10 + i, 1 + i, 100 + i, 1000 + i};
  }
  for (uint32_t step = 1; step <= LEARNING; step++)
    generation->steps[step - 1] = learned(campaign, number_of, step);
  select_survivors(generation, number_of * MEMBERS);
}

static void replay(const struct subject *campaign, uint32_t until, struct generation *generation)
{
  struct population before = {0};
  for (uint32_t i = 0; i <= until; i++) {
    make_generation(campaign, i, &before, generation);
    before = generation->after;
  }
}

static struct mo_campaign_loss saved_loss(const struct subject *campaign, uint32_t place)
{
  const uint64_t seed = seed_of(campaign, (uint32_t)(campaign->generation + 1)) ^ 1;
  struct mo_campaign_loss loss = {.place = place};
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
    loss.losses[k] = life_loss(seed, place, k, &loss.diverged_steps[k]);
  return loss;
}

/* ---- choosing ---- */

/* A study waits in the queue until a batch is submitted (tell), and again after its commit. */
static bool study_fits(const struct subject *study, enum act_kind kind)
{
  const bool is_pending = study->told > study->generation;
  switch (kind) {
  case ACT_CAMPAIGN_TELL: return !is_pending && study->generation + 1 < GENERATIONS_MAX;
  case ACT_CAMPAIGN_FINISH: return !is_pending && study->state == MO_JOB_QUEUED;
  case ACT_CAMPAIGN_START: return is_pending;
  case ACT_CAMPAIGN_EXTEND: return false;
  default: return is_pending && study->state == MO_JOB_RUNNING;
  }
}

bool campaign_fits(struct life *life, struct act *act)
{
  const unsigned queued = 1u << MO_JOB_QUEUED, running = 1u << MO_JOB_RUNNING;
  const unsigned states = act->kind == ACT_CAMPAIGN_START ? queued
                          : act->kind == ACT_CAMPAIGN_EXTEND || act->kind == ACT_CAMPAIGN
                              ? queued | running
                              : running;
  const int found = life_job_in(life, MO_JOB_CAMPAIGN,
                                act->kind == ACT_CAMPAIGN_TELL || act->kind == ACT_CAMPAIGN_FINISH
                                    ? queued | running
                                    : states,
                                false);
  act->index = act->kind == ACT_CAMPAIGN ? life->n_jobs[MO_JOB_CAMPAIGN] : found;
  if (act->kind == ACT_CAMPAIGN)
    return act->index < CAMPAIGNS_MAX && found < 0;
  if (found < 0)
    return false;
  const struct subject *campaign = &life->jobs[MO_JOB_CAMPAIGN][found];
  bool goes_on = campaign->generation + 1 < GENERATIONS_MAX;
  if (is_study(campaign) ? !study_fits(campaign, act->kind)
                         : act->kind == ACT_CAMPAIGN_TELL || (states >> campaign->state & 1) == 0)
    return false;
  switch (act->kind) {
  case ACT_CAMPAIGN_LOSSES:
    if (!goes_on || campaign->done == 2 * MEMBERS)
      return false;
    act->n = 1 + (uint32_t)life_some(life, (int)(2 * MEMBERS - campaign->done));
    return true;
  case ACT_CAMPAIGN_CHECKPOINT: /* possibly the same step again */
    act->n = (campaign->inside > 0 ? campaign->inside : 1) + (uint32_t)life_some(life, 3);
    return goes_on && learns(campaign) && act->n <= LEARNING;
  case ACT_CAMPAIGN_GENERATION: return goes_on;
  case ACT_CAMPAIGN_PARK: act->n = (uint32_t)life_some(life, 2); return true;
  case ACT_CAMPAIGN_EXTEND: act->n = 1 + (uint32_t)life_some(life, 2); return true;
  case ACT_CAMPAIGN_FINISH:
    return campaign->generation >= 0 && (!goes_on || life_some(life, 8) == 0);
  default: return true;
  }
}

/* ---- the operations ---- */

static int submit(const struct life *life, struct mo_store *of, const struct act *act, int64_t *id)
{
  struct mo_campaign_request submission = campaign_submission(
      act->seed % 2 == 0 ? MO_SIMULTANEOUS : MO_ZERO_SHOT, MEMBERS, GENERATIONS_MAX);
  const size_t first = BODIES_OF_CAMPAIGNS + (size_t)act->index * GENERATIONS_MAX * MEMBERS;
  const struct subject campaign = {.seed = act->seed};
  char key[32];
  bool replayed;
  life_key('c', act->index, key);
  if (is_study(&campaign)) {
    submission.record.settings.mode = MO_STUDY;
    submission.record.settings.generations = 0;
    submission.record.settings.exclude_pretraining = false;
  }
  submission.record.settings.seed = act->seed;
  submission.forms = life->forms + first;
  submission.genotypes = life->genotypes + first;
  submission.record.n_listed = is_study(&campaign) ? 0 : LISTED;
  submission.job.key.text = key;
  mo_sha256_of(&act->seed, sizeof(act->seed), &submission.job.key.sha256);
  return mo_store_submit_campaign(of, &submission, id, &replayed);
}

static int save_losses(struct mo_store *of, const struct subject *campaign, uint32_t n)
{
  struct mo_campaign_loss losses[2 * MEMBERS];
  for (uint32_t i = 0; i < n; i++)
    losses[i] = saved_loss(campaign, campaign->done + i);
  return mo_store_campaign_save_losses(of, campaign->id, (uint32_t)(campaign->generation + 1),
                                       losses, n, "{}");
}

static int save_checkpoint(struct mo_store *of, const struct subject *campaign, uint32_t step)
{
  const uint32_t generation = (uint32_t)(campaign->generation + 1);
  struct mo_campaign_step steps[LEARNING];
  uint8_t *bytes = NULL;
  const size_t size = life_checkpoint(seed_of(campaign, generation), step, &bytes);
  for (uint32_t i = 0; i < step; i++)
    steps[i] = learned(campaign, generation, i + 1);
  int error =
      mo_store_campaign_checkpoint(of, campaign->id, generation, step, bytes, size, steps, step);
  free(bytes);
  return error;
}

/* The metadata of a study's children: an operator with a custom name, and a measure. */
static const char operator_word[] = "made", measure_word[] = "height";

static struct mo_descent descent_of(const struct generation *generation, uint32_t child)
{
  const struct mo_birth *birth = &generation->births[child];
  struct mo_descent descent = {.op = birth->op};
  if (child == 0)
    descent.op = MO_OPERATORS; /* the first custom operator of the study */
  for (int p = 0; p < 2; p++)
    descent.parents[p] = birth->parents[p] == MO_NO_PARENT
                             ? MO_NO_PARENT
                             : generation->before.numbers[birth->parents[p]];
  return descent;
}

static int tell(const struct life *life, struct mo_store *of, const struct subject *study,
                int index)
{
  const uint32_t batch = (uint32_t)(study->generation + 1);
  const size_t first = BODIES_OF_CAMPAIGNS + ((size_t)index * GENERATIONS_MAX + batch) * MEMBERS;
  const uint64_t seed = seed_of(study, batch);
  struct generation generation;
  struct mo_study_child children[MEMBERS];
  double measures[MEMBERS];
  struct mo_study_telling telling = {
      .batch = {batch, MEMBERS, 1, 0, children, measures, false, NULL},
      .words = {.n_operators = 1, .n_measures = 1}};
  struct mo_telling_reply reply;
  uint8_t *bytes = NULL;
  replay(study, batch, &generation);
  for (uint32_t i = 0; i < MEMBERS; i++) {
    children[i] =
        (struct mo_study_child){mo_genotype_of(MO_DEFAULT_WORKSPACE, &life->genotypes[first + i]),
                                i, descent_of(&generation, i)};
    measures[i] = number(life_hash(seed, i));
  }
  memcpy(telling.words.operators[0], operator_word, sizeof(operator_word));
  memcpy(telling.words.measures[0], measure_word, sizeof(measure_word));
  telling.sampler_size = life_checkpoint(seed, 0, &bytes);
  telling.sampler = bytes;
  mo_sha256_of(&seed, sizeof(seed), &telling.sha256);
  const int error = mo_store_study_tell(of, study->id, &telling, &reply);
  free(bytes);
  return error;
}

static int commit(const struct life *life, struct mo_store *of, const struct subject *campaign,
                  int index)
{
  const uint32_t number_of = (uint32_t)(campaign->generation + 1);
  const size_t first =
      BODIES_OF_CAMPAIGNS + ((size_t)index * GENERATIONS_MAX + number_of) * MEMBERS;
  struct generation generation;
  uint8_t *bytes = NULL;
  replay(campaign, number_of, &generation);
  struct mo_campaign_commit call =
      (struct mo_campaign_commit){.row = {.generation = number_of,
                                          .born_before = (uint64_t)number_of * MEMBERS,
                                          .n_children = MEMBERS,
                                          .stats = {.n = MEMBERS, .diversity = 0.25},
                                          .mean_parents = NAN,
                                          .mean_children = 0.5 + number_of,
                                          .seconds = 1.5},
                                  .births = generation.births,
                                  .forms = life->forms + first,
                                  .genotypes = life->genotypes + first,
                                  .sizes = generation.sizes,
                                  .child_scores = generation.child_scores,
                                  .parent_numbers = generation.before.numbers,
                                  .parent_scores = generation.parent_scores,
                                  .n_parents = generation.before.n,
                                  .survivors = generation.survivors,
                                  .n_survivors = MEMBERS,
                                  .fingerprint = life->fingerprint,
                                  .event_data = "{}"};
  if (is_study(campaign)) {
    call.is_study = true;
    for (uint32_t i = 0; i < MEMBERS; i++) {
      const struct mo_descent descent = descent_of(&generation, i);
      generation.births[i].op = descent.op;
      memcpy(generation.births[i].parents, descent.parents, sizeof(descent.parents));
    }
  }
  if (learns(campaign)) {
    call.steps = generation.steps;
    call.n_steps = LEARNING;
    call.checkpoint_size = life_checkpoint(seed_of(campaign, number_of), LEARNING, &bytes);
    call.checkpoint = bytes;
    call.checkpoint_step = LEARNING;
  } else {
    call.losses = generation.losses;
    call.n_losses = MEMBERS;
  }
  int error = mo_store_campaign_commit(of, campaign->id, &call);
  free(bytes);
  return error;
}

static int finish(struct mo_store *of, const struct subject *campaign, uint64_t seed)
{
  struct put put;
  char name[32];
  enum mo_job_state before;
  if (is_study(campaign))
    return mo_store_study_finish(of, campaign->id, &before);
  put_start(&put, seed);
  snprintf(name, sizeof(name), "campaign-%lld", (long long)campaign->id);
  int error =
      mo_store_campaign_finish(of, campaign->id, MO_CAMPAIGN_COMPLETED, campaign->until, name,
                               put.bytes, put.size, learns(campaign) ? &put.controller : NULL);
  put_end(&put);
  return error;
}

int campaign_do(struct life *life, struct mo_store *of, const struct act *act, int64_t *id)
{
  const struct subject *campaign = &life->jobs[MO_JOB_CAMPAIGN][act->index];
  enum mo_job_state before;
  switch (act->kind) {
  case ACT_CAMPAIGN: return submit(life, of, act, id);
  case ACT_CAMPAIGN_TELL: return tell(life, of, campaign, act->index);
  case ACT_CAMPAIGN_START: return mo_store_run_start(of, campaign->id);
  case ACT_CAMPAIGN_LOSSES: return save_losses(of, campaign, act->n);
  case ACT_CAMPAIGN_CHECKPOINT: return save_checkpoint(of, campaign, act->n);
  case ACT_CAMPAIGN_GENERATION: return commit(life, of, campaign, act->index);
  case ACT_CAMPAIGN_PARK:
    return mo_store_run_park(of, campaign->id, act->n > 0 ? MO_ERR_NO_MEMORY : MO_OK,
                             act->n > 0 ? "out of memory" : NULL, 3, NULL);
  case ACT_CAMPAIGN_EXTEND:
    return mo_store_extend_campaign(of, campaign->id, act->n, NULL, &before);
  default: return finish(of, campaign, act->seed);
  }
}
