/* fleet.c: see fleet.h. */
#include "daemon/fleet.h"

#include <errno.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>

#include "base/clock.h"
#include "daemon/log.h"
#include "daemon/memory.h"
#include "daemon/tokens.h"
#include "fleet/facts.h"
#include "jobs/jobs.h"
#include "store/runner.h"
#include "store/store.h"

#define PEM_MAX 65536 /* bytes of a file */

/* Each session has one connection for its orders and one for leases; a third one may just have been
 * lost. */
#define CONNECTIONS_MAX (3 * 4096)
#define BODY_BYTES      (UINT64_C(8) << 20) /* for an exchange */
#define BODY_MEMORY     (UINT64_C(256) << 20)
#define BODY_TIMEOUT_MS 300000 /* 8 MiB at 250 kbit/s */

/* Reads a text (malloc, with a NUL). A pipe is rejected: reading it could block indefinitely. */
static int read_pem(const char *name, const char *path, char **text, struct mo_message *message)
{
  struct stat status;
  FILE *file = NULL;
  errno = 0;
  if (stat(path, &status) != 0 || !S_ISREG(status.st_mode) || (file = fopen(path, "re")) == NULL)
    return mo_fail(message, MO_ERR_INVALID, "%s: %s: %s", name, path,
                   errno != 0 ? strerror(errno) : "not a file");
  *text = enough(calloc(1, PEM_MAX + 1));
  const size_t n = fread(*text, 1, PEM_MAX + 1, file);
  const bool failed = ferror(file) != 0;
  fclose(file);
  if (failed || n == 0 || n > PEM_MAX)
    return mo_fail(message, MO_ERR_INVALID, "%s: %s: %s", name, path,
                   failed   ? strerror(errno)
                   : n == 0 ? "the file is empty"
                            : "the file is larger than 65536 bytes");
  return MO_OK;
}

int fleet_certificate_read(const struct settings *settings, struct fleet_certificate *pair,
                           struct mo_message *message)
{
  *pair = (struct fleet_certificate){NULL, NULL};
  if (settings->fleet_certificate == NULL || settings->fleet_key == NULL)
    return MO_OK;
  struct mo_message why = {{0}};
  int error =
      read_pem("fleet_certificate", settings->fleet_certificate, &pair->certificate, message);
  if (error == MO_OK)
    error = read_pem("fleet_key", settings->fleet_key, &pair->key, message);
  if (error == MO_OK &&
      (error = mo_http_check_certificate(pair->certificate, pair->key, &why)) != MO_OK)
    mo_fail(message, error, "fleet_certificate, fleet_key: %s", why.text);
  if (error != MO_OK)
    fleet_certificate_free(pair);
  return error;
}

void fleet_certificate_free(struct fleet_certificate *pair)
{
  if (pair->key != NULL)
    explicit_bzero(pair->key, PEM_MAX);
  free(pair->key);
  free(pair->certificate);
  *pair = (struct fleet_certificate){NULL, NULL};
}

bool fleet_is_on(const struct settings *settings)
{
  return settings->fleet_listen.n > 0 && settings->compute != COMPUTE_LOCAL;
}

uint32_t fleet_max_connections(const struct settings *settings)
{
  return fleet_is_on(settings) ? CONNECTIONS_MAX : 0;
}

/* ---- sessions and leases ---- */

struct fleet {
  struct mo_fleet *fleet;
  struct mo_store *store;
  struct mo_compute *compute;
  struct mo_jobs *jobs;         /* set when the fleet is served */
  _Atomic(struct mo_api *) api; /* NULL: not served yet */
};

static void wake(void *context, uint64_t session)
{
  struct fleet *fleet = context;
  struct mo_api *api = atomic_load(&fleet->api);
  if (api != NULL)
    mo_api_wake_session(api, session);
}

