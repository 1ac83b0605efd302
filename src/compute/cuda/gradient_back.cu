/* gradient_back.cu: the way back through physics, sensors and network, from a launch's last step to its first. Leaves ∂loss/∂ what each layer
 * sums for the products that give the parameters' gradient. A row whose adjoint is not finite becomes zeros from there on and is reported; the
 * host then walks back again without it, so that nothing of it is left in the sums. */
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
  uint32_t width;                               /* of ∂loss/∂ outputs in shared memory */
  back_mass *mass;                              /* (n_masses) */
  float *gx;                                    /* (n_masses, 3) ∂loss/∂ positions */
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

  /* ∂loss/∂ the final state. */
  __device__ __forceinline__ void start()
  {
    int from = first;
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int n = own_masses(r);
      const mo_gp_row &own = k.rows[first_row + warp + 16 * r];
      const mo_gk_result &end = k.results[first_row + warp + 16 * r];
      const double dx = end.com_end[0] - own.light_m[0], dy = end.com_end[1] - own.light_m[1];
      const double far = sqrt(dx * dx + dy * dy);
      const double scale = far > 0 && !excluded[r] && n > 0 ? 1.0 / (far * own.start_m * n) : 0.0;
      for (int m = lane; m < n; m += 32) {
        float *p = gx + 3 * (from + m);
        p[0] = (float)(dx * scale);
        p[1] = (float)(dy * scale);
        p[2] = 0;
        mass[from + m].z_gx.y = 0;
        mass[from + m].gyz = make_float2(0, 0);
      }
      from += n;
    }
  }

  /* Measures the adjoint of the state after `step` steps, says by what to scale it. */
  __device__ __forceinline__ float clip(int r, int from)
  {
    const int n = own_masses(r);
    double sum_x = 0, sum_v = 0;
    for (int i = lane; i < 3 * n; i += 32) {
      const double a = gx[3 * from + i];
      sum_x += a * a;
    }
    for (int m = lane; m < n; m += 32) {
      const double a = mass[from + m].z_gx.y;
      const float2 yz = mass[from + m].gyz;
      const double b = yz.x, c = yz.y;
      sum_v += a * a + (b * b + c * c);
    }
    sum_x = sum_lanes(sum_x);
    sum_v = sum_lanes(sum_v);
    if (excluded[r] || n == 0)
      return 0;
    back_row &own = result[warp + 16 * r]; /* all lanes have the same to write: the first does */
    const double m = own.start_m * fmax(sqrt(sum_x), MO_ADJOINT_RATE_PER_S * sqrt(sum_v));
    const bool bad = !(sum_x < 1e300) || !(sum_v < 1e300) || failed[warp + 16 * r];
    const bool scaled = !bad && k.bound > 0 && m > k.bound;
    __syncwarp();
    if (lane == 0) {
      own.steps++;
      own.clipped += scaled;
      if (bad)
        own.zeroed = 1;
      else
        own.largest = fmax(own.largest, m);
    }
    if (bad) {
      excluded[r] = true;
      return 0;
    }
    if (scaled)
      return (float)(k.bound / m);
    return 1;
  }

  __device__ __forceinline__ void move_back(uint32_t step)
  {
    const int n = n0 + n1;
    const float *velocity = (const float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + first;
    const float scale[2] = {clip(0, first), MT > 1 ? clip(MT - 1, first + n0) : 0.0f};
    __syncwarp();
    for (int m = lane; m < n; m += 32) {
      const bool second = m >= n0;
      const lane_row &own = rows[warp + (second ? 16 : 0)];
      const int at = 3 * (first + m);
      const back_mass own_mass = mass[first + m];
      float dp[3] = {0, 0, 0}, dv[3] = {0, 0, 0};
      const float s = second ? scale[1] : scale[0];
      if (s > 0) {
        const float p[3] = {own_mass.xy.x, own_mass.xy.y, own_mass.z_gx.x};
        const float v[3] = {__ldg(velocity + m), __ldg(velocity + n_masses + m), __ldg(velocity + 2 * n_masses + m)};
        dv[0] = s * own_mass.z_gx.y;
        dv[1] = s * own_mass.gyz.x;
        dv[2] = s * own_mass.gyz.y;
        for (int axis = 0; axis < 3; axis++)
          dp[axis] = s * gx[at + axis];
        mo_move_back(&k.physics, own.heights, own.highest, p, v, dp, dv);
      }
      for (int axis = 0; axis < 3; axis++)
        gx[at + axis] = dp[axis];
      mass[first + m].z_gx.y = dv[0];
      mass[first + m].gyz = make_float2(dv[1], dv[2]);
    }
    __syncwarp();
  }

  /* As on the way forward. ∂loss/∂ a spring's output goes to its place from one of its ends. */
  __device__ __forceinline__ void springs_back(uint32_t step)
  {
    enum { N = MO_GK_SPRINGS_AHEAD_BACK };
    const int16_t *kept = (const int16_t *)(tape + activation_at) + (size_t)step * n_chunks * 32 + chunk_at;
    const int n = own_chunks;
    if (n == 0)
      return;
    uint32_t ahead[N];
    int16_t kept_ahead[N];
#pragma unroll
    for (int i = 0; i < N; i++) {
      ahead[i] = __ldg(list + 32 * i);
      kept_ahead[i] = __ldg(kept + 32 * i);
    }
    uint32_t s = ahead[0], own = MO_GP_SPRING_OWN(s);
    back_mass other = mass[first + MO_GP_SPRING_OTHER(s)], here = mass[first + (own == MO_GP_NO_MASS ? 0 : own)];
    float sum[3] = {0, 0, 0};
    for (int c = 0;; c += N) {
      const uint32_t *far = list + 32 * (c + N);
      const int16_t *kept_far = kept + 32 * (c + N);
#pragma unroll
      for (int i = 0; i < N; i++) {
        const uint32_t next = c + i + 1 < n ? ahead[(i + 1) % N] : s;
        const back_mass next_other = mass[first + MO_GP_SPRING_OTHER(next)];
        const float a = (float)kept_ahead[i] * (1.0f / 32767.0f);
        ahead[i] = __ldg(far + 32 * i);
        kept_ahead[i] = __ldg(kept_far + 32 * i);
        const float d[3] = {here.xy.x - other.xy.x, here.xy.y - other.xy.y, here.z_gx.x - other.z_gx.x};
        const float across[3] = {other.z_gx.y - here.z_gx.y, other.gyz.x - here.gyz.x, other.gyz.y - here.gyz.y};
        const float rest = MO_GP_SPRING_DIAGONAL(s) ? (float)(MO_VOXEL_M * 1.41421356237309504880) : (float)MO_VOXEL_M;
        float dd[3];
        const float d_sum = mo_spring_pull_back(&k.physics, rest, a, d, across, dd) * fmaf(-a, a, 1.0f);
        for (int axis = 0; axis < 3; axis++)
          sum[axis] += dd[axis];
        if (own < MO_GP_SPRING_OTHER(s)) {
          const int row = warp + 16 * (int)MO_GP_SPRING_ROW(s);
          if (!(fabsf(d_sum) <= MO_GK_LARGE))
            atomicOr(failed + row, 1);
          outputs[row * width + MO_GP_SPRING_OUTPUT(s)] = __float2bfloat16_rn(d_sum);
        }
        if (s & MO_GP_SPRING_LAST) {
          if (own != MO_GP_NO_MASS)
            for (int axis = 0; axis < 3; axis++)
              gx[3 * (first + own) + axis] += sum[axis];
          own = MO_GP_SPRING_OWN(next);
          here = mass[first + (own == MO_GP_NO_MASS ? 0 : own)];
          sum[0] = sum[1] = sum[2] = 0;
        }
        if (c + i + 1 == n) {
          __syncwarp();
          return;
        }
        s = next;
        other = next_other;
      }
    }
  }

  /* ∂loss/∂ outputs to global memory, and their sums over rows: each thread has the same columns at every step. */
  __device__ __forceinline__ void keep_outputs(uint32_t step, float2 (&bias)[2])
  {
    const int words = n_outputs * 8;
    __nv_bfloat162 *to = (__nv_bfloat162 *)(tape + output_at) + (size_t)step * ROWS * words;
#pragma unroll
    for (int half = 0; half < 2; half++) {
      const int at = (int)threadIdx.x + half * MO_GK_THREADS;
      if (at >= words)
        continue;
#pragma unroll 8
      for (int row = 0; row < ROWS; row++) {
        const __nv_bfloat162 d = *(const __nv_bfloat162 *)(outputs + row * width + 2 * at);
        const float2 f = __bfloat1622float2(d);
        to[row * words + at] = d;
        bias[half].x += f.x;
        bias[half].y += f.y;
      }
    }
  }

  /* Sums over rows of three values per column, added to the sums of this launch. */
  __device__ __forceinline__ void add_columns(float *to, float value)
  {
    value += __shfl_xor_sync(0xffffffffu, value, 4);
    value += __shfl_xor_sync(0xffffffffu, value, 8);
    value += __shfl_xor_sync(0xffffffffu, value, 16);
    if (lane < 4)
      *to += value;
  }

  __device__ __forceinline__ void load_normal(int layer, uint32_t step, __half2 (&n)[MT][2][2], float (&factor)[MT][2])
  {
    const int column = warp * 16 + 4 * (lane & 3);
    const uint2 *normal =
        (const uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
    const float *scale = (const float *)(tape + scale_at) + ((size_t)step * MO_HIDDEN_LAYERS + layer) * ROWS;
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = m * 16 + h * 8 + (lane >> 2);
        factor[m][h] = __ldg(scale + row);
        const uint2 two = __ldcg(normal + row * (MO_HIDDEN / 4) + (column >> 2));
        n[m][h][0] = *(const __half2 *)&two.x;
        n[m][h][1] = *(const __half2 *)&two.y;
      }
  }

  /* sums: ∂loss/∂ what ReLU gave. Leaves ∂loss/∂ what the layer summed in `left`, and on the tape where n was. */
  __device__ __forceinline__ void norm_relu_back(int layer, uint32_t step, warp_sums<MT> &sums,
                                                 const __half2 (&n)[MT][2][2], const float (&factors)[MT][2],
                                                 const norm_columns &columns)
  {
    const int column = warp * 16 + 4 * (lane & 3);
    uint2 *dense = (uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
    float2 s[MT][2];
    float *bias = norms + layer * 3 * MO_HIDDEN + column, *gain_sum = bias + MO_HIDDEN,
          *shift_sum = gain_sum + MO_HIDDEN;
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++)
        s[m][h] = make_float2(0, 0);
#pragma unroll
    for (int j = 0; j < 2; j++) {
      const float2 gain = columns.gain[j], shift = columns.shift[j];
      float2 d_shift = {0, 0}, d_gain = {0, 0};
#pragma unroll
      for (int m = 0; m < MT; m++)
#pragma unroll
        for (int h = 0; h < 2; h++) {
          const float2 at = __half22float2(n[m][h][j]);
          const float d0 = fmaf(at.x, gain.x, shift.x) > 0 ? sums.c[m][j][2 * h] : 0.0f;
          const float d1 = fmaf(at.y, gain.y, shift.y) > 0 ? sums.c[m][j][2 * h + 1] : 0.0f;
          d_shift.x += d0;
          d_shift.y += d1;
          d_gain.x = fmaf(d0, at.x, d_gain.x);
          d_gain.y = fmaf(d1, at.y, d_gain.y);
          const float e0 = d0 * gain.x, e1 = d1 * gain.y;
          sums.c[m][j][2 * h] = e0;
          sums.c[m][j][2 * h + 1] = e1;
          s[m][h].x += e0 + e1;
          s[m][h].y += fmaf(e0, at.x, e1 * at.y);
        }
      add_columns(shift_sum + 2 * j, d_shift.x);
      add_columns(shift_sum + 2 * j + 1, d_shift.y);
      add_columns(gain_sum + 2 * j, d_gain.x);
      add_columns(gain_sum + 2 * j + 1, d_gain.y);
    }
    sum_rows<MT>(part, warp, lane, s);
    float2 d_bias[2] = {{0, 0}, {0, 0}};
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = m * 16 + h * 8 + (lane >> 2);
        const float factor = factors[m][h], mean = s[m][h].x * (1.0f / MO_HIDDEN),
                    along = s[m][h].y * (1.0f / MO_HIDDEN);
        float2 d[2];
#pragma unroll
        for (int j = 0; j < 2; j++) {
          const float2 at = __half22float2(n[m][h][j]);
          d[j] = make_float2(factor * (sums.c[m][j][2 * h] - fmaf(at.x, along, mean)),
                             factor * (sums.c[m][j][2 * h + 1] - fmaf(at.y, along, mean)));
          if (!(fabsf(d[j].x) <= MO_GK_LARGE) || !(fabsf(d[j].y) <= MO_GK_LARGE))
            atomicOr(failed + row, 1);
          d_bias[j].x += d[j].x;
          d_bias[j].y += d[j].y;
        }
        const uint2 both = four(__float22bfloat162_rn(d[0]), __float22bfloat162_rn(d[1]));
        *(uint2 *)(left + row * MO_GK_ROW + column) = both;
        dense[row * (MO_HIDDEN / 4) + (column >> 2)] = both;
      }
#pragma unroll
    for (int j = 0; j < 2; j++) {
      add_columns(bias + 2 * j, d_bias[j].x);
      add_columns(bias + 2 * j + 1, d_bias[j].y);
    }
    __syncthreads();
  }

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
    return (weights_ahead::N - n_outputs % weights_ahead::N) % weights_ahead::N;
  }

  __device__ __forceinline__ void start_ahead(weights_ahead &ahead) const
  {
    const int before = lead();
    ahead.start([&](int i) { return last_tile(max(i - before, 0)); });
  }

  __device__ __forceinline__ void add_last(warp_sums<MT> &sums, weights_ahead &ahead)
  {
    enum { N = weights_ahead::N };
    const uint32_t left_at = left_address(outputs, width * 2, lane);
    const uint4 *hidden = hidden_tiles(2);
    const int before = lead();
    int at = -before;
    if (before > 0) {
#pragma unroll
      for (int i = 0; i < N; i++) {
        if (i >= before)
          add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
        ahead.w[i] = load_weights(at + N < n_outputs ? last_tile(at + N + i) : hidden + i * 32);
      }
      at += N;
    }
#pragma unroll 1
    for (; at + N < n_outputs; at += N) {
#pragma unroll
      for (int i = 0; i < N; i++) {
        add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
        ahead.w[i] = load_weights(last_tile(at + N + i));
      }
    }
    if (at < n_outputs) {
#pragma unroll
      for (int i = 0; i < N; i++) {
        add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
        ahead.w[i] = load_weights(hidden + i * 32);
      }
    }
  }

  /* `ahead` has the last layer's first weights. */
  __device__ __forceinline__ void control_back(uint32_t step, weights_ahead &ahead)
  {
    const uint32_t left_at = left_address(left, MO_GK_ROW * 2, lane);
    const int column = warp * 16 + 4 * (lane & 3);
    __half2 n[MT][2][2];
    float factors[MT][2];
    warp_sums<MT> sums;
    norm_columns columns;
    columns.load(k.weights, 2, column);
    load_normal(2, step, n, factors);
    sums.clear();
    add_last(sums, ahead);
    norm_relu_back(2, step, sums, n, factors, columns);
#pragma unroll 1
    for (int layer = 2; layer > 0; layer--) {
      columns.load(k.weights, layer - 1, column);
      load_normal(layer - 1, step, n, factors);
      sums.clear();
      add_tiles<MT, true, true>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(layer), hidden_tiles(layer - 1));
      norm_relu_back(layer - 1, step, sums, n, factors, columns);
    }
    sums.clear();
    add_tiles<MT, true, false>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(0), nullptr);
    __syncthreads();
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++)
        *(uint2 *)(left + (m * 16 + h * 8 + (lane >> 2)) * MO_GK_ROW + column) =
            four(__floats2bfloat162_rn(sums.c[m][0][2 * h], sums.c[m][0][2 * h + 1]),
                 __floats2bfloat162_rn(sums.c[m][1][2 * h], sums.c[m][1][2 * h + 1]));
    __syncthreads();
  }

  __device__ __forceinline__ void sense_back()
  {
    int from = 0;
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int row = warp + 16 * r, n = own_masses(r);
      const lane_row &own = rows[row];
      float d[8], sum = 0;
#pragma unroll
      for (int j = 0; j < 8; j++) {
        const int m = lane + 32 * j;
        d[j] = m < n ? __bfloat162float(left[row * MO_GK_ROW + __ldg(input + from + m)]) : 0.0f;
        sum += d[j];
      }
      const float mean = sum_lanes(sum) / (float)max(n, 1);
#pragma unroll
      for (int j = 0; j < 8; j++) {
        const int m = lane + 32 * j;
        if (m < n) {
          const int at = 3 * (first + from + m);
          back_mass &own_mass = mass[first + from + m];
          const float2 z_gx = own_mass.z_gx, gyz = own_mass.gyz;
          const float away[3] = {own_mass.xy.x - own.light[0], own_mass.xy.y - own.light[1], z_gx.x - own.light[2]};
          const float push = (d[j] - mean) * mo_light_slope(&k.physics, away);
          for (int axis = 0; axis < 3; axis++)
            gx[at + axis] = fmaf(push, away[axis], gx[at + axis]);
          own_mass.z_gx.y = z_gx.y * k.physics.keep;
          own_mass.gyz = make_float2(gyz.x * k.physics.keep, gyz.y * k.physics.keep);
        }
      }
      from += n;
    }
    __syncwarp();
  }

  static __device__ __forceinline__ void fetch(const void *from, size_t bytes)
  {
    for (size_t i = (size_t)threadIdx.x * 128; i < bytes; i += (size_t)MO_GK_THREADS * 128)
      asm volatile("prefetch.global.L2 [%0];" ::"l"((const char *)from + i));
  }

  /* What the step before this one will read. */
  __device__ __forceinline__ void fetch_step(uint32_t step)
  {
    fetch(tape + position_at + (size_t)step * n_masses * 12, (size_t)n_masses * 12);
    fetch(tape + velocity_at + (size_t)step * n_masses * 12, (size_t)n_masses * 12);
    fetch(tape + activation_at + (size_t)step * n_chunks * 64, (size_t)n_chunks * 64);
    for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
      fetch(tape + normal_at + l * layer_bytes + (size_t)step * ROWS * MO_HIDDEN * 2, ROWS * MO_HIDDEN * 2);
  }

  __device__ __forceinline__ void run()
  {
    const int n = 3 * (n0 + n1);
    const uint64_t state = 3 * (g.first_mass + first);
    float *own_gx = gx + 3 * first;
    const bool is_first = end_step == k.n_steps;
    for (uint32_t i = threadIdx.x; i < ROWS * width / 2; i += MO_GK_THREADS)
      ((uint32_t *)outputs)[i] = 0;
    for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
      norms[i] = 0;
    if (threadIdx.x < ROWS)
      failed[threadIdx.x] = 0;
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const mo_gk_result &before = k.results[first_row + warp + 16 * r];
      excluded[r] = before.diverged || before.excluded || before.zeroed;
      if (lane == 0) {
        const back_row now = {
            k.rows[first_row + warp + 16 * r].start_m, before.largest, before.steps, before.clipped, before.zeroed, 0};
        result[warp + 16 * r] = now;
      }
    }
    __syncthreads();
    if (is_first)
      start();
    else
      for (int i = lane; i < n; i += 32) {
        own_gx[i] = k.position[state + i];
        ((float *)(mass + first + i / 3))[3 + i % 3] = k.velocity[state + i];
      }
    __syncwarp();
    float2 bias[2] = {{0, 0}, {0, 0}};
    for (uint32_t step = end_step; step-- > first_step;) {
      const float *kept = (const float *)(tape + position_at) + (size_t)step * 3 * n_masses + first;
      for (int m = lane; m < n0 + n1; m += 32) {
        mass[first + m].xy = make_float2(__ldg(kept + m), __ldg(kept + n_masses + m));
        mass[first + m].z_gx.x = __ldg(kept + 2 * n_masses + m);
      }
      if (step > 0)
        fetch_step(step - 1);
      __syncwarp();
      move_back(step);
      springs_back(step);
      weights_ahead ahead;
      start_ahead(ahead);
      __syncthreads();
      keep_outputs(step, bias);
      control_back(step, ahead);
      sense_back();
    }
    for (int i = lane; i < n; i += 32) {
      k.position[state + i] = own_gx[i];
      k.velocity[state + i] = ((const float *)(mass + first + i / 3))[3 + i % 3];
    }
    __syncthreads();
