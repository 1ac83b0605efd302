/* designs.c: stored designs, scores and controllers are read back bit for bit, and designs are
 * ranked. */
#include <math.h>

#include "../image.h"
#include "by_hand.h"
#include "one_store.h"
#include "training_fixture.h"

static void shares_designs_between_orientations(void)
{
  struct mo_bits images[2], same_forms[2];
  struct mo_design *design = NULL;
  genotypes = make_bodies(5, 40, &forms);
  images[0] = genotypes[0];
  for (unsigned i = 0; i < 40; i++) { /* a body that is not its own mirror image */
    REQUIRE_OK(make_image(MO_DEFAULT_WORKSPACE, genotypes[i].words, 4, images[1].words));
    mo_genotype_place(MO_DEFAULT_WORKSPACE, images[1].words);
    images[0] = genotypes[i];
    same_forms[0] = same_forms[1] = forms[i];
    if (memcmp(&images[0], &images[1], sizeof(images[0])) != 0)
      break;
  }
  REQUIRE(memcmp(&images[0], &images[1], sizeof(images[0])) != 0);
  struct mo_evaluation_request submission = fixture_submission(same_forms, images, 2);
  int64_t id = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(id, made_up_loss));
  CHECK_INT(outside_integer("SELECT count(*) FROM designs"), 1);
  const struct mo_genotype form = mo_genotype_of(MO_DEFAULT_WORKSPACE, &same_forms[0]),
                           image = mo_genotype_of(MO_DEFAULT_WORKSPACE, &images[1]),
                           absent = mo_genotype_of(MO_DEFAULT_WORKSPACE, &genotypes[39]);
  REQUIRE_OK(mo_store_design(store, &form, &design));
  CHECK_INT(design->n_orientations, 2);
  CHECK(mo_genotype_equal(&design->orientations[1].genotype, &image));
  REQUIRE(design->orientations[1].n_scores == 1);
  CHECK_TEXT(design->orientations[1].scores[0].environment_set, "paper-test");
  CHECK_INT(design->orientations[1].scores[0].n_losses, 10);
  CHECK(design->orientations[1].scores[0].losses[3] == made_up_loss(1, 3));
  CHECK_TEXT(design->orientations[1].scores[0].fingerprint, "by hand");
  mo_design_free(design);
  CHECK_INT(mo_store_design(store, &absent, &design), MO_ERR_NOT_FOUND);
}

/* The orientations of one design that were scored, and their mean losses. The design has 8
 * images. */
static const unsigned order[] = {6, 2, 5, 0, 7, 3};
static const double means[] = {2, 1, 1, 3, INFINITY, 1}; /* same order */

static double mean_loss(uint32_t n, uint32_t k)
{
  return k == 4 ? means[n] : isinf(means[n]) ? 1 : means[n];
}

/* An id without an orientation means the orientation with the best score in exactly these
 * environments; of equal scores, the smallest K. */
