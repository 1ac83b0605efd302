/* file.c: reads controllers from bytes and files, and encodes them. A file is read in pieces
 * directly into the parameters, so that a large controller is in memory only once. */
#include "controller/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define PIECE_BYTES ((size_t)1 << 30) /* for one system call */

int mo_controller_decode(const uint8_t *bytes, size_t size, struct mo_controller **controller,
                         struct mo_message *message)
{
  if (size > MO_CONTROLLER_FILE_MAX)
    return mo_fail(message, MO_ERR_LIMIT,
                   "the file has %zu bytes; at most %" PRIu64 " are accepted", size,
                   MO_CONTROLLER_FILE_MAX);
  uint32_t header_size = 0;
  int r = mo_safetensors_header_size(bytes, size, &header_size, message);
  if (r < 0)
    return r;
  struct mo_safetensors file = {0};
  r = mo_safetensors_parse((const char *)bytes + 8, header_size, size, &file, message);
  if (r < 0)
    return r;
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++)
    memcpy(file.controller->parameters + file.tensors[i].offset, bytes + file.offsets[i],
           file.tensors[i].count * sizeof(float));
  r = mo_safetensors_check_values(&file, message);
  if (r < 0) {
    mo_controller_free(file.controller);
    return r;
  }
  *controller = file.controller;
  return MO_OK;
}

/* Opens a regular file. Returns its descriptor and size. Never blocks, not even on a pipe. */
static int open_file(const char *path, uint64_t *size, struct mo_message *message)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0)
    return mo_fail(message, errno == ENOENT ? MO_ERR_NOT_FOUND : MO_ERR_IO, "cannot open %s: %s",
                   path, strerrordesc_np(errno));
  struct stat status;
  int r = MO_OK;
  if (fstat(fd, &status) < 0)
    r = mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
  else if (!S_ISREG(status.st_mode))
    r = mo_fail(message, MO_ERR_IO, "not a regular file");
  if (r < 0) {
    close(fd);
    return r;
  }
  *size = (uint64_t)status.st_size;
  return fd;
}

static int read_at(int fd, void *buffer, uint64_t size, uint64_t offset, struct mo_message *message)
{
  uint8_t *to = buffer;
  while (size > 0) {
    const ssize_t n = pread(fd, to, size < PIECE_BYTES ? size : PIECE_BYTES, (off_t)offset);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
    if (n == 0)
      return mo_fail(message, MO_ERR_IO, "the file became shorter while it was read");
    to += n;
    offset += (uint64_t)n;
    size -= (uint64_t)n;
  }
  return MO_OK;
}

static int read_header(int fd, uint64_t size, struct mo_safetensors *file,
                       struct mo_message *message)
{
  uint8_t prefix[8] = {0};
  int r = read_at(fd, prefix, size < 8 ? size : 8, 0, message);
  uint32_t header_size = 0;
  if (r == MO_OK)
    r = mo_safetensors_header_size(prefix, size, &header_size, message);
  if (r < 0)
    return r;
  char *header = malloc((size_t)header_size + 1);
  if (header == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  r = read_at(fd, header, header_size, 8, message);
  if (r == MO_OK)
    r = mo_safetensors_parse(header, header_size, size, file, message);
  free(header);
  return r;
}

static int read_open(int fd, uint64_t size, struct mo_controller **controller,
                     struct mo_message *message)
{
  if (size > MO_CONTROLLER_FILE_MAX)
    return mo_fail(message, MO_ERR_LIMIT,
                   "the file has %" PRIu64 " bytes; at most %" PRIu64 " are accepted", size,
                   MO_CONTROLLER_FILE_MAX);
  struct mo_safetensors file = {0};
  int r = read_header(fd, size, &file, message);
  if (r < 0 || file.controller == NULL)
    return r;
  for (int i = 0; i < MO_CONTROLLER_TENSORS && r == MO_OK; i++)
    r = read_at(fd, file.controller->parameters + file.tensors[i].offset,
                file.tensors[i].count * sizeof(float), file.offsets[i], message);
  if (r == MO_OK)
    r = mo_safetensors_check_values(&file, message);
  if (r < 0) {
    mo_controller_free(file.controller);
    return r;
  }
  *controller = file.controller;
  return MO_OK;
}

int mo_controller_read(const char *path, struct mo_controller **controller,
                       struct mo_message *message)
{
  uint64_t size = 0;
  const int fd = open_file(path, &size, message);
  if (fd < 0)
    return fd;
  const int r = read_open(fd, size, controller, message);
  close(fd);
  return r;
}

int mo_controller_encode(const struct mo_controller *controller, uint8_t **bytes, size_t *size)
{
  uint8_t *header = NULL;
  size_t header_size = 0;
  const int r = mo_safetensors_format(controller, &header, &header_size);
  if (r < 0)
    return r;
  const size_t data_size = controller->n_parameters * sizeof(float);
  uint8_t *out = realloc(header, header_size + data_size);
  if (out == NULL) {
    free(header);
    return MO_ERR_NO_MEMORY;
  }
  memcpy(out + header_size, controller->parameters, data_size);
  *bytes = out;
  *size = header_size + data_size;
  return MO_OK;
}
