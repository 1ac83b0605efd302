/* gradient_forward.cu: rollouts of a plan's groups, a number of steps per launch, which keep on the
 * tape the data that the backward pass needs. */
#include "compute/cuda/gradient_work.cuh"

/* A warp's masses that strike the ground. They are few, and a strike takes long, so they are
 * collected until there are 32, one for each lane. */
struct strikes {
  uint16_t *mass; /* (64) in shared memory */
  int n;

  __device__ __forceinline__ void add(bool strikes, int m, int lane)
  {
    const uint32_t which = __ballot_sync(0xffffffffu, strikes);
    if (strikes)
      mass[n + __popc(which & ((1u << lane) - 1))] = (uint16_t)m;
    n += __popc(which);
    __syncwarp();
  }

  /* Moves the masses after the first 32 to the front. */
  __device__ __forceinline__ void done(int lane)
  {
    const uint16_t rest = mass[32 + lane];
    __syncwarp();
    mass[lane] = rest;
    n -= min(n, 32);
    __syncwarp();
  }
};

template <int MT, int SHARE, int TIME> struct forward : walker<MT, SHARE, TIME> {
  using own = walker<MT, SHARE, TIME>;
  using own::activation_at, own::begin, own::begins_period, own::blends, own::broken, own::chunk_at,
      own::constants_of, own::end, own::end_step, own::first, own::first_row, own::first_step,
      own::g, own::group_first, own::group_row, own::guided, own::half_begin, own::hidden_at,
      own::input_at, own::is_second, own::k, own::terrain_of, own::lane, own::layer_bytes,
      own::list, own::n_chunks, own::n_masses, own::n_outputs, own::n_own, own::normal_at,
      own::output_tile, own::own_begin, own::own_chunks, own::own_masses, own::own_row,
      own::pair_row, own::pair_sync, own::part, own::pass_of, own::physics_of, own::place_light,
      own::plan_split_of, own::position_at, own::push_at, own::rows, own::scale_at, own::SPLIT,
      own::split_of, own::strikes_in, own::tape, own::TAPE_ROWS, own::TASKS, own::use_pull,
      own::velocity_at, own::warp, own::width;
  int16_t *outputs;
  __half *left;   /* (rows, MO_GK_ROW) */
  float *norms;   /* (layers, 3, 256) biases, gains, shifts */
  float4 *x;      /* (n_own) */
  float *v;       /* (n_own, 3) as the springs read it, after drag and gravity */
  uint8_t *input; /* (n_own) each mass's index among the inputs */
  bool dead[2];   /* rows of this warp with a rollout that has ended */

  __device__ __forceinline__ forward(const mo_gk &args, const mo_gp_group &group,
                                     unsigned char *shared, const mo_gk_task &task)
      : own(args, group, shared, task, task.part)
  {
    if (threadIdx.x < MO_GP_OUTPUT_TILES)
      output_tile[threadIdx.x] = g.output_tile[threadIdx.x];
    outputs = (int16_t *)own::output_memory;
    left = (__half *)own::left_memory;
    norms = (float *)own::behind;
    for (int layer = 0; layer < MO_HIDDEN_LAYERS; layer++)
      for (int i = threadIdx.x; i < MO_HIDDEN; i += MO_GK_THREADS) {
        float *to = norms + 3 * MO_HIDDEN * layer + i;
        to[0] = k.weights.bias[layer][i];
        to[MO_HIDDEN] = k.weights.gain[layer][i];
        to[2 * MO_HIDDEN] = k.weights.shift[layer][i];
      }
    x = (float4 *)(norms + MO_HIDDEN_LAYERS * 3 * MO_HIDDEN);
    v = (float *)(x + n_own);
    input = (uint8_t *)(v + 3 * n_own);
    for (int i = threadIdx.x; i < n_own; i += MO_GK_THREADS)
      input[i] = k.input[g.first_mass + half_begin + i];
  }

  /* Returns the center of mass of a row, in world coordinates. */
  __device__ __forceinline__ double3 center(int r) const
  {
    const int n = own_masses(r), from = first + own_begin(r);
    double sum[3] = {0, 0, 0};
#pragma unroll 1
    for (int m = lane; m < n; m += 32) {
      const float4 p = x[from + m];
      sum[0] += (double)p.x;
      sum[1] += (double)p.y;
      sum[2] += (double)p.z;
    }
    return make_double3(sum_lanes(sum[0]) / n + MO_WORLD_CENTER_M,
                        sum_lanes(sum[1]) / n + MO_WORLD_CENTER_M, sum_lanes(sum[2]) / n);
  }

  /* Moves the lights at the start of a control period. */
  __device__ __forceinline__ void guide(uint32_t step)
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const guided_row row = guided(own_row(r), pass_of(step));
      if (row.task == nullptr || dead[r])
        continue;
      place_light(own_row(r),
                  step == 0 ? guide_first(row) : guide_next(row, step * k.dt_s, center(r)));
    }
  }

  /* Ends the tasks of the rows. */
  __device__ __forceinline__ void end_tasks()
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const guided_row row = guided(own_row(r), pass_of(k.n_steps - 1) + 1);
      if (row.task == nullptr)
        continue;
      if (!dead[r]) {
        guide_end(row, center(r));
      } else if (lane == 0) {
        row.ending->loss = INFINITY;
        row.ending->value = -INFINITY;
      }
    }
  }

  __device__ __forceinline__ void sense(uint32_t step)
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int row = own_row(r), n = own_masses(r), from = own_begin(r);
      __half *to = left + row * MO_GK_ROW;
      ((uint4 *)to)[lane] = make_uint4(0, 0, 0, 0);
      __syncwarp();
      if (n > 0 && !dead[r]) {
        const mo_plan_scene &of = rows[row];
        const float lx = of.light[0], ly = of.light[1], lz = of.light[2];
        float light[8], sum = 0;
#pragma unroll
        for (int j = 0; j < 8; j++) {
          light[j] = 0;
          const int m = lane + 32 * j;
          if (m < n) {
            const float4 p = x[first + from + m];
            const float d[3] = {p.x - lx, p.y - ly, p.z - lz};
            light[j] = lane_light(k.sensor, lane_squared(d));
          }
          sum += light[j];
        }
        const float mean = sum_lanes(sum) / (float)n;
#pragma unroll
        for (int j = 0; j < 8; j++) {
          const int m = lane + 32 * j;
          if (m < n)
            to[input[first + from + m]] = __float2half_rn(light[j] - mean);
        }
      }
      if (lane < MO_CPG_INPUTS)
        to[MO_DEFAULT_MASSES + lane] =
            __float2half_rn(__ldg(k.generators + step * MO_CPG_INPUTS + lane));
    }
  }

  /* Writes a layer's inputs to the tape at `to`: (rows, 256) bfloat16. A warp writes complete
   * rows. */
  __device__ __forceinline__ void keep_left(unsigned char *to) const
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int row = warp + 16 * r;
      const uint4 from = *(const uint4 *)(left + row * MO_GK_ROW + 8 * lane);
      const uint32_t words[4] = {from.x, from.y, from.z, from.w};
      __nv_bfloat162 kept[4];
