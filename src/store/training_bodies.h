/* training_bodies.h: the designs of a training run that finetunes each one separately. Threads and
 * errors as in store.h. */
#ifndef MORPHO_STORE_TRAINING_BODIES_H
#define MORPHO_STORE_TRAINING_BODIES_H

#include "store/trainings.h"

/* A separately trained design. Scores are mean losses over the held-out environments; NaN: a
 * rollout diverged. */
struct mo_training_body {
  uint32_t position; /* of the design in the request */
  double zero_shot, finetuned;
  uint32_t zero_shot_diverged, finetuned_diverged; /* rollouts */
  struct mo_sha256 controller_sha256;              /* of the controller file that was learned for
                                                      it */
  bool is_kept;                                    /* the file is stored, under a name */
  /* Only when read; the runner does not write these. */
  double first_loss, last_loss; /* mean losses of its first and last step of learning */
  uint32_t skipped;             /* steps that changed nothing, because no robot had a gradient */
  struct mo_bits genotype, form;
};

/* Reads the separately trained designs at positions > after (−1: from the first). */
int64_t mo_store_training_bodies(struct mo_store *store, int64_t id, int64_t after,
                                 struct mo_training_body *rows, size_t limit);
/* Reads only the scores of these designs that are both finite (malloc), in order: zero_shot (n),
 * then finetuned (n). */
int mo_store_training_pairs(struct mo_store *store, int64_t id, double **pairs, uint32_t *n);
/* Stores a separately trained design, with the event "training.body"; deletes the training run's
 * checkpoints and resets its attempts. The record says whether the controller, which the bytes
 * encode, is kept: as <name>-<position>. A controller whose design is no longer among the best
 * loses its name, and its file is deleted unless something else refers to it. Returns after the
 * commit; MO_ERR_CONFLICT as for the writes in trainings.h. */
int mo_store_training_body(struct mo_store *store, int64_t id,
                           const struct mo_training_record *record,
                           const struct mo_training_body *body, const char *name,
                           const uint8_t *bytes, size_t size,
                           const struct mo_controller *controller);

#endif
