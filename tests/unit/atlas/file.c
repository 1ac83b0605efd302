/* file.c: atlas files: what was written is read, and anything else is refused. */
#include "../image.h"
#include "fixture.h"

#include "atlas/file.h"
#include "atlas/losses.h"
#include "world/environment.h"

#include <fcntl.h>
#include <sys/stat.h>

static void content(void)
{
  const struct mo_atlas_source source = fixture_source(6);
  const struct mo_atlas *atlas = fixture_atlas(&source, 1000);
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS] = {0}, read[MO_DEFAULT_WORDS], moved[MO_DEFAULT_WORDS];
  uint64_t position = 0, first = 0;
  REQUIRE_OK(mo_atlas_bodies_create(&source.scope, &bodies));
  for (uint64_t i = 0; mo_atlas_bodies_next(bodies, form) == MO_OK; i++) {
    float losses[MO_PAPER_TEST_COUNT];
    double sum = 0;
    REQUIRE_OK(mo_atlas_find(atlas, form, &position));
    CHECK_INT(position, i);
    CHECK_INT(mo_atlas_form(atlas, i, read), mo_genotype_count(source.scope.workspace, form));
    CHECK(SAME(read, form, MO_DEFAULT_WORDS));
    mo_atlas_losses(atlas, i, losses);
    for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++) {
      const double loss = fixture_loss(form, e, 1000);
      CHECK_NEAR(losses[e], loss, loss / 2048);
      sum += loss;
    }
    CHECK(mo_atlas_score(atlas, i) == (float)(sum / MO_PAPER_TEST_COUNT));
    for (unsigned k = 0; k < MO_ORIENTATIONS; k++)
      if (make_image(source.scope.workspace, form, k, moved) == MO_OK) {
        mo_genotype_place(source.scope.workspace, moved);
        CHECK_OK(mo_atlas_find(atlas, moved, &position));
        CHECK_INT(position, i);
      }
  }
  mo_atlas_bodies_free(bodies);
  CHECK_INT(mo_atlas_bodies_of(atlas), 654);
  CHECK_INT(mo_atlas_size(atlas, 5, &first), 95);
  CHECK_INT(first, 29);
  CHECK_INT(mo_atlas_size(atlas, 7, NULL), 0);
  CHECK_INT(mo_atlas_size(atlas, 0, &first), 0);
  const uint64_t seven[MO_DEFAULT_WORDS] = {0x111111f}, none[MO_DEFAULT_WORDS] = {0};
  const uint64_t apart[MO_DEFAULT_WORDS] = {5};
  CHECK_INT(mo_atlas_find(atlas, seven, &position), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_atlas_find(atlas, none, &position), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_atlas_find(atlas, apart, &position), MO_ERR_NOT_FOUND);
}

/* Several blocks of one size; 32 bytes a body. */
static void blocks(void)
{
  const struct mo_atlas_source source = fixture_source(8);
  const struct mo_atlas *atlas = fixture_atlas(&source, 1000);
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS] = {0}, position = 0, i = 0;
  size_t wrong = 0;
  REQUIRE_OK(mo_atlas_bodies_create(&source.scope, &bodies));
  for (; mo_atlas_bodies_next(bodies, form) == MO_OK; i++)
    wrong += mo_atlas_find(atlas, form, &position) != MO_OK || position != i;
  mo_atlas_bodies_free(bodies);
  CHECK_INT(wrong, 0);
  CHECK_INT(i, 24135);
  CHECK_INT(atlas->layout.blocks[8] - atlas->layout.blocks[7], 5);
  const uint64_t block_bytes = atlas->bytes - atlas->layout.begins[0];
  CHECK((double)block_bytes / (double)i < 32.03); /* 32, and 32 for each block */
}

#define SOME (1U << MO_MEASURE_MEAN_SPEED | 1U << MO_MEASURE_WORK)

