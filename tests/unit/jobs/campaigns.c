/* campaigns.c: campaigns with a fake back end, in which losses and gradients are functions of their
 * inputs: every mode end to end, compared with plain loops (campaign_history.h), and the
 * reports. */
#include "fakes.h"

/* Any number of workers; with custom environments, more than fit in one block. */
static void evolves_in_every_mode(void)
{
  static const uint32_t workers[] = {1, 2, 7};
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    struct mo_environment environments[20];
    for (uint32_t k = 0; k < 20; k++)
      mo_environment_held_out(8, k, &environments[k]);
    request.environments = environments;
    request.record.n_environments = 20;
    if (mode != MO_FEW_SHOT)
      request.record.environment_set[0] = '\0';
    if (mode == MO_SIMULTANEOUS)
      request.controller = "default";
    struct origin origin = origin_of(&request);
    REQUIRE_OK(service_begin());
    service.n_workers = workers[mode];
    REQUIRE_OK(service_open());
    int64_t id = submit_campaign(&request);
    CHECK(ends_as_plain(id, &origin));
    CHECK_OK(check_whole());
    CHECK_INT(warnings, 0);
  }
}

/* Parents keep their scores, and stored losses are not recomputed. */
SERVICE_CASE(scores_nothing_twice, 1)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  request.record.settings.racing = MO_RACING_OFF; /* children that were cut short are raced again */
  struct origin origin = origin_of(&request);
  struct mo_campaign_generation rows[GENERATIONS + 1];
  struct mo_campaign_design designs[POPULATION];
  struct mo_bits genotypes[POPULATION];
  int64_t id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  struct mo_jobs_stats stats = idle_stats();
  uint64_t rollouts = status_of(id).n_designs * MO_PAPER_TEST_COUNT;
  CHECK_INT(stats.campaign_rollouts, rollouts);
  CHECK_INT(stats.campaign_cached, 0);
  CHECK_INT(stats.campaign_generations, GENERATIONS + 1);
  CHECK_INT(stats.campaign_designs, status_of(id).n_designs);
  CHECK_INT(stats.active_campaigns, 0);
  CHECK_INT(stats.jobs_succeeded, 1);
  /* The same campaign again finds every loss; so does an evaluation of its designs. */
  id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  stats = idle_stats();
  CHECK_INT(stats.campaign_rollouts, rollouts);
  CHECK_INT(stats.campaign_cached, rollouts);
  CHECK_INT(mo_store_campaign_generations(store, id, -1, 1, rows, GENERATIONS + 1),
            GENERATIONS + 1);
  for (int g = 0; g <= GENERATIONS; g++)
    CHECK(rows[g].rollouts_cached == rows[g].rollouts &&
          rows[g].rollouts == rows[g].n_children * MO_PAPER_TEST_COUNT);
  REQUIRE(mo_store_campaign_designs(store, id, -1, designs, POPULATION) == POPULATION);
  for (int i = 0; i < POPULATION; i++)
    memcpy(genotypes[i].words, designs[i].genotype.words, sizeof(*genotypes));
  struct mo_evaluation_request evaluation = service_request(genotypes, POPULATION);
  evaluation.physics = request.record.settings.physics;
  id = submit_evaluation(&evaluation);
  CHECK_INT(end_of(id).rollouts_cached, POPULATION * MO_PAPER_TEST_COUNT);
  /* A campaign that learns scores with its own controller. */
  request = campaign(MO_FEW_SHOT);
  request.record.settings.racing = MO_RACING_OFF;
  request.record.settings.generations = 1;
  origin = origin_of(&request);
  id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  CHECK_INT(idle_stats().campaign_cached, rollouts);
  CHECK_INT(idle_stats().campaign_rollouts - rollouts, 3 * POPULATION * MO_PAPER_TEST_COUNT);
  CHECK_INT(idle_stats().campaign_steps, PARENT_STEPS + 2 * CHILD_STEPS);
}

/* Stored losses of children that were cut short are not recomputed, neither by the same campaign
 * nor by one that scores children completely. */
