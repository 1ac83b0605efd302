/* study_compare.h: compares a request for a study with the existing study of the same label. */
#ifndef MORPHO_API_STUDY_COMPARE_H
#define MORPHO_API_STUDY_COMPARE_H

#include "base/faults.h"
#include "store/campaign_records.h"

/* Compares a request that mo_campaign_parse has read with the study of the same label. Adds a fault
 * for each setting in the request that differs from the study's. Settings that the request omits
 * are not compared. environments: (status->record.n_environments) the study's environments;
 * controller: the hash of the request's controller, if it has one. MO_OK, with or without faults;
 * MO_ERR_NO_MEMORY. */
int mo_study_compare(const char *text, size_t size, const struct mo_campaign_status *status,
                     const struct mo_environment *environments, const struct mo_sha256 *controller,
                     struct mo_faults *faults);

#endif