static void orients_ids(void)
{
  struct mo_bits body = {{0}}, same_forms[6], images[6], asked[3];
  struct mo_design_note notes[] = {{.place = 0, .fault = {.detail = "empty"}},
                                   {.place = 1, .orientation = MO_ORIENTATION_CANONICAL},
                                   {.place = 3, .orientation = MO_ORIENTATION_CANONICAL}};
  const struct mo_physics physics = mo_paper_physics();
  char robot[MO_DEFAULT_ROBOT_DIGITS + 1];
  int64_t fingerprint = 0;
  int k = -1;
  for (uint64_t seed = 1; k != 7; seed++) { /* a body with 8 different images */
    struct mo_random random = dice(seed, 0, 0);
    REQUIRE_OK(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, body.words));
    REQUIRE_OK(mo_genotype_robot(MO_DEFAULT_WORKSPACE, body.words, robot));
    k = robot[MO_DEFAULT_ROBOT_DIGITS - 1] - '0';
  }
  for (size_t i = 0; i < COUNT(order); i++) {
    robot[MO_DEFAULT_ROBOT_DIGITS - 1] = (char)('0' + order[i]);
    REQUIRE_OK(mo_genotype_from_robot(MO_DEFAULT_WORKSPACE, robot, MO_DEFAULT_ROBOT_DIGITS,
                                      images[i].words, &k));
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, images[i].words, same_forms[i].words);
  }
  struct mo_evaluation_request submission = fixture_submission(same_forms, images, 6);
  REQUIRE_OK(run_by_hand(submit_evaluation(&submission), mean_loss));
  REQUIRE_OK(mo_store_fingerprint(store, "by hand", &fingerprint));
  struct mo_orienting under = {.controller = "default",
                               .environment_set = "paper-test",
                               .physics = &physics,
                               .precision = MO_FLOAT32,
                               .fingerprint = fingerprint,
                               .workspace = MO_DEFAULT_WORKSPACE};
  for (int round = 0; round < 4; round++) {
    const bool is_scored = round == 0;
    asked[0] = asked[1] =
        images[3]; /* orientation 0, which the request states for the second one */
    asked[2] = make_bodies(77, 1, NULL)[0];
    notes[1].orientation = notes[2].orientation = MO_ORIENTATION_CANONICAL;
    CHECK_OK(mo_store_orient(store, &under, asked, 3, notes, 3));
    CHECK_INT(notes[0].orientation, MO_ORIENTATION_GIVEN);
    CHECK_INT(notes[1].orientation, is_scored ? MO_ORIENTATION_BEST : MO_ORIENTATION_CANONICAL);
    CHECK(SAME(&asked[0], is_scored ? &images[1] : &images[3],
               1)); /* orientation 2: as good as 3 and 5 */
    CHECK_INT(notes[1].robot[MO_DEFAULT_ROBOT_DIGITS - 1], is_scored ? '2' : '0');
    CHECK(SAME(&asked[1], &images[3], 1));
    CHECK_INT(notes[2].orientation, MO_ORIENTATION_CANONICAL); /* never scored */
    if (round == 0)
      under.precision = MO_FLOAT64;
    else if (round == 1)
      under.precision = MO_FLOAT32, under.fingerprint = fingerprint + 1;
    else
      under.fingerprint = fingerprint, under.controller = "nobody";
  }
}

static double odd_loss(uint32_t n, uint32_t k)
{
  static const double values[] = {-0.0, 0.0, 4.9e-324, 1.0 / 3.0, INFINITY, 1.7976931348623157e308};
  return values[(n + k) % 6];
}

static double other_loss(uint32_t n, uint32_t k)
{
  return n == 1 && k == 2 ? nextafter(odd_loss(n, k), 2.0) : odd_loss(n, k);
}

static void keeps_every_bit(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  struct mo_evaluation_results *results = NULL;
  struct mo_environment environments[6];
  for (unsigned k = 0; k < 6; k++)
    mo_environment_training(9, 0, k, &environments[k]);
  environments[2].light_xy_m[0] = -0.0;
  submission.environment_set = NULL;
  submission.environments = environments;
  submission.n_environments = 6;
  int64_t id = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(id, odd_loss));
  REQUIRE_OK(reopen());
  REQUIRE_OK(mo_store_results(store, id, &results));
  for (uint32_t n = 0; n < 3; n++)
    for (uint32_t k = 0; k < 6; k++) {
      double expected = odd_loss(n, k);
      CHECK(memcmp(&results->losses[n * 6 + k], &expected, 8) == 0);
      CHECK_INT(results->diverged_steps[n * 6 + k], isinf(expected) ? 17 : 0);
    }
  CHECK(isinf(results->scores[0]));
  CHECK(memcmp(results->forms, forms, 3 * sizeof(*forms)) == 0);
  mo_evaluation_results_free(results);
  /* A second job that computes the same scores changes nothing; a verify job reports both. */
  submission.verify = true;
  int64_t again = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(again, other_loss));
  REQUIRE_OK(mo_store_results(store, again, &results));
  REQUIRE(results->agrees != NULL && results->stored_losses != NULL);
  CHECK(results->agrees[0] == 1 && results->agrees[1] == 0 && results->agrees[2] == 1);
  CHECK(results->losses[8] == other_loss(1, 2) && results->stored_losses[8] == odd_loss(1, 2));
  mo_evaluation_results_free(results);
  REQUIRE_OK(mo_store_results(store, id, &results));
  CHECK(results->losses[8] == odd_loss(1, 2));
  CHECK(results->agrees == NULL);
  mo_evaluation_results_free(results);
  CHECK_INT(mo_store_results(store, 77, &results), MO_ERR_NOT_FOUND);
}