/* Measures, over several blocks, and percentiles, compared with plain counting. */
static void measures(void)
{
  struct mo_atlas_source source = fixture_source(7);
  source.measures = SOME;
  const struct mo_atlas *atlas = fixture_atlas(&source, 50);
  const uint64_t n = mo_atlas_bodies_of(atlas);
  uint64_t form[MO_DEFAULT_WORDS] = {0}, first = 0, n_known = 0;
  CHECK_INT(mo_atlas_source_of(atlas)->measures, SOME);
  for (uint64_t i = 0; i < n; i++) {
    (void)mo_atlas_form(atlas, i, form);
    const float speed = mo_atlas_measure(atlas, i, MO_MEASURE_MEAN_SPEED);
    const float work = mo_atlas_measure(atlas, i, MO_MEASURE_WORK);
    const float expected[] = {(float)fixture_measure(form, 0, 50),
                              (float)fixture_measure(form, 1, 50)};
    CHECK(isnan(expected[0]) ? isnan(speed) : speed == expected[0]);
    CHECK(isnan(expected[1]) ? isnan(work) : work == expected[1]);
    CHECK(isnan(mo_atlas_measure(atlas, i, MO_MEASURE_TILT)));
    n_known += !isnan(work);
  }
  CHECK(n_known > n / 2 && n_known < n);
  for (uint64_t i = 1; i < n; i += 97) {
    const float own = mo_atlas_measure(atlas, i, MO_MEASURE_WORK);
    const uint64_t of = mo_atlas_size(atlas, mo_atlas_form(atlas, i, form), &first);
    double lower = 0, equal = 0, others = 0;
    for (uint64_t k = first; k < first + of; k++) {
      const float value = mo_atlas_measure(atlas, k, MO_MEASURE_WORK);
      lower += value < own;
      equal += k != i && value == own;
      others += k != i && !isnan(value);
    }
    const double found = mo_atlas_measure_percentile(atlas, i, MO_MEASURE_WORK);
    if (isnan(own))
      CHECK(isnan(found));
    else
      CHECK_NEAR(found, others > 0 ? 100 * (lower + equal / 2) / others : 100, 1e-12);
  }
  CHECK(isnan(mo_atlas_measure_percentile(atlas, 1, MO_MEASURE_TILT)));
}

/* Sorted by a measure: both ways, and those without a value last. */
static void order_of_measures(void)
{
  struct mo_atlas_source source = fixture_source(5);
  source.measures = SOME;
  const struct mo_atlas *atlas = fixture_atlas(&source, 20);
  const uint64_t n = mo_atlas_bodies_of(atlas);
  struct mo_atlas_index *index = NULL;
  CHECK_INT(mo_atlas_index_create_by(atlas, MO_MEASURE_TILT, false, &index), MO_ERR_NOT_FOUND);
  for (int is_negative = 0; is_negative < 2; is_negative++) {
    const float edges[] = {-INFINITY, 0, INFINITY};
    uint64_t counts[2] = {0}, n_known = 0;
    REQUIRE_OK(mo_atlas_index_create_by(atlas, MO_MEASURE_MEAN_SPEED, is_negative != 0, &index));
    for (uint64_t i = 0; i < n; i++) {
      const uint64_t at = mo_atlas_nth(index, 0, i);
      const float value = mo_atlas_measure(atlas, at, MO_MEASURE_MEAN_SPEED);
      n_known += !isnan(value);
      if (i == 0)
        continue;
      const uint64_t last_at = mo_atlas_nth(index, 0, i - 1);
      const float last = mo_atlas_measure(atlas, last_at, MO_MEASURE_MEAN_SPEED);
      CHECK(isnan(last) ? isnan(value) && last_at < at
                        : isnan(value) || (is_negative != 0 ? last > value : last < value) ||
                              (last == value && last_at < at));
    }
    mo_atlas_histogram(index, 0, edges, 2, counts);
    CHECK_INT(counts[0] + counts[1], n_known);
    CHECK(counts[0] > 0 && counts[1] > 0 && n_known < n);
    mo_atlas_index_free(index);
  }
}

/* Files without measures do not change. */
static void first_version(void)
{
  static const char expected[] = "ffa48ebdd00c5ac367a0f09733524028ae9962bade47b3e5d536116585b9bef7";
  const struct mo_atlas_source source = fixture_source(4);
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_message message = {""};
  struct mo_sha256 hash;
  char path[FIXTURE_PATH];
  size_t size;
  snprintf(path, FIXTURE_PATH, "%s/a.atlas", fixture_folder());
  mo_environment_paper_test(environments);
  CHECK_OK(fixture_write(&mo_system_files, path, &source, environments, 2, 100, &message));
  const uint8_t *bytes = fixture_bytes(path, &size);
  mo_sha256_of(bytes, size, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash), expected);
}

