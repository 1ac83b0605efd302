/* fleet.h: what the files about workers of other machines share. */
#ifndef MORPHO_API_FLEET_H
#define MORPHO_API_FLEET_H

#include "api/handlers.h"
#include "base/faults.h"
#include "fleet/fleet.h"
#include "jobs/verification.h"

/* Raised with every change of what travels. Workers of any version of the program may join that
 * have this protocol and compute the same bits. */
#define MO_FLEET_PROTOCOL 1
#define MO_FLEET_WAIT_S   30 /* longest wait for leases or orders */

/* A request for a session (POST /v1/fleet/sessions), parsed as those of requests.h are. */
struct mo_parsed_offer {
  uint32_t protocol;
  struct mo_fleet_offer offer;
};
/* A body of another protocol is not looked at further: *protocol says which. */
int mo_offer_parse(const char *text, size_t size, struct mo_parsed_offer *parsed,
                   struct mo_faults *faults);

#define MO_WHY_BYTES 127
/* The body of POST …/quarantine; `why` has MO_WHY_BYTES + 1 bytes. */
int mo_quarantine_parse(const char *text, size_t size, char *why, struct mo_faults *faults);

#define MO_VERIFIED_DEFAULT 16
/* The body of POST /v1/fleet/verify. */
struct mo_parsed_verification {
  char origin[MO_ORIGIN_BYTES]; /* NAME@HOST, or a host */
  struct mo_origin_place after;
  uint32_t limit;
  bool repair;
};
int mo_verification_parse(const char *text, size_t size, struct mo_parsed_verification *parsed,
                          struct mo_faults *faults);

/* Writes an object for each loss of a row that is not the one computed again. */
void mo_json_differences(struct mo_text *text, const struct mo_origin_row *row);
/* Reads the id of a session from the path. NULL: there is no fleet, or no such session can be; the
 * reply is made. */
struct mo_fleet *mo_path_session(struct mo_request *request, uint64_t *session);

#endif
