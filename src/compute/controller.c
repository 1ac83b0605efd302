/* controller.c: a controller's packs, one per precision, made when a block first needs them.
 * Devices own their copies of the weights until mo_devices_forget. */
#include "compute/devices.h"

#include <stdlib.h>

struct mo_compute_controller {
  const struct mo_controller *controller; /* NULL: passive */
  struct mo_devices *devices;             /* NULL: there are none */
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

void mo_compute_controller_free(struct mo_compute_controller *controller)
{
  if (controller == NULL)
    return;
  if (controller->devices != NULL)
    mo_devices_forget(controller->devices, controller);
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
