/* writer.c: the writer of atlas files: after any interruption, the file has the same bytes. */
#include "../image.h"
#include "fixture.h"

#include <errno.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/wait.h>

#define N      2   /* environments */
#define LEVELS 100 /* of losses */

static struct mo_environment environments[MO_PAPER_TEST_COUNT];
static struct mo_atlas_source source;
static char path[FIXTURE_PATH], part[FIXTURE_PATH];

static void setup(void)
{
  mo_environment_paper_test(environments);
  source = fixture_source(8); /* thirteen blocks */
}

/* Makes a folder for the case, and the bytes of the whole file. */
static const uint8_t *whole(size_t *size)
{
  struct mo_message message = {""};
  const char *folder = fixture_folder();
  snprintf(path, sizeof(path), "%s/whole", folder);
  make_check(fixture_write(&mo_system_files, path, &source, environments, N, LEVELS, &message),
             message.text);
  const uint8_t *bytes = fixture_bytes(path, size);
  snprintf(path, sizeof(path), "%s/a.atlas", folder);
  snprintf(part, sizeof(part), "%s/a.atlas.part", folder);
  return bytes;
}

static struct mo_atlas_writer *create(struct mo_message *message, int error)
{
  struct mo_atlas_writer *writer = NULL;
  CHECK_INT(mo_atlas_writer_create(path, &source, environments, N, &writer, message), error);
  CHECK((writer != NULL) == (error == MO_OK));
  return writer;
}

static bool has_bytes(const uint8_t *bytes, size_t size)
{
  size_t found;
  const uint8_t *read = fixture_bytes(path, &found);
  return found == size && SAME(read, bytes, size);
}

/* Completes the file, which then has these bytes, and removes it. */
static void complete(const uint8_t *bytes, size_t size)
{
  struct mo_message message = {""};
  CHECK_OK(fixture_write(&mo_system_files, path, &source, environments, N, LEVELS, &message));
  CHECK(has_bytes(bytes, size));
  CHECK(access(part, F_OK) != 0);
  CHECK_OK(unlink(path));
}

static void killed(void)
{
  static const uint64_t at[] = {0, 1, 700, 3822, 3823, 8000, 20000, 24134, 24135};
  size_t size;
  const uint8_t *bytes = whole(&size);
  for (size_t i = 0; i < COUNT(at); i++) {
    int status = 0;
    const pid_t child = fork();
    if (child == 0) {
      struct mo_atlas_writer *writer = NULL;
      if (mo_atlas_writer_create(path, &source, environments, N, &writer, NULL) == MO_OK)
        (void)fixture_add(writer, &source, N, LEVELS, at[i]);
      (void)kill(getpid(), SIGKILL);
    }
    CHECK_INT(waitpid(child, &status, 0), child);
    CHECK(WIFSIGNALED(status));
    struct mo_message message = {""};
    struct mo_atlas_writer *writer = create(&message, MO_OK);
    const uint64_t position = mo_atlas_writer_position(writer);
    CHECK(position <= at[i] && at[i] - position < MO_ATLAS_BLOCK);
    mo_atlas_writer_free(writer);
    complete(bytes, size);
  }
}

