/* checkpoint.c: encodes and decodes a training run.
 *
 * Little-endian, without padding: 8 bytes "morpho\r\n", the version (uint32), the size of the
 * settings (uint32), struct counters, the settings as JSON by their table, then, with VERSION_OWN,
 * the training run's own environments (struct worlds, then each in its packed form), then designs
 * (24 bytes each), weights (float32), first and second moments (float64 each), and a CRC-64 of
 * everything before it. Decoding trusts none of it: sizes must match to the byte, settings must
 * pass the checks of a new run, and numbers must be finite. */
#include "learning/internal.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "learning/fields.h"

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "checkpoints are little-endian");

#define VERSION     3 /* the run draws its environments */
#define VERSION_OWN 4 /* the run has its own environments */
#define SUM_BYTES   sizeof(uint64_t)

static const uint8_t magic[8] = {'m', 'o', 'r', 'p', 'h', 'o', '\r', '\n'};

/* The header between the magic and the settings. */
struct counters {
  uint32_t version, settings_bytes;
  uint32_t kind, sensor, held_out_designs, held_out_environments;
  uint32_t step, skipped;
  uint64_t seed, draws, n_designs, n_parameters;
};
_Static_assert(sizeof(struct counters) == 64, "without padding");
#define HEADER_BYTES (sizeof(magic) + sizeof(struct counters))

/* The environments of a checkpoint in VERSION_OWN. */
struct worlds {
  uint32_t n, version;   /* of the packed form */
  uint32_t draws_worlds; /* 1: only their tasks are the training run's own */
};

/* ---- checksum: CRC-64 with the polynomial of ECMA-182, reflected, as in the XZ format ---- */

#define POLYNOMIAL UINT64_C(0xC96C5795D7870F42)
#define SLICES     8

/* Not sanitized, for speed: code that sanitizers check reads the last bytes. */
__attribute__((no_sanitize("address", "thread", "undefined"))) static uint64_t
add_slices(const uint64_t table[SLICES][256], const uint8_t *bytes, size_t n, uint64_t crc)
{
  for (; n >= SLICES; n -= SLICES, bytes += SLICES) {
    uint64_t word;
    memcpy(&word, bytes, sizeof(word));
    crc ^= word;
    uint64_t next = 0;
    for (int k = 0; k < SLICES; k++)
      next ^= table[SLICES - 1 - k][crc >> 8 * k & 255];
    crc = next;
  }
  return crc;
}

uint64_t mo_checksum(const uint8_t *bytes, size_t n)
{
  uint64_t table[SLICES][256]; /* table[k][b]: byte b, then k zero bytes */
  for (uint32_t b = 0; b < 256; b++) {
    uint64_t crc = b;
    for (int bit = 0; bit < 8; bit++)
      crc = crc >> 1 ^ (crc & 1 ? POLYNOMIAL : 0);
    table[0][b] = crc;
  }
  for (int k = 1; k < SLICES; k++)
    for (uint32_t b = 0; b < 256; b++)
      table[k][b] = table[k - 1][b] >> 8 ^ table[0][table[k - 1][b] & 255];
  const size_t whole = n > 0 ? (n - 1) / SLICES * SLICES : 0;
  uint64_t crc = add_slices(table, bytes, whole, ~UINT64_C(0));
  for (size_t i = whole; i < n; i++)
    crc = crc >> 8 ^ table[0][(crc ^ bytes[i]) & 255];
  return ~crc;
}

/* ---- fields ---- */

/* Copies fields to `to` or from `from`. */
struct codec {
  uint8_t *to;
  const uint8_t *from; /* NULL: writes */
  size_t at;
};

static void field(struct codec *codec, void *value, size_t size)
{
  if (codec->from != NULL)
    memcpy(value, codec->from + codec->at, size);
  else
    memcpy(codec->to + codec->at, value, size);
  codec->at += size;
}

static size_t body_bytes(uint64_t n_designs, uint64_t n_parameters)
{
  return n_designs * MO_DEFAULT_WORDS * sizeof(uint64_t) +
         n_parameters * (sizeof(float) + 2 * sizeof(double));
}

/* Reads or writes the arrays after the header, in this order. */
static void body(struct codec *codec, struct mo_training *training)
{
  const size_t n = training->controller->n_parameters;
  if (training->n_designs > 0)
    field(codec, training->designs,
          (size_t)training->n_designs * MO_DEFAULT_WORDS * sizeof(uint64_t));
  field(codec, training->controller->parameters, n * sizeof(float));
  field(codec, training->adam.first, n * sizeof(double));
  field(codec, training->adam.second, n * sizeof(double));
}

