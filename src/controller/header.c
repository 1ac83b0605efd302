/* header.c: writes the header of a controller file. It does not use the JSON library, whose printer
 * may return an incomplete text when memory runs out. The bytes of a file, whose hash identifies a
 * controller, should not depend on a library's version either. The longest possible header is
 * allocated at once, so that nothing can fail halfway. */
#include "controller/internal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

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

int mo_safetensors_format(const struct mo_controller *controller, uint8_t **bytes, size_t *size)
{
  size_t longest = 64 + (size_t)MO_CONTROLLER_TENSORS * 192;
  for (size_t i = 0; i < controller->n_metadata; i++)
    longest +=
        6 * (strlen(controller->metadata[i].key) + strlen(controller->metadata[i].value)) + 8;
  char *text = malloc(longest);
  if (text == NULL)
    return MO_ERR_NO_MEMORY;
  char *out = text + 8;
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
  while ((out - text) % 8 != 0)
    *out++ = ' ';
  const uint64_t header = (uint64_t)(out - text) - 8;
  if (header > MO_SAFETENSORS_HEADER_MAX) {
    free(text);
    return MO_ERR_LIMIT;
  }
  memcpy(text, &header, 8);
  *bytes = (uint8_t *)text;
  *size = 8 + header;
  return MO_OK;
}
