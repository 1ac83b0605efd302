/* certificate.c: the body of POST /v1/certificates. An accepted body must be complete and valid, a
 * refused one must have a fault, and jansson decides what is JSON. */
#include "target.h"

#include "api/certificate_request.h"

static void check_accepted(const struct mo_certificate_request *request)
{
  const struct mo_certificate_record *record = &request->record;
  const bool is_listed = request->n_designs > 0;
  FUZZ_PROMISE(mo_certificate_check(&record->settings, NULL) == MO_OK);
  FUZZ_PROMISE((record->settings.axes & UINT32_C(1) << MO_AXIS_BASE) != 0);
  FUZZ_PROMISE(is_listed == (record->population == 0));
  FUZZ_PROMISE(request->n_designs <= MO_CERTIFICATE_DESIGNS_MAX);
  FUZZ_PROMISE(request->best >= 1 && request->best <= MO_CERTIFICATE_DESIGNS_MAX);
  FUZZ_PROMISE((request->environments == NULL) == (request->environment_set != NULL));
  FUZZ_PROMISE(request->job.priority == MO_BATCH);
  FUZZ_PROMISE(mo_physics_check(&request->physics, NULL) == MO_OK);
  for (uint32_t i = 0; request->environments != NULL && i < request->n_environments; i++)
    FUZZ_PROMISE(mo_environment_check(&request->environments[i], NULL) == MO_OK);
  for (uint32_t i = 0; i < request->n_designs; i++)
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, request->genotypes[i].words) == 1);
}

#define READER_PARSED struct mo_parsed_certificate
#define READER_PARSE  mo_certificate_parse
#include "body.h"
