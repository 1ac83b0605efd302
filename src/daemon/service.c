/* service.c: see service.h. Starts in this order: listeners (where a failure costs least), state
 * folder, store, crash marker, back end, jobs, controller, HTTP. Stops in the reverse order, except
 * that jobs park before HTTP ends, so that replies can still be sent. */
#include "service.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <grp.h>
#include <systemd/sd-daemon.h>

#include <morpho/compute.h>
#include <morpho/controller.h>

#include "api/api.h"
#include "base/clock.h"
#include "base/json.h"
#include "base/text.h"
#include "daemon/crash.h"
#include "daemon/devices.h"
#include "daemon/fleet.h"
#include "daemon/log.h"
#include "daemon/memory.h"
#include "daemon/sockets.h"
#include "daemon/tokens.h"
#include "jobs/jobs.h"
#include "store/store.h"

#define EVENT_FIELDS_MAX 16
#define OPEN_LIMIT_US    (UINT64_C(3600) * 1000000)
#define STORE_READERS                                                                              \
  8 /* more than the threads that read: the API, the HTTP clock, the scheduler */
#define JOBS_STOP_MS  3000
#define HTTP_GRACE_MS 1000

struct service {
  char *state_dir;
  struct sockets sockets, fleet_sockets; /* of `http`, of `fleet_http` */
  gid_t groups[64];                      /* that may use unix sockets */
  struct mo_store *store;
  struct mo_compute *compute;
  struct fleet *fleet; /* NULL: off */
  struct mo_jobs *jobs;
  struct mo_api *api;
  struct mo_http *http; /* of `api` */
  int subscription;     /* −1: none */
  bool crash_marker;
  char *last_marker; /* of the previous process, if it crashed; else NULL */
  int64_t killed_us; /* when the previous process began, if it was killed; else 0 */
  void (*fatal)(void *context, const char *what);
  uint64_t jobs_expired; /* as logged so far */
  bool clock_doubted;    /* logged */
};

/* ---- parts ---- */

static int make_folders(const char *path, struct mo_message *message)
{
  char *copy = enough(strdup(path));
  int status = MO_OK;
  for (char *slash = copy + 1;; slash++) {
    if (*slash != '/' && *slash != 0)
      continue;
    char kept = *slash;
    *slash = 0;
    if (mkdir(copy, 0700) != 0 && errno != EEXIST)
      status = mo_fail(message, errno == ENOSPC ? MO_ERR_NO_SPACE : MO_ERR_IO, "state_dir: %s: %s",
                       copy, strerror(errno));
    *slash = kept;
    if (kept == 0 || status != MO_OK)
      break;
  }
  free(copy);
  return status;
}

static int open_listeners(struct service *service, const struct settings *settings,
                          struct mo_message *message)
{
  char **names = NULL;
  const int n_passed = sd_listen_fds_with_names(1, &names);
  if (n_passed < 0)
    return mo_fail(message, MO_ERR_IO, "cannot use the sockets that were passed: %s",
                   strerror(-n_passed));
  int status = MO_OK;
  for (int i = 0; i < n_passed && status == MO_OK; i++) {
    status = sockets_add(&service->sockets, SD_LISTEN_FDS_START + i, NULL, message);
    if (status == MO_OK)
      log_debug("socket taken", LOG_TEXT("name", names != NULL ? names[i] : NULL),
                LOG_TEXT("address", service->sockets.addresses[i]));
  }
  for (int i = 0; names != NULL && names[i] != NULL; i++)
    free(names[i]);
  free(names);
  for (size_t i = 0; fleet_is_on(settings) && i < settings->fleet_listen.n && status == MO_OK; i++)
    status = sockets_add(&service->fleet_sockets, -1, settings->fleet_listen.items[i], message);
  if (settings->fleet_certificate != NULL)
    sockets_use_tls(&service->fleet_sockets);
  size_t row = 0;
  while (settings_table[row].offset != offsetof(struct settings, listen))
    row++;
  if (n_passed > 0 && settings->source[row] == SOURCE_DEFAULT)
    return status;
  for (size_t i = 0; i < settings->listen.n && status == MO_OK; i++)
    status = sockets_add(&service->sockets, -1, settings->listen.items[i], message);
  return status;
}

