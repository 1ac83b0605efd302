/* gradient_back.cu: the backward pass through physics, sensors and network, from a launch's last
 * step to its first. It stores ∂loss/∂(sums of each layer) for the products that form the gradient
 * of the parameters. A row with an adjoint that is not finite is zeroed from there on and reported;
 * the host then repeats the backward pass without it, so that it contributes nothing to the
 * sums. */
#include "compute/cuda/gradient_back_work.cuh"

/* Copies ∂loss/∂outputs to the tape: for each eight tiles, sixteen bytes per thread. */
struct output_copy {
  uint32_t from; /* in shared memory */
  uint4 *to;
  uint4 eight;

  __device__ __forceinline__ void read(bool any)
  {
    if (any)
      asm volatile("ld.shared.v4.u32 {%0,%1,%2,%3}, [%4];"
                   : "=r"(eight.x), "=r"(eight.y), "=r"(eight.z), "=r"(eight.w)
                   : "r"(from));
    from += 256;
  }
  __device__ __forceinline__ void write(bool any)
  {
    if (any)
      __stcs(to, eight);
    to += 16;
  }
};

/* Like load_weights, but the load stays where it is written: the compiler would move loads to the
 * end, to use their registers for something else. */
static __device__ __forceinline__ uint4 load_weights_here(const uint4 *p)
{
  uint4 w;
  asm volatile("ld.global.L1::no_allocate.v4.u32 {%0,%1,%2,%3}, [%4];"
               : "=r"(w.x), "=r"(w.y), "=r"(w.z), "=r"(w.w)
               : "l"(p));
  __syncwarp();
  return w;
}

/* Multiplies a tile's activations. */
template <int MT> struct left_tile {
  uint32_t a[MT][4];
  __device__ __forceinline__ void load(uint32_t left, uint32_t row_bytes)
  {
#pragma unroll
    for (int m = 0; m < MT; m++)
      load_matrices(a[m], left + (uint32_t)m * 16 * row_bytes);
    __syncwarp(); /* as load_weights_here */
  }
  __device__ __forceinline__ void add(warp_sums<MT> &sums, const uint4 &w) const
  {
#pragma unroll
    for (int m = 0; m < MT; m++) {
      multiply<true>(sums.c[m][0], a[m], w.x, w.y);
      multiply<true>(sums.c[m][1], a[m], w.z, w.w);
    }
  }
};

/* Adds the sixteen consecutive tiles at `now`; the ring has the first of them and, at the end,
 * those at `next` (MORE). */
template <int MT, bool MORE, int N>
static __device__ __forceinline__ void add_sixteen(warp_sums<MT> &sums, weights_ahead<N> &ahead,
                                                   uint32_t left, uint32_t row_bytes,
                                                   const uint4 *now, const uint4 *next)
{
  left_tile<MT> a[2];
  a[0].load(left, row_bytes);
#pragma unroll
  for (int k = 0; k < 16; k++) {
    if (k + 1 < 16)
      a[(k + 1) % 2].load(left + (uint32_t)(k + 1) * 32, row_bytes);
    a[k % 2].add(sums, ahead.w[k % N]);
    if (k + N < 16)
      ahead.w[k % N] = load_weights_here(now + (k + N) * 32);
    else if (MORE)
      ahead.w[k % N] = load_weights_here(next + (k + N - 16) * 32);
  }
}

/* Loads the tile with the number in the k-th byte of `four`. */
static __device__ __forceinline__ uint4 load_tile(const uint4 *from, uint32_t four, int k)
{
  return load_weights_here(
      (const uint4 *)((const char *)from + (uint64_t)__byte_perm(four, 0, 0x4440 + k) * 512));
}

