/* header.c: writes the header of a controller file. By hand, not with the JSON library: its
 * printer, when memory runs out, may return a text with a hole in it; and the bytes of a file, by
 * whose hash a controller is known, should not depend on a library's version. The longest possible
 * header is allocated at once, so that nothing can fail half way. */
#include "controller/internal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Length of the UTF-8 sequence at `text` (ending at its NUL at the latest); 0: not UTF-8. */
static size_t sequence(const unsigned char *text)
{
  static const struct {
    unsigned char mask, lead;
    uint32_t lowest; /* of the code point: longer forms than necessary are refused */
  } forms[] = {{0x80, 0x00, 0}, {0xe0, 0xc0, 0x80}, {0xf0, 0xe0, 0x800}, {0xf8, 0xf0, 0x10000}};
  for (size_t n = 0; n < 4; n++) {
    if ((text[0] & forms[n].mask) != forms[n].lead)
      continue;
    uint32_t code = text[0] & (unsigned char)~forms[n].mask;
    for (size_t i = 1; i <= n; i++) {
      if ((text[i] & 0xc0) != 0x80)
        return 0;
      code = code << 6 | (text[i] & 0x3f);
    }
    const bool surrogate = code >= 0xd800 && code <= 0xdfff;
    return code < forms[n].lowest || code > 0x10ffff || surrogate ? 0 : n + 1;
  }
  return 0;
}

bool mo_text_is_utf8(const char *text)
{
  const unsigned char *at = (const unsigned char *)text;
  while (*at != '\0') {
    const size_t n = sequence(at);
    if (n == 0)
      return false;
    at += n;
  }
  return true;
}

/* A JSON string with its quotes: at most 6 bytes per byte and 2 more. Returns its end. */
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
