/* gradient_kernels.cuh: shared by the kernels of the gradient: their arguments, tasks, a group's
 * shared memory, sums over rows. gradient_matrix.cuh has the matrix instructions. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_KERNELS_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_KERNELS_CUH

#include "compute/cuda/gradient_matrix.cuh"
#include "compute/cuda/gradient_tape.h"
#include "compute/cuda/lane.cuh"

#include <stdint.h>

enum {
  MO_GK_THREADS = MO_GP_WARPS * MO_GP_LANES,
  MO_GK_AHEAD = 8,              /* tiles of weights loaded ahead, forward */
  MO_GK_AHEAD_BACK = 8,         /* and backward, with fewer registers */
  MO_GK_SPRINGS_AHEAD = 8,      /* chunks of springs loaded ahead, forward */
  MO_GK_SPRINGS_AHEAD_BACK = 4, /* and backward: this many at once */
  MO_GK_ROW = MO_HIDDEN + 8,    /* a row of activations in shared memory: rows start in different
                                   banks */
  MO_GK_PART = MO_GP_WARPS + 2  /* a row of partial sums: rows start in different banks */
};
#define MO_GK_LARGE                                                                                \
  1e30f /* a larger derivative counts as not finite: sums of smaller ones are finite */

/* Weights as tiles. The first index is divided among warps. */
struct mo_gk_weights {
  uint4 *forward[MO_HIDDEN_LAYERS + 1]; /* (16, 16) × 3, (103, 16): [out tile][in tile], float16 */
  uint4 *back[MO_HIDDEN_LAYERS + 1];    /* (16, 16) × 3: [in tile][out tile]; (16, 103): [in
                                           tile][spring tile], bfloat16 */
  float *bias[MO_HIDDEN_LAYERS + 1], *gain[MO_HIDDEN_LAYERS], *shift[MO_HIDDEN_LAYERS];
};

struct mo_gk_result {
  double com_end[3]; /* x, y from the world's center */
  double largest;
  int32_t diverged;
  int32_t excluded; /* set by the host: contributes nothing */
  int32_t zeroed;   /* found in this backward pass */
  uint32_t steps, clipped;
};

/* The result of a row with a task, and the state of its backward pass. */
struct mo_gk_ending {
  double loss, value;
  double energy_m2[2]; /* what outputs have added to after² − before² of the springs
                          (gradient_work.cuh): those of the pair's first and second warp */
  struct mo_course_adjoint adjoint;
};

struct mo_gk {
  const struct mo_gp_group *groups;
  const struct mo_gp_row *rows;
  const uint32_t
      *order; /* (n_walks) MO_GK_WALK, some with MO_GK_HALVED: the most expensive first */
  const uint8_t *input;
  const uint32_t *springs;
  const float *generators; /* (n_steps, 5) */
  unsigned char *tape;
  float *sums;
  float *position, *velocity;   /* (n_masses, 3) between parts: the state, or ∂loss/∂state */
  struct mo_gk_result *results; /* (n_rows) */
  struct mo_gk_weights weights;
  float dt;
  uint32_t bisections; /* 0: exact */
  enum mo_sensor sensor;
  double bound, restart_weight;
  bool restarts; /* MO_ADJOINT_RESTART */
  int walked;    /* MO_GK_WHOLE … : how groups of 32 rows are computed */
  uint32_t n_steps, n_walks;
  uint32_t part_steps;    /* steps of a task: whole control periods */
  uint32_t control_steps; /* in a control period; not 0 */
  bool splits;            /* the integrator is `split` */
  uint32_t *tickets;      /* tasks handed out, then (by MO_GK_WALK) parts done; 0 before a launch */
  const volatile int *cancel; /* not 0: stop soon. On the device, because the host's memory is read
                               * so slowly (1.3 µs each, one after another) that products waited
                               * three times as long for it as they took */
  const struct mo_gp_course *courses; /* (n_rows); NULL: no row is special */
  struct mo_gk_ending *endings;       /* (n_rows) */
  double dt_s;
  const uint32_t *cuts; /* (n_chunks) as in struct mo_gradient_plan; NULL: no row has damage */
  bool works;           /* the task of some row needs the work of the springs */
};

