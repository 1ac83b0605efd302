/* settings_parse.h: values of settings that have a form of their own: addresses, devices. See
 * settings_check.c. */
#ifndef MORPHO_DAEMON_SETTINGS_PARSE_H
#define MORPHO_DAEMON_SETTINGS_PARSE_H

#include "daemon/settings.h"

/* The requested devices: "auto", "none", or numbers. */
#define SETTINGS_DEVICES_MAX 64
struct device_choice {
  bool all;
  uint32_t n, indices[SETTINGS_DEVICES_MAX]; /* (n) when not all; 0: none */
};
int settings_parse_devices(const struct setting_list *list, struct device_choice *choice,
                           struct mo_message *message);

#endif
