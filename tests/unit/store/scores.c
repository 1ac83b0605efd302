/* scores.c: packed losses, classes, origins, and what happens when a bit changes on the disk. */
#include "store/scores.h"

#include <sys/stat.h>

#include "by_hand.h"
#include "one_store.h"
#include "store/check.h"
#include "store/origins.h"

#define DESIGNS 12
#define FLIPS   120

static double lively_loss(uint32_t n, uint32_t k)
{
  return n % 5 == 4 && k == 3 ? INFINITY : 0.1 * (n + 1) + 0.003 * k;
}

/* ---- packed losses ---- */

static void packs_losses(void)
{
  const int64_t key[] = {7, 8, 9};
  for (uint32_t n = 1; n <= MO_BLOCK_LANES; n++)
    for (int diverges = 0; diverges < 2; diverges++) {
      double losses[MO_BLOCK_LANES], back[MO_BLOCK_LANES];
      uint32_t steps[MO_BLOCK_LANES] = {0}, back_steps[MO_BLOCK_LANES];
      uint8_t bytes[MO_PACKED_BYTES(MO_BLOCK_LANES)];
      for (uint32_t k = 0; k < n; k++)
        losses[k] = lively_loss(4, k);
      steps[n - 1] = diverges ? 17 : 0;
      size_t size = mo_pack_losses(key, 3, losses, steps, n, bytes);
      CHECK_INT(size, (diverges ? 12 : 8) * n + 8);
      CHECK_OK(mo_unpack_losses(key, 3, bytes, size, n, back, back_steps));
      CHECK(memcmp(losses, back, 8 * n) == 0 && memcmp(steps, back_steps, 4 * n) == 0);
      for (size_t bit = 0; bit < 8 * size; bit++) {
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
        CHECK_INT(mo_unpack_losses(key, 3, bytes, size, n, back, back_steps), MO_ERR_CORRUPT);
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
      }
      for (int i = 0; i < 3; i++) {
        int64_t other[] = {7, 8, 9};
        other[i] ^= 1;
        CHECK_INT(mo_unpack_losses(other, 3, bytes, size, n, back, back_steps), MO_ERR_CORRUPT);
      }
      CHECK_INT(mo_unpack_losses(key, 3, bytes, size - 4, n, back, back_steps), MO_ERR_CORRUPT);
      CHECK_INT(mo_unpack_losses(key, 3, NULL, size, n, back, back_steps), MO_ERR_CORRUPT);
    }
}

/* ---- classes ---- */

static struct mo_work *load(int64_t id, int64_t fingerprint)
{
  struct mo_work *work = NULL;
  CHECK_OK(mo_store_load_work(store, id, fixture_classes(fingerprint), &work));
  return work;
}

static int save_one(const struct mo_work *work, const uint32_t *places, uint32_t n, double loss)
{
  struct mo_saved_block block;
  struct mo_save save = {.blocks = &block};
  for (uint32_t i = 0; i < n; i++)
    fixture_loss(&save, work, 0, places[i], work->fingerprint, loss + places[i], 0);
  return save_and_wait(&save);
}

static uint32_t known_of(const struct mo_work *work, struct mo_score scores[MO_PAPER_TEST_COUNT])
{
  const struct mo_saved_design design = {.genotype = work->genotype_rows[0],
                                         .controller = work->controller,
                                         .physics = work->physics_rows[0],
                                         .fingerprint = work->fingerprint};
  uint32_t n = 0;
  CHECK_OK(mo_store_scores(store, &design, work->environment_rows, MO_PAPER_TEST_COUNT, scores));
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
    n += scores[k].known;
  return n;
}

/* Losses are found by environment, no matter what was computed along with them. Losses of another
 * class are not found; the losses computed first stay. */