static void store_event(void *context, const char *type, const char *data)
{
  struct fleet *fleet = context;
  const int error = mo_store_event(fleet->store, type, data);
  if (error != MO_OK)
    log_warning("an event was not stored", LOG_TEXT("event", type), LOG_TEXT("data", data),
                LOG_TEXT("reason", mo_error_text(error)));
}

static int name_class(void *context, enum mo_back_end back_end, const char *scores,
                      const char *gradients, const char *names[2])
{
  const struct fleet *fleet = context;
  const int error = back_end == MO_ON_DEVICE ? mo_jobs_name_devices(fleet->jobs, scores, gradients)
                                             : MO_ERR_INVALID;
  names[0] = mo_compute_device_fingerprint(fleet->compute);
  names[1] = mo_compute_device_gradient_fingerprint(fleet->compute);
  if (error == MO_OK)
    log_info("workers have devices", LOG_TEXT("scores", names[0]), LOG_TEXT("gradients", names[1]));
  return error == MO_ERR_CONFLICT && names[0] != NULL ? MO_OK : error;
}

static int origin(void *context, const char *text, int64_t *number)
{
  struct fleet *fleet = context;
  return mo_store_origin(fleet->store, text, number);
}

static void arrived(void *context)
{
  struct fleet *fleet = context;
  struct mo_api *api = atomic_load(&fleet->api);
  struct mo_http *http = api != NULL ? mo_api_fleet_http(api) : NULL;
  mo_fleet_arrived(fleet->fleet);
  if (http != NULL)
    mo_http_tick_soon(http);
}

int fleet_create(const struct settings *settings, struct mo_store *store,
                 struct mo_compute *compute, struct fleet **ret, struct mo_message *message)
{
  if (!fleet_is_on(settings))
    return MO_OK;
  struct fleet *fleet = enough(calloc(1, sizeof(*fleet)));
  *fleet = (struct fleet){.store = store, .compute = compute};
  struct mo_fleet_config config = {.source = mo_fleet_source_of(compute),
                                   .workspace = MO_STORE_WORKSPACE,
                                   .epoch = mo_store_epoch(store),
                                   .version = MORPHOD_VERSION,
                                   .name_class = name_class,
                                   .origin = origin,
                                   .wake = wake,
                                   .event = store_event,
                                   .context = fleet};
  config.classes[MO_ON_CPU].scores = mo_compute_fingerprint(compute, MO_FLOAT32);
  config.classes[MO_ON_CPU].gradients = mo_compute_gradient_fingerprint(compute);
  config.classes[MO_ON_DEVICE].scores = mo_compute_device_fingerprint(compute);
  config.classes[MO_ON_DEVICE].gradients = mo_compute_device_gradient_fingerprint(compute);
  config.classes[MO_ON_DEVICE].is_absent = mo_compute_expects_devices(compute);
  int error = getrandom(&config.seed, sizeof(config.seed), 0) > 0 ? MO_OK : MO_ERR_IO;
  for (int i = 0; i < 2 && error == MO_OK; i++)
    if (config.classes[i].scores != NULL && !config.classes[i].is_absent)
      error = mo_fleet_canary(compute, (enum mo_back_end)i, &config.classes[i].canary);
  if (error == MO_OK)
    error = mo_fleet_create(&config, &fleet->fleet);
  if (error != MO_OK) {
    free(fleet);
    return mo_fail(message, error, "fleet: %s", mo_error_text(error));
  }
  mo_compute_watch_remote(compute, arrived, fleet);
  mo_compute_leave_remote(compute, settings->compute == COMPUTE_FLEET);
  *ret = fleet;
  return MO_OK;
}

void fleet_end_others(struct fleet *fleet, const struct mo_token *tokens, size_t n)
{
  struct mo_session_status *sessions;
  size_t n_sessions;
  if (mo_fleet_sessions(fleet->fleet, &sessions, &n_sessions) != MO_OK)
    return; /* without valid tokens, their requests are refused, and they soon count as silent */
  for (size_t i = 0; i < n_sessions; i++) {
    bool is_known = sessions[i].offer.user[0] == '\0' && n == 0;
    for (size_t k = 0; k < n && !is_known; k++)
      is_known = strcmp(sessions[i].offer.user, tokens[k].name) == 0;
    if (!is_known && sessions[i].ended_ns == 0)
      mo_fleet_leave(fleet->fleet, sessions[i].id, true, mo_clock_ns());
  }
  free(sessions);
}

