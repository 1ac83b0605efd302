/* gradient_products.cu: the parameters' gradient as products over rows × passes of the network, its
 * sum over a shard's groups, and weights as tiles.
 *
 * A block computes 128 × 256 numbers of one matrix of one group: ∂loss/∂(sums of the layer)ᵀ times
 * the inputs of the layer, over all rows of the group and the launch's passes in order, and times
 * ones, which yields the sums for biases; the launches are also added in order, and the groups in
 * collect_kernel. So no sum depends on other groups or on the device. */
#include "compute/cuda/gradient_products.cuh"

enum {
  DEPTH = 32, /* rows × passes at a time */
  LEFT = MO_GK_JOB_COLUMNS,
  RIGHT = MO_HIDDEN,
  LEFT_ROW = LEFT + 8,
  RIGHT_ROW = RIGHT + 8,
  STAGES = 4,
  STAGE_BYTES = DEPTH * (LEFT_ROW + RIGHT_ROW) * 2,
  THREADS = 512
};
static_assert(DEPTH * LEFT == THREADS * 8 && DEPTH * RIGHT == 2 * THREADS * 8,
              "a thread copies three times 16 bytes of a stage");

/* The copies of a thread, stage by stage: 16 bytes of the left operand, and 16 bytes in each of two
 * rows of the right one. */
struct copies {
  const __nv_bfloat16 *left, *right;
  uint32_t left_to, right_to;
  int left_step, left_rows, right_rows; /* rows: remaining ones */
  bool left_there;

  __device__ __forceinline__ explicit copies(const operands &o)
  {
    const int row = (int)threadIdx.x / (LEFT / 8), column = (int)threadIdx.x % (LEFT / 8) * 8;
    left_there = column < o.left_columns;
    left = o.left + (size_t)row * o.left_row + (left_there ? column : 0);
    left_to = (uint32_t)(row * LEFT_ROW + column) * 2;
    left_step = DEPTH * o.left_row;
    left_rows = o.depth - row;
    const int right_at = (int)threadIdx.x / (RIGHT / 8),
              right_column = (int)threadIdx.x % (RIGHT / 8) * 8;
    right = o.right + (size_t)right_at * RIGHT + right_column;
    right_to = (uint32_t)(DEPTH * LEFT_ROW + right_at * RIGHT_ROW + right_column) * 2;
    right_rows = o.depth - right_at;
  }

  /* Rows beyond the last are filled with zeros, without reading anything. */
  __device__ __forceinline__ void next(uint32_t stage)
  {
    copy_ahead(stage + left_to, left, left_there && left_rows > 0);
    copy_ahead(stage + right_to, right, right_rows > 0);
    copy_ahead(stage + right_to + DEPTH / 2 * RIGHT_ROW * 2, right + DEPTH / 2 * RIGHT,
               right_rows > DEPTH / 2);
    left += left_step;
    right += DEPTH * RIGHT;
    left_rows -= DEPTH;
    right_rows -= DEPTH;
  }
};

static __global__ void __launch_bounds__(THREADS, 1)
    products_kernel(const __grid_constant__ mo_gk k, const uint32_t *jobs, uint32_t first,
                    uint32_t end)
{
  extern __shared__ __align__(16) unsigned char shared[];
  if (*k.cancel != 0)
    return;
  const operands o = operands_of(k, jobs[blockIdx.x], first, end);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, m0 = (warp & 3) * 32,
            n0 = (warp >> 2) * 64;
  const bool idle = m0 >= o.left_columns;
  const uint32_t base = shared_address(shared);
  const uint32_t left_at =
      (uint32_t)(((lane & 7) + (lane >> 4) * 8) * LEFT_ROW + m0 + ((lane >> 3) & 1) * 8) * 2;
  const uint32_t right_at =
      (uint32_t)(DEPTH * LEFT_ROW + ((lane & 7) + ((lane >> 3) & 1) * 8) * RIGHT_ROW + n0 +
                 (lane >> 4) * 8) *
      2;
  float c[2][8][4], sums[2][4] = {};
#pragma unroll
  for (int i = 0; i < 2; i++)
#pragma unroll
    for (int j = 0; j < 8; j++)
#pragma unroll
      for (int l = 0; l < 4; l++)
        c[i][j][l] = 0;
  const int n = (o.depth + DEPTH - 1) / DEPTH;
  copies ahead(o);
#pragma unroll
  for (int i = 0; i < STAGES - 1; i++) {
    if (i < n)
      ahead.next(base + i * STAGE_BYTES);
    asm volatile("cp.async.commit_group;");
  }
  for (int i = 0; i < n; i++) {
    asm volatile("cp.async.wait_group %0;" ::"n"(STAGES - 2));
    __syncthreads();
    if (i + STAGES - 1 < n)
      ahead.next(base + (uint32_t)((i + STAGES - 1) % STAGES) * STAGE_BYTES);
    asm volatile("cp.async.commit_group;");
    if (idle)
      continue;
    const uint32_t stage = base + (uint32_t)(i % STAGES) * STAGE_BYTES;
#pragma unroll
    for (int d = 0; d < DEPTH; d += 16) {
      uint32_t a[2][4], b[4][4];
#pragma unroll
      for (int m = 0; m < 2; m++)
        load_matrices_transposed(a[m], stage + left_at + (uint32_t)(d * LEFT_ROW + m * 16) * 2);
#pragma unroll
      for (int j = 0; j < 4; j++)
        load_matrices_transposed(b[j], stage + right_at + (uint32_t)(d * RIGHT_ROW + j * 16) * 2);
#pragma unroll
      for (int m = 0; m < 2; m++)
#pragma unroll
        for (int j = 0; j < 4; j++) {
          multiply<true>(c[m][2 * j], a[m], b[j][0], b[j][1]);
          multiply<true>(c[m][2 * j + 1], a[m], b[j][2], b[j][3]);
        }
      if (n0 == 0) {
#pragma unroll
        for (int m = 0; m < 2; m++)
          multiply<true>(sums[m], a[m], ONES, ONES);
      }
    }
  }
  if (idle)
    return;
#pragma unroll
  for (int m = 0; m < 2; m++)
#pragma unroll
    for (int h = 0; h < 2; h++)
      if (n0 == 0 && (lane & 3) == 0)
        add_bias(o, m0 + m * 16 + h * 8 + (lane >> 2), first == 0, sums[m][2 * h]);
#pragma unroll
  for (int m = 0; m < 2; m++)
#pragma unroll
    for (int j = 0; j < 8; j++)
#pragma unroll
      for (int h = 0; h < 2; h++)
        add_pair(o, m0 + m * 16 + h * 8 + (lane >> 2), n0 + j * 8 + 2 * (lane & 3), first == 0,
                 c[m][j][2 * h], c[m][j][2 * h + 1]);
}

