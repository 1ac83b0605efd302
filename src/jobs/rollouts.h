/* rollouts.h: rollouts that are computed at once and not stored: for viewers and editors, which
 * request many rollouts that are never needed again. */
#ifndef MORPHO_JOBS_ROLLOUTS_H
#define MORPHO_JOBS_ROLLOUTS_H

#include <morpho/state.h>

#include "jobs/evaluations.h"

#define MO_ROLLOUTS_MAX 64 /* in one request: a design in the largest set, or several designs */

struct mo_rolled_design {
  struct mo_genotype form, genotype; /* canonical; as it was scored */
  struct mo_body *body;
  double score;     /* mean loss; +infinity: a rollout diverged */
  uint32_t dropped; /* voxels that the repair removed */
  enum mo_orientation orientation;
};

/* A state that a rollout starts from, and the robot that it belongs to. */
struct mo_start {
  struct mo_state state;
  struct mo_genotype robot; /* as it was scored */
};
struct mo_rollout_states {
  const struct mo_start *from; /* (n_from) by design, each in every environment; NULL: none */
  uint32_t n_from;
  bool wants_final;
};

struct mo_rolled {
  struct mo_outcome outcome;
  struct mo_recording recording; /* owned; NULL arrays: not recorded */
};

struct mo_rollouts {
  uint32_t n_designs, n_environments, n_frames;
  struct mo_rolled_design *designs;    /* (n_designs) */
  struct mo_environment *environments; /* (n_environments) */
  struct mo_rolled *rollouts;          /* (n_designs, n_environments) */
  const struct mo_start *from;         /* (n_designs, n_environments), of the request, or NULL */
  struct mo_state *ends;               /* (n_designs, n_environments) final states; NULL: not
                                          requested */
  struct mo_physics physics;
  enum mo_precision precision;
  bool is_crowded; /* for a client with other requests in flight: other clients overtake these */
  struct mo_sha256 controller;
  enum mo_sensor sensor; /* of the controller */
};
void mo_rollouts_free(struct mo_rollouts *rollouts); /* NULL-safe */

/* Computes the rollouts of an evaluation request ahead of all batch work, and waits for them: at
 * most about a second of a core. is_crowded: the client has other requests in flight, so other
 * clients overtake this one. Ignores the members that belong to a job: priority, back end, weight,
 * label, key and `verify`. The losses have the same bits as in an evaluation. The states of the
 * request must outlive the rollouts.
 * - MO_ERR_RANGE, MO_ERR_INVALID: a value is outside its bounds
 * - MO_ERR_LIMIT: they would take too long or be too large; an evaluation can compute them
 * - MO_ERR_CONFLICT: a state does not match its rollout
 * - MO_ERR_NOT_FOUND: no such controller or set
 * - MO_ERR_UNSUPPORTED: the controller is for a different workspace
 * - MO_ERR_CANCELLED: the service is stopping */
int mo_jobs_roll(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                 const struct mo_rollout_states *states, bool is_crowded,
                 struct mo_rollouts **rollouts, struct mo_message *message);

#endif
