/* cmd_status.c: status, devices, version, completion. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "template.h"
#include "transport.h"

/* Finds out whether the server is ready, and why not: a text or null. "Not ready" is a valid
 * result, so there are no retries. */
static int ask_ready(struct ctl *ctl, bool *is_ready, json_t **why)
{
  struct reply ready;
  int status = transport_try(
      ctl, &(struct request){.method = "GET", .path = "/readyz", .once = true}, &ready);
  *is_ready = status == STATUS_OK && ready.status == 200;
  json_t *problem = !*is_ready && ready.body != NULL ? json_loads(ready.body, 0, NULL) : NULL;
  *why = json_incref(json_object_get(problem, "detail"));
  json_decref(problem);
  reply_free(&ready);
  return status;
}

int run_status(struct ctl *ctl)
{
  static const struct fact facts[] = {
      {"version", "{health.version}"},
      {"ready", "{word}[: {why:.150}]"},
      {"workers", "{workers.n_busy} of {workers.n_threads} busy"},
      {"waiting", "{workers.queued_interactive:,} interactive and {workers.queued_batch:,} batch "
                  "blocks"},
      {"rollouts", "{workers.rollouts_done:,} since the start"},
      {"float32", "{workers.fingerprints.float32}"},
      {"float64", "{workers.fingerprints.float64}"},
      {NULL, NULL}};
  json_t *health = NULL, *workers = NULL, *why = NULL;
  bool is_ready = false;
  int status = get_json(ctl, &health, "/healthz");
  if (status == STATUS_OK)
    status = ask_ready(ctl, &is_ready, &why);
  if (status == STATUS_OK)
    status = get_json(ctl, &workers, "/v1/threads");
  if (status == STATUS_OK && ctl->json) {
    json_t *all =
        json_pack("{s:O, s:b, s:O}", "health", health, "ready", is_ready, "workers", workers);
    print_json(all);
    json_decref(all);
  } else if (status == STATUS_OK) {
    json_t *all = json_pack("{s:O, s:s, s:O*, s:O}", "health", health, "word",
                            is_ready ? "yes" : "no", "why", why, "workers", workers);
    print_fact(ctl, "server", "%s", ctl->server);
    print_facts(ctl, all, facts);
    json_decref(all);
  }
  json_decref(health);
  json_decref(workers);
  json_decref(why);
  return status == STATUS_OK && !is_ready ? STATUS_NEGATIVE : status;
}

/* Returns STATUS_NEGATIVE if a device is lost. */
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
      print_from(stderr, device, "device {index} is lost: {error}");
  }
  return status;
}

int run_devices(struct ctl *ctl)
{
  json_t *answer = NULL;
  int status = get_json(ctl, &answer, "/v1/devices");
  const json_t *devices = json_object_get(answer, "items");
  if (status == STATUS_OK && ctl->json)
    print_json(answer);
  else if (status == STATUS_OK && json_array_size(devices) == 0)
    print_plain_line(stdout, "no devices: the processors compute");
  else if (status == STATUS_OK)
    print_table(stdout, ctl, devices,
                ">#={index}|name={name}|state={state}|>load={load:.0%}|>free GiB={free_bytes:GiB}"
                "|>of GiB={memory_bytes:GiB}|>rollouts={rollouts_done:,}"
                "|>gradients={gradient_robots_done:,}|id={id}");
  if (status == STATUS_OK)
    status = tell_lost(ctl, devices);
  json_decref(answer);
  return status;
}

int run_version(struct ctl *ctl)
{
  if (ctl->json)
    printf("{\"version\":\"%s\"}\n", MORPHOD_VERSION);
  else
    printf("morphoctl %s\n", MORPHOD_VERSION);
  return STATUS_OK;
}

int run_completion(struct ctl *ctl)
{
  (void)ctl;
  options_print_completion(stdout);
  return STATUS_OK;
}
