/* checkpoint.c: encodes and decodes a training.
 *
 * Little-endian, without padding: 8 bytes "morpho\r\n", the version (uint32), the fields in the
 * order of header() below, then designs (24 bytes each), weights (float32), first and second
 * moments (float64 each), and a CRC-64 of everything before it. One function writes and reads the
 * same list of fields. Decoding trusts nothing: sizes must agree to the byte, settings must pass
 * the checks of a new training, and numbers must be finite. */
#include "learning/internal.h"

#include "base/file.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "checkpoints are little-endian");

#define VERSION      2
#define HEADER_BYTES 240
#define SUM_BYTES    sizeof(uint64_t)

static const uint8_t magic[8] = {'m', 'o', 'r', 'p', 'h', 'o', '\r', '\n'};

/* Copies fields to `bytes` or from it; there is room for HEADER_BYTES. */
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

static void field_u32(struct codec *codec, uint32_t *value)
{
  field(codec, value, sizeof(*value));
}

static void field_u64(struct codec *codec, uint64_t *value)
{
  field(codec, value, sizeof(*value));
}

static void field_f64(struct codec *codec, double *value)
{
  field(codec, value, sizeof(*value));
}

/* Reads or writes an enumeration's field; a value read may be invalid. */
static int field_kind(struct codec *codec, int value)
{
  field(codec, &value, sizeof(value));
  return value;
}

struct counters {
  uint32_t version, step, skipped, n_designs;
  uint64_t draws, n_parameters;
};

static void schedule_fields(struct codec *codec, struct mo_schedule *schedule)
{
  schedule->kind = (enum mo_schedule_kind)field_kind(codec, (int)schedule->kind);
  field_f64(codec, &schedule->peak);
  field_f64(codec, &schedule->floor);
  field_f64(codec, &schedule->decay);
  field_u32(codec, &schedule->cycle_steps);
  field_u32(codec, &schedule->cycle_growth);
  field_u32(codec, &schedule->warmup_steps);
}

static void physics_fields(struct codec *codec, struct mo_physics *physics)
{
  field_f64(codec, &physics->dt_s);
  field_u32(codec, &physics->n_steps);
  field_f64(codec, &physics->stiffness_n_per_m);
  field_f64(codec, &physics->mass_kg);
  field_f64(codec, &physics->drag_per_s);
  field_f64(codec, &physics->gravity_m_per_s2);
  field_f64(codec, &physics->actuation);
  field_f64(codec, &physics->friction);
  field_f64(codec, &physics->friction_cap);
  field_f64(codec, &physics->drop_height_m);
  physics->impact = (enum mo_impact)field_kind(codec, (int)physics->impact);
  field_u32(codec, &physics->bisections);
}