/* Results keep the positions of the request; the work contains only the designs that remain. */
static void keeps_places_of_skipped_designs(void)
{
  struct mo_design_note notes[] = {
      {.place = 0, .fault = {.where = "/designs/0", .detail = "empty"}},
      {.place = 2, .fault = {.where = "/designs/2/voxels", .detail = "torn"}},
      {.place = 3, .dropped = 5}};
  struct mo_evaluation_request submission = draw_evaluation(4, 3);
  struct mo_evaluation_results *results = NULL;
  struct mo_work *work = NULL;
  int64_t fingerprint = 0;
  submission.notes = notes;
  submission.n_notes = 3;
  submission.n_skipped = 2;
  submission.verify = true;
  const int64_t id = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(id, made_up_loss));
  REQUIRE_OK(reopen());
  const struct mo_job job = job_of(id);
  CHECK(job.n_designs == 5 && job.n_skipped == 2 && job.rollouts_total == 30);
  REQUIRE_OK(mo_store_fingerprint(store, "by hand", &fingerprint));
  REQUIRE_OK(mo_store_load_work(store, id, fixture_classes(fingerprint), &work));
  CHECK(work->n_designs == 3 && work->positions[0] == 1 && work->positions[2] == 4);
  CHECK_INT(work->n_finished, 30);
  mo_work_free(work);
  REQUIRE_OK(mo_store_results(store, id, &results));
  REQUIRE(results->n_designs == 5 && results->n_notes == 3);
  CHECK_TEXT(results->notes[1].fault.where, "/designs/2/voxels");
  CHECK(results->notes[2].dropped == 5 && !mo_is_skipped(&results->notes[2]));
  for (uint32_t n = 0, taken = 0; n < 5; n++) {
    const bool skipped = n == 0 || n == 2;
    CHECK(isnan(results->scores[n]) == skipped);
    CHECK(SAME(&results->forms[n], skipped ? &(struct mo_bits){{0}} : &forms[taken], 1));
    CHECK(skipped || results->losses[n * 10 + 7] == made_up_loss(taken, 7));
    taken += !skipped;
  }
  mo_evaluation_results_free(results);
  REQUIRE_OK(mo_store_result(store, id, 3, &results));
  CHECK(SAME(&results->forms[0], &forms[1], 1));
  mo_evaluation_results_free(results);
}

static void ranks_designs(void)
{
  struct mo_evaluation_request submission = draw_evaluation(6, 20);
  struct mo_controller_record record;
  struct mo_design_query query = {
      .sort = MO_DESIGNS_BY_SCORE, .environment_set = "paper-test", .fingerprint = "by hand"};
  struct mo_design_row rows[8];
  int64_t id, seen = 0;
  double last = -1;
  id = submit_evaluation(&submission);
  REQUIRE_OK(mo_store_controller(store, "default", &record));
  query.controller_sha256 = record.sha256;
  query.physics = mo_paper_physics();
  CHECK_INT(mo_store_designs(store, &query, rows, 8), 0);
  REQUIRE_OK(run_by_hand(id, made_up_loss));
  for (;;) {
    int64_t n = mo_store_designs(store, &query, rows, 8);
    REQUIRE(n >= 0);
    for (int64_t i = 0; i < n; i++) {
      CHECK(rows[i].score > last);
      last = rows[i].score;
      CHECK(SAME(&forms[seen], rows[i].form.words, 1));
      seen++;
    }
    if (n == 0)
      break;
    query.after_row = rows[n - 1].genotype_row;
    query.after_score = rows[n - 1].score;
  }
  CHECK_INT(seen, 20);
  query.is_descending = true;
  query.after_row = 0;
  CHECK_INT(mo_store_designs(store, &query, rows, 8), 8);
  CHECK(rows[0].score == last && rows[1].score < last); /* the worst first */
  query = (struct mo_design_query){.sort = MO_DESIGNS_BY_ID};
  CHECK_INT(mo_store_designs(store, &query, rows, 8), 8);
  CHECK(SAME(&forms[7], rows[7].form.words, 1));
  query.after_row = rows[7].row;
  CHECK_INT(mo_store_designs(store, &query, rows, 8), 8);
  CHECK(SAME(&forms[8], rows[0].form.words, 1));
}