/* Saved bodies of an unfinished block are there after a kill, and its end may be torn. */
static void saved_at(const uint64_t *at, size_t n)
{
  size_t size, found;
  const uint8_t *bytes = whole(&size);
  for (size_t i = 0; i < n; i++) {
    int status = 0;
    const pid_t child = fork();
    if (child == 0) {
      struct mo_atlas_writer *writer = NULL;
      int error = mo_atlas_writer_create(path, &source, environments, N, &writer, NULL);
      for (uint64_t part_of = 3; part_of > 0 && error == MO_OK; part_of--) {
        error = fixture_add(writer, &source, N, LEVELS, at[i] / part_of);
        if (error == MO_OK)
          error = mo_atlas_writer_save(writer);
      }
      if (error == MO_OK)
        error = fixture_add(writer, &source, N, LEVELS, at[i] + 5); /* not saved */
      (void)kill(getpid(), error == MO_OK ? SIGKILL : SIGTERM);
    }
    CHECK_INT(waitpid(child, &status, 0), child);
    CHECK(WIFSIGNALED(status) && WTERMSIG(status) == SIGKILL);
    struct mo_message message = {""};
    struct mo_atlas_writer *writer = create(&message, MO_OK);
    const uint64_t position = mo_atlas_writer_position(writer);
    CHECK(position >= at[i] && position <= at[i] + 5); /* a block may have ended since */
    CHECK_OK(mo_atlas_writer_save(writer));
    mo_atlas_writer_free(writer);
    const uint8_t *written = fixture_bytes(part, &found);
    for (size_t cut = found; cut + 4000 > found && cut > 2400; cut -= 331) {
      FILE *file = fopen(part, "wb");
      REQUIRE(file != NULL);
      CHECK_INT(fwrite(written, 1, cut, file), cut);
      for (int k = 0; k < 20000 && cut % 2 == 1; k++)
        (void)fputc(k % 7, file);
      CHECK_OK(fclose(file));
      complete(bytes, size);
    }
  }
}

static void saved(void)
{
  static const uint64_t at[] = {1, 2, 700, 3823, 4000, 8191, 20000, 24134, 24135};
  saved_at(at, COUNT(at));
}

/* The end of an unfinished file may be anything. */
static void torn(void)
{
  size_t size;
  const uint8_t *bytes = whole(&size);
  for (size_t cut = 0; cut <= size; cut += cut < 600 ? 97 : 23457) {
    FILE *file = fopen(part, "wb");
    REQUIRE(file != NULL);
    CHECK_INT(fwrite(bytes, 1, cut, file), cut);
    for (int i = 0; i < 3000 && cut > sizeof(struct mo_atlas_header) + 2000; i++)
      (void)fputc(i % 7, file);
    CHECK_OK(fclose(file));
    complete(bytes, size);
  }
}

/* The same for a file with measures. */
static void measured(void)
{
  static const uint64_t at[] = {2, 4001, 24134};
  source.measures = 1U << MO_MEASURE_DISPLACEMENT | 1U << MO_MEASURE_WORK | 1U << MO_MEASURE_TILT;
  killed();
  saved_at(at, COUNT(at));
  torn();
  source.measures = 0;
}

/* Measures that cannot be stored, and other measures than those of an unfinished file. */
static void wrong_measures(void)
{
  struct mo_atlas_bodies *bodies = NULL;
  struct mo_message message = {""};
  uint64_t form[MO_DEFAULT_WORDS];
  const double losses[] = {1, 2};
  bool is_of = false;
  source = fixture_source(1);
  snprintf(path, sizeof(path), "%s/a", fixture_folder());
  source.measures = MO_MEASURES_ALL + 1;
  (void)create(&message, MO_ERR_INVALID);
  CHECK_SAYS(message, "20 measures");
  source.measures = 3;
  struct mo_atlas_writer *writer = create(&message, MO_OK);
  REQUIRE_OK(mo_atlas_bodies_create(&source.scope, &bodies));
  REQUIRE_OK(mo_atlas_bodies_next(bodies, form));
  mo_atlas_bodies_free(bodies);
  CHECK_INT(mo_atlas_writer_add(writer, form, losses, (double[]){1, INFINITY}), MO_ERR_INVALID);
  CHECK_INT(mo_atlas_writer_add(writer, form, losses, (double[]){-1e39, 0}), MO_ERR_INVALID);
  CHECK_INT(mo_atlas_writer_position(writer), 0);
  mo_atlas_writer_free(writer);
  source.measures = 5;
  (void)create(&message, MO_ERR_CONFLICT);
  source.measures = 3;
  writer = create(&message, MO_OK);
  CHECK_OK(mo_atlas_writer_add(writer, form, losses, (double[]){-NAN, 0.1}));
  CHECK_OK(mo_atlas_writer_finish(writer, &message));
  mo_atlas_writer_free(writer);
  const struct mo_atlas *atlas = fixture_open(path);
  CHECK(isnan(mo_atlas_measure(atlas, 0, MO_MEASURE_DISPLACEMENT)));
  CHECK(mo_atlas_measure(atlas, 0, MO_MEASURE_PATH_LENGTH) == 0.1F);
  CHECK(mo_atlas_is_of(atlas, &source, environments, N, &is_of) == MO_OK && is_of);
  source.measures = 5;
  CHECK(mo_atlas_is_of(atlas, &source, environments, N, &is_of) == MO_OK && !is_of);
  source = fixture_source(8);
}

