/* checkpoint.c: the reader of a training's checkpoints.
 *
 * Byte 0 even: the rest is a file. Odd: the rest is a header, of 228 bytes in version 1 and of 240
 * otherwise, and then designs; the file is made whole with as many weights and moments as a
 * checkpoint has, zeros but for the first of each kind, which bits 1 to 3 choose, and a right
 * checksum. What the reader refuses it must explain; what it accepts must be sound and come back
 * the same from the writer, or, of version 1, the same but for the version, the rule and its
 * weight. */
#include "target.h"

#include "learning/internal.h"

#include <math.h>
#include <string.h>

enum {
  MAGIC = 8,
  HEADER_1 = 228,
  RULE = 104,
  RULE_BYTES = 12,
  N_DESIGNS_BACK = 12,
  DESIGN = 24,
  DESIGNS_MAX = 64
};
#define PARAMETERS UINT64_C(620912)

static bool is_first(const uint8_t *version)
{
  return version[0] == 1 && version[1] + version[2] + version[3] == 0;
}

/* Whether `written` is the file, or the file of version 1 with the version, the rule, the weight
 * and the checksum of version 2. */
static bool same(const uint8_t *written, size_t n, const uint8_t *data, size_t size)
{
  enum { TO = MAGIC + RULE, FROM = MAGIC + 4, SUM = 8 };
  static const double usual = MO_RESTART_WEIGHT;
  if (!is_first(data + MAGIC))
    return n == size && memcmp(written, data, size) == 0;
  return n == size + RULE_BYTES && memcmp(written + FROM, data + FROM, TO - FROM) == 0 &&
         memcmp(written + TO, "\0\0\0", 4) == 0 &&
         memcmp(written + TO + 4, &usual, sizeof(usual)) == 0 &&
         memcmp(written + TO + RULE_BYTES, data + TO, size - TO - SUM) == 0;
}

static void check_training(const struct mo_training *training, const uint8_t *data, size_t size)
{
  uint8_t *bytes = NULL;
  size_t again = 0;
  FUZZ_PROMISE(mo_training_settings_check(mo_training_settings_of(training), NULL) == MO_OK);
  FUZZ_PROMISE(mo_training_step(training) <= mo_training_settings_of(training)->n_steps);
  FUZZ_PROMISE(isfinite(training->adam.beta1_power) && isfinite(training->adam.beta2_power));
  for (size_t i = 0; i < training->controller->n_parameters; i++) {
    FUZZ_PROMISE(isfinite(training->controller->parameters[i]) &&
                 isfinite(training->adam.first[i]) && training->adam.second[i] >= 0.0);
  }
  if (mo_training_encode(training, &bytes, &again) == MO_OK) {
    FUZZ_PROMISE(same(bytes, again, data, size));
    free(bytes);
  }
}

static void read_file(const uint8_t *data, size_t size)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  int code = mo_training_decode(data, size, &training, &message);
  FUZZ_PROMISE(memchr(message.text, '\0', sizeof(message.text)) != NULL);
  if (code == MO_OK) {
    check_training(training, data, size);
  } else {
    FUZZ_PROMISE(code == MO_ERR_FORMAT || code == MO_ERR_NO_MEMORY);
    FUZZ_PROMISE(training == NULL && message.text[0] != '\0');
  }
  mo_training_free(training);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  static const double firsts[8] = {0.0, 1e-3, -1.5, NAN, INFINITY, 2e6, -0.0, 1e-310};
  const size_t header = size > 4 && is_first(data + 1) ? HEADER_1 : HEADER_1 + RULE_BYTES;
  if (size == 0 || (data[0] % 2 != 0 && size < 1 + header)) {
    return 0;
  }
  if (data[0] % 2 == 0) {
    read_file(data + 1, size - 1);
    return 0;
  }
  uint32_t n_designs;
  memcpy(&n_designs, data + 1 + header - N_DESIGNS_BACK, sizeof(n_designs));
  size_t designs = (n_designs < DESIGNS_MAX ? n_designs : DESIGNS_MAX) * (size_t)DESIGN;
  size_t given = size - 1 - header < designs ? size - 1 - header : designs;
  size_t whole = MAGIC + header + designs + PARAMETERS * 20 + sizeof(uint64_t);
  uint8_t *file = calloc(1, whole);
  if (file == NULL) {
    return 0;
  }
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