static void keeps_controllers(void)
{
  struct mo_controller_record first, second, listed[4];
  char digits[65], reference[80], *metadata = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  CHECK_OK(mo_store_controller(store, "default", &first));
  CHECK_INT(first.version, 1);
  CHECK_INT(first.n_parameters, 620912);
  CHECK_OK(mo_store_controller_bytes(store, &first.sha256, &bytes, &size));
  CHECK_INT(size, first.size);
  free(bytes);
  CHECK_OK(mo_store_controller_metadata(store, &first.sha256, &metadata));
  CHECK(metadata != NULL && strstr(metadata, "\"sensor\":\"inverse_sqrt\"") != NULL);
  CHECK(metadata != NULL &&
        strstr(metadata, "\"note\":\"a \\\"quoted\\\"\\n\\\\ \xc3\xa9 note\"") != NULL);
  free(metadata);
  /* The same content under the same name changes nothing; other content moves the name. */
  CHECK_OK(put_weights("default", 1, &second));
  CHECK(second.version == 1 && second.stored_us == first.stored_us);
  CHECK_OK(put_weights("default", 2, &second));
  CHECK(second.version == 2 && !mo_sha256_equal(&first.sha256, &second.sha256));
  CHECK_OK(put_weights("another-one", 1, &second));
  CHECK_INT(mo_store_controllers(store, NULL, listed, 4), 2);
  CHECK_TEXT(listed[0].name, "another-one");
  CHECK_INT(mo_store_controllers(store, "another-one", listed, 4), 1);
  CHECK_TEXT(listed[0].name, "default");
  mo_sha256_to_hex(&first.sha256, digits);
  snprintf(reference, sizeof(reference), "sha256:%s", digits);
  CHECK_OK(mo_store_controller(store, reference, &second));
  CHECK(mo_sha256_equal(&first.sha256, &second.sha256) && second.name[0] == '\0');
  CHECK_INT(mo_store_controller(store, "sha256:12", &second), MO_ERR_NOT_FOUND);
  CHECK_OK(mo_store_controller_remove(store, "another-one"));
  CHECK_INT(mo_store_controller_remove(store, "another-one"), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_controller(store, "another-one", &second), MO_ERR_NOT_FOUND);
  CHECK_OK(mo_controller_name_check("bootstrap"));
  CHECK_OK(mo_controller_name_check("a.b_c-0"));
  CHECK_INT(mo_controller_name_check(""), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("../x"), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("Upper"), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("a/b"), MO_ERR_FORMAT);
  CHECK_INT(
      mo_controller_name_check("0123456789012345678901234567890123456789012345678901234567890123x"),
      MO_ERR_FORMAT);
  /* A damaged file is detected, and repaired by the next upload. */
  const char *path = path_of("controllers/%s.safetensors", digits);
  REQUIRE_OK(overwrite(path, 5000, "scratched", 9));
  CHECK_INT(mo_store_controller_bytes(store, &first.sha256, &bytes, &size), MO_ERR_CORRUPT);
  CHECK_OK(put_weights("default", 1, &second));
  CHECK_OK(mo_store_controller_bytes(store, &first.sha256, &bytes, &size));
  free(bytes);
  unlink(path);
  CHECK_INT(mo_store_controller_bytes(store, &first.sha256, &bytes, &size), MO_ERR_CORRUPT);
}

