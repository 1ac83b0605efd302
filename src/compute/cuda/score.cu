/* score.cu: whole rollouts in one kernel.
 *
 * A block of 256 threads takes a group of rows and lives its lives from the first step to the last, then takes the next group. Positions and
 * activations stay in shared memory; velocities and the springs' lengths are the block's own in global memory, and seldom leave the
 * caches. Two blocks share a multiprocessor, so that one's physics runs beside the other's products. A step:
 *   sense    sixteen lanes per row: the light's mean, then the inputs of the first layer
 *   think    three hidden layers (network.cuh), then tiles of springs: the length that each wants to have
 *   pull     a thread per mass and row adds its springs up, each seen from both of its ends: no two threads write one number
 *   move     the same thread moves the mass
 * A row's numbers come from its own inputs in a fixed order, wherever it stands. */
#include "compute/cuda/network.cuh"
#include "compute/cuda/score.cuh"

namespace {

constexpr uint32_t kRows = MO_PLAN_ROWS_MAX, kSpringSlots = MO_DEFAULT_SPRINGS;
constexpr uint32_t kChunks = 352; /* of 32 places: more than fit the shared memory */
constexpr uint32_t kCancelSteps = 16;
constexpr unsigned kAll = 0xffffffffu;

/* A part of the group, as the physics reads it. */
struct Part {
  uint32_t first_place, n_rows, n_masses, first_quad, first_mass, first_row;
  float per_row; /* 1 / n_rows */
};

struct Row {
  uint32_t first_place, stride; /* place of mass m: first_place + m · stride */
  uint32_t n_masses, body, part;
};

struct Shared {
  float first[MO_HIDDEN]; /* what the first layer's sums start from */
  float2 partial[MO_CUDA_WARPS * kRows];
  float4 light[kRows]; /* and the terrain's highest point */
  float com[2][kRows][3]; /* at the start of even and odd steps */
  Part parts[kRows];
  Row rows[kRows];
  const mo_cuda_cell *cells[kRows];
  uint32_t chunks[kChunks]; /* part << 16 | number */
  int insane[kRows], diverged[kRows];
  uint32_t n_chunks, group;
  uint32_t input_units; /* bits: units of the first layer that may not be 0 */
  int cancelled;
  mo_plan_group plan;
};

constexpr size_t kSharedBytes = (sizeof(Shared) + 127) / 128 * 128;

/* ---- the beginning of a life, in float64 as rollout/scene.c has it ---- */

struct Corner {
  int cell;
  double fraction;
};

__device__ Corner corner_of(double coordinate_m)
{
  Corner corner = {0, 0.0};
  if (coordinate_m > MO_TERRAIN_SIZE_M) {
    corner.cell = MO_TERRAIN_SIDE - 2;
    corner.fraction = 1.0;
  } else if (coordinate_m >= 0.0) {
    const double cells = coordinate_m * ((MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M);
    corner.cell = cells < MO_TERRAIN_SIDE - 1 ? (int)cells : MO_TERRAIN_SIDE - 2;
    corner.fraction = cells - corner.cell;
  }
  return corner;
}

__device__ double terrain_height(const double *heights, double x_m, double y_m)
{
  const Corner x = corner_of(x_m), y = corner_of(y_m);
  const double *corner = heights + y.cell * MO_TERRAIN_SIDE + x.cell;
  const double near = corner[0] + x.fraction * (corner[1] - corner[0]);
  const double far = corner[MO_TERRAIN_SIDE] + x.fraction * (corner[MO_TERRAIN_SIDE + 1] - corner[MO_TERRAIN_SIDE]);
  return near + y.fraction * (far - near);
}

__global__ void prepare_environments(const double *heights, mo_cuda_environment *environments, uint32_t n)
{
  const uint32_t e = blockIdx.x;
  if (e >= n)
    return;
  const double *in = heights + (size_t)e * MO_PLAN_ENVIRONMENT_DOUBLES;
  mo_cuda_environment *out = environments + e;
  for (int k = (int)threadIdx.x; k < MO_CUDA_CELLS; k += (int)blockDim.x)
    out->cells[k] = mo_cuda_cell_of(in + 2, k % MO_CUDA_CELLS_SIDE - 1, k / MO_CUDA_CELLS_SIDE - 1);
  if (threadIdx.x == 0) {
    double top = in[2];
    for (int k = 1; k < MO_TERRAIN_HEIGHTS; k++)
      top = fmax(top, in[2 + k]);
    out->light[0] = (float)(in[0] - MO_WORLD_CENTRE_M);
    out->light[1] = (float)(in[1] - MO_WORLD_CENTRE_M);
    out->light[2] = (float)terrain_height(in + 2, in[0], in[1]);
    /* A little above, so that rounding in the polynomials never counts. */
    out->highest = (float)(top + 1e-6 * (1.0 + fabs(top)));
  }
}

/* Where along an axis a mass starts. */
__device__ double start_of(uint32_t cell, int side)
{
  return MO_WORLD_CENTRE_M - 0.5 * MO_VOXEL_M * side + MO_VOXEL_M * cell;
}

/* A warp places one row. */
__device__ void place_row(const mo_cuda_score &score, const Shared &shared, uint32_t r, float *position, uint32_t lane)
{
  const Row row = shared.rows[r];
  const Part &part = shared.parts[row.part];
  const mo_plan_row plan = score.rows[shared.plan.first_row + r];
  const uint32_t *masses = score.masses + part.first_mass;
  const double *heights = score.heights + (size_t)plan.environment * MO_PLAN_ENVIRONMENT_DOUBLES + 2;
  uint32_t lowest = 255;
  for (uint32_t m = lane; m < row.n_masses; m += 32)
    lowest = min(lowest, MO_PLAN_MASS_Z(masses[m]));
  lowest = __reduce_min_sync(kAll, lowest);
  double lift = -INFINITY;
  for (uint32_t m = lane; m < row.n_masses; m += 32) {
    const uint32_t mass = masses[m];
    if (MO_PLAN_MASS_Z(mass) == lowest)
      lift = fmax(lift, terrain_height(heights, start_of(MO_PLAN_MASS_X(mass), 6), start_of(MO_PLAN_MASS_Y(mass), 6)));
  }
  for (int step = 16; step > 0; step /= 2)
    lift = fmax(lift, __shfl_xor_sync(kAll, lift, step));
  lift += score.drop_height_m;
  for (uint32_t m = lane; m < row.n_masses; m += 32) {
    const uint32_t mass = masses[m];
    float *p = position + 3 * (size_t)(row.first_place + m * row.stride);
    p[0] = (float)(start_of(MO_PLAN_MASS_X(mass), 6) - MO_WORLD_CENTRE_M);
    p[1] = (float)(start_of(MO_PLAN_MASS_Y(mass), 6) - MO_WORLD_CENTRE_M);
    p[2] = (float)(MO_VOXEL_M * (MO_PLAN_MASS_Z(mass) - lowest) + lift);
  }
  if (lane < 3) {
    const uint8_t *ranks = score.ranks + part.first_mass;
    double sum = 0;
    for (uint32_t i = 0; i < row.n_masses; i++) {
      const uint32_t mass = masses[ranks[i]];
      sum += lane == 0   ? start_of(MO_PLAN_MASS_X(mass), 6)
             : lane == 1 ? start_of(MO_PLAN_MASS_Y(mass), 6)
                         : MO_VOXEL_M * (MO_PLAN_MASS_Z(mass) - lowest) + lift;
    }
    score.outcomes[plan.row].com_start_m[lane] = sum / row.n_masses;
  }
}

/* Of an unactuated spring. */
__device__ __forceinline__ float rest_length(uint32_t slot)
{
  return slot < MO_PLAN_EDGES ? (float)MO_VOXEL_M : (float)(MO_VOXEL_M * 1.41421356237309504880);
}

/* What the group's rows and parts are, once per group. */
__device__ void begin_group(const mo_cuda_score &score, Shared &shared, uint32_t units, float *position,
                            float *velocity, float *wanted)
{
  const uint32_t thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
  const mo_plan_group &plan = shared.plan;
  if (thread < plan.n_parts) {
    const mo_plan_part in = score.parts[plan.first_part + thread];
    const mo_plan_body &body = score.bodies[in.body];
    Part &part = shared.parts[thread];
    part.first_place = in.first_place;
    part.n_rows = in.n_rows;
    part.n_masses = body.n_masses;
    part.first_quad = body.first_quad;
    part.first_mass = body.first_mass;
    part.first_row = in.first_row;
    part.per_row = 1.0f / (float)in.n_rows;
    for (uint32_t r = 0; r < in.n_rows; r++)
      shared.rows[in.first_row + r] = Row{in.first_place + r, in.n_rows, body.n_masses, in.body, thread};
  }
  if (thread < kRows) {
    shared.insane[thread] = 0;
    shared.diverged[thread] = 0;
    if (thread < plan.n_rows) {
      const mo_cuda_environment *environment = score.environments + score.rows[plan.first_row + thread].environment;
      shared.light[thread] =
          make_float4(environment->light[0], environment->light[1], environment->light[2], environment->highest);
      shared.cells[thread] = environment->cells;
    }
  }
  __syncthreads();
  if (thread == 0) {
    uint32_t n = 0;
    for (uint32_t p = 0; p < plan.n_parts; p++)
      for (uint32_t c = 0; c * 32 < shared.parts[p].n_masses * shared.parts[p].n_rows; c++)
        shared.chunks[n++] = p << 16 | c;
    shared.n_chunks = n;
    shared.input_units = 0;
    for (uint32_t tile = 0; tile < MO_WEIGHTS_TILES; tile++)
      shared.input_units |= (plan.input_tiles >> tile & 1u) << tile * units / MO_WEIGHTS_TILES;
  }
  for (uint32_t r = warp; r < plan.n_rows; r += MO_CUDA_WARPS)
    place_row(score, shared, r, position, lane);
  for (uint32_t k = thread; k < 3 * plan.n_places; k += MO_CUDA_THREADS)
    velocity[k] = 0.0f;
  if (score.weights == nullptr)
    for (uint32_t k = thread; k < kSpringSlots * kRows; k += MO_CUDA_THREADS)
      wanted[k] = rest_length(k / kRows);
  __syncthreads();
}

/* ---- a step ---- */

__device__ __forceinline__ float light_at(mo_sensor sensor, const float *p, const float4 &light)
{
  const float dx = p[0] - light.x, dy = p[1] - light.y, dz = p[2] - light.z;
  return mo_cuda_light(sensor, fmaf(dx, dx, fmaf(dy, dy, dz * dz)));
}

/* Two rows per warp, sixteen lanes each: lane bits 0 … 2 are a pair of inputs, bit 3 the row, bit 4 the tile. */
template <bool EXACT>
__device__ void sense(const mo_cuda_score &score, Shared &shared, mo_sensor sensor, const float *position, char *x,
                      uint32_t step)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const uint32_t g = lane & 7, tile_bit = lane >> 4, own = g | tile_bit << 3;
  for (uint32_t pair = warp; 2 * pair < shared.plan.n_rows; pair += MO_CUDA_WARPS) {
    const uint32_t r = 2 * pair + (lane >> 3 & 1);
    const bool used = r < shared.plan.n_rows;
    const Row row = shared.rows[used ? r : 2 * pair];
    const float4 light = shared.light[used ? r : 2 * pair];
    float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (uint32_t m = own; m < row.n_masses; m += 16) {
      const float *p = position + 3 * (row.first_place + m * row.stride);
      for (int axis = 0; axis < 3; axis++)
        sum[axis] += p[axis];
      sum[3] += light_at(sensor, p, light);
    }
#pragma unroll
    for (int k = 0; k < 4; k++) {
      sum[k] += __shfl_xor_sync(kAll, sum[k], 1);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 2);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 4);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 16);
    }
    const float n = (float)row.n_masses;
    if (used && own < 3)
      shared.com[step & 1][r][own] = __fdividef(own == 0 ? sum[0] : own == 1 ? sum[1] : sum[2], n);
    if (!used || score.weights == nullptr)
      continue;
    const float mean = __fdividef(sum[3], n);
    const uint4 inputs = __ldg(reinterpret_cast<const uint4 *>(score.inputs + (size_t)row.body * MO_PLAN_INPUTS) + own);
    const uint32_t listed[4] = {inputs.x, inputs.y, inputs.z, inputs.w};
    char *column = x + (r >> 3) * mo_cuda_network<EXACT>::COLUMN_BYTES;
