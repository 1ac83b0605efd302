/* campaign_runs.c: writes by a campaign's runner: whole generations, and losses and checkpoints in
 * between. */
#include <sys/stat.h>

#include "by_hand.h"
#include "campaign_fixture.h"
#include "one_store.h"
#include "store/check.h"
#include "store/deletion.h"
#include "store/scores.h"

#define UNTIL 5 /* generations after the first */

/* Starts a campaign of this mode and returns the state of its runner. */
static struct made begin(int mode)
{
  const struct mo_campaign_request submission =
      campaign_submission((enum mo_campaign_mode)mode, MADE_POPULATION, UNTIL);
  const int64_t id = submit_campaign(&submission);
  make_check(mo_store_run_start(store, id), "a campaign");
  return made_start(id, (enum mo_campaign_mode)mode, 9);
}

/* Restarts the process and the campaign. */
static int restart_run(struct made *made)
{
  int error = reopen();
  if (error == MO_OK)
    error = mo_store_requeue(store, 0, 3, "");
  return error == MO_OK ? mo_store_run_start(store, made->id) : error;
}

static struct mo_campaign_loss known[MADE_POPULATION + 2];

/* Writes to `known` the bodies that already have scores, and returns how many there are. */
static int64_t known_of(int64_t id, int64_t fingerprint, const struct mo_bits *bits, uint32_t n)
{
  return mo_store_campaign_known(store, id, fingerprint, 0, bits, n, known);
}

/* Returns the losses saved for a generation. */
static struct mo_campaign_loss *losses_of(int64_t id, uint32_t generation, size_t *n)
{
  struct mo_campaign_loss *losses = NULL;
  CHECK_OK(mo_store_campaign_losses(store, id, generation, &losses, n));
  return check_keep(losses, free);
}

static bool same_losses(const struct mo_campaign_loss *a, const struct mo_campaign_loss *b)
{
  return SAME(a->losses, b->losses, MO_PAPER_TEST_COUNT) &&
         SAME(a->diverged_steps, b->diverged_steps, MO_PAPER_TEST_COUNT);
}