/* A walk: a group, or half of one, which one block at a time takes through all steps. */
#define MO_GK_WALK(group, half) ((uint32_t)(group) << 1 | (uint32_t)(half))
#define MO_GK_HALVED            (UINT32_C(1) << 31) /* the walk is half of a group */
enum { MO_GK_WHOLE, MO_GK_HALVES, MO_GK_MIXED };
/* `paper` with new outputs in every step; `paper` with control periods of several steps; `split`
 * with any control period. The last two are for batches in which some row is special (plan.h):
 * `paper` and `split` with any control period. Their tasks are those of morpho/task.h; mo_gk_task
 * is something else. */
enum { MO_GK_EVERY, MO_GK_PERIODS, MO_GK_SPLIT, MO_GK_PERIODS_TASKS, MO_GK_SPLIT_TASKS };

/* A forward or backward pass is divided into *tasks*, each a part of the steps of one walk, so that
 * no multiprocessor waits long for the last one. A block does one task. Tasks are handed out part
 * by part, the most expensive walks first within each part. The block of a task waits until the
 * previous part of its walk is done. A block with an earlier ticket does that part, so the wait
 * always ends. */
struct mo_gk_task {
  uint32_t walk; /* MO_GK_WALK, with MO_GK_HALVED: separating them here would cost the kernels
                    registers */
  uint32_t part;
};

#ifdef __CUDACC__

/* Gets the next task; all threads call it. Returns false if cancelled. `ticket`: a word of shared
 * memory. */
static __device__ __forceinline__ bool take_task(const mo_gk &k, uint32_t *ticket, mo_gk_task *task)
{
  if (threadIdx.x == 0) {
    uint32_t t = atomicAdd(k.tickets, 1);
    const uint32_t part = t / k.n_walks;
    const uint32_t *done = k.tickets + 1 + (k.order[t % k.n_walks] & ~MO_GK_HALVED);
    for (uint32_t at = 0;; __nanosleep(500)) {
      asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(at) : "l"(done) : "memory");
      if (*k.cancel != 0)
        t = UINT32_MAX;
      if (at >= part || t == UINT32_MAX)
        break;
    }
    *ticket = t;
  }
  __syncthreads();
  const uint32_t t = *ticket;
  __syncthreads();
  if (t == UINT32_MAX)
    return false;
  task->walk = k.order[t % k.n_walks];
  task->part = t / k.n_walks;
  return true;
}

static __device__ __forceinline__ void end_task(const mo_gk &k, const mo_gk_task &task)
{
  __syncthreads();
  if (threadIdx.x == 0) {
    __threadfence();
    asm volatile(
        "st.release.gpu.global.u32 [%0], %1;" ::"l"(k.tickets + 1 + (task.walk & ~MO_GK_HALVED)),
        "r"(task.part + 1)
        : "memory");
  }
}

/* Allows every launch of the kernel the maximum of a block: the attribute belongs to the device, no
 * matter which handle sets it, so it is never set to the needs of a single launch. */
template <class Kernel>
static int allow_shared(Kernel kernel, uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  cudaFuncAttributes attributes;
  cudaError_t status = cudaFuncGetAttributes(&attributes, kernel);
  if (status != cudaSuccess)
    return (int)status;
  *dynamic_bytes = block_bytes - (uint32_t)attributes.sharedSizeBytes;
  return (int)cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                                   (int)*dynamic_bytes);
}

/* Return a spring's activation from the tape, and its target length. */
static __device__ __forceinline__ float activation_of(int16_t kept)
{
  return (float)kept * (1.0f / 32767.0f);
}

static __device__ __forceinline__ float wanted_length(float actuation, uint32_t spring,
                                                      float activation)
{
  return lane_wanted(lane_rest(MO_GP_SPRING_DIAGONAL(spring)), actuation, activation);
}

template <class T> static __device__ __forceinline__ T sum_lanes(T x)
{
#pragma unroll
  for (int k = 16; k > 0; k >>= 1)
    x += __shfl_xor_sync(0xffffffffu, x, k);
  return x;
}

/* A row at an instant of its task (gradient_guide.cuh): the start of a control period, or the end.
 */
struct guided_row {
  const mo_gp_course *task; /* NULL: the row is plain, or empty */
  mo_gk_ending *ending;
  mo_track *track; /* of the instant */
  uint32_t stride; /* back to the previous instant */
};