static void altered_block(void)
{
  size_t size, found;
  const uint8_t *bytes = whole(&size);
  struct mo_atlas_header header;
  struct mo_atlas_layout layout;
  struct mo_message message = {""};
  memcpy(&header, bytes, sizeof(header));
  mo_atlas_layout_fill(&header, &layout);
  const struct mo_atlas_block block = mo_atlas_block_of(&layout, 9);
  struct mo_atlas_writer *writer = create(&message, MO_OK);
  REQUIRE_OK(fixture_add(writer, &source, N, LEVELS, 24000));
  mo_atlas_writer_free(writer);
  uint8_t *written = fixture_bytes(part, &found);
  written[block.begin + 100] ^= 1;
  FILE *file = fopen(part, "wb");
  REQUIRE(file != NULL);
  CHECK_INT(fwrite(written, 1, found, file), found);
  CHECK_OK(fclose(file));
  writer = create(&message, MO_OK);
  CHECK_INT(mo_atlas_writer_position(writer), block.position);
  mo_atlas_writer_free(writer);
  complete(bytes, size);
}

/* ---- refusals ---- */

static void conflicts(void)
{
  size_t size;
  const uint8_t *bytes = whole(&size);
  struct mo_message message = {""};
  struct mo_atlas_writer *writer = create(&message, MO_OK);
  (void)create(&message, MO_ERR_BUSY);
  CHECK_SAYS(message, "another writer");
  REQUIRE_OK(fixture_add(writer, &source, N, LEVELS, 1000));
  mo_atlas_writer_free(writer);
  source.physics_sha256[0] ^= 1;
  (void)create(&message, MO_ERR_CONFLICT);
  CHECK_SAYS(message, "belongs to another atlas: remove it");
  source.physics_sha256[0] ^= 1;
  environments[1].light_xy_m[0] += 0.5;
  (void)create(&message, MO_ERR_CONFLICT);
  environments[1].light_xy_m[0] -= 0.5;
  CHECK_OK(fixture_write(&mo_system_files, path, &source, environments, N, LEVELS, &message));
  CHECK(has_bytes(bytes, size));
  (void)create(&message, MO_ERR_CONFLICT);
  CHECK_SAYS(message, "already exists");
  CHECK(access(part, F_OK) != 0);
}

/* A file that gets the name meanwhile stays. */
static void taken_meanwhile(void)
{
  size_t size;
  const uint8_t *bytes = whole(&size);
  struct mo_message message = {""};
  struct mo_atlas_writer *writer = create(&message, MO_OK);
  REQUIRE_OK(fixture_add(writer, &source, N, LEVELS, mo_atlas_writer_bodies(writer)));
  FILE *file = fopen(path, "wb");
  REQUIRE(file != NULL);
  CHECK(fputs("somebody's", file) >= 0);
  CHECK_OK(fclose(file));
  CHECK_INT(mo_atlas_writer_finish(writer, &message), MO_ERR_CONFLICT);
  CHECK_SAYS(message, "already exists: remove it");
  CHECK(has_bytes((const uint8_t *)"somebody's", 10));
  CHECK_OK(unlink(path));
  CHECK_OK(mo_atlas_writer_finish(writer, &message));
  CHECK_OK(mo_atlas_writer_finish(writer, &message)); /* once more does no harm */
  mo_atlas_writer_free(writer);
  CHECK(has_bytes(bytes, size) && access(part, F_OK) != 0);
}

