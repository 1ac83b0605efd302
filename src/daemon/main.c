/* main.c: the process. Signals are blocked in every thread. The main thread takes them one at a
 * time and otherwise only serves the watchdog. */
#include <errno.h>
#include <inttypes.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <systemd/sd-daemon.h>

#include "base/clock.h"
#include "daemon/commands.h"
#include "daemon/crash.h"
#include "daemon/log.h"
#include "daemon/memory.h"
#include "daemon/service.h"
#include "daemon/settings.h"

#define STOP_LIMIT_S                                                                               \
  9 /* from the first SIGTERM, with a drain of at most 5 s, to the end of the process */
/* A part that completes no round for this long counts as stuck. */
#define HEARTBEAT_LIMIT_US 15000000
/* Time to wait for the last lines if nobody reads standard error. */
#define LOG_FLUSH_MS    2000
#define ROUND_S         1
#define WATCHED_SIGNALS 5

struct process {
  int argc;
  const char *const *argv;
  struct settings settings;
  struct settings_request request;
  struct service *service;
  uint64_t watchdog_us; /* 0: no watchdog */
};

static atomic_bool broken; /* set by the store when the process must end */

static void must_end(void *context, const char *what)
{
  (void)context;
  log_error("the state can no longer be written; stopping to recover at the next start",
            LOG_TEXT("reason", what));
  atomic_store(&broken, true);
  kill(getpid(), SIGUSR1); /* wakes the main thread */
}

static void report_faults(const struct settings_faults *faults)
{
  for (size_t i = 0; i < faults->n; i++)
    LOG_AT(faults->items[i].fatal ? LOG_LEVEL_ERROR : LOG_LEVEL_WARNING, "configuration",
           LOG_TEXT("fault", faults->items[i].text));
}

/* Loads flags, environment and file into `settings`, and collects faults. */
static void load(struct process *process, struct settings *settings,
                 struct settings_request *request, struct settings_faults *faults)
{
  settings_init(settings);
  settings_load(settings, process->argc, process->argv, (const char *const *)environ, request,
                faults);
  settings_complete(settings, (const char *const *)environ);
}

/* Logs that a setting has a new value, and applies it if the setting can be reloaded. Other
 * settings keep their old values, for the next comparison. */
static void apply(struct settings *current, const struct settings *read,
                  const struct setting *setting)
{
  struct mo_message ignored;
  char *old = settings_value_text(current, setting), *fresh = settings_value_text(read, setting);
  const bool differs = strcmp(old, fresh) != 0;
  if (differs && setting->reloads)
    log_info("setting changed", LOG_TEXT("setting", setting->name), LOG_TEXT("value", fresh));
  else if (differs)
    log_warning("setting needs a restart to change", LOG_TEXT("setting", setting->name),
                LOG_TEXT("value", old), LOG_TEXT("new_value", fresh));
  if (setting->reloads)
    settings_set(current, setting, fresh,
                 (enum setting_source)read->source[setting - settings_table], false, &ignored);
  free(old);
  free(fresh);
}

/* Applies a valid new configuration on SIGHUP, and logs what needs a restart. */
static void reload(struct process *process)
{
  sd_notifyf(0, "RELOADING=1\nMONOTONIC_USEC=%" PRId64, mo_clock_us());
  struct settings settings = {0};
  struct settings_request request = {0};
  struct settings_faults faults = {0};
  struct mo_message message = {{0}};
  load(process, &settings, &request, &faults);
  if (faults.n_fatal == 0)
    settings_check(&settings, false, &faults);
  report_faults(&faults);
  if (faults.n_fatal > 0) {
    log_error("reload failed; the old configuration remains in use");
  } else if (service_reload_tokens(process->service, &settings, &message) != MO_OK) {
    log_error("reload failed; the old tokens remain in use", LOG_TEXT("reason", message.text));
  } else {
    for (size_t i = 0; i < settings_count; i++)
      apply(&process->settings, &settings, &settings_table[i]);
    log_set_level((enum log_level)settings.log_level);
    log_info("reloaded");
  }
  settings_faults_free(&faults);
  settings_request_free(&request);
  settings_free(&settings);
  sd_notify(0, "READY=1");
}

/* Ends the process when a stop exceeds its limit; everything acknowledged is already durable. */
static void out_of_time(int number)
{
  (void)number;
  static const char text[] = "morphod: stopping took too long; exiting at the deadline\n";
  log_last_words(text, sizeof(text) - 1);
  crash_forgive();
  _exit(EXIT_OK);
}