/* The walk of a block: a group, in which each warp has a pair (SHARE 1), two rows of 32 or one of
 * 16; or half of a group of 32 rows (SHARE 2), in which two warps share a pair: each has one of its
 * rows, and some of the springs of both. Rows and masses are numbered within the block; on the tape
 * and in the tables, within the group.
 *
 * TIME: MO_GK_EVERY … . Each value has its own kernels, because registers are scarce. */
template <int MT, int SHARE, int TIME> struct walker {
  static constexpr bool PERIODIC = TIME != MO_GK_EVERY,
                        SPLIT = TIME == MO_GK_SPLIT || TIME == MO_GK_SPLIT_TASKS,
                        TASKS = TIME == MO_GK_PERIODS_TASKS || TIME == MO_GK_SPLIT_TASKS;
  const mo_gk &k;
  const mo_gp_group &g;
  enum {
    ROWS = 16 * MT,
    TAPE_ROWS = SHARE > 1 ? MO_GP_ROWS_MAX : ROWS,
    PAIRS = MO_GP_WARPS / SHARE
  };
  int warp, lane, half, half_begin; /* half_begin: its first mass, within the group */
  int first, n0, n1, n_own; /* the pair's first mass; masses of its rows; masses of the block */
  int own_chunks;
  uint32_t first_chunk; /* of the group's */
  /* Copies of the group's members, because the compiler must assume that a store changes the
   * originals. */
  int n_masses, n_chunks, n_outputs;
  uint32_t first_row;
  const uint32_t *list; /* this lane's springs */
  uint32_t chunk_at;
  unsigned char *tape;
  /* Offsets on the group's tape, in bytes; layer_bytes: from one layer to the next. */
  uint32_t position_at, velocity_at, push_at, activation_at, d_activation_at, input_at, normal_at,
      hidden_at, scale_at, output_at;
  uint32_t layer_bytes;
  uint32_t width; /* of the outputs in shared memory, or of ∂loss/∂outputs */
  uint32_t first_step, end_step;
  /* In shared memory. */
  uint8_t *output_tile; /* (124) */
  void *left_memory;    /* (rows, MO_GK_ROW) the inputs of a layer, 16 bits each */
  float2 *part;
  mo_plan_scene *rows;
  void *output_memory;   /* (rows, width) 16 bits each */
  unsigned char *behind; /* memory for this direction's own use */

  /* part_number: selects the steps of the walk for the task. */
  __device__ __forceinline__ walker(const mo_gk &args, const mo_gp_group &group,
                                    unsigned char *shared, const mo_gk_task &task,
                                    uint32_t part_number)
      : k(args), g(group), warp(threadIdx.x / 32), lane(threadIdx.x % 32),
        half(SHARE > 1 ? (int)(task.walk & 1) : 0), first_step(part_number * args.part_steps),
        end_step(min(first_step + args.part_steps, args.n_steps))
  {
    const mo_gp_pair &pair = g.pair[PAIRS * half + warp / SHARE];
    half_begin = SHARE > 1 ? (int)g.pair[PAIRS * half].first_mass : 0;
    n_own = (int)(SHARE > 1 && half == 0 ? g.pair[PAIRS].first_mass : g.n_masses) - half_begin;
    first = (int)pair.first_mass - half_begin;
    n0 = (int)pair.n_masses[0];
    n1 = MT * SHARE > 1 ? (int)pair.n_masses[1] : 0;
    first_chunk = pair.first_chunk + (has_second() ? pair.split : 0);
    own_chunks = (int)(SHARE == 1     ? pair.n_chunks
                       : has_second() ? pair.n_chunks - pair.split
                                      : pair.split);
    n_masses = (int)g.n_masses;
    n_chunks = (int)g.n_chunks;
    n_outputs = (int)g.n_outputs;
    first_row = g.first_row;
    list = k.springs + (g.first_chunk + first_chunk) * 32 + lane;
    chunk_at = first_chunk * 32 + lane;
    const mo_gp_tape at = mo_gp_tape_of(
        &g, mo_gp_time{k.n_steps, PERIODIC ? k.control_steps : 1, SPLIT, TASKS, TASKS && k.works});
    tape = k.tape + g.tape_at;
    position_at = (uint32_t)at.position;
    velocity_at = (uint32_t)at.velocity;
    push_at = (uint32_t)at.push;
    activation_at = (uint32_t)at.activation;
    d_activation_at = (uint32_t)at.d_activation;
    input_at = (uint32_t)at.input;
    normal_at = (uint32_t)at.normal[0];
    hidden_at = (uint32_t)at.hidden[0];
    layer_bytes = (uint32_t)(at.normal[1] - at.normal[0]);
    scale_at = (uint32_t)at.scale;
    output_at = (uint32_t)at.d_output;
    width = g.n_outputs * MO_GP_TILE + 8;
    output_tile = shared;
    left_memory = shared + 128;
    part = (float2 *)(shared + 128 + ROWS * MO_GK_ROW * 2);
    rows = (mo_plan_scene *)(part + ROWS * MO_GK_PART);
    load_rows();
    if (TASKS && warp == 0) {
      const bool is_profile = lane < ROWS && special_of(lane).cells.rows == 1;
      const uint32_t bits = __ballot_sync(0xffffffffu, is_profile);
      if (lane == 0)
        *profiles() = bits;
    }
    output_memory = rows + ROWS;
    behind = (unsigned char *)output_memory + (ROWS * width * 2 + 15) / 16 * 16;
  }

  /* Return the pass of the network whose outputs act in a step, and whether the step is the first
   * of its control period, which computes them, or the last. */
  __device__ __forceinline__ uint32_t pass_of(uint32_t step) const
  {
    return PERIODIC ? step / k.control_steps : step;
  }
  __device__ __forceinline__ bool begins_period(uint32_t step) const
  {
    return !PERIODIC || step % k.control_steps == 0;
  }
  __device__ __forceinline__ bool ends_period(uint32_t step) const
  {
    return !PERIODIC || (step + 1) % k.control_steps == 0 || step + 1 == k.n_steps;
  }

  /* Returns whether a step has new outputs, which the springs blend with the previous ones. */
  __device__ __forceinline__ bool blends(uint32_t step) const
  {
    return SPLIT && step > 0 && begins_period(step);
  }

  /* Returns a row of the block at the start of a pass, or, after the last pass, at the end. */
  __device__ __forceinline__ guided_row guided(int row, uint32_t instant) const
  {
    const int at = group_row(row);
    const mo_gp_course *task = k.courses + first_row + at;
    const uint64_t track =
        mo_gp_tape_of(&g, mo_gp_time{k.n_steps, k.control_steps, SPLIT, TASKS, k.works}).bytes;
    return guided_row{task->is_plain ? nullptr : task, k.endings + first_row + at,
                      (mo_track *)(tape + track) + (size_t)instant * TAPE_ROWS + at, TAPE_ROWS};
  }
  __device__ __forceinline__ const mo_plan_special &special_of(int row) const
  {
    return k.courses[first_row + group_row(row)].special;
  }
  __device__ __forceinline__ lane_terrain terrain_of(int row) const
  {
    return lane_terrain{rows[row].heights, TASKS ? &special_of(row).cells : nullptr};
  }
  /* Like lane_strikes, for a mass of this row. Most masses need nothing else about the terrain, and
   * most terrains are grids, the cells of which need not be loaded. */
  __device__ __forceinline__ bool strikes_in(int row, const lane_physics &physics, const float *p,
                                             const float *v, float *next) const
  {
    const mo_plan_scene &of = rows[row];
    lane_cell ground;
    if (TASKS && (*profiles() >> row & 1u) != 0)
      return lane_strikes(&physics, terrain_of(row), of.highest, p, v, next, &ground);
    return lane_strikes(&physics, lane_grid(of.heights), of.highest, p, v, next, &ground);
  }
  /* Bit i: the terrain of the block's row i is a profile. It is in shared memory, after the numbers
   * of tiles. */
  __device__ __forceinline__ uint32_t *profiles() const
  {
    return (uint32_t *)(output_tile + 124);
  }
  /* Bit k: some springs of the pair's k-th row exert no force in a step. */
  __device__ __forceinline__ uint32_t broken(uint32_t step) const
  {
    uint32_t bits = 0;
    if (TASKS && k.cuts != nullptr)
      for (int i = 0; i < MT * SHARE; i++)
        bits |= (uint32_t)(step >= special_of(pair_row(i)).cut_step) << i;
    return bits;
  }
  /* Bit i: this lane's spring of the warp's chunk c + i is among those of broken rows that damage
   * cuts. n: the warp's chunks. */
  template <int N> __device__ __forceinline__ uint32_t cut_springs(int c, int n) const
  {
    const uint32_t *cuts = k.cuts + g.first_chunk + first_chunk + c;
    uint32_t bits = 0;
#pragma unroll
    for (int i = 0; i < N; i++)
      bits |= (c + i < n ? __ldg(cuts + i) >> lane & 1u : 0u) << i;
    return bits;
  }
  __device__ __forceinline__ void place_light(int row, const float3 &light) const
  {
    if (lane == 0) {
      rows[row].light[0] = light.x;
      rows[row].light[1] = light.y;
      rows[row].light[2] = light.z;
    }
    __syncwarp();
  }

  /* Returns whether this warp's only row is the pair's second. */
  __device__ __forceinline__ bool has_second() const
  {
    return SHARE > 1 && (warp & 1);
  }
  /* Return the range of this warp's masses within the pair. */
  __device__ __forceinline__ int begin() const
  {
    return has_second() ? n0 : 0;
  }
  __device__ __forceinline__ int end() const
  {
    return SHARE > 1 && !has_second() ? n0 : n0 + n1;
  }
  /* Returns the pair's first mass, within the group. */
  __device__ __forceinline__ int group_first() const
  {
    return SHARE > 1 ? half_begin + first : first;
  }

  /* Return the pair's k-th row, this warp's r-th row, and a row's place in the group. */
  __device__ __forceinline__ int pair_row(int k) const
  {
    return warp / SHARE + PAIRS * k;
  }
  __device__ __forceinline__ int own_row(int r) const
  {
    return pair_row(SHARE > 1 ? has_second() : r);
  }
  __device__ __forceinline__ int group_row(int row) const
  {
    return SHARE == 1 ? row : row % PAIRS + PAIRS * half + 16 * (row / PAIRS);
  }

  /* Return the number of masses in this warp's r-th row, and where they begin within the pair. */
  __device__ __forceinline__ int own_masses(int r) const
  {
    return SHARE > 1 ? end() - begin() : r == 0 ? n0 : n1;
  }
  __device__ __forceinline__ int own_begin(int r) const
  {
    return SHARE > 1 ? begin() : r == 0 ? 0 : n0;
  }
  /* Returns which of this warp's rows the pair's m-th mass belongs to. */
  __device__ __forceinline__ bool is_second(int m) const
  {
    return MT > 1 && m >= n0;
  }
  /* Returns this lane's first mass among the warp's: a lane has the same masses of a row, whether
   * its warp has one row or two. */
  __device__ __forceinline__ int lane_begin() const
  {
    return SHARE == 1 ? lane : begin() + ((lane - begin()) & 31);
  }

  __device__ __forceinline__ lane_physics physics_of(int row) const
  {
    return lane_physics_alike(k.dt, k.bisections, &rows[row].constants);
  }
  /* The constants of `split` for a row, which are read rarely, from global memory. */
  __device__ __forceinline__ const mo_plan_split &plan_split_of(int row) const
  {
    return k.rows[first_row + group_row(row)].split;
  }
  __device__ __forceinline__ lane_split split_of(int row, uint32_t step) const
  {
    const mo_plan_split &of = plan_split_of(row);
    lane_split split = lane_split_alike(&of.constants);
    if (step == 0)
      split.per_push = of.first_per_push;
    return split;
  }
  /* Sets the springs' pull in all rows: that of the first step or of the others. */
  __device__ __forceinline__ void use_pull(bool is_first) const
  {
    __syncthreads();
    for (int row = threadIdx.x; row < ROWS; row += MO_GK_THREADS)
      rows[row].constants.pull = is_first ? plan_split_of(row).first_pull
                                          : k.rows[first_row + group_row(row)].scene.constants.pull;
    __syncthreads();
  }

  /* The constants of the row that one of the pair's springs belongs to. */
  __device__ __forceinline__ const lane_constants &constants_of(uint32_t spring) const
  {
    return rows[pair_row(MO_GP_SPRING_ROW(spring))].constants;
  }

  __device__ __forceinline__ void pair_sync() const
  {
    __syncwarp(); /* the barrier requires warps with converged lanes */
    if (SHARE > 1)
      asm volatile("bar.sync %0, %1;" ::"r"(1 + warp / SHARE), "n"(32 * SHARE) : "memory");
  }

  __device__ __forceinline__ void load_rows() const
  {
    enum { WORDS = sizeof(mo_plan_scene) / 4 };
    for (int i = threadIdx.x; i < ROWS * WORDS; i += MO_GK_THREADS)
      ((float *)rows)[i] =
          ((const float *)&k.rows[g.first_row + group_row(i / WORDS)].scene)[i % WORDS];
  }
};