/* Copies a text of the event into the remaining space, and terminates it. */
static const char *keep(char **room, struct mo_json_slice text)
{
  char *kept = *room;
  memcpy(kept, text.bytes, text.size);
  kept[text.size] = '\0';
  *room += text.size + 1;
  return kept;
}

/* Logs an event, with the members of its data as fields. */
static void log_event(enum log_level level, const struct mo_event *event)
{
  struct log_field fields[EVENT_FIELDS_MAX];
  char kept[sizeof(event->data)], *room = kept; /* large enough, because each text had quotes */
  size_t n = 0;
  fields[n++] = LOG_INT("event", event->sequence);
  if (event->job != 0)
    fields[n++] = LOG_INT("job", event->job);
  struct mo_faults faults = {0};
  struct mo_json json;
  struct mo_json_slice key, text;
  mo_json_start(&json, event->data, strlen(event->data), &faults);
  bool object = mo_json_object(&json);
  while (object && n < EVENT_FIELDS_MAX && mo_json_member(&json, &key)) {
    enum mo_json_kind kind = mo_json_peek(&json);
    double number;
    if (mo_json_is(key, "id") || mo_json_is(key, "kind")) /* the line already has the job's id */
      mo_json_skip(&json);
    else if (kind == MO_JSON_STRING && mo_json_string(&json, &text)) {
      const char *name = keep(&room, key);
      fields[n++] = LOG_TEXT(name, keep(&room, text));
    } else if (kind == MO_JSON_NUMBER && mo_json_number(&json, &number)) {
      bool whole = number == nearbyint(number) && fabs(number) < 0x1p53;
      const char *name = keep(&room, key);
      fields[n++] = whole ? LOG_INT(name, (int64_t)number) : LOG_REAL(name, number);
    } else if (kind != MO_JSON_STRING && kind != MO_JSON_NUMBER)
      mo_json_skip(&json);
  }
  log_write(level, event->type, fields, n);
}

static void job_has_failed(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  log_warning("a job had an error", LOG_INT("job", job), LOG_TEXT("code", mo_error_name(error)),
              LOG_TEXT("detail", text));
}

static enum log_level level_of(const char *type)
{
  static const char *const warnings[] = {"campaign.lineage_unreadable",
                                         "fleet.differs",
                                         "fleet.empty",
                                         "fleet.lost",
                                         "fleet.refused",
                                         "job.warning",
                                         "scores.differ"};
  const char *what = strrchr(type, '.');
  if (what != NULL && strcmp(what, ".progress") == 0)
    return LOG_LEVEL_DEBUG;
  bool is_warning = what != NULL && strcmp(what, ".code_changed") == 0;
  for (size_t i = 0; i < sizeof(warnings) / sizeof(warnings[0]); i++)
    is_warning = is_warning || strcmp(type, warnings[i]) == 0;
  return is_warning ? LOG_LEVEL_WARNING : LOG_LEVEL_INFO;
}

static void log_events(void *context, const struct mo_event *events, size_t n)
{
  (void)context;
  for (size_t i = 0; i < n; i++) {
    enum log_level level = level_of(events[i].type);
    if (log_enabled(level))
      log_event(level, &events[i]);
  }
}

/* Logs a request. context: not NULL for the server of workers. */
static void log_request(void *context, const struct mo_http_log_entry *entry)
{
  /* Successful health checks, scrapes and exchanges of workers arrive every few seconds, and carry
   * no information. */
  bool probe = entry->status == 200 &&
               (context != NULL || strcmp(entry->path, "/healthz") == 0 ||
                strcmp(entry->path, "/readyz") == 0 || strcmp(entry->path, "/metrics") == 0);
  enum log_level level = entry->status >= 500 || entry->reason != NULL ? LOG_LEVEL_WARNING
                         : probe                                       ? LOG_LEVEL_DEBUG
                                                                       : LOG_LEVEL_INFO;
  struct log_field fields[10] = {
      LOG_TEXT("request", entry->request_id), LOG_TEXT("client", entry->client),
      LOG_TEXT("method", entry->method),      LOG_TEXT("path", entry->path),
      LOG_INT("status", entry->status),       LOG_INT("body_in", entry->body_in),
      LOG_INT("body_out", entry->body_out),   LOG_REAL("seconds", entry->duration_s),
  };
  size_t n = 8;
  if (entry->user[0] != '\0')
    fields[n++] = LOG_TEXT("user", entry->user);
  if (entry->reason != NULL)
    fields[n++] = LOG_TEXT("reason", entry->reason);
  log_write(level, "request", fields, n);
}

