/* campaign.c: the body of POST /v1/campaigns. An accepted body must be complete and valid, a
 * refused one must have a fault, and jansson decides what is JSON, as in evaluation.c. */
#include "target.h"

#include <jansson.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"

static void check_settings(const struct mo_campaign_settings *settings)
{
  const struct mo_workspace most = MO_DEFAULT_WORKSPACE, ours = settings->workspace;
  FUZZ_PROMISE(mo_campaign_settings_check(settings, NULL) == MO_OK);
  FUZZ_PROMISE(ours.nx >= 1 && ours.nx <= most.nx && ours.ny >= 1 && ours.ny <= most.ny &&
               ours.nz >= 1 && ours.nz <= most.nz);
  FUZZ_PROMISE((uint64_t)settings->population * ((uint64_t)settings->generations + 1) <=
               MO_CAMPAIGN_DESIGNS_MAX);
}

static void check_accepted(const struct mo_campaign_request *request)
{
  const struct mo_campaign_record *record = &request->record;
  bool zero_shot = record->settings.mode == MO_ZERO_SHOT;
  check_settings(&record->settings);
  FUZZ_PROMISE(record->name[0] == '\0' ||
               (!zero_shot && mo_controller_name_check(record->name) == MO_OK));
  FUZZ_PROMISE(record->settings.mode == MO_SIMULTANEOUS || request->controller != NULL);
  FUZZ_PROMISE(record->replicates >= 1 && record->replicates <= MO_REPLICATES_MAX);
  FUZZ_PROMISE(record->preset[0] != '\0' && record->n_listed <= record->settings.population);
  FUZZ_PROMISE(record->n_listed == 0 || record->initial_campaign == 0);
  FUZZ_PROMISE(request->job.weight >= 0.001 && request->job.weight <= 1000);
  FUZZ_PROMISE((record->environment_set[0] != '\0') == (request->environments == NULL));
  FUZZ_PROMISE(request->environments == NULL ||
               (record->n_environments >= 1 && record->n_environments <= MO_ENVIRONMENTS_MAX));
  FUZZ_PROMISE(request->job.label == NULL || strlen(request->job.label) <= MO_LABEL_BYTES_MAX);
  for (uint32_t i = 0; i < record->n_listed; i++) {
    struct mo_bits form, other;
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, request->genotypes[i].words) == 1);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, request->genotypes[i].words, form.words);
    for (uint32_t k = 0; k < i && i < 64; k++) {
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, request->genotypes[k].words, other.words);
      FUZZ_PROMISE(memcmp(&form, &other, sizeof(form)) != 0);
    }
  }
}

#define READER_PARSED struct mo_parsed_campaign
#define READER_PARSE  mo_campaign_parse
#include "body.h"
