/* encode.c: fixed little-endian layouts. */
#include "store/encode.h"

#include <string.h>

void mo_encode_u32(uint32_t value, uint8_t bytes[4])
{
  for (int i = 0; i < 4; i++)
    bytes[i] = (uint8_t)(value >> (8 * i));
}

uint32_t mo_decode_u32(const uint8_t bytes[4])
{
  uint32_t value = 0;
  for (int i = 3; i >= 0; i--)
    value = (value << 8) | bytes[i];
  return value;
}

void mo_encode_double(double value, uint8_t bytes[8])
{
  uint64_t word;
  memcpy(&word, &value, sizeof(word));
  for (int i = 0; i < 8; i++)
    bytes[i] = (uint8_t)(word >> (8 * i));
}

double mo_decode_double(const uint8_t bytes[8])
{
  uint64_t word = 0;
  double value;
  for (int i = 7; i >= 0; i--)
    word = (word << 8) | bytes[i];
  memcpy(&value, &word, sizeof(value));
  return value;
}

void mo_encode_doubles(const double *values, size_t n, uint8_t *bytes)
{
  for (size_t i = 0; i < n; i++)
    mo_encode_double(values[i], bytes + 8 * i);
}

void mo_decode_doubles(const uint8_t *bytes, size_t n, double *values)
{
  for (size_t i = 0; i < n; i++)
    values[i] = mo_decode_double(bytes + 8 * i);
}

void mo_encode_floats(const float *values, size_t n, uint8_t *bytes)
{
  for (size_t i = 0; i < n; i++) {
    uint32_t word;
    memcpy(&word, &values[i], sizeof(word));
    mo_encode_u32(word, bytes + 4 * i);
  }
}

void mo_decode_floats(const uint8_t *bytes, size_t n, float *values)
{
  for (size_t i = 0; i < n; i++) {
    uint32_t word = mo_decode_u32(bytes + 4 * i);
    memcpy(&values[i], &word, sizeof(word));
  }
}

/* Writes −0 as 0, so that equal environments have one row and are computed once. */
void mo_encode_environment(const struct mo_environment *environment,
                           uint8_t bytes[MO_ENVIRONMENT_BYTES])
{
  for (size_t i = 0; i < 2 + MO_TERRAIN_HEIGHTS; i++) {
    double value = i < 2 ? environment->light_xy_m[i] : environment->terrain_heights_m[i - 2];
    mo_encode_double(value == 0.0 ? 0.0 : value, bytes + 8 * i);
  }
}

void mo_decode_environment(const uint8_t bytes[MO_ENVIRONMENT_BYTES],
                           struct mo_environment *environment)
{
  mo_decode_doubles(bytes, 2, environment->light_xy_m);
  mo_decode_doubles(bytes + 16, MO_TERRAIN_HEIGHTS, environment->terrain_heights_m);
}

void mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                       enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES])
{
  const double values[9] = {
      physics->dt_s,       physics->stiffness_n_per_m, physics->mass_kg,
      physics->drag_per_s, physics->gravity_m_per_s2,  physics->actuation,
      physics->friction,   physics->friction_cap,      physics->drop_height_m};
  uint8_t *words = bytes + 1 + 9 * 8;
  bytes[0] = 1;
  for (size_t i = 0; i < 9; i++)
    mo_encode_double(values[i] == 0.0 ? 0.0 : values[i], bytes + 1 + 8 * i);
  mo_encode_u32(physics->n_steps, words);
  mo_encode_u32((uint32_t)physics->impact, words + 4);
  mo_encode_u32(physics->impact == MO_IMPACT_BISECTION ? physics->bisections : 0, words + 8);
  mo_encode_u32((uint32_t)precision, words + 12);
  mo_encode_u32((uint32_t)sensor, words + 16);
}

