/* cmd_status.c: status, devices, version, completion; dashboard: the address of the server's
 * pages. */
#include <pwd.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"

/* Returns why the server is not ready, or NULL if it is. "Not ready" is a valid result, so there
 * are no retries. */
static bool is_ready(struct ctl *ctl, json_t **why)
{
  const struct request request = {.method = "GET", .path = "/readyz", .once = true};
  struct reply reply;
  const int status = transport_try(ctl, &request, &reply);
  if (status != STATUS_OK)
    leave(status);
  json_t *problem =
      reply.status != 200 && reply.body != NULL ? json_loads(reply.body, 0, NULL) : NULL;
  *why = problem != NULL ? json_object_get(keep(problem), "detail") : NULL;
  const bool ready = reply.status == 200;
  reply_free(&reply);
  return ready;
}

void run_status(struct ctl *ctl)
{
  static const struct fact facts[] = {
      {"version", "{health.version}"},
      {"ready", "{word}[: {why:.150}]"},
      {"notice", "{health.notice}"},
      {"workers", "{workers.n_busy} of {workers.n_threads} busy"},
      {"waiting", "{workers.queued_interactive:,} interactive and {workers.queued_batch:,} batch "
                  "blocks"},
      {"rollouts", "{workers.rollouts_done:,} since the start"},
      {"float32", "{workers.fingerprints.float32}"},
      {"float64", "{workers.fingerprints.float64}"},
      {NULL, NULL}};
  json_t *why, *health = get_json(ctl, "/healthz");
  const bool ready = is_ready(ctl, &why);
  json_t *workers = get_json(ctl, "/v1/threads");
  if (ctl->json) {
    print_json(
        keep(json_pack("{s:O, s:b, s:O}", "health", health, "ready", ready, "workers", workers)));
  } else {
    print_fact(ctl, "server", "%s", ctl->server);
    print_facts(ctl,
                keep(json_pack("{s:O, s:s, s:O*, s:O}", "health", health, "word",
                               ready ? "yes" : "no", "why", why, "workers", workers)),
                facts);
  }
  if (!ready)
    leave(STATUS_NEGATIVE);
}

/* Exits with STATUS_NEGATIVE if a device is lost. */
static void tell_lost(const struct ctl *ctl, const json_t *devices)
{
  bool is_lost = false;
  size_t i;
  const json_t *device;
  json_array_foreach(devices, i, device)
  {
    if (strcmp(text_of(device, "state"), "lost") != 0)
      continue;
    is_lost = true;
    if (!ctl->json)
      print_from(stderr, device, "device {index} is lost: {error}");
  }
  if (is_lost)
    leave(STATUS_NEGATIVE);
}

void run_devices(struct ctl *ctl)
{
  const json_t *page = get_json(ctl, "/v1/devices"), *devices = json_object_get(page, "items");
  if (!ctl->json && json_array_size(devices) == 0)
    print_plain_line(stdout, "no devices: rollouts run on the CPU");
  else
    print_items(ctl, page,
                ">#={index}|name={name}|state={state}|>load={load:.0%}|>free GiB={free_bytes:GiB}"
                "|>of GiB={memory_bytes:GiB}|>rollouts={rollouts_done:,}"
                "|>gradients={gradient_robots_done:,}|id={id}");
  tell_lost(ctl, devices);
}

void run_version(struct ctl *ctl)
{
  if (ctl->json)
    printf("{\"version\":\"%s\"}\n", MORPHOD_VERSION);
  else
    printf("morphoctl %s\n", MORPHOD_VERSION);
}

void run_completion(struct ctl *ctl)
{
  options_print_completion(stdout, ctl);
}

/* ---- the pages ---- */

/* Prints the address. The token is in the part of it that is never sent. */
static void print_address(const char *server, const char *token)
{
  size_t length = strlen(server);
  while (length > 0 && server[length - 1] == '/')
    length--;
  print_plain_line(stdout, "%.*s/%s%s", (int)length, server, token != NULL ? "#token=" : "",
                   token != NULL ? escape(token) : "");
}

void run_dashboard(struct ctl *ctl)
{
  char host[256] = "this-machine";
  get_json(ctl, "/readyz");
  if (strncmp(ctl->server, "unix:", 5) != 0) {
    print_address(ctl->server, ctl->token);
    return;
  }
  gethostname(host, sizeof(host) - 1);
  const struct passwd *user = getpwuid(getuid());
  printf("A browser cannot open a unix socket. On the machine with the browser, type\n\n"
         "  ssh -N -L 8765:%s %s@%s\n\nand open\n\n  ",
         ctl->server + 5, user != NULL ? user->pw_name : "you", host);
  print_address("http://127.0.0.1:8765", ctl->token);
}
