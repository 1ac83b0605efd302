/* certificates.c: what the store records about certificates: settings, and the losses of trials,
 * which are read back by design and environment. */
#include "store/certificates.h"
#include "by_hand.h"
#include "one_store.h"
#include "store/check.h"
#include "store/controllers.h"
#include "store/deletion.h"

enum { DESIGNS = 3, WORLDS = 150, PART = MO_CERTIFICATE_PART };
static const struct mo_certificate_classes own = {{"cpu x float32", "cpu x float64"}};

static struct mo_certificate_request request_of(void)
{
  static struct mo_bits *forms_of, *bodies;
  bodies = make_bodies(3, DESIGNS, &forms_of);
  struct mo_certificate_request request = {.record = {.settings = mo_certificate_defaults(),
                                                      .taken = MO_TAKEN_PHYSICS,
                                                      .n_trials = 2,
                                                      .n_rollouts = 2 * DESIGNS * WORLDS},
                                           .physics = mo_default_physics(),
                                           .controller = "default",
                                           .genotypes = bodies,
                                           .forms = forms_of,
                                           .n_designs = DESIGNS,
                                           .environment_set = "morpho-12-walk"};
  request.record.settings.axes = 1U << MO_AXIS_BASE | 1U << MO_AXIS_FRICTION;
  request.record.settings.seed = 77;
  request.record.settings.top = 2;
  request.record.settings.n_levels = 1;
  request.record.settings.levels[0] = 0.1;
  return request;
}

static int64_t submit_certificate(const struct mo_certificate_request *request)
{
  bool replayed;
  int64_t id = 0;
  CHECK_OK(mo_store_submit_certificate(store, request, &id, &replayed));
  return id;
}

static int64_t start_certificate(void)
{
  const struct mo_certificate_request request = request_of();
  const int64_t id = submit_certificate(&request);
  bool restarts = true;
  CHECK_OK(mo_store_run_start(store, id));
  CHECK_OK(mo_store_certificate_start(store, id, &own, &restarts));
  CHECK(!restarts);
  return id;
}

/* Distinct for each design, environment and trial. */
static float loss_of(uint32_t trial, uint32_t design, uint32_t k)
{
  return (float)trial + 0.1F * (float)design + 0.0001F * (float)k;
}

/* Fills in the losses and measures of a trial in the order of storing. */
static void fill(uint32_t trial, float *losses, double (*measures)[MO_MEASURES])
{
  for (uint32_t first = 0; first < WORLDS; first += PART)
    for (uint32_t d = 0; d < DESIGNS; d++)
      for (uint32_t k = first; k < WORLDS && k < first + PART; k++) {
        for (int m = 0; m < MO_MEASURES; m++)
          (*measures)[m] = NAN;
        (*measures)[MO_MEASURE_INVERTED_VOXELS] = d + 2 * k;
        measures++;
        *losses++ = loss_of(trial, d, k);
      }
}

static struct mo_certificate_record progress_of(uint32_t trials, uint64_t rollouts)
{
  return (struct mo_certificate_record){.n_trials = 2,
                                        .trials_done = trials,
                                        .n_rollouts = 2 * DESIGNS * WORLDS,
                                        .rollouts_done = rollouts};
}

/* Saves the losses of a trial from place `from` to below `to`. */
static int save_part(int64_t id, uint32_t trial, uint32_t from, uint32_t to, bool measures)
{
  static float losses[DESIGNS * WORLDS];
  static double values[DESIGNS * WORLDS][MO_MEASURES];
  fill(trial, losses, values);
  const struct mo_certificate_losses part = {.trial = trial,
                                             .n = to - from,
                                             .place = from,
                                             .losses = losses + from,
                                             .measures = measures ? &values[from] : NULL};
  const bool is_whole = to == DESIGNS * WORLDS;
  const struct mo_certificate_record progress =
      progress_of(trial + is_whole, trial * DESIGNS * WORLDS + to);
  return mo_store_certificate_save(store, id, &part, 1, &progress);
}

