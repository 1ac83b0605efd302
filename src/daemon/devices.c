/* devices.c: see devices.h. */
#include "daemon/devices.h"

#include <ctype.h>
#include <errno.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"

int devices_parse(const struct setting_list *list, struct device_choice *choice,
                  struct mo_message *message)
{
  struct device_choice found = {.n = 0};
  for (size_t i = 0; i < list->n; i++) {
    const char *text = list->items[i];
    const bool is_word = strcmp(text, "auto") == 0 || strcmp(text, "none") == 0;
    if (is_word && list->n > 1)
      return mo_fail(message, MO_ERR_INVALID, "\"%s\" must be the only item", text);
    if (is_word) {
      found.all = strcmp(text, "auto") == 0;
      continue;
    }
    char *end;
    errno = 0;
    const unsigned long index = strtoul(text, &end, 10);
    if (!isdigit((unsigned char)*text) || *end != 0 || errno != 0 || index > 1023)
      return mo_fail(message, MO_ERR_INVALID, "\"%.60s\" must be auto, none, or a device number",
                     text);
    for (uint32_t k = 0; k < found.n; k++)
      if (found.indices[k] == index)
        return mo_fail(message, MO_ERR_INVALID, "duplicate device %lu", index);
    if (found.n == DEVICES_MAX)
      return mo_fail(message, MO_ERR_LIMIT, "there may be at most %d devices", DEVICES_MAX);
    found.indices[found.n++] = (uint32_t)index;
  }
  *choice = found;
  return MO_OK;
}

/* Called by the back end on one of its threads. */
static void device_is_lost(void *context, const struct mo_device_status *status)
{
  (void)context;
  log_error("a device was lost", LOG_INT("device", status->index), LOG_TEXT("name", status->name),
            LOG_TEXT("id", status->id), LOG_TEXT("detail", status->error));
}

/* Finds the module of the build tree, near this program, or the installed module. */
static void find_module(char path[PATH_MAX])
{
  static const char *const places[] = {"morphod-cuda.so", "../compute/cuda/morphod-cuda.so"};
  char program[PATH_MAX], *slash;
  ssize_t size = readlink("/proc/self/exe", program, sizeof(program) - 1);
  program[size > 0 ? size : 0] = '\0';
  slash = strrchr(program, '/');
  for (size_t i = 0; slash != NULL && i < sizeof(places) / sizeof(places[0]); i++) {
    int length = snprintf(path, PATH_MAX, "%.*s/%s", (int)(slash - program), program, places[i]);
    if (length > 0 && length < PATH_MAX && access(path, R_OK) == 0)
      return;
  }
  snprintf(path, PATH_MAX, "%s/morphod-cuda.so", MORPHOD_LIBDIR);
}

static void log_devices(struct mo_compute *compute)
{
  struct mo_device_status status;
  for (uint32_t i = 0; mo_compute_device(compute, i, &status) == MO_OK; i++)
    log_info("device", LOG_INT("device", status.index), LOG_TEXT("name", status.name),
             LOG_TEXT("id", status.id), LOG_INT("memory_mib", status.memory_bytes >> 20),
             LOG_INT("multiprocessors", status.multiprocessors));
  log_info("devices compute", LOG_TEXT("scores", mo_compute_device_fingerprint(compute)),
           LOG_TEXT("gradients", mo_compute_device_gradient_fingerprint(compute)));
}

int devices_open(struct mo_compute *compute, const struct setting_list *devices, const char *module,
                 struct mo_message *message)
{
  struct device_choice choice = {0};
  struct mo_message words = {""};
  char found[PATH_MAX];
  int status = devices_parse(devices, &choice, message);
  if (status != MO_OK)
    return status;
  if (!choice.all && choice.n == 0) {
    log_info("no devices are configured; using the CPU");
    return MO_OK;
  }
  if (module == NULL)
    find_module(found);
  const struct mo_devices_config config = {.module = module != NULL ? module : found,
                                           .devices = choice.all ? NULL : choice.indices,
                                           .n = choice.n,
                                           .lost = device_is_lost};
  status = mo_compute_add_devices(compute, &config, &words);
  const bool is_named = module != NULL || !choice.all;
  if (status == MO_OK)
    log_devices(compute);
  else if ((status == MO_ERR_NOT_FOUND && !is_named) ||
           (status == MO_ERR_EXHAUSTED && choice.all)) {
    log_info("no devices found; using the CPU", LOG_TEXT("detail", words.text));
    status = MO_OK;
  } else
    (void)mo_fail(message, status, "devices: %.230s", words.text);
  return status;
}