static void commits_generations(int mode)
{
  struct mo_campaign_generation rows[UNTIL + 2];
  struct mo_campaign_step steps[2 * UNTIL + 3];
  struct made made = begin(mode);
  const int64_t id = made.id;
  CHECK_INT(mo_store_run_start(store, id), MO_ERR_CONFLICT);
  REQUIRE_OK(made_generation(&made));
  CHECK(made_is_stored(&made));
  for (int g = 1; g <= UNTIL; g++)
    REQUIRE_OK(made_generation(&made));
  CHECK(made_is_stored(&made));
  CHECK_TEXT(last_event(id).type, "campaign.generation");
  CHECK_TEXT(last_event(id).data, "{\"made\":true}");
  REQUIRE_OK(reopen());
  CHECK(made_is_stored(&made));
  struct mo_campaign_status status = status_of(id);
  CHECK_INT(status.generation, UNTIL);
  CHECK_INT(status.job.steps_done, UNTIL);
  CHECK_INT(status.n_designs, (UNTIL + 1) * MADE_POPULATION);
  CHECK(same_bits(status.best_score, made.scores[0]));
  CHECK_INT(mo_store_campaign_generations(store, id, -1, 1, rows, UNTIL + 2), UNTIL + 1);
  struct mo_campaign_generation last = made.commit.row;
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
  CHECK_INT(mo_store_campaign_generations(store, id, 2, 1, rows, 2), 2);
  CHECK(rows[0].generation == 3 && rows[1].generation == 4);
  CHECK_INT(mo_store_campaign_generations(store, id, UNTIL, 1, rows, 2), 0);
  CHECK_INT(mo_store_campaign_generations(store, id, 0, 1, rows, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
  CHECK_INT(mo_store_campaign_steps(store, id, -1, 0, steps, 2 * UNTIL + 3),
            mode == MO_ZERO_SHOT ? 0 : 2 * UNTIL + 2);
  if (mode != MO_ZERO_SHOT) {
    CHECK(memcmp(&steps[2 * UNTIL + 1].report.mean_loss, &made.steps[1].report.mean_loss, 8) == 0);
    CHECK_INT(mo_store_campaign_steps(store, id, 1, 1, steps, 2), 2);
    CHECK(steps[0].generation == 1 && steps[0].step == 2 && steps[0].on_children &&
          steps[0].report.step == 4);
    CHECK(steps[0].report.diverged == 1 && steps[1].generation == 2 && steps[1].step == 1 &&
          !steps[1].on_children);
  }
  CHECK_OK(check_whole());
}

/* A commit that comes at the wrong time changes nothing. */
static void refuses_what_is_wrong(void)
{
  struct mo_campaign_commit commit;
  struct made made = begin(MO_ZERO_SHOT);
  const int64_t id = made.id;
  REQUIRE_OK(made_generation(&made));
  made_next(&made);
  struct mo_event before = last_event(id);
  for (uint32_t generation = 0; generation <= 2; generation += 2) {
    commit = made.commit;
    commit.row.generation = generation;
    CHECK_INT(mo_store_campaign_commit(store, id, &commit), MO_ERR_CONFLICT);
    CHECK(made_is_stored(&made));
  }
  CHECK_INT(last_event(id).sequence, before.sequence);
  CHECK_INT(mo_store_campaign_commit(store, id + 1, &made.commit), MO_ERR_CONFLICT);
  /* While the campaign is paused, its thread can still commit. After a cancellation or a restart of
   * the process, it cannot. */
  CHECK_OK(change(id, MO_CHANGE_PAUSE));
  CHECK_OK(made_commit(&made));
  CHECK(made_is_stored(&made));
  CHECK_INT(state_of(id), MO_JOB_PAUSED);
  made_next(&made);
  REQUIRE_OK(reopen());
  CHECK_INT(mo_store_campaign_commit(store, id, &made.commit), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(store, id, 2, made.losses, 1, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_checkpoint(store, id, 2, 1, (const uint8_t *)"x", 1, NULL, 0),
            MO_ERR_CONFLICT);
  CHECK_OK(change(id, MO_CHANGE_RESUME));
  CHECK_INT(mo_store_campaign_commit(store, id, &made.commit), MO_ERR_CONFLICT);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_INT(mo_store_campaign_commit(store, id, &made.commit), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_save_losses(store, id, 2, made.losses, 1, NULL), MO_ERR_CONFLICT);
  CHECK(made_is_stored(&made));
  CHECK_OK(check_whole());
}

static void keeps_losses_of_a_generation(void)
{
  struct mo_campaign_loss *losses = NULL, more;
  size_t n = 9;
  struct made made = begin(MO_FEW_SHOT);
  const int64_t id = made.id;
  made_next(&made);
  (void)losses_of(id, 0, &n);
  CHECK_INT(n, 0);
  CHECK_INT(mo_store_campaign_save_losses(store, id, 1, made.losses, 2, NULL), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, made.losses + 2, 2, NULL));
  CHECK_TEXT(last_event(id).type, "job.started");
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, made.losses, 3, "{\"saved\":3}"));
  CHECK_TEXT(last_event(id).type, "campaign.progress");
  more = made.losses[0];
  more.place = 2 * MADE_POPULATION - 1;
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, &more, 1, NULL));
  REQUIRE_OK(restart_run(&made));
  CHECK_INT(status_of(id).scored, 5);
  losses = losses_of(id, 0, &n);
  REQUIRE(n == 5);
  for (uint32_t i = 0; i < 4; i++) {
    CHECK_INT(losses[i].place, i);
    CHECK(same_losses(&losses[i], &made.losses[i]));
  }
  CHECK_INT(losses[4].place, 2 * MADE_POPULATION - 1);
  /* The commit removes them. */
  REQUIRE_OK(made_commit(&made));
  CHECK_INT(status_of(id).scored, 0);
  (void)losses_of(id, 0, &n);
  CHECK_INT(n, 0);
  CHECK_INT(mo_store_campaign_save_losses(store, id, 0, made.losses, 2, NULL), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_campaign_save_losses(store, id, 1, made.losses, 2, NULL));
  (void)losses_of(id, 1, &n);
  CHECK_INT(n, 2);
  CHECK_INT(mo_store_campaign_losses(store, 99, 1, &losses, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(outside_integer("SELECT count(*) FROM campaign_losses"), 2);
}

static double measured[MADE_POPULATION][MO_PAPER_TEST_COUNT][MO_MEASURES];

/* Gives all losses measures; some have no value. */
static void measure(struct made *made)
{
  for (uint32_t i = 0; i < MADE_POPULATION; i++) {
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
      for (unsigned m = 0; m < MO_MEASURES; m++)
        measured[i][k][m] = made->losses[i].diverged_steps[k] > 0 || (i + k + m) % 9 == 4
                                ? (double)NAN
                                : (i + 3.0 * k + 7 * m) / mo_measure_info[m].steps_in_one;
    made->losses[i].measures = measured[i];
  }
}

static bool same_measures(double (*a)[MO_MEASURES], double (*b)[MO_MEASURES])
{
  bool same = a != NULL && b != NULL;
  for (uint32_t k = 0; same && k < MO_PAPER_TEST_COUNT; k++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      same = same && (isnan(a[k][m]) ? isnan(b[k][m]) : mo_same_bits(a[k][m], b[k][m]));
  return same;
}

static void report(void *context, const char *finding)
{
  (void)context;
  CHECK(strstr(finding, "losses of a generation are damaged") != NULL);
}

/* Returns how many findings the check of all rows has. */
static uint64_t findings(void)
{
  struct mo_check_counts counts;
  CHECK_OK(mo_store_check_contents(store, report, NULL, &counts));
  return counts.findings;
}

/* Measures are saved with the losses of a generation, and stored with its scores; the designs have
 * the means. */
static void keeps_measures(void)
{
  static double found[MADE_POPULATION][MO_PAPER_TEST_COUNT][MO_MEASURES];
  double means[MADE_POPULATION][2];
  struct mo_campaign_design designs[MADE_POPULATION];
  struct mo_campaign_status status;
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, UNTIL);
  submission.record.measures = 1U << MO_MEASURE_WORK | 1U << MO_MEASURE_TILT;
  const int64_t id = submit_campaign(&submission);
  make_check(mo_store_run_start(store, id), "a campaign");
  struct made made = made_start(id, MO_ZERO_SHOT, 9);
  size_t n = 0;
  made_next(&made);
  measure(&made);
  made.losses[1].origins[2] = store->origin; /* the checksum covers who computed a loss */
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, made.losses, 5, NULL));
  REQUIRE_OK(restart_run(&made));
  CHECK_INT(findings(), 0);
  const struct mo_campaign_loss *losses = losses_of(id, 0, &n);
  REQUIRE(n == 5);
  for (uint32_t i = 0; i < 5; i++)
    CHECK(same_losses(&losses[i], &made.losses[i]) &&
          same_measures(losses[i].measures, made.losses[i].measures));
  for (uint32_t i = 0; i < MADE_POPULATION; i++)
    (void)mo_measures_mean(submission.record.measures,
                           (const double(*)[MO_MEASURES])made.losses[i].measures,
                           MO_PAPER_TEST_COUNT, means[i]);
  made.commit.measures = means[0];
  made.commit.n_measures = 2;
  REQUIRE_OK(made_commit(&made));
  CHECK_OK(mo_store_campaign(store, id, &status));
  CHECK_INT(status.words.n_measures, 2);
  CHECK_TEXT(status.words.measures[0], "tilt_rad");
  CHECK_TEXT(status.words.measures[1], "work_j");
  CHECK_INT(mo_store_campaign_designs(store, id, -1, designs, MADE_POPULATION), MADE_POPULATION);
  for (uint32_t i = 0; i < MADE_POPULATION; i++) {
    CHECK_INT(designs[i].n_measures, 2);
    CHECK(memcmp(designs[i].measures, means[i], sizeof(means[i])) == 0 || isnan(means[i][0]) ||
          isnan(means[i][1]));
  }
  /* Scores without measures count only where none are requested. */
  for (int measures = 1; measures >= 0; measures--) {
    for (uint32_t i = 0; i < MADE_POPULATION; i++)
      known[i].measures = found[i];
    CHECK_INT(known_of(id, made.fingerprint, made.children, MADE_POPULATION),
              measures ? MADE_POPULATION : 0);
    for (uint32_t i = 0; i < MADE_POPULATION && measures; i++)
      CHECK(same_losses(&known[i], &made.losses[i]) && same_measures(found[i], measured[i]));
    for (uint32_t i = 0; i < MADE_POPULATION; i++)
      known[i].measures = NULL;
    CHECK_INT(known_of(id, made.fingerprint, made.children, MADE_POPULATION), MADE_POPULATION);
    REQUIRE_OK(reopen_after("DELETE FROM measures"));
  }
}

