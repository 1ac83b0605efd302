/* settings_parse.h: values of settings that have a form of their own: addresses, devices. See
 * settings_check.c. */
#ifndef MORPHO_DAEMON_SETTINGS_PARSE_H
#define MORPHO_DAEMON_SETTINGS_PARSE_H

#include "daemon/settings.h"

/* Parses "127.0.0.1:8765", "[::1]:8765", "localhost:0" or "unix:/run/x". MO_ERR_INVALID with a
 * message. */
struct listen_address {
  bool is_unix, is_loopback;
  char host[256]; /* or the path */
  uint16_t port;
};
int settings_parse_address(const char *text, struct listen_address *address,
                           struct mo_message *message);

/* The requested devices: "auto", "none", or numbers. */
#define SETTINGS_DEVICES_MAX 64
struct device_choice {
  bool all;
  uint32_t n, indices[SETTINGS_DEVICES_MAX]; /* (n) when not all; 0: none */
};
int settings_parse_devices(const struct setting_list *list, struct device_choice *choice,
                           struct mo_message *message);

#endif
