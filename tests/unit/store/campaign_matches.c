/* campaign_matches.c: is a campaign in the store what the model says: every generation that was
 * committed, whole, and no other? */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fixture.h"
#include "life.h"

static bool same_double(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0;
}

/* A design at the end of the replay. */
struct lived {
  struct mo_descent descent;
  uint32_t born;
  int64_t died;
  double score;
};

/* Everybody who was ever born, and every population on the way. */
static bool populations_match(const struct life *life, const struct campaign_model *campaign,
                              struct lived *lived, char text[300])
{
  struct generation generation = {0};
  struct population before = {0};
  for (uint32_t g = 0; (int64_t)g <= campaign->generation; g++) {
    struct mo_campaign_design rows[MEMBERS];
    struct mo_campaign_generation row;
    uint32_t n = 0;
    bool lives[2 * MEMBERS] = {false};
    life_generation(campaign, g, &before, &generation);
    for (uint32_t i = 0; i < before.n; i++)
      lived[before.numbers[i]].score = generation.parent_scores[i];
    for (uint32_t i = 0; i < MEMBERS; i++) {
      struct lived *child = &lived[g * MEMBERS + i];
      *child = (struct lived){.born = g, .died = -1, .score = generation.child_scores[i]};
      child->descent.op = (uint8_t)generation.births[i].op;
      for (int p = 0; p < 2; p++)
        child->descent.parents[p] = generation.births[i].parents[p] == MO_NO_PARENT
                                        ? MO_NO_PARENT
                                        : before.numbers[generation.births[i].parents[p]];
      lives[generation.survivors[i]] = true;
    }
    for (uint32_t i = 0; i < before.n + MEMBERS; i++)
      if (!lives[i])
        lived[i < before.n ? before.numbers[i] : g * MEMBERS + i - before.n].died = g;
    if (mo_store_campaign_generations(life->store, campaign->id, (int64_t)g - 1, &row, 1) != 1 ||
        row.generation != g || row.born_before != (uint64_t)g * MEMBERS ||
        row.n_children != MEMBERS || row.mean_children != 0.5 + g || row.stats.diversity != 0.25)
      return life_differs(text, "generation %u of campaign %lld", g, campaign->id);
    if (mo_store_campaign_population(life->store, campaign->id, g, 0, rows, MEMBERS, &n) !=
            MEMBERS ||
        n != MEMBERS)
      return life_differs(text, "the population of generation %u of campaign %lld", g,
                          campaign->id);
    for (uint32_t i = 0; i < MEMBERS; i++)
      if (rows[i].number != generation.after.numbers[i] ||
          !same_double(rows[i].score, generation.after.scores[i]))
        return life_differs(text, "member %u of generation %u of campaign %lld", i, g,
                            campaign->id);
    before = generation.after;
  }
  return true;
}

static bool designs_match(const struct life *life, const struct campaign_model *campaign, int index,
                          const struct lived *lived, char text[300])
{
  struct mo_campaign_design rows[GENERATIONS_MAX * MEMBERS];
  const int64_t expected = MEMBERS * (campaign->generation + 1);
  const int64_t n =
      mo_store_campaign_designs(life->store, campaign->id, -1, rows, GENERATIONS_MAX * MEMBERS);
  const size_t first = BODIES_OF_CAMPAIGNS + (size_t)index * GENERATIONS_MAX * MEMBERS;
  if (n != expected)
    return life_differs(text, "campaign %lld has %lld designs, not %lld", campaign->id,
                        (long long)n, (long long)expected);
  for (int64_t i = 0; i < n; i++)
    if (rows[i].number != i ||
        memcmp(&rows[i].genotype, &life->genotypes[first + (size_t)i], sizeof(struct mo_bits)) !=
            0 ||
        memcmp(&rows[i].form, &life->forms[first + (size_t)i], sizeof(struct mo_bits)) != 0 ||
        rows[i].descent.op != lived[i].descent.op ||
        rows[i].descent.parents[0] != lived[i].descent.parents[0] ||
        rows[i].descent.parents[1] != lived[i].descent.parents[1] ||
        rows[i].born != lived[i].born || rows[i].died != lived[i].died ||
        !same_double(rows[i].score, lived[i].score) ||
        rows[i].size.springs != 1000 + (uint32_t)i % MEMBERS)
      return life_differs(text, "design %lld of campaign %lld", (long long)i, campaign->id);
  return true;
}

