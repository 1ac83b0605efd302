/* worker_command.c: `morphod worker`: its options, its back end, and its signals. The main thread
 * handles the signals; the worker's loop has its own thread. */
#include "daemon/commands.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/utsname.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <systemd/sd-daemon.h>

#include "base/thread.h"
#include "daemon/devices.h"
#include "daemon/log.h"
#include "daemon/memory.h"
#include "daemon/service.h"
#include "daemon/settings_rows.h"
#include "daemon/tokens.h"
#include "worker/worker.h"

#define NICE                                                                                       \
  5 /* niceness of the computing threads, so that the worker always answers in                     \
     * time */
#define BEFORE_END_S 30
#define STATUS_S     10
#define LOG_FLUSH_MS 2000
#define YEAR_MS      (365 * UINT64_C(86400000))

struct options {
  char *server, *token_file, *pin, *ca, *proxy, *name;
  uint64_t threads;
  int isa; /* 0: auto, else enum mo_isa + 1 */
  struct setting_list devices;
  char *compute_module;
  uint64_t leave_when_idle_ms, give_up_ms;
  int until_slurm;
  int log_level, log_format;
};

#define ROW(setting_name, setting_type, field, ...)                                                \
  {                                                                                                \
    .name = (setting_name), .type = (setting_type), .offset = offsetof(struct options, field),     \
    __VA_ARGS__                                                                                    \
  }

static const struct setting rows[] = {
    ROW("server", SETTING_PATH, server, .choices = "URL", .initial = "",
        .initial_words = "required",
        .help = "Address of the daemon's fleet_listen: https://host:port."),
    ROW("token_file", SETTING_PATH, token_file, .initial = "",
        .initial_words = "credential \"token\", if systemd passes one",
        .help = "File with the worker's token: a line of NAME worker TOKEN, or the token only."),
    ROW("pin", SETTING_PATH, pin, .choices = "sha256//BASE64", .initial = "",
        .initial_words = "none",
        .help = "Hash of the daemon's public key. Without --ca, no other proof is required, so a "
                "self-signed certificate suffices."),
    ROW("ca", SETTING_PATH, ca, .initial = "", .initial_words = "the system's",
        .help = "File with the certificates of the authorities to trust."),
    ROW("proxy", SETTING_PATH, proxy, .choices = "URL", .initial = "",
        .initial_words = "https_proxy, except on loopback",
        .help = "Proxy for connections to the daemon."),
    ROW("name", SETTING_PATH, name, .choices = "NAME", .initial = "", .initial_words = "the host's",
        .help = "Name in lists and in the origin of scores."),
    ROW("threads", SETTING_NUMBER, threads, .max = 1024, .initial = "0",
        .initial_words = "one per processor that the process may use",
        .help = "Number of computing threads."),
    ROW("isa", SETTING_CHOICE, isa, .choices = "auto|x86-64|avx2|avx512", .initial = "auto",
        .help = "Instruction set of the kernels; must be the same as the daemon's."),
    ROW("devices", SETTING_LIST, devices, .initial = "auto",
        .help = "GPUs to use: auto (all that work), none, or their numbers: 0,1."),
    ROW("compute_module", SETTING_PATH, compute_module, .initial = "",
        .initial_words = "morphod-cuda.so of the installation, if it exists",
        .help = "Module that computes on the devices."),
    ROW("leave_when_idle", SETTING_DURATION, leave_when_idle_ms, .max = YEAR_MS, .initial = "0",
        .initial_words = "never", .help = "Leave after this time without work."),
    ROW("until_slurm", SETTING_CHOICE, until_slurm, .choices = "no|yes", .initial = "no",
        .help = "Leave 30 s before the time limit of the process's Slurm job. The "
                "flag without a value means yes."),
    ROW("give_up", SETTING_DURATION, give_up_ms, .max = YEAR_MS, .initial = "0",
        .initial_words = "never", .help = "Exit when the daemon cannot be reached for this time."),
    ROW("log_level", SETTING_CHOICE, log_level, .choices = "error|warning|info|debug",
        .initial = "info", .help = "Least severe messages that are logged."),
    ROW("log_format", SETTING_CHOICE, log_format, .choices = "text|logfmt|json", .initial = "text",
        .help = "Format of the log lines on standard error."),
};
enum { N_ROWS = sizeof(rows) / sizeof(rows[0]) };

