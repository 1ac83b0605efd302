/* gradient_back.cuh: a group on the way back: where its numbers are, and what is done with them, of which gradient_back_physics.cuh has a part
 * and gradient_back.cu the other. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_BACK_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_BACK_CUH

#include "compute/cuda/gradient_kernels.cuh"

/* What a launch finds out about a row. */
struct back_row {
  double start_squared, largest; /* squares, too: largest of the adjoints' norms times start_m */
  uint32_t steps, clipped;
  int zeroed, padding;
};

/* What a spring asks of the mass at its other end. */
struct back_mass {
  float2 xy, z_gx, gyz; /* position; ∂loss/∂ velocity */
};

template <int MT> struct left_tile;

template <int MT, int SHARE> struct back : walker<MT, SHARE> {
  using own = walker<MT, SHARE>;
  using own::begin, own::end, own::first, own::first_chunk, own::group_first, own::group_row, own::half,
      own::half_begin, own::is_second, own::lane, own::lane_begin, own::n0, own::n1, own::n_own, own::own_begin,
      own::own_chunks, own::own_masses, own::own_row, own::pair_row, own::pair_sync, own::ROWS, own::TAPE_ROWS,
      own::warp;
  enum { HELD = 4 };
  /* The first of a lane's masses, on their way from the tape. */
  struct held {
    float v[HELD][3];
  };
  const mo_gk &k;
  const mo_gp_group &g;
  /* Copies of what the group says: a store might change the original, as far as the compiler knows. */
  int n_masses, n_chunks;
  int block_chunk, block_chunks; /* the first of this block's, of the group's; how many */
  uint32_t first_row;
  const uint8_t *input;
  const uint32_t *list; /* this lane's springs */
  uint32_t chunk_at;
  unsigned char *tape;
  uint32_t position_at, velocity_at, activation_at, normal_at, scale_at; /* on the group's tape, in bytes */
  uint32_t layer_bytes, output_at; /* from one layer to the next; ∂loss/∂ outputs */
  uint32_t width;                  /* of ∂loss/∂ outputs in shared memory */
  back_mass *mass;                 /* (n_own) */
  float *gx;                       /* (n_own, 3) ∂loss/∂ positions */
  __nv_bfloat16 *outputs, *left;
  float2 *part;
  int *failed; /* (rows) */
  mo_plan_scene *rows;
  uint8_t *output_tile;
  float *norm_sums; /* (halves, layers, 2, 256) of all steps */
  int n_outputs;
  bool excluded[2];
  back_row *result;              /* (rows) */
  uint32_t first_step, end_step; /* of this part */

  __device__ __forceinline__ back(const mo_gk &args, const mo_gp_group &group, unsigned char *shared,
                                  const mo_gk_task &task)
      : own(group, task.walk & 1), k(args), g(group),
        first_step(((args.n_steps - 1) / args.part_steps - task.part) * args.part_steps),
        end_step(min(first_step + args.part_steps, args.n_steps))
  {
    n_masses = (int)g.n_masses;
    n_chunks = (int)g.n_chunks;
    block_chunk = SHARE > 1 && half > 0 ? (int)g.pair[own::PAIRS].first_chunk : 0;
    block_chunks = (SHARE > 1 && half == 0 ? (int)g.pair[own::PAIRS].first_chunk : n_chunks) - block_chunk;
    first_row = g.first_row;
    input = k.input + g.first_mass + group_first();
    list = k.springs + (g.first_chunk + first_chunk) * 32 + lane;
    chunk_at = first_chunk * 32 + lane;
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
    if ((int)threadIdx.x < n_outputs)
      output_tile[lead() + threadIdx.x] = g.output_tile[threadIdx.x];
    if (threadIdx.x < MO_GK_AHEAD_BACK)
      output_tile[lead() + n_outputs + threadIdx.x] = (uint8_t)threadIdx.x; /* then the first of a hidden layer */
    shared += 128;
    left = (__nv_bfloat16 *)shared;
    shared += ROWS * MO_GK_ROW * 2;
    part = (float2 *)shared;
    shared += ROWS * MO_GK_PART * 8;
    rows = (mo_plan_scene *)shared;
    shared += ROWS * sizeof(mo_plan_scene);
    own::load_rows(rows, k.rows + g.first_row);
    norm_sums = k.sums + g.sum_at + mo_gp_sum_of(&g).norm + half * MO_GP_NORM_FLOATS;
    outputs = (__nv_bfloat16 *)shared;
    shared += (ROWS * width * 2 + 15) / 16 * 16;
    failed = (int *)shared;
    shared += ROWS * 4;
    result = (back_row *)shared;
    shared += ROWS * sizeof(back_row);
    mass = (back_mass *)shared;
    gx = (float *)(mass + n_own);
  }

  /* What follows from these is made again where it is needed: the compiler would make it before the first step, and have no registers for it. */
  __device__ __forceinline__ void forget()
  {
    asm volatile(""
                 : "+r"(warp), "+r"(lane), "+r"(n_masses), "+r"(n_chunks), "+r"(first), "+r"(n0), "+r"(n1),
                   "+r"(n_outputs));
  }

  __device__ __forceinline__ void aim(int r, double dx, double dy, double weight);

  __device__ __forceinline__ void start();

  __device__ __forceinline__ void restart(int r);

  __device__ __forceinline__ void hold(uint32_t step, held &h);

  __device__ __forceinline__ uint32_t limit(float (&scale)[2]);

  /* The i-th mass put aside: in the rows of the network's last adjoint that this warp alone has read. */
  __device__ __forceinline__ uint16_t *aside(int i)
  {
    return (uint16_t *)left + own_row(i >> 8) * MO_GK_ROW + (i & 255);
  }

  __device__ __forceinline__ void strikes_back(uint32_t step, int n, const float (&scale)[2]);

  __device__ __forceinline__ void move_one(int m, const float *v, const float (&scale)[2], int &n_aside);

  __device__ __forceinline__ void move_back(uint32_t step, const held &h);

  __device__ __forceinline__ void springs_back(uint32_t step);

  /* Which of the block's halves row 16 m + 8 h + lane / 4 is of, and whether it is this lane's first of it. */
  static __device__ __forceinline__ int half_of(int h)
  {
    return MT > 1 ? h : 0;
  }
  static __device__ __forceinline__ bool begins(int m, int h)
  {
    return m == 0 && (MT > 1 || h == 0);
  }

  /* Sums over rows of this lane's four columns, by halves, added to those of all steps. Lanes 4, 8 and 16 apart have other rows of the same columns;
   * each of them ends with one column, of one half. */
  __device__ __forceinline__ void add_columns(float *to, const float2 (&d)[MT][2])
  {
    const bool odd = lane & 4, second = lane & 8, upper = lane & 16;
    float sum[MT];
#pragma unroll
    for (int h = 0; h < MT; h++) {
      float2 near = odd ? make_float2(d[h][0].y, d[h][1].y) : make_float2(d[h][0].x, d[h][1].x);
      const float2 far = odd ? make_float2(d[h][0].x, d[h][1].x) : make_float2(d[h][0].y, d[h][1].y);
      near.x += __shfl_xor_sync(0xffffffffu, far.x, 4);
      near.y += __shfl_xor_sync(0xffffffffu, far.y, 4);
      sum[h] = second ? near.y : near.x;
      sum[h] += __shfl_xor_sync(0xffffffffu, second ? near.x : near.y, 8);
    }
    to += 2 * second + odd;
    if (MT > 1)
      atomicAdd(to + (upper ? MO_GP_NORM_FLOATS : 0),
                (upper ? sum[MT - 1] : sum[0]) + __shfl_xor_sync(0xffffffffu, upper ? sum[0] : sum[MT - 1], 16));
    else {
      sum[0] += __shfl_xor_sync(0xffffffffu, sum[0], 16);
      if (!upper)
        atomicAdd(to, sum[0]);
    }
  }

  __device__ __forceinline__ void load_normal(int layer, uint32_t step, __half2 (&n)[MT][2][2], float (&factor)[MT][2]);

  __device__ __forceinline__ void norm_relu_back(int layer, uint32_t step, warp_sums<MT> &sums,
                                                 const __half2 (&n)[MT][2][2], const float (&factors)[MT][2],
                                                 const norm_columns &columns);

  /* The first of the tiles of springs for this warp's neurons; of its sixteen tiles of a hidden layer. */
  __device__ __forceinline__ const uint4 *last_tiles() const
  {
    return k.weights.back[3] + (uint32_t)warp * MO_GP_OUTPUT_TILES * 32 + lane;
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

  /* The ring's first places are those left out, or hold nothing that is used. */
  __device__ __forceinline__ void start_ahead(weights_ahead<MO_GK_AHEAD_BACK> &ahead) const
  {
    const int before = lead();
    ahead.start([&](int i) { return last_tiles() + (i < before ? 0 : output_tile[i] * 32); });
  }

  template <bool FIRST>
  __device__ __forceinline__ void add_round(warp_sums<MT> &sums, weights_ahead<MO_GK_AHEAD_BACK> &ahead,
                                            left_tile<MT> (&a)[2], uint32_t left_at, const uint4 *from,
                                            const uint2 &then, int before);

  __device__ __forceinline__ void add_last(uint32_t step, warp_sums<MT> &sums, weights_ahead<MO_GK_AHEAD_BACK> &ahead);

  __device__ __forceinline__ void control_back(uint32_t step, weights_ahead<MO_GK_AHEAD_BACK> &ahead);

  __device__ __forceinline__ void sense_back(uint32_t inputs);

  __device__ __forceinline__ void push_back(int m, float d, const float (&mean)[2]);

  static __device__ __forceinline__ void copy_ahead(uint32_t to, const float *from)
  {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(to), "l"(from) : "memory");
  }
  static __device__ __forceinline__ void wait_copies()
  {
    asm volatile("cp.async.wait_all;" ::: "memory");
  }

  static __device__ __forceinline__ void fetch(const void *from, uint32_t bytes)
  {
#pragma unroll 1
    for (uint32_t i = threadIdx.x * 128; i < bytes; i += MO_GK_THREADS * 128)
      asm volatile("prefetch.global.L2 [%0];" ::"l"((const char *)from + i));
  }

  __device__ __forceinline__ void fetch_step(uint32_t step);

  __device__ __forceinline__ void run();
};

#endif
