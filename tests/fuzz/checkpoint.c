/* checkpoint.c: the reader of a training run's checkpoints.
 *
 * Byte 0 even: the rest is a file. Odd: the rest is the counters of a header, then its settings,
 * then designs. The file is completed with the weights and moments of a checkpoint, which are zero
 * except for the first of each kind (bits 1 to 3 choose it), and a correct checksum. The reader
 * must explain a refusal. Whatever it accepts must be valid, and must be the same after it was
 * written and read back. */
#include "target.h"

#include "learning/internal.h"

#include <math.h>
#include <string.h>

enum {
  MAGIC = 8,
  COUNTERS = 64,
  SETTINGS_BYTES = 4,
  N_DESIGNS = 48,
  DESIGN = 24,
  DESIGNS_MAX = 64
};
#define PARAMETERS UINT64_C(620912)

static void check_training(const struct mo_training *training)
{
  uint8_t *bytes = NULL, *again = NULL;
  size_t size = 0, size_again = 0;
  struct mo_training *read = NULL;
  FUZZ_PROMISE(mo_training_settings_check(mo_training_settings_of(training), NULL) == MO_OK);
  FUZZ_PROMISE(mo_training_step(training) <= mo_training_settings_of(training)->n_steps);
  FUZZ_PROMISE(isfinite(training->adam.beta1_power) && isfinite(training->adam.beta2_power));
  for (size_t i = 0; i < training->controller->n_parameters; i++) {
    FUZZ_PROMISE(isfinite(training->controller->parameters[i]) &&
                 isfinite(training->adam.first[i]) && training->adam.second[i] >= 0.0);
  }
  if (mo_training_encode(training, &bytes, &size) == MO_OK &&
      mo_training_decode(bytes, size, &read, NULL) == MO_OK &&
      mo_training_encode(read, &again, &size_again) == MO_OK)
    FUZZ_PROMISE(size == size_again && memcmp(bytes, again, size) == 0);
  mo_training_free(read);
  free(bytes);
  free(again);
}

static void read_file(const uint8_t *data, size_t size)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  int code = mo_training_decode(data, size, &training, &message);
  FUZZ_PROMISE(memchr(message.text, '\0', sizeof(message.text)) != NULL);
  if (code == MO_OK) {
    check_training(training);
  } else {
    FUZZ_PROMISE(code == MO_ERR_FORMAT || code == MO_ERR_NO_MEMORY);
    FUZZ_PROMISE(training == NULL && message.text[0] != '\0');
  }
  mo_training_free(training);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  static const double firsts[8] = {0.0, 1e-3, -1.5, NAN, INFINITY, 2e6, -0.0, 1e-310};
  if (size == 0 || (data[0] % 2 != 0 && size < 1 + COUNTERS))
    return 0;
  if (data[0] % 2 == 0) {
    read_file(data + 1, size - 1);
    return 0;
  }
  uint32_t settings_bytes;
  memcpy(&settings_bytes, data + 1 + SETTINGS_BYTES, sizeof(settings_bytes));
  if (settings_bytes > size - 1 - COUNTERS)
    return 0;
  const size_t header = COUNTERS + settings_bytes;
  uint64_t n_designs;
  memcpy(&n_designs, data + 1 + N_DESIGNS, sizeof(n_designs));
  size_t designs = (n_designs < DESIGNS_MAX ? n_designs : DESIGNS_MAX) * (size_t)DESIGN;
  size_t given = size - 1 - header < designs ? size - 1 - header : designs;
  size_t whole = MAGIC + header + designs + PARAMETERS * 20 + sizeof(uint64_t);
  uint8_t *file = calloc(1, whole);
  if (file == NULL)
    return 0;
  memcpy(file, "morpho\r\n", MAGIC);
  memcpy(file + MAGIC, data + 1, header + given);
  const double first = firsts[data[0] >> 1 & 7];
  const float weight = (float)first;
  uint8_t *weights = file + MAGIC + header + designs;
  memcpy(weights, &weight, sizeof(weight));
  memcpy(weights + PARAMETERS * 4, &first, sizeof(first));
  memcpy(weights + PARAMETERS * 12, &first, sizeof(first));
  uint64_t sum = mo_checksum(file, whole - sizeof(sum));
  memcpy(file + whole - sizeof(sum), &sum, sizeof(sum));
  read_file(file, whole);
  free(file);
  return 0;
}