int mo_training_encode(const struct mo_training *training, uint8_t **bytes, size_t *size)
{
  /* The arrays are passed by address, but writing does not change them. Meanwhile, a draw ahead may
   * change the other members. */
  const struct mo_training_settings *settings = &training->settings;
  struct mo_training copy = {.controller = training->controller,
                             .adam = training->adam,
                             .n_designs = training->n_designs,
                             .designs = training->designs};
  struct worlds worlds = {training->n_environments, mo_training_environments_version(training),
                          training->draws_worlds};
  const bool is_own = worlds.n > 0;
  const size_t worlds_bytes =
      is_own ? sizeof(worlds) + mo_training_environments_bytes(training, worlds.version) : 0;
  struct mo_text text = {0};
  mo_fields_write_object(&text, &mo_recipe_fields, settings);
  struct counters counters = {.version = is_own ? VERSION_OWN : VERSION,
                              .settings_bytes = (uint32_t)text.size,
                              .kind = settings->kind,
                              .sensor = settings->sensor,
                              .held_out_designs = settings->held_out_designs,
                              .held_out_environments = settings->held_out_environments,
                              .step = training->step,
                              .skipped = training->skipped,
                              .seed = settings->seed,
                              .n_designs = training->n_designs,
                              .draws = training->draws,
                              .n_parameters = training->controller->n_parameters};
  struct codec codec = {.to = text.failed
                                  ? NULL
                                  : malloc(HEADER_BYTES + text.size + worlds_bytes +
                                           body_bytes(counters.n_designs, counters.n_parameters) +
                                           SUM_BYTES)};
  if (codec.to == NULL) {
    mo_text_free(&text);
    return MO_ERR_NO_MEMORY;
  }
  memcpy(codec.to, magic, sizeof(magic));
  codec.at = sizeof(magic);
  field(&codec, &counters, sizeof(counters));
  field(&codec, text.data, text.size);
  if (is_own) {
    field(&codec, &worlds, sizeof(worlds));
    mo_training_environments_pack(training, worlds.version, codec.to + codec.at);
    codec.at += worlds_bytes - sizeof(worlds);
  }
  body(&codec, &copy);
  uint64_t sum = mo_checksum(codec.to, codec.at);
  field(&codec, &sum, sizeof(sum));
  mo_text_free(&text);
  *bytes = codec.to;
  *size = codec.at;
  return MO_OK;
}

static int damaged(struct mo_message *message, const char *what)
{
  return mo_fail(message, MO_ERR_FORMAT, "the checkpoint is damaged: %s", what);
}

static int read_settings(const char *text, const struct counters *counters,
                         struct mo_training_settings *settings, struct mo_message *message)
{
  struct mo_message why = {""};
  *settings = mo_training_defaults((enum mo_training_kind)counters->kind);
  settings->physics = mo_paper_physics(); /* for settings that are newer than the checkpoint */
  settings->seed = counters->seed;
  settings->sensor = (enum mo_sensor)counters->sensor;
  settings->held_out_designs = counters->held_out_designs;
  settings->held_out_environments = counters->held_out_environments;
  int error = mo_fields_parse(text, counters->settings_bytes, &mo_recipe_fields, settings, &why);
  if (error == MO_OK)
    error = mo_training_settings_check(settings, &why);
  if (error == MO_OK || error == MO_ERR_NO_MEMORY)
    return error;
  return mo_fail(message, MO_ERR_FORMAT, "the checkpoint has invalid settings: %.180s", why.text);
}

static int check_header(const struct mo_training_settings *settings,
                        const struct counters *counters, struct mo_message *message)
{
  if (counters->step > settings->n_steps || counters->skipped > counters->step)
    return damaged(message, "it has more steps than its training run");
  const bool finetune = settings->kind == MO_TRAINING_FINETUNE;
  if (finetune != (counters->n_designs > 0) || counters->n_designs > MO_TRAINING_DESIGNS_MAX)
    return damaged(message, "its number of designs does not match its kind");
  if ((finetune && counters->draws != 0) ||
      counters->draws < (finetune ? 0 : (uint64_t)counters->step * settings->batch))
    return damaged(message, "its stream of bodies is shorter than its steps");
  return MO_OK;
}

