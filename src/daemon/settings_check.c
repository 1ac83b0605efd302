/* settings_check.c: checks the resources that the values refer to. Only reads: --check-config
 * changes nothing. */
#include "daemon/settings.h"

#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <morpho/controller.h>
#include <morpho/rollout.h>

#include "daemon/devices.h"
#include "daemon/fleet.h"
#include "daemon/memory.h"
#include "daemon/service.h"
#include "http/server.h"
#include "store/store.h"
#include "tokens.h"

static void check_devices(const struct settings *settings, struct settings_faults *faults)
{
  struct device_choice choice;
  struct mo_message message = {{0}};
  if (devices_parse(&settings->devices, &choice, &message) != MO_OK)
    settings_fault(faults, true, "devices: %s", message.text);
  if (settings->compute_module != NULL && access(settings->compute_module, R_OK) != 0)
    settings_fault(faults, true, "compute_module: %s: %s", settings->compute_module,
                   strerror(errno));
}

/* Checks that the state folder is writable, or can be created below the deepest existing folder of
 * its path. */
static void check_state_dir(const char *path, struct settings_faults *faults)
{
  struct stat status;
  if (*path != '/') {
    settings_fault(faults, true, "state_dir: \"%s\" must be an absolute path", path);
    return;
  }
  if (stat(path, &status) == 0) {
    struct mo_message message = {{0}};
    const int fd = mo_state_folder_open(path, NULL, &message);
    if (fd < 0)
      settings_fault(faults, true, "state_dir: %s", message.text);
    else if (faccessat(AT_FDCWD, path, W_OK | X_OK, AT_EACCESS) != 0)
      settings_fault(faults, true, "state_dir: %s cannot be written: %s", path, strerror(errno));
    if (fd >= 0)
      close(fd);
    return;
  }
  if (errno != ENOENT) {
    settings_fault(faults, true, "state_dir: %s: %s", path, strerror(errno));
    return;
  }
  char *parent = enough(strdup(path));
  for (;;) {
    char *slash = strrchr(parent, '/');
    if (slash == parent)
      slash[1] = 0;
    else
      *slash = 0;
    if (stat(parent, &status) == 0) {
      if (!S_ISDIR(status.st_mode))
        settings_fault(faults, true, "state_dir: cannot create %s: %s is not a folder", path,
                       parent);
      else if (faccessat(AT_FDCWD, parent, W_OK | X_OK, AT_EACCESS) != 0)
        settings_fault(faults, true, "state_dir: cannot create %s in %s: %s", path, parent,
                       strerror(errno));
      break;
    }
    if (errno != ENOENT || slash == parent) {
      settings_fault(faults, true, "state_dir: %s: %s", parent, strerror(errno));
      break;
    }
  }
  free(parent);
}

static void warn_if_public(const char *name, const char *path, const struct stat *status,
                           struct settings_faults *faults)
{
  if ((status->st_mode & 0007) != 0)
    settings_fault(faults, false, "%s: everyone can read %s (mode %03o); run chmod o-rwx on it",
                   name, path, (unsigned)status->st_mode & 0777);
}

/* Checks the token file, and counts the tokens of clients and of workers. */
static void check_token_file(const char *path, size_t *n_clients, size_t *n_workers,
                             struct settings_faults *faults)
{
  struct stat status;
  if (stat(path, &status) != 0) { /* before opening: reading a pipe could block indefinitely */
    settings_fault(faults, true, "token_file: %s: %s", path, strerror(errno));
  } else if (!S_ISREG(status.st_mode)) {
    settings_fault(faults, true, "token_file: %s is not a file", path);
  } else {
    struct tokens tokens;
    struct mo_message message = {{0}};
    if (tokens_read(path, &tokens, &message) == MO_OK) {
      *n_workers = tokens.n_workers;
      *n_clients = tokens.n - tokens.n_workers;
      tokens_free(&tokens);
    } else {
      settings_fault(faults, true, "%s", message.text);
    }
    warn_if_public("token_file", path, &status, faults);
  }
}

/* Checks that the folder of a file to be created is writable. */
static void check_parent(const char *name, const char *path, struct settings_faults *faults)
{
  char *folder = enough(strdup(path)), *slash = strrchr(folder, '/');
  if (slash != NULL)
    slash[slash == folder] = 0;
  const char *where = slash != NULL ? folder : ".";
  if (faccessat(AT_FDCWD, where, W_OK | X_OK, AT_EACCESS) != 0)
    settings_fault(faults, true, "%s: %s: %s: %s", name, path, where, strerror(errno));
  free(folder);
}

/* Checks the addresses of a list. Returns whether one is not on loopback. */
static bool check_addresses(const char *name, const struct setting_list *list,
                            struct settings_faults *faults)
{
  bool beyond = false;
  for (size_t i = 0; i < list->n; i++) {
    struct mo_listen_address address = {0};
    struct mo_message message = {{0}};
    const char *text = list->items[i];
    if (mo_http_parse_address(text, &address, &message) != MO_OK) {
      settings_fault(faults, true, "%s: %s", name, message.text);
      continue;
    }
    for (size_t j = 0; j < i; j++)
      if (strcmp(text, list->items[j]) == 0 && !(address.port == 0 && !address.is_unix))
        settings_fault(faults, true, "%s: duplicate address %s", name, text);
    if (address.is_unix)
      check_parent(name, address.host, faults);
    beyond |= !address.is_loopback;
  }
  return beyond;
}

