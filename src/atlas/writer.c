/* writer.c: writes atlas files.
 *
 * PATH.part grows block by block, each synced before the next begins, and becomes PATH when it is
 * complete and synced. A writer that finds a PATH.part compares its header and environments with
 * its own, checks its blocks, cuts it off after the last whole one, and continues there. Whatever a
 * crash left behind is either a whole block or cut off, so the file does not depend on where it
 * was interrupted. The lock of PATH.part keeps other writers away, and ends with the process.
 *
 * The bodies of an unfinished block are saved as a smaller block in the place of the whole one,
 * which later replaces it. A save that fails or is torn loses the saved part of this one block:
 * only whole blocks are safe from later writes. */
#include "atlas/writer.h"

#include "atlas/bodies.h"
#include "atlas/format.h"
#include "atlas/losses.h"
#include "morphospace/form_set.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

struct mo_atlas_writer {
  const struct mo_file_operations *files;
  struct mo_atlas_scope scope;
  struct mo_atlas_layout layout;
  struct mo_atlas_sets sets;
  struct mo_atlas_bodies *bodies;
  char *path, *part;
  int fd;
  int error;         /* of an earlier call, after which nothing is written */
  bool is_named;     /* PATH.part has become PATH */
  uint64_t position; /* the next body, which is the one with next_key */
  uint64_t next_key;
  bool knows_next;    /* also if no body is left */
  uint64_t block;     /* index of the block that is being filled */
  uint32_t filled;    /* its bodies so far */
  uint32_t saved;     /* those already in PATH.part */
  uint8_t *bytes;     /* its bytes, and room for the largest block */
  uint8_t *beginning; /* the header and the environments */
  size_t beginning_bytes;
};

/* Fails with the errno of a system call. */
static int fail_at(const struct mo_atlas_writer *writer, int error, const char *what,
                   struct mo_message *message)
{
  return mo_fail(message, error, "cannot %s %.150s: %s", what, writer->part, strerror(errno));
}

static int fail_exists(const struct mo_atlas_writer *writer, struct mo_message *message)
{
  return mo_fail(message, MO_ERR_CONFLICT,
                 "%.150s already exists: remove it, or choose another name", writer->path);
}

/* ---- writing ---- */

static int write_durably(const struct mo_atlas_writer *writer, const uint8_t *bytes, size_t size)
{
  for (size_t written = 0; written < size;) {
    const ssize_t n = writer->files->write(writer->fd, bytes + written, size - written);
    if (n < 0 && errno != EINTR)
      return mo_file_error();
    written += n > 0 ? (size_t)n : 0;
  }
  return writer->files->sync(writer->fd) == 0 ? MO_OK : mo_file_error();
}

/* Writes at the end of the file. After a failure, cuts off what was written: after a failed sync,
 * the file could look whole and not be durable. */
static int append(struct mo_atlas_writer *writer, uint64_t end, const uint8_t *bytes, size_t size)
{
  if (lseek(writer->fd, (off_t)end, SEEK_SET) < 0)
    return MO_ERR_IO;
  const int error = write_durably(writer, bytes, size);
  if (error != MO_OK)
    (void)!ftruncate(writer->fd, (off_t)end);
  return error;
}

/* Completes the header and the checksum of a block, and writes it. */
static int write_block(struct mo_atlas_writer *writer, const struct mo_atlas_block *block,
                       uint8_t *bytes)
{
  const struct mo_atlas_block_header header = {
      .n_voxels = block->n_voxels, .n = block->n, .position = block->position};
  const size_t checked = mo_atlas_checksum_at(&writer->layout, block->n);
  memcpy(bytes, &header, sizeof(header));
  const uint64_t checksum = mo_form_hash(bytes, checked);
  memcpy(bytes + checked, &checksum, sizeof(checksum));
  const int error = append(writer, block->begin, bytes, block->bytes);
  if (error != MO_OK) /* its saved part is gone */
    writer->saved = 0;
  return error;
}

