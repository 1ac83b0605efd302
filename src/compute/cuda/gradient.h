/* gradient.h: gradients on one device, for module.cu and bench/cuda-gradient.c. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_H

#include "compute/device.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Version of the code, for fingerprints: changes whenever any bit of a result does. */
#define MO_CUDA_GRADIENT_CODE "gradient-7"

/* Implements mo_device_module.gradient. memory_bytes: limit of device memory to use; 0: the free
 * memory. */
int mo_cuda_gradient_run(struct mo_device *device, struct mo_device_gradient *gradient,
                         uint64_t memory_bytes);
/* These implement mo_device_module.lay_out, .layout_free, .allocate and .release. */
int mo_cuda_gradient_lay_out(const struct mo_device *device, const struct mo_robot *robots,
                             uint32_t n, const struct mo_physics *physics,
                             struct mo_device_layout **layout);
void mo_cuda_gradient_layout_free(struct mo_device_layout *layout);
void *mo_cuda_gradient_allocate(const struct mo_device *device, size_t bytes);
void mo_cuda_gradient_release(void *memory);

/* Releases device memory that other work needs. The next call allocates it again. */
void mo_cuda_gradient_trim(struct mo_device *device);

/* Whether groups of 32 robots are computed in halves, by two blocks each, which does not change the
 * bits. MO_CUDA_HALVES_SOME: the half of the groups that take longest. For tests: the default is
 * MO_CUDA_HALVES_IF_FASTER, which depends on the number of multiprocessors. */
enum mo_cuda_halves {
  MO_CUDA_HALVES_IF_FASTER,
  MO_CUDA_HALVES_NEVER,
  MO_CUDA_HALVES_SOME,
  MO_CUDA_HALVES_ALWAYS
};
void mo_cuda_gradient_set_halves(struct mo_device *device, enum mo_cuda_halves halves);

/* Times and counts of the last call. */
struct mo_cuda_gradient_profile {
  double plan_s, upload_s, forward_s, back_s, products_s,
      collect_s;                  /* the last four: device times, by its clock */
  uint64_t device_bytes;          /* allocated */
  uint32_t passes, groups, walks; /* parts that the call was divided into; groups; backward
                                   * passes */
  uint32_t halved;                /* groups that were computed in halves */
};
const struct mo_cuda_gradient_profile *mo_cuda_gradient_times(const struct mo_device *device);

#ifdef __cplusplus
}
#endif
#endif