/* Groups of 16 rows: rare, with their own use of registers. */
template <template <int, int, int> class Way, int TIME>
static __device__ __noinline__ void walk_small(const mo_gk &k, const mo_gp_group &g,
                                               unsigned char *shared, const mo_gk_task &task)
{
  Way<1, 1, TIME>(k, g, shared, task).run();
}

/* WALKED: how groups of 32 rows are computed. */
template <template <int, int, int> class Way, int WALKED, int TIME>
static __global__ void __launch_bounds__(MO_GK_THREADS, 1)
    way_kernel(const __grid_constant__ mo_gk k)
{
  extern __shared__ __align__(16) unsigned char shared[];
  mo_gk_task task;
  if (!take_task(k, (uint32_t *)shared, &task))
    return;
  const mo_gp_group &g = k.groups[(task.walk & ~MO_GK_HALVED) >> 1];
  if (WALKED == MO_GK_MIXED && (task.walk & MO_GK_HALVED) != 0)
    Way<1, 2, TIME>(k, g, shared, task).run();
  else if (g.n_rows == MO_GP_ROWS_MAX)
    Way<WALKED == MO_GK_HALVES ? 1 : 2, WALKED == MO_GK_HALVES ? 2 : 1, TIME>(k, g, shared, task)
        .run();
  else
    walk_small<Way, TIME>(k, g, shared, task);
  end_task(k, task);
}

