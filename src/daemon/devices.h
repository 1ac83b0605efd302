/* devices.h: which module and which devices the service computes with. */
#ifndef MORPHOD_DAEMON_DEVICES_H
#define MORPHOD_DAEMON_DEVICES_H

#include <morpho/compute.h>

#include "daemon/settings.h"

/* Adds the devices that the settings ask for, before anything else is made of the back end. Where
 * none is asked for by name, a machine without a module or a device is none to complain about: it
 * is logged, and the processors compute. MO_ERR_INVALID: the settings name what is not there, or
 * the module is of another version. */
int devices_open(struct mo_compute *compute, const struct settings *settings,
                 struct mo_message *message);

#endif