#pragma unroll
      for (int i = 0; i < 4; i++)
        kept[i] = __float22bfloat162_rn(__half22float2(*(const __half2 *)&words[i]));
      const uint2 low = four(kept[0], kept[1]), high = four(kept[2], kept[3]);
      *(uint4 *)(to + group_row(row) * (MO_HIDDEN * 2) + 16 * lane) =
          make_uint4(low.x, low.y, high.x, high.y);
    }
  }

  __device__ __forceinline__ void norm_relu(int layer, uint32_t pass, warp_sums<MT> &sums)
  {
    const int column = warp * 16 + 4 * (lane & 3);
    const float *columns = norms + 3 * MO_HIDDEN * layer + column;
    float2 s[MT][2];
#pragma unroll
    for (int j = 0; j < 2; j++) {
      const float2 bias = *(const float2 *)(columns + 2 * j);
#pragma unroll
      for (int m = 0; m < MT; m++)
#pragma unroll
        for (int h = 0; h < 2; h++) {
          sums.c[m][j][2 * h] += bias.x;
          sums.c[m][j][2 * h + 1] += bias.y;
        }
    }
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const float a = sums.c[m][0][2 * h], b = sums.c[m][0][2 * h + 1], c = sums.c[m][1][2 * h],
                    d = sums.c[m][1][2 * h + 1];
        s[m][h] = make_float2((a + b) + (c + d), fmaf(a, a, b * b) + fmaf(c, c, d * d));
      }
    sum_rows<MT>(part, warp, lane, s);
    const float4 gain = *(const float4 *)(columns + MO_HIDDEN),
                 shift = *(const float4 *)(columns + 2 * MO_HIDDEN);
    uint2 *normal = (uint2 *)(tape + normal_at + layer * layer_bytes) +
                    (size_t)pass * TAPE_ROWS * (MO_HIDDEN / 4);
    float *scale =
        (float *)(tape + scale_at) + ((size_t)pass * MO_HIDDEN_LAYERS + layer) * TAPE_ROWS;
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = m * 16 + h * 8 + (lane >> 2), on_tape = group_row(row);
        const float mean = s[m][h].x * (1.0f / MO_HIDDEN);
        const float variance = fmaxf(fmaf(-mean, mean, s[m][h].y * (1.0f / MO_HIDDEN)), 0.0f);
        const float factor = rsqrtf(variance + (float)MO_LAYERNORM_EPSILON);
        float2 n[2], y[2];
