/* devices.h: the module and the devices that the service computes with. */
#ifndef MORPHOD_DAEMON_DEVICES_H
#define MORPHOD_DAEMON_DEVICES_H

#include <morpho/compute.h>

#include "daemon/settings.h"

/* The requested devices: "auto", "none", or numbers. */
#define DEVICES_MAX 64
struct device_choice {
  bool all;
  uint32_t n, indices[DEVICES_MAX]; /* (n) when not all; 0: none */
};
int devices_parse(const struct setting_list *list, struct device_choice *choice,
                  struct mo_message *message);

/* Adds the devices of the settings (module nullable); call it before any other use of the back end.
 * If the settings do not list a device or module, a missing module or device is not an error: it is
 * logged, and the CPUs compute. MO_ERR_INVALID: the settings list a missing device or module, or
 * the module has a different version. */
int devices_open(struct mo_compute *compute, const struct setting_list *devices, const char *module,
                 struct mo_message *message);

#endif
