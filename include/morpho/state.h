/* state.h: rollouts in windows. A rollout can end with its state, and another one can start from
 * it: together, the windows give the same bits as one rollout over all their steps, including its
 * recordings and its loss. Between two windows the light may move, and the task and the controller
 * may change.
 *
 * Loss, value and measures of a window cover everything since the tally began, as in a single
 * rollout up to that point. Only the state holds data from earlier environments (where the tally
 * began, sums, progress on a path); the rest comes from the window's environment. A tally begins at
 * the start of the rollout, and again at the start of a window whose task differs from that of the
 * previous window: its clock, which moves the light of a guide, then starts at 0. The controller's
 * clock is never reset. */
#ifndef MORPHO_STATE_H
#define MORPHO_STATE_H

#include <morpho/rollout.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_STATE_TIME_MAX_S     3600.0
#define MO_STATE_POSITION_MAX_M 1e7  /* of |each coordinate| */
#define MO_STATE_SUM_MAX        1e18 /* of |each number of a tally| */
#define MO_STATE_KEY_BYTES      16

/* What the task and the measures have added up since step `begun_step`. Instants are the starts of
 * control periods. Members that a task or the measures do not use are 0. */
struct mo_state_tally {
  uint32_t begun_step;
  double com_start_m[3]; /* center of mass when it began */
  double start_turn[2];  /* as `turn`, when it began */
  /* The task, at the latest instant; unused by `reach` to a fixed light. */
  double com_m[3];
  double sum, sums[5]; /* distance traveled, or distances; of a sum's terms */
  double facing[2];    /* a unit vector: the heading, or the direction of the path's leg */
  double length_m, before_m, along_m; /* path: of this leg; progress at its start; on it */
  uint32_t leg;
  uint32_t n_heights; /* jump: heights that count, the largest, a sum of exponentials */
  double peak_m, soft;
  /* What measures observe. */
  uint32_t observed;    /* what has been observed, as bits of an internal enumeration */
  double seen_com_m[3]; /* center of mass at the latest instant */
  double turn[2];       /* twice the cosine and sine of the yaw, times the mean stretch */
  double path_m, height_sum_m, peak_height_m;
  double turns; /* whole turns to the left */
  uint64_t air_steps, hops, contacts, front_2, left_2;
  uint32_t inverted_max;        /* voxels inside out at two instants in a row, at most */
  double pull_m2, work_j;       /* work of the springs, as kernels and as the reference sum it */
  double strain_square, strain; /* the largest strain, in the same two forms */
};

/* The state of one body after step `step`. Numbers of a float32 rollout are exact in float64. */
struct mo_state {
  uint32_t n_masses, n_springs, n_voxels;
  uint32_t step; /* steps since the start; 0: the rollout diverged, and cannot continue */
  enum mo_precision precision; /* of the rollout */
  /* The first bytes of hashes. Two of these hashes must not change between windows: that of the
   * physics except for n_steps and drop_height_m, and that of the terrain with the factors. */
  uint8_t physics_key[MO_STATE_KEY_BYTES], terrain_key[MO_STATE_KEY_BYTES];
  uint8_t task_key[MO_STATE_KEY_BYTES];
  /* One allocation, of mo_state_create. */
  double *position_m;       /* (n_masses, 3) rounded to float64 */
  double *position_rest_m;  /* (n_masses, 3) what that rounding left out: kernels measure x and y
                               from the world's center */
  double *velocity_m_per_s; /* (n_masses, 3) at the end of the step; `split`: in its middle */
  double *output;           /* (n_springs) the held outputs of the controller; 0: none */
  uint8_t *contacts;        /* (n_masses) 1: touched the terrain in the step */
  uint8_t *cut;             /* (n_springs) 1: cut by damage */
  uint8_t *inverted;        /* (n_voxels) 1: inside out at the latest instant, if observed */
  struct mo_state_tally tally;
};

/* Allocates the arrays for a body, filled with 0; sets only them and their sizes. The caller frees
 * them. MO_ERR_NO_MEMORY. */
int mo_state_create(struct mo_state *state, uint32_t n_masses, uint32_t n_springs,
                    uint32_t n_voxels);
void mo_state_free(struct mo_state *state); /* all becomes 0; NULL-safe */

/* Checks whether a rollout can start from a state: sizes, physics, terrain and precision must be
 * those of the state, and all numbers finite and within bounds. MO_ERR_INVALID or MO_ERR_RANGE;
 * message (nullable) says which of them is wrong and what to do. */
int mo_state_check(const struct mo_state *state, const struct mo_body *body,
                   const struct mo_environment *environment, const struct mo_physics *physics,
                   enum mo_precision precision, struct mo_message *message);

/* The states of a window's rollouts. */
struct mo_states {
  const struct mo_state *from; /* (rollouts) all after the same step; NULL: the usual start */
  struct mo_state *to; /* (rollouts) of mo_state_create, written at the end; NULL: not requested.
                          Must differ from `from` */
};

/* Runs mo_rollout_reference for a window of physics->scheme.n_steps steps. diverged_step and the
 * frames of recordings count from its start. The first frame is the state: the same numbers as the
 * last frame of the previous window. com_start_m of an outcome is that of the tally. Measures: the
 * same set in all windows. MO_ERR_INVALID, MO_ERR_RANGE: see mo_state_check. */
int mo_rollout_reference_window(const struct mo_body *body, const struct mo_controller *controller,
                                const struct mo_environment *environment,
                                const struct mo_physics *physics, const struct mo_states *states,
                                const struct mo_recording *recording,
                                const struct mo_measuring *measuring, struct mo_outcome *outcome);

/* The same for mo_rollout_block. states NULL: mo_rollout_block itself. */
int mo_rollout_block_window(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                            const struct mo_body *body,
                            const struct mo_environment *const *environments,
                            uint32_t n_environments, const struct mo_physics *physics,
                            const struct mo_states *states, const struct mo_recording *recordings,
                            const struct mo_measuring *measuring,
                            const struct mo_pause_point *pause, struct mo_outcome *outcomes);

#ifdef __cplusplus
}
#endif
#endif