/* A changed bit of saved measures is noticed. */
static void refuses_damaged_measures(void)
{
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, UNTIL);
  struct mo_campaign_loss *losses = NULL;
  size_t n = 0;
  submission.record.measures = 1U << MO_MEASURE_WORK;
  const int64_t id = submit_campaign(&submission);
  make_check(mo_store_run_start(store, id), "a campaign");
  struct made made = made_start(id, MO_ZERO_SHOT, 9);
  made_next(&made);
  measure(&made);
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, made.losses, 1, NULL));
  REQUIRE_OK(reopen_after("UPDATE campaign_losses SET measures=cast(substr(measures,1,9) || x'55'"
                          " || substr(measures,11) AS BLOB)"));
  CHECK_INT(mo_store_campaign_losses(store, id, 0, &losses, &n), MO_ERR_CORRUPT);
  CHECK_INT(findings(), 1);
}

/* On a campaign for devices, losses computed by the workers are stored in `scores` under the
 * workers' fingerprint, even after a restart. */
static void names_who_computed(void)
{
  static const char sql[] = "SELECT count(*) FROM scores s JOIN conditions c ON c.id=s.condition "
                            "JOIN fingerprints f ON f.id=c.fingerprint WHERE f.text='workers'";
  struct mo_campaign_loss *losses = NULL;
  size_t n = 0;
  struct made made = begin(MO_ZERO_SHOT);
  const int64_t id = made.id, fingerprint = made.fingerprint;
  made_next(&made);
  made.losses[2].by_workers = ~(UINT64_MAX << MO_PAPER_TEST_COUNT);
  CHECK_OK(mo_store_campaign_save_losses(store, id, 0, made.losses, 3, NULL));
  REQUIRE_OK(restart_run(&made));
  losses = losses_of(id, 0, &n);
  REQUIRE(n == 3);
  for (uint32_t i = 0; i < 3; i++) {
    CHECK(losses[i].by_workers == made.losses[i].by_workers);
    CHECK(memcmp(losses[i].diverged_steps, made.losses[i].diverged_steps,
                 4 * MO_PAPER_TEST_COUNT) == 0);
  }
  CHECK_OK(mo_store_fingerprint(store, "workers", &made.commit.workers_fingerprint));
  REQUIRE_OK(mo_store_campaign_commit(store, id, &made.commit));
  CHECK_INT(outside_integer(sql), 1);
  CHECK_INT(known_of(id, fingerprint, made.children, MADE_POPULATION), MADE_POPULATION - 1);
  CHECK_INT(known_of(id, made.commit.workers_fingerprint, made.children, MADE_POPULATION), 1);
  CHECK_INT(known[0].place, 2);
  CHECK_INT(mo_store_campaign_known(store, id, fingerprint, made.commit.workers_fingerprint,
                                    made.children, MADE_POPULATION, known),
            MADE_POPULATION);
  for (uint32_t i = 0; i < MADE_POPULATION; i++)
    CHECK(same_losses(&known[i], &made.losses[i]));
  made_apply(&made);
}