/* The kernels of one direction, by MO_GK_EVERY … and MO_GK_WHOLE …; those for special rows compute
 * groups in both ways: one for whole groups only would not be faster. */
template <template <int, int, int> class Way> struct way_kernels {
  static constexpr void (*kernels[3][3])(const mo_gk) = {
      {way_kernel<Way, MO_GK_WHOLE, MO_GK_EVERY>, way_kernel<Way, MO_GK_HALVES, MO_GK_EVERY>,
       way_kernel<Way, MO_GK_MIXED, MO_GK_EVERY>},
      {way_kernel<Way, MO_GK_WHOLE, MO_GK_PERIODS>, way_kernel<Way, MO_GK_HALVES, MO_GK_PERIODS>,
       way_kernel<Way, MO_GK_MIXED, MO_GK_PERIODS>},
      {way_kernel<Way, MO_GK_WHOLE, MO_GK_SPLIT>, way_kernel<Way, MO_GK_HALVES, MO_GK_SPLIT>,
       way_kernel<Way, MO_GK_MIXED, MO_GK_SPLIT>}};
  static constexpr void (*special[2])(const mo_gk) = {
      way_kernel<Way, MO_GK_MIXED, MO_GK_PERIODS_TASKS>,
      way_kernel<Way, MO_GK_MIXED, MO_GK_SPLIT_TASKS>};

  /* Finds how much shared memory each of them can use. */
  static int open(uint32_t block_bytes, uint32_t *dynamic_bytes)
  {
    int status = 0;
    *dynamic_bytes = block_bytes;
    for (size_t i = 0; i < 11 && status == 0; i++) {
      uint32_t bytes = 0;
      status = allow_shared(i < 9 ? kernels[i / 3][i % 3] : special[i - 9], block_bytes, &bytes);
      *dynamic_bytes = min(*dynamic_bytes, bytes);
    }
    return status;
  }

  static int launch(const mo_gk *k, uint32_t shared_bytes, void *stream)
  {
    const uint32_t blocks = (k->n_steps + k->part_steps - 1) / k->part_steps * k->n_walks;
    const int time = k->splits ? MO_GK_SPLIT : k->control_steps > 1 ? MO_GK_PERIODS : MO_GK_EVERY;
    const auto kernel = k->courses != nullptr ? special[k->splits] : kernels[time][k->walked];
    kernel<<<blocks, MO_GK_THREADS, shared_bytes, (cudaStream_t)stream>>>(*k);
    return (int)cudaGetLastError();
  }
};