SERVICE_CASE(scores_no_loss_twice, 1)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  request.record.settings.generations = 12; /* the first generations do not race */
  struct origin origin = origin_of(&request);
  int64_t id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  const uint64_t computed = idle_stats().campaign_rollouts;
  id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  CHECK_INT(idle_stats().campaign_rollouts, computed);
  CHECK_INT(idle_stats().campaign_cached, computed);
  request.record.settings.racing = MO_RACING_OFF;
  origin = origin_of(&request);
  id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  const uint64_t all = status_of(id).n_designs * MO_PAPER_TEST_COUNT;
  CHECK(all > computed);
  CHECK_INT(idle_stats().campaign_rollouts, all);
  CHECK_INT(idle_stats().campaign_cached, 2 * computed);
  CHECK_INT(outside_integer("SELECT sum(length(c.environments)/8) FROM scores s"
                            " JOIN conditions c ON c.id=s.condition"),
            all);
}

/* Stored losses are counted once, including those of children that a process saved before it was
 * stopped. */
SERVICE_CASE(counts_what_was_stored_through_stops, 1)
{
  enum { UNTIL = 12, STOPS = 4 };
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct mo_campaign_generation rows[UNTIL + 1];
  uint64_t saved = 0, cached = 0;
  request.record.settings.generations = UNTIL;
  struct origin origin = origin_of(&request);
  int64_t id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  const uint64_t stored = idle_stats().campaign_rollouts;
  fake_plan.delay_us = 10000;
  request.record.settings.racing =
      MO_RACING_OFF; /* children have some of their losses, and get the rest */
  origin = origin_of(&request);
  id = submit_campaign(&request);
  for (uint32_t stop = 0; stop < STOPS; stop++) {
    REQUIRE(await_place(id, UNTIL - 2 * (STOPS - stop), MO_PHASE_SCORE));
    REQUIRE(AWAIT(live_of(id).done > POPULATION / 2));
    CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
    saved += status_of(id).scored;
    REQUIRE_OK(service_reopen());
  }
  CHECK(saved > 0);
  fake_plan.delay_us = 0;
  CHECK(ends_as_plain(id, &origin));
  CHECK_INT(mo_store_campaign_generations(store, id, -1, 1, rows, UNTIL + 1), UNTIL + 1);
  for (int g = 0; g <= UNTIL; g++)
    cached += rows[g].rollouts_cached;
  CHECK_INT(cached, stored);
}

/* Listed designs in a smaller workspace; then another campaign that starts with the final
 * population of the first. */
SERVICE_CASE(begins_with_what_is_given, 1)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  struct mo_bits listed[3] = {{{0}}};
  struct mo_campaign_design designs[POPULATION];
  struct mo_bits inherited[4];
  uint32_t n = 0;
  for (uint32_t i = 0; i < 3;
       i++) { /* columns of 1, 2 or 3 voxels along y: they fit only if turned */
    for (uint32_t y = 0; y <= i; y++)
      listed[i].words[(y * 4) / 64] |= UINT64_C(1) << (y * 4) % 64;
    mo_genotype_place(MO_DEFAULT_WORKSPACE, listed[i].words);
  }
  request.genotypes = listed;
  request.record.n_listed = 3;
  request.record.settings.workspace = (struct mo_workspace){3, 2, 2};
  struct origin origin = origin_of(&request);
  int64_t id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  CHECK_INT(mo_store_campaign_designs(store, id, -1, designs, 4), 4);
  CHECK(designs[0].descent.op == MO_BORN_LISTED && designs[3].descent.op == MO_BORN_RANDOM);
  REQUIRE(mo_store_campaign_population(store, id, -1, 0, designs, POPULATION, &n) == POPULATION);
  request = campaign(MO_ZERO_SHOT);
  request.record.initial_campaign = id;
  request.record.settings.population = 4; /* the best designs of the first campaign */
  for (int i = 0; i < 4; i++)
    memcpy(inherited[i].words, designs[i].genotype.words, sizeof(*inherited));
  origin = origin_of(&request);
  origin.given = inherited;
  origin.n_given = 4;
  id = submit_campaign(&request);
  CHECK(succeeds(id, NULL));
  struct history *history = plain_history(&fake_plain, &origin);
  for (int i = 0; i < 4; i++)
    history->designs[i].descent.op = MO_BORN_INHERITED;
  struct history *stored = stored_history(id);
  CHECK(same_history(stored, history));
  free(stored);
  free(history);
}