static void keeps_settings(void)
{
  const struct mo_certificate_request request = request_of();
  const int64_t id = submit_certificate(&request);
  struct mo_certificate_status status, listed[2];
  uint32_t n = 0;
  REQUIRE_OK(reopen());
  REQUIRE_OK(mo_store_certificate(store, id, &status));
  CHECK_INT(status.job.kind, MO_JOB_CERTIFICATE);
  CHECK(mo_fields_equal(&mo_certificate_fields, &status.record.settings, &request.record.settings));
  CHECK_INT(status.record.settings.n_levels, 1);
  CHECK(same_bits(status.record.settings.levels[0], 0.1));
  CHECK_INT(status.record.settings.axes, request.record.settings.axes);
  CHECK_INT(status.record.taken, MO_TAKEN_PHYSICS);
  CHECK_INT(status.record.n_trials, 2);
  CHECK_INT(status.record.n_rollouts, 2 * DESIGNS * WORLDS);
  CHECK_INT(status.job.n_designs, DESIGNS);
  CHECK_INT(status.job.n_environments, 10);
  CHECK_TEXT(status.job.environment_set, "morpho-12-walk");
  CHECK_TEXT(status.job.controller_name, "default");
  CHECK(SAME(designs_of(id, &n), request.genotypes, DESIGNS));
  CHECK_INT(mo_store_certificates(store, &any_job, listed, 2), 1);
  CHECK_INT(listed[0].job.id, id);
  close_store();
  CHECK_OK(outside("UPDATE certificates SET settings=replace(settings,'77','-7')"));
  REQUIRE_OK(reopen());
  CHECK_INT(mo_store_certificate(store, id, &status), MO_ERR_CORRUPT);
}

/* Returns the newest certificate of a design of job `id` under a controller (nullable). */
static struct mo_certified certified(int64_t id, const struct mo_sha256 *controller,
                                     uint32_t design)
{
  struct mo_certified found = {.id = -1};
  struct mo_bits *designs = NULL;
  uint32_t n = 0;
  CHECK_OK(mo_store_job_designs(store, id, &designs, &n));
  CHECK(design < n);
  if (design < n) {
    const struct mo_genotype genotype = mo_genotype_of(MO_STORE_WORKSPACE, &designs[design]);
    CHECK_OK(mo_store_certified(store, controller, &genotype, &found));
  }
  free(designs);
  return found;
}

static void keeps_losses(void)
{
  static float losses[DESIGNS * WORLDS];
  static double measures[DESIGNS * WORLDS][MO_MEASURES];
  const int64_t id = start_certificate();
  struct mo_certificate_status status;
  CHECK_OK(save_part(id, 0, 0, PART, true));
  CHECK_INT(mo_store_certificate_losses(store, id, 0, DESIGNS, WORLDS, losses, measures),
            MO_ERR_NOT_FOUND);
  CHECK_OK(save_part(id, 0, PART, DESIGNS * PART + 20, true));
  CHECK_OK(save_part(id, 0, DESIGNS * PART + 20, DESIGNS * WORLDS, true));
  REQUIRE_OK(mo_store_certificate_losses(store, id, 0, DESIGNS, WORLDS, losses, measures));
  bool same = true;
  for (uint32_t d = 0; d < DESIGNS; d++)
    for (uint32_t k = 0; k < WORLDS; k++)
      same = same && losses[d * WORLDS + k] == loss_of(0, d, k) &&
             measures[d * WORLDS + k][MO_MEASURE_INVERTED_VOXELS] == d + 2 * k;
  CHECK(same);
  CHECK_OK(mo_store_certificate(store, id, &status));
  CHECK_INT(status.record.trials_done, 1);
  CHECK_INT(status.record.rollouts_done, DESIGNS * WORLDS);
  CHECK(strstr(last_event(id).data, "\"trials_done\":1,\"trials\":2") != NULL);
  const uint8_t verdicts[DESIGNS] = {MO_CLASS_HOLDS, MO_CLASS_DEPENDS};
  CHECK_INT(certified(id, NULL, 0).id, 0);
  CHECK_OK(mo_store_certificate_finish(store, id, verdicts, DESIGNS));
  CHECK_INT(state_of(id), MO_JOB_SUCCEEDED);
  CHECK_INT(certified(id, NULL, 0).id, id);
  CHECK_INT(certified(id, NULL, 0).verdict, MO_CLASS_HOLDS);
  CHECK_INT(certified(id, &status.job.controller_sha256, 1).verdict, MO_CLASS_DEPENDS);
  CHECK_INT(certified(id, &(struct mo_sha256){{7}}, 1).id, 0);
  CHECK_INT(save_part(id, 1, 0, PART, false), MO_ERR_CONFLICT);
}