#pragma unroll
    for (uint32_t two = 0; two < MO_WEIGHTS_TILES / 2; two++) {
      const uint32_t tile = 2 * two + tile_bit;
      if ((shared.input_units >> (EXACT ? tile : two) & 1u) == 0)
        continue;
      float value[2];
#pragma unroll
      for (uint32_t e = 0; e < 2; e++) {
        const uint32_t m = listed[two / 2] >> (two % 2 * 16 + e * 8) & 0xffu;
        value[e] = 0.0f;
        if (m != MO_PLAN_NONE)
          value[e] = light_at(sensor, position + 3 * (row.first_place + m * row.stride), light) - mean;
      }
      mo_cuda_store_pair<EXACT>(column + mo_cuda_place<EXACT>(r & 7, tile, g), value[0], value[1]);
    }
  }
}

/* What a hidden layer is computed from. */
struct Layer {
  const char *matrix;
  const float *start; /* what its sums start from */
  const float *gain, *shift;
  float epsilon;
  uint32_t units; /* bits: those that may not be 0 */
};

/* One hidden layer for all rows, in place. */
template <bool EXACT, int COLUMNS>
__device__ __forceinline__ void hidden_layer(const Layer &layer, float2 *partial, char *x)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, g = lane >> 2, t = lane & 3;
  constexpr uint32_t kUnits = mo_cuda_network<EXACT>::UNITS;
  constexpr int kHalf = 8 * MO_WEIGHTS_PAIR_BYTES / 2; /* of a tile's unit */
  const char *row[2];
  uint32_t column[COLUMNS];
  float sum[2][COLUMNS][4];
