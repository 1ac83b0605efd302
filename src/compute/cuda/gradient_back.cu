/* gradient_back.cu: the way back through physics, sensors and network, from a launch's last step to its first. Leaves ∂loss/∂ what each layer
 * sums for the products that give the parameters' gradient. A row whose adjoint is not finite becomes zeros from there on and is reported; the
 * host then walks back again without it, so that nothing of it is left in the sums. */
#include "compute/cuda/gradient_back.cuh"
#include "compute/cuda/gradient_back_physics.cuh"

/* ∂loss/∂ outputs on their way to the tape: of each eight tiles, sixteen bytes for each thread. */
struct output_copy {
  uint4 *to;
  uint4 eight;

  __device__ __forceinline__ void read(bool any, uint32_t from)
  {
    if (any)
      asm volatile("ld.shared.v4.u32 {%0,%1,%2,%3}, [%4];"
                   : "=r"(eight.x), "=r"(eight.y), "=r"(eight.z), "=r"(eight.w)
                   : "r"(from));
  }
  __device__ __forceinline__ void write(bool any)
  {
    if (any)
      __stcs(to, eight);
    to += 16;
  }
};

/* Their sums over rows: products with ones, of each sixteenth tile. */
template <int MT> __device__ __forceinline__ void back<MT>::sum_outputs() const
{
  const uint32_t ones = 0x3f803f80, from = shared_address(outputs);
  float *to = output_sums + (lane >> 2);
#pragma unroll 1
  for (int tile = warp; tile < n_outputs; tile += MO_GP_WARPS) {
    float sum[4] = {0, 0, 0, 0};
#pragma unroll
    for (int m = 0; m < MT; m++) {
      uint32_t a[4];
      load_matrices_transposed(a, from + (uint32_t)((lane & 7) + (lane >> 4) * 8 + m * 16) * output_row_bytes() +
                                      (uint32_t)(2 * tile + (lane >> 3 & 1)) * 16);
      multiply<true>(sum, a, ones, ones);
    }
    if ((lane & 3) == 0) {
      atomicAdd(to + tile * MO_GP_TILE, sum[0]);
      atomicAdd(to + tile * MO_GP_TILE + 8, sum[2]);
    }
  }
}