/* ---- options ---- */

static int complain(int status, const char *name, const char *why)
{
  fprintf(stderr, "morphod worker: %s%s%s\n", name, *name != '\0' ? ": " : "", why);
  return status;
}

static int set(struct options *options, const struct setting *row, const char *text,
               const char *name, bool append)
{
  struct mo_message message = {""};
  const int error = setting_read(options, row, text, append, &message);
  return error == MO_OK ? EXIT_OK : complain(EXIT_USAGE, name, message.text);
}

/* Reads the variables MORPHOD_WORKER_…. */
static int read_environment(struct options *options)
{
  int status = EXIT_OK;
  for (const struct setting *row = rows; row < rows + N_ROWS && status == EXIT_OK; row++) {
    char name[64];
    settings_variable_name("MORPHOD_WORKER", row, name, sizeof(name));
    const char *text = getenv(name);
    if (text != NULL && (status = set(options, row, text, name, false)) != EXIT_OK)
      status = EXIT_CONFIG;
  }
  return status;
}

static int read_flags(struct options *options, int argc, const char *const *argv)
{
  /* The last list on the command line, to which its flag adds again. */
  const struct setting *list = NULL;
  for (int i = 2; i < argc; i++) {
    const char *flag = argv[i], *equals = strchr(flag, '=');
    const size_t length = equals != NULL ? (size_t)(equals - flag) : strlen(flag);
    const struct setting *row = setting_of_flag(rows, N_ROWS, flag, length);
    const char *value = equals != NULL ? equals + 1 : NULL;
    char name[80];
    snprintf(name, sizeof(name), "%.*s", (int)length, flag);
    if (row == NULL)
      return complain(EXIT_USAGE, name, "is not a flag; see --help");
    if (value == NULL && row->choices != NULL && strcmp(row->choices, "no|yes") == 0)
      value = "yes";
    if (value == NULL && ++i == argc)
      return complain(EXIT_USAGE, name, "needs a value");
    if (set(options, row, value != NULL ? value : argv[i], name, row == list) != EXIT_OK)
      return EXIT_USAGE;
    list = row->type == SETTING_LIST ? row : list;
  }
  return EXIT_OK;
}

static int read_options(struct options *options, int argc, const char *const *argv)
{
  int status = EXIT_OK;
  for (const struct setting *row = rows; row < rows + N_ROWS && status == EXIT_OK; row++)
    status = set(options, row, row->initial, row->name, false);
  if (status == EXIT_OK)
    status = read_environment(options);
  if (status == EXIT_OK)
    status = read_flags(options, argc, argv);
  if (status == EXIT_OK && options->server == NULL)
    status = complain(EXIT_USAGE, "--server", "is required: the daemon's fleet_listen");
  if (options->token_file == NULL)
    options->token_file = credential_path(getenv("CREDENTIALS_DIRECTORY"));
  return status;
}

static void print_help(void)
{
  fputs("Usage: morphod worker --server URL [FLAG]...\nComputes for a daemon on another machine, "
        "with all processors and GPUs that it may use,\nuntil SIGTERM or SIGINT. It stores nothing "
        "and opens no ports.\n\nA flag overrides its environment variable: --token-file is "
        "MORPHOD_WORKER_TOKEN_FILE, and so on.\n\n",
        stdout);
  settings_print_rows(rows, N_ROWS, stdout);
  fputs("\nExit status: 0 left as requested; 64 usage; 69 the daemon requires another version or "
        "class;\n71 system; 75 unreachable (--give-up); 76 wrong bits; 77 token or\n"
        "certificate refused; 78 configuration.\n",
        stdout);
}

/* ---- Slurm ---- */

/* Reads the output of squeue: local time as 2026-11-24T09:30:00. Returns 0 for anything else, such
 * as NONE. */