#pragma unroll
  for (int c = 0; c < COLUMNS; c++)
    column[c] = c * mo_cuda_network<EXACT>::COLUMN_BYTES;
#pragma unroll
  for (int m = 0; m < 2; m++) {
    row[m] = layer.matrix + (2 * warp + m) * kUnits * 2 * kHalf + lane * MO_WEIGHTS_LOAD_BYTES;
#pragma unroll
    for (int h = 0; h < 2; h++) {
      const float from = layer.start[warp * 32 + m * 16 + h * 8 + g];
#pragma unroll
      for (int c = 0; c < COLUMNS; c++)
        sum[m][c][2 * h] = sum[m][c][2 * h + 1] = from;
    }
  }
  const char *mine = x + mo_cuda_slot(g, t);
  if (layer.units == (1u << kUnits) - 1)
    mo_cuda_product<EXACT, kHalf, 2, COLUMNS>(sum, row, mine, column);
  else
    mo_cuda_product_of<EXACT, kHalf, 2, COLUMNS>(sum, row, mine, column, layer.units);
  mo_cuda_normalize<EXACT, COLUMNS>(sum, layer.gain, layer.shift, layer.epsilon, partial, x, warp, lane);
}

template <bool EXACT>
__device__ __forceinline__ void think(const mo_cuda_score &score, Shared &shared, const mo_weights_scalars &scalars,
                                      char *x)
{
  constexpr uint32_t kUnits = mo_cuda_network<EXACT>::UNITS;
#pragma unroll 1
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    Layer layer;
    layer.matrix = score.weights + score.layout.hidden[l];
    layer.start = l == 0 ? shared.first : reinterpret_cast<const float *>(score.weights + score.layout.bias[l]);
    layer.gain = reinterpret_cast<const float *>(score.weights + score.layout.gain[l]);
    layer.shift = reinterpret_cast<const float *>(score.weights + score.layout.shift[l]);
    layer.epsilon = l == 0 ? scalars.epsilon[0] : l == 1 ? scalars.epsilon[1] : scalars.epsilon[2];
    layer.units = l == 0 ? shared.input_units : (1u << kUnits) - 1;
    switch ((shared.plan.n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN) {
    case 1:
      hidden_layer<EXACT, 1>(layer, shared.partial, x);
      break;
    case 2:
      hidden_layer<EXACT, 2>(layer, shared.partial, x);
      break;
    case 3:
      hidden_layer<EXACT, 3>(layer, shared.partial, x);
      break;
    case 4:
      hidden_layer<EXACT, 4>(layer, shared.partial, x);
      break;
    default:
      hidden_layer<EXACT, 5>(layer, shared.partial, x);
    }
  }
}