/* Losses under other code are forgotten; under the same code, they stay. */
static void forgets_losses_of_other_code(void)
{
  static const struct mo_certificate_classes other = {{"cpu x float32", "cpu y float64"}};
  const int64_t id = start_certificate();
  struct mo_certificate_classes classes;
  struct mo_certificate_status status;
  bool restarts = true;
  CHECK_OK(save_part(id, 0, 0, PART, true));
  CHECK_INT(park(id, MO_OK), MO_JOB_QUEUED);
  CHECK_OK(mo_store_run_start(store, id));
  CHECK_OK(mo_store_certificate_start(store, id, &own, &restarts));
  CHECK(!restarts);
  CHECK_OK(mo_store_certificate(store, id, &status));
  CHECK_INT(status.record.rollouts_done, PART);
  CHECK_OK(mo_store_certificate_start(store, id, &other, &restarts));
  CHECK(restarts);
  CHECK_OK(mo_store_certificate(store, id, &status));
  CHECK_INT(status.record.rollouts_done, 0);
  CHECK_OK(mo_store_certificate_classes(store, id, &classes));
  CHECK_TEXT(classes.fingerprint[1], "cpu y float64");
  CHECK_OK(save_part(id, 0, 0, PART, true));
}

static void report(void *context, const char *finding)
{
  (void)context;
  CHECK(strstr(finding, "losses of a trial are damaged: certificate 1") != NULL);
}

static void detects_damage(void)
{
  static const char *const damage[] = {
      "UPDATE certificate_losses SET losses=zeroblob(length(losses))",
      "UPDATE certificate_losses SET losses=substr(losses,1,100)",
      "UPDATE certificate_losses SET place=place+1",
      "UPDATE certificate_losses SET losses=x''",
      "UPDATE certificate_losses SET measures=NULL",
      "DELETE FROM certificate_losses WHERE place=0"};
  enum { ROWS = 4 }; /* the first ones damage rows */
  static float losses[DESIGNS * WORLDS];
  static double measures[DESIGNS * WORLDS][MO_MEASURES];
  struct mo_check_counts counts;
  for (size_t i = 0; i < COUNT(damage); i++) {
    const int64_t id = start_certificate();
    CHECK_OK(save_part(id, 0, 0, PART, true));
    CHECK_OK(save_part(id, 0, PART, DESIGNS * WORLDS, true));
    REQUIRE_OK(reopen_after(damage[i]));
    CHECK_INT(mo_store_certificate_losses(store, id, 0, DESIGNS, WORLDS, losses, measures),
              MO_ERR_CORRUPT);
    CHECK_OK(mo_store_check_contents(store, report, NULL, &counts));
    CHECK_INT(counts.findings, i < ROWS ? 2 : 0); /* nothing is wrong with the other rows */
    start_over();
  }
}

/* A certificate keeps the job with its designs and its controller. */
static void keeps_what_it_needs(void)
{
  struct mo_evaluation_request evaluation = draw_evaluation(2, 3);
  struct mo_message message = {.text = ""};
  struct mo_deleted deleted;
  const int64_t source = submit_evaluation(&evaluation);
  struct mo_certificate_request request = request_of();
  request.record.population = source;
  const int64_t id = submit_certificate(&request);
  CHECK_OK(change(source, MO_CHANGE_CANCEL));
  CHECK_INT(mo_store_delete_job(store, source, &deleted, &message), MO_ERR_CONFLICT);
  CHECK_SAYS(message, "is about its designs");
  CHECK_INT(mo_store_delete_job(store, id, &deleted, &message), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_run_start(store, id));
  bool restarts;
  CHECK_OK(mo_store_certificate_start(store, id, &own, &restarts));
  CHECK_OK(save_part(id, 0, 0, DESIGNS * WORLDS, true));
  CHECK_OK(save_part(id, 1, 0, DESIGNS * WORLDS, false));
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_OK(mo_store_delete_job(store, id, &deleted, &message));
  CHECK_OK(mo_store_delete_job(store, source, &deleted, &message));
  close_store();
  CHECK_INT(outside_integer("SELECT count(*) FROM certificate_losses"), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM certificates"), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM job_designs"), 0);
}

static const struct check_case cases[] = {
    {"settings are read back", keeps_settings},
    {"losses are read back by design and environment", keeps_losses},
    {"losses under other code are forgotten", forgets_losses_of_other_code},
    {"damaged losses are detected", detects_damage},
    {"a certificate keeps the job with its designs", keeps_what_it_needs},
};
CHECK_MAIN_AROUND(cases, with_a_store)
