/* rollout.h: the simulation of one body in one environment (paper, section 2.2; design constants in
 * mo_paper_physics).
 *
 * A step: sense → control → springs → velocity → position → contact; docs/model.md has the
 * equations. The environment's task (task.h) moves the light and measures the loss. Without one,
 * the light is fixed, and the loss is the distance in x, y from the center of mass to the light at
 * the end, divided by (the distance at the start + 1e-8 m). Lower is better; 1 means standing
 * still.
 *
 * Two implementations of the same mathematics:
 *   mo_rollout_reference  plain float64 C, one rollout, the reference for every test
 *   mo_rollout_block      vectors over up to MO_BLOCK_LANES environments of one body, float32 or
 *                         float64, compiled for several instruction sets
 * In mo_rollout_block the bits of a lane depend only on its own inputs, not on the other lanes or
 * its position among them. */
#ifndef MORPHO_ROLLOUT_H
#define MORPHO_ROLLOUT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/controller.h>
#include <morpho/measure.h>
#include <morpho/morphospace.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_BLOCK_LANES 16
#define MO_STEPS_MAX   1000000
#define MO_DIVERGED_SPEED_M_PER_S                                                                  \
  1000.0 /* a mass faster than this, or not finite, makes its rollout diverge */

enum mo_impact {
  MO_IMPACT_EXACT = 0,    /* time of impact in closed form: the gap over one terrain cell is a
                             quadratic; the default */
  MO_IMPACT_BISECTION = 1 /* `bisections` halvings of [0, dt], lower end kept (paper: 8) */
};
/* How a step advances positions and velocities; docs/model.md describes both integrators. */
enum mo_integrator {
  MO_INTEGRATOR_PAPER = 0, /* the paper's: a whole kick, then a drift; first order */
  MO_INTEGRATOR_SPLIT = 1  /* leapfrog: velocities are those at the middle of a step; an impact acts
                              on the velocity that the mass has at that moment; second order. Needs
                              drag · dt ≤ 1 */
};
extern const char *const mo_integrator_words[]; /* "paper", "split", NULL */
enum mo_precision { MO_FLOAT32 = 0, MO_FLOAT64 = 1 };

/* Settings that all rollouts of a block share, because they determine the operations. */
struct mo_scheme {
  double dt_s;             /* 0.004 */
  uint32_t n_steps;        /* 1000 */
  double control_period_s; /* 0: the controller computes its outputs in every step. Otherwise a
                              whole multiple of dt_s: it computes them at the start of each period,
                              and they are held until the next one */
  enum mo_integrator integrator; /* paper */
  enum mo_impact impact;         /* exact */
  uint32_t bisections;           /* 8; 1 … 52; used with MO_IMPACT_BISECTION only */
};
/* Numbers that may differ between the lanes of a block. */
struct mo_constants {
  double stiffness_n_per_m; /* 15000, of every spring */
  double mass_kg;           /* 1, of every node */
  double drag_per_s;        /* 15: rate at which velocities decay */
  double gravity_m_per_s2;  /* 9.8 */
  double actuation;         /* 0.2: rest length L0 (1 + actuation · a), a in [−1, 1] */
  double friction;          /* 0.9: tangential speed lost per unit of normal speed */
  double friction_cap;      /* 0.95: largest share of the tangential speed lost in one impact */
};
struct mo_physics {
  struct mo_scheme scheme;
  struct mo_constants constants;
  double drop_height_m; /* 0: extra lift of the body at the start, plus the environment's drop_m */
};
/* The settings for requests that do not specify any: `split`, 2000 steps of 2 ms.
 * docs/performance.md compares their time and error with the paper's. */
#define MO_DEFAULT_CONTROL_PERIOD_S 0.016 /* of controllers that start from random weights */
struct mo_physics mo_default_physics(void);
/* The paper's settings, which the comments above give. Packed and stored settings are read on top
 * of them, so they must never change. */
struct mo_physics mo_paper_physics(void);
/* MO_ERR_INVALID (not finite) or MO_ERR_RANGE; message names the field and its bounds. */
int mo_physics_check(const struct mo_physics *physics, struct mo_message *message);
/* Performs the same check on the constants multiplied by an environment's factors and by any
 * factors from `vary`. environment, vary: nullable. */
int mo_physics_check_in(const struct mo_physics *physics, const struct mo_environment *environment,
                        const struct mo_factor_ranges *vary, struct mo_message *message);

/* Returns the largest time step at which the springs of a body, linearized about rest, are stable
 * with this stiffness, mass, drag and integrator. eigenvalue: the largest one of the body's
 * stiffness matrix, in units of the stiffness. No body exceeds MO_EIGENVALUE_MAX. Without stiffness
 * the step is INFINITY. docs/numerics.md derives both bounds. */
#define MO_EIGENVALUE_MAX 12.0
double mo_stable_step_s(const struct mo_physics *physics, double eigenvalue);
/* Returns whether dt_s is below that step, at less cost. */
bool mo_step_is_stable(const struct mo_physics *physics, double eigenvalue);

/* Completes settings for a controller whose file states this control period: a period of 0 becomes
 * the controller's. A period of one step becomes 0 again if the controller has none, so that equal
 * computations have equal settings. MO_ERR_RANGE: the period is not a whole multiple of dt_s. */
int mo_physics_complete(struct mo_physics *physics, double controller_period_s);