static int64_t read_time(const char *text)
{
  struct tm time = {.tm_isdst = -1};
  const char *end = strptime(text, "%Y-%m-%dT%H:%M:%S", &time);
  if (end == NULL || (*end != '\0' && *end != '\n'))
    return 0;
  const time_t seconds = mktime(&time);
  return seconds > 0 ? seconds : 0;
}

/* Runs a program and reads the first line of its output. Returns false if it failed. */
static bool ask(const char *const *command, char *line, size_t capacity)
{
  int ends[2], status = -1;
  posix_spawn_file_actions_t actions;
  pid_t child;
  if (pipe2(ends, O_CLOEXEC) != 0)
    return false;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_adddup2(&actions, ends[1], STDOUT_FILENO);
  posix_spawn_file_actions_addopen(&actions, STDERR_FILENO, "/dev/null", O_WRONLY, 0);
  const int error =
      posix_spawnp(&child, command[0], &actions, NULL, (char *const *)command, environ);
  posix_spawn_file_actions_destroy(&actions);
  close(ends[1]);
  FILE *file = fdopen(ends[0], "r");
  const bool got = error == 0 && file != NULL && fgets(line, (int)capacity, file) != NULL;
  if (file != NULL)
    fclose(file);
  else
    close(ends[0]);
  return (error != 0 || waitpid(child, &status, 0) == child) && got && status == 0;
}

/* Returns the end of the Slurm job that this process belongs to, in seconds since 1970, or 0 if it
 * is unknown or there is no limit. Newer versions of Slurm set it in the environment; for older
 * versions, squeue reports it. */
static int64_t job_end_s(void)
{
  const char *end = getenv("SLURM_JOB_END_TIME"), *job = getenv("SLURM_JOB_ID");
  char line[64];
  if (end != NULL && *end != '\0' && strspn(end, "0123456789") == strlen(end))
    return strtoll(end, NULL, 10);
  if (job == NULL || *job == '\0')
    return 0;
  const char *const command[] = {"squeue", "-h", "-j", job, "-o", "%e", NULL};
  return ask(command, line, sizeof(line)) ? read_time(line) : 0;
}

/* ---- running ---- */

struct process {
  const struct options *options;
  struct tokens tokens;
  struct mo_compute *compute;
  struct mo_worker *worker;
  struct mo_worker_config config;
  char user_agent[48];
  enum mo_worker_end end;
  struct mo_message why;
};

static void say(void *context, enum mo_worker_news news, const char *what, const char *detail)
{
  (void)context;
  LOG_AT(news == MO_WORKER_WARNING ? LOG_LEVEL_WARNING : LOG_LEVEL_INFO, what,
         LOG_TEXT("detail", detail));
}

static void *run_worker(void *context)
{
  struct process *process = context;
  process->end = mo_worker_run(process->worker, &process->why);
  kill(getpid(), SIGUSR1); /* the main thread waits for it */
  return NULL;
}

static void offer_class(struct mo_fleet_offer *offer, enum mo_back_end back_end, const char *scores,
                        const char *gradients)
{
  snprintf(offer->classes[back_end].scores, sizeof(offer->classes[back_end].scores), "%s", scores);
  snprintf(offer->classes[back_end].gradients, sizeof(offer->classes[back_end].gradients), "%s",
           gradients);
}

