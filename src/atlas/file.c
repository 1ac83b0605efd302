/* file.c: opens atlas files, and looks bodies up in them.
 *
 * Opening reads the file with system calls, which report disk errors, and checks everything that
 * the queries rely on. After that, a look-up is two binary searches, over the first keys of the
 * size's blocks and over the keys of one block, which are in 32 KB. */
#include "atlas/file.h"

#include "atlas/losses.h"
#include "base/files.h"
#include "morphospace/form_set.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/fs.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#define PIECE_BYTES ((size_t)256 << 10)
#define REMEDY      "remove it and write the atlas again"

const char *const mo_atlas_orientation_words[] = {"canonical", "images", NULL};

/* ---- opening ---- */

static struct mo_atlas_scope scope_of(const struct mo_atlas_header *header)
{
  return (struct mo_atlas_scope){.workspace = {(uint16_t)header->sides[0],
                                               (uint16_t)header->sides[1],
                                               (uint16_t)header->sides[2]},
                                 .voxels_max = header->voxels_max};
}

/* Returns whether the numbers of a header are within their bounds, in a file of this size. */
static bool is_sound(const struct mo_atlas_header *header, uint64_t file_bytes)
{
  const struct mo_atlas_scope scope = scope_of(header);
  uint64_t bodies = 0;
  for (int axis = 0; axis < 3; axis++)
    if (header->sides[axis] > UINT16_MAX)
      return false;
  if (mo_atlas_scope_check(&scope, NULL) != MO_OK || header->orientations > MO_ATLAS_IMAGES ||
      header->n_environments < 1 || header->n_environments > MO_ATLAS_ENVIRONMENTS_MAX ||
      header->block_bodies != MO_ATLAS_BLOCK || header->environments_bytes % 8 != 0 ||
      (header->version == MO_ATLAS_MEASURED) != (mo_atlas_header_measures(header) != 0) ||
      memchr(header->fingerprint, '\0', sizeof(header->fingerprint)) == NULL)
    return false;
  for (uint32_t i = 0; i < MO_ATLAS_VOXELS_MAX; i++) {
    if (header->counts[i] > file_bytes || (i >= header->voxels_max && header->counts[i] > 0))
      return false;
    bodies += header->counts[i];
  }
  return bodies > 0 && bodies <= UINT32_MAX;
}

int mo_atlas_header_check(const struct mo_atlas_header *header, uint64_t file_bytes,
                          struct mo_message *message)
{
  struct mo_atlas_layout layout;
  if (file_bytes < sizeof(header->magic) ||
      memcmp(header->magic, MO_ATLAS_MAGIC, sizeof(header->magic)) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "this is not an atlas file: check its name");
  if (file_bytes < sizeof(*header))
    return mo_fail(message, MO_ERR_CORRUPT, "the atlas file is truncated: " REMEDY);
  if (header->byte_order != MO_ATLAS_ORDER)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "the atlas file has another byte order: write it on a little-endian machine");
  if (header->version < MO_ATLAS_VERSION || header->version > MO_ATLAS_MEASURED)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "the atlas file has version %u; this program reads versions %d and %d: use "
                   "the program that wrote it, or write the atlas again",
                   header->version, MO_ATLAS_VERSION, MO_ATLAS_MEASURED);
  if (header->end[header->version == MO_ATLAS_MEASURED] != mo_atlas_header_hash(header) ||
      !is_sound(header, file_bytes))
    return mo_fail(message, MO_ERR_CORRUPT, "the header of the atlas file is damaged: " REMEDY);
  if (mo_atlas_header_measures(header) > MO_MEASURES_ALL)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "the atlas file has unknown measures: use the program that wrote it");
  mo_atlas_layout_fill(header, &layout);
  if (layout.begins[MO_ATLAS_VOXELS_MAX] != file_bytes)
    return mo_fail(
        message, MO_ERR_CORRUPT, "the atlas file has %llu bytes, but should have %llu: " REMEDY,
        (unsigned long long)file_bytes, (unsigned long long)layout.begins[MO_ATLAS_VOXELS_MAX]);
  return MO_OK;
}

static int fail_to_read(int error, struct mo_message *message)
{
  return mo_fail(message, error, "the atlas file cannot be read: %s", mo_error_text(error));
}

