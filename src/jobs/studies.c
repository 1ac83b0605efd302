/* studies.c: see studies.h. */
#include "jobs/studies.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/submission.h"
#include "store/worlds.h"

static int read_study(struct mo_jobs *jobs, int64_t id, struct mo_campaign_status *status)
{
  const int error = mo_store_campaign(jobs->store, id, status);
  return error == MO_OK && mo_modes[status->record.settings.mode].makes_children ? MO_ERR_NOT_FOUND
                                                                                 : error;
}

/* ---- submitting a batch ---- */

static int place_bodies(struct mo_workspace workspace, struct mo_study_telling *telling)
{
  for (uint32_t i = 0; i < telling->batch.n_children; i++) {
    struct mo_study_child *child = &telling->batch.children[i];
    struct mo_bits moved;
    mo_genotype_place(child->genotype.workspace, child->genotype.words);
    const int error =
        mo_genotype_move(child->genotype.workspace, child->genotype.words, workspace, moved.words);
    if (error != MO_OK)
      return error;
  }
  return MO_OK;
}

/* Orients the children that came as ids, using the scores in the study. */
static int orient(struct mo_jobs *jobs, int64_t id, const struct mo_campaign_status *status,
                  struct mo_study_telling *telling, struct mo_message *message)
{
  const uint32_t n = telling->batch.n_children;
  char controller[MO_SHA256_DIGITS + 8] = "sha256:";
  struct mo_environment *environments = NULL;
  struct mo_placed placed = {NULL, calloc((size_t)n + 1, sizeof(*placed.genotypes))};
  struct mo_orienting under = {.physics = &status->record.settings.physics,
                               .controller = controller,
                               .precision = MO_FLOAT32,
                               .workspace = status->record.settings.workspace};
  int error = placed.genotypes != NULL
                  ? mo_store_job_environments(jobs->store, id, MO_JOB_CAMPAIGN, &environments,
                                              &under.n_environments)
                  : MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    memcpy(placed.genotypes[i].words, telling->batch.children[i].genotype.words,
           sizeof(*placed.genotypes));
  mo_sha256_to_hex(&status->job.controller_sha256, controller + strlen(controller));
  under.environments = environments;
  if (error == MO_OK)
    error = mo_placed_orient(jobs, &under, status->job.back_end, &placed, n, telling->notes,
                             telling->n_notes, message);
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    telling->batch.children[i].genotype =
        mo_genotype_of(jobs->lattice->workspace, &placed.genotypes[i]);
  mo_environments_free(environments, under.n_environments);
  mo_placed_free(&placed);
  return error;
}

static int explain(int error, const struct mo_telling_reply *reply,
                   const struct mo_study_telling *telling, const struct mo_campaign_status *status,
                   struct mo_message *message)
{
  const unsigned number = (unsigned)telling->batch.number;
  if (error != MO_ERR_CONFLICT && error != MO_ERR_RANGE && error != MO_ERR_INVALID &&
      error != MO_ERR_LIMIT)
    return mo_fail(message, error, "the batch could not be stored: %s", mo_error_text(error));
  switch (reply->fault) {
  case MO_TELLING_NUMBER:
    return mo_fail(message, error, "got batch %u, but batch %u is %s", number,
                   (unsigned)reply->next,
                   status->told == reply->next ? "still being scored" : "the next one");
  case MO_TELLING_OTHER:
    return mo_fail(message, error,
                   "batch %u was already sent with different content; the next batch is %u", number,
                   (unsigned)(number < reply->next ? reply->next : number + 1));
  case MO_TELLING_ENDED: return mo_fail(message, error, "the study has ended");
  case MO_TELLING_PARENT:
    return mo_fail(message, error, "a parent must be the number of an earlier design, 0 to %lld",
                   (long long)status->n_designs - 1);
  case MO_TELLING_SURVIVOR:
    return mo_fail(message, error,
                   "survivors must be numbers of designs in the population, without duplicates");
  case MO_TELLING_MANY:
    return mo_fail(message, error,
                   "survivors and children must not exceed the study's population, which is %u",
                   (unsigned)reply->place);
  case MO_TELLING_SCORE:
    return mo_fail(message, error,
                   "this body already has the score %s in this study, and a body can have only "
                   "one; send that score, or leave the body out",
                   MO_NUMBER(reply->score));
  case MO_TELLING_WORDS:
    return mo_fail(message, error, "a study may define at most %d operators and %d measures",
                   MO_STUDY_OPERATORS_MAX, MO_STUDY_MEASURES_MAX);
  default:
    return mo_fail(message, error, "a study may have at most %d batches and %" PRIu64 " designs",
                   MO_GENERATIONS_MAX, MO_CAMPAIGN_DESIGNS_MAX);
  }
}

