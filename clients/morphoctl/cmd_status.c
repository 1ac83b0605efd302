/* cmd_status.c: status, version, completion. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

int run_status(struct ctl *ctl)
{
  json_t *health = NULL, *workers = NULL;
  struct reply ready;
  int status = transport_get_json(ctl, "/healthz", 0, &health);
  bool is_ready = false;
  char why[160] = "";
  if (status == STATUS_OK) {
    /* Do not retry: "not ready" is a valid result. */
    status = transport_try(ctl, &(struct request){.method = "GET", .path = "/readyz", .once = true},
                           &ready);
    is_ready = status == STATUS_OK && ready.status == 200;
    json_t *problem = status == STATUS_OK && !is_ready && ready.body != NULL
                          ? json_loads(ready.body, 0, NULL)
                          : NULL;
    snprintf(why, sizeof(why), "%.150s", text_of(problem, "detail"));
    json_decref(problem);
    reply_free(&ready);
  }
  if (status == STATUS_OK)
    status = transport_get_json(ctl, "/v1/threads", 0, &workers);
  if (status == STATUS_OK && ctl->json) {
    json_t *all =
        json_pack("{s:O, s:b, s:O}", "health", health, "ready", is_ready, "workers", workers);
    print_json(all);
    json_decref(all);
  } else if (status == STATUS_OK) {
    char a[32], b[32];
    const json_t *fingerprints = json_object_get(workers, "fingerprints");
    print_fact(ctl, "server", "%s", ctl->server);
    print_fact(ctl, "version", "%s", text_of(health, "version"));
    print_fact(ctl, "ready", "%s%s%s", is_ready ? "yes" : "no", *why != 0 ? ": " : "", why);
    print_fact(ctl, "workers", "%" PRId64 " of %" PRId64 " busy", number_of(workers, "n_busy"),
               number_of(workers, "n_threads"));
    print_fact(ctl, "waiting", "%s interactive and %s batch blocks",
               count_text(number_of(workers, "queued_interactive"), a),
               count_text(number_of(workers, "queued_batch"), b));
    print_fact(ctl, "rollouts", "%s since the start",
               count_text(number_of(workers, "rollouts_done"), a));
    print_fact(ctl, "float32", "%s", text_of(fingerprints, "float32"));
    print_fact(ctl, "float64", "%s", text_of(fingerprints, "float64"));
  }
  json_decref(health);
  json_decref(workers);
  if (status == STATUS_OK && !is_ready)
    status = STATUS_NEGATIVE;
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