static int read_environments(int fd, const struct mo_atlas_header *header, struct mo_atlas *atlas)
{
  uint8_t *bytes = malloc(header->environments_bytes > 0 ? header->environments_bytes : 1);
  struct mo_sha256 hash;
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_file_read_at(fd, mo_atlas_header_bytes(header), header->environments_bytes, bytes);
  if (error == MO_OK) {
    mo_sha256_of(bytes, header->environments_bytes, &hash);
    error = mo_sha256_equal(&hash, &header->environments)
                ? mo_atlas_environments_unpack(bytes, header->environments_bytes,
                                               header->n_environments, &atlas->environments)
                : MO_ERR_CORRUPT;
  }
  free(bytes);
  return error;
}

/* Reads and checks every block, and lists them with their first keys. */
static int read_blocks(int fd, struct mo_atlas *atlas)
{
  const uint64_t n = atlas->layout.blocks[MO_ATLAS_VOXELS_MAX];
  uint8_t *bytes = malloc(mo_atlas_block_bytes(&atlas->layout, MO_ATLAS_BLOCK));
  uint64_t last = 0;
  int error = MO_OK;
  atlas->blocks = calloc(n, sizeof(*atlas->blocks));
  atlas->first_keys = calloc(n, sizeof(*atlas->first_keys));
  if (bytes == NULL || atlas->blocks == NULL || atlas->first_keys == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint64_t i = 0; error == MO_OK && i < n; i++) {
    const struct mo_atlas_block block = mo_atlas_block_of(&atlas->layout, i);
    const bool has_last = block.position > atlas->layout.firsts[block.n_voxels - 1];
    error = mo_file_read_at(fd, block.begin, block.bytes, bytes);
    if (error == MO_OK)
      error = mo_atlas_block_check(&atlas->layout, &block, &atlas->sets, bytes, has_last, &last);
    if (error == MO_OK) {
      atlas->blocks[i] = block;
      memcpy(&atlas->first_keys[i], bytes + sizeof(struct mo_atlas_block_header), sizeof(uint64_t));
    }
  }
  free(bytes);
  return error;
}

static int read_header(int fd, struct mo_atlas_header *header, size_t *bytes,
                       struct mo_message *message)
{
  struct stat status;
  if (fstat(fd, &status) != 0)
    return fail_to_read(MO_ERR_IO, message);
  *bytes = (size_t)status.st_size;
  const int error =
      mo_file_read_at(fd, 0, *bytes < sizeof(*header) ? *bytes : sizeof(*header), header);
  return error == MO_OK ? mo_atlas_header_check(header, *bytes, message)
                        : fail_to_read(error, message);
}

static int read_all(int fd, struct mo_atlas *atlas, struct mo_message *message)
{
  struct mo_atlas_header header = {.version = 0};
  int error = read_header(fd, &header, &atlas->bytes, message);
  if (error != MO_OK)
    return error;
  atlas->source =
      (struct mo_atlas_source){.scope = scope_of(&header),
                               .orientations = (enum mo_atlas_orientations)header.orientations,
                               .measures = (uint32_t)mo_atlas_header_measures(&header)};
  memcpy(atlas->source.controller_sha256, header.controller.bytes, sizeof(header.controller.bytes));
  memcpy(atlas->source.physics_sha256, header.physics.bytes, sizeof(header.physics.bytes));
  memcpy(atlas->source.fingerprint, header.fingerprint, sizeof(header.fingerprint));
  atlas->environments_sha256 = header.environments;
  mo_atlas_layout_fill(&header, &atlas->layout);
  mo_atlas_sets_fill(atlas->source.scope.workspace, &atlas->sets);
  error = read_environments(fd, &header, atlas);
  if (error == MO_ERR_CORRUPT)
    return mo_fail(message, error, "the environments of the atlas file are damaged: " REMEDY);
  if (error == MO_OK)
    error = read_blocks(fd, atlas);
  if (error == MO_ERR_CORRUPT)
    return mo_fail(message, error, "a block of the atlas file is damaged or unsorted: " REMEDY);
  return error == MO_OK ? MO_OK : fail_to_read(error, message);
}