/* ---- reports ---- */

SERVICE_CASE(reports_its_generations, 1)
{
  struct mo_campaign_request request = campaign(MO_FEW_SHOT);
  struct mo_campaign_generation rows[GENERATIONS + 1];
  struct mo_event events[80];
  double most = 0;
  bool warned_since = false;
  int expected = 0;
  request.record.settings.collapse_share = 1; /* the threshold: any drop */
  request.record.settings.seed = 2;           /* set if there was one */
  snprintf(request.record.name, sizeof(request.record.name), "walker");
  fake_plan.delay_us = 2000;
  int64_t id = submit_campaign(&request);
  REQUIRE(await_place(id, 1, MO_PHASE_SCORE));
  CHECK(live_of(id).total == 2 * POPULATION || live_of(id).phase != MO_PHASE_SCORE);
  CHECK_TEXT(mo_phase_name(MO_PHASE_SCORE), "scoring");
  CHECK(succeeds(id, NULL));
  int64_t n = mo_store_events(store, 0, id, events, 80, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    CHECK(events[i].data[strlen(events[i].data) - 1] == '}' && strlen(events[i].data) < 480);
  CHECK_INT(count_events(id, "campaign.generation"), GENERATIONS + 1);
  CHECK_TEXT(events[n - 1].type, "job.finished");
  REQUIRE(mo_store_campaign_generations(store, id, -1, 1, rows, GENERATIONS + 1) ==
          GENERATIONS + 1);
  for (int g = 0; g <= GENERATIONS;
       g++) { /* one event for every drop, and the next only after a new maximum */
    if (rows[g].stats.diversity > most) {
      most = rows[g].stats.diversity;
      warned_since = false;
    }
    bool falls = !warned_since && rows[g].stats.diversity < most;
    CHECK_INT(rows[g].collapse, falls);
    warned_since = warned_since || falls;
    expected += falls;
    CHECK(rows[g].seconds > 0 && rows[g].stats.n == POPULATION &&
          rows[g].stats.species == POPULATION);
    CHECK_INT(rows[g].learning_steps, (g > 0 ? PARENT_STEPS : 0) + CHILD_STEPS);
    CHECK(isnan(rows[g].mean_parents) == (g == 0) && rows[g].mean_children > 0 &&
          rows[g].first_loss > 0);
    CHECK(g == 0 ? rows[g].turnover == 1 : rows[g].turnover < 1);
    CHECK_INT(rows[g].survived_mutants + rows[g].survived_recombinants,
              g > 0 ? (uint32_t)lround(rows[g].turnover * POPULATION) : 0);
  }
  CHECK(expected > 0);
  CHECK_INT(count_events(id, "campaign.diversity_collapse"), expected);
  CHECK_INT(live_of(id + 7).phase, MO_PHASE_IDLE);
}

/* The reported work is never a generation behind the last commit, even while the end is being
 * saved. */
SERVICE_CASE(shows_no_generation_behind_its_last, 1)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct mo_live live;
  uint32_t most = 0;
  bool behind = false;
  for (request.record.settings.seed = 1; request.record.settings.seed <= 8;
       request.record.settings.seed++) {
    const int64_t id = submit_campaign(&request);
    while (!mo_job_state_is_final(status_of(id).job.state))
      for (int i = 0; i < 1000; i++) {
        live = live_of(id);
        most = live.position > most ? live.position : most;
        behind |= live.phase == MO_PHASE_SAVE && live.position > GENERATIONS;
      }
  }
  CHECK_INT(most, GENERATIONS);
  CHECK(!behind);
}

static const struct check_case cases[] = {
    {"evolves in every mode", evolves_in_every_mode},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"scores nothing twice", scores_nothing_twice},
    {"recomputes no stored loss of a child that was cut short", scores_no_loss_twice},
    {"counts stored losses across stops", counts_what_was_stored_through_stops},
    {"starts with given designs", begins_with_what_is_given},
    {"reports its generations", reports_its_generations},
    {"never shows an outdated generation", shows_no_generation_behind_its_last},
#endif
};
CHECK_MAIN(cases)
