/* gradient_back.cuh: a group on the way back: where its numbers are, and what is done with them, of which gradient_back_physics.cuh has a part
 * and gradient_back.cu the other. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_BACK_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_BACK_CUH

#include "compute/cuda/gradient_kernels.cuh"

/* What a launch finds out about a row. */
struct back_row {
  double start_m, largest;
  uint32_t steps, clipped;
  int zeroed, padding;
};

/* What a spring asks of the mass at its other end. */
struct back_mass {
  float2 xy, z_gx, gyz; /* position; ∂loss/∂ velocity */
};

template <int MT> struct back {
  enum { ROWS = 16 * MT };
  const mo_gk &k;
  const mo_gp_group &g;
  const int warp, lane;
  /* Copies of what the group says: a store might change the original, as far as the compiler knows. */
  int n_masses, n_chunks, first, n0, n1, own_chunks;
  uint32_t first_row;
  const uint8_t *input;
  const uint32_t *list; /* this lane's springs */
  uint32_t chunk_at;
  unsigned char *tape;
  uint32_t position_at, velocity_at, activation_at, normal_at, scale_at; /* on the group's tape, in bytes */
  uint32_t layer_bytes, output_at; /* from one layer to the next; ∂loss/∂ outputs */
  uint32_t width;                  /* of ∂loss/∂ outputs in shared memory */
  back_mass *mass;                 /* (n_masses) */
  float *gx;                       /* (n_masses, 3) ∂loss/∂ positions */
  __nv_bfloat16 *outputs, *left;
  float2 *part;
  float *norms; /* (3 layers, bias gain shift, 256) */
  int *failed;  /* (rows) */
  lane_row *rows;
  uint8_t *output_tile;
  int n_outputs;
  bool excluded[2];
  back_row *result;              /* (rows) */
  uint32_t first_step, end_step; /* of this part */

  __device__ __forceinline__ back(const mo_gk &args, const mo_gp_group &group, unsigned char *shared, uint32_t nth)
      : k(args), g(group), warp(threadIdx.x / 32), lane(threadIdx.x % 32),
        first_step(((args.n_steps - 1) / args.part_steps - nth) * args.part_steps),
        end_step(min(first_step + args.part_steps, args.n_steps))
  {
    const mo_gp_pair &pair = g.pair[warp];
    n_masses = (int)g.n_masses;
    n_chunks = (int)g.n_chunks;
    first = (int)pair.first_mass;
    n0 = (int)pair.n_masses[0];
    n1 = MT > 1 ? (int)pair.n_masses[1] : 0;
    own_chunks = (int)pair.n_chunks;
    first_row = g.first_row;
    input = k.input + g.first_mass + first;
    list = k.springs + (g.first_chunk + pair.first_chunk) * 32 + lane;
    chunk_at = pair.first_chunk * 32 + lane;
    const mo_gp_tape at = mo_gp_tape_of(&g, k.n_steps);
    tape = k.tape + g.tape_at;
    position_at = (uint32_t)at.position;
    velocity_at = (uint32_t)at.velocity;
    activation_at = (uint32_t)at.activation;
    normal_at = (uint32_t)at.normal[0];
    layer_bytes = (uint32_t)(at.normal[1] - at.normal[0]);
    scale_at = (uint32_t)at.scale;
    output_at = (uint32_t)at.d_output;
    width = g.n_outputs * MO_GP_TILE + 8;
    n_outputs = (int)g.n_outputs;
    output_tile = shared;
    if (threadIdx.x < MO_GP_OUTPUT_TILES)
      output_tile[threadIdx.x] = g.output_tile[threadIdx.x];
    shared += 128;
    left = (__nv_bfloat16 *)shared;
    shared += ROWS * MO_GK_ROW * 2;
    part = (float2 *)shared;
    shared += ROWS * MO_GK_PART * 8;
    rows = (lane_row *)shared;
    shared += ROWS * sizeof(lane_row);
    load_rows(rows, k.rows + g.first_row, ROWS);
    outputs = (__nv_bfloat16 *)shared;
    shared += (ROWS * width * 2 + 15) / 16 * 16;
    norms = (float *)shared;
    shared += 9 * MO_HIDDEN * 4;
    failed = (int *)shared;
    shared += ROWS * 4;
    result = (back_row *)shared;
    shared += ROWS * sizeof(back_row);
    mass = (back_mass *)shared;
    gx = (float *)(mass + n_masses);
  }

  __device__ __forceinline__ int own_masses(int r) const
  {
    return r == 0 ? n0 : n1;
  }

  __device__ __forceinline__ void start();

  __device__ __forceinline__ float clip(int r, int from);

  __device__ __forceinline__ void move_back(uint32_t step);

  __device__ __forceinline__ void springs_back(uint32_t step);

  __device__ __forceinline__ void keep_outputs(uint32_t step, float2 (&bias)[2]);

  /* Sums over rows of three values per column, added to the sums of this launch. */
  __device__ __forceinline__ void add_columns(float *to, float value)
  {
    value += __shfl_xor_sync(0xffffffffu, value, 4);
    value += __shfl_xor_sync(0xffffffffu, value, 8);
    value += __shfl_xor_sync(0xffffffffu, value, 16);
    if (lane < 4)
      *to += value;
  }

  __device__ __forceinline__ void load_normal(int layer, uint32_t step, __half2 (&n)[MT][2][2], float (&factor)[MT][2]);

  __device__ __forceinline__ void norm_relu_back(int layer, uint32_t step, warp_sums<MT> &sums,
                                                 const __half2 (&n)[MT][2][2], const float (&factors)[MT][2],
                                                 const norm_columns &columns);

  /* A tile of springs for this warp's neurons; the first of its sixteen tiles of a hidden layer. */
  __device__ __forceinline__ const uint4 *last_tile(int i) const
  {
    return k.weights.back[3] + ((uint32_t)warp * MO_GP_OUTPUT_TILES + output_tile[i]) * 32 + lane;
  }
  __device__ __forceinline__ const uint4 *hidden_tiles(int layer) const
  {
    return k.weights.back[layer] + (uint32_t)warp * (16 * 32) + lane;
  }

  /* Springs' tiles go by the ring's length, the first time fewer: so many are left out before the first. */
  __device__ __forceinline__ int lead() const
  {
    return (MO_GK_AHEAD_BACK - n_outputs % MO_GK_AHEAD_BACK) % MO_GK_AHEAD_BACK;
  }

  __device__ __forceinline__ void start_ahead(weights_ahead<MO_GK_AHEAD_BACK> &ahead) const
  {
    const int before = lead();
    ahead.start([&](int i) { return last_tile(max(i - before, 0)); });
  }

  __device__ __forceinline__ void add_last(warp_sums<MT> &sums, weights_ahead<MO_GK_AHEAD_BACK> &ahead);

  __device__ __forceinline__ void control_back(uint32_t step, weights_ahead<MO_GK_AHEAD_BACK> &ahead);

  __device__ __forceinline__ void sense_back();

  static __device__ __forceinline__ void fetch(const void *from, size_t bytes)
  {
    for (size_t i = (size_t)threadIdx.x * 128; i < bytes; i += (size_t)MO_GK_THREADS * 128)
      asm volatile("prefetch.global.L2 [%0];" ::"l"((const char *)from + i));
  }

  __device__ __forceinline__ void fetch_step(uint32_t step);

  __device__ __forceinline__ void run();
};

#endif
