/* export.c: the controller of a training with its lineage, all of it a function of the training's
 * state. */
#include "learning/internal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/number.h"

#define SETTINGS_BYTES 2048
#define CODE_BYTES     (MO_LINEAGE_MAX * (MO_FINGERPRINT_BYTES + 48) + 4)

static void spell_settings(const struct mo_training *training, char text[SETTINGS_BYTES])
{
  const struct mo_training_settings *s = &training->settings;
  const struct mo_schedule *rate = &s->schedule;
  const struct mo_physics *p = &s->physics;
  char n[18][MO_NUMBER_BYTES], impact[24] = "exact";
  if (p->impact == MO_IMPACT_BISECTION)
    snprintf(impact, sizeof(impact), "bisection%" PRIu32, p->bisections);
  snprintf(
      text, SETTINGS_BYTES,
      "{\"steps\":%" PRIu32 ",\"batch\":%" PRIu32
      ",\"schedule\":{\"kind\":\"%s\",\"peak\":%s,\"floor\":%s,"
      "\"decay\":%s,\"cycle_steps\":%" PRIu32 ",\"cycle_growth\":%" PRIu32
      ",\"warmup_steps\":%" PRIu32 "},"
      "\"adam\":{\"beta1\":%s,\"beta2\":%s,\"epsilon\":%s},\"gradient_norm_limit\":%s,\"adjoint_"
      "bound\":%s,"
      "\"adjoint_rule\":\"%s\",\"restart_weight\":%s,\"physics\":{\"dt_s\":%s,\"n_steps\":%" PRIu32
      ","
      "\"stiffness_n_per_m\":%s,\"mass_kg\":%s,\"drag_per_s\":%s,\"gravity_m_per_s2\":%s,"
      "\"actuation\":%s,"
      "\"friction\":%s,\"friction_cap\":%s,\"drop_height_m\":%s,\"impact\":\"%s\"},\"designs\":"
      "%" PRIu32 "}",
      s->n_steps, s->batch, mo_schedule_name(rate->kind), mo_number_text(rate->peak, n[0]),
      mo_number_text(rate->floor, n[1]), mo_number_text(rate->decay, n[2]), rate->cycle_steps,
      rate->cycle_growth, rate->warmup_steps, mo_number_text(s->beta1, n[3]),
      mo_number_text(s->beta2, n[4]), mo_number_text(s->epsilon, n[5]),
      mo_number_text(s->norm_limit, n[6]), mo_number_text(s->adjoint_bound, n[7]),
      mo_adjoint_rule_name(s->adjoint_rule), mo_number_text(s->restart_weight, n[16]),
      mo_number_text(p->dt_s, n[8]), p->n_steps, mo_number_text(p->stiffness_n_per_m, n[9]),
      mo_number_text(p->mass_kg, n[10]), mo_number_text(p->drag_per_s, n[11]),
      mo_number_text(p->gravity_m_per_s2, n[12]), mo_number_text(p->actuation, n[13]),
      mo_number_text(p->friction, n[14]), mo_number_text(p->friction_cap, n[15]),
      mo_number_text(p->drop_height_m, n[17]), impact, training->n_designs);
}

/* The entries below the training's step. MO_ERR_INVALID: a fingerprint that JSON cannot hold as it
 * is. */
static int spell_code(const struct mo_training *training, const struct mo_training_lineage *lineage,
                      char text[CODE_BYTES])
{
  size_t size = 1;
  text[0] = '[';
  for (uint32_t i = 0; i < lineage->n && i < MO_LINEAGE_MAX; i++) {
    const struct mo_training_code *code = &lineage->codes[i];
    for (const char *c = code->fingerprint; *c != '\0'; c++)
      if (*c < ' ' || *c > '~' || *c == '"' || *c == '\\')
        return MO_ERR_INVALID;
    if (code->from_step >= training->step)
      break;
    const char *quote = code->fingerprint[0] != '\0' ? "\"" : "";
    size += (size_t)snprintf(text + size, CODE_BYTES - size,
                             "%s{\"from_step\":%" PRIu32 ",\"fingerprint\":%s%.*s%s}",
                             i > 0 ? "," : "", code->from_step, quote, MO_FINGERPRINT_BYTES - 1,
                             quote[0] != '\0' ? code->fingerprint : "null", quote);
  }
  memcpy(text + size, "]", 2);
  return MO_OK;
}

int mo_training_export(const struct mo_training *training, const char *parent_sha256_hex,
                       const char *code_version, const struct mo_training_lineage *lineage,
                       struct mo_controller **controller)
{
  struct mo_controller *made = NULL;
  int r = mo_controller_create(MO_DEFAULT_WORKSPACE, training->settings.sensor, &made);
  if (r < 0)
    return r;
  memcpy(made->parameters, training->controller->parameters, made->n_parameters * sizeof(float));
  char settings[SETTINGS_BYTES], code[CODE_BYTES], seed[MO_NUMBER_BYTES], step[MO_NUMBER_BYTES],
      designs[MO_NUMBER_BYTES];
  spell_settings(training, settings);
  snprintf(seed, sizeof(seed), "%" PRIu64, training->settings.seed);
  snprintf(step, sizeof(step), "%" PRIu32, training->step);
  snprintf(designs, sizeof(designs), "%016" PRIx64,
           mo_checksum((const uint8_t *)training->designs,
                       (size_t)training->n_designs * MO_DEFAULT_WORDS * sizeof(uint64_t)));
  const char *const entries[][2] = {
      {"morphod.kind", training->settings.kind == MO_TRAINING_PRETRAIN ? "pretrain" : "finetune"},
      {"morphod.parent", parent_sha256_hex != NULL ? parent_sha256_hex : "random"},
      {"morphod.seed", seed},
      {"morphod.settings", settings},
      {"morphod.step", step},
      {"morphod.version", code_version},
      {"morphod.designs_crc64", designs}};
  size_t n = sizeof(entries) / sizeof(entries[0]);
  if (training->settings.kind == MO_TRAINING_PRETRAIN)
    n--;
  for (size_t i = 0; i < n && r == MO_OK; i++)
    r = mo_controller_set_metadata(made, entries[i][0], entries[i][1]);
  if (lineage != NULL && r == MO_OK)
    r = spell_code(training, lineage, code);
  if (lineage != NULL && r == MO_OK)
    r = mo_controller_set_metadata(made, "morphod.code", code);
  if (r < 0) {
    mo_controller_free(made);
    return r;
  }
  *controller = made;
  return MO_OK;
}