static void environments(void)
{
  const double heights[] = {0.1, 0.2, 0.1, 0.3, 0.2, 0.1};
  struct mo_atlas_source source = fixture_source(3);
  struct mo_environment list[4] = {mo_environment_defaults, mo_environment_defaults};
  struct mo_message message = {""};
  char path[FIXTURE_PATH];
  uint32_t n = 0;
  source.orientations = MO_ATLAS_IMAGES;
  mo_environment_training(1, 2, 3, &list[0]);
  list[1].task.guide = (struct mo_guide){.kind = MO_GUIDE_AHEAD, .distance_m = 1.5};
  list[1].task.objective = MO_OBJECTIVE_TRAVEL;
  list[1].light_xy_m[0] = -0.0;
  list[2] = list[1];
  REQUIRE_OK(mo_terrain_grid_create(3, 2, 0.5, heights, &list[2].grid));
  list[3] = list[0];
  list[3].drop_m = 0.125;
  snprintf(path, sizeof(path), "%s/a.atlas", fixture_folder());
  CHECK_OK(fixture_write(&mo_system_files, path, &source, list, 4, 10, &message));
  CHECK_TEXT(message.text, "");
  const struct mo_atlas *atlas = fixture_open(path);
  const struct mo_environment *read = mo_atlas_environments(atlas, &n);
  REQUIRE(n == 4 && read[3].drop_m == 0.125);
  for (uint32_t i = 0; i < n; i++) {
    struct mo_sha256 expected, found;
    mo_environment_digest(&list[i], &expected);
    mo_environment_digest(&read[i], &found);
    CHECK(mo_sha256_equal(&expected, &found));
  }
  CHECK(read[2].grid != NULL && read[2].grid->columns == 3);
  const struct mo_atlas_source *found = mo_atlas_source_of(atlas);
  CHECK(mo_workspace_equal(found->scope.workspace, source.scope.workspace));
  CHECK_INT(found->scope.voxels_max, source.scope.voxels_max);
  CHECK_INT(found->orientations, MO_ATLAS_IMAGES);
  CHECK(SAME(found->controller_sha256, source.controller_sha256, 32));
  CHECK(SAME(found->physics_sha256, source.physics_sha256, 32));
  CHECK_TEXT(found->fingerprint, source.fingerprint);
  mo_environments_drop(list, 4);
}

/* ---- refusals ---- */

static void store(const char *path, const uint8_t *bytes, size_t size)
{
  FILE *file = fopen(path, "wb");
  REQUIRE(file != NULL);
  CHECK_INT(fwrite(bytes, 1, size, file), size);
  CHECK_OK(fclose(file));
}

/* Opens these bytes as a file, which must fail with a message that has these words. */
static void refuse(const char *path, const uint8_t *bytes, size_t size, int error,
                   const char *words)
{
  struct mo_atlas *atlas = NULL;
  struct mo_message message = {""};
  store(path, bytes, size);
  CHECK_INT(mo_atlas_open(path, &atlas, &message), error);
  CHECK_SAYS(message, words);
  CHECK(atlas == NULL);
  mo_atlas_close(atlas);
}

static uint8_t *small_file_with(uint32_t set, char path[FIXTURE_PATH], size_t *size)
{
  struct mo_atlas_source source = fixture_source(4);
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_message message = {""};
  source.measures = set;
  snprintf(path, FIXTURE_PATH, "%s/a.atlas", fixture_folder());
  mo_environment_paper_test(environments);
  make_check(fixture_write(&mo_system_files, path, &source, environments, 2, 100, &message),
             message.text);
  return fixture_bytes(path, size);
}

static uint8_t *small_file(char path[FIXTURE_PATH], size_t *size)
{
  return small_file_with(0, path, size);
}