static void finds_by_environment_and_class(void)
{
  static const uint32_t first[] = {0, 2, 4}, second[] = {4, 3, 9};
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  struct mo_score scores[MO_PAPER_TEST_COUNT];
  int64_t id, one = 0, two = 0;
  id = submit_evaluation(&submission);
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  REQUIRE_OK(mo_store_fingerprint(store, "two", &two));
  struct mo_work *work = load(id, one);
  struct mo_work *other = load(id, two);
  REQUIRE(work != NULL && other != NULL);
  CHECK_OK(save_one(work, first, 3, 0.5));
  CHECK_OK(save_one(work, second, 3, 0.75)); /* loss 4 is already known */
  CHECK_OK(save_one(work, first, 3, 0.25));  /* the same losses */
  CHECK_INT(known_of(work, scores), 5);
  CHECK(scores[0].loss == 0.5 && scores[2].loss == 2.5 && scores[4].loss == 4.5);
  CHECK(scores[3].loss == 3.75 && scores[9].loss == 9.75 && !scores[1].known);
  CHECK_INT(known_of(other, scores), 0);
  CHECK_OK(save_one(other, second, 2, 0.125));
  CHECK_INT(known_of(other, scores), 2);
  CHECK(scores[4].loss == 4.125 && scores[3].loss == 3.125);
  CHECK_INT(known_of(work, scores), 5);
  CHECK(scores[4].loss == 4.5);
  CHECK_INT(outside_integer("SELECT count(*) FROM scores"), 3);
  mo_work_free(work);
  mo_work_free(other);
}

/* A recording job that continues with other code restarts from the beginning, and says so. */
static void goes_on_in_a_new_class(void)
{
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  double com_m[9] = {0};
  struct mo_saved_trajectory trajectory = {
      .frames = 3, .n_masses = 8, .recording = {.stride = 10, .com_m = com_m}};
  struct mo_job_update update = {.step = MO_STEP_START};
  struct mo_save save = {.updates = &update, .n_updates = 1};
  struct mo_event events[8];
  struct mo_work *work;
  int64_t id, classes[2] = {0, 0}, n;
  submission.record = MO_RECORD_COM;
  id = submit_evaluation(&submission);
  REQUIRE_OK(mo_store_fingerprint(store, "one", &classes[0]));
  REQUIRE_OK(mo_store_fingerprint(store, "two", &classes[1]));
  update.job = trajectory.job = id;
  for (int round = 0; round < 3; round++) { /* nothing changes in the second one */
    const int64_t now = classes[round == 2];
    work = load(id, now);
    REQUIRE(work != NULL);
    CHECK_INT(work->fingerprint, now);
    CHECK_INT(work->n_finished, round == 1 ? 1 : 0);
    mo_work_free(work);
    update.fingerprint = update.workers = now;
    CHECK_OK(save_and_wait(&save));
    CHECK(update.applied);
    CHECK_INT(outside_integer("SELECT count(*) FROM trajectories"), round == 1);
    save.trajectories = &trajectory;
    save.n_trajectories = round == 0;
    save.n_updates = 0;
    CHECK_OK(save_and_wait(&save));
    save.n_updates = 1;
    save.n_trajectories = 0;
  }
  n = mo_store_events(store, 0, id, events, 8, NULL, NULL);
  REQUIRE(n == 5); /* created, three starts, and the change before the last of them */
  CHECK_TEXT(events[3].type, "evaluation.code_changed");
  CHECK_HAS(events[3].data, "\"before\":\"one\",\"fingerprint\":\"two\"");
}

/* ---- damage ---- */

static void count_finding(void *context, const char *finding)
{
  (void)finding;
  (*(int *)context)++;
}

static uint8_t *read_file(const char *path, size_t *size)
{
  struct stat status = {.st_size = 0};
  FILE *file = fopen(path, "r");
  make_check(stat(path, &status), path);
  *size = (size_t)status.st_size;
  uint8_t *bytes = make_zeros(*size, 1);
  CHECK(file != NULL && fread(bytes, 1, *size, file) == *size && fclose(file) == 0);
  return bytes;
}

/* Returns whether the results equal the stored losses. */
static bool is_the_truth(const struct mo_evaluation_results *results)
{
  bool same = results->n_designs == DESIGNS && results->n_environments == MO_PAPER_TEST_COUNT &&
              SAME(results->forms, forms, DESIGNS) && SAME(results->genotypes, genotypes, DESIGNS);
  for (uint32_t i = 0; same && i < DESIGNS * MO_PAPER_TEST_COUNT; i++) {
    const double loss = lively_loss(i / MO_PAPER_TEST_COUNT, i % MO_PAPER_TEST_COUNT);
    same = memcmp(&results->losses[i], &loss, 8) == 0 &&
           results->diverged_steps[i] == (isinf(loss) ? 17 : 0);
  }
  return same;
}