template <int MT, int SHARE, int TIME> struct back : back_physics<MT, SHARE, TIME> {
  using own = back_physics<MT, SHARE, TIME>;
  using own::activation_at, own::begin, own::begins_period, own::blends, own::end, own::end_step,
      own::ends_period, own::excluded, own::failed, own::first, own::first_row, own::first_step,
      own::forget, own::g, own::group_first, own::group_row, own::gx, own::half, own::half_begin,
      own::HELD, own::hold, own::input, own::k, own::kick_back, own::lane, own::lane_begin,
      own::layer_bytes, own::left, own::mass, own::move_back, own::n_chunks, own::n_masses,
      own::n_outputs, own::n_own, own::normal_at, own::output_at, own::output_tile, own::outputs,
      own::own_row, own::part, own::pass_of, own::position_at, own::result, own::ROWS,
      own::scale_at, own::has_later, own::sense_back, own::SPLIT, own::springs_back, own::start,
      own::tape, own::TAPE_ROWS, own::TASKS, own::use_pull, own::velocity_at, own::warp, own::width;
  using typename own::held;
  /* This block's share of the group's chunks: the first, and how many. */
  int block_chunk, block_chunks;
  float *norm_sums; /* (halves, layers, 2, 256) sums over all steps */

  __device__ __forceinline__ back(const mo_gk &args, const mo_gp_group &group,
                                  unsigned char *shared, const mo_gk_task &task)
      : own(args, group, shared, task)
  {
    block_chunk = SHARE > 1 && half > 0 ? (int)g.pair[own::PAIRS].first_chunk : 0;
    block_chunks =
        (SHARE > 1 && half == 0 ? (int)g.pair[own::PAIRS].first_chunk : n_chunks) - block_chunk;
    norm_sums = k.sums + g.sum_at + mo_gp_sum_of(&g).norm + half * MO_GP_NORM_FLOATS;
    if ((int)threadIdx.x < n_outputs)
      output_tile[lead() + threadIdx.x] = g.output_tile[threadIdx.x];
    if (threadIdx.x < MO_GK_AHEAD_BACK)
      output_tile[lead() + n_outputs + threadIdx.x] =
          (uint8_t)threadIdx.x; /* then the first tiles of a hidden layer */
  }

  /* Return the half of the block that row 16 m + 8 h + lane / 4 belongs to, and whether it is this
   * lane's first row of that half. */
  static __device__ __forceinline__ int half_of(int h)
  {
    return MT > 1 ? h : 0;
  }
  static __device__ __forceinline__ bool begins(int m, int h)
  {
    return m == 0 && (MT > 1 || h == 0);
  }

  /* Sums this lane's four columns over rows, by halves, and adds them to the sums over all steps.
   * Lanes 4, 8 and 16 apart have different rows of the same columns; each of them ends up with one
   * column of one half. */
  __device__ __forceinline__ void add_columns(float *to, const float2 (&d)[MT][2])
  {
    const bool odd = lane & 4, second = lane & 8, upper = lane & 16;
    float sum[MT];
#pragma unroll
    for (int h = 0; h < MT; h++) {
      float2 near = odd ? make_float2(d[h][0].y, d[h][1].y) : make_float2(d[h][0].x, d[h][1].x);
      const float2 far =
          odd ? make_float2(d[h][0].x, d[h][1].x) : make_float2(d[h][0].y, d[h][1].y);
      near.x += __shfl_xor_sync(0xffffffffu, far.x, 4);
      near.y += __shfl_xor_sync(0xffffffffu, far.y, 4);
      sum[h] = second ? near.y : near.x;
      sum[h] += __shfl_xor_sync(0xffffffffu, second ? near.x : near.y, 8);
    }
    to += 2 * second + odd;
    if (MT > 1)
      atomicAdd(to + (upper ? MO_GP_NORM_FLOATS : 0),
                (upper ? sum[MT - 1] : sum[0]) +
                    __shfl_xor_sync(0xffffffffu, upper ? sum[0] : sum[MT - 1], 16));
    else {
      sum[0] += __shfl_xor_sync(0xffffffffu, sum[0], 16);
      if (!upper)
        atomicAdd(to, sum[0]);
    }
  }

  /* Return the first of the tiles of springs for this warp's neurons, and of its sixteen tiles of a
   * hidden layer. */
  __device__ __forceinline__ const uint4 *last_tiles() const
  {
    return k.weights.back[3] + (uint32_t)warp * MO_GP_OUTPUT_TILES * 32 + lane;
  }
  __device__ __forceinline__ const uint4 *hidden_tiles(int layer) const
  {
    return k.weights.back[layer] + (uint32_t)warp * (16 * 32) + lane;
  }

  /* Tiles of springs are processed in rounds of the ring's length, with fewer in the first round:
   * returns how many places are skipped before the first tile. */
  __device__ __forceinline__ int lead() const
  {
    return (MO_GK_AHEAD_BACK - n_outputs % MO_GK_AHEAD_BACK) % MO_GK_AHEAD_BACK;
  }

  /* Starts to load the ring; its first places are skipped, or their content is not used. */
  __device__ __forceinline__ void start_ahead(weights_ahead<MO_GK_AHEAD_BACK> &ahead) const
  {
    const int before = lead();
    ahead.start([&](int i) { return last_tiles() + (i < before ? 0 : output_tile[i] * 32); });
  }

  static __device__ __forceinline__ void fetch(const void *from, uint32_t bytes)
  {
#pragma unroll 1
    for (uint32_t i = threadIdx.x * 128; i < bytes; i += MO_GK_THREADS * 128)
      asm volatile("prefetch.global.L2 [%0];" ::"l"((const char *)from + i));
  }

  __device__ __forceinline__ void load_normal(int layer, uint32_t pass, __half2 (&n)[MT][2][2],
                                              float (&factor)[MT][2])
  {
    const int column = warp * 16 + 4 * (lane & 3);
    const uint2 *normal = (const uint2 *)(tape + normal_at + layer * layer_bytes) +
                          (size_t)pass * TAPE_ROWS * (MO_HIDDEN / 4);
    const float *scale =
        (const float *)(tape + scale_at) + ((size_t)pass * MO_HIDDEN_LAYERS + layer) * TAPE_ROWS;
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = group_row(m * 16 + h * 8 + (lane >> 2));
        uint2 two;
        asm volatile("ld.global.cs.v2.u32 {%0, %1}, [%2];"
                     : "=r"(two.x), "=r"(two.y)
                     : "l"(normal + row * (MO_HIDDEN / 4) + (column >> 2)));
        asm volatile("ld.global.nc.f32 %0, [%1];" : "=f"(factor[m][h]) : "l"(scale + row));
        n[m][h][0] = *(const __half2 *)&two.x;
        n[m][h][1] = *(const __half2 *)&two.y;
      }
  }

  /* sums: ∂loss/∂(outputs of ReLU). Stores ∂loss/∂(sums of the layer) in `left`, and on the tape in
   * place of n. */
  __device__ __forceinline__ void norm_relu_back(int layer, uint32_t pass, warp_sums<MT> &sums,
                                                 const __half2 (&n)[MT][2][2],
                                                 const float (&factors)[MT][2],
                                                 const norm_columns &columns)
  {
    const int column = warp * 16 + 4 * (lane & 3);
    uint2 *dense = (uint2 *)(tape + normal_at + layer * layer_bytes) +
                   (size_t)pass * TAPE_ROWS * (MO_HIDDEN / 4);
    float2 s[MT][2], d_shifts[MT][2], d_gains[MT][2];
    float *gain_sum = norm_sums + layer * 2 * MO_HIDDEN + column, *shift_sum = gain_sum + MO_HIDDEN;
#pragma unroll
    for (int j = 0; j < 2; j++) {
      const float2 gain = columns.gain[j], shift = columns.shift[j];
#pragma unroll
      for (int m = 0; m < MT; m++)
#pragma unroll
        for (int h = 0; h < 2; h++) {
          const float2 at = __half22float2(n[m][h][j]);
          const float d0 = fmaf(at.x, gain.x, shift.x) > 0 ? sums.c[m][j][2 * h] : 0.0f;
          const float d1 = fmaf(at.y, gain.y, shift.y) > 0 ? sums.c[m][j][2 * h + 1] : 0.0f;
          float2 &d_shift = d_shifts[half_of(h)][j], &d_gain = d_gains[half_of(h)][j];
          d_shift =
              begins(m, h) ? make_float2(d0, d1) : make_float2(d_shift.x + d0, d_shift.y + d1);
          d_gain = begins(m, h) ? make_float2(d0 * at.x, d1 * at.y)
                                : make_float2(fmaf(d0, at.x, d_gain.x), fmaf(d1, at.y, d_gain.y));
          const float e0 = d0 * gain.x, e1 = d1 * gain.y;
          sums.c[m][j][2 * h] = e0;
          sums.c[m][j][2 * h + 1] = e1;
          const float2 part_of = make_float2(e0 + e1, fmaf(e0, at.x, e1 * at.y));
          s[m][h] = j == 0 ? part_of : make_float2(s[m][h].x + part_of.x, s[m][h].y + part_of.y);
        }
    }
    add_columns(shift_sum, d_shifts);
    add_columns(gain_sum, d_gains);
    sum_rows<MT>(part, warp, lane, s);
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const int row = m * 16 + h * 8 + (lane >> 2);
        const float factor = factors[m][h], mean = s[m][h].x * (1.0f / MO_HIDDEN),
                    along = s[m][h].y * (1.0f / MO_HIDDEN);
        float2 d[2];
        bool sound = true;
#pragma unroll
        for (int j = 0; j < 2; j++) {
          const float2 at = __half22float2(n[m][h][j]);
          d[j] = make_float2(factor * (sums.c[m][j][2 * h] - fmaf(at.x, along, mean)),
                             factor * (sums.c[m][j][2 * h + 1] - fmaf(at.y, along, mean)));
          sound = sound && fabsf(d[j].x) <= MO_GK_LARGE && fabsf(d[j].y) <= MO_GK_LARGE;
        }
        if (!sound)
          failed[row] = 1;
        const uint2 both = four(__float22bfloat162_rn(d[0]), __float22bfloat162_rn(d[1]));
        *(uint2 *)(left + row * MO_GK_ROW + column) = both;
        __stcs(dense + group_row(row) * (MO_HIDDEN / 4) + (column >> 2), both);
      }
    __syncthreads();
  }

  /* Processes as many tiles as the ring holds, which then holds those numbered by the bytes of
   * `then`. FIRST: skips the first `before`. */
  template <bool FIRST>
  __device__ __forceinline__ void
  add_round(warp_sums<MT> &sums, weights_ahead<MO_GK_AHEAD_BACK> &ahead, left_tile<MT> (&a)[2],
            uint32_t left_at, const uint4 *from, const uint2 &then, int before)
  {
#pragma unroll
    for (int i = 0; i < MO_GK_AHEAD_BACK; i++) {
      a[(i + 1) % 2].load(left_at + (uint32_t)(i + 1) * 32,
                          width * 2); /* not used beyond the last */
      if (!FIRST || i >= before)
        a[i % 2].add(sums, ahead.w[i]);
      ahead.w[i] = load_tile(from, i < 4 ? then.x : then.y, i % 4);
    }
  }

  /* The addresses of tiles are known two rounds before they are multiplied, so that loads are not
   * delayed. */
  __device__ __forceinline__ void add_last(uint32_t pass, warp_sums<MT> &sums,
                                           weights_ahead<MO_GK_AHEAD_BACK> &ahead)
  {
    enum { N = MO_GK_AHEAD_BACK };
    const int before = lead();
    uint32_t left_at = left_address(outputs, width * 2, lane) - (uint32_t)before * 32;
    const uint2 *numbers = (const uint2 *)output_tile + 1;
    const uint4 *last = last_tiles(), *hidden = hidden_tiles(2);
    const int n = (before + n_outputs) / N;
    int round = 0;
    uint2 then = numbers[0];
    left_tile<MT> a[2];
    const int row = warp * 2 + lane / 16, part_of = lane % 16;
    const bool any = row < ROWS;
    output_copy copy = {
        shared_address(outputs + row * width) + (uint32_t)part_of * 16 - (uint32_t)before * 32,
        (uint4 *)(tape + output_at +
                  ((size_t)pass * TAPE_ROWS + group_row(row)) * (n_outputs * MO_GP_TILE * 2)) +
            part_of - 2 * before};
    a[0].load(left_at, width * 2);
    if (before > 0) {
      copy.read(any && part_of >= 2 * before);
      add_round<true>(sums, ahead, a, left_at, n > 1 ? last : hidden, then, before);
      copy.write(any && part_of >= 2 * before);
      left_at += N * 32;
      then = *++numbers;
      round++;
    }
#pragma unroll 1
    for (; round < n; round++) {
      const uint2 after = *++numbers;
      copy.read(any);
      add_round<false>(sums, ahead, a, left_at, round + 1 < n ? last : hidden, then, 0);
      copy.write(any);
      left_at += N * 32;
      then = after;
    }
  }

  /* `ahead` has the last layer's first weights. */
  __device__ __forceinline__ void control_back(uint32_t pass,
                                               weights_ahead<MO_GK_AHEAD_BACK> &ahead)
  {
    const uint32_t left_at = left_address(left, MO_GK_ROW * 2, lane);
    const int column = warp * 16 + 4 * (lane & 3);
    __half2 n[MT][2][2];
    float factors[MT][2];
    warp_sums<MT> sums;
    norm_columns columns;
    sums.clear();
    load_normal(2, pass, n, factors);
    add_last(pass, sums, ahead);
    columns.load(k.weights, 2, column);
    norm_relu_back(2, pass, sums, n, factors, columns);
#pragma unroll 1
    for (int layer = 2; layer > 0; layer--) {
      sums.clear();
      load_normal(layer - 1, pass, n, factors);
      add_sixteen<MT, true>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(layer),
                            hidden_tiles(layer - 1));
      columns.load(k.weights, layer - 1, column);
      norm_relu_back(layer - 1, pass, sums, n, factors, columns);
    }
    sums.clear();
    add_sixteen<MT, false>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(0), nullptr);
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

  /* Prefetches the data that the previous step will read and no later step has read: for a half,
   * its own masses, chunks and rows. */
  __device__ __forceinline__ void fetch_step(uint32_t step)
  {
    enum { ROW_BYTES = MO_HIDDEN * 2 };
    const uint32_t masses = 4 * n_masses, normals = TAPE_ROWS * ROW_BYTES;
    if (SHARE == 1) {
      fetch(tape + position_at + (size_t)step * 3 * masses, 3 * masses);
      fetch(tape + velocity_at + (size_t)step * 3 * masses, 3 * masses);
    } else {
#pragma unroll 1
      for (uint32_t axis = 0; axis < 3; axis++) {
        const size_t at = (size_t)(3 * step + axis) * masses + 4 * half_begin;
        fetch(tape + position_at + at, 4 * n_own);
        fetch(tape + velocity_at + at, 4 * n_own);
      }
    }
    const uint32_t pass = pass_of(step);
    if (ends_period(step))
      fetch(tape + activation_at + ((size_t)pass * n_chunks + block_chunk) * 64, 64 * block_chunks);
    if (blends(step))
      fetch(tape + activation_at + ((size_t)(pass - 1) * n_chunks + block_chunk) * 64,
            64 * block_chunks);
    if (!begins_period(step))
      return;
#pragma unroll 1
    for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
      const unsigned char *rows_at = tape + normal_at + l * layer_bytes + (size_t)pass * normals;
      if (SHARE == 1) {
        fetch(rows_at, normals);
      } else {
        fetch(rows_at + group_row(0) * ROW_BYTES, 8 * ROW_BYTES);
        fetch(rows_at + group_row(8) * ROW_BYTES, 8 * ROW_BYTES);
      }
    }
  }

  /* The same with the work at the starts of control periods, if tasks of the pair need it. */
  __device__ __forceinline__ void springs_and_work_back(uint32_t step)
  {
    const bool begins = step > 0 && begins_period(step);
    const uint32_t works = works_of(*this);
    if (works != 0 && begins)
      work_back<false>(*this, step, works, has_later(step, true));
    springs_back(step, works != 0);
    if (works != 0 && begins)
      work_back<true>(*this, step, works, SPLIT);
  }

  __device__ __forceinline__ void run()
  {
    const uint64_t state = 3 * (g.first_mass + group_first());
    float *own_gx = gx + 3 * first;
    const bool is_first = end_step == k.n_steps;
    for (uint32_t i = threadIdx.x; i < ROWS * width / 2; i += MO_GK_THREADS)
      ((uint32_t *)outputs)[i] = 0;
    if (is_first)
      for (int i = threadIdx.x; i < MT * MO_GP_NORM_FLOATS; i += MO_GK_THREADS)
        norm_sums[i] = 0;
    if (threadIdx.x < ROWS)
      failed[threadIdx.x] = 0;
#pragma unroll
    for (int r = 0; r < MT; r++) {
      const int row = own_row(r);
      const mo_gk_result &before = k.results[first_row + group_row(row)];
      excluded[r] = before.diverged || before.excluded || before.zeroed;
      if (lane == 0) {
        const double scale_m = k.rows[first_row + group_row(row)].goal.scale_m;
        const back_row now = {scale_m * scale_m, before.largest * before.largest,
                              before.steps,      before.clipped,
                              before.zeroed,     0};
        result[row] = now;
      }
    }
    __syncthreads();
    if (is_first)
      start();
    else
      for (int i = 3 * begin() + lane; i < 3 * end(); i += 32) {
        own_gx[i] = k.position[state + i];
        ((float *)(mass + first + i / 3))[3 + i % 3] = k.velocity[state + i];
      }
    __syncwarp();
    uint32_t inputs = 0;
#pragma unroll
    for (int i = 0; i < HELD; i++)
      if (lane_begin() + 32 * i < end())
        inputs |= (uint32_t)__ldg(input + lane_begin() + 32 * i) << 8 * i;
    for (uint32_t step = end_step; step-- > first_step;) {
      held h;
      forget();
      hold(step, h);
      if (step > 0)
        fetch_step(step - 1);
      else if (SPLIT)
        use_pull(true);
      move_back(step, h);
      if constexpr (TASKS)
        springs_and_work_back(step);
      else
        springs_back(step, false);
      if (!begins_period(step)) {
        kick_back(step);
        continue;
      }
      forget();
      weights_ahead<MO_GK_AHEAD_BACK> ahead;
      start_ahead(ahead);
      __syncthreads();
      fetch(k.springs + (g.first_chunk + block_chunk) * 32,
            128 * block_chunks); /* they may be evicted before the next step */
      control_back(pass_of(step), ahead);
      forget();
      sense_back(step, inputs);
    }
    for (int i = 3 * begin() + lane; i < 3 * end(); i += 32) {
      k.position[state + i] = own_gx[i];
      k.velocity[state + i] = ((const float *)(mass + first + i / 3))[3 + i % 3];
    }
    __syncthreads();
#pragma unroll
    for (int r = 0; r < MT; r++)
      if (lane == 0) {
        const int row = own_row(r);
        mo_gk_result &after = k.results[first_row + group_row(row)];
        after.largest = sqrt(result[row].largest);
        after.steps = result[row].steps;
        after.clipped = result[row].clipped;
        after.zeroed = result[row].zeroed || (failed[row] && !excluded[r]);
      }
  }
};

extern "C" int mo_gk_open_back(uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  return way_kernels<back>::open(block_bytes, dynamic_bytes);
}

extern "C" int mo_gk_back(const struct mo_gk *k, uint32_t shared_bytes, void *stream)
{
  return way_kernels<back>::launch(k, shared_bytes, stream);
}