static void damage(int set)
{
  char path[FIXTURE_PATH];
  size_t size;
  uint8_t *bytes = small_file_with((uint32_t)set, path, &size);
  REQUIRE(size > sizeof(struct mo_atlas_header));
  for (size_t at = 0; at < size;
       at += at < sizeof(struct mo_atlas_header) || at > size - 64 ? 1 : 7) {
    struct mo_atlas *atlas = NULL;
    struct mo_message message = {""};
    bytes[at] ^= 0x10;
    store(path, bytes, size);
    const int error = mo_atlas_open(path, &atlas, &message);
    CHECK_INT(error, at < 16 ? MO_ERR_FORMAT : at < 24 ? MO_ERR_UNSUPPORTED : MO_ERR_CORRUPT);
    CHECK_SAYS(message, ": "); /* what to do */
    CHECK(atlas == NULL);
    bytes[at] ^= 0x10;
  }
  for (size_t cut = 0; cut < size; cut += cut < 400 ? 13 : 101)
    refuse(path, bytes, cut, cut < 16 ? MO_ERR_FORMAT : MO_ERR_CORRUPT, ": ");
  uint8_t *longer = make_zeros(size + 1, 1);
  memcpy(longer, bytes, size);
  refuse(path, longer, size + 1, MO_ERR_CORRUPT, "should have");
  store(path, bytes, size);
  CHECK(fixture_open(path) != NULL);
}

/* Changes members of the header and fixes its checksum. */
static void header_that_lies(void)
{
  static const struct {
    size_t at;
    uint32_t value;
    int error;
    const char *words;
  } lies[] = {
      {offsetof(struct mo_atlas_header, version), 3, MO_ERR_UNSUPPORTED, "version 3"},
      {offsetof(struct mo_atlas_header, byte_order), 0x04030201, MO_ERR_UNSUPPORTED, "byte order"},
      {offsetof(struct mo_atlas_header, sides), 0, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, sides), 65542, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, voxels_max), 3, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, voxels_max), 11, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, orientations), 2, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, n_environments), 0, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, n_environments), 65, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, n_environments), 3, MO_ERR_CORRUPT, "should have"},
      {offsetof(struct mo_atlas_header, block_bodies), 4095, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, environments_bytes), 8, MO_ERR_CORRUPT, "should have"},
      {offsetof(struct mo_atlas_header, counts) + 24, 20, MO_ERR_CORRUPT, "should have"},
      {offsetof(struct mo_atlas_header, counts) + 4, 0x80000000, MO_ERR_CORRUPT, "header"},
      {offsetof(struct mo_atlas_header, environments), 1, MO_ERR_CORRUPT, "environments"},
  };
  char path[FIXTURE_PATH];
  size_t size;
  uint8_t *bytes = small_file(path, &size);
  for (size_t i = 0; i < COUNT(lies); i++) {
    struct mo_atlas_header header;
    memcpy(&header, bytes, sizeof(header));
    memcpy((uint8_t *)&header + lies[i].at, &lies[i].value, sizeof(lies[i].value));
    *mo_atlas_header_checksum(&header) = mo_atlas_header_hash(&header);
    uint8_t *changed = make_zeros(size, 1);
    memcpy(changed, bytes, size);
    memcpy(changed, &header, sizeof(header));
    refuse(path, changed, size, lies[i].error, lies[i].words);
  }
}

/* Changes one number of a file with measures, and fixes the checksums. */
static void measures_that_lie(void)
{
  static const struct {
    uint64_t set;
    uint32_t value;
    int error;
    const char *words;
  } lies[] = {{SOME, MO_ATLAS_NO_VALUE, MO_OK, ""},
              {SOME, 0xc0000000, MO_OK, ""},
              {SOME, 0x7fc00001, MO_ERR_CORRUPT, "damaged or unsorted"},
              {SOME, 0xffc00000, MO_ERR_CORRUPT, "damaged or unsorted"},
              {SOME, 0xff800000, MO_ERR_CORRUPT, "damaged or unsorted"},
              {0, 0, MO_ERR_CORRUPT, "header"},
              {1, 0, MO_ERR_CORRUPT, "should have"},
              {SOME | 1U << MO_MEASURES, 0, MO_ERR_UNSUPPORTED, "unknown measures"}};
  char path[FIXTURE_PATH];
  size_t size;
  uint8_t *bytes = small_file_with(SOME, path, &size);
  struct mo_atlas_layout layout;
  struct mo_atlas_header header;
  memcpy(&header, bytes, sizeof(header));
  CHECK(header.version == 2 && mo_atlas_header_bytes(&header) == 312);
  mo_atlas_layout_fill(&header, &layout);
  const struct mo_atlas_block block = mo_atlas_block_of(&layout, 3); /* 21 bodies of 4 voxels */
  uint8_t *const begin = bytes + block.begin;
  for (size_t i = 0; i < COUNT(lies); i++) {
    struct mo_atlas *atlas = NULL;
    header.end[0] = lies[i].set;
    *mo_atlas_header_checksum(&header) = mo_atlas_header_hash(&header);
    memcpy(bytes, &header, sizeof(header));
    memcpy(begin + mo_atlas_measures_at(&layout, block.n) + 4, &lies[i].value, 4);
    const uint64_t checksum = mo_form_hash(begin, mo_atlas_checksum_at(&layout, block.n));
    memcpy(begin + mo_atlas_checksum_at(&layout, block.n), &checksum, sizeof(checksum));
    if (lies[i].error != MO_OK) {
      refuse(path, bytes, size, lies[i].error, lies[i].words);
      continue;
    }
    store(path, bytes, size);
    CHECK_OK(mo_atlas_open(path, &atlas, NULL));
    mo_atlas_close(atlas);
  }
}

