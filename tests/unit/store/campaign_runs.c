/* campaign_runs.c: what a campaign's runner writes: generations whole, losses and checkpoints on
 * the way. */
#include <dirent.h>
#include <sys/stat.h>

#include "../check.h"
#include "by_hand.h"
#include "campaign_fixture.h"
#include "one_store.h"

#define UNTIL 5 /* generations after the first */

static bool same_bits(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0;
}

/* A campaign of a mode that was started, its runner at hand. */
static int64_t begin(struct made *made, enum mo_campaign_mode mode)
{
  struct mo_campaign_submission submission = campaign_submission(mode, MADE_POPULATION, UNTIL);
  int64_t id;
  int error = fixture_start(&fixture) == 0 ? MO_OK : MO_ERR_IO;
  if (error != MO_OK)
    return error;
  id = campaign_submit(&fixture, &submission);
  if (id > 0)
    error = made_start(made, fixture.store, id, mode, MADE_POPULATION, 9);
  if (id > 0 && error == MO_OK)
    error = mo_store_run_start(fixture.store, id);
  return error != MO_OK ? error : id;
}

/* Another life of the process: the campaign runs again. */
static int live_again(struct made *made)
{
  int error = fixture_reopen(&fixture);
  made->store = fixture.store;
  if (error == MO_OK)
    error = mo_store_requeue(fixture.store, 0, 3, "");
  return error == MO_OK ? mo_store_run_start(fixture.store, made->id) : error;
}

static void commits_generations(enum mo_campaign_mode mode)
{
  struct made made = {0};
  struct mo_campaign_status status;
  struct mo_campaign_generation rows[UNTIL + 2];
  struct mo_campaign_step steps[2 * UNTIL + 3];
  struct mo_campaign_generation last;
  int64_t id = begin(&made, mode);
  REQUIRE(id > 0);
  CHECK_INT(mo_store_run_start(fixture.store, id), MO_ERR_CONFLICT);
  REQUIRE(made_generation(&made) == MO_OK);
  CHECK(made_is_stored(&made));
  for (int g = 1; g <= UNTIL; g++)
    REQUIRE(made_generation(&made) == MO_OK);
  CHECK(made_is_stored(&made));
  CHECK_TEXT(campaign_event(&fixture, id).type, "campaign.generation");
  CHECK_TEXT(campaign_event(&fixture, id).data, "{\"made\":true}");
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  made.store = fixture.store;
  CHECK(made_is_stored(&made));
  REQUIRE(mo_store_campaign(fixture.store, id, &status) == MO_OK);
  CHECK_INT(status.generation, UNTIL);
  CHECK_INT(status.job.steps_done, UNTIL);
  CHECK_INT(status.n_designs, (UNTIL + 1) * MADE_POPULATION);
  CHECK(same_bits(status.best_score, made.scores[0]));
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, -1, rows, UNTIL + 2), UNTIL + 1);
  last = made.commit.row;
  last.stored_us = rows[UNTIL].stored_us;
  CHECK(last.stored_us > 0);
  CHECK(isnan(rows[UNTIL].mean_parents));
  CHECK(rows[UNTIL].stats.n == last.stats.n &&
        same_bits(rows[UNTIL].stats.diversity, last.stats.diversity));
  CHECK(memcmp(rows[UNTIL].stats.quantiles, last.stats.quantiles, sizeof(last.stats.quantiles)) ==
        0);
  CHECK(memcmp(&rows[UNTIL].stats.voxels, &last.stats.voxels, 4 * sizeof(last.stats.voxels)) == 0);
  CHECK(memcmp(&rows[UNTIL].variation.mutation_attempts, &last.variation.mutation_attempts, 8) ==
        0);
  CHECK(rows[UNTIL].mean_children == last.mean_children && rows[UNTIL].turnover == last.turnover);
  CHECK(rows[UNTIL].rollouts == last.rollouts && rows[UNTIL].collapse == last.collapse);
  CHECK(rows[UNTIL].seconds == 1.5 && rows[UNTIL].born_before == UNTIL * MADE_POPULATION);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, 2, rows, 2), 2);
  CHECK(rows[0].generation == 3 && rows[1].generation == 4);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, UNTIL, rows, 2), 0);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, 0, rows, MO_PAGE_MAX + 1),
            MO_ERR_LIMIT);
  CHECK_INT(mo_store_campaign_steps(fixture.store, id, -1, 0, steps, 2 * UNTIL + 3),
            mode == MO_ZERO_SHOT ? 0 : 2 * UNTIL + 2);
  if (mode != MO_ZERO_SHOT) {
    CHECK(memcmp(&steps[2 * UNTIL + 1].report.mean_loss, &made.steps[1].report.mean_loss, 8) == 0);
    CHECK_INT(mo_store_campaign_steps(fixture.store, id, 1, 1, steps, 2), 2);
    CHECK(steps[0].generation == 1 && steps[0].step == 2 && steps[0].on_children &&
          steps[0].report.step == 4);
    CHECK(steps[0].report.diverged == 1 && steps[1].generation == 2 && steps[1].step == 1 &&
          !steps[1].on_children);
  }
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  made_free(&made);
}