static int check_values(const struct mo_training *training, struct mo_message *message)
{
  for (size_t i = 0; i < training->controller->n_parameters; i++) {
    if (!(fabsf(training->controller->parameters[i]) <= MO_WEIGHT_LIMIT))
      return damaged(message, "a weight is not finite, or exceeds its limit");
    if (!isfinite(training->adam.first[i]) || !isfinite(training->adam.second[i]) ||
        training->adam.second[i] < 0.0)
      return damaged(message, "a moment is not finite, or a second moment is negative");
  }
  for (uint32_t i = 0; i < training->n_designs; i++) {
    const uint64_t *design = training->designs + (size_t)MO_DEFAULT_WORDS * i;
    const int r = mo_training_design_is_placed(design);
    if (r <= 0)
      return r < 0 ? r
                   : damaged(message,
                             "a design is empty, not in one piece, or not in its canonical place");
  }
  return MO_OK;
}

/* Reads the training run's own environments. size: of the checkpoint. */
static int read_worlds(struct codec *codec, size_t size, struct mo_training *training,
                       struct mo_message *message)
{
  static const char what[] = "its environments are invalid";
  struct worlds worlds = {0};
  if (size < codec->at + sizeof(worlds) + SUM_BYTES)
    return damaged(message, what);
  field(codec, &worlds, sizeof(worlds));
  if (worlds.n < 1 || worlds.n > MO_TRAINING_ENVIRONMENTS_MAX || worlds.draws_worlds > 1)
    return damaged(message, what);
  int r = mo_training_allocate_environments(training, worlds.n);
  if (r < 0)
    return mo_fail(message, r, "the training run does not fit in memory");
  size_t bytes = 0;
  r = mo_training_environments_unpack(training, worlds.version, codec->from + codec->at,
                                      size - SUM_BYTES - codec->at, &bytes);
  codec->at += bytes;
  training->draws_worlds = worlds.draws_worlds == 1;
  if (r == MO_ERR_NO_MEMORY)
    return mo_fail(message, r, "the training run does not fit in memory");
  return r == MO_OK ? MO_OK : damaged(message, what);
}

static int read_arrays(struct codec *codec, const struct mo_training_settings *settings,
                       const struct counters *counters, size_t size, struct mo_training **training,
                       struct mo_message *message)
{
  struct mo_training *made = NULL;
  int r = mo_training_allocate(settings, (uint32_t)counters->n_designs, &made);
  if (r < 0)
    return mo_fail(message, r, "the training run does not fit in memory");
  const uint64_t n = made->controller->n_parameters;
  if (counters->version == VERSION_OWN)
    r = read_worlds(codec, size, made, message);
  if (r == MO_OK && counters->n_parameters != n)
    r = damaged(message, "its number of parameters is wrong");
  else if (r == MO_OK && size != codec->at + body_bytes(counters->n_designs, n) + SUM_BYTES)
    r = damaged(message, "its size does not match its contents");
  if (r == MO_OK) {
    body(codec, made);
    made->step = counters->step;
    made->skipped = counters->skipped;
    made->draws = counters->draws;
    mo_adam_count(&made->adam, settings, counters->step - counters->skipped);
    r = check_values(made, message);
  }
  if (r < 0) {
    mo_training_free(made);
    return r;
  }
  *training = made;
  return MO_OK;
}

int mo_training_decode(const uint8_t *bytes, size_t size, struct mo_training **training,
                       struct mo_message *message)
{
  if (size < sizeof(magic) || memcmp(bytes, magic, sizeof(magic)) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "not a checkpoint of a training run");
  if (size < HEADER_BYTES + SUM_BYTES)
    return damaged(message, "it is too short");
  struct codec codec = {.from = bytes, .at = sizeof(magic)};
  struct mo_training_settings settings;
  struct counters counters;
  field(&codec, &counters, sizeof(counters));
  if (counters.version != VERSION && counters.version != VERSION_OWN)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the checkpoint has version %" PRIu32 "; this program reads versions %d and %d",
                   counters.version, VERSION, VERSION_OWN);
  uint64_t sum;
  memcpy(&sum, bytes + size - SUM_BYTES, SUM_BYTES);
  if (sum != mo_checksum(bytes, size - SUM_BYTES))
    return damaged(message, "its checksum is wrong");
  if (counters.settings_bytes > size - SUM_BYTES - HEADER_BYTES)
    return damaged(message, "its settings extend past its end");
  int r = read_settings((const char *)bytes + HEADER_BYTES, &counters, &settings, message);
  codec.at += counters.settings_bytes;
  if (r == MO_OK)
    r = check_header(&settings, &counters, message);
  return r == MO_OK ? read_arrays(&codec, &settings, &counters, size, training, message) : r;
}
