/* gradient_tape.h: where a group's arrays are on the tape that the forward pass leaves for the
 * backward pass, and in the sums of products. C and CUDA. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_TAPE_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_TAPE_H

#include "compute/cuda/gradient_tables.h"

#include <stdbool.h>

/* How a rollout is divided into steps and control periods. */
struct mo_gp_time {
  uint32_t n_steps, control_steps; /* control_steps: in a control period; not 0 */
  bool splits;                     /* the integrator is `split` */
  bool is_special;                 /* some row is (plan.h) */
  bool works;                      /* the task of some row needs the work of the springs */
};

/* Offsets in a group's part of the tape, in bytes. Positions, velocities and pushes are
 * (n_steps, …), the rest (passes, …): the network computes its outputs once per control period. */
struct mo_gp_tape {
  uint64_t position;     /* float (3, n_masses) */
  uint64_t velocity;     /* float (3, n_masses) before contact */
  uint64_t push;         /* float (3, n_masses): what the springs add to the velocity; the backward
                            pass replaces it by ∂loss/∂push through the acceleration alone, where a
                            mass strikes. With `split`, otherwise absent */
  uint64_t activation;   /* int16 (n_chunks, 32) in units of 1/32767 */
  uint64_t d_activation; /* float (n_chunks, 32), once: ∂loss/∂activation, summed over
                            the steps of a control period; absent if it is one step, the
                            integrator is the paper's, and no task needs the work; in that case it
                            comes last, and `works` moves nothing else */
  uint64_t input;        /* bfloat16 (n_rows, 256) */
  uint64_t normal[MO_HIDDEN_LAYERS]; /* float16 (n_rows, 256); the backward pass replaces it by
                                        ∂loss/∂(sums of the layer), bfloat16 */
  uint64_t hidden[MO_HIDDEN_LAYERS]; /* bfloat16 (n_rows, 256) */
  uint64_t scale;                    /* float (MO_HIDDEN_LAYERS, n_rows) */
  uint64_t d_output; /* bfloat16 (n_rows, 16 n_outputs): ∂loss/∂(sums of the last layer) */
  uint64_t bytes;    /* the tracks follow: struct mo_track (passes + 1, n_rows), at each instant of
                        the rows' tasks */
};
/* Offsets in a group's sums, in floats. */
struct mo_gp_sum {
  uint64_t output;      /* (16 n_outputs, 256) */
  uint64_t hidden[2];   /* (256, 256) */
  uint64_t input;       /* (256, 256) */
  uint64_t output_bias; /* (16 n_outputs) */
  uint64_t bias;        /* (layers, 256) */
  uint64_t norm;        /* (halves, layers, 2, 256): gains, shifts */
  uint64_t floats;
};

#define MO_GP_ALIGN(bytes) (((uint64_t)(bytes) + 255) / 256 * 256)

#ifdef __CUDACC__
#define MO_GP_BOTH static __host__ __device__ inline
#else
#define MO_GP_BOTH static inline
#endif

/* Returns the number of control periods, the last of which may be shorter. */
MO_GP_BOTH uint32_t mo_gp_passes(uint32_t n_steps, uint32_t control_steps)
{
  return (n_steps + control_steps - 1) / control_steps;
}

MO_GP_BOTH struct mo_gp_tape mo_gp_tape_of(const struct mo_gp_group *g, struct mo_gp_time time)
{
  struct mo_gp_tape t;
  const uint64_t n = time.n_steps, passes = mo_gp_passes(time.n_steps, time.control_steps),
                 rows = g->n_rows;
  const bool sums = time.control_steps > 1 || time.splits;
  uint64_t at = 0;
  t.position = at, at += MO_GP_ALIGN(n * g->n_masses * 12);
  t.velocity = at, at += MO_GP_ALIGN(n * g->n_masses * 12);
  t.push = at, at += time.splits ? MO_GP_ALIGN(n * g->n_masses * 12) : 0;
  t.activation = at, at += MO_GP_ALIGN(passes * g->n_chunks * MO_GP_LANES * 2);
  t.d_activation = at, at += sums ? MO_GP_ALIGN(g->n_chunks * MO_GP_LANES * 4) : 0;
  t.input = at, at += MO_GP_ALIGN(passes * rows * MO_GP_INPUTS * 2);
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    t.normal[l] = at, at += MO_GP_ALIGN(passes * rows * MO_HIDDEN * 2);
    t.hidden[l] = at, at += MO_GP_ALIGN(passes * rows * MO_HIDDEN * 2);
  }
  t.scale = at, at += MO_GP_ALIGN(passes * rows * MO_HIDDEN_LAYERS * 4);
  t.d_output = at, at += MO_GP_ALIGN(passes * rows * g->n_outputs * MO_GP_TILE * 2);
  if (time.works && !sums)
    t.d_activation = at, at += MO_GP_ALIGN(g->n_chunks * MO_GP_LANES * 4);
  t.bytes = at;
  return t;
}

/* Return the bytes of the tracks in a group's part of the tape, and of all of it. */
MO_GP_BOTH uint64_t mo_gp_track_bytes(const struct mo_gp_group *g, struct mo_gp_time time)
{
  const uint64_t instants = (uint64_t)mo_gp_passes(time.n_steps, time.control_steps) + 1;
  return time.is_special ? MO_GP_ALIGN(instants * g->n_rows * sizeof(struct mo_track)) : 0;
}

MO_GP_BOTH uint64_t mo_gp_tape_bytes(const struct mo_gp_group *g, struct mo_gp_time time)
{
  return mo_gp_tape_of(g, time).bytes + mo_gp_track_bytes(g, time);
}

MO_GP_BOTH struct mo_gp_sum mo_gp_sum_of(const struct mo_gp_group *g)
{
  struct mo_gp_sum s;
  uint64_t at = 0;
  s.output = at, at += (uint64_t)g->n_outputs * MO_GP_TILE * MO_HIDDEN;
  for (int l = 0; l < 2; l++)
    s.hidden[l] = at, at += MO_HIDDEN * MO_HIDDEN;
  s.input = at, at += (uint64_t)MO_GP_INPUTS * MO_HIDDEN;
  s.output_bias = at, at += (uint64_t)g->n_outputs * MO_GP_TILE;
  s.bias = at, at += MO_HIDDEN_LAYERS * MO_HIDDEN;
  s.norm = at, at += g->n_rows / MO_GP_HALF_ROWS * MO_GP_NORM_FLOATS;
  s.floats = at;
  return s;
}

#endif
