/* atlas_request.h: the body of POST /v1/atlases; requests.h has those of other jobs. */
#ifndef MORPHO_API_ATLAS_REQUEST_H
#define MORPHO_API_ATLAS_REQUEST_H

#include "api/requests.h"
#include "jobs/atlases.h"

extern const struct mo_fields mo_atlas_request_fields;

struct mo_parsed_atlas {
  struct mo_atlas_request request;
  struct mo_parts parts;
  int task; /* of mo_suite_task_words; −1: none */
};
int mo_atlas_parse(const char *text, size_t size, struct mo_parsed_atlas *parsed,
                   struct mo_faults *faults);

#endif
