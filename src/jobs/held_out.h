/* held_out.h: the held-out designs of a training run's validation, and their score. */
#ifndef MORPHO_JOBS_HELD_OUT_H
#define MORPHO_JOBS_HELD_OUT_H

#include "jobs/state.h"
#include "store/trainings.h"

/* The designs and environments of validation: every design is scored in every environment, with the
 * physics of the settings, in float32. A pretraining run uses bodies from the held-out stream of
 * its seed. A finetuning run uses the first of its own designs, which it also trains on, but in
 * different environments. A run in its own environments is validated in all of these; a run with
 * its own tasks, in held-out environments with these tasks in turn. */
struct mo_held_out {
  struct mo_bits *genotypes; /* (n_designs) placed */
  uint32_t n_designs;
  struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
};
/* MO_ERR_NO_MEMORY, and errors of the store. Free the result with mo_held_out_free. */
int mo_held_out_load(struct mo_store *store, const struct mo_training_status *status,
                     struct mo_held_out *held_out);
/* Loads only the environments. *environments: (n) malloc, owned by the caller, even after an
 * error. */
int mo_held_out_worlds(struct mo_store *store, const struct mo_training_status *status,
                       struct mo_environment **environments, uint32_t *n);
void mo_held_out_free(struct mo_held_out *held_out); /* frees the arrays */
/* Scores the held-out designs with the current weights. MO_ERR_CANCELLED; MO_ERR_NO_MEMORY and
 * other errors of blocks. */
int mo_held_out_score(struct mo_runner *runner, const struct mo_held_out *held_out,
                      const struct mo_controller *controller,
                      const struct mo_training_status *status,
                      struct mo_training_validation_row *row);

#endif