int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor)
{
  const uint8_t *words;
  uint32_t impact, chosen_precision, chosen_sensor;
  if (size != MO_PHYSICS_BYTES || bytes[0] != 1)
    return MO_ERR_CORRUPT;
  words = bytes + 1 + 9 * 8;
  impact = mo_decode_u32(words + 4);
  chosen_precision = mo_decode_u32(words + 12);
  chosen_sensor = mo_decode_u32(words + 16);
  if (impact > MO_IMPACT_BISECTION || chosen_precision > MO_FLOAT64 ||
      chosen_sensor > MO_SENSOR_INVERSE_SQUARE)
    return MO_ERR_CORRUPT;
  *physics = (struct mo_physics){
      .dt_s = mo_decode_double(bytes + 1),
      .n_steps = mo_decode_u32(words),
      .stiffness_n_per_m = mo_decode_double(bytes + 9),
      .mass_kg = mo_decode_double(bytes + 17),
      .drag_per_s = mo_decode_double(bytes + 25),
      .gravity_m_per_s2 = mo_decode_double(bytes + 33),
      .actuation = mo_decode_double(bytes + 41),
      .friction = mo_decode_double(bytes + 49),
      .friction_cap = mo_decode_double(bytes + 57),
      .drop_height_m = mo_decode_double(bytes + 65),
      .impact = (enum mo_impact)impact,
      .bisections = impact == MO_IMPACT_BISECTION ? mo_decode_u32(words + 8) : 8,
  };
  *precision = (enum mo_precision)chosen_precision;
  *sensor = (enum mo_sensor)chosen_sensor;
  return MO_OK;
}

/* Encodes the end of settings: the rule of the adjoint, a 32-bit word, and the restart weight, a
 * double. */
static void encode_rule(enum mo_adjoint_rule rule, double weight, uint8_t bytes[MO_RULE_BYTES])
{
  mo_encode_u32((uint32_t)rule, bytes);
  mo_encode_double(weight, bytes + 4);
}

static int decode_rule(const uint8_t *bytes, size_t size, size_t expected,
                       enum mo_adjoint_rule *rule, double *weight)
{
  uint32_t word;
  if (bytes == NULL || size != expected || bytes[0] != 2)
    return MO_ERR_CORRUPT;
  word = mo_decode_u32(bytes + size - MO_RULE_BYTES);
  *weight = mo_decode_double(bytes + size - MO_RULE_BYTES + 4);
  *rule = (enum mo_adjoint_rule)word;
  return word > MO_ADJOINT_RESTART ? MO_ERR_CORRUPT : MO_OK;
}

/* Version 2: the byte 2; 32-bit words kind, steps, batch, schedule kind, cycle steps, cycle growth,
 * warm-up, held-out designs, held-out environments, impact's bisections; the 64-bit seed; doubles
 * peak, floor, decay, beta1, beta2, epsilon, norm limit, adjoint bound; physics with precision and
 * sensor; the adjoint's rule and restart weight. */
void mo_encode_training(const struct mo_training_settings *settings,
                        uint8_t bytes[MO_TRAINING_BYTES])
{
  const struct mo_schedule *schedule = &settings->learning.schedule;
  const uint32_t words[10] = {
      (uint32_t)settings->kind,    settings->n_steps,          settings->batch,
      (uint32_t)schedule->kind,    schedule->cycle_steps,      schedule->cycle_growth,
      schedule->warmup_steps,      settings->held_out_designs, settings->held_out_environments,
      settings->physics.bisections};
  const double values[8] = {schedule->peak,
                            schedule->floor,
                            schedule->decay,
                            settings->learning.beta1,
                            settings->learning.beta2,
                            settings->learning.epsilon,
                            settings->learning.norm_limit,
                            settings->learning.adjoint_bound};
  uint8_t *at = bytes;
  *at++ = 2;
  for (size_t i = 0; i < 10; i++, at += 4)
    mo_encode_u32(words[i], at);
  mo_encode_u32((uint32_t)settings->seed, at);
  mo_encode_u32((uint32_t)(settings->seed >> 32), at + 4);
  mo_encode_doubles(values, 8, at + 8);
  mo_encode_physics(&settings->physics, MO_FLOAT32, settings->sensor, at + 8 + 8 * 8);
  encode_rule(settings->learning.adjoint_rule, settings->learning.restart_weight,
              at + 8 + 8 * 8 + MO_PHYSICS_BYTES);
}

