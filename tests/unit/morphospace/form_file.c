/* form_file.c: sets of forms as files: they have the same members when read back, and changed files
 * are refused. */
#include "../make.h"

#include "morphospace/form_file.h"
#include "morphospace/form_set.h"

#include <sys/mman.h>
#include <unistd.h>

#define N 6000

static const struct mo_form_key key = {.bytes = "a key", .n = 5};
static const struct mo_workspace small = {3, 3, 2};

static int put(void *context, const void *bytes, size_t size)
{
  return write(*(int *)context, bytes, size) == (ssize_t)size ? MO_OK : MO_ERR_IO;
}

static int refuse(void *context, const void *bytes, size_t size)
{
  (void)bytes;
  (void)size;
  return --*(int *)context < 0 ? MO_ERR_NO_SPACE : MO_OK;
}

/* Draws the forms of n bodies of a seed, and adds them to the set (nullable) or looks them up in
 * `has`. */
static uint32_t of_seed(uint64_t seed, uint32_t n, struct mo_form_set *set,
                        const struct mo_form_set *has)
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, seed);
  uint32_t found = 0;
  for (uint32_t i = 0; i < n; i++) {
    uint64_t body[MO_DEFAULT_WORDS], form[MO_DEFAULT_WORDS];
    make_check(mo_body_stream_next(stream, body, form), "a body");
    found += set != NULL ? mo_form_set_add(set, form) == 1 : mo_form_set_has(has, form);
  }
  return found;
}

static int file_of(const struct mo_form_set *set)
{
  int fd = memfd_create("forms", MFD_CLOEXEC);
  CHECK_OK(mo_form_file_write(set, &key, put, &fd));
  CHECK_INT(lseek(fd, 0, SEEK_END), mo_form_file_bytes(set));
  return fd;
}

static void same_members(void)
{
  struct mo_form_set *drawn = make_form_set(MO_DEFAULT_WORKSPACE), *mapped = NULL;
  CHECK_INT(of_seed(1, N, drawn, NULL), N);
  const int fd = file_of(drawn);
  for (uint32_t threads = 0; threads <= 3; threads++) {
    REQUIRE_OK(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &key, threads, &mapped));
    CHECK_INT(mo_form_set_count(mapped), N);
    CHECK_INT(of_seed(1, N, NULL, mapped), N);
    CHECK_INT(of_seed(2, N, NULL, mapped), of_seed(2, N, NULL, drawn));
    CHECK(of_seed(2, N, NULL, mapped) < N); /* not all of them are in it */
    mo_form_set_free(mapped);
  }
  CHECK(mo_form_file_bytes(drawn) < 18 * N * 5 / 4 + 16384); /* close to 18 bytes per form */
  close(fd);
}

/* An empty set, and the set of a small workspace, in which all one-word forms are compared. */
static void other_sets(void)
{
  struct mo_form_set *drawn = make_form_set(small), *mapped = NULL;
  int fd = file_of(drawn);
  REQUIRE_OK(mo_form_file_map(fd, small, &key, 2, &mapped));
  CHECK_INT(mo_form_set_count(mapped), 0);
  CHECK_INT(mo_form_set_has(mapped, &(uint64_t){1}), 0);
  mo_form_set_free(mapped);
  close(fd);
  CHECK_OK(mo_pretraining_forms(11, 1200, small, 1, NULL, NULL, drawn));
  fd = file_of(drawn);
  REQUIRE_OK(mo_form_file_map(fd, small, &key, 2, &mapped));
  CHECK_INT(mo_form_set_count(mapped), mo_form_set_count(drawn));
  uint32_t different = 0;
  for (uint64_t form = 1; form < UINT64_C(1) << 18; form++)
    different += mo_form_set_has(mapped, &form) != mo_form_set_has(drawn, &form);
  CHECK_INT(different, 0);
  mo_form_set_free(mapped);
  close(fd);
}

/* A file with missing, changed or additional bytes is corrupt, wherever they are. */
static void damage(void)
{
  struct mo_form_set *drawn = make_form_set(MO_DEFAULT_WORKSPACE), *mapped = NULL;
  (void)of_seed(1, N, drawn, NULL);
  const int fd = file_of(drawn);
  const off_t size = lseek(fd, 0, SEEK_END);
  for (off_t at = 0; at < size; at += at < size - 16 ? 997 : 1) {
    uint8_t byte;
    REQUIRE(pread(fd, &byte, 1, at) == 1);
    byte ^= 1 << at % 8;
    REQUIRE(pwrite(fd, &byte, 1, at) == 1);
    CHECK_INT(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &key, 1, &mapped), MO_ERR_CORRUPT);
    byte ^= 1 << at % 8;
    REQUIRE(pwrite(fd, &byte, 1, at) == 1);
  }
  for (off_t least = 0; least < size; least += 4099) {
    REQUIRE(ftruncate(fd, 0) == 0);
    REQUIRE(lseek(fd, 0, SEEK_SET) == 0);
    CHECK_OK(mo_form_file_write(drawn, &key, put, (int[]){fd}));
    REQUIRE(ftruncate(fd, least) == 0);
    CHECK_INT(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &key, 1, &mapped), MO_ERR_CORRUPT);
    REQUIRE(ftruncate(fd, size) == 0); /* filled with zeros */
    CHECK_INT(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &key, 1, &mapped), MO_ERR_CORRUPT);
  }
  CHECK(mapped == NULL);
  close(fd);
}

static void another_key(void)
{
  struct mo_form_set *drawn = make_form_set(MO_DEFAULT_WORKSPACE), *mapped = NULL;
  struct mo_form_key other = key;
  (void)of_seed(1, 100, drawn, NULL);
  const int fd = file_of(drawn);
  other.bytes[4]++;
  CHECK_INT(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &other, 1, &mapped), MO_ERR_NOT_FOUND);
  other = key;
  other.n++;
  CHECK_INT(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &other, 1, &mapped), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_form_file_map(fd, (struct mo_workspace){6, 4, 6}, &key, 1, &mapped),
            MO_ERR_NOT_FOUND);
  CHECK_OK(mo_form_file_map(fd, MO_DEFAULT_WORKSPACE, &key, 1, &mapped));
  mo_form_set_free(mapped);
  close(fd);
}

static void write_errors(void)
{
  struct mo_form_set *drawn = make_form_set(MO_DEFAULT_WORKSPACE);
  (void)of_seed(1, N, drawn, NULL);
  for (int at = 0; at < 257; at++)
    CHECK_INT(mo_form_file_write(drawn, &key, refuse, (int[]){at}), MO_ERR_NO_SPACE);
  CHECK_OK(mo_form_file_write(drawn, &key, refuse, (int[]){257}));
}

static const struct check_case cases[] = {
    {"the same members", same_members}, {"an empty set, and a small workspace", other_sets},
    {"damaged files", damage},          {"files of another key or workspace", another_key},
    {"write errors", write_errors},
};
CHECK_MAIN(cases)