#pragma unroll
        for (int j = 0; j < 2; j++) {
          n[j] = make_float2((sums.c[m][j][2 * h] - mean) * factor,
                             (sums.c[m][j][2 * h + 1] - mean) * factor);
        }
        y[0] = make_float2(fmaxf(fmaf(n[0].x, gain.x, shift.x), 0.0f),
                           fmaxf(fmaf(n[0].y, gain.y, shift.y), 0.0f));
        y[1] = make_float2(fmaxf(fmaf(n[1].x, gain.z, shift.z), 0.0f),
                           fmaxf(fmaf(n[1].y, gain.w, shift.w), 0.0f));
        *(uint2 *)(left + row * MO_GK_ROW + column) =
            four(__float22half2_rn(y[0]), __float22half2_rn(y[1]));
        normal[on_tape * (MO_HIDDEN / 4) + (column >> 2)] =
            four(__float22half2_rn(n[0]), __float22half2_rn(n[1]));
        if (warp == 0 && (lane & 3) == 0)
          scale[on_tape] = factor;
      }
    __syncthreads();
  }

  /* Returns the first of this warp's sixteen tiles of a hidden layer. */
  __device__ __forceinline__ const uint4 *hidden_tiles(int layer) const
  {
    return k.weights.forward[layer] + (uint32_t)warp * (16 * 32) + lane;
  }
  /* Returns the first tile for a tile of springs. */
  __device__ __forceinline__ const uint4 *output_tiles(int u) const
  {
    return k.weights.forward[3] + (uint32_t)output_tile[min(u, n_outputs - 1)] * (16 * 32) + lane;
  }

  /* The weights of T tiles, with interleaved parts. */
  template <int T> struct in_turn {
    const uint4 *at[T];
    __device__ __forceinline__ const uint4 *operator()(int i) const
    {
      return at[i % T] + (i / T) * 32;
    }
  };

  /* Multiplies T tiles of columns, sixteen tiles deep. The ring has their first weights and, at the
   * end, those of coming() (MORE). The layer's inputs are loaded once for all T, one tile ahead:
   * loading them for each took longer than loading the weights. It is all straight-line code, so
   * that loads stay roughly where they are written. */
  template <int T, bool MORE, class Next>
  __device__ __forceinline__ void add_run(warp_sums<MT> (&sums)[T],
                                          weights_ahead<MO_GK_AHEAD> &ahead, uint32_t left_at,
                                          const in_turn<T> &now, const Next &coming)
  {
#pragma unroll
    for (int t = 0; t < T; t++)
      sums[t].clear();
    uint32_t a[2][MT][4];
#pragma unroll
    for (int m = 0; m < MT; m++)
      load_matrices(a[0][m], left_at + (uint32_t)m * 16 * MO_GK_ROW * 2);
#pragma unroll
    for (int i = 0; i < 16 * T; i++) {
      const int k = i / T;
      if (i % T == 0 && k + 1 < 16) {
#pragma unroll
        for (int m = 0; m < MT; m++)
          load_matrices(a[(k + 1) % 2][m],
                        left_at + (uint32_t)(k + 1) * 32 + (uint32_t)m * 16 * MO_GK_ROW * 2);
      }
      const uint4 &w = ahead.w[i % MO_GK_AHEAD];
#pragma unroll
      for (int m = 0; m < MT; m++) {
        multiply<false>(sums[i % T].c[m][0], a[k % 2][m], w.x, w.y);
        multiply<false>(sums[i % T].c[m][1], a[k % 2][m], w.z, w.w);
      }
      if (i + MO_GK_AHEAD < 16 * T)
        ahead.w[i % MO_GK_AHEAD] = load_weights(now(i + MO_GK_AHEAD));
      else if (MORE) {
        const auto next = coming();
        ahead.w[i % MO_GK_AHEAD] = load_weights(next(i + MO_GK_AHEAD - 16 * T));
      }
    }
  }

  /* Applies the activation to a tile of springs. */
  __device__ __forceinline__ void act(int u, const warp_sums<MT> &sums)
  {
    const float4 bias =
        __ldg((const float4 *)(k.weights.bias[3] + output_tile[u] * MO_GP_TILE + 4 * (lane & 3)));
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = m * 16 + h * 8 + (lane >> 2);
        const uint32_t a =
            activations(sums.c[m][0][2 * h] + bias.x, sums.c[m][0][2 * h + 1] + bias.y);
        const uint32_t c =
            activations(sums.c[m][1][2 * h] + bias.z, sums.c[m][1][2 * h + 1] + bias.w);
        *(uint2 *)(outputs + row * width + u * 16 + 4 * (lane & 3)) = make_uint2(a, c);
      }
  }

  /* `ahead` has the first layer's first weights. */
  __device__ __forceinline__ void control(uint32_t pass, weights_ahead<MO_GK_AHEAD> &ahead)
  {
    const uint32_t left_at = left_address(left, MO_GK_ROW * 2, lane);
#pragma unroll 1
    for (int layer = 0; layer < MO_HIDDEN_LAYERS; layer++) {
      warp_sums<MT> sums[1];
      if (layer + 1 < MO_HIDDEN_LAYERS)
        add_run<1, true>(sums, ahead, left_at, in_turn<1>{hidden_tiles(layer)},
                         [&] { return in_turn<1>{hidden_tiles(layer + 1)}; });
      else
        add_run<1, true>(sums, ahead, left_at, in_turn<1>{hidden_tiles(layer)}, [&] {
          return in_turn<2>{output_tiles(warp), output_tiles(warp + MO_GP_WARPS)};
        });
      norm_relu(layer, pass, sums[0]);
      keep_left(tape + hidden_at + layer * layer_bytes +
                (size_t)pass * TAPE_ROWS * (MO_HIDDEN * 2));
    }
    int u = warp;
#pragma unroll 1
    for (; u + 3 * MO_GP_WARPS < n_outputs; u += 2 * MO_GP_WARPS) {
      warp_sums<MT> sums[2];
      add_run<2, true>(
          sums, ahead, left_at, in_turn<2>{output_tiles(u), output_tiles(u + MO_GP_WARPS)}, [&] {
            return in_turn<2>{output_tiles(u + 2 * MO_GP_WARPS), output_tiles(u + 3 * MO_GP_WARPS)};
          });
      act(u, sums[0]);
      act(u + MO_GP_WARPS, sums[1]);
    }
    /* One to three tiles remain. A single tile is multiplied together with another, which is not
     * used. */
    if (u < n_outputs) {
      warp_sums<MT> sums[2];
      add_run<2, true>(sums, ahead, left_at,
                       in_turn<2>{output_tiles(u), output_tiles(u + MO_GP_WARPS)},
                       [&] { return in_turn<1>{output_tiles(u + 2 * MO_GP_WARPS)}; });
      act(u, sums[0]);
      if (u + MO_GP_WARPS < n_outputs)
        act(u + MO_GP_WARPS, sums[1]);
    }
    if (u + 2 * MO_GP_WARPS < n_outputs) {
      warp_sums<MT> sums[1];
      add_run<1, false>(sums, ahead, left_at, in_turn<1>{output_tiles(u + 2 * MO_GP_WARPS)},
                        [&] { return in_turn<1>{nullptr}; });
      act(u + 2 * MO_GP_WARPS, sums[0]);
    }
  }

  /* Computes tanh, 1 − 2 / (1 + exp(2 y)), in units of 1/32767: the addition rounds it and leaves
   * it in the sum's lowest bits. For large y the instructions return 0 and infinity, which is
   * correct.
   */
  static __device__ __forceinline__ uint32_t activation(float y)
  {
    float e, r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(e) : "f"(y * 2.885390081777927f));
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(e + 1.0f));
    return __float_as_uint(fmaf(r, -65534.0f, 12582912.0f + 32767.0f));
  }

  static __device__ __forceinline__ uint32_t activations(float y, float z)
  {
    return __byte_perm(activation(y), activation(z), 0x5410);
  }

  struct spring {
    float4 other; /* its position */
    int16_t a;
  };

  __device__ __forceinline__ spring spring_of(uint32_t s) const
  {
    spring p;
    p.other = x[first + MO_GP_SPRING_OTHER(s)];
    p.a = outputs[pair_row(MO_GP_SPRING_ROW(s)) * width + MO_GP_SPRING_OUTPUT(s)];
    return p;
  }

  /* The springs of the chunks are loaded N at a time, some of them beyond the pair's own, while the
   * previous ones are computed, because one of several loads in flight is not available before the
   * last of them. The data that they need from shared memory is fetched one chunk ahead. */
  __device__ __forceinline__ void springs(uint32_t step)
  {
    enum { N = MO_GK_SPRINGS_AHEAD };
    int16_t *keep =
        (int16_t *)(tape + activation_at) + (size_t)pass_of(step) * n_chunks * 32 + chunk_at;
    const bool keeps = begins_period(step), blend = blends(step);
    float *pushes = (float *)(tape + push_at) + (size_t)step * 3 * n_masses + group_first();
    const int n = own_chunks;
    if (n == 0)
      return;
    const uint32_t is_broken = broken(step);
    uint32_t now[N], then[N], cut = 0;
#pragma unroll
    for (int i = 0; i < N; i++)
      now[i] = __ldg(list + 32 * i);
    uint32_t s = now[0], at = MO_GP_SPRING_OWN(s);
    spring p = spring_of(s);
    float4 here = x[first + (at == MO_GP_NO_MASS ? 0 : at)];
    float pull = constants_of(s).pull, actuation = constants_of(s).actuation, sum[3] = {0, 0, 0};
    for (int c = 0;; c += N) {
      int16_t old[N]; /* activations of the previous control period */
      if (SPLIT && blend) {
#pragma unroll
        for (int i = 0; i < N; i++)
          old[i] = __ldcg(keep + (c + i) * 32 - n_chunks * 32);
      }
      if (c + N < n) {
#pragma unroll
        for (int i = 0; i < N; i++)
          then[i] = __ldg(list + 32 * (c + N + i));
      }
      if (TASKS && is_broken != 0)
        cut = own::template cut_springs<N>(c, n);
#pragma unroll
      for (int i = 0; i < N; i++) {
        const uint32_t next = c + i + 1 < n ? (i + 1 < N ? now[(i + 1) % N] : then[0]) : s;
        const spring q = spring_of(next);
        float a = activation_of(p.a);
        if (SPLIT && blend)
          a = 0.5f * (a + activation_of(old[i]));
        if (keeps)
          keep[(c + i) * 32] = p.a;
        const float d[3] = {here.x - p.other.x, here.y - p.other.y, here.z - p.other.z};
        const struct lane_length length = lane_length_of(lane_squared(d));
        float f = lane_spring(pull, &length, wanted_length(actuation, s, a));
        if (TASKS && (cut >> i & is_broken >> MO_GP_SPRING_ROW(s) & 1u) != 0)
          f = 0.0f;
        for (int axis = 0; axis < 3; axis++)
          sum[axis] = fmaf(-f, d[axis], sum[axis]);
        if (s & MO_GP_SPRING_LAST) {
          if (at != MO_GP_NO_MASS)
            for (int axis = 0; axis < 3; axis++) {
              v[3 * (first + at) + axis] += sum[axis];
              if (SPLIT)
                pushes[axis * n_masses + at] = sum[axis];
            }
          at = MO_GP_SPRING_OWN(next);
          here = x[first + (at == MO_GP_NO_MASS ? 0 : at)];
          pull = constants_of(next).pull;
          actuation = constants_of(next).actuation;
          sum[0] = sum[1] = sum[2] = 0;
        }
        if (c + i + 1 == n) {
          __syncwarp();
          return;
        }
        s = next;
        p = q;
      }
#pragma unroll
      for (int i = 0; i < N; i++)
        now[i] = then[i];
    }
  }

  /* Returns the velocity of a mass as the springs see it: adding −0 changes no number. */
  __device__ __forceinline__ float unpushed(int m, int axis, float u) const
  {
    const lane_physics of = physics_of(own_row(is_second(m)));
    return lane_kick(&of, axis, u, -0.0f);
  }

  /* Stores a mass's state after the step. Returns false if it is not valid. */
  __device__ __forceinline__ bool leave(int m, const float *p, const float *u)
  {
    x[first + m] = make_float4(p[0], p[1], p[2], 0);
    for (int axis = 0; axis < 3; axis++)
      v[3 * (first + m) + axis] = unpushed(m, axis, u[axis]);
    return lane_is_sane(p, u);
  }

  __device__ __forceinline__ void move(uint32_t step)
  {
    float *keep = (float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + group_first();
    bool sane[2] = {true, true};
    strikes aside = {(uint16_t *)part + warp * 64, 0};
    for (int from = begin(); from < end(); from += 32) {
      const int m = from + lane;
      bool struck = false;
      if (m < end()) {
        const bool second = is_second(m), ended = second ? dead[1] : dead[0];
        const lane_physics physics = physics_of(own_row(second));
        const float *pv = v + 3 * (first + m);
        const float4 before = x[first + m];
        const float p[3] = {before.x, before.y, before.z};
        const float u[3] = {ended ? 0.0f : pv[0], ended ? 0.0f : pv[1], ended ? 0.0f : pv[2]};
        float next[3];
        keep[m] = u[0];
        keep[n_masses + m] = u[1];
        keep[2 * n_masses + m] = u[2];
        struck = !ended && strikes_in(own_row(second), physics, p, u, next);
        if (ended)
          leave(m, p, u);
        else if (!struck && !leave(m, next, u))
          (second ? sane[1] : sane[0]) = false;
      }
      aside.add(struck, m, lane);
      while (aside.n >= 32 || (from + 32 >= end() && aside.n > 0)) {
        if (lane < aside.n) {
          const int at = aside.mass[lane];
          const bool second = is_second(at);
          const mo_plan_scene &of = rows[own_row(second)];
          const lane_physics physics = physics_of(own_row(second));
          const float *pv = v + 3 * (first + at);
          const float4 before = x[first + at];
          const lane_terrain terrain = terrain_of(own_row(second));
          float p[3] = {before.x, before.y, before.z}, u[3] = {pv[0], pv[1], pv[2]};
          if (SPLIT) {
            const float *pushes =
                (const float *)(tape + push_at) + (size_t)step * 3 * n_masses + group_first() + at;
            const float push[3] = {pushes[0], pushes[n_masses], pushes[2 * n_masses]};
            const lane_split split = split_of(own_row(second), step);
            lane_move_split(&physics, &split, terrain, push, p, u);
          } else {
            lane_move(&physics, terrain, of.highest, p, u);
          }
          if (!leave(at, p, u))
            (second ? sane[1] : sane[0]) = false;
        }
        aside.done(lane);
      }
    }
#pragma unroll
    for (int r = 0; r < MT; r++) {
      if (!__all_sync(0xffffffffu, sane[r]) && !dead[r]) {
        const int from = own_begin(r);
        const float *before = (const float *)(tape + position_at) + (size_t)step * 3 * n_masses +
                              group_first() + from;
        for (int m = lane; m < own_masses(r); m += 32)
          x[first + from + m] =
              make_float4(before[m], before[n_masses + m], before[2 * n_masses + m], 0);
        if (lane == 0)
          k.results[first_row + group_row(own_row(r))].diverged = (int32_t)step + 1;
        dead[r] = true;
      }
    }
    __syncwarp();
  }

  __device__ __forceinline__ void finish()
  {
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int n = own_masses(r), from = first + own_begin(r);
      double sum[3] = {0, 0, 0};
      for (int m = lane; m < n; m += 32) {
        const float4 p = x[from + m];
        sum[0] += (double)p.x;
        sum[1] += (double)p.y;
        sum[2] += (double)p.z;
      }
#pragma unroll
      for (int axis = 0; axis < 3; axis++)
        sum[axis] = sum_lanes(sum[axis]);
      if (lane < 3 && n > 0)
        k.results[first_row + group_row(own_row(r))].com_end[lane] = (lane == 0   ? sum[0]
                                                                      : lane == 1 ? sum[1]
                                                                                  : sum[2]) /
                                                                     n;
    }
  }

  __device__ __forceinline__ void run()
  {
    const uint64_t state_at = 3 * (g.first_mass + group_first());
    float *state_x = k.position + state_at, *state_v = k.velocity + state_at;
    float *own_v = v + 3 * first;
    __syncthreads(); /* all threads have loaded the rows' constants, which unpushed() reads */
    for (int m = begin() + lane; m < end(); m += 32)
      x[first + m] = make_float4(state_x[3 * m], state_x[3 * m + 1], state_x[3 * m + 2], 0);
    for (int i = 3 * begin() + lane; i < 3 * end(); i += 32) {
      if (first_step > 0)
        own_v[i] = state_v[i];
      else if (SPLIT)
        own_v[i] = i % 3 == 2 ? -plan_split_of(own_row(is_second(i / 3))).first_fall : 0.0f;
      else
        own_v[i] = unpushed(i / 3, i % 3, 0.0f);
    }
    dead[0] = k.results[first_row + group_row(own_row(0))].diverged != 0;
    dead[1] = MT > 1 && k.results[first_row + group_row(own_row(MT - 1))].diverged != 0;
    __syncthreads();
    if (SPLIT && first_step == 0)
      use_pull(true);
    for (uint32_t step = first_step; step < end_step; step++) {
      weights_ahead<MO_GK_AHEAD> ahead;
      float *keep = (float *)(tape + position_at) + (size_t)step * 3 * n_masses + group_first();
      for (int m = begin() + lane; m < end(); m += 32) {
        const float4 p = x[first + m];
        keep[m] = p.x;
        keep[n_masses + m] = p.y;
        keep[2 * n_masses + m] = p.z;
      }
      if (begins_period(step)) {
        const uint32_t pass = pass_of(step);
        if constexpr (TASKS)
          guide(step);
        sense(step);
        ahead.start([&](int i) { return hidden_tiles(0) + i * 32; });
        __syncthreads();
        keep_left(tape + input_at + (size_t)pass * TAPE_ROWS * (MO_GP_INPUTS * 2));
        control(pass, ahead);
        __syncthreads();
        if constexpr (TASKS)
          if (step > 0)
            add_work(*this, step);
      } else {
        pair_sync(); /* waits until the other warp has moved its masses */
      }
      springs(step);
      pair_sync(); /* also waits for the other warp's springs */
      move(step);
      if (SPLIT && step == 0)
        use_pull(false);
    }
    for (int i = 3 * begin() + lane; i < 3 * end(); i += 32) {
      state_x[i] = ((const float *)(x + first + i / 3))[i % 3];
      state_v[i] = own_v[i];
    }
    if (end_step == k.n_steps) {
      finish();
      if constexpr (TASKS)
        end_tasks();
    }
  }
};

extern "C" int mo_gk_open_forward(uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  return way_kernels<forward>::open(block_bytes, dynamic_bytes);
}

extern "C" int mo_gk_forward(const struct mo_gk *k, uint32_t shared_bytes, void *stream)
{
  return way_kernels<forward>::launch(k, shared_bytes, stream);
}
