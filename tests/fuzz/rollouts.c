/* rollouts.c: the body of POST /v1/rollouts, with states to start from.
 *
 * The states of an accepted body must fit their sizes and bounds; whether they fit the robots is
 * checked later, by mo_state_check. */
#include "target.h"

#include <math.h>

#include "api/requests.h"
#include "api/states.h"

static void check_state(const struct mo_state *state)
{
  FUZZ_PROMISE(state->n_masses >= 1 && state->n_masses <= MO_DEFAULT_MASSES);
  FUZZ_PROMISE(state->n_springs >= 1 && state->n_springs <= MO_DEFAULT_SPRINGS);
  FUZZ_PROMISE(state->n_voxels <= MO_DEFAULT_VOXELS && state->step >= 1);
  for (uint32_t i = 0; i < 3 * state->n_masses; i++)
    FUZZ_PROMISE(isfinite(state->position_m[i]) && fabs(state->position_rest_m[i]) <= 1e-6 &&
                 isfinite(state->velocity_m_per_s[i]));
  for (uint32_t s = 0; s < state->n_springs; s++)
    FUZZ_PROMISE(fabs(state->output[s]) <= 1.0001 && state->cut[s] <= 1);
}

static void check_accepted(const struct mo_parsed_rollouts *parsed)
{
  FUZZ_PROMISE(parsed->evaluation.request.n_designs >= 1);
  FUZZ_PROMISE(parsed->states.n <= 64);
  for (uint32_t i = 0; i < parsed->states.n; i++)
    check_state(&parsed->states.list[i].state);
}

static void release(struct mo_parsed_rollouts *parsed)
{
  mo_states_free(&parsed->states);
  mo_parts_free(&parsed->evaluation.parts);
}

#define READER_PARSED          struct mo_parsed_rollouts
#define READER_PARSE           mo_rollouts_parse
#define READER_REQUEST(parsed) (parsed)
#define READER_FREE            release
#include "body.h"