/* Returns the beginning of a block as a separate block. */
static struct mo_atlas_block some_of(const struct mo_atlas_writer *writer,
                                     const struct mo_atlas_block *block, uint32_t n)
{
  struct mo_atlas_block some = *block;
  some.n = n;
  some.bytes = mo_atlas_block_bytes(&writer->layout, n);
  return some;
}

/* Copies the first n bodies of a block to one of a different size. */
static void copy_bodies(const struct mo_atlas_writer *writer, uint32_t n, const uint8_t *from,
                        uint32_t from_n, uint8_t *to, uint32_t to_n)
{
  const size_t header = sizeof(struct mo_atlas_block_header);
  memcpy(to + header, from + header, 8 * (size_t)n);
  memcpy(to + mo_atlas_scores_at(to_n), from + mo_atlas_scores_at(from_n), 4 * (size_t)n);
  memcpy(to + mo_atlas_losses_at(to_n), from + mo_atlas_losses_at(from_n),
         2 * (size_t)n * writer->layout.n_environments);
  for (size_t m = 0; m < writer->layout.n_measures; m++)
    memcpy(to + mo_atlas_measures_at(&writer->layout, to_n) + 4 * m * to_n,
           from + mo_atlas_measures_at(&writer->layout, from_n) + 4 * m * from_n, 4 * (size_t)n);
}

int mo_atlas_writer_save(struct mo_atlas_writer *writer)
{
  if (writer->error != MO_OK || writer->filled == writer->saved)
    return writer->error;
  const struct mo_atlas_block block = mo_atlas_block_of(&writer->layout, writer->block);
  const struct mo_atlas_block some = some_of(writer, &block, writer->filled);
  uint8_t *bytes = calloc(1, some.bytes);
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  copy_bodies(writer, some.n, writer->bytes, block.n, bytes, some.n);
  const int error = write_block(writer, &some, bytes);
  free(bytes);
  if (error == MO_OK)
    writer->saved = writer->filled;
  else if (error != MO_ERR_NO_SPACE)
    writer->error = error;
  return error;
}

static void put_measures(struct mo_atlas_writer *writer, const struct mo_atlas_block *block,
                         const double *measures)
{
  uint8_t *to = writer->bytes + mo_atlas_measures_at(&writer->layout, block->n);
  for (size_t m = 0; m < writer->layout.n_measures; m++) {
    const float value = (float)measures[m];
    uint32_t bits = MO_ATLAS_NO_VALUE;
    if (!isnan(value))
      memcpy(&bits, &value, sizeof(bits));
    memcpy(to + 4 * (m * block->n + writer->filled), &bits, sizeof(bits));
  }
}

/* Puts a body into the block that is being filled. */
static void put(struct mo_atlas_writer *writer, const struct mo_atlas_block *block,
                const double *losses, const double *measures)
{
  const uint32_t n_environments = writer->layout.n_environments;
  const size_t i = writer->filled;
  double sum = 0;
  if (i == 0)
    memset(writer->bytes, 0, block->bytes);
  for (uint32_t e = 0; e < n_environments; e++) {
    const uint16_t packed = mo_atlas_pack_loss(losses[e]);
    memcpy(writer->bytes + mo_atlas_losses_at(block->n) + 2 * (i * n_environments + e), &packed,
           sizeof(packed));
    sum += losses[e];
  }
  const float score = (float)(sum / n_environments);
  memcpy(writer->bytes + sizeof(struct mo_atlas_block_header) + 8 * i, &writer->next_key,
         sizeof(writer->next_key));
  memcpy(writer->bytes + mo_atlas_scores_at(block->n) + 4 * i, &score, sizeof(score));
  put_measures(writer, block, measures);
}