static void header(struct codec *codec, struct mo_training_settings *settings,
                   struct counters *counters)
{
  field_u32(codec, &counters->version);
  settings->kind = (enum mo_training_kind)field_kind(codec, (int)settings->kind);
  field_u64(codec, &settings->seed);
  field_u32(codec, &settings->n_steps);
  field_u32(codec, &settings->batch);
  schedule_fields(codec, &settings->learning.schedule);
  field_f64(codec, &settings->learning.beta1);
  field_f64(codec, &settings->learning.beta2);
  field_f64(codec, &settings->learning.epsilon);
  field_f64(codec, &settings->learning.norm_limit);
  field_f64(codec, &settings->learning.adjoint_bound);
  settings->learning.adjoint_rule =
      (enum mo_adjoint_rule)field_kind(codec, (int)settings->learning.adjoint_rule);
  field_f64(codec, &settings->learning.restart_weight);
  physics_fields(codec, &settings->physics);
  settings->sensor = (enum mo_sensor)field_kind(codec, (int)settings->sensor);
  field_u32(codec, &settings->held_out_designs);
  field_u32(codec, &settings->held_out_environments);
  field_u32(codec, &counters->step);
  field_u32(codec, &counters->skipped);
  field_u64(codec, &counters->draws);
  field_u32(codec, &counters->n_designs);
  field_u64(codec, &counters->n_parameters);
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
  /* Fields are passed by address, but writing changes none. A concurrent draw ahead may change the
   * other members. */
  struct mo_training copy = {.settings = training->settings,
                             .controller = training->controller,
                             .adam = training->adam,
                             .step = training->step,
                             .skipped = training->skipped,
                             .n_designs = training->n_designs,
                             .designs = training->designs,
                             .draws = training->draws};
  struct counters counters = {VERSION,        copy.step,  copy.skipped,
                              copy.n_designs, copy.draws, copy.controller->n_parameters};
  const size_t all = sizeof(magic) + HEADER_BYTES +
                     body_bytes(counters.n_designs, counters.n_parameters) + SUM_BYTES;
  struct codec codec = {.to = malloc(all)};
  if (codec.to == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(codec.to, magic, sizeof(magic));
  codec.at = sizeof(magic);
  header(&codec, &copy.settings, &counters);
  body(&codec, &copy);
  uint64_t sum = mo_checksum(codec.to, codec.at);
  field_u64(&codec, &sum);
  *bytes = codec.to;
  *size = codec.at;
  return MO_OK;
}

static int damaged(struct mo_message *message, const char *what)
{
  return mo_fail(message, MO_ERR_FORMAT, "the checkpoint is damaged: %s", what);
}

static int check_header(const struct mo_training_settings *settings,
                        const struct counters *counters, struct mo_message *message)
{
  struct mo_message why = {""};
  if (mo_training_settings_check(settings, &why) != MO_OK)
    return mo_fail(message, MO_ERR_FORMAT, "the checkpoint's settings are not acceptable: %.180s",
                   why.text);
  if (counters->step > settings->n_steps || counters->skipped > counters->step)
    return damaged(message, "it has more steps than its training");
  const bool finetune = settings->kind == MO_TRAINING_FINETUNE;
  if (finetune != (counters->n_designs > 0) || counters->n_designs > MO_TRAINING_DESIGNS_MAX)
    return damaged(message, "the number of its designs does not suit its kind");
  if ((finetune && counters->draws != 0) ||
      counters->draws < (finetune ? 0 : (uint64_t)counters->step * settings->batch))
    return damaged(message, "its stream of bodies is shorter than its steps");
  return MO_OK;
}

static int check_values(const struct mo_training *training, struct mo_message *message)
{
  for (size_t i = 0; i < training->controller->n_parameters; i++) {
    if (!(fabsf(training->controller->parameters[i]) <= MO_WEIGHT_LIMIT))
      return damaged(message, "a weight is not finite or beyond its limit");
    if (!isfinite(training->adam.first[i]) || !isfinite(training->adam.second[i]) ||
        training->adam.second[i] < 0.0)
      return damaged(message, "a moment is not finite, or a second moment is negative");
  }
  struct mo_message why = {""};
  const int r = mo_training_check_designs(training->designs, training->n_designs, &why);
  if (r == MO_ERR_INVALID)
    return mo_fail(message, MO_ERR_FORMAT, "the checkpoint is damaged: %.180s", why.text);
  return r;
}

static int read_arrays(struct codec *codec, const struct mo_training_settings *settings,
                       const struct counters *counters, size_t size, struct mo_training **training,
                       struct mo_message *message)
{
  struct mo_training *made = NULL;
  int r = mo_training_allocate(settings, counters->n_designs, &made);
  if (r < 0)
    return mo_fail(message, r, "the training does not fit in memory");
  const uint64_t n = made->controller->n_parameters;
  if (counters->n_parameters != n)
    r = damaged(message, "it has another number of parameters");
  else if (size != codec->at + body_bytes(counters->n_designs, n) + SUM_BYTES)
    r = damaged(message, "its size does not agree with its contents");
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
    return mo_fail(message, MO_ERR_FORMAT, "not a checkpoint of a training");
  if (size < sizeof(magic) + sizeof(uint32_t) + SUM_BYTES)
    return damaged(message, "it is too short");
  uint32_t version;
  memcpy(&version, bytes + sizeof(magic), sizeof(version));
  if (version != VERSION)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the checkpoint is of version %" PRIu32 "; this program reads version %d",
                   version, VERSION);
  if (size < sizeof(magic) + HEADER_BYTES + SUM_BYTES)
    return damaged(message, "it is too short");
  uint64_t sum;
  memcpy(&sum, bytes + size - SUM_BYTES, SUM_BYTES);
  if (sum != mo_checksum(bytes, size - SUM_BYTES))
    return damaged(message, "its checksum is wrong");
  struct codec codec = {.from = bytes, .at = sizeof(magic)};
  struct mo_training_settings settings = {0};
  struct counters counters = {0};
  header(&codec, &settings, &counters);
  const int r = check_header(&settings, &counters, message);
  return r == MO_OK ? read_arrays(&codec, &settings, &counters, size, training, message) : r;
}