/* A lane's pairs of springs of up to two tiles, and the columns that have any of the tiles' springs. */
struct Tiles {
  uint32_t pair[2], columns;
};

/* The round-th tiles of a warp, and how many: rounds of two tiles per warp; the last round spreads what is left. */
__device__ __forceinline__ uint32_t tiles_of(const mo_cuda_score &score, const Shared &shared, uint32_t round,
                                             Tiles *ret)
{
  const uint32_t warp = threadIdx.x >> 5, g = (threadIdx.x & 31) >> 2, n = shared.plan.n_tiles;
  const uint32_t done = round * 2 * MO_CUDA_WARPS;
  if (done >= n)
    return 0;
  const uint32_t left = n - done;
  const uint32_t twos = left >= 2 * MO_CUDA_WARPS ? MO_CUDA_WARPS : left > MO_CUDA_WARPS ? left - MO_CUDA_WARPS : 0;
  const uint32_t count = warp < twos ? 2 : warp + twos < left ? 1 : 0;
  const uint32_t first = shared.plan.first_tile + done + (warp < twos ? 2 * warp : twos + warp);
  ret->columns = 0;
#pragma unroll
  for (uint32_t m = 0; m < 2; m++)
    if (m < count) {
      ret->columns |= __ldg(score.columns + first + m);
      ret->pair[m] = __ldg(&score.tiles[first + m].pair[g]);
    }
  return count;
}