/* Gains and shifts for a lane's four columns of a normalized layer: columns 2 j, 2 j + 1 in [j]. */
struct norm_columns {
  float2 gain[2], shift[2];
  __device__ __forceinline__ void load(const mo_gk_weights &w, int layer, int column)
  {
    const float4 g = __ldg((const float4 *)(w.gain[layer] + column)),
                 s = __ldg((const float4 *)(w.shift[layer] + column));
    gain[0] = make_float2(g.x, g.y);
    gain[1] = make_float2(g.z, g.w);
    shift[0] = make_float2(s.x, s.y);
    shift[1] = make_float2(s.z, s.w);
  }
};

/* Computes two sums over each row's 256 columns, from each lane's share of them: part is (rows,
 * MO_GK_PART) in shared memory. Synchronizes the block. */
template <int MT>
static __device__ __forceinline__ void sum_rows(float2 *part, int warp, int lane,
                                                float2 (&s)[MT][2])
{
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++) {
      float2 x = s[m][h];
      x.x += __shfl_xor_sync(0xffffffffu, x.x, 1);
      x.y += __shfl_xor_sync(0xffffffffu, x.y, 1);
      x.x += __shfl_xor_sync(0xffffffffu, x.x, 2);
      x.y += __shfl_xor_sync(0xffffffffu, x.y, 2);
      if ((lane & 3) == 0)
        part[(m * 16 + h * 8 + (lane >> 2)) * MO_GK_PART + warp] = x;
    }
  __syncthreads();
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++) {
      /* The row's four lanes add a quarter of the warps' parts each. */
      const float4 *row =
          (const float4 *)(part + (m * 16 + h * 8 + (lane >> 2)) * MO_GK_PART) + 2 * (lane & 3);
      const float4 one = row[0], two = row[1];
      float2 x = make_float2((one.x + one.z) + (two.x + two.z), (one.y + one.w) + (two.y + two.w));
      x.x += __shfl_xor_sync(0xffffffffu, x.x, 1);
      x.y += __shfl_xor_sync(0xffffffffu, x.y, 1);
      x.x += __shfl_xor_sync(0xffffffffu, x.x, 2);
      x.y += __shfl_xor_sync(0xffffffffu, x.y, 2);
      s[m][h] = x;
    }
}

