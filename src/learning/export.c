/* export.c: exports the controller of a training run with its lineage. The result depends only on
 * the training run's state. */
#include "learning/internal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "learning/fields.h"

static void write_settings(const struct mo_training *training, struct mo_text *text)
{
  mo_text_object(text);
  mo_fields_write(text, &mo_recipe_fields, &training->settings);
  mo_text_member_count(text, "designs", training->n_designs);
  if (training->n_environments > 0)
    mo_text_member_count(text, training->draws_worlds ? "tasks" : "environments",
                         training->n_environments);
  mo_text_add(text, "}");
}

/* Writes the entries below the training run's step. */
static void write_code(const struct mo_training *training,
                       const struct mo_training_lineage *lineage, struct mo_text *text)
{
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < lineage->n && i < MO_LINEAGE_MAX; i++) {
    const struct mo_training_code *code = &lineage->codes[i];
    if (code->from_step >= training->step)
      break;
    mo_text_object(text);
    mo_text_member_count(text, "from_step", code->from_step);
    mo_text_member(text, "fingerprint", code->fingerprint[0] != '\0' ? code->fingerprint : NULL);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

/* Adds the checksum of the training run's own environments to the metadata. */
static int add_environments(const struct mo_training *training, struct mo_controller *controller)
{
  const unsigned version = mo_training_environments_version(training);
  const size_t size = mo_training_environments_bytes(training, version);
  char sum[MO_NUMBER_BYTES];
  uint8_t *bytes = malloc(size);
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  mo_training_environments_pack(training, version, bytes);
  snprintf(sum, sizeof(sum), "%016" PRIx64, mo_checksum(bytes, size));
  free(bytes);
  return mo_controller_set_metadata(controller, "morphod.environments_crc64", sum);
}

int mo_training_export(const struct mo_training *training, const char *parent_sha256_hex,
                       const char *code_version, const struct mo_training_lineage *lineage,
                       struct mo_controller **controller)
{
  struct mo_controller *made = NULL;
  int r = mo_training_blank(&training->settings, &made);
  if (r < 0) {
    mo_controller_free(made);
    return r;
  }
  memcpy(made->parameters, training->controller->parameters, made->n_parameters * sizeof(float));
  struct mo_text settings = {0}, code = {0};
  char seed[MO_NUMBER_BYTES], step[MO_NUMBER_BYTES], designs[MO_NUMBER_BYTES];
  write_settings(training, &settings);
  if (lineage != NULL)
    write_code(training, lineage, &code);
  if (settings.failed || code.failed)
    r = MO_ERR_NO_MEMORY;
  snprintf(seed, sizeof(seed), "%" PRIu64, training->settings.seed);
  snprintf(step, sizeof(step), "%" PRIu32, training->step);
  snprintf(designs, sizeof(designs), "%016" PRIx64,
           mo_checksum((const uint8_t *)training->designs,
                       (size_t)training->n_designs * MO_DEFAULT_WORDS * sizeof(uint64_t)));
  const char *const entries[][2] = {
      {"morphod.kind", training->settings.kind == MO_TRAINING_PRETRAIN ? "pretrain" : "finetune"},
      {"morphod.parent", parent_sha256_hex != NULL ? parent_sha256_hex : "random"},
      {"morphod.seed", seed},
      {"morphod.settings", settings.data},
      {"morphod.step", step},
      {"morphod.version", code_version},
      {"morphod.designs_crc64", designs}};
  size_t n = sizeof(entries) / sizeof(entries[0]);
  if (training->settings.kind == MO_TRAINING_PRETRAIN)
    n--;
  for (size_t i = 0; i < n && r == MO_OK; i++)
    r = mo_controller_set_metadata(made, entries[i][0], entries[i][1]);
  if (lineage != NULL && r == MO_OK)
    r = mo_controller_set_metadata(made, "morphod.code", code.data);
  if (training->n_environments > 0 && r == MO_OK)
    r = add_environments(training, made);
  mo_text_free(&settings);
  mo_text_free(&code);
  if (r < 0) {
    mo_controller_free(made);
    return r;
  }
  *controller = made;
  return MO_OK;
}
