/* training_request.h: parses the body of POST /v1/trainings. Does no I/O: the fuzz target calls
 * this. */
#ifndef MORPHO_API_TRAINING_REQUEST_H
#define MORPHO_API_TRAINING_REQUEST_H

#include "http/problem.h"
#include "jobs/trainings.h"

/* A request and the data that its pointers point to. */
struct mo_parsed_training {
  struct mo_training_request request;
  struct mo_bits *genotypes;
  enum mo_job_kind population_kind;   /* of the job that gives the designs, if there is one */
  char parent[MO_NAME_BYTES_MAX + 8]; /* "": not given */
  char label[MO_LABEL_BYTES_MAX + 1];
};

/* Parses `size` bytes (text[size] must be NUL). MO_OK: complete, with the defaults of its kind and
 * preset; MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults;
 * MO_ERR_NO_MEMORY. Free in every case. With MO_ERR_INVALID, `parent` and request.population still
 * hold valid values, so that the caller can look them up and report all faults at once. The caller
 * sets idempotency_key and body_sha256. */
int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults);
void mo_training_parsed_free(struct mo_parsed_training *parsed);

#endif