/* The results of re-evaluated generations: each design has the newest, a population none that is
 * newer. */
static void keeps_re_evaluations(void)
{
  struct made made = begin(MO_ZERO_SHOT);
  struct mo_campaign_design rows[2];
  struct mo_re_evaluated found[MO_ELITE_MAX];
  struct mo_campaign_generation row;
  uint32_t n = 0;
  REQUIRE_OK(made_generation(&made));
  for (uint32_t generation = 1; generation <= 2; generation++) {
    made_next(&made);
    const uint32_t place = made.commit.survivors[0], n_parents = made.commit.n_parents;
    const uint32_t best = place < n_parents
                              ? made.numbers[place]
                              : (uint32_t)made.commit.row.born_before + place - n_parents;
    const struct mo_re_evaluated results[2] = {
        {best, generation, 64, 0, 0.1 / 3 + generation, 0.01 / 7},
        {best + 1000, generation, 64, 2, NAN, NAN}};
    made.commit.held_out = results;
    made.commit.n_held_out = 2;
    made.commit.row.held_out =
        (struct mo_held_out_summary){2, 64, 128, 2, results[0], {0.5, 1.5}, 0.25, (double)NAN};
    REQUIRE_OK(made_commit(&made));
    CHECK_INT(mo_store_campaign_held_out(store, made.id, generation, found), 2);
    CHECK(found[0].mean == results[0].mean && found[0].number == best && found[0].worlds == 64);
    CHECK(found[0].standard_error == results[0].standard_error && found[0].diverged == 0);
    CHECK(isnan(found[1].mean) && isnan(found[1].standard_error) && found[1].diverged == 2);
    CHECK_INT(mo_store_campaign_population(store, made.id, -1, 0, rows, 1, &n), 1);
    CHECK(rows[0].number == best && rows[0].held_out.generation == generation);
    CHECK(rows[0].held_out.mean == results[0].mean);
    CHECK_INT(mo_store_campaign_generations(store, made.id, generation - 1, 1, &row, 1), 1);
    CHECK(row.held_out.designs == 2 && row.held_out.champion.mean == results[0].mean);
    CHECK(row.held_out.champion_interval.hi == 1.5 && isnan(row.held_out.top_score));
    CHECK_INT(mo_store_campaign_population(store, made.id, 0, 0, rows, 2, &n), 2);
    CHECK(rows[0].held_out.worlds == 0 && rows[1].held_out.worlds == 0);
  }
  CHECK_INT(mo_store_campaign_held_out(store, made.id, 0, found), 0);
  REQUIRE_OK(mo_store_change_job(store, made.id, MO_CHANGE_CANCEL, NULL));
  CHECK_INT(park(made.id, MO_OK), MO_JOB_CANCELLED);
  struct mo_deleted deleted;
  struct mo_message message;
  CHECK_OK(mo_store_delete_job(store, made.id, &deleted, &message));
  close_store();
  CHECK_INT(outside_integer("SELECT count(*) FROM campaign_held_out"), 0);
  REQUIRE_OK(reopen());
}