/* What the last layer is computed from, and where its lengths go. */
struct Output {
  const char *matrix;
  const float2 *bias;
  float scale, actuation;
  float *wanted;
};

/* TILES tiles of springs for the columns that have them: COLUMNS of them. */
template <bool EXACT, int TILES, int COLUMNS>
__device__ __forceinline__ void act_tiles(const Output &output, const Tiles &tiles, const char *x)
{
  const uint32_t lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3;
  const char *row[TILES];
  uint32_t column[COLUMNS], columns = tiles.columns;
  float sum[TILES][COLUMNS][4];
#pragma unroll
  for (int m = 0; m < TILES; m++)
    row[m] = output.matrix + (tiles.pair[m] == MO_PLAN_NO_PAIR ? 0 : tiles.pair[m]) * mo_cuda_network<EXACT>::UNITS *
                                 MO_WEIGHTS_PAIR_BYTES + t * MO_WEIGHTS_LOAD_BYTES;
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    column[c] = (uint32_t)(__ffs((int)columns) - 1) * mo_cuda_network<EXACT>::COLUMN_BYTES;
    columns &= columns - 1;
#pragma unroll
    for (int m = 0; m < TILES; m++)
#pragma unroll
      for (int k = 0; k < 4; k++)
        sum[m][c][k] = 0.0f;
  }
  mo_cuda_product<EXACT, MO_WEIGHTS_PAIR_BYTES / 2, TILES, COLUMNS>(sum, row, x + mo_cuda_slot(g, t), column);
#pragma unroll
  for (int m = 0; m < TILES; m++) {
    const uint32_t pair = tiles.pair[m];
    if (pair == MO_PLAN_NO_PAIR)
      continue;
    const float2 bias = __ldg(output.bias + pair);
    const float rest = rest_length(2 * pair), reach = rest * output.actuation;
    float *out = output.wanted + 2 * pair * kRows + 2 * t;
#pragma unroll
    for (int c = 0; c < COLUMNS; c++) {
      const uint32_t first = column[c] / (mo_cuda_network<EXACT>::COLUMN_BYTES / MO_PLAN_COLUMN);
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const float from = h == 0 ? bias.x : bias.y;
        float2 wanted;
        wanted.x = fmaf(reach, mo_cuda_tanh(fmaf(sum[m][c][2 * h], output.scale, from)), rest);
        wanted.y = fmaf(reach, mo_cuda_tanh(fmaf(sum[m][c][2 * h + 1], output.scale, from)), rest);
        *reinterpret_cast<float2 *>(out + h * kRows + first) = wanted;
      }
    }
  }
}