static int make_offer(struct process *process, struct mo_fleet_offer *offer)
{
  struct mo_compute *compute = process->compute;
  struct mo_compute_stats stats;
  struct utsname host;
  uname(&host);
  mo_compute_get_stats(compute, &stats);
  const char *name = process->options->name != NULL ? process->options->name : host.nodename;
  snprintf(offer->name, sizeof(offer->name), "%s", name);
  snprintf(offer->host, sizeof(offer->host), "%.*s", MO_FLEET_NAME_BYTES, host.nodename);
  snprintf(offer->version, sizeof(offer->version), "%s", MORPHOD_VERSION);
  offer->n_threads = stats.n_workers;
  offer->n_devices = mo_compute_devices_working(compute);
  offer_class(offer, MO_ON_CPU, mo_compute_fingerprint(compute, MO_FLOAT32),
              mo_compute_gradient_fingerprint(compute));
  int error = mo_fleet_canary(compute, MO_ON_CPU, &offer->classes[MO_ON_CPU].canary);
  if (error == MO_OK && offer->n_devices > 0) {
    offer_class(offer, MO_ON_DEVICE, mo_compute_device_fingerprint(compute),
                mo_compute_device_gradient_fingerprint(compute));
    error = mo_fleet_canary(compute, MO_ON_DEVICE, &offer->classes[MO_ON_DEVICE].canary);
  }
  return error;
}

/* Limits the scratch memory of gradients to half of the memory. It grows only with the first
 * gradient. */
static void limit_gradients(const struct process *process)
{
  struct mo_compute_stats stats;
  mo_compute_get_stats(process->compute, &stats);
  const uint64_t bytes = memory_limit() / 2 / stats.n_workers;
  if (bytes < MO_GRADIENT_DEFAULT_BYTES)
    mo_compute_set_gradient_bytes(process->compute, bytes);
}

static int prepare(struct process *process, struct mo_message *message)
{
  const struct options *options = process->options;
  const struct mo_compute_config compute = {
      .n_workers = (uint32_t)options->threads,
      .isa = options->isa == 0 ? mo_isa_best() : (enum mo_isa)(options->isa - 1),
      .nice = NICE};
  if (options->name != NULL &&
      (strlen(options->name) > MO_FLEET_NAME_BYTES || strpbrk(options->name, " \t\r\n") != NULL)) {
    (void)mo_fail(message, MO_ERR_INVALID, "name: must be at most %d bytes, without spaces",
                  MO_FLEET_NAME_BYTES);
    return EXIT_CONFIG;
  }
  int error = tokens_read(options->token_file, &process->tokens, message);
  if (error != MO_OK)
    return EXIT_CONFIG;
  if (process->tokens.n > 1) {
    (void)mo_fail(message, MO_ERR_INVALID, "token_file: %s must have only one token",
                  options->token_file);
    return EXIT_CONFIG;
  }
  error = mo_compute_create_cpu(&compute, &process->compute);
  if (error != MO_OK) {
    (void)mo_fail(message, error, "workers: %s", mo_error_text(error));
    return error == MO_ERR_UNSUPPORTED ? EXIT_CONFIG : EXIT_SYSTEM;
  }
  limit_gradients(process);
  error = devices_open(process->compute, &options->devices, options->compute_module, message);
  if (error != MO_OK)
    return error == MO_ERR_INVALID ? EXIT_CONFIG : EXIT_SYSTEM;
  error = make_offer(process, &process->config.offer);
  if (error != MO_OK) {
    (void)mo_fail(message, error, "canary: %s", mo_error_text(error));
    return EXIT_SYSTEM;
  }
  snprintf(process->user_agent, sizeof(process->user_agent), "morphod-worker/%s", MORPHOD_VERSION);
  process->config.link =
      (struct mo_link_config){.server = options->server,
                              .token = process->tokens.n > 0 ? process->tokens.items[0].text : NULL,
                              .pin = options->pin,
                              .ca = options->ca,
                              .proxy = options->proxy,
                              .user_agent = process->user_agent};
  process->config.compute = process->compute;
  process->config.idle_ms = options->leave_when_idle_ms;
  process->config.give_up_ms = options->give_up_ms;
  process->config.say = say;
  error = mo_worker_create(&process->config, &process->worker, message);
  return error == MO_OK ? EXIT_OK : error == MO_ERR_INVALID ? EXIT_CONFIG : EXIT_SYSTEM;
}

static void read_slurm(struct process *process)
{
  const int64_t end_s = process->options->until_slurm ? job_end_s() : 0;
  if (end_s > 0)
    process->config.leave_at_us = (end_s - BEFORE_END_S) * 1000000;
  else if (process->options->until_slurm)
    log_warning("Slurm reports no end time for this job; only SIGTERM will stop the worker");
}