/* Means over the best that have both; the champion is the first. */
static void sums_up_re_evaluations(void)
{
  const struct mo_re_evaluation settings = {.every = 1, .environments = 4, .designs = 3};
  const struct mo_re_evaluated rows[4] = {
      {9, 1, 4, 0, 0.5, 0.1}, {5, 1, 4, 2, NAN, NAN}, {7, 1, 4, 0, 0.25, 0.5}, {8, 1, 4, 0, 8, 1}};
  const uint32_t numbers[4] = {7, 5, 9, 8};
  const double scores[4] = {0.125, 0.25, 0.5, 1};
  struct mo_held_out_summary sum = mo_held_out_summary(&settings, rows, 4, numbers, scores, 4);
  CHECK(sum.designs == 4 && sum.worlds == 4 && sum.rollouts == 16 && sum.diverged == 2);
  CHECK(sum.champion.mean == 0.25 && sum.champion.standard_error == 0.5);
  CHECK_NEAR(sum.champion_interval.hi - 0.25, 3.182446 * 0.5, 1e-5);
  CHECK(sum.top_mean == 0.375 && sum.top_score == 0.3125);
  sum = mo_held_out_summary(&settings, rows + 1, 1, numbers, scores, 4);
  CHECK(isnan(sum.champion.mean) && isnan(sum.champion_interval.lo) && isnan(sum.top_mean));
  sum = mo_held_out_summary(&settings, NULL, 0, numbers, scores, 4);
  CHECK(sum.designs == 0 && sum.worlds == 0 && isnan(sum.champion.mean));
}

/* A zero-shot campaign shares scores with evaluations: both find them, and the first to save
 * inserts them. */