/* Returns the steps in a control period: 1 … n_steps, because a longer period acts like n_steps.
 * Returns 0 if the period is not a whole multiple of dt_s. */
uint32_t mo_control_steps(const struct mo_scheme *scheme);

/* The channels of a recording, as bits of a set. */
enum mo_channel {
  MO_RECORD_COM = 1,
  MO_RECORD_MASSES = 2,
  MO_RECORD_ACTUATION = 4,
  MO_RECORD_CONTACTS = 8
};
#define MO_CHANNELS 4
extern const char *const mo_channel_words[]; /* in the order of the bits, then NULL */

/* The states at steps 0, stride, 2·stride, … ≤ n_steps: n_steps / stride + 1 frames. The caller
 * owns the arrays; NULL: not recorded. Positions after a divergence are those of the last finite
 * state. Actuation and contacts are those of the step that ends at the frame; in the first frame,
 * and after a divergence, they are 0. */
struct mo_recording {
  uint32_t stride;   /* ≥ 1 */
  double *com_m;     /* (frames, 3) */
  float *mass_m;     /* (frames, n_masses, 3) */
  int8_t *actuation; /* (frames, n_springs) the controller's output in [−1, 1], times 127 */
  uint8_t *contacts; /* (frames, n_masses) 1: the mass touched the terrain */
};
uint32_t mo_recording_frames(const struct mo_physics *physics, uint32_t stride);

/* The count of numbers in one frame of a channel, and the bytes of each number. */
uint32_t mo_channel_numbers(enum mo_channel channel, uint32_t n_masses, uint32_t n_springs);
uint32_t mo_channel_width(enum mo_channel channel);
/* Returns the bytes of one frame of a set of channels. */
uint64_t mo_recording_frame_bytes(unsigned channels, uint32_t n_masses, uint32_t n_springs);
/* Returns the array of a channel; NULL if not recorded. */
void *mo_recording_array(const struct mo_recording *recording, enum mo_channel channel);
/* Allocates the arrays of the channels in the set, filled with 0. MO_ERR_NO_MEMORY: no array is
 * left allocated. */
int mo_recording_create(struct mo_recording *recording, unsigned channels, uint32_t stride,
                        uint32_t frames, uint32_t n_masses, uint32_t n_springs);
void mo_recording_free(struct mo_recording *recording); /* the arrays; they become NULL */

struct mo_outcome {
  double loss;           /* +infinity when diverged */
  double value;          /* the objective's, in mo_objective_unit; −infinity when diverged */
  int32_t diverged_step; /* step (1-based) after which the state was not finite or too fast; 0: no
                            divergence */
  double com_start_m[3];
  double com_end_m[3]; /* the last finite one when diverged */
};

/* A callback every `interval` steps; a non-zero return value stops the block with MO_ERR_CANCELLED.
 * The callback may run other blocks in another workspace memory: urgent blocks run this way. */
struct mo_pause_point {
  uint32_t interval; /* 0: never */
  int (*reached)(void *context);
  void *context;
};

/* Runs one rollout. controller NULL: no actuation (rest lengths constant). recording, measuring:
 * nullable. MO_ERR_INVALID: the workspaces of the controller and the body differ; MO_ERR_NO_MEMORY.
 * A diverged rollout still returns MO_OK: the outcome records the divergence. */
int mo_rollout_reference(const struct mo_body *body, const struct mo_controller *controller,
                         const struct mo_environment *environment, const struct mo_physics *physics,
                         const struct mo_recording *recording, const struct mo_measuring *measuring,
                         struct mo_outcome *outcome);

/* ---- the fast path ---- */

enum mo_isa { MO_ISA_BASELINE = 0, MO_ISA_AVX2 = 1, MO_ISA_AVX512 = 2, MO_ISA_COUNT };
enum mo_isa mo_isa_best(void); /* the widest that this CPU and operating system support */
const char *mo_isa_name(enum mo_isa isa); /* "x86-64", "avx2", "avx512" */

/* A controller laid out for one instruction set and precision. Const, shared by all workers. Keeps
 * no reference to the controller. controller NULL: a pack for passive bodies of any workspace.
 * MO_ERR_UNSUPPORTED: this CPU lacks the instruction set. */
struct mo_pack;
int mo_pack_create(const struct mo_controller *controller, enum mo_isa isa,
                   enum mo_precision precision, struct mo_pack **pack);
void mo_pack_free(struct mo_pack *pack); /* NULL-safe */

/* Scratch memory of one worker: grows to fit the largest body seen, then allocates no more. */
struct mo_workspace_memory;
int mo_workspace_memory_create(struct mo_workspace_memory **memory);
void mo_workspace_memory_free(struct mo_workspace_memory *memory);
size_t mo_workspace_memory_bytes(const struct mo_workspace_memory *memory);

/* Runs one body in n_environments (1 … MO_BLOCK_LANES) environments. recordings: NULL or
 * n_environments of them. outcomes: (n_environments). measuring, pause: nullable. */
int mo_rollout_block(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                     const struct mo_body *body, const struct mo_environment *const *environments,
                     uint32_t n_environments, const struct mo_physics *physics,
                     const struct mo_recording *recordings, const struct mo_measuring *measuring,
                     const struct mo_pause_point *pause, struct mo_outcome *outcomes);

#ifdef __cplusplus
}
#endif
#endif