/* Returns where rows of scores and bodies are in the database file: an offset inside or next to
 * one. */
static size_t place_of(const uint8_t *bytes, size_t size, uint32_t n, uint64_t random)
{
  uint8_t pattern[MO_BITS_BYTES];
  const bool is_loss = random % 2 == 0;
  const size_t length = is_loss ? 16 : MO_BITS_BYTES, extent = is_loss ? 100 : MO_BITS_BYTES;
  if (is_loss)
    memcpy(pattern, (double[]){lively_loss(n, 0), lively_loss(n, 1)}, 16);
  else
    mo_encode_genotype(genotypes[n].words, pattern);
  const uint8_t *at = memmem(bytes, size, pattern, length);
  return at == NULL ? 4096 : (size_t)(at - bytes) - 12 + (size_t)(random >> 8) % (extent + 12);
}

/* Flips a single bit of the database, mostly in or near a score or a body. Results must be correct
 * or refused. `store check` must find the damage that results do not reveal. */
static void serves_no_flipped_bit(void)
{
  struct mo_evaluation_request submission = draw_evaluation(9, DESIGNS);
  size_t size = 0;
  uint64_t random = 1;
  int refused = 0, found = 0, harmless = 0;
  int64_t id = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(id, lively_loss));
  close_store();
  uint8_t *bytes = read_file(path_of("morphod.db"), &size);
  for (int i = 0; i < FLIPS; i++) {
    struct mo_evaluation_results *results = NULL;
    struct mo_check_counts counts = {0};
    int findings = 0, error;
    random = random * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    size_t bit =
        i % 4 == 0
            ? 8 * 4096 + (size_t)(random >> 20) % (8 * (size - 4096)) /* outside the schema */
            : 8 * place_of(bytes, size, (uint32_t)i % DESIGNS, random >> 24) + (random >> 20) % 8;
    const uint8_t flipped = bytes[bit / 8] ^ (uint8_t)(1 << bit % 8);
    REQUIRE_OK(overwrite(path_of("morphod.db"), (long)(bit / 8), &flipped, 1));
    error = reopen();
    if (error == MO_OK) {
      error = mo_store_results(store, id, &results);
      if (error == MO_OK) {
        const bool is_true = is_the_truth(results);
        CHECK(is_true);
        if (!is_true)
          printf("# bit %zu is served\n", bit);
        mo_evaluation_results_free(results);
        if (check_whole() != MO_OK ||
            mo_store_check_contents(store, count_finding, &findings, &counts) != MO_OK ||
            findings > 0)
          found++;
        else
          harmless++;
      } else {
        refused++;
      }
      close_store();
    } else {
      refused++;
    }
    REQUIRE(truncate(path_of("morphod.db"), (off_t)size) == 0);
    REQUIRE_OK(overwrite(path_of("morphod.db"), 0, bytes, size));
  }
  printf("# %d bits: %d refused, %d found by the check, %d never read\n", FLIPS, refused, found,
         harmless);
  CHECK(refused + found > 10);
}

