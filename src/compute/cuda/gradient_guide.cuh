/* gradient_guide.cuh: the tasks of rows (course.cuh) in the kernels of the gradient, in float64.
 *
 * All lanes of a row's warp call these functions with the same arguments and compute the same
 * numbers; the first lane stores them. They are not inlined, because the kernels need all
 * registers, and they run only once per control period. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_GUIDE_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_GUIDE_CUH

#include "compute/cuda/course_back.cuh"
#include "compute/cuda/gradient_kernels.cuh"

static __device__ __forceinline__ mo_course course_of(const guided_row &row)
{
  mo_course course = row.task->course;
  course.environment = &row.task->environment;
  return course;
}

static __device__ __forceinline__ float3 light_of(const mo_course &course, double t_s,
                                                  const mo_track &track)
{
  double light_m[3];
  course_light(&course, t_s, &track, light_m);
  return make_float3((float)(light_m[0] - MO_WORLD_CENTER_M),
                     (float)(light_m[1] - MO_WORLD_CENTER_M), (float)light_m[2]);
}

/* Stores the track of an instant. */
static __device__ __forceinline__ void keep_track(const guided_row &row, const mo_track &track)
{
  if (threadIdx.x % 32 == 0)
    *row.track = track;
  __syncwarp();
}

static __device__ __forceinline__ void keep_adjoint(const guided_row &row,
                                                    const mo_course_adjoint &adjoint)
{
  __syncwarp(); /* all lanes have read the previous one */
  if (threadIdx.x % 32 == 0)
    row.ending->adjoint = adjoint;
  __syncwarp();
}

/* Returns the light at an instant from its stored track. */
static __device__ __noinline__ float3 guided_light(const guided_row row, double t_s)
{
  return light_of(course_of(row), t_s, *row.track);
}

/* Begins a row's track, and returns the first light. */
static __device__ __noinline__ float3 guide_first(const guided_row row)
{
  const mo_track track = row.task->start;
  const float3 light = light_of(course_of(row), 0, track);
  if (threadIdx.x % 32 == 0)
    row.ending->energy_m2[0] = row.ending->energy_m2[1] = 0;
  keep_track(row, track);
  return light;
}

/* Continues a row's track to the next instant, and returns the light there. */
static __device__ __noinline__ float3 guide_next(const guided_row row, double t_s,
                                                 const double3 com)
{
  const mo_course course = course_of(row);
  const double com_m[3] = {com.x, com.y, com.z};
  mo_track track = row.track[-(int64_t)row.stride];
  course_advance_all(&course, t_s, com_m, &track);
  const float3 light = light_of(course, t_s, track);
  keep_track(row, track);
  return light;
}

static __device__ __forceinline__ double work_of(const guided_row &row)
{
  return 0.5 * row.task->stiffness_n_per_m * (row.ending->energy_m2[0] + row.ending->energy_m2[1]);
}

/* Ends a row's track and sets its result. */
static __device__ __noinline__ void guide_end(const guided_row row, const double3 com)
{
  const mo_course course = course_of(row);
  const double com_m[3] = {com.x, com.y, com.z};
  mo_track track = row.track[-(int64_t)row.stride];
  course_advance_all(&course, course.end_s, com_m, &track);
  const course_result result = course_finish_all(&course, &track, work_of(row), false);
  if (threadIdx.x % 32 == 0) {
    row.ending->loss = result.loss;
    row.ending->value = result.value;
  }
  keep_track(row, track);
}

/* These three return ∂loss/∂ the center of mass. */

static __device__ __noinline__ double3 guide_end_back(const guided_row row)
{
  const mo_course course = course_of(row);
  mo_course_adjoint adjoint;
  double d_com[3];
  course_end_back(&course, row.track - row.stride, row.track, work_of(row), &adjoint, d_com);
  keep_adjoint(row, adjoint);
  return make_double3(d_com[0], d_com[1], d_com[2]);
}

/* is_first: the instant is the start of the rollout. */
static __device__ __noinline__ double3 guide_back(const guided_row row, double t_s, bool is_first,
                                                  const double3 d_light)
{
  const mo_course course = course_of(row);
  const double d_light_m[3] = {d_light.x, d_light.y, d_light.z};
  mo_course_adjoint adjoint = row.ending->adjoint;
  double d_com[3];
  course_back(&course, t_s, is_first ? nullptr : row.track - row.stride, row.track,
              row.track + row.stride, d_light_m, &adjoint, d_com);
  keep_adjoint(row, adjoint);
  return make_double3(d_com[0], d_com[1], d_com[2]);
}

static __device__ __noinline__ double3 guide_restart(const guided_row row, double t_s,
                                                     const double2 com, double weight)
{
  const mo_course course = course_of(row);
  const double com_m[3] = {com.x, com.y, 0};
  mo_course_adjoint adjoint = row.ending->adjoint;
  double d_com[3];
  course_restart(&course, t_s, row.track, com_m, weight, &adjoint, d_com);
  keep_adjoint(row, adjoint);
  return make_double3(d_com[0], d_com[1], d_com[2]);
}

#endif