static void shares_scores(void)
{
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, UNTIL);
  struct mo_bits asked[MADE_POPULATION + 2];
  struct mo_design *design = NULL;
  struct mo_design_query query = {
      .sort = MO_DESIGNS_BY_SCORE, .physics = mo_paper_physics(), .fingerprint = "by hand"};
  struct mo_design_row rows[2 * MADE_POPULATION];
  struct mo_controller_record controller;
  struct made made = begin(MO_ZERO_SHOT);
  const int64_t id = made.id, fingerprint = made.fingerprint;
  made_next(&made);
  CHECK_INT(known_of(id, fingerprint, made.children, MADE_POPULATION), 0);
  REQUIRE_OK(mo_store_campaign_commit(store, id, &made.commit));
  memcpy(asked, made.children, sizeof(*asked) * MADE_POPULATION);
  asked[MADE_POPULATION] = asked[2];
  memset(&asked[MADE_POPULATION + 1], 0, sizeof(*asked));
  asked[MADE_POPULATION + 1].words[0] = 1;
  CHECK_INT(known_of(id, fingerprint + 1, asked, MADE_POPULATION + 2), 0); /* other code */
  CHECK_INT(known_of(id, fingerprint, asked, MADE_POPULATION + 2), MADE_POPULATION + 1);
  for (uint32_t i = 0; i < MADE_POPULATION + 1; i++) {
    const struct mo_campaign_loss *loss = &made.losses[i < MADE_POPULATION ? i : 2];
    CHECK_INT(known[i].place, i);
    CHECK(same_losses(&known[i], loss));
  }
  /* As the designs' own pages show them. */
  const struct mo_genotype form = mo_genotype_of(MO_DEFAULT_WORKSPACE, &made.forms[1]);
  REQUIRE_OK(mo_store_design(store, &form, &design));
  CHECK(design->n_orientations == 1 && design->orientations[0].n_scores == 1);
  CHECK_TEXT(design->orientations[0].scores[0].environment_set, "paper-test");
  CHECK_TEXT(design->orientations[0].scores[0].fingerprint, "by hand");
  CHECK(memcmp(design->orientations[0].scores[0].losses, made.losses[1].losses,
               8 * MO_PAPER_TEST_COUNT) == 0);
  mo_design_free(design);
  REQUIRE_OK(mo_store_controller(store, "default", &controller));
  query.controller_sha256 = controller.sha256;
  snprintf(query.environment_set, sizeof(query.environment_set), "paper-test");
  CHECK_INT(mo_store_designs(store, &query, rows, 2 * MADE_POPULATION), MADE_POPULATION);
  CHECK(same_bits(rows[0].score, made_score_of(&made, made.survivors[0])));
  CHECK(isinf(rows[MADE_POPULATION - 1].score)); /* the design that diverged */
  double first_loss = made.losses[1].losses[0];
  made_apply(&made);
  /* Another campaign with the same bodies: stored scores stay, even though its losses differ. */
  const int64_t second = submit_campaign(&submission);
  REQUIRE_OK(mo_store_run_start(store, second));
  struct made other = made_start(second, MO_ZERO_SHOT, 9);
  other.state++;
  CHECK_OK(made_generation(&other));
  CHECK(!same_bits(other.losses[1].losses[0], first_loss));
  CHECK_INT(known_of(second, fingerprint, other.children, MADE_POPULATION), MADE_POPULATION);
  CHECK(same_bits(known[1].losses[0], first_loss));
  CHECK_INT(mo_store_designs(store, &query, rows, 2 * MADE_POPULATION), MADE_POPULATION);
  /* If a score is missing, the others are still found. */
  CHECK_OK(made_generation(&made));
  CHECK_INT(known_of(id, fingerprint, made.children, MADE_POPULATION), MADE_POPULATION);
  close_store();
  REQUIRE(outside("DELETE FROM scores WHERE genotype=(SELECT max(genotype) FROM "
                  "scores)") == SQLITE_OK);
  REQUIRE_OK(reopen());
  CHECK_INT(known_of(id, fingerprint, made.children, MADE_POPULATION), MADE_POPULATION - 1);
  CHECK_INT(known_of(99, fingerprint, made.children, 1), MO_ERR_NOT_FOUND);
  CHECK_OK(check_whole());
  /* A campaign that learns has no scores to share. */
  other = begin(MO_FEW_SHOT);
  REQUIRE_OK(made_generation(&other));
  CHECK_INT(known_of(other.id, fingerprint, other.children, MADE_POPULATION), 0);
}

/* ---- checkpoints ---- */

static bool newest_is(int64_t id, uint32_t generation, uint32_t step, const char *text)
{
  uint32_t found_generation = 99, found_step = 99;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool same =
      newest_checkpoint(store, id, &found_generation, &found_step, &bytes, &size) == MO_OK &&
      found_generation == generation && found_step == step && size == strlen(text) &&
      memcmp(bytes, text, size) == 0;
  free(bytes);
  return same;
}

static int put_checkpoint(int64_t id, uint32_t generation, uint32_t step, const char *text)
{
  return mo_store_campaign_checkpoint(store, id, generation, step, (const uint8_t *)text,
                                      strlen(text), NULL, 0);
}

static int commit_with(struct made *made, const char *text, uint32_t step)
{
  made_next(made);
  made->commit.checkpoint = (const uint8_t *)text;
  made->commit.checkpoint_size = strlen(text);
  made->commit.checkpoint_step = step;
  return made_commit(made);
}

