/* requests.h: parses the bodies of requests. Does no I/O: the fuzz targets call this.
 *
 * Each function parses `size` bytes (text[size] must be NUL). MO_OK: complete, with all defaults;
 * MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults; MO_ERR_NO_MEMORY.
 * Free `parts` in every case. With MO_ERR_INVALID, what the request names (controller, population,
 * initial campaign) still holds valid values, so that the caller can look it up and report all
 * faults at once. The caller sets idempotency_key and body_sha256. */
#ifndef MORPHO_API_REQUESTS_H
#define MORPHO_API_REQUESTS_H

#include "api/request_parts.h"
#include "jobs/campaigns.h"
#include "jobs/evaluations.h"
#include "jobs/trainings.h"

/* All members of a submission, as tables; tests hold the contract to them. */
extern const struct mo_fields mo_evaluation_request_fields, mo_training_request_fields,
    mo_campaign_request_fields;

/* A request, and the parts that its pointers point to. */
struct mo_parsed_evaluation {
  struct mo_evaluation_request request;
  struct mo_parts parts;
};
int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults);

struct mo_parsed_training {
  struct mo_training_request request;
  struct mo_parts parts;
  enum mo_learning_preset preset;
  bool has_kind, has_population;
  enum mo_job_kind population_kind; /* of the job that gives the designs, if there is one */
};
int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults);

struct mo_parsed_campaign {
  struct mo_campaign_request request;
  struct mo_parts parts; /* genotypes: of the initial population */
  int mode, preset;      /* mode −1: not a valid word */
  bool has_mode, has_learning, has_sensor;
};
int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults);

/* Parse the bodies of POST …/extend (further generations), …/champions and …/weight. */
int mo_extension_parse(const char *text, size_t size, uint32_t *generations,
                       struct mo_faults *faults);
#define MO_CHAMPIONS_MAX 1000
int mo_champions_parse(const char *text, size_t size, uint32_t *count, uint32_t *stride,
                       struct mo_faults *faults);
int mo_weight_parse(const char *text, size_t size, double *weight, struct mo_faults *faults);

#endif