void fleet_retire(struct fleet *fleet)
{
  if (fleet == NULL)
    return;
  mo_compute_watch_remote(fleet->compute, NULL, NULL);
  atomic_store(&fleet->api, NULL);
}

void fleet_free(struct fleet *fleet)
{
  if (fleet == NULL)
    return;
  mo_compute_leave_remote(fleet->compute, false);
  mo_fleet_free(fleet->fleet);
  free(fleet);
}

/* ---- the server ---- */

static struct mo_http_config limits_of(const struct settings *settings)
{
  const uint64_t memory = memory_limit_of(settings->max_memory) / 8;
  return (struct mo_http_config){
      .max_connections = CONNECTIONS_MAX,
      .other_files = (uint32_t)settings->max_connections,
      .max_in_flight = CONNECTIONS_MAX, /* one address may have many workers */
      .client_rate_per_s = (uint32_t)settings->client_rate_per_s,
      .max_queued = CONNECTIONS_MAX,
      .max_file_bytes = BODY_BYTES,
      .max_body_memory = memory < BODY_MEMORY ? memory : BODY_MEMORY,
      .header_timeout_ms = (uint32_t)settings->header_timeout_ms,
      .body_timeout_ms = BODY_TIMEOUT_MS,
      .idle_timeout_ms = (uint32_t)settings->idle_timeout_ms,
  };
}

static void warn_of_few_files(const struct mo_http *http)
{
  struct mo_http_stats stats;
  mo_http_get_stats((struct mo_http *)http, &stats);
  if (stats.max_connections < CONNECTIONS_MAX)
    log_warning(
        "the limit on open files reduces the number of worker connections; raise it (LimitNOFILE=)",
        LOG_INT("max_connections", CONNECTIONS_MAX), LOG_INT("used", stats.max_connections));
}

int fleet_serve(struct fleet *fleet, const struct settings *settings, struct sockets *sockets,
                struct mo_jobs *jobs, struct mo_api *api,
                void (*log)(void *context, const struct mo_http_log_entry *entry),
                struct mo_message *message)
{
  static const char *const words[] = {
      [COMPUTE_BOTH] = "both", [COMPUTE_LOCAL] = "local", [COMPUTE_FLEET] = "fleet"};
  struct tokens tokens;
  struct fleet_certificate pair;
  int error = fleet_certificate_read(settings, &pair, message);
  if (error != MO_OK)
    return error;
  error = tokens_read(settings->token_file, &tokens, message);
  if (error == MO_OK) {
    struct mo_http_config config = limits_of(settings);
    const struct mo_api_fleet shared = {fleet->fleet, mo_store_epoch(fleet->store),
                                        words[settings->compute]};
    config.listeners = sockets->fd;
    config.n_listeners = sockets->n;
    config.allowed_hosts = (const char *const *)settings->allowed_hosts.items;
    config.n_allowed_hosts = settings->allowed_hosts.n;
    config.tokens = tokens.items;
    config.n_tokens = tokens.n_workers;
    config.token_if_any = true;
    config.certificate = pair.certificate;
    config.key = pair.key;
    config.log = log;
    config.log_context = fleet;
    fleet->jobs = jobs;
    atomic_store(&fleet->api, api);
    error = mo_api_start_fleet(api, &config, &shared, message);
    sockets_hand_over(sockets);
    tokens_free(&tokens);
  } else if (error == MO_ERR_IO) {
    error = MO_ERR_INVALID; /* MO_ERR_IO would mean an error of a socket */
  }
  fleet_certificate_free(&pair);
  if (error == MO_OK)
    warn_of_few_files(mo_api_fleet_http(api));
  return error;
}
