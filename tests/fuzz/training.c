/* training.c: the body of POST /v1/trainings. An accepted body must be complete and valid, a
 * refused one must have a fault, and jansson decides what is JSON, as in evaluation.c. */
#include "target.h"

#include <jansson.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"

static void check_accepted(const struct mo_training_request *request)
{
  const struct mo_training_record *record = &request->record;
  bool finetune = record->settings.kind == MO_TRAINING_FINETUNE;
  FUZZ_PROMISE(mo_training_settings_check(&record->settings, NULL) == MO_OK);
  FUZZ_PROMISE(record->settings.held_out_designs >= 1 &&
               record->settings.held_out_environments >= 1);
  FUZZ_PROMISE(record->checkpoints_kept >= 1 &&
               record->checkpoints_kept <= MO_CHECKPOINTS_KEPT_MAX);
  FUZZ_PROMISE(record->name[0] == '\0' || mo_controller_name_check(record->name) == MO_OK);
  const bool is_drawn = record->sample.atlas[0] != '\0';
  FUZZ_PROMISE((record->n_designs > 0) + (record->population > 0) + is_drawn == finetune);
  FUZZ_PROMISE(!is_drawn ||
               (record->sample.count >= 1 && record->sample.count <= MO_ATLAS_SAMPLE_MAX &&
                request->population_best == 0));
  FUZZ_PROMISE(!finetune || request->parent != NULL);
  FUZZ_PROMISE(request->parent == NULL || strlen(request->parent) <= MO_NAME_BYTES_MAX + 7);
  FUZZ_PROMISE(request->job.label == NULL || strlen(request->job.label) <= MO_LABEL_BYTES_MAX);
  FUZZ_PROMISE(record->n_designs <= MO_TRAINING_DESIGNS_MAX);
  FUZZ_PROMISE(record->n_environments <= MO_TRAINING_ENVIRONMENTS_MAX);
  FUZZ_PROMISE((record->n_environments > 0) == (request->environments != NULL));
  FUZZ_PROMISE(request->environments == NULL || record->environment_set[0] == '\0');
  FUZZ_PROMISE(!record->draws_worlds || request->environments != NULL);
  FUZZ_PROMISE(finetune || !record->each);
  FUZZ_PROMISE(record->each || (record->keep == MO_KEEP_NONE && record->keep_best == 0));
  FUZZ_PROMISE(record->keep == MO_KEEP_NONE || record->keep_best == 0);
  FUZZ_PROMISE(!record->each || (record->validate_every_steps == record->settings.n_steps &&
                                 record->settings.held_out_designs == 1));
  for (uint32_t i = 0; i < record->n_environments; i++)
    FUZZ_PROMISE(mo_environment_check(&request->environments[i], NULL) == MO_OK);
  for (uint32_t i = 0; i < record->n_designs; i++)
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, request->genotypes[i].words) == 1);
}

#define READER_PARSED struct mo_parsed_training
#define READER_PARSE  mo_training_parse
#include "body.h"
