/* device_gradient.h: computes the gradient of a batch on the devices of this machine. */
#ifndef MORPHO_COMPUTE_DEVICE_GRADIENT_H
#define MORPHO_COMPUTE_DEVICE_GRADIENT_H

#include "compute/devices.h"

/* State between gradients: memory, and the robots that were laid out ahead. */
struct mo_device_gradients;
int mo_device_gradients_create(struct mo_devices *devices,
                               struct mo_device_gradients **ret);     /* MO_ERR_NO_MEMORY */
void mo_device_gradients_free(struct mo_device_gradients *gradients); /* NULL-safe */
/* Computes the gradient of a batch. Adds to the counts, which start at 0. One call at a time. */
int mo_devices_gradient(struct mo_device_gradients *gradients, struct mo_gradient_batch *batch);
/* Lays out robots, which must not change until their gradient is computed or they are forgotten.
 * One call at a time; a call of mo_devices_gradient may run concurrently. Forgets an older layout
 * that is not in use. MO_ERR_CONFLICT: two layouts are in use. */
int mo_devices_lay_out(struct mo_device_gradients *gradients, const struct mo_robot *robots,
                       uint32_t n, const struct mo_physics *physics);
void mo_device_gradients_forget(struct mo_device_gradients *gradients);

#endif