template <int MT>
__device__ __forceinline__ void back<MT>::load_normal(int layer, uint32_t step, __half2 (&n)[2 * MT][2],
                                                      float (&factor)[2 * MT])
{
  const int quad = warp * 4 + (lane & 3);
  const uint2 *normal = (const uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
  const float *scale = (const float *)(tape + scale_at) + ((size_t)step * MO_HIDDEN_LAYERS + layer) * ROWS;
#pragma unroll
  for (int i = 0; i < 2 * MT; i++) {
    const int row = 8 * i + (lane >> 2);
    uint2 two;
    asm volatile("ld.global.cs.v2.u32 {%0, %1}, [%2];"
                 : "=r"(two.x), "=r"(two.y)
                 : "l"(normal + row * (MO_HIDDEN / 4) + quad));
    asm volatile("ld.global.nc.f32 %0, [%1];" : "=f"(factor[i]) : "l"(scale + row));
    n[i][0] = *(const __half2 *)&two.x;
    n[i][1] = *(const __half2 *)&two.y;
  }
}

/* sums: ∂loss/∂ what ReLU gave. Leaves ∂loss/∂ what the layer summed in `left`, and on the tape where n was. */
template <int MT>
__device__ __forceinline__ void back<MT>::norm_relu_back(int layer, uint32_t step, float (&sums)[2 * MT][4],
                                                         const __half2 (&n)[2 * MT][2], const float (&factors)[2 * MT],
                                                         const norm_columns &columns)
{
  const int column = warp * 16 + 4 * (lane & 3);
  uint2 *dense = (uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
  const float gain[4] = {columns.gain[0].x, columns.gain[0].y, columns.gain[1].x, columns.gain[1].y};
  const float shift[4] = {columns.shift[0].x, columns.shift[0].y, columns.shift[1].x, columns.shift[1].y};
  float2 s[MT][2];
  float d_shift[4], d_gain[4], d_bias[4];
  float *bias = norms + layer * 3 * MO_HIDDEN + column, *gain_sum = bias + MO_HIDDEN, *shift_sum = gain_sum + MO_HIDDEN;
#pragma unroll
  for (int i = 0; i < 2 * MT; i++) {
    const float2 low = __half22float2(n[i][0]), high = __half22float2(n[i][1]);
    const float at[4] = {low.x, low.y, high.x, high.y};
#pragma unroll
    for (int j = 0; j < 4; j++) {
      const float d = fmaf(at[j], gain[j], shift[j]) > 0 ? sums[i][j] : 0.0f;
      d_shift[j] = i == 0 ? d : d_shift[j] + d;
      d_gain[j] = i == 0 ? d * at[j] : fmaf(d, at[j], d_gain[j]);
      sums[i][j] = d * gain[j];
    }
    const float(&e)[4] = sums[i];
    s[i / 2][i % 2] =
        make_float2((e[0] + e[1]) + (e[2] + e[3]), fmaf(e[0], at[0], e[1] * at[1]) + fmaf(e[2], at[2], e[3] * at[3]));
  }
  add_columns(shift_sum, d_shift);
  add_columns(gain_sum, d_gain);
  sum_rows<MT>(part, warp, lane, s);
  uint2 both[2 * MT];
#pragma unroll
  for (int i = 0; i < 2 * MT; i++) {
    const int row = 8 * i + (lane >> 2);
    const float2 low = __half22float2(n[i][0]), high = __half22float2(n[i][1]);
    const float at[4] = {low.x, low.y, high.x, high.y};
    const float mean = s[i / 2][i % 2].x * (1.0f / MO_HIDDEN), along = s[i / 2][i % 2].y * (1.0f / MO_HIDDEN);
    float d[4];
    bool sound = true;
#pragma unroll
    for (int j = 0; j < 4; j++) {
      d[j] = factors[i] * (sums[i][j] - fmaf(at[j], along, mean));
      sound = sound && fabsf(d[j]) <= MO_GK_LARGE;
      d_bias[j] = i == 0 ? d[j] : d_bias[j] + d[j];
    }
    if (!sound)
      failed[row] = 1;
    both[i] = four(__floats2bfloat162_rn(d[0], d[1]), __floats2bfloat162_rn(d[2], d[3]));
    *(uint2 *)(left + left_place(row, column)) = both[i];
  }
#pragma unroll
  for (int i = 0; i < 2 * MT; i++)
    __stcs(dense + (8 * i + (lane >> 2)) * (MO_HIDDEN / 4) + (column >> 2), both[i]);
  add_columns(bias, d_bias);
  __syncthreads();
}

/* As load_weights, and where it is written: the compiler would put loads last, to have their registers for something else. */
static __device__ __forceinline__ uint4 load_weights_here(const uint4 *p)
{
  uint4 w;
  asm volatile("ld.global.L1::no_allocate.v4.u32 {%0,%1,%2,%3}, [%4];"
               : "=r"(w.x), "=r"(w.y), "=r"(w.z), "=r"(w.w)
               : "l"(p));
  __syncwarp();
  return w;
}

/* A product in the making: this warp's sixteen columns for all rows, eight tiles of weights at a time. */
template <int MT> struct eight_tiles {
  warp_sums<MT> sums;
  uint32_t a[2][MT][4]; /* adjoints, a tile ahead */
  uint32_t from, row_bytes;
  int tile; /* the next; those below 0 have weights 0, and are multiplied with tile 0's adjoints */

  __device__ __forceinline__ void fetch(int which, int next)
  {
    const uint32_t at = from + (uint32_t)max(next, 0) * 32;
#pragma unroll
    for (int m = 0; m < MT; m++)
      load_matrices(a[which][m], at + (uint32_t)m * 16 * row_bytes);
    __syncwarp(); /* as load_weights_here */
  }

  __device__ __forceinline__ void begin(const unsigned char *adjoints, uint32_t bytes, int first, int lane)
  {
    row_bytes = bytes;
    from = left_address(adjoints, bytes, lane);
    tile = first;
    sums.clear();
    fetch(0, tile);
  }

  /* The next eight, whose weights the ring has; each gives way to what load(i) gives when it has been multiplied. */
  template <class Load> __device__ __forceinline__ void add(weights_ahead<MO_GK_AHEAD_BACK> &ahead, Load load)
  {
#pragma unroll
    for (int i = 0; i < 8; i++) {
      fetch((i + 1) % 2, tile + i + 1); /* beyond the last: not used */
#pragma unroll
      for (int m = 0; m < MT; m++) {
        multiply<true>(sums.c[m][0], a[i % 2][m], ahead.w[i].x, ahead.w[i].y);
        multiply<true>(sums.c[m][1], a[i % 2][m], ahead.w[i].z, ahead.w[i].w);
      }
      ahead.w[i] = load(i);
    }
    tile += 8;
  }

  /* Row by row: a lane's i-th row is 8 i + lane/4. */
  __device__ __forceinline__ void end(float (&to)[2 * MT][4]) const
  {
#pragma unroll
    for (int i = 0; i < 2 * MT; i++)
#pragma unroll
      for (int j = 0; j < 4; j++)
        to[i][j] = sums.c[i / 2][j / 2][2 * (i % 2) + j % 2];
  }
};
static_assert(MO_GK_AHEAD_BACK == 8, "the ring has the eight tiles that are multiplied at a time");

/* The tile whose number is the k-th byte of `four`. */
static __device__ __forceinline__ uint4 load_tile(const uint4 *from, uint32_t four, int k)
{
  return load_weights_here((const uint4 *)((const char *)from + (uint64_t)__byte_perm(four, 0, 0x4440 + k) * 512));
}

/* Where the tiles are is known two rounds before they are multiplied, so that nothing keeps a load from its place. */
template <int MT>
__device__ __forceinline__ void back<MT>::add_last(uint32_t step, float (&sums)[2 * MT][4],
                                                   weights_ahead<MO_GK_AHEAD_BACK> &ahead)
{
  const int before = lead(), n = (before + n_outputs) / MO_GK_AHEAD_BACK;
  const uint2 *numbers = (const uint2 *)output_tile + 1;
  const uint4 *last = last_tiles(), *hidden = hidden_tiles(2);
  const int row = warp * 2 + lane / 16, part_of = lane % 16 - 2 * before;
  const bool any = row < ROWS;
  const uint32_t from = shared_address(outputs);
  output_copy copy;
  copy.to = (uint4 *)(tape + output_at + ((size_t)step * ROWS + row) * (n_outputs * MO_GP_TILE * 2)) + part_of;
  eight_tiles<MT> product;
  product.begin(outputs, output_row_bytes(), -before, lane);
  uint2 then = numbers[0];
#pragma unroll 1
  for (int round = 0; round < n; round++) {
    const uint2 after = *++numbers;
    const uint4 *next = round + 1 < n ? last : hidden;
    const int piece = part_of + 16 * round;
    copy.read(any && piece >= 0, from + (uint32_t)row * output_row_bytes() + (uint32_t)(piece * 16));
    product.add(ahead, [&](int i) { return load_tile(next, i < 4 ? then.x : then.y, i % 4); });
    copy.write(any && piece >= 0);
    then = after;
  }
  product.end(sums);
}

/* A hidden layer, half of whose weights the ring has; it ends with what next(i) gives. */
template <int MT>
template <class Next>
__device__ __forceinline__ void back<MT>::add_sixteen(int layer, float (&sums)[2 * MT][4],
                                                      weights_ahead<MO_GK_AHEAD_BACK> &ahead, Next next)
{
  const uint4 *rest = hidden_tiles(layer) + MO_GK_AHEAD_BACK * 32;
  eight_tiles<MT> product;
  product.begin(left, MO_GK_ROW * 2, 0, lane);
  product.add(ahead, [&](int i) { return load_weights_here(rest + i * 32); });
  product.add(ahead, next);
  product.end(sums);
}

/* `ahead` has the last layer's first weights. */
template <int MT>
__device__ __forceinline__ void back<MT>::control_back(uint32_t step, weights_ahead<MO_GK_AHEAD_BACK> &ahead)
{
  const int column = warp * 16 + 4 * (lane & 3);
  __half2 n[2 * MT][2];
  float factors[2 * MT];
  float sums[2 * MT][4];
  norm_columns columns;
  sum_outputs();
  load_normal(2, step, n, factors);
  add_last(step, sums, ahead);
  columns.load(k.weights, 2, column);
  norm_relu_back(2, step, sums, n, factors, columns);
#pragma unroll 1
  for (int layer = 2; layer > 0; layer--) {
    const uint4 *next = hidden_tiles(layer - 1);
    load_normal(layer - 1, step, n, factors);
    add_sixteen(layer, sums, ahead, [&](int i) { return load_weights_here(next + i * 32); });
    columns.load(k.weights, layer - 1, column);
    norm_relu_back(layer - 1, step, sums, n, factors, columns);
  }
  add_sixteen(0, sums, ahead, [](int) { return make_uint4(0, 0, 0, 0); });
  __syncthreads();
#pragma unroll
  for (int i = 0; i < 2 * MT; i++)
    *(uint2 *)(left + left_place(8 * i + (lane >> 2), column)) =
        four(__floats2bfloat162_rn(sums[i][0], sums[i][1]), __floats2bfloat162_rn(sums[i][2], sums[i][3]));
  __syncthreads();
}

/* What the step before this one will read. */
template <int MT> __device__ __forceinline__ void back<MT>::fetch_step(uint32_t step)
{
  const uint32_t masses = 12 * n_masses, chunks = 64 * n_chunks, normals = ROWS * MO_HIDDEN * 2;
  fetch(tape + position_at + (size_t)step * masses, masses);
  fetch(tape + velocity_at + (size_t)step * masses, masses);
  fetch(tape + activation_at + (size_t)step * chunks, chunks);
#pragma unroll 1
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    fetch(tape + normal_at + l * layer_bytes + (size_t)step * normals, normals);
}

template <int MT> __device__ __forceinline__ void back<MT>::run()
{
  const int n = 3 * (n0 + n1);
  const uint64_t state = 3 * (g.first_mass + first);
  float *own_gx = gx + 3 * first;
  const bool is_first = end_step == k.n_steps;
  for (uint32_t i = threadIdx.x; i < ROWS * output_row_bytes() / 4; i += MO_GK_THREADS)
    ((uint32_t *)outputs)[i] = 0;
  for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
    norms[i] = 0;
  if (is_first)
    for (int i = threadIdx.x; i < n_outputs * MO_GP_TILE; i += MO_GK_THREADS)
      output_sums[i] = 0;
  if (threadIdx.x < ROWS)
    failed[threadIdx.x] = 0;
#pragma unroll
  for (int r = 0; r < MT; r++) {
    const mo_gk_result &before = k.results[first_row + warp + 16 * r];
    excluded[r] = before.diverged || before.excluded || before.zeroed;
    if (lane == 0) {
      const double start_m = k.rows[first_row + warp + 16 * r].start_m;
      const back_row now = {
          start_m * start_m, before.largest * before.largest, before.steps, before.clipped, before.zeroed, 0};
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
  uint32_t inputs = 0;
#pragma unroll
  for (int i = 0; i < HELD; i++)
    if (lane + 32 * i < n0 + n1)
      inputs |= (uint32_t)__ldg(input + lane + 32 * i) << 8 * i;
  for (uint32_t step = end_step; step-- > first_step;) {
    held h;
    forget();
    hold(step, h);
    if (step > 0)
      fetch_step(step - 1);
    move_back(step, h);
    springs_back(step);
    forget();
    weights_ahead<MO_GK_AHEAD_BACK> ahead;
    start_ahead(ahead);
    __syncthreads();
    fetch(k.springs + g.first_chunk * 32, 128 * n_chunks); /* they may be gone until the next step */
    control_back(step, ahead);
    forget();
    sense_back(inputs);
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
      after.largest = sqrt(result[row].largest);
      after.steps = result[row].steps;
      after.clipped = result[row].clipped;
      after.zeroed = result[row].zeroed || (failed[row] && !excluded[r]);
    }
  const mo_gp_sum place = mo_gp_sum_of(&g);
  float *sums = k.sums + g.sum_at;
  __syncthreads();
  for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
    sums[place.bias[0] + i] = norms[i] + (is_first ? 0.0f : sums[place.bias[0] + i]);
}

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

extern "C" int mo_gk_open_back(uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  return allow_shared(back_kernel, block_bytes, dynamic_bytes);
}

extern "C" int mo_gk_back(const struct mo_gk *k, uint32_t shared_bytes, void *stream)
{
  const uint32_t blocks = (k->n_steps + k->part_steps - 1) / k->part_steps * k->n_groups;
  back_kernel<<<blocks, MO_GK_THREADS, shared_bytes, (cudaStream_t)stream>>>(*k);
  return (int)cudaGetLastError();
}