/* Two keys in the wrong order, and a score that is not a number, with a correct checksum. */
static void blocks_that_lie(void)
{
  char path[FIXTURE_PATH];
  size_t size;
  uint8_t *bytes = small_file(path, &size);
  struct mo_atlas_layout layout;
  struct mo_atlas_header header;
  memcpy(&header, bytes, sizeof(header));
  mo_atlas_layout_fill(&header, &layout);
  const struct mo_atlas_block block = mo_atlas_block_of(&layout, 3); /* 21 bodies of 4 voxels */
  REQUIRE(block.n == 21);
  uint8_t *const begin = bytes + block.begin;
  const size_t checked = mo_atlas_checksum_at(&layout, block.n);
  for (int lie = 0; lie < 5; lie++) {
    uint8_t *saved = make_zeros(block.bytes, 1);
    const float nan_score = NAN;
    const uint16_t nan_loss = 0x7c01;
    const uint64_t large = UINT64_MAX;
    uint64_t *keys = (uint64_t *)(void *)(begin + sizeof(struct mo_atlas_block_header));
    memcpy(saved, begin, block.bytes);
    if (lie == 0)
      keys[5] = keys[6];
    else if (lie == 1)
      memcpy(begin + mo_atlas_scores_at(block.n) + 12, &nan_score, sizeof(nan_score));
    else if (lie == 2)
      memcpy(begin + mo_atlas_losses_at(block.n) + 12, &nan_loss, sizeof(nan_loss));
    else if (lie == 3)
      memcpy(&keys[20], &large, sizeof(large));
    else
      begin[0]++; /* the number of voxels */
    const uint64_t checksum = mo_form_hash(begin, checked);
    memcpy(begin + checked, &checksum, sizeof(checksum));
    refuse(path, bytes, size, MO_ERR_CORRUPT, "damaged or unsorted");
    memcpy(begin, saved, block.bytes);
  }
}

static void other_files(void)
{
  const char *folder = fixture_folder();
  char path[FIXTURE_PATH];
  struct mo_atlas *atlas = NULL;
  struct mo_message message = {""};
  snprintf(path, sizeof(path), "%s/a", folder);
  CHECK_INT(mo_atlas_open(path, &atlas, &message), MO_ERR_NOT_FOUND);
  CHECK_SAYS(message, "No such file");
  CHECK_INT(mo_atlas_open(folder, &atlas, &message), MO_ERR_IO);
  CHECK_SAYS(message, "a directory");
  CHECK_OK(mkfifo(path, 0600));
  CHECK_INT(mo_atlas_open(path, &atlas, &message), MO_ERR_IO);
  CHECK_SAYS(message, "a pipe");
  CHECK_OK(unlink(path));
  CHECK_OK(symlink("nothing", path));
  CHECK_INT(mo_atlas_open(path, &atlas, &message), MO_ERR_IO);
  CHECK_SAYS(message, "a link to a file that does not exist");
}