static void check_listen(const struct settings *settings, size_t n_tokens,
                         struct settings_faults *faults)
{
  const bool beyond = check_addresses("listen", &settings->listen, faults);
  if (settings->listen.n == 0)
    settings_fault(faults, true, "listen: at least one address is required");
  if (beyond && settings->token_file == NULL)
    settings_fault(faults, true, "listen: an address that is not on loopback needs a token_file");
  else if (settings->token_on_loopback != 0 && settings->token_file == NULL)
    settings_fault(faults, true, "token_on_loopback: needs a token_file");
  else if ((beyond || settings->token_on_loopback != 0) && n_tokens == 0 && faults->n_fatal == 0)
    settings_fault(faults, true,
                   "listen: token_file has only worker tokens; add a token with the right read, "
                   "submit or admin");
}

static void check_fleet(const struct settings *settings, size_t n_tokens,
                        struct settings_faults *faults)
{
  const bool beyond = check_addresses("fleet_listen", &settings->fleet_listen, faults);
  const bool has_both = settings->fleet_certificate != NULL && settings->fleet_key != NULL;
  struct fleet_certificate pair;
  struct mo_message message = {{0}};
  struct stat status;
  if (!has_both && (settings->fleet_certificate != NULL || settings->fleet_key != NULL))
    settings_fault(faults, true, "fleet_certificate and fleet_key: set both or neither");
  else if (has_both && fleet_certificate_read(settings, &pair, &message) != MO_OK)
    settings_fault(faults, true, "%s", message.text);
  else if (has_both)
    fleet_certificate_free(&pair);
  if (has_both && stat(settings->fleet_key, &status) == 0)
    warn_if_public("fleet_key", settings->fleet_key, &status, faults);
  if (beyond && !has_both)
    settings_fault(faults, true,
                   "fleet_listen: an address that is not on loopback needs fleet_certificate and "
                   "fleet_key");
  if (beyond && n_tokens == 0 && faults->n_fatal == 0)
    settings_fault(
        faults, true,
        "fleet_listen: an address that is not on loopback needs a token_file with a worker "
        "token: NAME worker TOKEN");
  if (settings->compute == COMPUTE_FLEET && settings->fleet_listen.n == 0)
    settings_fault(faults, true, "compute: \"fleet\" needs fleet_listen, where workers get work");
}

static void check_controller(const char *path, struct settings_faults *faults)
{
  struct mo_controller *controller;
  struct mo_message message = {{0}};
  int status = mo_controller_read(path, &controller, &message);
  if (status == MO_OK)
    mo_controller_free(controller);
  else
    settings_fault(faults, true, "default_controller: %s: %s", path,
                   message.text[0] != 0 ? message.text : mo_error_text(status));
}

/* Checks the installed controllers, which the first start uses if the settings do not name one.
 * Later starts do not need them. */
static void check_shipped_controllers(const char *state_dir, struct settings_faults *faults)
{
  static const char *const paths[] = {SHIPPED_CONTROLLER, PAPER_CONTROLLER, GENERALIST_CONTROLLER,
                                      ROBUST_CONTROLLER};
  char *database = format_text("%s/morphod.db", state_dir);
  for (size_t i = 0; i < sizeof(paths) / sizeof(*paths) && access(database, F_OK) != 0; i++)
    if (access(paths[i], R_OK) != 0)
      settings_fault(faults, false,
                     "default_controller: %s: %s; the first start needs this controller", paths[i],
                     strerror(errno));
  free(database);
}

void settings_check(const struct settings *settings, bool state_dir, struct settings_faults *faults)
{
  if (state_dir)
    check_state_dir(settings->state_dir, faults);
  size_t n_clients = 0, n_workers = 0;
  if (settings->token_file != NULL)
    check_token_file(settings->token_file, &n_clients, &n_workers, faults);
  check_listen(settings, n_clients, faults);
  check_fleet(settings, n_workers, faults);
  if (settings->default_controller != NULL)
    check_controller(settings->default_controller, faults);
  else
    check_shipped_controllers(settings->state_dir, faults);
  if (settings->isa > 0 && settings->isa - 1 > (int)mo_isa_best())
    settings_fault(faults, true,
                   "isa: this processor does not support %s; the widest set that it supports is %s",
                   mo_isa_name((enum mo_isa)(settings->isa - 1)), mo_isa_name(mo_isa_best()));
  check_devices(settings, faults);
  for (size_t i = 0; i < settings->allowed_hosts.n; i++)
    if (strpbrk(settings->allowed_hosts.items[i], "/@") != NULL)
      settings_fault(faults, true, "allowed_hosts: \"%s\" is not a host name",
                     settings->allowed_hosts.items[i]);
  if (settings->port_file != NULL)
    check_parent("port_file", settings->port_file, faults);
  for (size_t i = 0; i < settings->unix_groups.n; i++)
    if (getgrnam(settings->unix_groups.items[i]) == NULL)
      settings_fault(faults, true, "unix_groups: group \"%s\" does not exist",
                     settings->unix_groups.items[i]);
  if (settings->max_memory > 0 && settings->max_memory < (UINT64_C(128) << 20))
    settings_fault(faults, true, "max_memory: must be at least 128M");
  if (settings->max_recordings_bytes > 0 &&
      settings->max_recordings_bytes < settings->max_recorded_bytes)
    settings_fault(faults, false,
                   "max_recordings is smaller than max_recorded, which is used instead");
  if (settings->max_streams > settings->max_connections)
    settings_fault(faults, false, "max_streams is larger than max_connections and has no effect");
}