/* ---- over a shard's groups ---- */

static __device__ double of_group(const mo_gp_group &g, const float *sums, uint32_t i)
{
  const mo_gp_sum sum = mo_gp_sum_of(&g);
  const float *from = sums + g.sum_at;
  enum { INPUTS = MO_DEFAULT_MASSES + MO_CPG_INPUTS, SQUARE = MO_HIDDEN * MO_HIDDEN };
  if (i < MO_HIDDEN * INPUTS) {
    return from[sum.input + i / INPUTS * MO_GP_INPUTS + i % INPUTS];
  }
  i -= MO_HIDDEN * INPUTS;
  for (int layer = 0; layer < MO_HIDDEN_LAYERS; layer++) {
    if (layer > 0) {
      if (i < SQUARE)
        return from[sum.hidden[layer - 1] + i];
      i -= SQUARE;
    }
    if (i < MO_HIDDEN)
      return from[sum.bias + layer * MO_HIDDEN + i];
    i -= MO_HIDDEN;
    if (i < 2 * MO_HIDDEN) {
      const float *at = from + sum.norm + layer * 2 * MO_HIDDEN + i;
      return g.n_rows > MO_GP_HALF_ROWS ? (double)at[0] + at[MO_GP_NORM_FLOATS] : at[0];
    }
    i -= 2 * MO_HIDDEN;
  }
  const bool is_bias = i >= MO_DEFAULT_SPRINGS * MO_HIDDEN;
  const uint32_t spring = is_bias ? i - MO_DEFAULT_SPRINGS * MO_HIDDEN : i / MO_HIDDEN,
                 column = i % MO_HIDDEN;
  const uint32_t place = g.output_place[spring / MO_GP_TILE];
  if (place == MO_GP_NONE)
    return 0;
  const uint32_t at = place * MO_GP_TILE + spring % MO_GP_TILE;
  return is_bias ? from[sum.output_bias + at] : from[sum.output + at * MO_HIDDEN + column];
}

static __global__ void collect_kernel(const mo_gp_group *groups, const float *sums,
                                      const uint32_t *shard_groups, double weight,
                                      uint32_t n_parameters, float *d_parameters)
{
  const uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= n_parameters)
    return;
  double sum = 0;
  for (uint32_t g = shard_groups[blockIdx.y]; g < shard_groups[blockIdx.y + 1]; g++)
    sum += of_group(groups[g], sums, i);
  d_parameters[(size_t)blockIdx.y * n_parameters + i] = (float)(sum * weight);
}

/* ---- weights ---- */

/* Returns an element of a matrix (n_out, n_in), 0 beyond it. */
static __device__ __forceinline__ float at(const float *w, uint32_t n_out, uint32_t n_in,
                                           uint32_t out, uint32_t in)
{
  return out < n_out && in < n_in ? w[out * n_in + in] : 0.0f;
}

static __device__ __forceinline__ uint32_t pair_half(float a, float b)
{
  const __half2 h = __floats2half2_rn(a, b);
  return *(const uint32_t *)&h;
}

static __device__ __forceinline__ uint32_t pair_bfloat(float a, float b)
{
  const __nv_bfloat162 h = __floats2bfloat162_rn(a, b);
  return *(const uint32_t *)&h;
}