/* A copy is mapped, so the file may become empty, which otherwise ends the process. */
static void file_that_changes(void)
{
  const struct mo_atlas_source source = fixture_source(6);
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas *atlas = NULL;
  const char *folder = fixture_folder();
  char path[FIXTURE_PATH];
  uint64_t form[MO_DEFAULT_WORDS], position = 0;
  uint8_t before[32], after[32];
  mo_environment_paper_test(environments);
  snprintf(path, sizeof(path), "%s/a.atlas", folder);
  REQUIRE_OK(fixture_write(&mo_system_files, path, &source, environments, 3, 1000, NULL));
  REQUIRE_OK(mo_atlas_open_copy(path, folder, &atlas, NULL));
  mo_atlas_hash(atlas, before);
  CHECK_OK(truncate(path, 0));
  mo_atlas_hash(atlas, after);
  CHECK(SAME(before, after, sizeof(before)));
  (void)mo_atlas_form(atlas, 500, form);
  CHECK_OK(mo_atlas_find(atlas, form, &position));
  CHECK_INT(position, 500);
  mo_atlas_close(atlas);
  CHECK_INT(mo_atlas_open_copy(path, folder, &atlas, NULL), MO_ERR_FORMAT);
  CHECK_OK(unlink(path));
  CHECK_INT(rmdir(folder), 0); /* the copy has no name */
}

/* Without a folder for the copy, the file itself is mapped. */
static void no_copy(void)
{
  const struct mo_atlas_source source = fixture_source(4);
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas *atlas = NULL;
  char path[FIXTURE_PATH];
  mo_environment_paper_test(environments);
  snprintf(path, sizeof(path), "%s/a.atlas", fixture_folder());
  REQUIRE_OK(fixture_write(&mo_system_files, path, &source, environments, 3, 1000, NULL));
  CHECK_OK(mo_atlas_open_copy(path, "/nowhere", &atlas, NULL));
  CHECK_INT(mo_atlas_bodies_of(atlas), 29);
  mo_atlas_close(atlas);
}

/* ---- losses in 16 bits ---- */

static void losses(void)
{
  size_t changed = 0;
  for (uint32_t code = 0; code < 65536; code++)
    if (!mo_atlas_loss_is_nan((uint16_t)code) && code != 0x8000) /* −0 is stored as 0 */
      changed += mo_atlas_pack_loss(mo_atlas_unpack_loss((uint16_t)code)) != code;
  CHECK_INT(changed, 0);
  CHECK(mo_atlas_unpack_loss(0x3c00) == 1.0F && mo_atlas_unpack_loss(0xc000) == -2.0F);
  CHECK(mo_atlas_unpack_loss(1) == 0x1p-24F && mo_atlas_unpack_loss(0x7bff) == 65504.0F);
  CHECK(mo_atlas_unpack_loss(0x7c00) == INFINITY && mo_atlas_unpack_loss(0xfc00) == -INFINITY);
  CHECK_INT(mo_atlas_pack_loss(-0.0), 0);
  CHECK_INT(mo_atlas_pack_loss(1e300), 0x7bff);
  CHECK_INT(mo_atlas_pack_loss(-65505), 0xfbff);
  /* Between neighbors, the nearest; in the middle, the even one. */
  for (uint16_t code = 0; code < 0x7bff; code++) {
    const double low = mo_atlas_unpack_loss(code), high = mo_atlas_unpack_loss(code + 1);
    const double middle = (low + high) / 2;
    const uint16_t even = code % 2 == 0 ? code : code + 1;
    changed += mo_atlas_pack_loss(middle) != even;
    changed += mo_atlas_pack_loss(nextafter(middle, 0)) != code;
    changed += mo_atlas_pack_loss(nextafter(middle, 1e9)) != code + 1;
  }
  CHECK_INT(changed, 0);
}

static const struct check_case cases[] = {
    {"what was written is read", content},
    {"several blocks; bytes of a body", blocks},
    {"measures and their percentiles", measures},
    {"bodies in the order of a measure", order_of_measures},
    {"files without measures stay as they were", first_version},
    {"source and environments", environments},
    {"damaged, truncated and longer files", WITH(damage, 0)},
    {"the same with measures", WITH(damage, SOME)},
    {"headers with wrong numbers", header_that_lies},
    {"blocks with wrong numbers", blocks_that_lie},
    {"measures with wrong numbers", measures_that_lie},
    {"things that are not atlas files", other_files},
    {"a file that changes while its copy is mapped", file_that_changes},
    {"no place for a copy", no_copy},
    {"losses in 16 bits", losses},
};
CHECK_MAIN(cases)
