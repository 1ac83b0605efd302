/* file.c: controllers from and to bytes and files. A file is read piece by piece straight into the parameters, so that a large
 * controller is held once. A file is written beside its destination, synced, and renamed over it: readers see the old or the
 * new one, never a part. */
#include "controller/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

int mo_controller_decode(const uint8_t *bytes, size_t size, struct mo_controller **controller,
                         struct mo_message *message)
{
  if (size > MO_CONTROLLER_FILE_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "the file has %zu bytes; at most %" PRIu64 " are accepted", size,
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

/* Reads exactly `size` bytes at `offset`. */
static int read_at(int fd, void *buffer, uint64_t size, uint64_t offset, struct mo_message *message)
{
  uint8_t *to = buffer;
  while (size > 0) {
    const size_t piece = size < (UINT64_C(1) << 30) ? size : (UINT64_C(1) << 30);
    const ssize_t n = pread(fd, to, piece, (off_t)offset);
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

static int read_header(int fd, uint64_t size, struct mo_safetensors *file, struct mo_message *message)
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

static int read_open(int fd, struct mo_controller **controller, struct mo_message *message)
{
  struct stat status;
  if (fstat(fd, &status) < 0)
    return mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
  if (!S_ISREG(status.st_mode))
    return mo_fail(message, MO_ERR_IO, "not a regular file");
  const uint64_t size = (uint64_t)status.st_size;
  if (size > MO_CONTROLLER_FILE_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "the file has %" PRIu64 " bytes; at most %" PRIu64 " are accepted", size,
                   MO_CONTROLLER_FILE_MAX);
  struct mo_safetensors file = {0};
  int r = read_header(fd, size, &file, message);
  if (r < 0 || file.controller == NULL)
    return r;
  for (int i = 0; i < MO_CONTROLLER_TENSORS && r == MO_OK; i++)
    r = read_at(fd, file.controller->parameters + file.tensors[i].offset, file.tensors[i].count * sizeof(float),
                file.offsets[i], message);
  if (r == MO_OK)
    r = mo_safetensors_check_values(&file, message);
  if (r < 0) {
    mo_controller_free(file.controller);
    return r;
  }
  *controller = file.controller;
  return MO_OK;
}

int mo_controller_read(const char *path, struct mo_controller **controller, struct mo_message *message)
{
  /* O_NONBLOCK: opening a pipe must not wait for its writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0)
    return mo_fail(message, errno == ENOENT ? MO_ERR_NOT_FOUND : MO_ERR_IO, "cannot open %s: %s", path,
                   strerrordesc_np(errno));
  const int r = read_open(fd, controller, message);
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

static int fail_writing(const char *path, struct mo_message *message)
{
  const int error = errno;
  return mo_fail(message, error == ENOSPC || error == EDQUOT ? MO_ERR_NO_SPACE : MO_ERR_IO, "cannot write %s: %s", path,
                 strerrordesc_np(error));
}

static int write_all(int fd, const void *buffer, size_t size)
{
  const uint8_t *from = buffer;
  while (size > 0) {
    const ssize_t n = write(fd, from, size < ((size_t)1 << 30) ? size : ((size_t)1 << 30));
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return -1;
    from += n;
    size -= (size_t)n;
  }
  return 0;
}

/* The new name is durable once the folder is synced. */
static int sync_folder(const char *path)
{
  const char *slash = strrchr(path, '/');
  char *folder = slash == NULL ? strdup(".") : strndup(path, slash == path ? 1 : (size_t)(slash - path));
  if (folder == NULL)
    return -1;
  const int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  free(folder);
  if (fd < 0)
    return -1;
  const int r = fsync(fd);
  close(fd);
  return r;
}

static int write_temporary(const struct mo_controller *controller, const uint8_t *header, size_t header_size,
                           const char *temporary, const char *path, struct mo_message *message)
{
  const int fd = open(temporary, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
  if (fd < 0)
    return fail_writing(path, message);
  int r = MO_OK;
  if (write_all(fd, header, header_size) < 0 ||
      write_all(fd, controller->parameters, controller->n_parameters * sizeof(float)) < 0 || fsync(fd) < 0)
    r = fail_writing(path, message);
  if (close(fd) < 0 && r == MO_OK)
    r = fail_writing(path, message);
  if (r == MO_OK && rename(temporary, path) < 0)
    r = fail_writing(path, message);
  if (r < 0)
    unlink(temporary);
  return r;
}

int mo_controller_write(const struct mo_controller *controller, const char *path, struct mo_message *message)
{
  uint8_t *header = NULL;
  size_t header_size = 0;
  int r = mo_safetensors_format(controller, &header, &header_size);
  if (r < 0)
    return mo_fail(message, r, "cannot write %s: %s", path,
                   r == MO_ERR_LIMIT ? "its metadata exceeds the largest header" : "out of memory");
  uint64_t unique = 0;
  if (getrandom(&unique, sizeof(unique), 0) != (ssize_t)sizeof(unique))
    unique = (uint64_t)getpid();
  char *temporary = NULL;
  if (asprintf(&temporary, "%s.%016" PRIx64 ".tmp", path, unique) < 0) {
    free(header);
    return mo_fail(message, MO_ERR_NO_MEMORY, "cannot write %s: out of memory", path);
  }
  r = write_temporary(controller, header, header_size, temporary, path, message);
  if (r == MO_OK && sync_folder(path) < 0)
    r = fail_writing(path, message);
  free(temporary);
  free(header);
  return r;
}
