/* fleet.h: shared by the files about workers on other machines. */
#ifndef MORPHO_API_FLEET_H
#define MORPHO_API_FLEET_H

#include "api/handlers.h"
#include "fleet/fleet.h"
#include "jobs/verification.h"

#define MO_FLEET_WAIT_S 30 /* longest wait for leases or orders */

/* Writes an object for each loss of a row that differs from the recomputed loss. */
void mo_json_differences(struct mo_text *text, const struct mo_origin_row *row);
/* Reads the id of a session from the path. Returns NULL after an error reply if there is no fleet
 * or the id is invalid. */
struct mo_fleet *mo_path_session(struct mo_request *request, uint64_t *session);

#endif
