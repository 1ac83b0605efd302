/* controller.c: a controller's packs, one per precision, made when a block first needs them.
 * Devices own their copies of the weights until the controller is freed. */
#include "compute/devices.h"

#include <stdlib.h>

struct mo_compute_controller {
  const struct mo_controller *controller; /* NULL: passive */
  struct mo_devices *devices;             /* NULL: none */
  enum mo_isa isa;
  pthread_mutex_t making;
  struct mo_pack *pack[2]; /* by mo_precision; written once, under the mutex */
};

int mo_compute_controller_create(struct mo_compute *compute, const struct mo_controller *controller,
                                 struct mo_compute_controller **ret)
{
  struct mo_compute_controller *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->controller = controller;
  made->devices = mo_core(compute)->devices;
  made->isa = mo_core(compute)->isa;
  pthread_mutex_init(&made->making, NULL);
  *ret = made;
  return MO_OK;
}

/* Marks the copies of a controller that is being freed as no longer needed. */
static void forget(struct mo_devices *devices, const struct mo_compute_controller *controller)
{
  MO_GUARD(&devices->fair.mutex);
  for (uint32_t i = 0; i < MO_CALLERS * devices->n; i++) {
    const struct mo_caller *caller = &devices->units[i / MO_CALLERS].callers[i % MO_CALLERS];
    for (struct mo_device_copy *copy = caller->copies; copy != NULL; copy = copy->next)
      if (copy->owner == controller)
        copy->owner = NULL;
  }
  pthread_cond_broadcast(&devices->wake); /* callers free the copies */
}

void mo_compute_controller_free(struct mo_compute_controller *controller)
{
  if (controller == NULL)
    return;
  if (controller->devices != NULL)
    forget(controller->devices, controller);
  for (int precision = 0; precision < 2; precision++)
    mo_pack_free(controller->pack[precision]);
  pthread_mutex_destroy(&controller->making);
  free(controller);
}

const struct mo_controller *
mo_compute_controller_weights(const struct mo_compute_controller *controller)
{
  return controller->controller;
}

int mo_compute_controller_pack(struct mo_compute_controller *controller,
                               enum mo_precision precision, const struct mo_pack **ret)
{
  int status = MO_OK;
  MO_GUARD(&controller->making);
  if (controller->pack[precision] == NULL)
    status = mo_pack_create(controller->controller, controller->isa, precision,
                            &controller->pack[precision]);
  *ret = controller->pack[precision];
  return status;
}
