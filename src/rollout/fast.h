/* fast.h: data that block.c and gradient_block.c prepare for kernel.inc and gradient_kernel.inc.
 * Internal to this room.
 *
 * Every array of reals is of the pack's precision and 64-byte aligned. "Lanes" are environments:
 * MO_BLOCK_LANES values are stored side by side, so that one vector operation handles a spring or a
 * mass in all environments, without a gather. The controller's matrices are cut into panels of
 * `panel` outputs, (k, panel) row-major, so that matrix products compute several outputs side by
 * side, and every environment is one row. */
#ifndef MORPHO_ROLLOUT_FAST_H
#define MORPHO_ROLLOUT_FAST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>
#include <morpho/state.h>

#define MO_LANES MO_BLOCK_LANES

/* The terrain as polynomials: 7 × 7 cells and a rim of cells beyond the map, where the clamped
 * coordinate has no effect. Cell (i, j), −1 ≤ i, j ≤ 7, at (j + 1)·9 + (i + 1): h + u·a + w·b +
 * u·w·c from its corner. A profile has cells (i, 0), −1 ≤ i ≤ 63; other grids: lane_grid.inc. */
#define MO_CELLS_SIDE 9
#define MO_CELLS      (MO_CELLS_SIDE * MO_CELLS_SIDE)

struct mo_pack {
  enum mo_isa isa;
  enum mo_precision precision;
  bool passive;
  struct mo_workspace workspace;
  enum mo_sensor sensor;
  uint32_t n_masses, n_springs, n_inputs;
  size_t n_parameters;
  uint32_t panel; /* outputs per panel: two vectors */
  size_t real_bytes;
  /* One allocation; float if weights are only repacked for a body. */
  float *input_weight;                          /* (256 / panel, n_masses, panel) */
  float *output_weight, *output_bias;           /* (n_springs, 256), (n_springs): as in the file */
  void *cpg_weight;                             /* reals (5, 256): transposed */
  void *hidden_weight[MO_HIDDEN_LAYERS - 1];    /* reals (256 / panel, 256 inputs, panel outputs) */
  float *backward_weight[MO_HIDDEN_LAYERS - 1]; /* (256 / panel, 256 outputs, panel inputs); NULL:
                                                   not for gradients */
  void *bias[MO_HIDDEN_LAYERS];                 /* reals (256) */
  void *gain[MO_HIDDEN_LAYERS], *shift[MO_HIDDEN_LAYERS];
};

struct mo_fast_run {
  const struct mo_pack *pack;
  const struct mo_body *body;
  const struct mo_environment *const *environments;
  uint32_t n_environments;
  const struct mo_physics *physics;
  uint32_t control_steps, first_step;      /* steps in a control period; first step of the block */
  const struct mo_state *from;             /* (n_environments); NULL: the usual start */
  struct mo_state *to;                     /* (n_environments); NULL: not requested */
  struct mo_constants constants[MO_LANES]; /* of each environment */
  const struct mo_recording *recordings;
  const struct mo_measuring *measuring;   /* NULL: no measures */
  unsigned observations, needs[MO_LANES]; /* measuring.h, for measures and tasks: of all, of each */
  const struct mo_pause_point *pause;
  struct mo_outcome *outcomes;
  /* Scratch, carved by block.c. */
  void *input_weight;    /* (256 / panel, n_masses, panel) of the body's masses */
  void *output_weight;   /* (n_panels, 256, panel); the last panel is only one vector wide if that
                          * suffices */
  void *output_bias;     /* (n_panels · panel) */
  uint32_t *spring_ends; /* (n_springs, 2) offsets of the masses in the arrays below */
  void *spring_rest;     /* (n_springs) rest lengths */
  bool breaks;           /* some environment cuts springs */
  void *intact;          /* (n_springs, lanes) 1, or 0 if cut; only if `breaks` */
  uint8_t *cut;          /* (n_springs) the springs cut in one environment; only if `breaks` */
  void *position[2];     /* (n_masses, 3, lanes): now and next; x, y from the world's center */
  void *velocity;        /* (n_masses, 3, lanes) */
  void *coasted;         /* (n_masses, 3, lanes) velocities without the springs; for `split` only */
  double *start;         /* (n_masses, 3) */
  void *sensor;          /* (n_masses, lanes) */
  void *hidden;          /* (2, lanes, 256) */
  void *activation;      /* (lanes, panel) */
  bool keeps;    /* activations outlive a step: control periods, `split`, measures, states */
  bool blends;   /* springs use mean activations: `split`, or for measures */
  void *held;    /* (n_panels · panel, lanes) the latest activations; one panel's if not kept */
  void *blended; /* (panel, lanes) the mean of new and previous activations; only if `blends` */
  void *terrain; /* (lanes, MO_CELLS, 4) */
  uint32_t *contacts; /* (n_masses) bits of the lanes that touched the terrain, in steps that end
                       * at a frame or a state, or are observed; undefined in other steps */
  /* Only if something is observed: the first two are described in measuring.h. */
  double (*rows)[3];    /* (n_masses) */
  uint8_t (*halves)[2]; /* (n_masses) */
  void *turn_rows;      /* (n_masses, 2) reals: what the yaw needs of `rows` */
  void *inverse_rest;   /* (n_springs) 1 / rest length */
  uint32_t *corners;    /* (n_voxels, 8) offsets of the masses in the arrays of positions */
  uint32_t *inverted;   /* (n_voxels) bits of the lanes: inverted at the previous instant */
};

/* ---- gradients ---- */

/* Memory that grows and never shrinks. */
struct mo_gradient_buffer {
  char *base;
  size_t size;
  bool mapped; /* by mmap */
};

struct mo_gradient_memory {
  size_t budget_bytes;
  struct mo_gradient_buffer block, tiling, work;
};

/* Makes buffer->base point to at least `bytes`, 64-byte aligned; old content is lost.
 * MO_ERR_NO_MEMORY: the buffer did not change, or is empty. */
int mo_gradient_reserve(struct mo_gradient_buffer *buffer, size_t bytes);

struct mo_gradient_run {
  struct mo_gradient_memory *memory;
  const struct mo_pack *pack;
  const struct mo_robot *robots;
  uint32_t n;
  const struct mo_physics *physics;
  uint32_t control_steps; /* in a control period */
  const struct mo_gradient_options *options;
  const struct mo_pause_point *pause;
  struct mo_outcome *outcomes;
  float *d_parameters;
  struct mo_gradient_counts *counts; /* of this block */
};

/* ---- kernels ---- */

typedef int mo_fast_function(struct mo_fast_run *run);
mo_fast_function mo_fast_baseline_float, mo_fast_baseline_double;
mo_fast_function mo_fast_avx2_float, mo_fast_avx2_double;
mo_fast_function mo_fast_avx512_float, mo_fast_avx512_double;

typedef int mo_gradient_function(struct mo_gradient_run *run);
mo_gradient_function mo_gradient_baseline, mo_gradient_avx2, mo_gradient_avx512;

/* Return the kernels of an instruction set. */
mo_fast_function *mo_fast_find(enum mo_isa isa, enum mo_precision precision);
mo_gradient_function *mo_gradient_find(enum mo_isa isa);
uint32_t mo_isa_vector_bytes(enum mo_isa isa);

/* Compute sin, exp and the natural logarithm from only IEEE operations, so that the bits do not
 * depend on the variant that the C library chooses for the CPU. Within 2 ulp of the exact value for
 * |x| ≤ 1e6, −700 ≤ x ≤ 0 and normal x > 0 respectively. */
double mo_fast_sin(double x);
double mo_fast_exp(double x);
double mo_fast_log(double x);

#endif