static void commits_in_every_mode(void)
{
  commits_generations(MO_ZERO_SHOT);
  commits_generations(MO_FEW_SHOT);
  commits_generations(MO_SIMULTANEOUS);
}

/* Everything that a commit may say wrong, and every moment at which it comes at the wrong time:
 * nothing changes. */
static void refuses_what_is_wrong(void)
{
  struct made made = {0}, child;
  struct mo_campaign_commit commit;
  struct mo_event before, after;
  uint32_t survivors[2 * MADE_POPULATION], numbers[MADE_POPULATION];
  int64_t id = begin(&made, MO_ZERO_SHOT);
  REQUIRE(id > 0 && made_generation(&made) == MO_OK && made_next(&made) == MO_OK);
  before = campaign_event(&fixture, id);
  child = made; /* what is committed in the end */
#define REFUSE(change, expected)                                                                   \
  do {                                                                                             \
    commit = made.commit;                                                                          \
    memcpy(survivors, made.survivors, sizeof(survivors));                                          \
    memcpy(numbers, made.numbers, sizeof(numbers));                                                \
    commit.survivors = survivors;                                                                  \
    commit.parent_numbers = numbers;                                                               \
    change;                                                                                        \
    CHECK_INT(mo_store_campaign_commit(fixture.store, id, &commit), expected);                     \
    CHECK(made_is_stored(&made));                                                                  \
  } while (0)
  REFUSE(commit.row.generation = 0, MO_ERR_CONFLICT);
  REFUSE(commit.row.generation = 2, MO_ERR_CONFLICT);
  REFUSE(commit.row.born_before = 5, MO_ERR_INVALID);
  REFUSE(commit.row.born_before = MO_CAMPAIGN_DESIGNS_MAX, MO_ERR_RANGE);
  REFUSE(commit.row.n_children = MO_POPULATION_MAX + 1, MO_ERR_RANGE);
  REFUSE(commit.n_parents--, MO_ERR_INVALID);
  REFUSE(commit.n_survivors = 2 * MADE_POPULATION + 1, MO_ERR_RANGE);
  REFUSE(survivors[1] = survivors[0], MO_ERR_INVALID);
  REFUSE(survivors[0] = 2 * MADE_POPULATION, MO_ERR_INVALID);
  REFUSE(numbers[2] = numbers[3], MO_ERR_INVALID);
#undef REFUSE
  after = campaign_event(&fixture, id);
  CHECK_INT(after.sequence, before.sequence);
  CHECK_INT(mo_store_campaign_commit(fixture.store, id + 1, &made.commit), MO_ERR_CONFLICT);
  /* Paused: its thread commits what it has; cancelled, or of an earlier life of the process: it may
   * not. */
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(mo_store_campaign_commit(fixture.store, id, &child.commit), MO_OK);
  made_apply(&made);
  CHECK(made_is_stored(&made));
  CHECK_INT(campaign_state(&fixture, id), MO_JOB_PAUSED);
  REQUIRE(made_next(&made) == MO_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  made.store = fixture.store;
  CHECK_INT(mo_store_campaign_commit(fixture.store, id, &made.commit), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 2, made.losses, 1, NULL),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_checkpoint(fixture.store, id, 2, 1, (const uint8_t *)"x", 1, NULL, 0),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, NULL), MO_OK);
  CHECK_INT(mo_store_campaign_commit(fixture.store, id, &made.commit), MO_ERR_CONFLICT);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_campaign_commit(fixture.store, id, &made.commit), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 2, made.losses, 1, NULL),
            MO_ERR_CONFLICT);
  CHECK(made_is_stored(&made));
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  made_free(&made);
}

