/* certificate_request.h: the body of POST /v1/certificates; requests.h has those of other jobs. */
#ifndef MORPHO_API_CERTIFICATE_REQUEST_H
#define MORPHO_API_CERTIFICATE_REQUEST_H

#include "api/requests.h"
#include "jobs/certificates.h"

extern const struct mo_fields mo_certificate_request_fields;

struct mo_parsed_certificate {
  struct mo_certificate_request request;
  struct mo_parts parts;
  bool has_population;
  enum mo_job_kind population_kind; /* kind of the job that provides the designs, if there is one */
};
int mo_certificate_parse(const char *text, size_t size, struct mo_parsed_certificate *parsed,
                         struct mo_faults *faults);

#endif
