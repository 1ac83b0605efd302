/* states.h: the states of rollouts (morpho/state.h) in JSON: members of the requests and replies of
 * POST /v1/rollouts. docs/driving.md describes them. */
#ifndef MORPHO_API_STATES_H
#define MORPHO_API_STATES_H

#include "api/requests.h"
#include "jobs/rollouts.h"

/* The states in a request, and what it requests about states. */
struct mo_parsed_states {
  struct mo_start *list; /* (n) in the order of the request; steps are set by mo_states_check */
  double *times_s;       /* (n, 2) of each state, and when its tally began */
  uint32_t n;
  bool is_given, wants_final;
  bool int16_masses; /* positions as masses_int16 (docs/scenes.md) */
  int error;         /* MO_ERR_NO_MEMORY */
};
extern const struct mo_fields mo_states_fields; /* its members: states, final_states,
                                               masses_int16 */

/* The body of POST /v1/rollouts: without the members of an evaluation that belong to a job. Free
 * its states, and the parts of its evaluation, in every case. */
struct mo_parsed_rollouts {
  struct mo_parsed_evaluation evaluation;
  struct mo_parsed_states states;
};
int mo_rollouts_parse(const char *text, size_t size, struct mo_parsed_rollouts *parsed,
                      struct mo_faults *faults);

/* Converts the times to steps, and adds a fault for each time that is not a multiple of the time
 * step. */
void mo_states_check(struct mo_json *json, const struct mo_physics *physics,
                     struct mo_parsed_states *states);
void mo_states_free(struct mo_parsed_states *states);

/* Writes a state as the member "state"; null if its rollout diverged. */
void mo_member_state(struct mo_text *text, const struct mo_state *state,
                     const struct mo_genotype *robot, const struct mo_task *task,
                     const struct mo_physics *physics);

#endif
