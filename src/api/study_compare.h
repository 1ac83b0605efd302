/* study_compare.h: compares a request for a study with the study of its label. */
#ifndef MORPHO_API_STUDY_COMPARE_H
#define MORPHO_API_STUDY_COMPARE_H

#include "base/faults.h"
#include "store/campaign_records.h"

/* Compares a request that mo_campaign_parse has read with the study of its label. Adds a fault for
 * each setting that is given and that the study has otherwise; what is not given is the study's.
 * environments: (status->record.n_environments) of the study; controller: the hash of the one that
 * the request names, if it names one. MO_OK, with or without faults; MO_ERR_NO_MEMORY. */
int mo_study_compare(const char *text, size_t size, const struct mo_campaign_status *status,
                     const struct mo_environment *environments, const struct mo_sha256 *controller,
                     struct mo_faults *faults);

#endif
