/* campaign_request.h: parses the body of POST /v1/campaigns. Does no I/O: the fuzz target calls
 * this. */
#ifndef MORPHO_API_CAMPAIGN_REQUEST_H
#define MORPHO_API_CAMPAIGN_REQUEST_H

#include "http/problem.h"
#include "jobs/campaigns.h"

/* A request and the data that its pointers point to. */
struct mo_parsed_campaign {
  struct mo_campaign_request request;
  struct mo_bits *genotypes;
  struct mo_environment *environments;
  char controller[MO_NAME_BYTES_MAX + 8]; /* "": not given */
  char label[MO_LABEL_BYTES_MAX + 1];
};

/* Parses `size` bytes (text[size] must be NUL). MO_OK: complete, with the defaults of its mode and
 * preset; MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults;
 * MO_ERR_NO_MEMORY. Free in every case. With MO_ERR_INVALID, `controller` and
 * request.record.initial_campaign still hold valid values, so that the caller can look them up and
 * report all faults at once. The caller sets idempotency_key and body_sha256. */
int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults);
void mo_campaign_parsed_free(struct mo_parsed_campaign *parsed);

/* Parse the bodies of POST …/extend (further generations) and POST …/champions. MO_OK,
 * MO_ERR_FORMAT, MO_ERR_INVALID, MO_ERR_NO_MEMORY. */
int mo_extension_parse(const char *text, size_t size, uint32_t *generations,
                       struct mo_faults *faults);
#define MO_CHAMPIONS_MAX 1000
int mo_champions_parse(const char *text, size_t size, uint32_t *count, uint32_t *stride,
                       struct mo_faults *faults);

#endif