enum { CONTROLLER_NAME_BYTES = 128 };

/* Returns the name of a file without folder and ".safetensors", or "default" if that is not a valid
 * name for a controller. */
static const char *name_of_file(const char *path, char name[CONTROLLER_NAME_BYTES])
{
  static const char ending[] = ".safetensors";
  const char *slash = strrchr(path, '/');
  snprintf(name, CONTROLLER_NAME_BYTES, "%s", slash != NULL ? slash + 1 : path);
  const size_t length = strlen(name);
  if (length > strlen(ending) && strcmp(name + length - strlen(ending), ending) == 0)
    name[length - strlen(ending)] = '\0';
  return mo_controller_name_check(name) == MO_OK ? name : "default";
}

/* Stores a file's controller under the name of the file, and as "default" if it is that. */
static int store_controller(struct service *service, const char *path, bool is_default,
                            struct mo_message *message)
{
  struct mo_controller_record record;
  struct mo_controller *controller = NULL;
  struct stat info = {.st_size = 0};
  uint8_t *bytes = NULL;
  int status = mo_controller_read(path, &controller, message);
  /* Store the bytes of the file itself, because the hash of a controller is the hash of its
   * file. */
  FILE *file = status == MO_OK ? fopen(path, "re") : NULL;
  if (status == MO_OK && (file == NULL || fstat(fileno(file), &info) != 0 ||
                          (bytes = malloc((size_t)info.st_size)) == NULL ||
                          fread(bytes, (size_t)info.st_size, 1, file) != 1))
    status = mo_fail(message, MO_ERR_IO, "%s: %s", path, strerror(errno));
  if (file != NULL)
    fclose(file);
  char own_name[CONTROLLER_NAME_BYTES];
  const char *const names[] = {name_of_file(path, own_name), "default"};
  for (size_t i = 0; i < (is_default ? 2 : 1) && status == MO_OK; i++) {
    bool created;
    status = mo_store_controller_put(service->store, names[i], bytes, (size_t)info.st_size,
                                     controller, &record, &created);
  }
  if (status == MO_OK)
    log_info(is_default ? "default controller stored" : "controller stored",
             LOG_TEXT("file", path));
  free(bytes);
  mo_controller_free(controller);
  return status;
}

/* On the first start, stores the installed controllers: the default one as "default" and under the
 * name of its file, which remains when "default" is replaced; and, unless the settings name a
 * different one, the other installed controllers. */
static int store_default_controller(struct service *service, const struct settings *settings,
                                    struct mo_message *message)
{
  static const char *const others[] = {PAPER_CONTROLLER, GENERALIST_CONTROLLER, ROBUST_CONTROLLER};
  struct mo_controller_record record;
  const char *path = settings->default_controller;
  int status = mo_store_controller(service->store, "default", &record);
  if (status == MO_ERR_CORRUPT)
    snprintf(message->text, sizeof(message->text), "the controller default cannot be read: %s",
             mo_error_text(status));
  if (status != MO_ERR_NOT_FOUND)
    return status;
  if (path != NULL)
    return store_controller(service, path, true, message);
  status = MO_OK;
  for (size_t i = 0; status == MO_OK && i < sizeof(others) / sizeof(others[0]); i++)
    status = store_controller(service, others[i], false, message);
  return status == MO_OK ? store_controller(service, SHIPPED_CONTROLLER, true, message) : status;
}