/* What is saved of the unfinished generation. */
static bool losses_match(const struct life *life, const struct campaign_model *campaign,
                         char text[300])
{
  struct mo_campaign_loss *losses = NULL;
  size_t n = 0;
  const int error = mo_store_campaign_losses(life->store, campaign->id,
                                             (uint32_t)(campaign->generation + 1), &losses, &n);
  bool same = error == MO_OK && n == campaign->scored;
  for (uint32_t i = 0; same && i < n; i++) {
    const struct mo_campaign_loss loss = life_saved_loss(campaign, i);
    same = losses[i].place == i &&
           memcmp(losses[i].losses, loss.losses, MO_PAPER_TEST_COUNT * sizeof(double)) == 0 &&
           memcmp(losses[i].diverged_steps, loss.diverged_steps,
                  MO_PAPER_TEST_COUNT * sizeof(int32_t)) == 0;
  }
  if (error == MO_OK)
    free(losses);
  return same || life_differs(text, "losses of campaign %lld: error %d, %zu, not %u", campaign->id,
                              error, n, campaign->scored);
}

static bool steps_match(const struct life *life, const struct campaign_model *campaign,
                        char text[300])
{
  struct mo_campaign_step rows[(GENERATIONS_MAX + 1) * LEARNING];
  const int64_t expected =
      campaign->learns ? LEARNING * (campaign->generation + 1) + campaign->inside : 0;
  const int64_t n = mo_store_campaign_steps(life->store, campaign->id, -1, 0, rows,
                                            (GENERATIONS_MAX + 1) * LEARNING);
  bool same = n == expected;
  for (int64_t i = 0; same && i < n; i++) {
    const struct mo_campaign_step step =
        life_learned(campaign, (uint32_t)(i / LEARNING), (uint32_t)(i % LEARNING) + 1);
    same = rows[i].generation == step.generation && rows[i].step == step.step &&
           rows[i].on_children == step.on_children &&
           same_double(rows[i].report.mean_loss, step.report.mean_loss);
  }
  return same || life_differs(text, "campaign %lld learned %lld steps, not %lld, or others",
                              campaign->id, (long long)n, (long long)expected);
}

/* The bytes are those of a generation and step; generation −1: there are none. */
static bool state_is(const struct campaign_model *campaign, int error, const uint8_t *bytes,
                     size_t size, int64_t generation, uint32_t step)
{
  uint8_t *expected = NULL;
  if (generation < 0)
    return error == MO_ERR_NOT_FOUND;
  size_t expected_size = life_state(campaign, (uint32_t)generation, step, &expected);
  bool same = error == MO_OK && size == expected_size && memcmp(bytes, expected, size) == 0;
  free(expected);
  return same;
}

static bool checkpoints_match(const struct life *life, const struct campaign_model *campaign,
                              char text[300])
{
  const bool inside = campaign->inside > 0;
  const int64_t newest = inside             ? campaign->generation + 1
                         : campaign->learns ? campaign->generation
                                            : -1;
  const uint32_t files = life_files(life, "campaigns", campaign->id, NULL);
  const uint32_t expected = (campaign->learns && campaign->generation >= 0) + inside;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t generation = 0, step = 0;
  int error = newest_checkpoint(life->store, campaign->id, &generation, &step, &bytes, &size);
  bool same =
      state_is(campaign, error, bytes, size, newest, inside ? campaign->inside : LEARNING) &&
      (newest < 0 || (generation == newest && step == (inside ? campaign->inside : LEARNING)));
  if (error == MO_OK)
    free(bytes);
  if (same && campaign->generation >= 0) {
    error = mo_store_campaign_checkpoint_of(life->store, campaign->id,
                                            (uint32_t)campaign->generation, &step, &bytes, &size);
    same = state_is(campaign, error, bytes, size, campaign->learns ? campaign->generation : -1,
                    LEARNING);
    if (error == MO_OK)
      free(bytes);
  }
  if (!same)
    return life_differs(text, "a checkpoint of campaign %lld: error %d", campaign->id, error);
  return files == expected || life_differs(text, "campaign %lld has %u files for %u checkpoints",
                                           campaign->id, files, expected);
}

bool campaign_matches(const struct life *life, const struct campaign_model *campaign, int index,
                      char text[300])
{
  static struct mo_campaign_status status;
  struct lived lived[GENERATIONS_MAX * MEMBERS];
  const int error = mo_store_campaign(life->store, campaign->id, &status);
  if (error != MO_OK)
    return life_differs(text, "campaign %lld: error %d", campaign->id, error);
  if (status.job.state != campaign->state || status.job.attempts != campaign->attempts ||
      status.generation != campaign->generation ||
      status.n_designs != (uint64_t)(MEMBERS * (campaign->generation + 1)) ||
      status.scored != campaign->scored || status.has_result != (campaign->result >= 0) ||
      status.record.settings.seed != campaign->seed ||
      status.record.settings.generations != campaign->until)
    return life_differs(
        text, "campaign %lld: state %d, attempts %u, generation %lld, %llu designs, %u scored",
        campaign->id, status.job.state, status.job.attempts, (long long)status.generation,
        (unsigned long long)status.n_designs, status.scored);
  return populations_match(life, campaign, lived, text) &&
         designs_match(life, campaign, index, lived, text) && losses_match(life, campaign, text) &&
         steps_match(life, campaign, text) && checkpoints_match(life, campaign, text);
}
