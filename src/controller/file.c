/* file.c: reads controllers from bytes and files, and encodes them. A file is read in pieces
 * directly into the parameters, so that a large controller is in memory only once. */
#include "controller/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define PIECE_BYTES ((size_t)1 << 30) /* for one system call */

/* What a controller is read from. */
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
      return mo_fail(source->message, MO_ERR_IO, "the file became shorter while it was read");
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
 * The header is not written by the JSON library, whose printer may return an incomplete text when
 * memory runs out. The bytes of a file, whose hash identifies a controller, should not depend on a
 * library's version either. */

/* Writes a JSON string with its quotes: at most 6 bytes per byte and 2 more. Returns its end. */
static char *put_string(char *out, const char *text)
{
  static const char escapes[] =
      "\bb\ff\nn\rr\tt\"\"\\\\"; /* pairs: character, letter after the backslash */
  *out++ = '"';
  for (; *text != '\0'; text++) {
    const unsigned char c = (unsigned char)*text;
    const char *pair = escapes;
    while (*pair != '\0' && *pair != *text)
      pair += 2;
    if (*pair != '\0') {
      *out++ = '\\';
      *out++ = pair[1];
    } else if (c < 0x20) {
      out += sprintf(out, "\\u%04X", c);
    } else {
      *out++ = *text;
    }
  }
  *out++ = '"';
  return out;
}

static char *put_tensor(char *out, const struct mo_tensor *tensor)
{
  out += sprintf(out, ",\"%s\":{\"dtype\":\"F32\",\"shape\":[%" PRIu64, tensor->name,
                 tensor->shape[0]);
  if (tensor->n_dims == 2)
    out += sprintf(out, ",%" PRIu64, tensor->shape[1]);
  return out + sprintf(out, "],\"data_offsets\":[%" PRIu64 ",%" PRIu64 "]}",
                       tensor->offset * sizeof(float),
                       (tensor->offset + tensor->count) * sizeof(float));
}

/* Writes the header, padded to whole parameters, and returns its end. */
static char *put_header(char *out, const struct mo_controller *controller)
{
  const char *const first = out;
  out += sprintf(out, "{\"__metadata__\":{");
  for (size_t i = 0; i < controller->n_metadata; i++) {
    if (i > 0)
      *out++ = ',';
    out = put_string(out, controller->metadata[i].key);
    *out++ = ':';
    out = put_string(out, controller->metadata[i].value);
  }
  *out++ = '}';
  struct mo_tensor tensors[MO_CONTROLLER_TENSORS];
  mo_controller_tensors(controller->workspace, tensors);
  for (int i = 0; i < MO_CONTROLLER_TENSORS; i++)
    out = put_tensor(out, &tensors[i]);
  *out++ = '}';
  while ((out - first) % 8 != 0)
    *out++ = ' ';
  return out;
}

int mo_controller_encode(const struct mo_controller *controller, uint8_t **bytes, size_t *size)
{
  const size_t data_size = controller->n_parameters * sizeof(float);
  size_t longest = 64 + (size_t)MO_CONTROLLER_TENSORS * 192; /* of the header */
  for (size_t i = 0; i < controller->n_metadata; i++)
    longest +=
        6 * (strlen(controller->metadata[i].key) + strlen(controller->metadata[i].value)) + 8;
  char *text = malloc(longest + data_size);
  if (text == NULL)
    return MO_ERR_NO_MEMORY;
  char *data = put_header(text + 8, controller);
  const uint64_t header_size = (uint64_t)(data - text) - 8;
  if (header_size > MO_SAFETENSORS_HEADER_MAX) {
    free(text);
    return MO_ERR_LIMIT;
  }
  memcpy(text, &header_size, 8);
  memcpy(data, controller->parameters, data_size);
  *bytes = (uint8_t *)text;
  *size = 8 + header_size + data_size;
  return MO_OK;
}
