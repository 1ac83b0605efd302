/* certificate_figures.h: the trials of a certificate whose losses are stored, and their figures:
 * for its report, and for the verdicts that are stored when it succeeds. */
#ifndef MORPHO_JOBS_CERTIFICATE_FIGURES_H
#define MORPHO_JOBS_CERTIFICATE_FIGURES_H

#include "store/certificates.h"

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

#endif