static void keeps_checkpoints(void)
{
  struct mo_campaign_step rows[3] = {
      {.generation = 1, .step = 1, .report = {.step = 3, .mean_loss = 0.5}},
      {.generation = 1, .step = 2, .report = {.step = 4, .mean_loss = NAN}}};
  uint32_t generation, step = 0;
  uint8_t *bytes = NULL;
  size_t size = 0;
  struct made made = begin(MO_SIMULTANEOUS);
  const int64_t id = made.id;
  CHECK_INT(newest_checkpoint(store, id, &generation, &step, &bytes, &size), MO_ERR_NOT_FOUND);
  CHECK_INT(put_checkpoint(id, 1, 1, "out of turn"), MO_ERR_CONFLICT);
  CHECK_INT(files_of("campaigns", id), -1); /* no folder yet */
  CHECK_OK(put_checkpoint(id, 0, 1, "zero one"));
  CHECK(newest_is(id, 0, 1, "zero one"));
  CHECK_OK(put_checkpoint(id, 0, 2, "zero two"));
  CHECK(newest_is(id, 0, 2, "zero two") && files_of("campaigns", id) == 1);
  /* The state after a generation replaces the checkpoints inside the generation. */
  CHECK_OK(commit_with(&made, "after zero", 5));
  CHECK(newest_is(id, 0, 5, "after zero") && files_of("campaigns", id) == 1);
  CHECK_INT(put_checkpoint(id, 0, 6, "too late"), MO_ERR_CONFLICT);
  /* It stays when the next generation stores checkpoints. */
  CHECK_OK(mo_store_campaign_checkpoint(store, id, 1, 1, (const uint8_t *)"one one", 7, rows, 1));
  CHECK_OK(mo_store_campaign_checkpoint(store, id, 1, 2, (const uint8_t *)"one two", 7, rows, 2));
  CHECK(newest_is(id, 1, 2, "one two") && files_of("campaigns", id) == 2);
  CHECK_INT(mo_store_campaign_steps(store, id, 0, 2, rows, 3), 2);
  CHECK(rows[0].report.mean_loss == 0.5 && isnan(rows[1].report.mean_loss));
  CHECK_OK(mo_store_campaign_checkpoint_of(store, id, 0, &step, &bytes, &size));
  CHECK(step == 5 && size == 10 && memcmp(bytes, "after zero", 10) == 0);
  free(bytes);
  CHECK_INT(mo_store_campaign_checkpoint_of(store, id, 2, &step, &bytes, &size), MO_ERR_NOT_FOUND);
  /* A repeated step replaces the checkpoint of an earlier run that got further or wrote other
   * bytes. */
  CHECK_OK(put_checkpoint(id, 1, 1, "again one"));
  CHECK(newest_is(id, 1, 1, "again one") && files_of("campaigns", id) == 2);
  CHECK_OK(put_checkpoint(id, 1, 1, "another one"));
  CHECK(newest_is(id, 1, 1, "another one") && files_of("campaigns", id) == 2);
  /* The next start removes files that a crash left without a row. Foreign files stay. */
  const long long folder = id;
  REQUIRE_OK(put_file(path_of("campaigns/%lld/1-7.checkpoint", folder), ""));
  REQUIRE_OK(put_file(path_of("campaigns/%lld/.tmp-3", folder), ""));
  REQUIRE_OK(put_file(path_of("campaigns/%lld/1-x.checkpoint", folder), ""));
  REQUIRE(mkdir(path_of("campaigns/77"), 0700) == 0);
  CHECK_INT(files_of("campaigns", id), 5);
  REQUIRE_OK(restart_run(&made));
  CHECK_INT(files_of("campaigns", id), 3);
  CHECK_INT(files_of("campaigns", 77), 0);
  CHECK(newest_is(id, 1, 1, "another one"));
  CHECK_INT(mo_store_orphans(store)->n, 1);
  CHECK_HAS(mo_store_orphans(store)->first, "/1-x.checkpoint");
  /* The checkpoint at the end of learning is also the checkpoint of the commit. */
  CHECK_OK(put_checkpoint(id, 1, 5, "after one"));
  CHECK_OK(commit_with(&made, "after one", 5));
  CHECK(newest_is(id, 1, 5, "after one"));
  CHECK_INT(files_of("campaigns", id), 2); /* and the foreign file */
  /* A commit without a checkpoint removes the older checkpoints. */
  REQUIRE_OK(made_generation(&made));
  CHECK_INT(newest_checkpoint(store, id, &generation, &step, &bytes, &size), MO_ERR_NOT_FOUND);
  CHECK_INT(files_of("campaigns", id), 1);
  /* Damage is detected. */
  CHECK_OK(put_checkpoint(id, 3, 1, "three one"));
  REQUIRE_OK(put_file(path_of("campaigns/%lld/3-1.checkpoint", folder), "three ONE"));
  CHECK_INT(newest_checkpoint(store, id, &generation, &step, &bytes, &size), MO_ERR_CORRUPT);
  REQUIRE(unlink(path_of("campaigns/%lld/3-1.checkpoint", folder)) == 0);
  CHECK_INT(newest_checkpoint(store, id, &generation, &step, &bytes, &size), MO_ERR_CORRUPT);
  CHECK_OK(put_checkpoint(id, 3, 1, "three one"));
  CHECK(newest_is(id, 3, 1, "three one"));
}