/* Returns the memory for bodies: eight of the largest, but not more than an eighth of max_memory.
 */
static uint64_t body_memory(const struct settings *settings)
{
  const uint64_t larger = settings->max_body_bytes > settings->max_controller_bytes
                              ? settings->max_body_bytes
                              : settings->max_controller_bytes;
  const uint64_t bundles = 2 * settings->max_bundle_bytes;
  const uint64_t wanted = 8 * larger > bundles ? 8 * larger : bundles;
  const uint64_t most = memory_limit_of(settings->max_memory) / 8;
  return wanted < most ? wanted : most;
}

static int start_http(struct service *service, const struct settings *settings,
                      struct mo_message *message)
{
  struct tokens tokens;
  int status = tokens_read(settings->token_file, &tokens, message);
  if (status != MO_OK)
    return status == MO_ERR_IO ? MO_ERR_INVALID : status; /* not an error of a socket */
  for (size_t i = 0; i < settings->unix_groups.n && status == MO_OK; i++) {
    const struct group *group = getgrnam(settings->unix_groups.items[i]);
    if (group == NULL)
      status = mo_fail(message, MO_ERR_INVALID, "unix_groups: group \"%s\" does not exist",
                       settings->unix_groups.items[i]);
    else
      service->groups[i] = group->gr_gid;
  }
  struct mo_http_config config = {
      .listeners = service->sockets.fd,
      .n_listeners = service->sockets.n,
      .allowed_hosts = (const char *const *)settings->allowed_hosts.items,
      .n_allowed_hosts = settings->allowed_hosts.n,
      .tokens = tokens.items + tokens.n_workers,
      .n_tokens = tokens.n - tokens.n_workers,
      .token_on_loopback = settings->token_on_loopback != 0,
      .unix_groups = service->groups,
      .n_unix_groups = settings->unix_groups.n,
      .max_connections = (uint32_t)settings->max_connections,
      .other_files = fleet_max_connections(settings),
      .max_streams = (uint32_t)settings->max_streams,
      .max_in_flight = (uint32_t)settings->max_in_flight,
      .client_rate_per_s = (uint32_t)settings->client_rate_per_s,
      .max_body_bytes = settings->max_body_bytes,
      .max_file_bytes = settings->max_controller_bytes,
      .max_bundle_bytes = settings->max_bundle_bytes,
      .header_timeout_ms = (uint32_t)settings->header_timeout_ms,
      .body_timeout_ms = (uint32_t)settings->body_timeout_ms,
      .idle_timeout_ms = (uint32_t)settings->idle_timeout_ms,
      .max_body_memory = body_memory(settings),
      .log = log_request,
  };
  struct mo_api_services services = {.store = service->store,
                                     .jobs = service->jobs,
                                     .compute = service->compute,
                                     .version = MORPHOD_VERSION,
                                     .log_dropped = log_dropped,
                                     .dashboard = (enum mo_dashboard)settings->dashboard};
  if (status == MO_OK) {
    status = mo_api_start(&config, &services, &service->api, message);
    sockets_hand_over(&service->sockets); /* even if the start failed */
  }
  if (status == MO_OK) {
    struct mo_http_stats stats;
    service->http = mo_api_http(service->api);
    mo_http_get_stats(service->http, &stats);
    if (stats.max_connections < settings->max_connections)
      log_warning("the limit on open files allows fewer connections than max_connections: raise it "
                  "(LimitNOFILE=)",
                  LOG_INT("max_connections", settings->max_connections),
                  LOG_INT("used", stats.max_connections));
  }
  tokens_free(&tokens);
  return status;
}

static int serve_fleet(struct service *service, const struct settings *settings,
                       struct mo_message *message)
{
  return service->fleet == NULL ? MO_OK
                                : fleet_serve(service->fleet, settings, &service->fleet_sockets,
                                              service->jobs, service->api, log_request, message);
}

/* ---- start ---- */

static int exit_status_of(int error, int otherwise)
{
  switch (error) {
  case MO_ERR_NO_MEMORY: return EXIT_SYSTEM;
  case MO_ERR_UNSUPPORTED: return EXIT_CONFIG;
  case MO_ERR_BUSY: return EXIT_IN_USE;
  default: return otherwise;
  }
}

