/* evaluation.c: the body of POST /v1/evaluations.
 *
 * An accepted body must be complete and valid, and a refused one must have a fault. jansson and our
 * reader must agree on what is JSON, except for numbers outside jansson's range and our bounds on
 * depth and keys. */
#include "target.h"

#include <jansson.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"

static void check_accepted(const struct mo_evaluation_request *request)
{
  const uint32_t n_given = request->n_designs + request->n_skipped;
  FUZZ_PROMISE(n_given >= 1 && n_given <= MO_DESIGNS_MAX && request->n_notes <= n_given);
  for (uint32_t i = 1; i < request->n_notes; i++)
    FUZZ_PROMISE(request->notes[i - 1].place < request->notes[i].place);
  for (uint32_t i = 0; i < request->n_designs; i++)
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, request->genotypes[i].words) == 1);
  if (request->environment_set == NULL) {
    FUZZ_PROMISE(request->n_environments >= 1 && request->n_environments <= MO_ENVIRONMENTS_MAX);
    for (uint32_t k = 0; k < request->n_environments; k++)
      FUZZ_PROMISE(mo_environment_check(&request->environments[k], NULL) == MO_OK);
  }
  FUZZ_PROMISE(mo_physics_check(&request->physics, NULL) == MO_OK);
  FUZZ_PROMISE(request->record_stride >= 1 &&
               request->record_stride <= request->physics.scheme.n_steps);
  FUZZ_PROMISE(request->controller != NULL && strlen(request->controller) <= MO_NAME_BYTES_MAX + 7);
  FUZZ_PROMISE(request->job.label == NULL || strlen(request->job.label) <= MO_LABEL_BYTES_MAX);
}

#define READER_PARSED struct mo_parsed_evaluation
#define READER_PARSE  mo_evaluation_parse
#include "body.h"