static void other_environments(void)
{
  size_t size;
  bool is_of = false;
  (void)whole(&size);
  struct mo_message message = {""};
  CHECK_OK(fixture_write(&mo_system_files, path, &source, environments, N, LEVELS, &message));
  const struct mo_atlas *atlas = fixture_open(path);
  CHECK(mo_atlas_is_of(atlas, &source, environments, N, &is_of) == MO_OK && is_of);
  CHECK(mo_atlas_is_of(atlas, &source, environments, N - 1, &is_of) == MO_OK && !is_of);
  environments[1].light_xy_m[0] += 0.5;
  CHECK(mo_atlas_is_of(atlas, &source, environments, N, &is_of) == MO_OK && !is_of);
  environments[1].light_xy_m[0] -= 0.5;
  source.physics_sha256[3] ^= 1;
  CHECK(mo_atlas_is_of(atlas, &source, environments, N, &is_of) == MO_OK && !is_of);
  source.physics_sha256[3] ^= 1;
}

static void wrong_sources(void)
{
  const struct mo_atlas_source right = source;
  struct mo_message message = {""};
  snprintf(path, sizeof(path), "%s/a", fixture_folder());
  source.scope.voxels_max = 11;
  (void)create(&message, MO_ERR_RANGE);
  source = right;
  source.orientations = (enum mo_atlas_orientations)2;
  (void)create(&message, MO_ERR_INVALID);
  source = right;
  memset(source.fingerprint, 'x', sizeof(source.fingerprint));
  (void)create(&message, MO_ERR_INVALID);
  CHECK_SAYS(message, "at most 63 characters");
  source = right;
  environments[1].light_xy_m[0] = NAN;
  (void)create(&message, MO_ERR_INVALID);
  CHECK_SAYS(message, "environment 1");
  mo_environment_paper_test(environments);
  struct mo_atlas_writer *writer = NULL;
  CHECK_INT(mo_atlas_writer_create(path, &source, environments, 0, &writer, &message),
            MO_ERR_LIMIT);
  snprintf(path, sizeof(path), "/no such folder/a");
  (void)create(&message, MO_ERR_IO);
  CHECK_SAYS(message, "No such file");
}

