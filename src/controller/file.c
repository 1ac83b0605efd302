/* file.c: reads controllers from bytes and files, and encodes them. A file is read in pieces
 * directly into the parameters, so that a large controller is never in memory twice. */
#include "controller/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "base/text.h"

#define PIECE_BYTES ((size_t)1 << 30) /* limit for one system call */

/* The source of a controller. */
struct source {
  const uint8_t *bytes; /* NULL: the file `fd` */
  int fd;
  uint64_t size;
  struct mo_message *message;
};

static int read_at(const struct source *source, void *buffer, uint64_t size, uint64_t offset)
{
  uint8_t *to = buffer;
  if (source->bytes != NULL) {
    memcpy(to, source->bytes + offset, size);
    return MO_OK;
  }
  while (size > 0) {
    const ssize_t n = pread(source->fd, to, size < PIECE_BYTES ? size : PIECE_BYTES, (off_t)offset);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return mo_fail(source->message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
    if (n == 0)
      return mo_fail(source->message, MO_ERR_IO, "the file was truncated while it was being read");
    to += n;
    offset += (uint64_t)n;
    size -= (uint64_t)n;
  }
  return MO_OK;
}

static int read_header(const struct source *source, struct mo_safetensors *file)
{
  uint8_t prefix[8] = {0};
  uint32_t header_size = 0;
  int r = read_at(source, prefix, source->size < 8 ? source->size : 8, 0);
  if (r == MO_OK)
    r = mo_safetensors_header_size(prefix, source->size, &header_size, source->message);
  if (r < 0)
    return r;
  char *header = malloc((size_t)header_size + 1);
  if (header == NULL)
    return mo_fail(source->message, MO_ERR_NO_MEMORY, "out of memory");
  r = read_at(source, header, header_size, 8);
  if (r == MO_OK)
    r = mo_safetensors_parse(header, header_size, source->size, file, source->message);
  free(header);
  return r;
}

static int read_source(const struct source *source, struct mo_controller **controller)
{
  if (source->size > MO_CONTROLLER_FILE_MAX)
    return mo_fail(source->message, MO_ERR_LIMIT,
                   "the file has %" PRIu64 " bytes; at most %" PRIu64 " are accepted", source->size,
                   MO_CONTROLLER_FILE_MAX);
  struct mo_safetensors file = {0};
  int r = read_header(source, &file);
  if (r < 0 || file.controller == NULL)
    return r;
  for (int i = 0; i < MO_CONTROLLER_TENSORS && r == MO_OK; i++)
    r = read_at(source, file.controller->parameters + file.tensors[i].offset,
                file.tensors[i].count * sizeof(float), file.offsets[i]);
  if (r == MO_OK)
    r = mo_safetensors_check_values(&file, source->message);
  if (r < 0) {
    mo_controller_free(file.controller);
    return r;
  }
  *controller = file.controller;
  return MO_OK;
}

int mo_controller_decode(const uint8_t *bytes, size_t size, struct mo_controller **controller,
                         struct mo_message *message)
{
  const struct source source = {.bytes = bytes, .size = size, .message = message};
  return read_source(&source, controller);
}

int mo_controller_read(const char *path, struct mo_controller **controller,
                       struct mo_message *message)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0)
    return mo_fail(message, errno == ENOENT ? MO_ERR_NOT_FOUND : MO_ERR_IO, "cannot open %s: %s",
                   path, strerrordesc_np(errno));
  struct stat status;
  int r;
  if (fstat(fd, &status) < 0) {
    r = mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
  } else if (!S_ISREG(status.st_mode)) {
    r = mo_fail(message, MO_ERR_IO, "not a regular file");
  } else {
    const struct source source = {.fd = fd, .size = (uint64_t)status.st_size, .message = message};
    r = read_source(&source, controller);
  }
  close(fd);
  return r;
}

/* ---- writing ----
 *
 * The JSON library does not write the header, because its printer may return an incomplete text
 * when memory runs out. Moreover, the hash of a file identifies a controller, so its bytes should
 * not depend on a library's version. */

/* Writes the header, padded to whole parameters. */
static void write_header(struct mo_text *text, const struct mo_controller *controller)
{
  struct mo_tensor tensors[MO_CONTROLLER_TENSORS];
  mo_controller_tensors(controller->workspace, tensors);
  mo_text_add(text, "{\"__metadata__\":{");
  for (size_t i = 0; i < controller->n_metadata; i++) {
    const struct mo_metadata_entry *entry = &controller->metadata[i];
    mo_text_next(text);
    mo_text_json_string(text, entry->key, strlen(entry->key));
    mo_text_add(text, ":");
    mo_text_json_string(text, entry->value, strlen(entry->value));
  }
  mo_text_add(text, "}");
  for (const struct mo_tensor *tensor = tensors; tensor < tensors + MO_CONTROLLER_TENSORS;
       tensor++) {
    mo_text_name(text, tensor->name);
    mo_text_format(text, "{\"dtype\":\"F32\",\"shape\":[%" PRIu64, tensor->shape[0]);
    if (tensor->n_dims == 2)
      mo_text_format(text, ",%" PRIu64, tensor->shape[1]);
    mo_text_format(text, "],\"data_offsets\":[%" PRIu64 ",%" PRIu64 "]}",
                   tensor->offset * sizeof(float),
                   (tensor->offset + tensor->count) * sizeof(float));
  }
  mo_text_add(text, "}");
  while (text->size % 8 != 0 && !text->failed)
    mo_text_add(text, " ");
}

int mo_controller_encode(const struct mo_controller *controller, uint8_t **bytes, size_t *size)
{
  const size_t data_size = controller->n_parameters * sizeof(float);
  struct mo_text header = {0};
  write_header(&header, controller);
  const uint64_t header_size = header.size;
  uint8_t *file = NULL;
  int error = header.failed                             ? MO_ERR_NO_MEMORY
              : header_size > MO_SAFETENSORS_HEADER_MAX ? MO_ERR_LIMIT
                                                        : MO_OK;
  if (error == MO_OK && (file = malloc(8 + header_size + data_size)) == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    memcpy(file, &header_size, 8);
    memcpy(file + 8, header.data, header_size);
    memcpy(file + 8 + header_size, controller->parameters, data_size);
    *bytes = file;
    *size = 8 + header_size + data_size;
  }
  mo_text_free(&header);
  return error;
}