static double design_loss(uint32_t n, uint32_t k)
{
  static const double losses[6] = {0.5, 0.25, INFINITY, 0.75, 0.125, 0.25};
  (void)k;
  return losses[n];
}

static void ranks_a_population(void)
{
  struct mo_bits *best = NULL;
  struct mo_evaluation_request evaluation = draw_evaluation(5, 6);
  struct mo_training_request training = submission_of(10);
  int64_t id = 0;
  uint32_t n = 0;
  forms[5] = forms[1]; /* requested twice */
  genotypes[5] = genotypes[1];
  id = submit_evaluation(&evaluation);
  CHECK_INT(mo_store_population(store, id, 0, &best, &n), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_population(store, id + 1, 0, &best, &n), MO_ERR_NOT_FOUND);
  REQUIRE_OK(run_by_hand(id, design_loss));
  best = best_of(id, 0, &n);
  CHECK(n == 4 && SAME(&best[0], &genotypes[4], 1) && SAME(&best[1], &genotypes[1], 1) &&
        SAME(&best[2], &genotypes[0], 1) && SAME(&best[3], &genotypes[3], 1));
  best = best_of(id, 2, &n);
  CHECK_INT(n, 2);
  /* Lower bounds are not ranked, even if they are below all scores; another entry of the same
   * genotype is ranked. */
  REQUIRE_OK(reopen_after("UPDATE job_designs SET counted=3 WHERE position IN (1,4)"));
  best = best_of(id, 4, &n);
  CHECK(n == 3 && SAME(&best[0], &genotypes[5], 1) && SAME(&best[1], &genotypes[0], 1) &&
        SAME(&best[2], &genotypes[3], 1));
  best = best_of(id, 1, &n);
  CHECK(n == 1 && SAME(&best[0], &genotypes[5], 1));
  CHECK_INT(mo_store_population(store, submit_training(&training), 0, &best, &n), MO_ERR_NOT_FOUND);
}

static void *delete_contents(void *context)
{
  struct mo_controller_record record;
  char reference[80], digits[65];
#ifdef __SANITIZE_THREAD__ /* finds in a few rounds what others find only by chance */
  const int rounds = 15;
#else
  const int rounds = 60;
#endif
  for (int n = 0; n < rounds;) {
    if (mo_store_controller(store, "again", &record) != MO_OK)
      continue;
    mo_sha256_to_hex(&record.sha256, digits);
    snprintf(reference, sizeof(reference), "sha256:%s", digits);
    (void)mo_store_controller_remove(store, "again");
    n += mo_store_controller_delete(store, reference, NULL) == MO_OK;
  }
  return context;
}

/* Content is stored again while it is being deleted: no row may refer to a deleted file. */
static void stores_again_what_is_deleted(void)
{
  struct mo_controller_record record;
  pthread_t thread;
  REQUIRE(pthread_create(&thread, NULL, delete_contents, NULL) == 0);
  while (pthread_tryjoin_np(thread, NULL) != 0) {
    struct mo_controller_record seen;
    char digits[65], reference[80];
    REQUIRE_OK(put_weights("again", 77, &record));
    mo_sha256_to_hex(&record.sha256, digits);
    snprintf(reference, sizeof(reference), "sha256:%s", digits);
    /* If the row outlived its file, it would stay broken: no other call recreates the file. */
    CHECK(access(path_of("controllers/%s.safetensors", digits), F_OK) == 0 ||
          mo_store_controller(store, reference, &seen) == MO_ERR_NOT_FOUND);
  }
}

/* A list that is too long to be stored with the submission: kept as bits, then stored group by
 * group in order. */