/* Packs a matrix, with one thread per lane of a tile, forward and back. */
static __global__ void pack_kernel(const float *w, uint32_t n_out, uint32_t n_in,
                                   uint32_t out_tiles, uint32_t in_tiles, uint4 *forward,
                                   uint4 *back)
{
  const uint32_t i = blockIdx.x * blockDim.x + threadIdx.x, lane = i % 32, tile = i / 32;
  if (tile >= out_tiles * in_tiles)
    return;
  const uint32_t out = tile / in_tiles * 16, in = tile % in_tiles * 16, g = lane / 4,
                 t = lane % 4 * 2;
  uint32_t f[4], b[4];
  for (uint32_t k = 0; k < 4; k++) {
    const uint32_t n = g / 2 * 4 + k / 2 * 2 + g % 2, m = k % 2 * 8 + t; /* see warp_sums */
    f[k] = pair_half(at(w, n_out, n_in, out + n, in + m), at(w, n_out, n_in, out + n, in + m + 1));
    b[k] =
        pair_bfloat(at(w, n_out, n_in, out + m, in + n), at(w, n_out, n_in, out + m + 1, in + n));
  }
  forward[i] = make_uint4(f[0], f[1], f[2], f[3]);
  back[((in / 16) * out_tiles + out / 16) * 32 + lane] = make_uint4(b[0], b[1], b[2], b[3]);
}

static __global__ void copy_kernel(const float *from, float *to, uint32_t n)
{
  for (uint32_t i = threadIdx.x; i < n; i += blockDim.x)
    to[i] = from[i];
}

extern "C" int mo_gk_pack(const float *parameters, const struct mo_gk_weights *w, void *stream)
{
  const cudaStream_t s = (cudaStream_t)stream;
  const float *from = parameters;
  for (int layer = 0; layer <= MO_HIDDEN_LAYERS; layer++) {
    const uint32_t n_in = layer == 0 ? MO_DEFAULT_MASSES + MO_CPG_INPUTS : MO_HIDDEN;
    const uint32_t n_out = layer < MO_HIDDEN_LAYERS ? MO_HIDDEN : MO_DEFAULT_SPRINGS,
                   out_tiles = (n_out + 15) / 16;
    pack_kernel<<<(out_tiles * 16 * 32 + 255) / 256, 256, 0, s>>>(
        from, n_out, n_in, out_tiles, 16, w->forward[layer], w->back[layer]);
    from += n_out * n_in;
    copy_kernel<<<1, 256, 0, s>>>(from, w->bias[layer], n_out);
    from += n_out;
    if (layer < MO_HIDDEN_LAYERS) {
      copy_kernel<<<1, 256, 0, s>>>(from, w->gain[layer], MO_HIDDEN);
      copy_kernel<<<1, 256, 0, s>>>(from + MO_HIDDEN, w->shift[layer], MO_HIDDEN);
      from += 2 * MO_HIDDEN;
    }
  }
  return (int)cudaGetLastError();
}

/* Sets *wide to whether the current device has the features that the wide kernel needs: only
 * capability 9.0 has them, later ones do not. */
static cudaError_t has_wide(bool *wide)
{
  int device = 0, major = 0, minor = 0;
  cudaError_t status = cudaGetDevice(&device);
  if (status == cudaSuccess)
    status = cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device);
  if (status == cudaSuccess)
    status = cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device);
  *wide = major == 9 && minor == 0;
  return status;
}

extern "C" int mo_gk_open_products(uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  bool wide = false;
  const cudaError_t status = has_wide(&wide);
  if (status != cudaSuccess)
    return (int)status;
  return wide ? allow_shared(wide_products_kernel, block_bytes, dynamic_bytes)
              : allow_shared(products_kernel, block_bytes, dynamic_bytes);
}

extern "C" int mo_gk_products(const struct mo_gk *k, const uint32_t *jobs, uint32_t n,
                              uint32_t first, uint32_t end, void *stream)
{
  bool wide = false;
  const cudaError_t status = has_wide(&wide);
  if (status != cudaSuccess)
    return (int)status;
  if (wide)
    wide_products_kernel<<<n, WIDE_THREADS, WIDE_SHARED, (cudaStream_t)stream>>>(*k, jobs, first,
                                                                                 end);
  else
    products_kernel<<<n, THREADS, STAGES * STAGE_BYTES, (cudaStream_t)stream>>>(*k, jobs, first,
                                                                                end);
  return (int)cudaGetLastError();
}

extern "C" int mo_gk_collect(const struct mo_gk *k, const uint32_t *shard_groups, uint32_t n_shards,
                             double weight, float *d_parameters, void *stream)
{
  const uint32_t n = MO_HIDDEN * (MO_DEFAULT_MASSES + MO_CPG_INPUTS) + 2 * MO_HIDDEN * MO_HIDDEN +
                     9 * MO_HIDDEN + MO_DEFAULT_SPRINGS * (MO_HIDDEN + 1);
  collect_kernel<<<dim3((n + 255) / 256, n_shards), 256, 0, (cudaStream_t)stream>>>(
      k->groups, k->sums, shard_groups, weight, n, d_parameters);
  return (int)cudaGetLastError();
}