/* Reads the key of the next body, if there is one. */
static int look_ahead(struct mo_atlas_writer *writer)
{
  uint32_t n_voxels;
  const int error = writer->position == writer->layout.firsts[MO_ATLAS_VOXELS_MAX]
                        ? MO_OK
                        : mo_atlas_bodies_next_key(writer->bodies, &n_voxels, &writer->next_key);
  writer->knows_next = error == MO_OK;
  return error;
}

/* Returns whether losses and measures can be stored. */
static bool are_storable(const struct mo_atlas_layout *layout, const double *losses,
                         const double *measures)
{
  double sum = 0;
  for (uint32_t e = 0; e < layout->n_environments; e++)
    sum += losses[e];
  if (isnan(sum) || isinf(sum) < 0 || isnan((float)sum)) /* −infinity, or both infinities */
    return false;
  for (uint32_t m = 0; m < layout->n_measures; m++)
    if (isinf((float)measures[m]))
      return false;
  return true;
}

int mo_atlas_writer_add(struct mo_atlas_writer *writer, const uint64_t *form, const double *losses,
                        const double *measures)
{
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  if (writer->error == MO_OK && !writer->knows_next) {
    const int error = look_ahead(writer);
    if (error != MO_OK)
      return error;
  }
  if (writer->error != MO_OK)
    return writer->error;
  if (writer->position == writer->layout.firsts[MO_ATLAS_VOXELS_MAX])
    return MO_ERR_CONFLICT;
  const struct mo_atlas_block block = mo_atlas_block_of(&writer->layout, writer->block);
  if (mo_atlas_voxels_of(writer->scope.workspace, form, voxels) != block.n_voxels ||
      mo_atlas_key_of(&writer->sets, voxels, block.n_voxels) != writer->next_key)
    return MO_ERR_CONFLICT;
  if (!are_storable(&writer->layout, losses, measures))
    return MO_ERR_INVALID;
  put(writer, &block, losses, measures);
  if (writer->filled + 1 == block.n) {
    const int error = write_block(writer, &block, writer->bytes);
    if (error != MO_OK) {
      writer->error = error == MO_ERR_NO_SPACE ? MO_OK : error;
      return error;
    }
  }
  writer->position++;
  if (++writer->filled == block.n) {
    writer->filled = writer->saved = 0;
    writer->block++;
  }
  writer->knows_next = false;
  return MO_OK;
}

static int sync_folder(const struct mo_atlas_writer *writer)
{
  char *folder = strdup(writer->path);
  int error = MO_OK;
  if (folder == NULL)
    return MO_ERR_NO_MEMORY;
  char *slash = strrchr(folder, '/');
  if (slash == NULL)
    folder[0] = '\0';
  else
    slash[slash == folder] = '\0'; /* the root keeps its slash */
  const int fd =
      writer->files->open(folder[0] != '\0' ? folder : ".", O_RDONLY | O_CLOEXEC | O_DIRECTORY);
  if (fd < 0 || writer->files->sync(fd) != 0)
    error = mo_file_error();
  if (fd >= 0)
    (void)writer->files->close(fd);
  free(folder);
  return error;
}

int mo_atlas_writer_finish(struct mo_atlas_writer *writer, struct mo_message *message)
{
  const uint64_t bodies = writer->layout.firsts[MO_ATLAS_VOXELS_MAX];
  if (writer->error != MO_OK)
    return mo_fail(message, writer->error, "writing %.150s failed: make a new writer to continue",
                   writer->part);
  if (writer->position < bodies)
    return mo_fail(message, MO_ERR_INVALID,
                   "the atlas lacks %llu of %llu bodies: add them before finishing it",
                   (unsigned long long)(bodies - writer->position), (unsigned long long)bodies);
  if (!writer->is_named && writer->files->rename_new(writer->part, writer->path) != 0)
    return errno == EEXIST ? fail_exists(writer, message)
                           : fail_at(writer, mo_file_error(), "rename", message);
  writer->is_named = true;
  const int error = sync_folder(writer);
  return error == MO_OK ? MO_OK : fail_at(writer, error, "sync the folder of", message);
}