int service_store_status(int error)
{
  const bool needs_a_person =
      error == MO_ERR_FORMAT || error == MO_ERR_INVALID || error == MO_ERR_CONFLICT;
  return exit_status_of(error, needs_a_person ? EXIT_CONFIG : EXIT_STATE);
}

/* Returns the budget of all recordings, which is at least the budget of one evaluation; 0: no
 * limit. */
static uint64_t max_recordings_of(const struct settings *settings)
{
  const uint64_t all = settings->max_recordings_bytes, one = settings->max_recorded_bytes;
  return all > 0 && all < one ? one : all;
}

static int64_t seconds_of(uint64_t ms)
{
  return (int64_t)(ms + 999) / 1000;
}

static int open_store(struct service *service, const struct settings *settings,
                      struct mo_message *message)
{
  /* A migration, or the check after an unclean stop, takes time in proportion to the database:
   * systemd must not end it. */
  sd_notifyf(0, "STATUS=Opening the state folder\nEXTEND_TIMEOUT_USEC=%" PRIu64, OPEN_LIMIT_US);
  const struct mo_store_config config = {
      .path = settings->state_dir,
      .n_readers = STORE_READERS,
      .events_kept = settings->events_kept,
      .max_recordings_bytes = max_recordings_of(settings),
      .max_excluded_bytes = settings->max_excluded_bytes,
      .keep_jobs_s = {[MO_JOB_EVALUATION] = seconds_of(settings->keep_evaluations_ms),
                      [MO_JOB_TRAINING] = seconds_of(settings->keep_trainings_ms),
                      [MO_JOB_CAMPAIGN] = seconds_of(settings->keep_campaigns_ms)},
      .keep_recordings_s = seconds_of(settings->keep_recordings_ms),
      .fatal = service->fatal};
  mo_store_limit_memory(memory_limit_of(settings->max_memory) / 8);
  int error = make_folders(settings->state_dir, message);
  if (error == MO_OK)
    error = mo_store_open(&config, &service->store, message);
  if (error == MO_OK)
    error = crash_open(settings->state_dir, &service->last_marker, &service->killed_us, message);
  if (error != MO_OK)
    return error;
  service->crash_marker = true;
  if (service->last_marker != NULL)
    log_warning("the previous process crashed while it computed a job",
                LOG_TEXT("marker", service->last_marker));
  const struct mo_orphans *orphans = mo_store_orphans(service->store);
  if (orphans->n > 0)
    log_warning("unused files remain in the state folder; `morphod store clean` removes them",
                LOG_INT("files", (int64_t)orphans->n), LOG_INT("bytes", (int64_t)orphans->bytes),
                LOG_TEXT("first", orphans->first));
  mo_store_subscribe(service->store, log_events, service, &service->subscription);
  return MO_OK;
}

static int start_workers(struct service *service, const struct settings *settings,
                         struct mo_message *message)
{
  const struct mo_compute_config config = {
      .n_workers = (uint32_t)settings->workers,
      .isa = settings->isa == 0 ? mo_isa_best() : (enum mo_isa)(settings->isa - 1),
      .nice = (int)settings->worker_nice};
  const int error = mo_compute_create_cpu(&config, &service->compute);
  return error == MO_OK ? MO_OK : mo_fail(message, error, "workers: %s", mo_error_text(error));
}

static int open_devices(struct service *service, const struct settings *settings,
                        struct mo_message *message)
{
  const int error =
      devices_open(service->compute, &settings->devices, settings->compute_module, message);
  return error == MO_OK && mo_compute_devices(service->compute) == 0 && fleet_is_on(settings)
             ? mo_compute_expect_devices(service->compute) /* workers may have devices */
             : error;
}

static int create_fleet(struct service *service, const struct settings *settings,
                        struct mo_message *message)
{
  return fleet_create(settings, service->store, service->compute, &service->fleet, message);
}