static int map(int fd, struct mo_atlas *atlas, struct mo_message *message)
{
  void *mapped = mmap(NULL, atlas->bytes, PROT_READ, MAP_SHARED, fd, 0);
  if (mapped == MAP_FAILED)
    return mo_fail(message, MO_ERR_NO_MEMORY, "cannot map the atlas file: %s", strerror(errno));
  atlas->mapped = mapped;
  return MO_OK;
}

/* Explains why a path cannot be opened as a file; errno: of the attempt. */
static int fail_to_open(const char *path, struct mo_message *message)
{
  const int error = mo_open_error(), reason = errno;
  struct stat status;
  if (error == MO_ERR_NO_MEMORY)
    return mo_fail(message, error, "cannot open the atlas file: %s", strerror(reason));
  if (stat(path, &status) == 0 && !S_ISREG(status.st_mode))
    return mo_fail(message, error,
                   S_ISDIR(status.st_mode)
                       ? "this is " MO_ATLAS_IS_FOLDER
                       : "this is a pipe, a socket or a device, not a file: remove it");
  if (reason != ENOENT)
    return mo_fail(message, error, "the file cannot be read: check its owner and its permissions");
  if (lstat(path, &status) == 0)
    return mo_fail(message, error,
                   "this is a link to a file that does not exist: remove the link, or restore "
                   "that file");
  return mo_fail(message, MO_ERR_NOT_FOUND, "cannot open the atlas file %.150s: %s", path,
                 strerror(reason));
}

int mo_atlas_file_open(const char *path, int *ret, struct stat *status, struct mo_message *message)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd >= 0 && fstat(fd, status) == 0 && S_ISREG(status->st_mode)) {
    *ret = fd;
    return MO_OK;
  }
  if (fd >= 0) {
    (void)close(fd);
    errno = EINVAL; /* it is not a file */
  }
  return fail_to_open(path, message);
}

/* Makes a file without a name in a folder. Returns −1 if it cannot. */
static int make_nameless(const char *folder)
{
  char *path;
  if (asprintf(&path, "%s/.tmp-XXXXXX", folder) < 0)
    return -1;
  const int fd = mkostemp(path, O_CLOEXEC);
  if (fd >= 0)
    (void)unlink(path);
  free(path);
  return fd;
}

/* Copies a file. Of a file that is being truncated, the copy is too short, and fails the checks. */
static bool copy_all(int from, int to, size_t bytes)
{
  uint8_t *piece = malloc(PIECE_BYTES);
  int error = piece != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (size_t at = 0; error == MO_OK && at < bytes;) {
    const size_t left = bytes - at, n = left < PIECE_BYTES ? left : PIECE_BYTES;
    error = mo_file_read_at(from, at, n, piece);
    if (error != MO_OK)
      break;
    const ssize_t written = pwrite(to, piece, n, (off_t)at);
    if (written > 0)
      at += (size_t)written;
    else if (written == 0 || errno != EINTR)
      error = MO_ERR_NO_SPACE;
  }
  free(piece);
  return error == MO_OK || error == MO_ERR_CORRUPT;
}

/* Replaces an atlas file by a copy without a name, if its header is sound, which bounds its size,
 * and if there is space. Where the file system can, the copy shares the bytes. */
static void use_copy(int *fd, const char *folder)
{
  struct mo_atlas_header header = {.version = 0};
  size_t bytes = 0;
  const int copy = read_header(*fd, &header, &bytes, NULL) == MO_OK ? make_nameless(folder) : -1;
  if (copy < 0)
    return;
  const bool is_copied = ioctl(copy, FICLONE, *fd) == 0 || copy_all(*fd, copy, bytes);
  (void)close(is_copied ? *fd : copy);
  *fd = is_copied ? copy : *fd;
}

int mo_atlas_open(const char *path, struct mo_atlas **atlas, struct mo_message *message)
{
  return mo_atlas_open_copy(path, NULL, atlas, message);
}