int mo_decode_training(const uint8_t *bytes, size_t size, struct mo_training_settings *settings)
{
  uint32_t words[10];
  double values[8];
  enum mo_precision precision;
  enum mo_adjoint_rule rule;
  double weight;
  const uint8_t *at;
  uint64_t seed;
  int error = decode_rule(bytes, size, MO_TRAINING_BYTES, &rule, &weight);
  if (error != MO_OK)
    return error;
  at = bytes + 1;
  for (size_t i = 0; i < 10; i++, at += 4)
    words[i] = mo_decode_u32(at);
  seed = (uint64_t)mo_decode_u32(at + 4) << 32 | mo_decode_u32(at);
  mo_decode_doubles(at + 8, 8, values);
  if (words[0] > MO_TRAINING_FINETUNE || words[3] > MO_SCHEDULE_CONSTANT)
    return MO_ERR_CORRUPT;
  memset(settings, 0, sizeof(*settings));
  settings->kind = (enum mo_training_kind)words[0];
  settings->seed = seed;
  settings->n_steps = words[1];
  settings->batch = words[2];
  settings->learning.schedule = (struct mo_schedule){.kind = (enum mo_schedule_kind)words[3],
                                                     .peak = values[0],
                                                     .floor = values[1],
                                                     .decay = values[2],
                                                     .cycle_steps = words[4],
                                                     .cycle_growth = words[5],
                                                     .warmup_steps = words[6]};
  settings->learning.beta1 = values[3];
  settings->learning.beta2 = values[4];
  settings->learning.epsilon = values[5];
  settings->learning.norm_limit = values[6];
  settings->learning.adjoint_bound = values[7];
  settings->learning.adjoint_rule = rule;
  settings->learning.restart_weight = weight;
  settings->held_out_designs = words[7];
  settings->held_out_environments = words[8];
  error = mo_decode_physics(at + 8 + 8 * 8, MO_PHYSICS_BYTES, &settings->physics, &precision,
                            &settings->sensor);
  settings->physics.bisections = words[9];
  return error;
}

#define CAMPAIGN_WORDS  19
#define CAMPAIGN_VALUES 13

/* Version 2: the byte 2; 32-bit words mode, workspace x, y, z, population, generations, selection
 * kind, tournament size, layers, age gap, exclude pretraining, parent steps, child steps, batch,
 * schedule kind, cycle steps, cycle growth, warm-up, impact's bisections; the 64-bit seed; doubles
 * mutation share, rate, growth, novelty weight, collapse share, peak, floor, decay, beta1, beta2,
 * epsilon, norm limit, adjoint bound; physics with precision and sensor; the adjoint's rule and
 * restart weight. */
void mo_encode_campaign(const struct mo_campaign_settings *settings,
                        uint8_t bytes[MO_CAMPAIGN_BYTES])
{
  const struct mo_schedule *schedule = &settings->learning.schedule;
  const struct mo_selection *selection = &settings->selection;
  const uint32_t words[CAMPAIGN_WORDS] = {(uint32_t)settings->mode,      settings->workspace.nx,
                                          settings->workspace.ny,        settings->workspace.nz,
                                          settings->population,          settings->generations,
                                          (uint32_t)selection->kind,     selection->tournament_size,
                                          selection->n_layers,           selection->age_gap,
                                          settings->exclude_pretraining, settings->parent_steps,
                                          settings->child_steps,         settings->batch,
                                          (uint32_t)schedule->kind,      schedule->cycle_steps,
                                          schedule->cycle_growth,        schedule->warmup_steps,
                                          settings->physics.bisections};
  const double values[CAMPAIGN_VALUES] = {settings->mutation_share,
                                          settings->mutation_rate,
                                          settings->mutation_growth,
                                          selection->novelty_weight,
                                          settings->collapse_share,
                                          schedule->peak,
                                          schedule->floor,
                                          schedule->decay,
                                          settings->learning.beta1,
                                          settings->learning.beta2,
                                          settings->learning.epsilon,
                                          settings->learning.norm_limit,
                                          settings->learning.adjoint_bound};
  uint8_t *at = bytes;
  *at++ = 2;
  for (size_t i = 0; i < CAMPAIGN_WORDS; i++, at += 4)
    mo_encode_u32(words[i], at);
  mo_encode_u32((uint32_t)settings->seed, at);
  mo_encode_u32((uint32_t)(settings->seed >> 32), at + 4);
  mo_encode_doubles(values, CAMPAIGN_VALUES, at + 8);
  mo_encode_physics(&settings->physics, MO_FLOAT32, settings->sensor, at + 8 + 8 * CAMPAIGN_VALUES);
  encode_rule(settings->learning.adjoint_rule, settings->learning.restart_weight,
              at + 8 + 8 * CAMPAIGN_VALUES + MO_PHYSICS_BYTES);
}