static int wait_signal(const sigset_t *set, int64_t timeout_us)
{
  struct timespec timeout = {.tv_sec = timeout_us / 1000000,
                             .tv_nsec = timeout_us % 1000000 * 1000};
  return sigtimedwait(set, NULL, &timeout);
}

static void stop(struct process *process, int number, const sigset_t *set)
{
  int64_t begin = mo_clock_us();
  uint64_t drain_s = process->settings.drain_timeout_ms / 1000;
  struct sigaction action = {.sa_handler = out_of_time};
  sigaction(SIGALRM, &action, NULL);
  alarm((unsigned)(drain_s > 5 ? drain_s + 4 : STOP_LIMIT_S));
  sd_notifyf(0, "STOPPING=1\nSTATUS=Stopping\nEXTEND_TIMEOUT_USEC=%" PRIu64,
             (drain_s + 10) * 1000000);
  log_info("stopping", LOG_TEXT("signal", sigabbrev_np(number)));
  service_drain(process->service);
  int64_t until = begin + (int64_t)process->settings.drain_timeout_ms * 1000;
  while (!atomic_load(&broken) && !service_is_idle(process->service)) {
    int64_t left = until - mo_clock_us();
    if (left <= 0)
      break;
    int again = wait_signal(set, left < 50000 ? left : 50000);
    if (again == SIGTERM || again == SIGINT) {
      log_info("stopping immediately", LOG_TEXT("signal", sigabbrev_np(again)));
      break;
    }
  }
  bool idle = service_is_idle(process->service) && !service_is_learning(process->service);
  service_stop(process->service);
  process->service = NULL;
  log_info("stopped", LOG_TEXT("work", idle ? "finished" : "parked"),
           LOG_REAL("seconds", (double)(mo_clock_us() - begin) * 1e-6));
}

static void check_parts(struct process *process, bool *was_alive)
{
  const char *who;
  int64_t limit_us = HEARTBEAT_LIMIT_US;
  if (process->watchdog_us > 0 && (int64_t)(process->watchdog_us / 2) < limit_us)
    limit_us = (int64_t)(process->watchdog_us / 2);
  bool alive = service_is_alive(process->service, limit_us, &who);
  if (alive && process->watchdog_us > 0)
    sd_notify(0, "WATCHDOG=1");
  if (!alive && *was_alive)
    log_error("part of the service is stuck", LOG_TEXT("part", who));
  if (alive && !*was_alive)
    log_info("the service is running again");
  *was_alive = alive;
}

/* Returns the exit status. */
static int run(struct process *process, const sigset_t *set)
{
  if (sd_watchdog_enabled(0, &process->watchdog_us) <= 0)
    process->watchdog_us = 0;
  int64_t round_us = ROUND_S * 1000000;
  if (process->watchdog_us > 0 && (int64_t)(process->watchdog_us / 4) < round_us)
    round_us = (int64_t)(process->watchdog_us / 4);
  bool alive = true;
  int rounds = 0;
  for (;;) {
    int number = wait_signal(set, round_us);
    if (atomic_load(&broken)) {
      /* The remaining work could not be written. The next start recovers the state. */
      sd_notifyf(0, "STATUS=The state can no longer be written\nERRNO=%d", EIO);
      return EXIT_STATE;
    }
    if (number == SIGTERM || number == SIGINT) {
      stop(process, number, set);
      return EXIT_OK;
    }
    if (number == SIGHUP)
      reload(process);
    check_parts(process, &alive);
    service_report_expiry(process->service);
    if (rounds++ % 10 == 0) {
      char text[160];
      service_describe(process->service, text, sizeof(text));
      sd_notifyf(0, "STATUS=%s", text);
    }
  }
}

/* Writes one line per address to standard output and to the port file, which is given its name only
 * when it is complete. */
