/* measures.c: stored measures: packed, found by environment, added to stored losses, and refused
 * where a bit has changed. */
#include "store/measures.h"

#include "by_hand.h"
#include "one_store.h"
#include "store/check.h"
#include "store/origins.h"
#include "store/scores.h"

/* A value that each kernel could give: a whole number of steps. */
static double lively_measure(uint32_t k, unsigned m)
{
  const double steps = mo_measure_info[m].steps_in_one;
  return m % 7 == 5 && k % 3 == 1 ? (double)NAN : rint((0.37 * (m + 1) - 0.11 * k) * steps) / steps;
}

static void fill(double (*values)[MO_MEASURES], uint32_t n, uint32_t first)
{
  for (uint32_t k = 0; k < n; k++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      values[k][m] = lively_measure(first + k, m);
}

static bool are_equal(const double *a, const double *b)
{
  bool equal = true;
  for (unsigned m = 0; m < MO_MEASURES; m++)
    equal = equal && ((isnan(a[m]) && isnan(b[m])) || mo_same_bits(a[m], b[m]));
  return equal;
}

static const double (*constant(double (*values)[MO_MEASURES]))[MO_MEASURES]
{
  return (const double(*)[MO_MEASURES])values;
}

/* ---- packed ---- */

static void packs_measures(void)
{
  const int64_t key[] = {7, 8, 9};
  double values[MO_BLOCK_LANES][MO_MEASURES], back[MO_BLOCK_LANES][MO_MEASURES];
  uint8_t bytes[MO_PACKED_MEASURES_BYTES(MO_BLOCK_LANES)];
  for (uint32_t n = 1; n <= MO_BLOCK_LANES; n += 5)
    for (int kind = 0; kind < 4; kind++) {
      uint32_t n_measures = 0;
      fill(values, n, 0);
      if (kind == 1)
        values[n - 1][MO_MEASURE_COST_OF_TRANSPORT] = 3e5; /* more steps than 32 bits hold */
      if (kind == 2)
        values[n - 1][MO_MEASURE_TILT] = 1e-7; /* less than a step */
      if (kind == 3)
        values[n - 1][MO_MEASURE_TILT] = -0.0;
      const size_t size = mo_pack_measures(key, 3, constant(values), n, bytes);
      CHECK_INT(size, (kind == 0 ? 4 : 8) * MO_MEASURES * n + 12);
      CHECK_OK(mo_unpack_measures(key, 3, bytes, size, n, back, &n_measures));
      CHECK_INT(n_measures, MO_MEASURES);
      for (uint32_t k = 0; k < n; k++)
        CHECK(are_equal(values[k], back[k]));
      for (size_t bit = 0; bit < 8 * size; bit += n == 1 ? 1 : 97) {
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
        CHECK_INT(mo_unpack_measures(key, 3, bytes, size, n, back, &n_measures), MO_ERR_CORRUPT);
        bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
      }
      for (int i = 0; i < 3; i++) {
        int64_t other[] = {7, 8, 9};
        other[i] ^= 1;
        CHECK_INT(mo_unpack_measures(other, 3, bytes, size, n, back, &n_measures), MO_ERR_CORRUPT);
      }
      CHECK_INT(mo_unpack_measures(key, 3, bytes, size - 4, n, back, &n_measures), MO_ERR_CORRUPT);
      CHECK_INT(mo_unpack_measures(key, 3, bytes, 8, n, back, &n_measures), MO_ERR_CORRUPT);
      CHECK_INT(mo_unpack_measures(key, 3, NULL, size, n, back, &n_measures), MO_ERR_CORRUPT);
    }
}

/* A row of a version that knew fewer measures, or more. */
static void reads_other_numbers_of_measures(void)
{
  const int64_t key[] = {7};
  for (uint32_t n = MO_MEASURES - 2; n <= MO_MEASURES + 1; n++) {
    double values[2][MO_MEASURES];
    uint8_t bytes[12 + 4 * 2 * (MO_MEASURES + 1)];
    uint32_t n_measures = 0;
    size_t size = 4;
    memcpy(bytes, &n, 4);
    for (uint32_t i = 0; i < 2 * n; i++, size += 4) {
      const int32_t steps = (int32_t)i + 1;
      memcpy(bytes + size, &steps, 4);
    }
    const uint64_t sum = mo_row_checksum(key, 1, bytes, size);
    memcpy(bytes + size, &sum, 8);
    CHECK_OK(mo_unpack_measures(key, 1, bytes, size + 8, 2, values, &n_measures));
    CHECK_INT(n_measures, n < MO_MEASURES ? n : MO_MEASURES);
    CHECK(values[0][0] == 1e-6 && values[1][0] == (n + 1) / 1e6);
    CHECK(isnan(values[1][MO_MEASURES - 1]) == (n < MO_MEASURES));
  }
}

/* ---- stored ---- */

static struct mo_work *load(int64_t id, int64_t fingerprint)
{
  struct mo_work *work = NULL;
  CHECK_OK(mo_store_load_work(store, id, fixture_classes(fingerprint), &work));
  return work;
}

/* Saves losses of design 0 at places, with measures or without, of an origin (0: this host). */
static int save_block_of(const struct mo_work *work, const uint32_t *places, uint32_t n,
                         bool measured, int64_t origin)
{
  double values[MO_BLOCK_LANES][MO_MEASURES];
  struct mo_saved_block block = {.genotype = 0};
  struct mo_save save = {.blocks = &block};
  for (uint32_t i = 0; i < n; i++) {
    fixture_loss(&save, work, 0, places[i], work->fingerprint, 0.5 + places[i], 0);
    fill(&values[i], 1, places[i]);
  }
  block.measures = measured ? values : NULL;
  block.origin = origin;
  return save_and_wait(&save);
}

static int save_block(const struct mo_work *work, const uint32_t *places, uint32_t n, bool measured)
{
  return save_block_of(work, places, n, measured, 0);
}

static struct mo_saved_design design_of(const struct mo_work *work)
{
  return (struct mo_saved_design){.genotype = work->genotype_rows[0],
                                  .controller = work->controller,
                                  .physics = work->physics_rows[0],
                                  .fingerprint = work->fingerprint};
}

static uint64_t measured_places(const struct mo_work *work)
{
  const struct mo_saved_design design = design_of(work);
  uint64_t known = 0;
  CHECK_OK(mo_store_measured(store, &design, work->environment_rows, MO_PAPER_TEST_COUNT,
                             MO_MEASURES_ALL, &known));
  return known;
}

/* Losses without measures stay as they are when measures are added, and count once. */
static void adds_measures_to_losses(void)
{
  static const uint32_t first[] = {0, 2, 4}, second[] = {4, 0}, third[] = {4, 7, 9};
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  submission.measures = 1U << MO_MEASURE_WORK | 1U << MO_MEASURE_AIR_SHARE;
  const int64_t id = submit_evaluation(&submission);
  struct mo_evaluation_results *results = NULL;
  int64_t one = 0, two = 0;
  REQUIRE(id > 0);
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  REQUIRE_OK(mo_store_fingerprint(store, "two", &two));
  struct mo_work *work = load(id, one), *other = load(id, two);
  REQUIRE(work != NULL && other != NULL);
  CHECK_INT(work->job.measures, submission.measures);
  CHECK_OK(save_block(work, first, 3, false));
  CHECK_INT(measured_places(work), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM measures"), 0);
  CHECK_OK(save_block(work, second, 2, true)); /* both losses are known */
  CHECK_INT(measured_places(work), 1 << 0 | 1 << 4);
  CHECK_INT(outside_integer("SELECT count(*) FROM scores"), 1);
  CHECK_OK(save_block(work, third, 3, true)); /* one of them is */
  CHECK_OK(save_block(work, third, 3, true)); /* again */
  CHECK_INT(measured_places(work), 1 << 0 | 1 << 4 | 1 << 7 | 1 << 9);
  CHECK_INT(measured_places(other), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM scores"), 2);
  CHECK_INT(outside_integer("SELECT count(*) FROM measures"), 2);
  struct mo_job_update update = {
      .job = id, .step = MO_STEP_START, .fingerprint = one, .workers = one};
  REQUIRE_OK(save_and_wait(&(struct mo_save){.updates = &update, .n_updates = 1}));
  REQUIRE_OK(mo_store_results(store, id, &results));
  CHECK_INT(results->n_measures, 2);
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
    const double *values = &results->measures[2 * (size_t)k];
    if (k == 0 || k == 4 || k == 7 || k == 9)
      CHECK(mo_same_bits(values[0], lively_measure(k, MO_MEASURE_AIR_SHARE)) &&
            mo_same_bits(values[1], lively_measure(k, MO_MEASURE_WORK)) &&
            results->flags[k] == (MO_FLAG_OVERSTRAINED | (k % 3 == 1 ? 0 : MO_FLAG_INVERTED)));
    else
      CHECK(isnan(values[0]) && isnan(values[1]) && results->flags[k] == 0);
  }
  mo_evaluation_results_free(results);
  mo_work_free(work);
  mo_work_free(other);
}

/* A damaged row is an error of every reader, and a finding of the check. */
static void report(void *context, const char *finding)
{
  (void)context;
  CHECK(strstr(finding, "measures are damaged") != NULL);
}

static void refuses_damaged_measures(void)
{
  static const uint32_t places[] = {1, 2};
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  const int64_t id = submit_evaluation(&submission);
  struct mo_check_counts counts;
  int64_t one = 0;
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  struct mo_work *work = load(id, one);
  REQUIRE(work != NULL);
  REQUIRE_OK(save_block(work, places, 2, true));
  REQUIRE_OK(mo_store_check_contents(store, report, NULL, &counts));
  CHECK_INT(counts.findings, 0);
  REQUIRE_OK(reopen_after(
      "UPDATE measures SET packed=CAST(substr(packed,1,8)||x'01'||substr(packed,10) AS BLOB)"));
  const struct mo_saved_design design = design_of(work);
  uint64_t known = 0;
  CHECK_INT(mo_store_measured(store, &design, work->environment_rows, MO_PAPER_TEST_COUNT,
                              MO_MEASURES_ALL, &known),
            MO_ERR_CORRUPT);
  REQUIRE_OK(mo_store_check_contents(store, report, NULL, &counts));
  CHECK_INT(counts.findings, 1);
  mo_work_free(work);
}

/* ---- of an origin ---- */

/* Reads the first row of an origin. */
static bool row_of(const char *origin, struct mo_origin_row *row)
{
  struct mo_origin_place place = {0, 0};
  bool is_last;
  return mo_store_origin_rows(store, origin, &place, row, 1, &is_last) == 1;
}

/* Losses and measures of the same rollouts may have two origins. Only measures that differ are
 * replaced, and those that have changed in the meantime stay. */
static void replaces_measures_of_an_origin(void)
{
  static const uint32_t places[] = {3, 5};
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  const int64_t id = submit_evaluation(&submission);
  struct mo_origin_row *row = make_zeros(2, sizeof(*row));
  int64_t one = 0, a = 0, b = 0;
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  REQUIRE_OK(mo_store_origin(store, "a@host", &a));
  REQUIRE_OK(mo_store_origin(store, "b@host", &b));
  struct mo_work *work = load(id, one);
  REQUIRE(work != NULL);
  REQUIRE_OK(save_block_of(work, places, 2, false, a));
  REQUIRE(row_of("a@host", row) && row->has_losses && !row->has_measures && row->n == 2);
  CHECK(!row_of("b@host", row));
  REQUIRE_OK(save_block_of(work, places, 2, true, b));
  REQUIRE(row_of("a@host", row) && row->has_losses && !row->has_measures);
  REQUIRE(row_of("b@host", row) && !row->has_losses && row->has_measures);
  CHECK_INT(row->n_measures, MO_MEASURES);
  for (uint32_t k = 0; k < 2; k++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      CHECK(mo_measure_equal(row->stored_measures.values[k][m], lively_measure(places[k], m)));
  const int64_t before = job_of(id).version;
  row->again_measures = row->stored_measures;
  row->again_measures.values[1][MO_MEASURE_WORK] += 1;
  row->measures_differ = true;
  row[1] = row[0];
  row[1].stored_measures.values[0][0] += 1; /* no longer what is stored */
  REQUIRE_OK(mo_store_origin_replace(store, &row[1], 1));
  REQUIRE(row_of("b@host", &row[1]));
  REQUIRE_OK(mo_store_origin_replace(store, row, 1));
  CHECK(job_of(id).version > before);
  CHECK(!row_of("b@host", &row[1]));
  REQUIRE(row_of("a@host", row) && row->has_losses); /* which stay */
  const struct mo_saved_design design = design_of(work);
  double values[MO_PAPER_TEST_COUNT][MO_MEASURES];
  uint64_t known = 0;
  REQUIRE_OK(mo_measures_read(&store->writer, &design, work->environment_rows, MO_PAPER_TEST_COUNT,
                              MO_MEASURES_ALL, values, &known));
  CHECK(known == (1 << 3 | 1 << 5));
  CHECK(values[5][MO_MEASURE_WORK] == lively_measure(5, MO_MEASURE_WORK) + 1);
  CHECK(mo_measure_equal(values[3][MO_MEASURE_WORK], lively_measure(3, MO_MEASURE_WORK)));
  mo_work_free(work);
}

/* A row from before version 22 has no origin, and its checksum does not include one. */
static void measures_without_an_origin_are_of_all(void)
{
  static const uint32_t places[] = {3};
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  const int64_t id = submit_evaluation(&submission);
  struct mo_origin_row *row = make_zeros(1, sizeof(*row));
  double values[1][MO_MEASURES];
  uint8_t bytes[MO_PACKED_MEASURES_BYTES(1)];
  char sql[2 * sizeof(bytes) + 64] = "UPDATE measures SET origin=NULL,packed=x'";
  int64_t one = 0, origin = 0;
  REQUIRE_OK(mo_store_fingerprint(store, "one", &one));
  REQUIRE_OK(mo_store_origin(store, "a@host", &origin));
  struct mo_work *work = load(id, one);
  REQUIRE(work != NULL);
  REQUIRE_OK(save_block(work, places, 1, true));
  CHECK(!row_of("a@host", row));
  close_store();
  const int64_t key[] = {work->genotype_rows[0],
                         work->controller,
                         work->physics_rows[0],
                         one,
                         outside_integer("SELECT computed_us FROM measures"),
                         work->environment_rows[3]};
  fill(values, 1, 3);
  const size_t size = mo_pack_measures(key, 6, constant(values), 1, bytes);
  for (size_t i = 0; i < size; i++)
    snprintf(sql + strlen(sql), 3, "%02x", bytes[i]);
  strcat(sql, "'");
  REQUIRE(outside(sql) == SQLITE_OK);
  REQUIRE_OK(reopen());
  REQUIRE(row_of("a@host", row) && row->has_measures && !row->has_losses);
  row->again_measures = row->stored_measures;
  row->again_measures.values[0][0] += 1;
  row->measures_differ = true;
  REQUIRE_OK(mo_store_origin_replace(store, row, 1));
  CHECK(!row_of("a@host", row)); /* it is this host's now */
  mo_work_free(work);
}

static const struct check_case cases[] = {
    {"packs measures with a checksum", packs_measures},
    {"reads rows with fewer and more measures", reads_other_numbers_of_measures},
    {"adds measures to stored losses", adds_measures_to_losses},
    {"refuses damaged measures", refuses_damaged_measures},
    {"replaces measures of an origin", replaces_measures_of_an_origin},
    {"measures without an origin are everyone's", measures_without_an_origin_are_of_all},
};
CHECK_MAIN_AROUND(cases, with_a_store)