int mo_decode_campaign(const uint8_t *bytes, size_t size, struct mo_campaign_settings *settings)
{
  uint32_t words[CAMPAIGN_WORDS];
  double values[CAMPAIGN_VALUES];
  enum mo_precision precision;
  enum mo_adjoint_rule rule;
  double weight;
  const uint8_t *at;
  int error = decode_rule(bytes, size, MO_CAMPAIGN_BYTES, &rule, &weight);
  if (error != MO_OK)
    return error;
  at = bytes + 1;
  for (size_t i = 0; i < CAMPAIGN_WORDS; i++, at += 4)
    words[i] = mo_decode_u32(at);
  mo_decode_doubles(at + 8, CAMPAIGN_VALUES, values);
  if (words[0] > MO_SIMULTANEOUS || words[6] > MO_SELECT_AGE_LAYERED ||
      words[14] > MO_SCHEDULE_CONSTANT || words[1] > UINT16_MAX || words[2] > UINT16_MAX ||
      words[3] > UINT16_MAX || words[4] > MO_POPULATION_MAX)
    return MO_ERR_CORRUPT;
  *settings = (struct mo_campaign_settings){
      .mode = (enum mo_campaign_mode)words[0],
      .seed = (uint64_t)mo_decode_u32(at + 4) << 32 | mo_decode_u32(at),
      .workspace = {(uint16_t)words[1], (uint16_t)words[2], (uint16_t)words[3]},
      .population = words[4],
      .generations = words[5],
      .mutation_share = values[0],
      .mutation_rate = values[1],
      .mutation_growth = values[2],
      .selection = {(enum mo_selection_kind)words[6], words[7], values[3], words[8], words[9]},
      .exclude_pretraining = words[10] != 0,
      .collapse_share = values[4],
      .parent_steps = words[11],
      .child_steps = words[12],
      .batch = words[13],
      .learning.schedule = {.kind = (enum mo_schedule_kind)words[14],
                            .peak = values[5],
                            .floor = values[6],
                            .decay = values[7],
                            .cycle_steps = words[15],
                            .cycle_growth = words[16],
                            .warmup_steps = words[17]},
      .learning.beta1 = values[8],
      .learning.beta2 = values[9],
      .learning.epsilon = values[10],
      .learning.norm_limit = values[11],
      .learning.adjoint_bound = values[12],
      .learning.adjoint_rule = rule,
      .learning.restart_weight = weight,
  };
  error = mo_decode_physics(at + 8 + 8 * CAMPAIGN_VALUES, MO_PHYSICS_BYTES, &settings->physics,
                            &precision, &settings->sensor);
  settings->physics.bisections = words[18];
  return error;
}

void mo_encode_bits(const struct mo_bits *bits, uint8_t bytes[MO_BITS_BYTES])
{
  memset(bytes, 0, MO_BITS_BYTES);
  for (unsigned v = 0; v < MO_DEFAULT_VOXELS; v++)
    if ((bits->words[v >> 6] >> (v & 63)) & 1)
      bytes[v >> 3] |= (uint8_t)(0x80U >> (v & 7));
}

int mo_decode_bits(const uint8_t *bytes, size_t size, struct mo_bits *bits)
{
  if (size != MO_BITS_BYTES || bytes == NULL)
    return MO_ERR_CORRUPT;
  memset(bits, 0, sizeof(*bits));
  for (unsigned v = 0; v < MO_DEFAULT_VOXELS; v++)
    if (bytes[v >> 3] & (0x80U >> (v & 7)))
      bits->words[v >> 6] |= UINT64_C(1) << (v & 63);
  return MO_OK;
}
