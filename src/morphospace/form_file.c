/* form_file.c: see form_file.h.
 *
 * A file has the tables of a set (form_set.c), filled to 8/9, and ends with their sizes and
 * checksums. A look-up reads only one or two places in the tables. Opening reads the file with
 * system calls, which report disk errors; an error while reading through the mapping would kill the
 * process. Checked pages are in the page cache, which may drop them when memory is short. */
#include "morphospace/form_file.h"

#include "base/files.h"
#include "base/thread.h"
#include "morphospace/form_set.h"

#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>

static const char magic[16] = "morphod forms 1";

/* The end of a file. It is in the machine's byte order, because a file is never used on other
 * machines. */
struct tail {
  char magic[sizeof(magic)];
  uint32_t sides[3], form_bytes;
  struct mo_form_key key;
  struct {
    uint64_t capacity, used, checksum;
  } tables[MO_FORM_SEGMENTS];
  uint64_t checksum; /* checksum of the tail before this member */
};

/* Returns the number of slots of a table in a file, or 0 for an empty table. */
static uint64_t capacity_of(const struct mo_form_segment *segment)
{
  return segment->used > 0 ? segment->used + segment->used / 8 + 1 : 0;
}

uint64_t mo_form_file_bytes(const struct mo_form_set *set)
{
  uint64_t slots = 0;
  for (int i = 0; i < MO_FORM_SEGMENTS; i++)
    slots += capacity_of(&set->segments[i]);
  return slots * set->form_bytes + sizeof(struct tail);
}

static void fill(struct tail *tail, struct mo_workspace workspace, const struct mo_form_key *key)
{
  memset(tail, 0, sizeof(*tail));
  memcpy(tail->magic, magic, sizeof(magic));
  tail->sides[0] = workspace.nx;
  tail->sides[1] = workspace.ny;
  tail->sides[2] = workspace.nz;
  tail->form_bytes = (uint32_t)((mo_workspace_voxels(workspace) + 7) / 8);
  tail->key = *key;
}

static uint64_t checksum_of(const struct tail *tail)
{
  return mo_form_hash((const uint8_t *)tail, offsetof(struct tail, checksum));
}

/* ---- writing ---- */

int mo_form_file_write(const struct mo_form_set *set, const struct mo_form_key *key,
                       int (*put)(void *context, const void *bytes, size_t size), void *context)
{
  struct tail tail;
  int error = MO_OK;
  fill(&tail, set->workspace, key);
  for (int i = 0; i < MO_FORM_SEGMENTS && error == MO_OK; i++) {
    const uint64_t capacity = capacity_of(&set->segments[i]);
    const size_t size = (size_t)capacity * set->form_bytes;
    struct mo_form_segment dense = {.slots = NULL};
    if (capacity == 0)
      continue;
    error = mo_form_segment_copy(&set->segments[i], set->form_bytes, capacity, &dense);
    if (error != MO_OK)
      return error;
    tail.tables[i].capacity = capacity;
    tail.tables[i].used = dense.used;
    tail.tables[i].checksum = mo_form_hash(dense.slots, size);
    error = put(context, dense.slots, size);
    free(dense.slots);
  }
  tail.checksum = checksum_of(&tail);
  return error == MO_OK ? put(context, &tail, sizeof(tail)) : error;
}

/* ---- reading ---- */

struct checking {
  int fd;
  const struct tail *tail;
  uint64_t begins[MO_FORM_SEGMENTS];
  atomic_int error;
};

static void check_some(void *context, size_t first, size_t end)
{
  struct checking *checking = context;
  const struct tail *tail = checking->tail;
  size_t most = 1;
  for (size_t i = first; i < end; i++)
    most = tail->tables[i].capacity > most ? tail->tables[i].capacity : most;
  uint8_t *bytes = malloc(most * tail->form_bytes);
  int error = bytes != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (size_t i = first; i < end && error == MO_OK; i++) {
    const size_t size = tail->tables[i].capacity * tail->form_bytes;
    if (size == 0)
      continue;
    error = mo_file_read_at(checking->fd, checking->begins[i], size, bytes);
    if (error == MO_OK && mo_form_hash(bytes, size) != tail->tables[i].checksum)
      error = MO_ERR_CORRUPT;
  }
  free(bytes);
  if (error != MO_OK)
    atomic_store(&checking->error, error);
}

/* Reads the tail and checks that its tables fill the file before it. *size: the size of the
 * file. */
static int read_tail(int fd, struct mo_workspace workspace, const struct mo_form_key *key,
                     struct tail *tail, uint64_t begins[MO_FORM_SEGMENTS], uint64_t *size)
{
  struct stat status;
  struct tail expected;
  uint64_t at = 0;
  if (fstat(fd, &status) != 0)
    return MO_ERR_IO;
  *size = (uint64_t)status.st_size;
  if (*size < sizeof(*tail))
    return MO_ERR_CORRUPT;
  const int error = mo_file_read_at(fd, *size - sizeof(*tail), sizeof(*tail), tail);
  if (error != MO_OK)
    return error;
  if (checksum_of(tail) != tail->checksum)
    return MO_ERR_CORRUPT;
  fill(&expected, workspace, key);
  if (memcmp(tail, &expected, offsetof(struct tail, tables)) != 0)
    return MO_ERR_NOT_FOUND;
  for (int i = 0; i < MO_FORM_SEGMENTS; i++) {
    const uint64_t capacity = tail->tables[i].capacity;
    begins[i] = at;
    if (capacity > *size || (capacity > 0 && tail->tables[i].used >= capacity))
      return MO_ERR_CORRUPT;
    at += capacity * tail->form_bytes;
  }
  return at + sizeof(*tail) == *size ? MO_OK : MO_ERR_CORRUPT;
}

int mo_form_file_map(int fd, struct mo_workspace workspace, const struct mo_form_key *key,
                     uint32_t n_threads, struct mo_form_set **set)
{
  struct tail tail;
  struct checking checking = {.fd = fd, .tail = &tail};
  struct mo_form_set *made = NULL;
  uint64_t size = 0;
  int error = read_tail(fd, workspace, key, &tail, checking.begins, &size);
  if (error != MO_OK)
    return error;
  mo_parallel(n_threads, MO_FORM_SEGMENTS, check_some, &checking);
  error = atomic_load(&checking.error);
  if (error == MO_OK)
    error = mo_form_set_create(workspace, &made);
  if (error != MO_OK)
    return error;
  uint8_t *mapped = mmap(NULL, size, PROT_READ, MAP_SHARED, fd, 0);
  if (mapped == MAP_FAILED) {
    mo_form_set_free(made);
    return MO_ERR_NO_MEMORY;
  }
  (void)madvise(mapped, size, MADV_RANDOM);
  made->mapped = mapped;
  made->mapped_bytes = size;
  for (int i = 0; i < MO_FORM_SEGMENTS; i++)
    made->segments[i] = (struct mo_form_segment){.slots = mapped + checking.begins[i],
                                                 .capacity = tail.tables[i].capacity,
                                                 .used = tail.tables[i].used};
  *set = made;
  return MO_OK;
}
