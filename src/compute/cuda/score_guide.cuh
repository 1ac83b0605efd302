/* score_guide.cuh: what only special rows have: profiles, damage, and tasks. The tasks of a group's
 * rows (course.cuh) are computed in float64, by one thread per row. That runs at the start of each
 * control period, before the sensors are read, with the center of mass that sensing finds. Rows
 * with a plain task are left out; plain rows stay bit-identical next to special ones.
 *
 * All threads of a block call these functions, which are not inlined: the steps of the kernel need
 * all registers. They read the call and the group from shared memory. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_GUIDE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_GUIDE_CUH

#include "compute/cuda/score_think.cuh"

namespace {

/* This thread's row, if it has a task. */
struct Guided {
  mo_cuda_guided *state; /* NULL: the thread has no row, or a plain one */
  course_result *result;
  mo_cuda_outcome *outcome;
  const mo_environment *environment;
};

__device__ __forceinline__ Guided guided_row(const mo_cuda_tasks &k)
{
  const Shared &shared = shared_of_block();
  Guided guided = {};
  if (threadIdx.x >= shared.plan.n_rows)
    return guided;
  const mo_plan_row row = shared.score.rows[shared.plan.first_row + threadIdx.x];
  guided.environment = k.environments + row.environment;
  if (course_is_plain(&guided.environment->task))
    return guided;
  guided.state = k.rows + row.row;
  guided.result = k.results + row.row;
  guided.outcome = shared.score.outcomes + row.row;
  return guided;
}

/* Places this thread's light. */
__device__ __forceinline__ void place_light(const mo_course &course, double t_s,
                                            const mo_track &track)
{
  double light_m[3];
  course_light(&course, t_s, &track, light_m);
  float4 &light = shared_of_block().light[threadIdx.x]; /* w: the terrain's highest point */
  light.x = (float)(light_m[0] - MO_WORLD_CENTER_M);
  light.y = (float)(light_m[1] - MO_WORLD_CENTER_M);
  light.z = (float)light_m[2];
}

/* Begins the tasks, after begin_group, which has placed the rows. */
__device__ __noinline__ void begin_tasks(const mo_cuda_tasks &k)
{
  const Guided own = guided_row(k);
  if (own.state != nullptr) {
    const double *start_m = own.outcome->com_start_m;
    const double com_m[3] = {start_m[0], start_m[1], start_m[2]};
    mo_course course;
    mo_track track;
    course_begin(&course, own.environment, k.end_s, k.n_periods, com_m, &track);
    course_begin_tally(&track);
    place_light(course, 0, track);
    own.state->course = course;
    own.state->track = track;
  }
  __syncthreads();
}

/* Advances a track to the next instant. */
__device__ __forceinline__ void advance(const mo_course &course, double t_s,
                                        const double (&com_m)[3], mo_track &track)
{
  if (course_has_tally(&course.environment->task)) {
    const mo_track before = track;
    course_advance(&course, t_s, com_m, &track);
    course_add_tally(&course, t_s, &before, &track);
  } else {
    course_advance(&course, t_s, com_m, &track);
  }
}

/* Advances the tasks at the start of a control period other than the first. The masses are where
 * the step starts. */
__device__ __noinline__ void guide_rows(const mo_cuda_tasks &k, uint32_t step)
{
  Shared &shared = shared_of_block();
  const Guided own = guided_row(k);
  const bool moves = own.state != nullptr && shared.diverged[threadIdx.x] == 0;
  if (!__syncthreads_or(moves))
    return;
  const Memory memory = memory_of(shared.score);
  sense<false>(shared.score, shared, (mo_sensor)shared.scalars.sensor, memory.position, memory.x,
               step);
  __syncthreads();
  if (moves) {
    const double t_s = step * k.dt_s;
    const float *com = shared.com[step & 1][threadIdx.x];
    const double com_m[3] = {(double)com[0] + MO_WORLD_CENTER_M, (double)com[1] + MO_WORLD_CENTER_M,
                             (double)com[2]};
    mo_track track = own.state->track;
    advance(own.state->course, t_s, com_m, track);
    place_light(own.state->course, t_s, track);
    own.state->track = track;
  }
  __syncthreads();
}

/* Ends the tasks, after end_group, which writes the centers of mass at the end. */
__device__ __noinline__ void end_tasks(const mo_cuda_tasks &k)
{
  __syncthreads();
  const Guided own = guided_row(k);
  if (own.state == nullptr)
    return;
  course_result result = {INFINITY, -INFINITY};
  if (shared_of_block().diverged[threadIdx.x] == 0) {
    const double *end_m = own.outcome->com_end_m;
    const double com_m[3] = {end_m[0], end_m[1], end_m[2]};
    mo_track track = own.state->track;
    advance(own.state->course, k.end_s, com_m, track);
    result = course_finish(&own.state->course, &track);
    own.state->track = track; /* the host reads those with a tally */
  }
  *own.result = result;
}

/* What the kernel does for special rows: nothing if no row of a launch is special. */
struct Plain {
  static constexpr bool kSpecial = false;

  __device__ __forceinline__ terrain_map map_of(uint32_t) const
  {
    return terrain_map_of_grid();
  }
  __device__ __forceinline__ void begin() const
  {
  }
  __device__ __forceinline__ void guide(const mo_cuda_score &, uint32_t) const
  {
  }
  __device__ __forceinline__ void keep_lengths(const Memory &, uint32_t) const
  {
  }
  __device__ __forceinline__ void observe(const mo_cuda_score &, uint32_t) const
  {
  }
  __device__ __forceinline__ void touches(Shared &, uint32_t, uint32_t) const
  {
  }
  /* Returns whether this thread's row has become insane. */
  __device__ __forceinline__ bool end_step(const mo_cuda_score &, Shared &shared, uint32_t) const
  {
    return threadIdx.x < shared.plan.n_rows && shared.insane[threadIdx.x] != 0;
  }
  __device__ __forceinline__ void end() const
  {
  }
};

struct Tasks : Plain {
  static constexpr bool kSpecial = true;
  const mo_cuda_tasks &k;

  __device__ __forceinline__ explicit Tasks(const mo_cuda_tasks &tasks) : k(tasks)
  {
  }
  /* environment: its number in the launch. */
  __device__ __forceinline__ terrain_map map_of(uint32_t environment) const
  {
    return terrain_map_of(k.environments + environment);
  }
  __device__ __forceinline__ void begin() const
  {
    begin_tasks(k);
  }
  __device__ __forceinline__ void guide(const mo_cuda_score &score, uint32_t step) const
  {
    if (step > 0 && step % score.control_steps == 0)
      guide_rows(k, step);
  }
  __device__ __forceinline__ void end() const
  {
    end_tasks(k);
  }
};

} // namespace

#endif
