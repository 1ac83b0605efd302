/* evaluation.c: the body of POST /v1/evaluations.
 *
 * What is accepted must be complete and valid; what is not must have a fault; and what we take for JSON, jansson must take for
 * JSON too (and the reverse), but for the numbers that are out of jansson's range and our bounds on depth and keys. */
#include "target.h"

#include <jansson.h>
#include <stdlib.h>
#include <string.h>

#include "http/evaluation_request.h"

static void check_accepted(const struct mo_evaluation_request *request)
{
  FUZZ_PROMISE(request->n_designs >= 1 && request->n_designs <= MO_DESIGNS_MAX);
  for (uint32_t i = 0; i < request->n_designs; i++)
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, request->genotypes[i].words) == 1);
  if (request->environment_set == NULL) {
    FUZZ_PROMISE(request->n_environments >= 1 && request->n_environments <= MO_ENVIRONMENTS_MAX);
    for (uint32_t k = 0; k < request->n_environments; k++)
      FUZZ_PROMISE(mo_environment_check(&request->environments[k], NULL) == MO_OK);
  }
  FUZZ_PROMISE(mo_physics_check(&request->physics, NULL) == MO_OK);
  FUZZ_PROMISE(request->record_stride >= 1 && request->record_stride <= request->physics.n_steps);
  FUZZ_PROMISE(request->controller != NULL && strlen(request->controller) <= MO_NAME_BYTES_MAX + 7);
  FUZZ_PROMISE(request->label == NULL || strlen(request->label) <= MO_LABEL_BYTES_MAX);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  struct mo_parsed_evaluation parsed;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  char *text = malloc(size + 1);
  if (faults == NULL || text == NULL) {
    free(faults);
    free(text);
    return 0;
  }
  if (size > 0)
    memcpy(text, data, size);
  text[size] = '\0';
  int code = mo_evaluation_parse(text, size, &parsed, faults);
  if (code == MO_OK)
    check_accepted(&parsed.request);
  else if (code != MO_ERR_NO_MEMORY)
    FUZZ_PROMISE(faults->n > 0 && faults->malformed == (code == MO_ERR_FORMAT));
  for (unsigned i = 0; i < faults->n; i++)
    FUZZ_PROMISE(faults->items[i].detail[0] != '\0');
  mo_evaluation_parsed_free(&parsed);
  if (memchr(text, '\0', size) == NULL && size < 100000) {
    json_error_t error;
    json_t *tree = json_loadb(text, size, JSON_REJECT_DUPLICATES | JSON_DECODE_ANY, &error);
    if (code == MO_OK)
      FUZZ_PROMISE(tree != NULL || json_error_code(&error) == json_error_numeric_overflow);
    /* When many other faults end the reading early, the rest has not been looked at. */
    if (code == MO_ERR_FORMAT && strstr(faults->items[0].detail, "more than 64") == NULL &&
        strstr(faults->items[0].detail, "more than 256 bytes") == NULL)
      FUZZ_PROMISE(tree == NULL);
    json_decref(tree);
  }
  free(text);
  free(faults);
  return 0;
}