int mo_jobs_tell(struct mo_jobs *jobs, int64_t id, struct mo_study_telling *telling,
                 struct mo_telling_reply *reply, struct mo_message *message)
{
  struct mo_campaign_status status;
  int error = read_study(jobs, id, &status);
  if (error != MO_OK)
    return mo_fail(message, error, "the study does not exist");
  if ((telling->batch.scores != NULL) != mo_campaign_takes_scores(&status.record))
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   telling->batch.scores != NULL
                       ? "this study has no own_score, so it does not accept scores"
                       : "this study has an own_score, so each child needs a score");
  error = place_bodies(status.record.settings.workspace, telling);
  if (error != MO_OK)
    return mo_fail(message, error, "a child does not fit the study's workspace");
  error = telling->n_notes > 0 ? orient(jobs, id, &status, telling, message) : MO_OK;
  if (error != MO_OK)
    return error;
  error = mo_store_study_tell(jobs->store, id, telling, reply);
  if (error != MO_OK)
    return explain(error, reply, telling, &status, message);
  if (reply->is_new)
    mo_runners_wake(&jobs->runners[MO_JOB_CAMPAIGN]);
  return MO_OK;
}

/* ---- asking ---- */

struct asking {
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_campaign_settings settings; /* population: size of the batch */
  size_t words;
  uint32_t generation, n_parents;
  uint32_t *numbers;   /* (n_parents) */
  uint64_t *parents;   /* (n_parents, words) */
  uint64_t *genotypes; /* (n, words) */
  struct mo_birth *births;
  struct mo_seen *seen;
};

/* Reads the numbers and bodies of the parents: all, in their order, or as many as there are
 * requested bodies, at random. A study that asks for its whole population therefore behaves like a
 * campaign. */