static void keeps_losses_of_a_generation(void)
{
  struct made made = {0};
  struct mo_campaign_loss *losses = NULL, more;
  struct mo_campaign_status status;
  size_t n = 9;
  int64_t id = begin(&made, MO_FEW_SHOT);
  REQUIRE(id > 0 && made_next(&made) == MO_OK);
  CHECK_INT(mo_store_campaign_losses(fixture.store, id, 0, &losses, &n), MO_OK);
  CHECK_INT(n, 0);
  free(losses);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 1, made.losses, 2, NULL),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, made.losses + 2, 2, NULL), MO_OK);
  CHECK_TEXT(campaign_event(&fixture, id).type, "job.started");
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, made.losses, 3, "{\"saved\":3}"),
            MO_OK);
  CHECK_TEXT(campaign_event(&fixture, id).type, "campaign.progress");
  more = made.losses[0];
  more.place = 2 * MADE_POPULATION;
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, &more, 1, NULL), MO_ERR_RANGE);
  more.place--;
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, &more, 1, NULL), MO_OK);
  REQUIRE(live_again(&made) == MO_OK);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.scored, 5);
  CHECK_INT(mo_store_campaign_losses(fixture.store, id, 0, &losses, &n), MO_OK);
  REQUIRE(n == 5);
  for (uint32_t i = 0; i < 4; i++) {
    CHECK_INT(losses[i].place, i);
    CHECK(memcmp(losses[i].losses, made.losses[i].losses, 8 * MO_PAPER_TEST_COUNT) == 0);
    CHECK(memcmp(losses[i].diverged_steps, made.losses[i].diverged_steps,
                 4 * MO_PAPER_TEST_COUNT) == 0);
  }
  CHECK_INT(losses[4].place, 2 * MADE_POPULATION - 1);
  free(losses);
  /* They go with the commit. */
  REQUIRE(mo_store_campaign_commit(fixture.store, id, &made.commit) == MO_OK);
  made_apply(&made);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.scored, 0);
  CHECK_INT(mo_store_campaign_losses(fixture.store, id, 0, &losses, &n), MO_OK);
  CHECK_INT(n, 0);
  free(losses);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, made.losses, 2, NULL),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 1, made.losses, 2, NULL), MO_OK);
  CHECK_INT(mo_store_campaign_losses(fixture.store, id, 1, &losses, &n), MO_OK);
  CHECK_INT(n, 2);
  free(losses);
  CHECK_INT(mo_store_campaign_losses(fixture.store, 99, 1, &losses, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(outside_integer(&fixture, "SELECT count(*) FROM campaign_losses"), 2);
  made_free(&made);
}

/* What the workers computed for a campaign of devices goes into `scores` as theirs, also after a
 * restart. */
static void names_who_computed(void)
{
  static const char sql[] = "SELECT count(*) FROM scores s JOIN conditions c ON c.id=s.condition "
                            "JOIN fingerprints f ON f.id=c.fingerprint WHERE f.text='workers'";
  struct made made = {0};
  struct mo_campaign_loss known[MADE_POPULATION], *losses = NULL;
  size_t n = 0;
  int64_t id = begin(&made, MO_ZERO_SHOT), fingerprint = made.fingerprint;
  REQUIRE(id > 0 && made_next(&made) == MO_OK);
  made.losses[2].by_workers = ~(UINT64_MAX << MO_PAPER_TEST_COUNT);
  CHECK_INT(mo_store_campaign_save_losses(fixture.store, id, 0, made.losses, 3, NULL), MO_OK);
  REQUIRE(live_again(&made) == MO_OK);
  REQUIRE(mo_store_campaign_losses(fixture.store, id, 0, &losses, &n) == MO_OK && n == 3);
  for (uint32_t i = 0; i < 3; i++) {
    CHECK(losses[i].by_workers == made.losses[i].by_workers);
    CHECK(memcmp(losses[i].diverged_steps, made.losses[i].diverged_steps,
                 4 * MO_PAPER_TEST_COUNT) == 0);
  }
  free(losses);
  CHECK_INT(mo_store_fingerprint(fixture.store, "workers", &made.commit.workers_fingerprint),
            MO_OK);
  REQUIRE(mo_store_campaign_commit(fixture.store, id, &made.commit) == MO_OK);
  CHECK_INT(outside_integer(&fixture, sql), 1);
  CHECK_INT(mo_store_campaign_known(fixture.store, id, fingerprint, made.children, MADE_POPULATION,
                                    known),
            MADE_POPULATION - 1);
  CHECK_INT(mo_store_campaign_known(fixture.store, id, made.commit.workers_fingerprint,
                                    made.children, MADE_POPULATION, known),
            1);
  CHECK_INT(known[0].place, 2);
  made_apply(&made);
  made_free(&made);
}

/* Scores of a zero-shot campaign are those of evaluations: found by both, inserted once,
 * whichever was first. */
static void shares_scores(void)
{
  struct made made = {0}, other = {0};
  struct mo_campaign_submission submission =
      campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, UNTIL);
  struct mo_campaign_loss known[MADE_POPULATION + 2];
  struct mo_bits asked[MADE_POPULATION + 2];
  struct mo_design *design = NULL;
  struct mo_design_query query = {
      .sort = MO_DESIGNS_BY_SCORE, .physics = mo_default_physics(), .fingerprint = "by hand"};
  struct mo_design_row rows[2 * MADE_POPULATION];
  struct mo_controller_record controller;
  double first_loss;
  int64_t n;
  int64_t id = begin(&made, MO_ZERO_SHOT), second, fingerprint = made.fingerprint;
  REQUIRE(id > 0 && made_next(&made) == MO_OK);
  CHECK_INT(mo_store_campaign_known(fixture.store, id, fingerprint, made.children, MADE_POPULATION,
                                    known),
            0);
  REQUIRE(mo_store_campaign_commit(fixture.store, id, &made.commit) == MO_OK);
  memcpy(asked, made.children, sizeof(*asked) * MADE_POPULATION);
  asked[MADE_POPULATION] = asked[2];
  memset(&asked[MADE_POPULATION + 1], 0, sizeof(*asked));
  asked[MADE_POPULATION + 1].words[0] = 1;
  CHECK_INT(mo_store_campaign_known(fixture.store, id, fingerprint + 1, asked, MADE_POPULATION + 2,
                                    known),
            0); /* other code */
  CHECK_INT(
      mo_store_campaign_known(fixture.store, id, fingerprint, asked, MADE_POPULATION + 2, known),
      MADE_POPULATION + 1);
  for (uint32_t i = 0; i < MADE_POPULATION + 1; i++) {
    const struct mo_campaign_loss *loss = &made.losses[i < MADE_POPULATION ? i : 2];
    CHECK_INT(known[i].place, i);
    CHECK(memcmp(known[i].losses, loss->losses, 8 * MO_PAPER_TEST_COUNT) == 0);
    CHECK(memcmp(known[i].diverged_steps, loss->diverged_steps, 4 * MO_PAPER_TEST_COUNT) == 0);
  }
  /* As the designs' own pages show them. */
  REQUIRE(mo_store_design(fixture.store, &made.forms[1], &design) == MO_OK);
  CHECK(design->n_orientations == 1 && design->orientations[0].n_scores == 1);
  CHECK_TEXT(design->orientations[0].scores[0].environment_set, "paper-test");
  CHECK_TEXT(design->orientations[0].scores[0].fingerprint, "by hand");
  CHECK(memcmp(design->orientations[0].scores[0].losses, made.losses[1].losses,
               8 * MO_PAPER_TEST_COUNT) == 0);
  CHECK(same_bits(design->orientations[0].scores[0].score, made.child_scores[1]));
  mo_design_free(design);
  REQUIRE(mo_store_controller(fixture.store, "default", &controller) == MO_OK);
  query.controller_sha256 = controller.sha256;
  snprintf(query.environment_set, sizeof(query.environment_set), "paper-test");
  CHECK_INT(mo_store_designs(fixture.store, &query, rows, 2 * MADE_POPULATION), MADE_POPULATION);
  CHECK(same_bits(rows[0].score, made_score_of(&made, made.survivors[0])));
  CHECK(isinf(rows[MADE_POPULATION - 1].score)); /* the one that diverged */
  first_loss = made.losses[1].losses[0];
  made_apply(&made);
  /* Another campaign of the same: what is stored stays, though it says otherwise. */
  second = campaign_submit(&fixture, &submission);
  REQUIRE(mo_store_run_start(fixture.store, second) == MO_OK);
  REQUIRE(made_start(&other, fixture.store, second, MO_ZERO_SHOT, MADE_POPULATION, 9) == MO_OK);
  other.state++;
  CHECK_INT(made_generation(&other), MO_OK);
  CHECK(!same_bits(other.losses[1].losses[0], first_loss));
  CHECK_INT(mo_store_campaign_known(fixture.store, second, fingerprint, other.children,
                                    MADE_POPULATION, known),
            MADE_POPULATION);
  CHECK(same_bits(known[1].losses[0], first_loss));
  CHECK_INT(mo_store_designs(fixture.store, &query, rows, 2 * MADE_POPULATION), MADE_POPULATION);
  made_free(&other);
  /* In part: what is missing is not known. */
  CHECK_INT(made_generation(&made), MO_OK);
  CHECK_INT(mo_store_campaign_known(fixture.store, id, fingerprint, made.children, MADE_POPULATION,
                                    known),
            MADE_POPULATION);
  fixture_close(&fixture);
  REQUIRE(outside(&fixture, "DELETE FROM scores WHERE genotype=(SELECT max(genotype) FROM "
                            "scores)") == SQLITE_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  n = mo_store_campaign_known(fixture.store, id, fingerprint, made.children, MADE_POPULATION,
                              known);
  CHECK_INT(n, MADE_POPULATION - 1);
  CHECK_INT(mo_store_campaign_known(fixture.store, 99, fingerprint, made.children, 1, known),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  made_free(&made);
  /* A campaign that learns has no scores to share. */
  id = begin(&other, MO_FEW_SHOT);
  REQUIRE(id > 0 && made_generation(&other) == MO_OK);
  CHECK_INT(mo_store_campaign_known(fixture.store, id, fingerprint, other.children, MADE_POPULATION,
                                    known),
            0);
  made_free(&other);
}

/* ---- checkpoints ---- */

static int files_of(int64_t id)
{
  char path[600];
  int n = 0;
  DIR *folder;
  snprintf(path, sizeof(path), "%s/campaigns/%lld", fixture.path, (long long)id);
  folder = opendir(path);
  if (folder == NULL)
    return -1;
  for (struct dirent *entry; (entry = readdir(folder)) != NULL;)
    n += entry->d_name[0] != '.';
  closedir(folder);
  return n;
}

static bool newest_is(int64_t id, uint32_t generation, uint32_t step, const char *text)
{
  uint32_t found_generation = 99, found_step = 99;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool same = fixture_campaign_checkpoint(fixture.store, id, &found_generation, &found_step, &bytes,
                                          &size) == MO_OK &&
              found_generation == generation && found_step == step && size == strlen(text) &&
              memcmp(bytes, text, size) == 0;
  free(bytes);
  return same;
}

static int put_checkpoint(int64_t id, uint32_t generation, uint32_t step, const char *text)
{
  return mo_store_campaign_checkpoint(fixture.store, id, generation, step, (const uint8_t *)text,
                                      strlen(text), NULL, 0);
}

static int commit_with(struct made *made, const char *text, uint32_t step)
{
  int error = made_next(made);
  made->commit.checkpoint = (const uint8_t *)text;
  made->commit.checkpoint_size = strlen(text);
  made->commit.checkpoint_step = step;
  if (error == MO_OK)
    error = mo_store_campaign_commit(made->store, made->id, &made->commit);
  if (error == MO_OK)
    made_apply(made);
  return error;
}

static void keeps_checkpoints(void)
{
  struct made made = {0};
  struct mo_campaign_step rows[3] = {
      {.generation = 1, .step = 1, .report = {.step = 3, .mean_loss = 0.5}},
      {.generation = 1, .step = 2, .report = {.step = 4, .mean_loss = NAN}}};
  uint32_t generation, step = 0;
  uint8_t *bytes = NULL;
  char path[600];
  FILE *file;
  size_t size = 0;
  int64_t id = begin(&made, MO_SIMULTANEOUS);
  REQUIRE(id > 0);
  CHECK_INT(fixture_campaign_checkpoint(fixture.store, id, &generation, &step, &bytes, &size),
            MO_ERR_NOT_FOUND);
  CHECK_INT(put_checkpoint(id, 1, 1, "out of turn"), MO_ERR_CONFLICT);
  CHECK_INT(files_of(id), -1); /* no folder */
  CHECK_INT(put_checkpoint(id, 0, 1, "zero one"), MO_OK);
  CHECK(newest_is(id, 0, 1, "zero one"));
  CHECK_INT(put_checkpoint(id, 0, 2, "zero two"), MO_OK);
  CHECK(newest_is(id, 0, 2, "zero two") && files_of(id) == 1);
  /* The state after a generation replaces what is inside it. */
  CHECK_INT(commit_with(&made, "after zero", 5), MO_OK);
  CHECK(newest_is(id, 0, 5, "after zero") && files_of(id) == 1);
  CHECK_INT(put_checkpoint(id, 0, 6, "too late"), MO_ERR_CONFLICT);
  /* Inside the next one, it stays. */
  CHECK_INT(
      mo_store_campaign_checkpoint(fixture.store, id, 1, 1, (const uint8_t *)"one one", 7, rows, 1),
      MO_OK);
  CHECK_INT(
      mo_store_campaign_checkpoint(fixture.store, id, 1, 2, (const uint8_t *)"one two", 7, rows, 2),
      MO_OK);
  CHECK(newest_is(id, 1, 2, "one two") && files_of(id) == 2);
  CHECK_INT(mo_store_campaign_steps(fixture.store, id, 0, 2, rows, 3), 2);
  CHECK(rows[0].report.mean_loss == 0.5 && isnan(rows[1].report.mean_loss));
  CHECK_INT(mo_store_campaign_checkpoint_of(fixture.store, id, 0, &step, &bytes, &size), MO_OK);
  CHECK(step == 5 && size == 10 && memcmp(bytes, "after zero", 10) == 0);
  free(bytes);
  CHECK_INT(mo_store_campaign_checkpoint_of(fixture.store, id, 2, &step, &bytes, &size),
            MO_ERR_NOT_FOUND);
  /* Of an earlier run that came further, or whose bytes were others. */
  CHECK_INT(put_checkpoint(id, 1, 1, "again one"), MO_OK);
  CHECK(newest_is(id, 1, 1, "again one") && files_of(id) == 2);
  CHECK_INT(put_checkpoint(id, 1, 1, "another one"), MO_OK);
  CHECK(newest_is(id, 1, 1, "another one") && files_of(id) == 2);
  /* What a process that dies leaves without a row goes at the next start; what is not ours stays.
   */
  snprintf(path, sizeof(path), "%s/campaigns/%lld/1-7.checkpoint", fixture.path, (long long)id);
  file = fopen(path, "w");
  REQUIRE(file != NULL && fclose(file) == 0);
  snprintf(path, sizeof(path), "%s/campaigns/%lld/.tmp-3", fixture.path, (long long)id);
  file = fopen(path, "w");
  REQUIRE(file != NULL && fclose(file) == 0);
  snprintf(path, sizeof(path), "%s/campaigns/%lld/1-x.checkpoint", fixture.path, (long long)id);
  file = fopen(path, "w");
  REQUIRE(file != NULL && fclose(file) == 0);
  snprintf(path, sizeof(path), "%s/campaigns/77", fixture.path);
  REQUIRE(mkdir(path, 0700) == 0);
  CHECK_INT(files_of(id), 4);
  REQUIRE(live_again(&made) == MO_OK);
  CHECK_INT(files_of(id), 3);
  CHECK(access(path, F_OK) == 0);
  CHECK(newest_is(id, 1, 1, "another one"));
  CHECK_INT(mo_store_orphans(fixture.store)->n, 1);
  CHECK(strstr(mo_store_orphans(fixture.store)->first, "/1-x.checkpoint") != NULL);
  /* The checkpoint at the end of the learning is that of the commit, too. */
  CHECK_INT(put_checkpoint(id, 1, 5, "after one"), MO_OK);
  CHECK_INT(commit_with(&made, "after one", 5), MO_OK);
  CHECK(newest_is(id, 1, 5, "after one"));
  CHECK_INT(files_of(id), 2); /* and the one that is not ours */
  /* Without one, what is older than the generation goes. */
  REQUIRE(made_generation(&made) == MO_OK);
  CHECK_INT(fixture_campaign_checkpoint(fixture.store, id, &generation, &step, &bytes, &size),
            MO_ERR_NOT_FOUND);
  CHECK_INT(files_of(id), 1);
  /* Damage is found. */
  CHECK_INT(put_checkpoint(id, 3, 1, "three one"), MO_OK);
  snprintf(path, sizeof(path), "%s/campaigns/%lld/3-1.checkpoint", fixture.path, (long long)id);
  file = fopen(path, "w");
  REQUIRE(file != NULL && fputs("three ONE", file) >= 0 && fclose(file) == 0);
  CHECK_INT(fixture_campaign_checkpoint(fixture.store, id, &generation, &step, &bytes, &size),
            MO_ERR_CORRUPT);
  REQUIRE(unlink(path) == 0);
  CHECK_INT(fixture_campaign_checkpoint(fixture.store, id, &generation, &step, &bytes, &size),
            MO_ERR_CORRUPT);
  CHECK_INT(put_checkpoint(id, 3, 1, "three one"), MO_OK);
  CHECK(newest_is(id, 3, 1, "three one"));
  made_free(&made);
}

static void removes_checkpoints(void)
{
  struct made made = {0};
  struct mo_checkpoint_row rows[3];
  struct mo_checkpoints_removed removed = {.n = 9};
  enum mo_job_state before;
  int64_t id = begin(&made, MO_SIMULTANEOUS);
  REQUIRE(id > 0);
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 3), 0);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before),
            MO_OK); /* it has learned nothing yet */
  REQUIRE(commit_with(&made, "after zero", 5) == MO_OK);
  REQUIRE(put_checkpoint(id, 1, 1, "one one") == MO_OK);
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 3), 2);
  CHECK(rows[0].generation == 1 && rows[0].step == 1 && rows[0].size == 7 && rows[0].stored_us > 0);
  CHECK(rows[1].generation == 0 && rows[1].step == 5 && rows[1].size == 10);
  /* It goes on from both, also when it is paused. */
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id + 1, MO_JOB_CAMPAIGN, 0, &removed),
            MO_ERR_NOT_FOUND);
  CHECK_INT(removed.n, 9);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_CAMPAIGN, 0, &removed), MO_OK);
  CHECK(removed.n == 0 && removed.bytes == 0 && files_of(id) == 2);
  REQUIRE(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL) == MO_OK);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_CAMPAIGN, 0, &removed), MO_OK);
  CHECK(removed.n == 0 && files_of(id) == 2);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_OK);
  REQUIRE(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL) == MO_OK);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_CAMPAIGN, 0, &removed), MO_OK);
  CHECK(removed.n == 2 && removed.places[0].generation == 1 && removed.places[1].step == 5 &&
        removed.bytes == 17);
  CHECK_INT(files_of(id), -1); /* no folder */
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 3), 0);
  /* A run that learns late of its end leaves nothing. */
  CHECK_INT(put_checkpoint(id, 1, 2, "late"), MO_ERR_CONFLICT);
  CHECK_INT(files_of(id), -1);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  made_free(&made);
}

static const struct check_case cases[] = {
    {"commits in every mode", commits_in_every_mode},
    {"refuses what is wrong", refuses_what_is_wrong},
    {"keeps losses of a generation", keeps_losses_of_a_generation},
    {"names who computed a score", names_who_computed},
    {"shares scores", shares_scores},
    {"keeps checkpoints", keeps_checkpoints},
    {"removes checkpoints", removes_checkpoints},
};
CHECK_MAIN_AROUND(cases, with_a_store)