/* What the check counts in an intact store, and what it reports for damage. */
static void checks_contents(void)
{
  static const char *const damage[] = {
      "UPDATE scores SET losses=CAST(zeroblob(8)||substr(losses,9) AS BLOB) WHERE genotype=2",
      "UPDATE scores SET genotype=genotype+100 WHERE genotype=2",
      "UPDATE scores SET computed_us=computed_us+1 WHERE genotype=2",
      "UPDATE conditions SET fingerprint=(SELECT max(id) FROM fingerprints)",
      "UPDATE condition_environments SET environment=1+environment%2 WHERE position=4",
      "DELETE FROM condition_environments WHERE position=9",
      "UPDATE set_scores SET score=score/2 WHERE genotype=3",
      "UPDATE genotypes SET bits=CAST(substr(bits,1,17)||x'7f' AS BLOB) WHERE id=5",
      "UPDATE environments SET data=zeroblob(528) WHERE id=3",
      "UPDATE physics SET sha256=zeroblob(32)",
      "UPDATE jobs SET state=9",
  };
  for (size_t i = 0; i <= COUNT(damage); i++) {
    const bool is_sound = i == COUNT(damage);
    struct mo_evaluation_request submission = draw_evaluation(9, DESIGNS);
    struct mo_check_counts counts;
    struct mo_score_sample samples[4];
    int64_t id, other;
    int findings = 0;
    id = submit_evaluation(&submission);
    REQUIRE_OK(run_by_hand(id, lively_loss));
    REQUIRE_OK(mo_store_fingerprint(store, "another", &other));
    CHECK_INT(mo_store_sample(store, "by hand", 12345, samples, 4), 4);
    for (int k = 0; k < 4; k++) {
      uint32_t n = 0;
      while (n < DESIGNS &&
             memcmp(samples[k].genotype.words, &genotypes[n], sizeof(*genotypes)) != 0)
        n++;
      CHECK(n < DESIGNS);
      CHECK_INT(samples[k].diverged_step, isinf(samples[k].loss) ? 17 : 0);
    }
    CHECK_INT(mo_store_sample(store, "another", 12345, samples, 4), 0);
    close_store();
    if (!is_sound)
      CHECK_INT(outside(damage[i]), SQLITE_OK);
    REQUIRE_OK(reopen());
    CHECK_OK(mo_store_check_contents(store, count_finding, &findings, &counts));
    CHECK_INT(counts.findings, findings);
    CHECK_INT(counts.files, 1);
    CHECK(is_sound ? findings == 0 && counts.rows > 2 * DESIGNS : findings > 0);
    if (!is_sound && findings == 0)
      printf("# not found: %s\n", damage[i]);
    start_over();
  }
}

/* ---- origins ---- */

/* Saves the losses of a run of the only design, as computed by an origin. */
static int save_run(const struct mo_work *work, uint32_t run, int64_t origin)
{
  struct mo_saved_block block;
  struct mo_save save = {.blocks = &block};
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
    fixture_loss(&save, work, run, k, work->fingerprint, 0.5 + 0.1 * k, 0);
  block.condition.physics = work->physics_rows[run];
  block.origin = origin;
  return save_and_wait(&save);
}

/* The errors of scores depend on the losses of all runs: where one of them is replaced, the ETag of
 * the job changes, but not where a job does not depend on it. */
static void replaces_losses_of_every_run(void)
{
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  int64_t one = 0, origin = 0;
  const int64_t plain = submit_evaluation(&submission);
  submission.n_displaced = MO_ERROR_DISPLACED;
  const int64_t id = submit_evaluation(&submission);
  REQUIRE(plain > 0 && id > 0);
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  REQUIRE_OK(mo_store_origin(store, "someone@host", &origin));
  struct mo_work *work = load(id, one);
  REQUIRE(work != NULL && work->n_runs == 2 + MO_ERROR_DISPLACED);
  for (uint32_t run = 0; run < work->n_runs; run++) {
    struct mo_origin_row rows[8];
    struct mo_origin_place place = {0, 0};
    const int64_t before = job_of(id).version, of_plain = job_of(plain).version;
    bool is_last;
    REQUIRE_OK(save_run(work, run, origin));
    REQUIRE(mo_store_origin_rows(store, "someone@host", &place, rows, 8, &is_last) == 1);
    rows[0].again = rows[0].stored;
    rows[0].again.losses[3] += 0.25;
    rows[0].differs = true;
    REQUIRE_OK(mo_store_origin_replace(store, rows, 1)); /* it is no longer the origin's */
    CHECK(job_of(id).version > before);
    CHECK((job_of(plain).version > of_plain) == (run == 0));
  }
  mo_work_free(work);
}

static const struct check_case cases[] = {
    {"packs losses with a checksum", packs_losses},
    {"finds losses by environment and class", finds_by_environment_and_class},
    {"continues in a new class", goes_on_in_a_new_class},
    {"never serves a flipped bit", serves_no_flipped_bit},
    {"replaces losses of every run", replaces_losses_of_every_run},
    {"checks contents", checks_contents},
};
CHECK_MAIN_AROUND(cases, with_a_store)