static void wrong_bodies(void)
{
  struct mo_atlas_bodies *bodies = NULL;
  struct mo_message message = {""};
  uint64_t first[MO_DEFAULT_WORDS], second[MO_DEFAULT_WORDS];
  source = fixture_source(2);
  snprintf(path, sizeof(path), "%s/a", fixture_folder());
  struct mo_atlas_writer *writer = create(&message, MO_OK);
  REQUIRE_OK(mo_atlas_bodies_create(&source.scope, &bodies));
  REQUIRE_OK(mo_atlas_bodies_next(bodies, first));
  REQUIRE_OK(mo_atlas_bodies_next(bodies, second));
  CHECK_INT(mo_atlas_writer_bodies(writer), 3);
  CHECK_INT(mo_atlas_writer_add(writer, second, (double[]){1, 2}, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_atlas_writer_add(writer, first, (double[]){1, NAN}, NULL), MO_ERR_INVALID);
  CHECK_INT(mo_atlas_writer_add(writer, first, (double[]){-INFINITY, 1}, NULL), MO_ERR_INVALID);
  CHECK_INT(mo_atlas_writer_add(writer, first, (double[]){-INFINITY, INFINITY}, NULL),
            MO_ERR_INVALID);
  CHECK_INT(mo_atlas_writer_position(writer), 0);
  CHECK_OK(mo_atlas_writer_add(writer, first, (double[]){1, INFINITY}, NULL));
  CHECK_OK(mo_atlas_writer_add(writer, second, (double[]){1e5, 1}, NULL));
  CHECK_INT(mo_atlas_writer_finish(writer, &message), MO_ERR_INVALID);
  CHECK_SAYS(message, "lacks 1 of 3 bodies");
  REQUIRE_OK(mo_atlas_bodies_next(bodies, second));
  CHECK_OK(mo_atlas_writer_add(writer, second, (double[]){0.25, 0.5}, NULL));
  CHECK_INT(mo_atlas_writer_add(writer, second, (double[]){0.25, 0.5}, NULL), MO_ERR_CONFLICT);
  CHECK_OK(mo_atlas_writer_finish(writer, &message));
  mo_atlas_writer_free(writer);
  mo_atlas_bodies_free(bodies);
  const struct mo_atlas *atlas = fixture_open(path);
  float losses[N];
  CHECK(mo_atlas_score(atlas, 0) == INFINITY && mo_atlas_score(atlas, 1) == 50000.5F);
  CHECK(mo_atlas_score(atlas, 2) == 0.375F);
  mo_atlas_losses(atlas, 0, losses);
  CHECK(losses[0] == 1 && losses[1] == INFINITY);
  mo_atlas_losses(atlas, 1, losses);
  CHECK(losses[0] == 65504 && losses[1] == 1);
  source = fixture_source(8);
}

/* ---- disks that fail ---- */

static long calls, failing; /* the call of this number fails */
static int fault;

static bool fails(void)
{
  errno = fault;
  return ++calls == failing;
}

static ssize_t write_some(int fd, const void *bytes, size_t size)
{
  const bool is_faulty = fails(); /* half of it is written */
  const ssize_t n = write(fd, bytes, is_faulty ? size / 2 : size < 50000 ? size : 50000);
  errno = fault;
  return is_faulty ? -1 : n;
}
static off_t synced; /* bytes of the file at its last sync */
static int sync_fails(int fd)
{
  struct stat status;
  if (fails() || fstat(fd, &status) != 0)
    return -1;
  synced = S_ISREG(status.st_mode) ? status.st_size : synced;
  return fsync(fd);
}
static int rename_fails(const char *from, const char *to)
{
  return fails() ? -1 : mo_system_files.rename_new(from, to);
}

static void failing_disk(int error)
{
  struct mo_file_operations files = mo_system_files;
  size_t size;
  source = fixture_source(7); /* seven blocks */
  const uint8_t *bytes = whole(&size);
  int result = MO_ERR_IO;
  files.write = write_some;
  files.sync = sync_fails;
  files.rename_new = rename_fails;
  fault = error == MO_ERR_NO_SPACE ? ENOSPC : EIO;
  for (failing = 1; result != MO_OK && failing < 1000; failing++) {
    struct mo_message message = {""};
    struct stat status;
    calls = synced = 0;
    result = fixture_write(&files, path, &source, environments, N, LEVELS, &message);
    if (result == MO_OK)
      break;
    CHECK_INT(result, error);
    if (access(path, F_OK) == 0) { /* only the folder's sync failed */
      CHECK(has_bytes(bytes, size) && unlink(path) == 0);
    } else {
      CHECK(stat(part, &status) == 0 && status.st_size == synced); /* nothing else is trusted */
      complete(bytes, size);
    }
  }
  CHECK(result == MO_OK && failing > 15 && has_bytes(bytes, size));
  source = fixture_source(8);
}

/* A writer whose disk was full tries again, and loses nothing. */
static void space_again(void)
{
  struct mo_file_operations files = mo_system_files;
  size_t size;
  source = fixture_source(6);
  const uint8_t *bytes = whole(&size);
  files.write = write_some;
  files.sync = sync_fails;
  fault = ENOSPC;
  long n_failed = 0;
  failing = -1; /* none */
  for (long offset = 3; offset < 9; offset++) {
    struct mo_message message = {""};
    struct mo_atlas_writer *writer = NULL;
    calls = 0;
    CHECK_OK(
        mo_atlas_writer_create_with(&files, path, &source, environments, N, &writer, &message));
    const uint64_t bodies = mo_atlas_writer_bodies(writer);
    for (uint64_t end = 100; mo_atlas_writer_position(writer) < bodies; end += 100) {
      calls = 0;
      failing = (long)(end / 100) % offset; /* 0: none */
      const uint64_t before = mo_atlas_writer_position(writer);
      int error = fixture_add(writer, &source, N, LEVELS, end);
      if (error == MO_OK)
        error = mo_atlas_writer_save(writer);
      CHECK(error == MO_OK || error == MO_ERR_NO_SPACE);
      CHECK(mo_atlas_writer_position(writer) >= before);
      n_failed += error != MO_OK;
    }
    failing = -1;
    CHECK_OK(mo_atlas_writer_save(writer));
    CHECK_OK(mo_atlas_writer_finish(writer, &message));
    mo_atlas_writer_free(writer);
    CHECK(has_bytes(bytes, size) && unlink(path) == 0);
  }
  CHECK(n_failed > 20);
  source = fixture_source(8);
}

/* ---- designs ---- */

static void designs(void)
{
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS] = {0}, image[MO_DEFAULT_WORDS];
  const struct mo_atlas_scope scope = {MO_DEFAULT_WORKSPACE, 5};
  uint32_t of_n[MO_ORIENTATIONS + 1] = {0};
  REQUIRE_OK(mo_atlas_bodies_create(&scope, &bodies));
  while (mo_atlas_bodies_next(bodies, form) == MO_OK) {
    struct mo_bits made[MO_ORIENTATIONS];
    struct mo_form_set *distinct = make_form_set(scope.workspace);
    const uint32_t n = mo_atlas_designs(&scope, form, MO_ATLAS_IMAGES, made);
    for (unsigned k = 0; k < MO_ORIENTATIONS; k++) {
      CHECK_OK(make_image(scope.workspace, form, k, image)); /* all fit */
      mo_genotype_place(scope.workspace, image);
      (void)mo_form_set_add(distinct, image);
    }
    CHECK_INT(mo_form_set_count(distinct), n);
    for (uint32_t i = 0; i < n; i++)
      CHECK(mo_form_set_has(distinct, made[i].words));
    of_n[n]++;
    CHECK_INT(mo_atlas_designs(&scope, form, MO_ATLAS_CANONICAL, made), 1);
    mo_genotype_place(scope.workspace, form);
    CHECK(SAME(made[0].words, form, MO_DEFAULT_WORDS));
  }
  mo_atlas_bodies_free(bodies);
  CHECK(of_n[1] > 0 && of_n[2] > 0 && of_n[4] > 0 && of_n[8] > 0);
  CHECK_INT(of_n[1] + of_n[2] + of_n[4] + of_n[8], 124);
  /* A bar of five along x does not fit a workspace of 5 × 1 turned by 90°. */
  const struct mo_atlas_scope narrow = {{5, 1, 1}, 5};
  struct mo_bits made[MO_ORIENTATIONS];
  CHECK_INT(mo_atlas_designs(&narrow, (uint64_t[]){31}, MO_ATLAS_IMAGES, made), 1);
}

static const struct check_case cases[] = {
    {"killed at any moment", killed},
    {"saved bodies of an unfinished block", saved},
    {"an end of anything", torn},
    {"with measures", measured},
    {"measures that are refused", wrong_measures},
    {"an altered block", altered_block},
    {"other files and writers", conflicts},
    {"a name that is taken meanwhile", taken_meanwhile},
    {"a file of other environments", other_environments},
    {"sources that are refused", wrong_sources},
    {"bodies and losses that are refused", wrong_bodies},
    {"a full disk", WITH(failing_disk, MO_ERR_NO_SPACE)},
    {"a failing disk", WITH(failing_disk, MO_ERR_IO)},
    {"a full disk that gets space again", space_again},
    {"designs of a body", designs},
};
CHECK_MAIN_WITH(setup, cases)
