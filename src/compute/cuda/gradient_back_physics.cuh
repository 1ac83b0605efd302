/* gradient_back_physics.cuh: a group in the backward pass: where its numbers are, and a step back
 * through contact, springs and sensors, for the warp with the two bodies. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_BACK_PHYSICS_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_BACK_PHYSICS_CUH

#include "compute/cuda/gradient_guide.cuh"

/* The results of a launch for a row. */
struct back_row {
  double scale_squared, largest; /* also squares: largest of the adjoints' norms times scale_m */
  uint32_t steps, clipped;
  int zeroed, padding;
};

/* The data that a spring needs from the mass at its other end. */
struct back_mass {
  float2 xy, z_gx, gyz; /* position; ∂loss/∂ velocity */
};

/* Loads data that is read once: it bypasses the first-level cache, which is left to other data. */
static __device__ __forceinline__ uint32_t load_once(const uint32_t *p)
{
  uint32_t x;
  asm volatile("ld.global.L1::no_allocate.u32 %0, [%1];" : "=r"(x) : "l"(p));
  return x;
}
/* Loads a number that this thread may have stored before; 0 without a load if `there` is false. */
static __device__ __forceinline__ float load_if(bool there, const float *p)
{
  float x;
  asm volatile("{ .reg .pred p; setp.ne.u32 p, %1, 0; mov.f32 %0, 0f00000000; "
               "@p ld.global.L1::no_allocate.f32 %0, [%2]; }"
               : "=f"(x)
               : "r"((uint32_t)there), "l"(p)
               : "memory");
  return x;
}
static __device__ __forceinline__ int16_t load_once(const int16_t *p)
{
  int16_t x;
  asm volatile("ld.global.L1::no_allocate.s16 %0, [%1];" : "=h"(x) : "l"(p));
  return x;
}

static __device__ __forceinline__ void store(float *p, float x)
{
  asm volatile("st.global.f32 [%0], %1;" ::"l"(p), "f"(x) : "memory");
}

/* Keeps a number in a register, which the compiler would otherwise compute again each time. */
static __device__ __forceinline__ uint32_t kept_value(uint32_t x)
{
  asm volatile("" : "+r"(x));
  return x;
}

static __device__ __forceinline__ back_mass load_mass(uint32_t from, uint32_t m)
{
  back_mass b;
  const uint32_t at = from + m * (uint32_t)sizeof(back_mass);
  asm volatile("ld.shared.v2.f32 {%0, %1}, [%2];" : "=f"(b.xy.x), "=f"(b.xy.y) : "r"(at));
  asm volatile("ld.shared.v2.f32 {%0, %1}, [%2 + 8];" : "=f"(b.z_gx.x), "=f"(b.z_gx.y) : "r"(at));
  asm volatile("ld.shared.v2.f32 {%0, %1}, [%2 + 16];" : "=f"(b.gyz.x), "=f"(b.gyz.y) : "r"(at));
  return b;
}

static __device__ __forceinline__ void add_shared(uint32_t at, float x)
{
  float sum;
  asm volatile("ld.shared.f32 %0, [%1];" : "=f"(sum) : "r"(at));
  asm volatile("st.shared.f32 [%0], %1;" ::"r"(at), "f"(sum + x) : "memory");
}

/* Stores a number as bfloat16. */
static __device__ __forceinline__ void store_if_less(uint32_t a, uint32_t b, uint32_t to, float x)
{
  asm volatile("{ .reg .pred p; .reg .b16 h; setp.lt.u32 p, %0, %1; cvt.rn.bf16.f32 h, %3; @p "
               "st.shared.b16 [%2], h; }" ::"r"(a),
               "r"(b), "r"(to), "f"(x)
               : "memory");
}

