/* devices.h: the module and the devices with which the service computes. */
#ifndef MORPHOD_DAEMON_DEVICES_H
#define MORPHOD_DAEMON_DEVICES_H

#include <morpho/compute.h>

#include "daemon/settings.h"

/* Adds the devices of the settings; call it before any other use of the back end. If no device or
 * module is named, a machine without either is no error: it is logged, and the processors compute.
 * MO_ERR_INVALID: the settings name a missing device or module, or the module has another version.
 */
int devices_open(struct mo_compute *compute, const struct settings *settings,
                 struct mo_message *message);

#endif
