/* training_request.h: the body of POST /v1/trainings, read and checked. No I/O: the fuzz target
 * calls this. */
#ifndef MORPHO_HTTP_TRAINING_REQUEST_H
#define MORPHO_HTTP_TRAINING_REQUEST_H

#include "http/fault.h"
#include "jobs/trainings.h"

/* A request and what its pointers point to. */
struct mo_parsed_training {
  struct mo_training_request request;
  struct mo_bits *genotypes;
  enum mo_job_kind population_kind; /* of the job whose designs are learned from, if there is one */
  char parent[MO_NAME_BYTES_MAX + 8]; /* "": none was given */
  char label[MO_LABEL_BYTES_MAX + 1];
};

/* Reads `size` bytes (text[size] must be NUL). MO_OK: complete, what is not given is that of its
 * kind and preset; MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: faults say what;
 * MO_ERR_NO_MEMORY. Free in every case. With MO_ERR_INVALID, `parent` and request.population hold
 * what was well given, so that they can be looked up and all faults be told at once.
 * idempotency_key and body_sha256 are left to the caller. */
int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults);
void mo_training_parsed_free(struct mo_parsed_training *parsed);

#endif