static int start_jobs(struct service *service, const struct settings *settings,
                      struct mo_message *message)
{
  const struct mo_jobs_config config = {.max_open_jobs = (uint32_t)settings->max_open_jobs,
                                        .max_open_rollouts = settings->max_open_rollouts,
                                        .max_recorded_bytes = settings->max_recorded_bytes,
                                        .max_active_trainings = (uint32_t)settings->max_trainings,
                                        .max_active_campaigns = (uint32_t)settings->max_campaigns,
                                        .version = MORPHOD_VERSION,
                                        .max_memory = memory_limit_of(settings->max_memory),
                                        .crash_marker = service->last_marker,
                                        .killed_us = service->killed_us,
                                        .warn = job_has_failed};
  return mo_jobs_create(service->store, service->compute, &config, &service->jobs, message);
}

/* The parts in starting order, with the exit status of an error: `other_status` for the errors in
 * `others`, otherwise `status`. */
static const struct part {
  int (*start)(struct service *service, const struct settings *settings,
               struct mo_message *message);
  enum exit_status status, other_status;
  int others[3];
} parts[] = {
    {open_listeners, EXIT_UNAVAILABLE, EXIT_CONFIG, {MO_ERR_INVALID}},
    {open_store, EXIT_STATE, EXIT_CONFIG, {MO_ERR_FORMAT, MO_ERR_INVALID, MO_ERR_CONFLICT}},
    {start_workers, EXIT_SYSTEM, EXIT_SYSTEM, {0}},
    {open_devices, EXIT_CONFIG, EXIT_CONFIG, {0}},
    {create_fleet, EXIT_SYSTEM, EXIT_SYSTEM, {0}},
    {store_default_controller, EXIT_CONFIG, EXIT_STATE, {MO_ERR_NO_SPACE, MO_ERR_CORRUPT}},
    {start_jobs, EXIT_INTERNAL, EXIT_STATE, {MO_ERR_IO, MO_ERR_NO_SPACE}},
    {start_http, EXIT_CONFIG, EXIT_UNAVAILABLE, {MO_ERR_IO}},
    {serve_fleet, EXIT_CONFIG, EXIT_UNAVAILABLE, {MO_ERR_IO}},
};

/* Completes the message about a part that could not start, and returns the exit status. */
static int fail_with(struct mo_message *message, int error, const struct part *part)
{
  int status = part->status;
  if (message->text[0] == 0)
    snprintf(message->text, sizeof(message->text), "%s", mo_error_text(error));
  if (error == MO_ERR_NO_SPACE) {
    size_t n = strlen(message->text);
    snprintf(message->text + n, sizeof(message->text) - n,
             "; free space on the disk of the state folder, then restart");
  }
  for (size_t i = 0; i < sizeof(part->others) / sizeof(part->others[0]); i++)
    if (part->others[i] == error)
      status = part->other_status;
  return exit_status_of(error, status);
}

int service_start(const struct settings *settings, void (*fatal)(void *context, const char *what),
                  struct service **ret_service, struct mo_message *message)
{
  message->text[0] = 0;
  struct service *service = enough(calloc(1, sizeof(*service)));
  service->state_dir = enough(strdup(settings->state_dir));
  service->fatal = fatal;
  service->subscription = -1;
  for (size_t i = 0; i < sizeof(parts) / sizeof(parts[0]); i++) {
    const int error = parts[i].start(service, settings, message);
    if (error != MO_OK) {
      service_stop(service);
      return fail_with(message, error, &parts[i]);
    }
  }
  mo_http_set_ready(service->http, true);
  if (service->fleet != NULL)
    mo_http_set_ready(mo_api_fleet_http(service->api), true);
  *ret_service = service;
  return EXIT_OK;
}

size_t service_addresses(const struct service *service, bool of_fleet,
                         const char *const **addresses)
{
  const struct sockets *sockets = of_fleet ? &service->fleet_sockets : &service->sockets;
  *addresses = sockets->addresses;
  return sockets->n;
}