#endif

/* ---- launches; all return a cudaError_t as int ---- */

#ifdef __cplusplus
extern "C" {
#endif
/* Call once for the current device, before the first launch. block_bytes: the shared memory of a
 * block there. dynamic_bytes: the part of it that a launch can request. */
int mo_gk_open_forward(uint32_t block_bytes, uint32_t *dynamic_bytes);
int mo_gk_open_back(uint32_t block_bytes, uint32_t *dynamic_bytes);
int mo_gk_open_products(uint32_t block_bytes, uint32_t *dynamic_bytes);
int mo_gk_pack(const float *parameters, const struct mo_gk_weights *weights, void *stream);
int mo_gk_forward(const struct mo_gk *k, uint32_t shared_bytes, void *stream);
int mo_gk_back(const struct mo_gk *k, uint32_t shared_bytes, void *stream);
/* jobs: (n) group, kind and block of each product; adds the network's passes first … end − 1. */
int mo_gk_products(const struct mo_gk *k, const uint32_t *jobs, uint32_t n, uint32_t first,
                   uint32_t end, void *stream);
/* shard_groups: (n_shards + 1) first group of each shard. d_parameters: (n_shards, n_parameters).
 */
int mo_gk_collect(const struct mo_gk *k, const uint32_t *shard_groups, uint32_t n_shards,
                  double weight, float *d_parameters, void *stream);
#ifdef __cplusplus
}
#endif

#define MO_GK_JOB(group, kind, block)                                                              \
  ((uint32_t)(group) << 8 | (uint32_t)(kind) << 4 | (uint32_t)(block))
enum {
  MO_GK_JOB_OUTPUT = 0,
  MO_GK_JOB_HIDDEN_2 = 1,
  MO_GK_JOB_HIDDEN_1 = 2,
  MO_GK_JOB_INPUT = 3,
  MO_GK_JOB_COLUMNS = 128
};

#endif