static void stores_long_lists_in_groups(void)
{
  enum { N = MO_DESIGN_GROUP + 5 };
  static struct mo_bits read[MO_DESIGN_GROUP];
  struct mo_evaluation_request submission = draw_evaluation(8, N);
  submission.forms = NULL;
  const int64_t id = submit_evaluation(&submission);
  int64_t waiting = 0, queued[4];
  REQUIRE_OK(mo_store_waiting(store, &waiting));
  CHECK_INT(waiting, id);
  const enum mo_urgency urgency = (enum mo_urgency)submission.job.priority;
  CHECK_INT(mo_store_queued(store, urgency, 0, true, queued, 4), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM job_designs"), 0);
  CHECK_OK(mo_store_waiting_designs(store, id, 0, read, MO_DESIGN_GROUP));
  CHECK(memcmp(read, genotypes, sizeof(read)) == 0);
  CHECK_INT(mo_store_waiting_designs(store, id, 1, read, MO_DESIGN_GROUP), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_waiting_designs(store, id, MO_DESIGN_GROUP, read, 4), MO_ERR_CORRUPT);
  CHECK_INT(mo_store_group(store, id, MO_DESIGN_GROUP, forms, genotypes, 5), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_group(store, id, 0, forms, genotypes, MO_DESIGN_GROUP));
  CHECK_INT(mo_store_waiting_designs(store, id, 0, read, MO_DESIGN_GROUP), MO_ERR_NOT_FOUND);
  CHECK_OK(outside("UPDATE waiting_designs SET bits=zeroblob(length(bits))"));
  CHECK_INT(mo_store_waiting_designs(store, id, MO_DESIGN_GROUP, read, 5), MO_ERR_CORRUPT);
  CHECK_OK(mo_store_group(store, id, MO_DESIGN_GROUP, forms + MO_DESIGN_GROUP,
                          genotypes + MO_DESIGN_GROUP, 5));
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM job_designs"), N);
  REQUIRE_OK(mo_store_waiting(store, &waiting));
  CHECK_INT(waiting, 0);
  CHECK_INT(mo_store_queued(store, urgency, 0, true, queued, 4), 1);
}

/* When a job ends before its list is stored, the list is deleted. Lists of other jobs stay. */
static void deletes_lists_of_ended_jobs(void)
{
  enum { N = MO_DESIGN_GROUP + 5 };
  struct mo_evaluation_request submission = draw_evaluation(8, N);
  enum mo_job_state after = MO_JOB_QUEUED;
  submission.forms = NULL;
  const int64_t cancelled = submit_evaluation(&submission), failed = submit_evaluation(&submission),
                kept = submit_evaluation(&submission);
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 6);
  CHECK_OK(change(cancelled, MO_CHANGE_PAUSE));
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 6);
  CHECK_OK(change(cancelled, MO_CHANGE_CANCEL));
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 4);
  CHECK_OK(mo_store_run_park(store, failed, MO_ERR_CORRUPT, "damaged", 2, &after));
  CHECK_INT(after, MO_JOB_QUEUED);
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 4);
  CHECK_OK(mo_store_run_park(store, failed, MO_ERR_CORRUPT, "damaged", 2, &after));
  CHECK_INT(after, MO_JOB_FAILED);
  CHECK_INT(outside_integer("SELECT count(DISTINCT job) FROM waiting_designs"), 1);
  CHECK_INT(outside_integer("SELECT min(job) FROM waiting_designs"), kept);
}

static const struct check_case cases[] = {
    {"stores long lists in groups", stores_long_lists_in_groups},
    {"deletes lists of ended jobs", deletes_lists_of_ended_jobs},
    {"shares a design between its orientations", shares_designs_between_orientations},
    {"resolves an id to the best scored orientation", orients_ids},
    {"keeps every bit of a loss", keeps_every_bit},
    {"keeps the positions of skipped designs", keeps_places_of_skipped_designs},
    {"ranks designs by score", ranks_designs},
    {"keeps controllers by content and by name", keeps_controllers},
    {"restores deleted content", stores_again_what_is_deleted},
    {"ranks a population", ranks_a_population},
};
CHECK_MAIN_AROUND(cases, with_a_store)