/* A lane's part of ∂loss/∂ the lights of its warp's rows: the opposite of what the masses get. */
template <bool TASKS> struct light_sums {
  float of[2][3] = {{0, 0, 0}, {0, 0, 0}};
  __device__ __forceinline__ void add(bool second, float push, const float (&away)[3])
  {
    for (int axis = 0; axis < 3; axis++) {
      of[0][axis] -= second ? 0.0f : push * away[axis];
      of[1][axis] -= second ? push * away[axis] : 0.0f;
    }
  }
};
template <> struct light_sums<false> {
  __device__ __forceinline__ void add(bool, float, const float (&)[3])
  {
  }
};

template <int MT, int SHARE, int TIME> struct back_physics : walker<MT, SHARE, TIME> {
  using own = walker<MT, SHARE, TIME>;
  using own::activation_at, own::begin, own::begins_period, own::blends, own::broken, own::chunk_at,
      own::constants_of, own::d_activation_at, own::end, own::ends_period, own::first,
      own::first_row, own::g, own::group_first, own::group_row, own::guided, own::is_second, own::k,
      own::terrain_of, own::lane, own::lane_begin, own::list, own::n0, own::n1, own::n_chunks,
      own::n_masses, own::n_outputs, own::n_own, own::own_begin, own::own_chunks, own::own_masses,
      own::own_row, own::pair_row, own::pair_sync, own::pass_of, own::PERIODIC, own::physics_of,
      own::place_light, own::position_at, own::push_at, own::ROWS, own::rows, own::SPLIT,
      own::split_of, own::strikes_in, own::tape, own::TASKS, own::velocity_at, own::warp,
      own::width;
  enum { HELD = 4 };
  /* The first of a lane's masses, being loaded from the tape. */
  struct held {
    float v[HELD][3];
  };
  const uint8_t *input;
  back_mass *mass; /* (n_own) */
  float *gx;       /* (n_own, 3) ∂loss/∂ positions */
  __nv_bfloat16 *outputs, *left;
  int *failed; /* (rows) */
  bool excluded[2];
  uint32_t struck;  /* bit i: this lane's i-th mass strikes in this step; with SPLIT */
  back_row *result; /* (rows) */

  __device__ __forceinline__ back_physics(const mo_gk &args, const mo_gp_group &group,
                                          unsigned char *shared, const mo_gk_task &task)
      : own(args, group, shared, task, (args.n_steps - 1) / args.part_steps - task.part)
  {
    input = k.input + g.first_mass + group_first();
    outputs = (__nv_bfloat16 *)own::output_memory;
    left = (__nv_bfloat16 *)own::left_memory;
    failed = (int *)own::behind;
    result = (back_row *)(failed + ROWS);
    mass = (back_mass *)(result + ROWS);
    gx = (float *)(mass + n_own);
  }

  /* Values derived from these are recomputed where they are needed: the compiler would compute them
   * before the first step, and run out of registers. */
  __device__ __forceinline__ void forget()
  {
    asm volatile(""
                 : "+r"(warp), "+r"(lane), "+r"(n_masses), "+r"(n_chunks), "+r"(first), "+r"(n0),
                   "+r"(n1), "+r"(n_outputs));
  }

  /* Returns the i-th mass that was put aside, stored in the rows of the network's last adjoint that
   * only this warp reads. */
  __device__ __forceinline__ uint16_t *aside(int i)
  {
    return (uint16_t *)left + own_row(i >> 8) * MO_GK_ROW + (i & 255);
  }

  static __device__ __forceinline__ void copy_ahead(uint32_t to, const float *from)
  {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(to), "l"(from) : "memory");
  }
  static __device__ __forceinline__ void wait_copies()
  {
    asm volatile("cp.async.wait_all;" ::: "memory");
  }

  /* Computes ∂loss/∂ the final state of row r, times `weight`. */
  __device__ __forceinline__ void aim(int r, mo_away end, double weight)
  {
    const int n = own_masses(r), from = first + own_begin(r);
    const mo_seed seed = mo_goal_seed(&k.rows[first_row + group_row(own_row(r))].goal, end);
    const double scale =
        seed.length > 0 && !excluded[r] && n > 0 ? weight / (seed.length * seed.scale * n) : 0.0;
#pragma unroll 1
    for (int m = lane; m < n; m += 32) {
      float *p = gx + 3 * (from + m);
      p[0] = (float)(seed.toward.x * scale);
      p[1] = (float)(seed.toward.y * scale);
      p[2] = 0;
      mass[from + m].z_gx.y = 0;
      mass[from + m].gyz = make_float2(0, 0);
    }
  }

  /* The same for a row with a task: d_com is ∂loss/∂ its center of mass. */
  __device__ __forceinline__ void aim_at(int r, const double3 &d_com)
  {
    const int n = own_masses(r), from = first + own_begin(r);
#pragma unroll 1
    for (int m = lane; m < n; m += 32) {
      float *p = gx + 3 * (from + m);
      p[0] = (float)(d_com.x / n);
      p[1] = (float)(d_com.y / n);
      p[2] = (float)(d_com.z / n);
      mass[from + m].z_gx.y = 0;
      mass[from + m].gyz = make_float2(0, 0);
    }
  }

  __device__ __forceinline__ void start()
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int row = group_row(own_row(r));
      if constexpr (TASKS) {
        const guided_row end = guided(own_row(r), pass_of(k.n_steps - 1) + 1);
        if (end.task != nullptr) {
          if (excluded[r] && lane == 0)
            end.ending->adjoint.d_work = 0;
          aim_at(r, excluded[r] ? make_double3(0, 0, 0) : guide_end_back(end));
          continue;
        }
      }
      aim(r, mo_away_of(k.rows[first_row + row].light_m, k.results[first_row + row].com_end), 1.0);
    }
  }

  /* Restarts row r's adjoint, with the masses at their positions before the step. This is rare, and
   * optimized for size rather than speed. */
  __device__ __forceinline__ void restart(int r)
  {
    const int n = own_masses(r), from = first + own_begin(r);
    const mo_plan_scene &of = rows[own_row(r)];
    double dx = 0, dy = 0;
#pragma unroll 1
    for (int m = lane; m < n; m += 32) {
      const float2 xy = mass[from + m].xy;
      dx += (double)xy.x - (double)of.light[0];
      dy += (double)xy.y - (double)of.light[1];
    }
#pragma unroll 1
    for (int far = 16; far > 0; far >>= 1) {
      dx += __shfl_xor_sync(0xffffffffu, dx, far);
      dy += __shfl_xor_sync(0xffffffffu, dy, far);
    }
    aim(r, mo_away{dx / n, dy / n}, k.restart_weight);
  }

  /* The same for row r with a task, of which `row` is the start of the step's control period. */
  __device__ __forceinline__ void restart_task(int r, uint32_t step, const guided_row &row)
  {
    const int n = own_masses(r), from = first + own_begin(r);
    double x = 0, y = 0;
#pragma unroll 1
    for (int m = lane; m < n; m += 32) {
      const float2 xy = mass[from + m].xy;
      x += (double)xy.x;
      y += (double)xy.y;
    }
    const double2 com =
        make_double2(sum_lanes(x) / n + MO_WORLD_CENTER_M, sum_lanes(y) / n + MO_WORLD_CENTER_M);
    aim_at(r, guide_restart(row, (step - step % k.control_steps) * k.dt_s, com, k.restart_weight));
  }

  /* Starts to load the positions of this warp's masses before `step`, and the velocities of each
   * lane's first masses, while other work continues. */
  __device__ __forceinline__ void hold(uint32_t step, held &h)
  {
    const float *position =
        (const float *)(tape + position_at) + (size_t)step * 3 * n_masses + group_first();
    const float *velocity =
        (const float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + group_first();
#pragma unroll
    for (int i = 0; i < HELD; i++) {
      const int m = lane_begin() + 32 * i;
#pragma unroll
      for (int axis = 0; axis < 3; axis++)
        h.v[i][axis] = m < end() ? __ldg(velocity + axis * n_masses + m) : 0.0f;
    }
#pragma unroll 1
    for (int m = lane_begin(); m < end(); m += 32) {
      const uint32_t to = shared_address(&mass[first + m]);
      copy_ahead(to, position + m);
      copy_ahead(to + 4, position + n_masses + m);
      copy_ahead(to + 8, position + 2 * n_masses + m);
    }
  }

  /* Measures the adjoints of the states of this warp's rows, and returns the factors to scale them,
   * or bits for the adjoints that must restart. It compares squares. */
  __device__ __forceinline__ uint32_t limit(float (&scale)[2])
  {
    uint32_t restarts = 0;
    double sum_x[2] = {0, 0}, sum_v[2] = {0, 0};
#pragma unroll 1
    for (int m = lane_begin(); m < end(); m += 32) {
      const float *a = gx + 3 * (first + m);
      const float2 yz = mass[first + m].gyz;
      const double x = a[0], y = a[1], z = a[2], u = mass[first + m].z_gx.y, v = yz.x, w = yz.y;
      const double of_x = fma(x, x, fma(y, y, z * z)), of_v = fma(u, u, fma(v, v, w * w));
      if (is_second(m)) {
        sum_x[1] += of_x;
        sum_v[1] += of_v;
      } else {
        sum_x[0] += of_x;
        sum_v[0] += of_v;
      }
    }
#pragma unroll
    for (int far = 16; far > 0; far >>= 1)
#pragma unroll
      for (int r = 0; r < MT; r++) {
        sum_x[r] += __shfl_xor_sync(0xffffffffu, sum_x[r], far);
        sum_v[r] += __shfl_xor_sync(0xffffffffu, sum_v[r], far);
      }
    scale[0] = scale[1] = 0;
#pragma unroll
    for (int r = 0; r < MT; r++) {
      if (excluded[r] || own_masses(r) == 0)
        continue;
      back_row &of = result[own_row(r)]; /* all lanes would write the same values, so only the first
                                          * does */
      const double square = of.scale_squared * fmax(sum_x[r], MO_ADJOINT_RATE_PER_S *
                                                                  MO_ADJOINT_RATE_PER_S * sum_v[r]);
      const bool bad = !(sum_x[r] < 1e300) || !(sum_v[r] < 1e300) || failed[own_row(r)];
      const bool scaled = !bad && k.bound > 0 && square > k.bound * k.bound;
      __syncwarp();
      if (lane == 0) {
        of.steps++;
        of.clipped += scaled;
        if (bad)
          of.zeroed = 1;
        else
          of.largest = fmax(of.largest, square);
      }
      if (bad) {
        excluded[r] = true;
        continue;
      }
      scale[r] = scaled && !k.restarts ? (float)(k.bound / sqrt(square)) : 1.0f;
      restarts |= scaled && k.restarts ? 1u << r : 0u;
    }
    return restarts;
  }

  /* Processes masses that strike the ground, one per lane. */
  __device__ __forceinline__ void strikes_back(uint32_t step, int n, const float (&scale)[2])
  {
    const float *velocity =
        (const float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + group_first();
#pragma unroll 1
    for (int i = lane; i < n; i += 32) {
      const int m = *aside(i);
      const float v[3] = {__ldg(velocity + m), __ldg(velocity + n_masses + m),
                          __ldg(velocity + 2 * n_masses + m)};
      const bool second = is_second(m);
      const mo_plan_scene &of = rows[own_row(second)];
      const float s = second ? scale[1] : scale[0];
      back_mass &to = mass[first + m];
      float *d = gx + 3 * (first + m);
      const float p[3] = {to.xy.x, to.xy.y, to.z_gx.x};
      float dp[3] = {s * d[0], s * d[1], s * d[2]},
            dv[3] = {s * to.z_gx.y, s * to.gyz.x, s * to.gyz.y};
      const lane_physics physics = physics_of(own_row(second));
      const lane_terrain terrain = terrain_of(own_row(second));
      if (SPLIT) {
        float *pushes = (float *)(tape + push_at) + (size_t)step * 3 * n_masses + group_first() + m;
        const float push[3] = {load_if(true, pushes), load_if(true, pushes + n_masses),
                               load_if(true, pushes + 2 * n_masses)};
        const lane_split split = split_of(own_row(second), step);
        float da[3];
        lane_move_split_back(&physics, &split, terrain, push, p, v, dp, dv, da);
        for (int axis = 0; axis < 3; axis++) {
          const float d_push = lane_push_back(&split, 0.0f, da[axis]);
          store(pushes + axis * n_masses, d_push);
          dv[axis] += d_push;
        }
      } else {
        lane_move_back(&physics, terrain, of.highest, p, v, dp, dv);
      }
      for (int axis = 0; axis < 3; axis++)
        d[axis] = dp[axis];
      to.z_gx.y = dv[0];
      to.gyz = make_float2(dv[1], dv[2]);
    }
  }

  /* Processes a mass that does not strike the ground. Puts aside a mass that does, because such
   * masses are few and take long. */
  __device__ __forceinline__ void move_one(int m, const float *v, const float (&scale)[2],
                                           int &n_aside)
  {
    bool strikes = false;
    if (m < end()) {
      const bool second = is_second(m);
      const float s = second ? scale[1] : scale[0];
      float *d = gx + 3 * (first + m);
      back_mass &to = mass[first + m];
      const float p[3] = {to.xy.x, to.xy.y, to.z_gx.x};
      const lane_physics physics = physics_of(own_row(second));
      float next[3];
      strikes = s > 0 && strikes_in(own_row(second), physics, p, v, next);
      if (!strikes) {
        float dp[3] = {0, 0, 0}, dv[3] = {0, 0, 0};
        if (s > 0) {
          const float2 yz = to.gyz;
          const float before[3] = {s * to.z_gx.y, s * yz.x, s * yz.y};
          for (int axis = 0; axis < 3; axis++) {
            dp[axis] = s * d[axis];
            dv[axis] = lane_drift_back(&physics, dp[axis], before[axis]);
          }
        }
        for (int axis = 0; axis < 3; axis++)
          d[axis] = dp[axis];
        to.z_gx.y = dv[0];
        to.gyz = make_float2(dv[1], dv[2]);
      }
    }
    if (SPLIT)
      struck |= (uint32_t)strikes << (m - lane_begin()) / 32;
    const uint32_t which = __ballot_sync(0xffffffffu, strikes);
    if (strikes)
      *aside(n_aside + __popc(which & ((1u << lane) - 1))) = (uint16_t)m;
    n_aside += __popc(which);
  }

  __device__ __forceinline__ void move_back(uint32_t step, const held &h)
  {
    float scale[2];
    int n_aside = 0;
    struck = 0;
    const uint32_t restarts = limit(scale);
    wait_copies();
    __syncwarp();
    if (restarts != 0) {
#pragma unroll
      for (int r = 0; r < MT; r++)
        if (restarts >> r & 1) {
          if constexpr (TASKS) {
            const guided_row row = guided(own_row(r), pass_of(step));
            if (row.task != nullptr) {
              restart_task(r, step, row);
              continue;
            }
          }
          restart(r);
        }
      __syncwarp();
    }
#pragma unroll
    for (int i = 0; i < HELD; i++)
      move_one(lane_begin() + 32 * i, h.v[i], scale, n_aside);
#pragma unroll 1
    for (int far = 32 * HELD; begin() + far < end(); far += 32) {
      const int m = lane_begin() + far;
      const float *velocity =
          (const float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + group_first() + m;
      float v[3];
      for (int axis = 0; axis < 3; axis++)
        v[axis] = m < end() ? __ldg(velocity + axis * n_masses) : 0.0f;
      move_one(m, v, scale, n_aside);
    }
    __syncwarp();
    strikes_back(step, n_aside, scale);
    pair_sync(); /* springs belong to both rows */
  }

  /* Whether the sums of ∂loss/∂activation have something from later steps. */
  __device__ __forceinline__ bool has_later(uint32_t step, bool works) const
  {
    return SPLIT || works ? step + 1 < k.n_steps : !ends_period(step);
  }

  /* As in the forward pass. One of a spring's ends writes ∂loss/∂(the spring's output), in the step
   * that computed it; both have added the contributions of later steps that hold it. works: tasks
   * of the pair need the work, which has contributed at the starts of periods. */
  __device__ __forceinline__ void springs_back(uint32_t step, bool works)
  {
    enum { N = MO_GK_SPRINGS_AHEAD_BACK };
    const int16_t *kept =
        (const int16_t *)(tape + activation_at) + (size_t)pass_of(step) * n_chunks * 32 + chunk_at;
    float *const sums = (float *)(tape + d_activation_at) + chunk_at;
    const bool begins = begins_period(step), blend = blends(step),
               adds = has_later(step, works) || (works && begins && step > 0);
    const int n = own_chunks;
    if (n == 0)
      return;
    const uint32_t own_mass = kept_value(shared_address(mass + first)),
                   own_gx = kept_value(shared_address(gx + 3 * first));
    const uint32_t to = kept_value(shared_address(outputs + pair_row(0) * width)),
                   to_second = kept_value((pair_row(1) - pair_row(0)) * width * 2);
    const uint32_t is_broken = broken(step);
    uint32_t bad = 0, cut = 0;
    uint32_t now[N], then[N];
    int16_t kept_now[N], kept_then[N];
#pragma unroll
    for (int i = 0; i < N; i++) {
      now[i] = load_once(list + 32 * i);
      kept_now[i] = load_once(kept + 32 * i);
    }
    uint32_t s = now[0], at = MO_GP_SPRING_OWN(s);
    back_mass other = load_mass(own_mass, MO_GP_SPRING_OTHER(s)),
              here = load_mass(own_mass, at == MO_GP_NO_MASS ? 0 : at);
    float pull = constants_of(s).pull, actuation = constants_of(s).actuation, sum[3] = {0, 0, 0};
    for (int c = 0;; c += N) {
      const uint32_t *far = list + 32 * (c + N);
      const int16_t *kept_far = kept + 32 * (c + N);
#pragma unroll
      for (int i = 0; i < N; i++) {
        then[i] = load_once(far + 32 * i);
        kept_then[i] = load_once(kept_far + 32 * i);
      }
      if (TASKS && is_broken != 0)
        cut = own::template cut_springs<N>(c, n);
      float later[N]; /* ∂loss/∂activation in the period's later steps */
#pragma unroll
      for (int i = 0; i < N; i++)
        later[i] = PERIODIC ? load_if(adds, sums + 32 * (c + i)) : 0.0f;
      int16_t old[N]; /* activations of the previous control period */
      if (SPLIT && blend) {
#pragma unroll
        for (int i = 0; i < N; i++)
          old[i] = load_once(kept + 32 * (c + i) - n_chunks * 32);
      }
      __syncwarp(); /* here, not where they are needed */
#pragma unroll
      for (int i = 0; i < N; i++) {
        const uint32_t next = c + i + 1 < n ? (i + 1 < N ? now[(i + 1) % N] : then[0]) : s;
        const back_mass next_other = load_mass(own_mass, MO_GP_SPRING_OTHER(next));
        const float a = activation_of(kept_now[i]);
        const float pulls = SPLIT && blend ? 0.5f * (a + activation_of(old[i])) : a;
        const float d[3] = {here.xy.x - other.xy.x, here.xy.y - other.xy.y,
                            here.z_gx.x - other.z_gx.x};
        const float across[3] = {other.z_gx.y - here.z_gx.y, other.gyz.x - here.gyz.x,
                                 other.gyz.y - here.gyz.y};
        const struct lane_length length = lane_length_of(lane_squared(d));
        float dd[3];
        float d_wanted =
            -lane_spring_back(pull, &length, wanted_length(actuation, s, pulls), d, across, dd);
        if (TASKS && (cut >> i & is_broken >> MO_GP_SPRING_ROW(s) & 1u) != 0)
          d_wanted = dd[0] = dd[1] = dd[2] = 0.0f;
        float d_activation = d_wanted * (lane_rest(MO_GP_SPRING_DIAGONAL(s)) * actuation);
        if (SPLIT && blend) { /* half belongs to the previous period */
          d_activation *= 0.5f;
          store(sums + 32 * (c + i), d_activation);
          d_activation += later[i];
        } else if (PERIODIC) {
          d_activation += later[i];
          if (!begins)
            store(sums + 32 * (c + i), d_activation);
        }
        const float d_sum = d_activation * fmaf(-a, a, 1.0f);
        for (int axis = 0; axis < 3; axis++)
          sum[axis] += dd[axis];
        const uint32_t row = MO_GP_SPRING_ROW(s);
        if (!(fabsf(d_sum) <= MO_GK_LARGE))
          bad |= 1 + row;
        if (begins)
          store_if_less(at, MO_GP_SPRING_OTHER(s),
                        to + 2 * MO_GP_SPRING_OUTPUT(s) + row * to_second, d_sum);
        if (s & MO_GP_SPRING_LAST) {
          if (at != MO_GP_NO_MASS)
            for (int axis = 0; axis < 3; axis++)
              add_shared(own_gx + 12 * at + 4 * axis, sum[axis]);
          at = MO_GP_SPRING_OWN(next);
          here = load_mass(own_mass, at == MO_GP_NO_MASS ? 0 : at);
          pull = constants_of(next).pull;
          actuation = constants_of(next).actuation;
          sum[0] = sum[1] = sum[2] = 0;
        }
        if (c + i + 1 == n) {
          if (bad & 1)
            atomicOr(failed + pair_row(0), 1);
          if (bad & 2)
            atomicOr(failed + pair_row(1), 1);
          __syncwarp();
          return;
        }
        s = next;
        other = next_other;
      }
#pragma unroll
      for (int i = 0; i < N; i++) {
        now[i] = then[i];
        kept_now[i] = kept_then[i];
      }
    }
  }

  /* Places the lights where they were in the step. */
  __device__ __forceinline__ void relight(uint32_t step)
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const guided_row row = guided(own_row(r), pass_of(step));
      if (row.task != nullptr && !excluded[r])
        place_light(own_row(r), guided_light(row, step * k.dt_s));
    }
  }

  /* Adds the part of the adjoints through the lights and the objectives at the start of a control
   * period. d_light: this lane's part of ∂loss/∂ the lights. */
  __device__ __forceinline__ void guides_back(uint32_t step, const light_sums<true> &d_light)
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int n = own_masses(r), from = first + own_begin(r);
      const float sum[3] = {sum_lanes(d_light.of[r][0]), sum_lanes(d_light.of[r][1]),
                            sum_lanes(d_light.of[r][2])};
      const guided_row row = guided(own_row(r), pass_of(step));
      if (row.task == nullptr || excluded[r])
        continue;
      const double3 d_com =
          guide_back(row, step * k.dt_s, step == 0,
                     make_double3((double)sum[0], (double)sum[1], (double)sum[2]));
      const float share[3] = {(float)(d_com.x / n), (float)(d_com.y / n), (float)(d_com.z / n)};
#pragma unroll 1
      for (int m = lane; m < n; m += 32)
        for (int axis = 0; axis < 3; axis++)
          gx[3 * (from + m) + axis] += share[axis];
    }
  }

  /* ∂loss/∂(what a mass senses), minus its row's mean. inputs: the places of the first of this
   * lane's masses among the network's inputs. */
  __device__ __forceinline__ void sense_back(uint32_t step, uint32_t inputs)
  {
    if constexpr (TASKS)
      relight(step);
    float d[HELD], sum[2] = {0, 0};
    light_sums<TASKS> d_light;
    const auto sensed = [&](int m, uint32_t at) {
      return __bfloat162float(left[own_row(is_second(m)) * MO_GK_ROW + at]);
    };
#pragma unroll
    for (int i = 0; i < HELD; i++) {
      const int m = lane_begin() + 32 * i;
      d[i] = m < end() ? sensed(m, inputs >> 8 * i & 0xffu) : 0.0f;
      sum[0] += is_second(m) ? 0.0f : d[i];
      sum[1] += is_second(m) ? d[i] : 0.0f;
    }
#pragma unroll 1
    for (int m = lane_begin() + 32 * HELD; m < end(); m += 32) {
      const float more = sensed(m, __ldg(input + m));
      sum[0] += is_second(m) ? 0.0f : more;
      sum[1] += is_second(m) ? more : 0.0f;
    }
#pragma unroll
    for (int far = 16; far > 0; far >>= 1)
#pragma unroll
      for (int r = 0; r < MT; r++)
        sum[r] += __shfl_xor_sync(0xffffffffu, sum[r], far);
    const float mean[2] = {sum[0] / (float)max(own_masses(0), 1),
                           sum[1] / (float)max(own_masses(MT - 1), 1)};
#pragma unroll
    for (int i = 0; i < HELD; i++)
      if (lane_begin() + 32 * i < end())
        push_back(step, lane_begin() + 32 * i, d[i], mean, d_light);
#pragma unroll 1
    for (int m = lane_begin() + 32 * HELD; m < end(); m += 32)
      push_back(step, m, sensed(m, __ldg(input + m)), mean, d_light);
    __syncwarp();
    if constexpr (TASKS) {
      guides_back(step, d_light);
      __syncwarp();
    }
  }

  /* Takes the velocities' adjoints back through the kick, in a step without sensors. */
  __device__ __forceinline__ void kick_back(uint32_t step)
  {
    pair_sync(); /* the other warp's springs have read them */
#pragma unroll 1
    for (int m = lane_begin(); m < end(); m += 32)
      kick_one_back(step, m);
    __syncwarp();
  }

  /* Takes the adjoint of one velocity back through the kick. The acceleration does not depend on
   * the velocity before the kick, so with `split` the acceleration's part of the adjoint is
   * subtracted first if the mass strikes. */
  __device__ __forceinline__ void kick_one_back(uint32_t step, int m)
  {
    back_mass &to = mass[first + m];
    const float2 yz = to.gyz;
    float dv[3] = {to.z_gx.y, yz.x, yz.y};
    if (SPLIT) {
      const bool strikes = struck >> (m - lane_begin()) / 32 & 1;
      const float *pushes =
          (const float *)(tape + push_at) + (size_t)step * 3 * n_masses + group_first() + m;
      for (int axis = 0; axis < 3; axis++)
        dv[axis] -= load_if(strikes, pushes + axis * n_masses);
    }
    const lane_physics physics = physics_of(own_row(is_second(m)));
    to.z_gx.y = lane_kick_back(&physics, dv[0]);
    to.gyz = make_float2(lane_kick_back(&physics, dv[1]), lane_kick_back(&physics, dv[2]));
  }

  /* Adds the light's part to the mass's adjoint, then takes its velocity back through the kick. */
  __device__ __forceinline__ void push_back(uint32_t step, int m, float d, const float (&mean)[2],
                                            light_sums<TASKS> &d_light)
  {
    const bool second = is_second(m);
    const mo_plan_scene &of = rows[own_row(second)];
    back_mass &to = mass[first + m];
    float *d_place = gx + 3 * (first + m);
    const float away[3] = {to.xy.x - of.light[0], to.xy.y - of.light[1], to.z_gx.x - of.light[2]};
    const float push =
        (d - (second ? mean[1] : mean[0])) * lane_light_slope(k.sensor, lane_squared(away));
    for (int axis = 0; axis < 3; axis++)
      d_place[axis] = fmaf(push, away[axis], d_place[axis]);
    d_light.add(second, push, away);
    kick_one_back(step, m);
  }
};

#endif