/* ---- an unfinished file ---- */

/* Returns whether the file begins with the writer's header and environments; *is_cut: it ends
 * within them. */
static int compare_beginning(const struct mo_atlas_writer *writer, uint64_t file_bytes,
                             bool *is_same, bool *is_cut)
{
  const size_t size =
      file_bytes < writer->beginning_bytes ? (size_t)file_bytes : writer->beginning_bytes;
  uint8_t *bytes = malloc(size > 0 ? size : 1);
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  const int error = mo_file_read_at(writer->fd, 0, size, bytes);
  *is_same = error == MO_OK && memcmp(bytes, writer->beginning, size) == 0;
  *is_cut = size < writer->beginning_bytes;
  free(bytes);
  return error == MO_ERR_CORRUPT ? MO_ERR_IO : error;
}

/* Takes the saved beginning of the next block, if it is the end of the file. Returns its bytes, or
 * 0. */
static size_t take_saved(struct mo_atlas_writer *writer, uint64_t end, uint64_t file_bytes,
                         bool has_last, uint64_t *last)
{
  const struct mo_atlas_block block = mo_atlas_block_of(&writer->layout, writer->block);
  const uint64_t left = file_bytes - end;
  struct mo_atlas_block_header header = {.n = 0};
  uint8_t *bytes = left >= sizeof(header) && left < block.bytes ? malloc(left) : NULL;
  bool is_whole = bytes != NULL && mo_file_read_at(writer->fd, end, left, bytes) == MO_OK;
  if (is_whole)
    memcpy(&header, bytes, sizeof(header));
  const struct mo_atlas_block some = some_of(writer, &block, header.n);
  is_whole =
      is_whole && header.n > 0 && header.n < block.n && some.bytes == left &&
      mo_atlas_block_check(&writer->layout, &some, &writer->sets, bytes, has_last, last) == MO_OK;
  if (is_whole) {
    memset(writer->bytes, 0, block.bytes);
    copy_bodies(writer, some.n, bytes, some.n, writer->bytes, block.n);
    writer->filled = writer->saved = some.n;
    writer->position = block.position + some.n;
  }
  free(bytes);
  return is_whole ? some.bytes : 0;
}

/* Skips the whole blocks and a saved one, and cuts off the rest. */
static int pass_blocks(struct mo_atlas_writer *writer, uint64_t file_bytes)
{
  const uint64_t blocks = writer->layout.blocks[MO_ATLAS_VOXELS_MAX];
  uint64_t last = 0, end = writer->beginning_bytes;
  for (; writer->block < blocks; writer->block++) {
    const struct mo_atlas_block block = mo_atlas_block_of(&writer->layout, writer->block);
    const bool has_last = block.position > writer->layout.firsts[block.n_voxels - 1];
    if (block.begin + block.bytes > file_bytes) {
      end += take_saved(writer, end, file_bytes, has_last, &last);
      break;
    }
    const int error = mo_file_read_at(writer->fd, block.begin, block.bytes, writer->bytes);
    if (error != MO_OK)
      return error == MO_ERR_CORRUPT ? MO_ERR_IO : error;
    if (mo_atlas_block_check(&writer->layout, &block, &writer->sets, writer->bytes, has_last,
                             &last) != MO_OK)
      break;
    end = block.begin + block.bytes;
    writer->position = block.position + block.n;
  }
  if (ftruncate(writer->fd, (off_t)end) != 0 || writer->files->sync(writer->fd) != 0)
    return mo_file_error();
  return MO_OK;
}