static void removes_checkpoints(void)
{
  struct mo_checkpoint_row rows[3];
  struct mo_checkpoints_removed removed = {.n = 9};
  enum mo_job_state before;
  struct made made = begin(MO_SIMULTANEOUS);
  const int64_t id = made.id;
  CHECK_INT(mo_store_checkpoints(store, id, rows, 3), 0);
  CHECK_OK(mo_store_extend_campaign(store, id, 1, NULL, &before)); /* nothing learned yet */
  REQUIRE_OK(commit_with(&made, "after zero", 5));
  REQUIRE_OK(put_checkpoint(id, 1, 1, "one one"));
  CHECK_INT(mo_store_checkpoints(store, id, rows, 3), 2);
  CHECK(rows[0].generation == 1 && rows[0].step == 1 && rows[0].size == 7 && rows[0].stored_us > 0);
  CHECK(rows[1].generation == 0 && rows[1].step == 5 && rows[1].size == 10);
  /* The campaign needs both to continue, even while it is paused. */
  CHECK_INT(mo_store_checkpoints_remove(store, id + 1, MO_JOB_CAMPAIGN, 0, &removed),
            MO_ERR_NOT_FOUND);
  CHECK_INT(removed.n, 9);
  CHECK_OK(mo_store_checkpoints_remove(store, id, MO_JOB_CAMPAIGN, 0, &removed));
  CHECK(removed.n == 0 && removed.bytes == 0 && files_of("campaigns", id) == 2);
  REQUIRE_OK(change(id, MO_CHANGE_PAUSE));
  CHECK_OK(mo_store_checkpoints_remove(store, id, MO_JOB_CAMPAIGN, 0, &removed));
  CHECK(removed.n == 0 && files_of("campaigns", id) == 2);
  CHECK_OK(mo_store_extend_campaign(store, id, 1, NULL, &before));
  REQUIRE_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_OK(mo_store_checkpoints_remove(store, id, MO_JOB_CAMPAIGN, 0, &removed));
  CHECK(removed.n == 2 && removed.places[0].generation == 1 && removed.places[1].step == 5 &&
        removed.bytes == 17);
  CHECK_INT(files_of("campaigns", id), -1); /* no folder */
  CHECK_INT(mo_store_checkpoints(store, id, rows, 3), 0);
  /* A run that notices its end too late leaves no file. */
  CHECK_INT(put_checkpoint(id, 1, 2, "late"), MO_ERR_CONFLICT);
  CHECK_INT(files_of("campaigns", id), -1);
  CHECK_OK(check_whole());
}

static const struct check_case cases[] = {
    {"commits generations, zero-shot", WITH(commits_generations, MO_ZERO_SHOT)},
    {"commits generations, few-shot", WITH(commits_generations, MO_FEW_SHOT)},
    {"commits generations, simultaneous", WITH(commits_generations, MO_SIMULTANEOUS)},
    {"refuses commits at the wrong time", refuses_what_is_wrong},
    {"keeps losses of a generation", keeps_losses_of_a_generation},
    {"keeps measures with losses and designs", keeps_measures},
    {"refuses damaged measures", refuses_damaged_measures},
    {"records who computed a score", names_who_computed},
    {"shares scores", shares_scores},
    {"keeps results of re-evaluations", keeps_re_evaluations},
    {"sums up re-evaluations", sums_up_re_evaluations},
    {"keeps checkpoints", keeps_checkpoints},
    {"removes checkpoints", removes_checkpoints},
};
CHECK_MAIN_AROUND(cases, with_a_store)