static int announce(const struct process *process, struct mo_message *message)
{
  const char *const *addresses[2];
  size_t n[2];
  for (int of_fleet = 0; of_fleet < 2; of_fleet++) {
    n[of_fleet] = service_addresses(process->service, of_fleet, &addresses[of_fleet]);
    for (size_t i = 0; i < n[of_fleet]; i++) {
      printf("morphod serves %s%s\n", of_fleet ? "workers at " : "", addresses[of_fleet][i]);
      log_info(of_fleet ? "serving workers" : "serving",
               LOG_TEXT("address", addresses[of_fleet][i]));
    }
  }
  fflush(stdout);
  const char *path = process->settings.port_file;
  if (path == NULL)
    return MO_OK;
  char *temporary = format_text("%s.new", path);
  FILE *file = fopen(temporary, "we");
  int status = file != NULL ? MO_OK : MO_ERR_IO;
  for (size_t i = 0; i < n[0] + n[1] && status == MO_OK; i++)
    if (fprintf(file, "%s\n", i < n[0] ? addresses[0][i] : addresses[1][i - n[0]]) < 0)
      status = MO_ERR_IO;
  if (file != NULL && fclose(file) != 0)
    status = MO_ERR_IO;
  if (status == MO_OK && rename(temporary, path) != 0)
    status = MO_ERR_IO;
  if (status != MO_OK)
    mo_fail(message, status, "port_file: %s: %s", path, strerror(errno));
  free(temporary);
  return status;
}

static int serve(struct process *process)
{
  sigset_t set;
  static const int watched[WATCHED_SIGNALS] = {SIGTERM, SIGINT, SIGHUP, SIGUSR1, SIGUSR2};
  sigemptyset(&set);
  for (size_t i = 0; i < WATCHED_SIGNALS; i++)
    sigaddset(&set, watched[i]);
  pthread_sigmask(SIG_BLOCK, &set, NULL);
  signal(SIGPIPE, SIG_IGN);
  umask(077);
  log_open((enum log_format)process->settings.log_format,
           (enum log_level)process->settings.log_level);
  if (log_start() != 0) { /* after the signals are blocked, so that its thread does not take them */
    log_error("cannot start", LOG_TEXT("reason", "cannot start the log thread"));
    return EXIT_SYSTEM;
  }
  log_info("starting", LOG_TEXT("version", MORPHOD_VERSION),
           LOG_TEXT("state_dir", process->settings.state_dir),
           LOG_TEXT("config", process->request.config_found), LOG_INT("pid", getpid()));
  struct mo_message message = {{0}};
  int status = service_start(&process->settings, must_end, &process->service, &message);
  if (status != EXIT_OK) {
    log_error("cannot start", LOG_TEXT("reason", message.text), LOG_INT("exit_status", status));
    sd_notifyf(0, "STATUS=%s", message.text);
    return status;
  }
  if (announce(process, &message) != MO_OK) {
    log_error("cannot start", LOG_TEXT("reason", message.text));
    service_stop(process->service);
    return EXIT_CONFIG;
  }
  sd_notify(0, "READY=1\nSTATUS=Serving");
  status = run(process, &set);
  if (process->settings.port_file != NULL)
    unlink(process->settings.port_file);
  return status;
}

int main(int argc, char **argv)
{
  struct process process = {.argc = argc, .argv = (const char *const *)argv};
  struct settings_faults faults = {0};
  if (argc > 1 && strcmp(argv[1], "store") == 0)
    return store_command(argc, process.argv);
  if (argc > 1 && strcmp(argv[1], "worker") == 0)
    return worker_command(argc, process.argv);
  load(&process, &process.settings, &process.request, &faults);
  enum settings_action action = process.request.action;
  int status = EXIT_OK;
  if (process.request.usage_fault) {
    settings_faults_print(&faults);
    status = EXIT_USAGE;
  } else if (action == ACTION_HELP) {
    settings_print_help(stdout);
  } else if (action == ACTION_VERSION) {
    printf("morphod %s\n", MORPHOD_VERSION);
  } else if (action == ACTION_TABLE) {
    settings_print_table(stdout);
  } else {
    if (faults.n_fatal == 0 && action != ACTION_PRINT)
      settings_check(&process.settings, action == ACTION_CHECK, &faults);
    if (faults.n_fatal > 0)
      status = EXIT_CONFIG;
    settings_faults_print(&faults);
    if (action == ACTION_CHECK && status == EXIT_OK)
      printf("morphod: the configuration is valid (%s)\n",
             process.request.config_found != NULL ? process.request.config_found : "no file");
    else if (action == ACTION_PRINT && status == EXIT_OK)
      settings_print(&process.settings, stdout);
    else if (action == ACTION_RUN && status == EXIT_OK)
      status = serve(&process);
  }
  log_stop(LOG_FLUSH_MS);
  settings_faults_free(&faults);
  if (status == EXIT_STATE && process.service != NULL) {
    crash_forgive();
    _exit(status); /* threads of the service still run, so no destructors may run */
  }
  settings_request_free(&process.request);
  settings_free(&process.settings);
  return status;
}