/* Opens and locks PATH.part. */
static int lock(struct mo_atlas_writer *writer, struct stat *status, struct mo_message *message)
{
  struct stat named;
  writer->fd = writer->files->open(writer->part, O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (writer->fd < 0)
    return fail_at(writer, mo_file_error(), "open", message);
  if (flock(writer->fd, LOCK_EX | LOCK_NB) != 0)
    return errno == EWOULDBLOCK
               ? mo_fail(message, MO_ERR_BUSY, "another writer is using %.150s: wait until it ends",
                         writer->part)
               : fail_at(writer, MO_ERR_IO, "lock", message);
  /* Another writer may have finished between the opening and the lock. */
  if (fstat(writer->fd, status) != 0 || stat(writer->part, &named) != 0 ||
      named.st_ino != status->st_ino || named.st_dev != status->st_dev)
    return mo_fail(message, MO_ERR_BUSY, "another writer has just finished %.150s: use its file",
                   writer->path);
  return MO_OK;
}

static int refuse_complete(const struct mo_atlas_writer *writer, struct mo_message *message)
{
  return access(writer->path, F_OK) == 0 ? fail_exists(writer, message) : MO_OK;
}

static int begin(struct mo_atlas_writer *writer, struct mo_message *message)
{
  struct stat status = {.st_size = 0};
  bool is_same = false, is_cut = false;
  int error = refuse_complete(writer, message);
  if (error == MO_OK)
    error = lock(writer, &status, message);
  if (error == MO_OK) /* it may have been finished since */
    error = refuse_complete(writer, message);
  if (error != MO_OK)
    return error;
  const uint64_t file_bytes = (uint64_t)status.st_size;
  error = compare_beginning(writer, file_bytes, &is_same, &is_cut);
  if (error == MO_OK && !is_same)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "%.150s belongs to another atlas: remove it, or choose another name",
                   writer->part);
  if (error == MO_OK)
    error = is_cut ? append(writer, 0, writer->beginning, writer->beginning_bytes)
                   : pass_blocks(writer, file_bytes);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(writer->bodies, writer->position);
  if (error == MO_OK)
    error = look_ahead(writer);
  return error == MO_OK ? MO_OK
                        : mo_fail(message, error, "cannot continue %.150s: %s", writer->part,
                                  mo_error_text(error));
}

/* ---- making a writer ---- */

static int check(const struct mo_atlas_source *source, const struct mo_environment *environments,
                 uint32_t n, struct mo_message *message)
{
  const int error = mo_atlas_scope_check(&source->scope, message);
  if (error != MO_OK)
    return error;
  if (source->orientations != MO_ATLAS_CANONICAL && source->orientations != MO_ATLAS_IMAGES)
    return mo_fail(message, MO_ERR_INVALID, "orientations must be canonical or images");
  if (source->measures > MO_MEASURES_ALL)
    return mo_fail(message, MO_ERR_INVALID, "there are %d measures, as bits of enum mo_measure",
                   MO_MEASURES);
  if (memchr(source->fingerprint, '\0', sizeof(source->fingerprint)) == NULL)
    return mo_fail(message, MO_ERR_INVALID, "the fingerprint must have at most %d characters",
                   MO_ATLAS_FINGERPRINT - 1);
  if (n < 1 || n > MO_ATLAS_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "an atlas must have 1 to %d environments, got %u",
                   MO_ATLAS_ENVIRONMENTS_MAX, n);
  for (uint32_t i = 0; i < n; i++) {
    const int fault = mo_environment_check(&environments[i], NULL);
    if (fault != MO_OK)
      return mo_fail(message, fault, "environment %u has a value outside its bounds", i);
  }
  return MO_OK;
}

