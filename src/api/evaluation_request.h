/* evaluation_request.h: parses the body of POST /v1/evaluations. Does no I/O: the fuzz target calls
 * this. */
#ifndef MORPHO_API_EVALUATION_REQUEST_H
#define MORPHO_API_EVALUATION_REQUEST_H

#include "http/problem.h"
#include "jobs/evaluations.h"

/* A request and the data that its pointers point to. */
struct mo_parsed_evaluation {
  struct mo_evaluation_request request;
  struct mo_bits *genotypes;
  struct mo_environment *environments;
  char environment_set[MO_NAME_BYTES_MAX + 1];
  char controller[MO_NAME_BYTES_MAX + 8];
  char label[MO_LABEL_BYTES_MAX + 1];
};

/* Parses `size` bytes (text[size] must be NUL). MO_OK; MO_ERR_FORMAT: not JSON (faults->malformed);
 * MO_ERR_INVALID: see the faults; MO_ERR_NO_MEMORY. Free in every case. The caller sets
 * idempotency_key and body_sha256. */
int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults);
void mo_evaluation_parsed_free(struct mo_parsed_evaluation *parsed);

#endif