static int read_parents(struct asking *asking, const struct mo_ask *ask)
{
  struct mo_campaign_state *state = NULL;
  struct mo_campaign_design *designs = NULL;
  uint32_t *places = NULL;
  int error = MO_OK;
  uint32_t n = ask->n_parents;
  if (ask->parents == NULL)
    error = mo_store_campaign_state(asking->jobs->store, asking->id, &state);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error; /* no design has been born yet */
  const uint32_t *numbers = state != NULL ? state->numbers : ask->parents;
  n = state != NULL ? state->n : numbers != NULL ? n : 0;
  asking->n_parents = n < ask->n ? n : ask->n;
  asking->numbers = calloc((size_t)n + 1, sizeof(*asking->numbers));
  asking->parents = calloc((size_t)asking->n_parents + 1, asking->words * sizeof(uint64_t));
  designs = calloc((size_t)asking->n_parents + 1, sizeof(*designs));
  places = calloc((size_t)n + 1, sizeof(*places));
  if (asking->numbers == NULL || asking->parents == NULL || designs == NULL || places == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    places[i] = i;
  if (error == MO_OK && asking->n_parents < n)
    mo_variation_parents(asking->settings.seed, asking->generation, n, asking->n_parents, places);
  for (uint32_t i = 0; i < asking->n_parents && error == MO_OK; i++)
    asking->numbers[i] = numbers[places[i]];
  if (error == MO_OK)
    error = mo_store_campaign_designs_of(asking->jobs->store, asking->id, asking->numbers,
                                         asking->n_parents, designs);
  if (error == MO_ERR_NOT_FOUND)
    error = MO_ERR_RANGE;
  for (uint32_t i = 0; i < asking->n_parents && error == MO_OK; i++)
    error = mo_genotype_move(designs[i].genotype.workspace, designs[i].genotype.words,
                             asking->settings.workspace, asking->parents + asking->words * i);
  mo_campaign_state_free(state);
  free(designs);
  free(places);
  return error;
}

/* Makes the bodies, and writes them as children. */
static int make(struct asking *asking, bool is_random, struct mo_asked *asked)
{
  struct mo_variation_counts counts;
  const bool varies = !is_random && asking->n_parents > 0;
  int error = mo_seen_create(asking->settings.workspace, NULL, &asking->seen);
  if (error == MO_OK)
    error = mo_store_campaign_each(asking->jobs->store, asking->id, mo_seen_take, asking->seen);
  if (error == MO_OK && varies)
    error = mo_variation(&asking->settings, asking->generation, asking->parents, asking->n_parents,
                         asking->seen, asking->genotypes, asking->births, &asked->n, &counts, NULL);
  else if (error == MO_OK)
    error = mo_population_initial(&asking->settings, asking->seen, asking->genotypes, 0, &asked->n,
                                  NULL, NULL);
  for (uint32_t i = 0; i < asked->n && error == MO_OK; i++) {
    struct mo_study_child *child = &asked->children[i];
    child->place = i;
    child->descent = (struct mo_descent){{MO_NO_PARENT, MO_NO_PARENT}, MO_BORN_RANDOM};
    for (int p = 0; p < 2 && varies; p++)
      if (asking->births[i].parents[p] != MO_NO_PARENT)
        child->descent.parents[p] = asking->numbers[asking->births[i].parents[p]];
    if (varies)
      child->descent.op = (uint8_t)asking->births[i].op;
    child->genotype.workspace = asking->jobs->lattice->workspace;
    error = mo_genotype_move(asking->settings.workspace, asking->genotypes + asking->words * i,
                             child->genotype.workspace, child->genotype.words);
  }
  return error;
}

int mo_jobs_ask(struct mo_jobs *jobs, int64_t id, const struct mo_ask *ask, struct mo_asked *asked,
                struct mo_message *message)
{
  struct mo_campaign_status status;
  int error = read_study(jobs, id, &status);
  if (error != MO_OK)
    return mo_fail(message, error, "the study does not exist");
  if (mo_job_state_is_final(status.job.state))
    return mo_fail(message, MO_ERR_CONFLICT, "the study has ended");
  if (status.n_designs > MO_COLUMNS_MAX) /* all of them are read, and their forms kept */
    return mo_fail(message, MO_ERR_LIMIT,
                   "a study with more than %lld designs cannot return bodies",
                   (long long)MO_COLUMNS_MAX);
  if (status.told > status.generation)
    return mo_fail(message, MO_ERR_CONFLICT, "batch %lld is still being scored",
                   (long long)status.told);
  struct asking asking = {.jobs = jobs,
                          .id = id,
                          .settings = status.record.settings,
                          .words = mo_workspace_words(status.record.settings.workspace),
                          .generation = (uint32_t)(status.generation + 1)};
  if (ask->n > asking.settings.population)
    return mo_fail(message, MO_ERR_RANGE, "n must be at most the population, which is %u",
                   (unsigned)asking.settings.population);
  asking.settings.population = ask->n;
  *asked = (struct mo_asked){.batch = asking.generation,
                             .children = calloc(ask->n, sizeof(*asked->children))};
  asking.genotypes = calloc(ask->n, asking.words * sizeof(uint64_t));
  asking.births = calloc(ask->n, sizeof(*asking.births));
  if (asked->children == NULL || asking.genotypes == NULL || asking.births == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK && !ask->is_random)
    error = read_parents(&asking, ask);
  if (error == MO_OK)
    error = make(&asking, ask->is_random, asked);
  mo_seen_free(asking.seen);
  free(asking.numbers);
  free(asking.parents);
  free(asking.genotypes);
  free(asking.births);
  if (error == MO_OK)
    return MO_OK;
  free(asked->children);
  asked->children = NULL;
  return error == MO_ERR_RANGE
             ? mo_fail(message, error, "a parent must be the number of a design, 0 to %lld",
                       (long long)status.n_designs - 1)
             : mo_fail(message, error, "no bodies could be made: %s", mo_error_text(error));
}

/* ---- the end, and results ---- */

int mo_jobs_finish_study(struct mo_jobs *jobs, int64_t id)
{
  struct mo_campaign_status status;
  enum mo_job_state before;
  int error = read_study(jobs, id, &status);
  if (error == MO_OK)
    error = mo_store_study_finish(jobs->store, id, &before);
  if (error == MO_OK && before != MO_JOB_SUCCEEDED) {
    atomic_fetch_add(&jobs->jobs_succeeded, 1);
    mo_jobs_closed(jobs, 1, 0);
  }
  return error;
}

int mo_jobs_study_losses(struct mo_jobs *jobs, int64_t id, const struct mo_bits *genotypes,
                         uint32_t n, struct mo_campaign_loss *losses,
                         double (*measures)[MO_MEASURES], uint8_t *known)
{
  struct mo_job job;
  struct mo_campaign_loss *found = calloc((size_t)n + 1, sizeof(*found));
  int error = found == NULL ? MO_ERR_NO_MEMORY : mo_store_job(jobs->store, id, &job);
  int64_t n_found = 0;
  for (uint32_t i = 0; i < n && error == MO_OK && measures != NULL; i++)
    found[i].measures = measures + (size_t)i * job.n_environments;
  if (error == MO_OK)
    n_found = mo_store_campaign_known(jobs->store, id, mo_back_end_fingerprint(jobs, job.back_end),
                                      0, genotypes, n, found);
  for (int64_t i = 0; i < n_found; i++) {
    losses[found[i].place] = found[i];
    known[found[i].place] = found[i].stored == UINT64_MAX >> (64 - job.n_environments);
  }
  free(found);
  return n_found < 0 ? (int)n_found : error;
}