int service_reload_tokens(struct service *service, const struct settings *settings,
                          struct mo_message *message)
{
  struct tokens tokens;
  int status = tokens_read(settings->token_file, &tokens, message);
  if (status != MO_OK)
    return status;
  struct mo_http *fleet = mo_api_fleet_http(service->api);
  status = mo_http_set_tokens(service->http, tokens.items + tokens.n_workers,
                              tokens.n - tokens.n_workers, message);
  if (status == MO_OK && fleet != NULL)
    status = mo_http_set_tokens(fleet, tokens.items, tokens.n_workers, message);
  if (status == MO_OK && fleet != NULL)
    fleet_end_others(service->fleet, tokens.items, tokens.n_workers);
  tokens_free(&tokens);
  return status;
}

void service_drain(struct service *service)
{
  mo_http_set_ready(service->http, false);
}

bool service_is_idle(struct service *service)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service->jobs, &stats);
  return stats.active_batch + stats.active_interactive + stats.blocks_in_flight == 0;
}

bool service_is_learning(struct service *service)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service->jobs, &stats);
  return stats.active_trainings + stats.active_campaigns > 0;
}

bool service_is_alive(struct service *service, int64_t limit_us, const char **who)
{
  struct mo_store_stats store;
  struct mo_jobs_stats jobs;
  struct mo_http_stats http, fleet = {.heartbeat_us = INT64_MAX};
  mo_store_get_stats(service->store, &store);
  mo_jobs_get_stats(service->jobs, &jobs);
  mo_http_get_stats(service->http, &http);
  if (service->fleet != NULL)
    mo_http_get_stats(mo_api_fleet_http(service->api), &fleet);
  int64_t oldest_allowed = mo_clock_us() - limit_us;
  *who = store.heartbeat_us < oldest_allowed   ? "writer"
         : jobs.heartbeat_us < oldest_allowed  ? "scheduler"
         : http.heartbeat_us < oldest_allowed  ? "http"
         : fleet.heartbeat_us < oldest_allowed ? "fleet"
                                               : NULL;
  return *who == NULL;
}

void service_report_expiry(struct service *service)
{
  struct mo_store_stats store;
  mo_store_get_stats(service->store, &store);
  if (store.jobs_expired > service->jobs_expired)
    log_info("old jobs were deleted",
             LOG_INT("jobs", (int64_t)(store.jobs_expired - service->jobs_expired)));
  if (store.clock_ahead_us > 0 && !service->clock_doubted)
    log_warning("the clock is not credible, so no jobs are deleted by age; set the clock, or "
                "confirm it with `morphod store accept-clock`",
                LOG_REAL("days_ahead", (double)store.clock_ahead_us / 86400e6));
  service->jobs_expired = store.jobs_expired;
  service->clock_doubted = store.clock_ahead_us > 0;
}

void service_describe(struct service *service, char *text, size_t capacity)
{
  struct mo_jobs_stats jobs;
  struct mo_http_stats http;
  mo_jobs_get_stats(service->jobs, &jobs);
  mo_http_get_stats(service->http, &http);
  snprintf(text, capacity, "%s, %s to do, %s%s", MO_COUNTED(jobs.open_jobs, "open job"),
           MO_COUNTED(jobs.open_rollouts, "rollout"), MO_COUNTED(http.connections, "connection"),
           jobs.no_space ? ", waiting for disk space" : "");
}

void service_stop(struct service *service)
{
  if (service->jobs != NULL && mo_jobs_stop(service->jobs, JOBS_STOP_MS) != MO_OK)
    log_warning(
        "some work was not saved before the deadline; it will be repeated after the next start");
  sockets_close(&service->sockets);
  sockets_close(&service->fleet_sockets);
  fleet_retire(service->fleet);
  mo_api_stop(service->api, HTTP_GRACE_MS);
  fleet_free(service->fleet);
  mo_jobs_free(service->jobs);
  mo_compute_free(service->compute);
  if (service->subscription >= 0)
    mo_store_unsubscribe(service->store, service->subscription);
  mo_store_close(service->store);
  if (service->crash_marker)
    crash_close(service->state_dir);
  free(service->last_marker);
  free(service->state_dir);
  free(service);
}