template <bool EXACT, int TILES>
__device__ __forceinline__ void act_tiles_of(const Output &output, const Tiles &tiles, const char *x)
{
  switch (__popc(tiles.columns)) {
  case 1:
    act_tiles<EXACT, TILES, 1>(output, tiles, x);
    break;
  case 2:
    act_tiles<EXACT, TILES, 2>(output, tiles, x);
    break;
  case 3:
    act_tiles<EXACT, TILES, 3>(output, tiles, x);
    break;
  case 4:
    act_tiles<EXACT, TILES, 4>(output, tiles, x);
    break;
  default:
    act_tiles<EXACT, TILES, 5>(output, tiles, x);
  }
}

/* The last layer. */
template <bool EXACT>
__device__ __forceinline__ void act(const mo_cuda_score &score, const Shared &shared, float scale, const char *x,
                                    float *wanted)
{
  const Output output = {score.weights + score.layout.output,
                         reinterpret_cast<const float2 *>(score.weights + score.layout.output_bias), scale,
                         score.constants.actuation, wanted};
  Tiles now = {}, next = {};
  uint32_t count = tiles_of(score, shared, 0, &now);
  for (uint32_t round = 1; count > 0; round++) {
    const uint32_t after = tiles_of(score, shared, round, &next);
    if (count == 2)
      act_tiles_of<EXACT, 2>(output, now, x);
    else
      act_tiles_of<EXACT, 1>(output, now, x);
    now = next;
    count = after;
  }
}

/* A thread's mass and row within a chunk. */
struct Item {
  uint32_t mass, row; /* row: of the part */
  uint32_t place;
  bool used;
};

__device__ __forceinline__ Item item_of(const Part &part, uint32_t chunk, uint32_t lane)
{
  const uint32_t q = (chunk & 0xffffu) * 32 + lane;
  Item item;
  item.mass = (uint32_t)(((float)q + 0.5f) * part.per_row);
  item.row = q - item.mass * part.n_rows;
  item.place = part.first_place + q;
  item.used = item.mass < part.n_masses;
  return item;
}

/* Four links of a mass at p: adds up what their springs pull. */
__device__ __forceinline__ void pull_four(const uint4 &quad, const float *first, uint32_t stride, const char *wanted,
                                          const float (&p)[3], float (&j)[3])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
  float length[MO_PLAN_LINKS];
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++)
    length[i] = *reinterpret_cast<const float *>(wanted + (uint64_t)MO_PLAN_LINK_SLOT(link[i]) * (kRows * 4));
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++) {
    const float *other = first + MO_PLAN_LINK_MASS(link[i]) * stride;
    const float d[3] = {other[0] - p[0], other[1] - p[1], other[2] - p[2]};
    const float q = mo_cuda_spring(d[0], d[1], d[2], length[i]);
    j[0] = fmaf(q, d[0], j[0]);
    j[1] = fmaf(q, d[1], j[1]);
    j[2] = fmaf(q, d[2], j[2]);
  }
}

