/* controller.c: a controller's packs, one per precision, made when a block first needs them.
 * Devices own their copies of the weights until mo_devices_forget. */
#include "compute/devices.h"

#include <stdlib.h>

struct mo_compute_controller {
  const struct mo_controller *controller; /* NULL: passive */
  struct mo_devices *devices;             /* NULL: there are none */
  enum mo_isa isa;
  pthread_mutex_t making;
  _Atomic(struct mo_pack *) pack[2]; /* by mo_precision; written once */
};

int mo_compute_controller_create(struct mo_compute *compute, const struct mo_controller *controller,
                                 struct mo_compute_controller **ret)
{
  struct mo_compute_controller *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->controller = controller;
  made->devices = mo_compute_get_devices(compute);
  made->isa = mo_compute_isa(compute);
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
    mo_pack_free(atomic_load(&controller->pack[precision]));
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
  struct mo_pack *pack = atomic_load_explicit(&controller->pack[precision], memory_order_acquire);
  int status = MO_OK;
  if (pack == NULL) {
    pthread_mutex_lock(&controller->making);
    pack = atomic_load(&controller->pack[precision]);
    if (pack == NULL) {
      status = mo_pack_create(controller->controller, controller->isa, precision, &pack);
      if (status == MO_OK)
        atomic_store_explicit(&controller->pack[precision], pack, memory_order_release);
    }
    pthread_mutex_unlock(&controller->making);
  }
  if (status == MO_OK)
    *ret = pack;
  return status;
}
