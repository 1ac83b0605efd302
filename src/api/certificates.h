/* certificates.h: the trials of a certificate whose losses are stored, and their figures. Only for
 * the files certificate*.c of this room. */
#ifndef MORPHO_API_CERTIFICATES_H
#define MORPHO_API_CERTIFICATES_H

#include "api/handlers.h"
#include "store/certificates.h"

/* The content of a report. */
struct mo_report {
  struct mo_certificate_status status;
  struct mo_certificate_base base;
  struct mo_environment *environments; /* the base's */
  struct mo_bits *genotypes;           /* (n_designs) */
  uint32_t n_designs;
  struct mo_trial *trials; /* (n_trials) those that are complete */
  uint32_t n_trials;
  float **losses;                  /* (n_trials) each (n_designs, n_environments) */
  double (*measures)[MO_MEASURES]; /* (n_designs, n_environments) of the base */
  struct mo_trial_score *scores;   /* (n_trials, n_designs) */
  struct mo_trial_list *lists;     /* (n_trials) */
  struct mo_certificate_classes classes;
};
/* Reads the complete trials and computes the figures. MO_ERR_EMPTY: no trial is complete. Free it
 * in any case. */
int mo_report_load(struct mo_store *store, int64_t id, struct mo_report *report);
void mo_report_free(struct mo_report *report);

/* Writes the axes that were requested and do not apply, with the reasons, and what a reader of the
 * others must know, as two members. */
void mo_members_axes(struct mo_text *text, const struct mo_certificate_settings *settings,
                     const struct mo_certificate_base *base);

#endif