__device__ __forceinline__ void pull(const mo_cuda_score &score, const Shared &shared, const float *position,
                                     const float *wanted, float *velocity)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const mo_cuda_constants &k = score.constants;
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const uint32_t chunk = shared.chunks[c];
    const Part &part = shared.parts[chunk >> 16];
    const Item item = item_of(part, chunk, lane);
    if (!item.used)
      continue;
    const uint32_t mass = __ldg(score.masses + part.first_mass + item.mass);
    float *v = velocity + 3 * item.place;
    const float before[3] = {v[0], v[1], v[2]};
    const uint4 *quads = reinterpret_cast<const uint4 *>(score.links) + part.first_quad + MO_PLAN_MASS_QUAD(mass);
    const float *own = position + 3 * item.place, *first = position + 3 * (part.first_place + item.row);
    const char *lengths = reinterpret_cast<const char *>(wanted + part.first_row + item.row);
    const float p[3] = {own[0], own[1], own[2]};
    const uint32_t stride = 3 * part.n_rows;
    float j[3] = {0.0f, 0.0f, 0.0f};
    uint4 quad = __ldg(quads);
    for (uint32_t left = MO_PLAN_MASS_QUADS(mass); left > 0; left--) {
      quads += left > 1;
      const uint4 next = __ldg(quads);
      pull_four(quad, first, stride, lengths, p, j);
      quad = next;
    }
    v[0] = fmaf(j[0], k.pull, before[0] * k.keep);
    v[1] = fmaf(j[1], k.pull, before[1] * k.keep);
    v[2] = fmaf(j[2], k.pull, fmaf(before[2], k.keep, -k.fall));
  }
}

__device__ __forceinline__ void move(const mo_cuda_score &score, Shared &shared, float *position, float *velocity)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const uint32_t chunk = shared.chunks[c];
    const Part &part = shared.parts[chunk >> 16];
    const Item item = item_of(part, chunk, lane);
    if (!item.used)
      continue;
    const uint32_t row = part.first_row + item.row;
    float *at = position + 3 * item.place, *speed = velocity + 3 * item.place;
    float v[3] = {speed[0], speed[1], speed[2]};
    float p[3] = {at[0], at[1], at[2]};
    if (mo_cuda_move(&score.constants, shared.cells[row], shared.light[row].w, p, v)) {
      speed[0] = v[0];
      speed[1] = v[1];
      speed[2] = v[2];
    }
    at[0] = p[0];
    at[1] = p[1];
    at[2] = p[2];
    if (!mo_cuda_is_sane(&score.constants, p, v))
      atomicOr(&shared.insane[row], 1);
  }
}

/* What the first layer's sums start from: bias and generators. */
__device__ __forceinline__ void begin_first_layer(const mo_cuda_score &score, Shared &shared, uint32_t step)
{
  const uint32_t o = threadIdx.x;
  const float *generators = score.generators + (size_t)step * MO_CPG_INPUTS;
  const float *weights = reinterpret_cast<const float *>(score.weights + score.layout.generators) + o;
  float sum = __ldg(reinterpret_cast<const float *>(score.weights + score.layout.bias[0]) + o);
#pragma unroll
  for (int i = 0; i < MO_CPG_INPUTS; i++)
    sum = fmaf(__ldg(generators + i), __ldg(weights + i * MO_HIDDEN), sum);
  shared.first[o] = sum;
}

__device__ void end_group(const mo_cuda_score &score, const Shared &shared, const float *position)
{
  for (uint32_t k = threadIdx.x; k < 3 * shared.plan.n_rows; k += MO_CUDA_THREADS) {
    const uint32_t r = k / 3, axis = k % 3;
    const Row row = shared.rows[r];
    mo_cuda_outcome *outcome = score.outcomes + score.rows[shared.plan.first_row + r].row;
    if (axis == 0)
      outcome->diverged_step = shared.diverged[r];
    if (shared.diverged[r] != 0)
      continue; /* com_end was written then */
    const uint8_t *ranks = score.ranks + shared.parts[row.part].first_mass;
    double sum = 0;
    for (uint32_t i = 0; i < row.n_masses; i++)
      sum += position[3 * (row.first_place + ranks[i] * row.stride) + axis];
    outcome->com_end_m[axis] = sum / row.n_masses + (axis < 2 ? MO_WORLD_CENTRE_M : 0.0);
  }
}

