/* cmd_devices.c: devices. */
#include <inttypes.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

static void print_devices(const struct ctl *ctl, const json_t *devices)
{
  struct table table;
  size_t i;
  const json_t *device;
  table_open(&table, ">#|name|state|>load|>free GiB|>of GiB|>rollouts|>gradients|id");
  json_array_foreach(devices, i, device)
  {
    char number[24], load[24], unused[24], memory[24], rollouts[32], gradients[32];
    snprintf(number, sizeof(number), "%" PRId64, number_of(device, "index"));
    snprintf(load, sizeof(load), "%.0f %%",
             100 * json_number_value(json_object_get(device, "load")));
    snprintf(unused, sizeof(unused), "%.1f",
             (double)number_of(device, "free_bytes") / (double)(1 << 30));
    snprintf(memory, sizeof(memory), "%.1f",
             (double)number_of(device, "memory_bytes") / (double)(1 << 30));
    const char *cells[] = {number,
                           text_of(device, "name"),
                           text_of(device, "state"),
                           load,
                           unused,
                           memory,
                           count_text(number_of(device, "rollouts_done"), rollouts),
                           count_text(number_of(device, "gradient_robots_done"), gradients),
                           text_of(device, "id")};
    table_add(&table, cells);
  }
  table_print(&table, stdout, ctl);
}

static int tell_lost(const struct ctl *ctl, const json_t *devices)
{
  int status = STATUS_OK;
  size_t i;
  const json_t *device;
  json_array_foreach(devices, i, device)
  {
    if (strcmp(text_of(device, "state"), "lost") != 0)
      continue;
    status = STATUS_NEGATIVE;
    if (!ctl->json)
      print_plain_line(stderr, "device %" PRId64 " is lost: %s", number_of(device, "index"),
                       text_of(device, "error"));
  }
  return status;
}

int run_devices(struct ctl *ctl)
{
  json_t *answer = NULL;
  int status = transport_get_json(ctl, "/v1/devices", 0, &answer);
  const json_t *devices = json_object_get(answer, "items");
  if (status == STATUS_OK && ctl->json)
    print_json(answer);
  else if (status == STATUS_OK && json_array_size(devices) == 0)
    print_plain_line(stdout, "no devices: the processors compute");
  else if (status == STATUS_OK)
    print_devices(ctl, devices);
  if (status == STATUS_OK)
    status = tell_lost(ctl, devices);
  json_decref(answer);
  return status;
}