#pragma unroll
    for (int r = 0; r < MT; r++)
      if (lane == 0) {
        const int row = warp + 16 * r;
        mo_gk_result &after = k.results[first_row + row];
        after.largest = result[row].largest;
        after.steps = result[row].steps;
        after.clipped = result[row].clipped;
        after.zeroed = result[row].zeroed || (failed[row] && !excluded[r]);
      }
    const mo_gp_sum place = mo_gp_sum_of(&g);
    float *sums = k.sums + g.sum_at;
    __syncthreads();
    for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
      sums[place.bias[0] + i] = norms[i] + (is_first ? 0.0f : sums[place.bias[0] + i]);
#pragma unroll
    for (int half = 0; half < 2; half++) {
      const int at = (int)threadIdx.x + half * MO_GK_THREADS;
      if (at < (int)g.n_outputs * 8) {
        float2 *to = (float2 *)(sums + place.output_bias) + at;
        const float2 before = is_first ? make_float2(0, 0) : *to;
        *to = make_float2(before.x + bias[half].x, before.y + bias[half].y);
      }
    }
  }
};

static __global__ void __launch_bounds__(MO_GK_THREADS, 1) back_kernel(const __grid_constant__ mo_gk k)
{
  extern __shared__ __align__(16) unsigned char shared[];
  mo_gk_task task;
  if (!take_task(k, (uint32_t *)shared, &task))
    return;
  const mo_gp_group &g = k.groups[task.group];
  if (g.n_rows == 32)
    back<2>(k, g, shared, task.part).run();
  else
    back<1>(k, g, shared, task.part).run();
  end_task(k, task);
}

extern "C" int mo_gk_back(const struct mo_gk *k, uint32_t shared_bytes, void *stream)
{
  const uint32_t blocks = (k->n_steps + k->part_steps - 1) / k->part_steps * k->n_groups;
  const cudaError_t status =
      cudaFuncSetAttribute(back_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, (int)shared_bytes);
  if (status != cudaSuccess)
    return (int)status;
  back_kernel<<<blocks, MO_GK_THREADS, shared_bytes, (cudaStream_t)stream>>>(*k);
  return (int)cudaGetLastError();
}
