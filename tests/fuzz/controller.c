/* controller.c: the reader of controller files (safetensors).
 *
 * Byte 0 even: the rest is a file. Odd: the rest is the header of a file with the data of a 1x1x1
 * controller, which is zero except for its first value (bits 1 and 2 choose it). The reader must
 * explain a refusal. Whatever it accepts must be finite, and must be written back unchanged. */
#include "target.h"

#include <math.h>
#include <morpho/controller.h>
#include <string.h>

#define TINY_FLOATS (256 * 13 + 2 * 256 * 256 + 24 * 256 + 24 + 9 * 256)

static void check_controller(const struct mo_controller *controller)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  for (size_t i = 0; i < controller->n_parameters; i++)
    FUZZ_PROMISE(isfinite(controller->parameters[i]));
  int code = mo_controller_encode(controller, &bytes, &size);
  if (code == MO_ERR_LIMIT || code == MO_ERR_NO_MEMORY)
    return;
  FUZZ_PROMISE(code == MO_OK);
  struct mo_controller *again = NULL;
  struct mo_message message;
  FUZZ_PROMISE(mo_controller_decode(bytes, size, &again, &message) == MO_OK);
  FUZZ_PROMISE(again->n_parameters == controller->n_parameters &&
               again->sensor == controller->sensor);
  FUZZ_PROMISE(memcmp(again->parameters, controller->parameters,
                      controller->n_parameters * sizeof(float)) == 0);
  FUZZ_PROMISE(again->n_metadata == controller->n_metadata);
  for (size_t i = 0; i < again->n_metadata; i++) {
    FUZZ_PROMISE(strcmp(again->metadata[i].key, controller->metadata[i].key) == 0);
    FUZZ_PROMISE(strcmp(again->metadata[i].value, controller->metadata[i].value) == 0);
  }
  mo_controller_free(again);
  free(bytes);
}

static void read_file(const uint8_t *data, size_t size)
{
  struct mo_controller *controller = NULL;
  struct mo_message message = {""};
  int code = mo_controller_decode(data, size, &controller, &message);
  FUZZ_PROMISE(memchr(message.text, '\0', sizeof(message.text)) != NULL);
  if (code == MO_OK) {
    check_controller(controller);
  } else {
    FUZZ_PROMISE(code == MO_ERR_FORMAT || code == MO_ERR_LIMIT || code == MO_ERR_NO_MEMORY);
    FUZZ_PROMISE(controller == NULL && message.text[0] != '\0');
  }
  mo_controller_free(controller);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  static const float firsts[4] = {0.0F, -1.5F, NAN, INFINITY};
  if (size == 0)
    return 0;
  if (data[0] % 2 == 0) {
    read_file(data + 1, size - 1);
    return 0;
  }
  uint64_t header = size - 1;
  uint8_t *file = calloc(1, 8 + header + TINY_FLOATS * sizeof(float));
  if (file == NULL)
    return 0;
  memcpy(file, &header, 8);
  memcpy(file + 8, data + 1, header);
  memcpy(file + 8 + header, &firsts[data[0] >> 1 & 3], sizeof(float));
  read_file(file, 8 + header + TINY_FLOATS * sizeof(float));
  free(file);
  return 0;
}