int mo_atlas_open_copy(const char *path, const char *folder, struct mo_atlas **atlas,
                       struct mo_message *message)
{
  struct mo_atlas *made = calloc(1, sizeof(*made));
  struct stat status;
  int fd = -1;
  if (made == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  int error = mo_atlas_file_open(path, &fd, &status, message);
  if (error == MO_OK && folder != NULL)
    use_copy(&fd, folder);
  if (error == MO_OK)
    error = read_all(fd, made, message);
  if (error == MO_OK)
    error = map(fd, made, message);
  if (fd >= 0)
    (void)close(fd);
  if (error == MO_OK)
    *atlas = made;
  else
    mo_atlas_close(made);
  return error;
}

void mo_atlas_close(struct mo_atlas *atlas)
{
  if (atlas == NULL)
    return;
  if (atlas->mapped != NULL)
    (void)munmap(atlas->mapped, atlas->bytes);
  mo_environments_free(atlas->environments, atlas->layout.n_environments);
  free(atlas->blocks);
  free(atlas->first_keys);
  free(atlas);
}

/* ---- content ---- */

int mo_atlas_is_of(const struct mo_atlas *atlas, const struct mo_atlas_source *source,
                   const struct mo_environment *environments, uint32_t n, bool *is_of)
{
  const struct mo_atlas_source *own = &atlas->source;
  struct mo_sha256 hash;
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int error = mo_atlas_environments_pack(environments, n, &bytes, &size);
  if (error != MO_OK)
    return error;
  mo_sha256_of(bytes, size, &hash);
  free(bytes);
  *is_of =
      mo_workspace_equal(own->scope.workspace, source->scope.workspace) &&
      own->scope.voxels_max == source->scope.voxels_max &&
      own->orientations == source->orientations && own->measures == source->measures &&
      atlas->layout.n_environments == n && mo_sha256_equal(&hash, &atlas->environments_sha256) &&
      memcmp(own->controller_sha256, source->controller_sha256, sizeof(own->controller_sha256)) ==
          0 &&
      memcmp(own->physics_sha256, source->physics_sha256, sizeof(own->physics_sha256)) == 0 &&
      strcmp(own->fingerprint, source->fingerprint) == 0;
  return MO_OK;
}

const struct mo_atlas_source *mo_atlas_source_of(const struct mo_atlas *atlas)
{
  return &atlas->source;
}

const struct mo_environment *mo_atlas_environments(const struct mo_atlas *atlas, uint32_t *n)
{
  *n = atlas->layout.n_environments;
  return atlas->environments;
}

uint64_t mo_atlas_bodies_of(const struct mo_atlas *atlas)
{
  return atlas->layout.firsts[MO_ATLAS_VOXELS_MAX];
}

void mo_atlas_hash(const struct mo_atlas *atlas, uint8_t sha256[32])
{
  struct mo_sha256 hash;
  mo_sha256_of(atlas->mapped, atlas->bytes, &hash);
  memcpy(sha256, hash.bytes, sizeof(hash.bytes));
}

uint64_t mo_atlas_size(const struct mo_atlas *atlas, uint32_t n_voxels, uint64_t *first)
{
  const bool is_known = n_voxels >= 1 && n_voxels <= MO_ATLAS_VOXELS_MAX;
  if (first != NULL)
    *first = is_known ? atlas->layout.firsts[n_voxels - 1] : 0;
  return is_known ? atlas->layout.counts[n_voxels - 1] : 0;
}

/* Returns the block of a position; *i: which of its bodies. */
static const struct mo_atlas_block *block_at(const struct mo_atlas *atlas, uint64_t position,
                                             uint32_t *i)
{
  const struct mo_atlas_layout *layout = &atlas->layout;
  uint32_t size = 0;
  while (position >= layout->firsts[size + 1])
    size++;
  const uint64_t before = position - layout->firsts[size];
  *i = (uint32_t)(before % MO_ATLAS_BLOCK);
  return &atlas->blocks[layout->blocks[size] + before / MO_ATLAS_BLOCK];
}

/* Blocks begin at multiples of 8. */
static const uint64_t *keys_of(const struct mo_atlas *atlas, const struct mo_atlas_block *block)
{
  return (const uint64_t *)(const void *)(atlas->mapped + block->begin +
                                          sizeof(struct mo_atlas_block_header));
}

uint32_t mo_atlas_key_at(const struct mo_atlas *atlas, uint64_t position, uint64_t *key)
{
  uint32_t i;
  const struct mo_atlas_block *block = block_at(atlas, position, &i);
  *key = keys_of(atlas, block)[i];
  return block->n_voxels;
}

uint32_t mo_atlas_form(const struct mo_atlas *atlas, uint64_t position, uint64_t *form)
{
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  uint64_t key;
  const uint32_t n = mo_atlas_key_at(atlas, position, &key);
  mo_atlas_key_voxels(&atlas->sets, key, n, voxels);
  mo_atlas_bits_of(atlas->source.scope.workspace, voxels, n, form);
  return n;
}

float mo_atlas_score(const struct mo_atlas *atlas, uint64_t position)
{
  uint32_t i;
  float score;
  const struct mo_atlas_block *block = block_at(atlas, position, &i);
  memcpy(&score, atlas->mapped + block->begin + mo_atlas_scores_at(block->n) + 4 * (size_t)i,
         sizeof(score));
  return score;
}

void mo_atlas_losses(const struct mo_atlas *atlas, uint64_t position, float *losses)
{
  const uint32_t n_environments = atlas->layout.n_environments;
  uint32_t i;
  const struct mo_atlas_block *block = block_at(atlas, position, &i);
  const uint8_t *from =
      atlas->mapped + block->begin + mo_atlas_losses_at(block->n) + 2 * (size_t)i * n_environments;
  for (uint32_t e = 0; e < n_environments; e++) {
    uint16_t packed;
    memcpy(&packed, from + 2 * (size_t)e, sizeof(packed));
    losses[e] = mo_atlas_unpack_loss(packed);
  }
}

const float *mo_atlas_column(const struct mo_atlas *atlas, const struct mo_atlas_block *block,
                             uint32_t column)
{
  return (const float *)(const void *)(atlas->mapped + block->begin +
                                       mo_atlas_measures_at(&atlas->layout, block->n)) +
         (size_t)column * block->n;
}

float mo_atlas_in_column(const struct mo_atlas *atlas, uint64_t position, uint32_t column)
{
  uint32_t i;
  const struct mo_atlas_block *block = block_at(atlas, position, &i);
  return mo_atlas_column(atlas, block, column)[i];
}

/* ---- finding ---- */

/* Returns how many of n ascending keys are at most `key`. */
static size_t count_up_to(const uint64_t *keys, size_t n, uint64_t key)
{
  size_t low = 0, high = n;
  while (low < high) {
    const size_t middle = low + (high - low) / 2;
    if (keys[middle] <= key)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

int mo_atlas_find_key(const struct mo_atlas *atlas, uint32_t n_voxels, uint64_t key,
                      uint64_t *position)
{
  const struct mo_atlas_layout *layout = &atlas->layout;
  if (n_voxels < 1 || n_voxels > layout->voxels_max)
    return MO_ERR_NOT_FOUND;
  const uint64_t first = layout->blocks[n_voxels - 1];
  const size_t blocks =
      count_up_to(atlas->first_keys + first, layout->blocks[n_voxels] - first, key);
  if (blocks == 0)
    return MO_ERR_NOT_FOUND;
  const struct mo_atlas_block *block = &atlas->blocks[first + blocks - 1];
  const uint64_t *keys = keys_of(atlas, block);
  const size_t n = count_up_to(keys, block->n, key); /* at least 1 */
  if (keys[n - 1] != key)
    return MO_ERR_NOT_FOUND;
  *position = block->position + n - 1;
  return MO_OK;
}

int mo_atlas_find(const struct mo_atlas *atlas, const uint64_t *bits, uint64_t *position)
{
  const struct mo_workspace workspace = atlas->source.scope.workspace;
  uint64_t form[MO_DEFAULT_WORDS];
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  const uint32_t n = mo_genotype_count(workspace, bits);
  if (n < 1 || n > atlas->layout.voxels_max)
    return MO_ERR_NOT_FOUND;
  mo_genotype_canonical(workspace, bits, form);
  (void)mo_atlas_voxels_of(workspace, form, voxels);
  return mo_atlas_find_key(atlas, n, mo_atlas_key_of(&atlas->sets, voxels, n), position);
}