template <bool EXACT> __global__ void __launch_bounds__(MO_CUDA_THREADS, MO_CUDA_SCORE_BLOCKS_PER_MULTIPROCESSOR)
live(const __grid_constant__ mo_cuda_score score)
{
  extern __shared__ __align__(128) char memory[];
  Shared &shared = *reinterpret_cast<Shared *>(memory);
  char *x = memory + kSharedBytes;
  const uint32_t thread = threadIdx.x;
  float *wanted = score.wanted + (size_t)blockIdx.x * kSpringSlots * kRows;
  float *velocity = score.velocities + (size_t)blockIdx.x * 3 * score.max_places;
  const mo_weights_scalars scalars =
      score.weights == nullptr
          ? mo_weights_scalars{}
          : *reinterpret_cast<const mo_weights_scalars *>(score.weights + score.layout.scalars);
  const mo_sensor sensor = (mo_sensor)scalars.sensor;
  if (thread == 0)
    shared.cancelled = 0;
  for (;;) {
    __syncthreads();
    if (thread == 0)
      shared.group = atomicAdd(score.next_group, 1u);
    __syncthreads();
    if (shared.group >= score.n_groups || shared.cancelled)
      return;
    if (thread == 0)
      shared.plan = score.groups[shared.group];
    __syncthreads();
    const uint32_t n_rows = shared.plan.n_rows;
    float *position = reinterpret_cast<float *>(x + (n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN *
                                                        mo_cuda_network<EXACT>::COLUMN_BYTES);
    begin_group(score, shared, mo_cuda_network<EXACT>::UNITS, position, velocity, wanted);
    for (uint32_t step = 0; step < score.n_steps; step++) {
      sense<EXACT>(score, shared, sensor, position, x, step);
      if (score.weights != nullptr) {
        begin_first_layer(score, shared, step);
        __syncthreads();
        think<EXACT>(score, shared, scalars, x);
        act<EXACT>(score, shared, scalars.output, x, wanted);
        __syncthreads();
      }
      pull(score, shared, position, wanted, velocity);
      if (thread == 0 && step % kCancelSteps == 0 && *score.cancel != 0)
        shared.cancelled = 1;
      if (!__syncthreads_or(thread < n_rows && shared.diverged[thread] == 0) || shared.cancelled)
        break;
      move(score, shared, position, velocity);
      __syncthreads();
      if (thread < n_rows && shared.insane[thread] != 0 && shared.diverged[thread] == 0) {
        shared.diverged[thread] = (int)(step + 1);
        mo_cuda_outcome *outcome = score.outcomes + score.rows[shared.plan.first_row + thread].row;
        for (int axis = 0; axis < 3; axis++)
          outcome->com_end_m[axis] =
              (double)shared.com[step & 1][thread][axis] + (axis < 2 ? MO_WORLD_CENTRE_M : 0.0);
      }
    }
    __syncthreads();
    end_group(score, shared, position);
  }
}

} // namespace

size_t mo_cuda_score_group_bytes()
{
  return MO_CUDA_SCORE_SHARED_BYTES - kSharedBytes;
}

size_t mo_cuda_score_column_bytes(bool exact)
{
  return exact ? mo_cuda_network<true>::COLUMN_BYTES : mo_cuda_network<false>::COLUMN_BYTES;
}

cudaError_t mo_cuda_score_prepare()
{
  cudaError_t status = cudaFuncSetAttribute(live<true>, cudaFuncAttributeMaxDynamicSharedMemorySize,
                                            MO_CUDA_SCORE_SHARED_BYTES);
  if (status == cudaSuccess)
    status = cudaFuncSetAttribute(live<false>, cudaFuncAttributeMaxDynamicSharedMemorySize,
                                  MO_CUDA_SCORE_SHARED_BYTES);
  return status;
}

cudaError_t mo_cuda_score_launch(const mo_cuda_score &score, bool exact, uint32_t blocks, cudaStream_t stream)
{
  prepare_environments<<<score.n_environments, 96, 0, stream>>>(score.heights, score.environments,
                                                                score.n_environments);
  cudaError_t status = cudaGetLastError();
  if (status != cudaSuccess)
    return status;
  if (exact)
    live<true><<<blocks, MO_CUDA_THREADS, MO_CUDA_SCORE_SHARED_BYTES, stream>>>(score);
  else
    live<false><<<blocks, MO_CUDA_THREADS, MO_CUDA_SCORE_SHARED_BYTES, stream>>>(score);
  return cudaGetLastError();
}