/* Handles signals until the worker's thread has ended. */
static void watch(struct process *process, const sigset_t *set)
{
  char text[256];
  for (;;) {
    const struct timespec round = {.tv_sec = STATUS_S};
    const int number = sigtimedwait(set, NULL, &round);
    if (number == SIGUSR1)
      return;
    if (number == SIGTERM || number == SIGINT) {
      log_info("stopping", LOG_TEXT("signal", sigabbrev_np(number)));
      sd_notify(0, "STOPPING=1\nSTATUS=Leaving");
      mo_worker_stop(process->worker);
    }
    mo_worker_describe(process->worker, text, sizeof(text));
    sd_notifyf(0, "STATUS=%s", text);
  }
}

static int status_of(enum mo_worker_end end)
{
  static const int statuses[] = {
      [MO_WORKER_LEFT] = EXIT_OK,          [MO_WORKER_UNWANTED] = EXIT_UNAVAILABLE,
      [MO_WORKER_REFUSED] = EXIT_PROTOCOL, [MO_WORKER_DENIED] = EXIT_DENIED,
      [MO_WORKER_MISPLACED] = EXIT_CONFIG, [MO_WORKER_UNREACHABLE] = EXIT_IN_USE,
      [MO_WORKER_FAILED] = EXIT_SYSTEM};
  return statuses[end];
}

static int run(struct process *process)
{
  struct mo_message message = {""};
  pthread_t thread;
  sigset_t set;
  char text[256];
  sigemptyset(&set);
  sigaddset(&set, SIGTERM);
  sigaddset(&set, SIGINT);
  sigaddset(&set, SIGUSR1);
  pthread_sigmask(SIG_BLOCK, &set, NULL);
  signal(SIGPIPE, SIG_IGN);
  umask(077);
  log_open((enum log_format)process->options->log_format,
           (enum log_level)process->options->log_level);
  read_slurm(process);
  if (log_start() != 0)
    return complain(EXIT_SYSTEM, "", "cannot start the log thread");
  int status = prepare(process, &message);
  if (status == EXIT_OK && mo_thread_create(&thread, "worker", run_worker, process) != 0)
    status = EXIT_SYSTEM;
  if (status != EXIT_OK) {
    log_error("cannot start", LOG_TEXT("reason", message.text), LOG_INT("exit_status", status));
    sd_notifyf(0, "STATUS=%s", message.text);
    return status;
  }
  const struct mo_fleet_offer *offer = &process->config.offer;
  log_info("worker", LOG_TEXT("version", MORPHOD_VERSION), LOG_TEXT("name", offer->name),
           LOG_INT("threads", offer->n_threads), LOG_INT("devices", offer->n_devices),
           LOG_TEXT("class", offer->classes[MO_ON_CPU].scores), LOG_INT("pid", getpid()));
  sd_notify(0, "READY=1");
  watch(process, &set);
  pthread_join(thread, NULL);
  status = status_of(process->end);
  mo_worker_describe(process->worker, text, sizeof(text));
  if (status == EXIT_OK)
    log_info("left", LOG_TEXT("detail", text));
  else
    log_error("ended", LOG_TEXT("reason", process->why.text), LOG_INT("exit_status", status));
  sd_notifyf(0, "STATUS=%s", status == EXIT_OK ? "Left" : process->why.text);
  return status;
}

int worker_command(int argc, const char *const *argv)
{
  struct options options = {0};
  struct process process = {.options = &options};
  for (int i = 2; i < argc; i++)
    if (strcmp(argv[i], "--help") == 0) {
      print_help();
      return EXIT_OK;
    }
  int status = read_options(&options, argc, argv);
  if (status == EXIT_OK)
    status = run(&process);
  mo_worker_free(process.worker);
  mo_compute_free(process.compute);
  tokens_free(&process.tokens);
  log_stop(LOG_FLUSH_MS);
  for (size_t i = 0; i < N_ROWS; i++)
    setting_free(&options, &rows[i]);
  return status;
}