/* Makes the header and the environments. */
static int make_beginning(struct mo_atlas_writer *writer, const struct mo_atlas_source *source,
                          const struct mo_environment *environments, uint32_t n)
{
  struct mo_atlas_header header = {
      .magic = MO_ATLAS_MAGIC,
      .byte_order = MO_ATLAS_ORDER,
      .version = source->measures != 0 ? MO_ATLAS_MEASURED : MO_ATLAS_VERSION,
      .sides = {source->scope.workspace.nx, source->scope.workspace.ny, source->scope.workspace.nz},
      .voxels_max = source->scope.voxels_max,
      .orientations = (uint32_t)source->orientations,
      .n_environments = n,
      .block_bodies = MO_ATLAS_BLOCK};
  uint8_t *packed = NULL;
  size_t size = 0;
  int error = mo_atlas_bodies_count(writer->bodies, header.counts);
  if (error == MO_OK)
    error = mo_atlas_environments_pack(environments, n, &packed, &size);
  if (error != MO_OK)
    return error;
  memcpy(header.controller.bytes, source->controller_sha256, sizeof(header.controller.bytes));
  memcpy(header.physics.bytes, source->physics_sha256, sizeof(header.physics.bytes));
  memcpy(header.fingerprint, source->fingerprint, strlen(source->fingerprint));
  header.environments_bytes = (uint32_t)size;
  mo_sha256_of(packed, size, &header.environments);
  header.end[0] = source->measures;
  *mo_atlas_header_checksum(&header) = mo_atlas_header_hash(&header);
  mo_atlas_layout_fill(&header, &writer->layout);
  writer->beginning_bytes = mo_atlas_header_bytes(&header) + size;
  writer->beginning = malloc(writer->beginning_bytes);
  writer->bytes = malloc(mo_atlas_block_bytes(&writer->layout, MO_ATLAS_BLOCK));
  if (writer->beginning == NULL || writer->bytes == NULL) {
    error = MO_ERR_NO_MEMORY;
  } else {
    memcpy(writer->beginning, &header, writer->beginning_bytes - size);
    memcpy(writer->beginning + writer->beginning_bytes - size, packed, size);
  }
  free(packed);
  return error;
}

int mo_atlas_writer_create_with(const struct mo_file_operations *files, const char *path,
                                const struct mo_atlas_source *source,
                                const struct mo_environment *environments, uint32_t n,
                                struct mo_atlas_writer **writer, struct mo_message *message)
{
  int error = check(source, environments, n, message);
  if (error != MO_OK)
    return error;
  struct mo_atlas_writer *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  made->files = files;
  made->scope = source->scope;
  made->fd = -1;
  mo_atlas_sets_fill(source->scope.workspace, &made->sets);
  made->path = strdup(path);
  if (asprintf(&made->part, "%s.part", path) < 0)
    made->part = NULL;
  error = made->path == NULL || made->part == NULL
              ? MO_ERR_NO_MEMORY
              : mo_atlas_bodies_create(&source->scope, &made->bodies);
  if (error == MO_OK)
    error = make_beginning(made, source, environments, n);
  error =
      error == MO_OK ? begin(made, message) : mo_fail(message, error, "%s", mo_error_text(error));
  if (error == MO_OK)
    *writer = made;
  else
    mo_atlas_writer_free(made);
  return error;
}

int mo_atlas_writer_create(const char *path, const struct mo_atlas_source *source,
                           const struct mo_environment *environments, uint32_t n,
                           struct mo_atlas_writer **writer, struct mo_message *message)
{
  return mo_atlas_writer_create_with(&mo_system_files, path, source, environments, n, writer,
                                     message);
}

void mo_atlas_writer_free(struct mo_atlas_writer *writer)
{
  if (writer == NULL)
    return;
  if (writer->fd >= 0)
    (void)writer->files->close(writer->fd);
  mo_atlas_bodies_free(writer->bodies);
  free(writer->path);
  free(writer->part);
  free(writer->bytes);
  free(writer->beginning);
  free(writer);
}

uint64_t mo_atlas_writer_position(const struct mo_atlas_writer *writer)
{
  return writer->position;
}

uint64_t mo_atlas_writer_bodies(const struct mo_atlas_writer *writer)
{
  return writer->layout.firsts[MO_ATLAS_VOXELS_MAX];
}
