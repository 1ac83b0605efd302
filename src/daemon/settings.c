/* settings.c: the table, and the conversion of text to values. See settings.h; files, flags and
 * checks are in settings_load.c and settings_check.c. */
#include "settings.h"
#include "settings_rows.h"

#include <ctype.h>
#include <errno.h>
#include <inttypes.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/memory.h"

#define KIB                UINT64_C(1024)
#define MIB                (KIB * KIB)
#define GIB                (MIB * KIB)
#define SECOND             UINT64_C(1000)
#define HOUR               (3600 * SECOND)
#define DAY                (24 * HOUR)
#define AT(settings, row)  ((void *)((char *)(settings) + (row)->offset))
#define CAT(settings, row) ((const void *)((const char *)(settings) + (row)->offset))

#define TEXT_ROW(n, type, field, initial, words, reloads, help)                                    \
  {                                                                                                \
    n, type, reloads, offsetof(struct settings, field), 0, 0, initial, words, NULL, help           \
  }
#define VALUE_ROW(n, type, field, min, max, initial, words, help)                                  \
  {                                                                                                \
    n, type, false, offsetof(struct settings, field), min, max, initial, words, NULL, help         \
  }
#define CHOICE_ROW(n, field, choices, initial, reloads, help)                                      \
  {                                                                                                \
    n, SETTING_CHOICE, reloads, offsetof(struct settings, field), 0, 0, initial, NULL, choices,    \
        help                                                                                       \
  }

const struct setting settings_table[] = {
    TEXT_ROW("state_dir", SETTING_PATH, state_dir, "",
             "$STATE_DIRECTORY, else $XDG_STATE_HOME/morphod, else ~/.local/state/morphod", false,
             "Folder for the database, controllers and recordings; created if missing, for its "
             "owner only. It must belong to the user that morphod runs as, and no other user may "
             "write to it."),
    TEXT_ROW("listen", SETTING_LIST, listen, "127.0.0.1:8765", NULL, false,
             "Addresses to serve: host:port, [ipv6]:port or unix:/path; port 0 chooses a free one. "
             "Sockets passed by systemd are also served, and replace the default."),
    VALUE_ROW("workers", SETTING_NUMBER, workers, 0, 1024, "0", "one per processor",
              "Number of computing threads. Scores do not depend on it."),
    CHOICE_ROW("isa", isa, "auto|x86-64|avx2|avx512", "auto", false,
               "Instruction set of the kernels. Scores from one set never change; those from "
               "different sets differ in the last bits."),
    VALUE_ROW("worker_nice", SETTING_NUMBER, worker_nice, 0, 19, "5", NULL,
              "Niceness of the computing threads relative to the process, so that replies never "
              "wait for computing."),
    TEXT_ROW("devices", SETTING_LIST, devices, "auto", NULL, false,
             "GPUs to use: auto (all that work), none, or their numbers: 0,1. Scores do not "
             "depend on their number, but differ from the CPU's in the last digits."),
    TEXT_ROW("compute_module", SETTING_PATH, compute_module, "",
             "morphod-cuda.so of the installation, if it exists", false,
             "Module that computes on the devices."),
    TEXT_ROW("fleet_listen", SETTING_LIST, fleet_listen, "", "none", false,
             "Addresses where workers on other machines (morphod worker) get work: host:port or "
             "[ipv6]:port. Addresses that are not on loopback need fleet_certificate, fleet_key, "
             "and tokens with the right worker."),
    TEXT_ROW("fleet_certificate", SETTING_PATH, fleet_certificate, "", "none: without TLS", false,
             "Certificate of fleet_listen, in PEM, with its chain; served with TLS 1.3."),
    TEXT_ROW("fleet_key", SETTING_PATH, fleet_key, "", "none", false,
             "Private key of fleet_certificate, in PEM."),
    CHOICE_ROW("compute", compute, "both|local|fleet", "both", false,
               "What computes the scores and gradients of batch jobs: this machine together with "
               "the workers of fleet_listen, this machine only, or the workers only. This machine "
               "always computes what workers cannot. Results do not depend on it."),
    TEXT_ROW("default_controller", SETTING_PATH, default_controller, "",
             "phototaxis-16ms.safetensors of the installation", false,
             "Controller file that is stored at the first start: as \"default\", and under its own "
             "name if that is a valid name for a controller. Without it, the installation's "
             "phototaxis.safetensors, made for the paper's physics, "
             "generalist-16ms.safetensors, trained with all guides, and "
             "robust-16ms.safetensors, trained on slippery ground, are stored too."),
    TEXT_ROW("token_file", SETTING_PATH, token_file, "",
             "credential \"token\", if systemd passes one", true,
             "File with lines of NAME RIGHT TOKEN; rights are read, submit and admin, and worker "
             "for fleet_listen. Required for addresses that are not on loopback."),
    CHOICE_ROW("token_on_loopback", token_on_loopback, "no|yes", "no", false,
               "Whether loopback addresses also require a token."),
    CHOICE_ROW("dashboard", dashboard, "on|read-only|off", "on", false,
               "Whether the dashboard at / is served; read-only: without actions that submit or "
               "change anything."),
    TEXT_ROW("allowed_hosts", SETTING_LIST, allowed_hosts, "",
             "the loopback names and the addresses served", false,
             "Additional names that a request's Host and Origin may have."),
    TEXT_ROW(
        "unix_groups", SETTING_LIST, unix_groups, "", "none", false,
        "Groups whose members may use the unix sockets, besides root and the service's own user."),
    VALUE_ROW("max_connections", SETTING_NUMBER, max_connections, 1, 65536, "1024", NULL,
              "Simultaneous connections; idle ones are closed to make room for new ones. If none "
              "is idle, new ones are refused with 503."),
    VALUE_ROW("max_streams", SETTING_NUMBER, max_streams, 1, 65536, "256", NULL,
              "Simultaneous event streams; more are refused with 503."),
    VALUE_ROW("max_body", SETTING_BYTES, max_body_bytes, 1 * KIB, 1 * GIB, "64M", NULL,
              "Largest JSON request body; a million designs take 50 MiB, as hexadecimal digits."),
    VALUE_ROW("max_controller", SETTING_BYTES, max_controller_bytes, 1 * MIB, 4 * GIB, "16M", NULL,
              "Largest controller file that a client may store."),
    VALUE_ROW("max_bundle", SETTING_BYTES, max_bundle_bytes, 1 * MIB, 4 * GIB, "256M", NULL,
              "Largest bundle of campaigns, blocks of scores in one request, or atlas file that a "
              "client may import; held in memory."),
    VALUE_ROW("header_timeout", SETTING_DURATION, header_timeout_ms, SECOND, HOUR, "10s", NULL,
              "Time limit for the arrival of a request's header."),
    VALUE_ROW("body_timeout", SETTING_DURATION, body_timeout_ms, SECOND, HOUR, "60s", NULL,
              "Time limit for the arrival of a request's body."),
    VALUE_ROW("idle_timeout", SETTING_DURATION, idle_timeout_ms, SECOND, HOUR, "60s", NULL,
              "Time after which an idle connection is closed."),
    VALUE_ROW("max_open_jobs", SETTING_NUMBER, max_open_jobs, 1, 1000000, "10000", NULL,
              "Jobs that are queued, running or paused; more are refused with 503."),
    VALUE_ROW("max_open_rollouts", SETTING_NUMBER, max_open_rollouts, 1000, UINT64_C(1000000000),
              "20000000", NULL, "Rollouts of all open jobs; more are refused with 503."),
    VALUE_ROW("max_trainings", SETTING_NUMBER, max_trainings, 1, 16, "1", NULL,
              "Training runs that run at the same time; the others wait in order of submission."),
    VALUE_ROW("max_campaigns", SETTING_NUMBER, max_campaigns, 1, 64, "4", NULL,
              "Campaigns that run at the same time; the others wait in order of submission."),
    VALUE_ROW("max_recorded", SETTING_BYTES, max_recorded_bytes, 0, 16 * GIB, "64M", NULL,
              "Recorded trajectories of one evaluation; a request for more is refused with 422."),
    VALUE_ROW("max_recordings", SETTING_BYTES, max_recordings_bytes, 0, MIB *GIB, "8G", NULL,
              "Recorded trajectories of all evaluations; beyond this, recordings of evaluations "
              "that have ended are removed, oldest first. 0: no limit."),
    VALUE_ROW("max_excluded", SETTING_BYTES, max_excluded_bytes, 0, MIB *GIB, "1G", NULL,
              "Files of the bodies that campaigns exclude, because their controller was pretrained "
              "on them; 222 MiB for the default controller. They are drawn once; beyond the limit, "
              "the least recently used file is removed. 0: each campaign draws them."),
    VALUE_ROW(
        "keep_evaluations", SETTING_DURATION, keep_evaluations_ms, 0, 36500 * DAY, "0",
        "permanently",
        "How long an evaluation and its recordings are kept after its end; it is not deleted if "
        "it has a note, is archived, or a training run uses its designs. Scores are kept."),
    VALUE_ROW(
        "keep_trainings", SETTING_DURATION, keep_trainings_ms, 0, 36500 * DAY, "0", "permanently",
        "How long a training run, its curve and checkpoints are kept after its end; it is not "
        "deleted if it has a note, is archived, or another job started from its controller. The "
        "controller is kept."),
    VALUE_ROW(
        "keep_campaigns", SETTING_DURATION, keep_campaigns_ms, 0, 36500 * DAY, "0", "permanently",
        "How long a campaign or study, its phylogeny and checkpoints are kept after its end or "
        "import; it is not deleted if it has a note, is archived, or another job started from its "
        "population or controller, or shares its environments. Designs, scores and the controller "
        "are kept."),
    VALUE_ROW(
        "keep_recordings", SETTING_DURATION, keep_recordings_ms, 0, 36500 * DAY, "0", "permanently",
        "How long the recordings of an evaluation are kept after its end; they are not deleted if "
        "it has a note or is archived."),
    VALUE_ROW("max_memory", SETTING_BYTES, max_memory, 0, MIB *GIB, "0",
              "seven eighths of the machine's memory, or of the limit of the cgroup or process if "
              "that is less, at least 64M",
              "Memory that the service may use, at least 128M; a training run or campaign that "
              "needs more waits, or is refused with 422."),
    VALUE_ROW("max_in_flight", SETTING_NUMBER, max_in_flight, 1, 65536, "64", NULL,
              "Requests from one client that are handled at the same time, except event streams "
              "and waits for jobs; more are refused with 429."),
    VALUE_ROW("client_rate", SETTING_NUMBER, client_rate_per_s, 0, 1000000, "0", "no limit",
              "Submissions and uploads per second from one client; more are refused with 429."),
    VALUE_ROW("events_kept", SETTING_NUMBER, events_kept, 1000, UINT64_C(100000000), "100000", NULL,
              "Events kept for clients that reconnect with Last-Event-ID."),
    VALUE_ROW("drain_timeout", SETTING_DURATION, drain_timeout_ms, 0, 60 * SECOND, "5s", NULL,
              "Time that running work has to finish during a stop before it is parked. Parked work "
              "continues after the next start."),
    CHOICE_ROW("log_level", log_level, "error|warning|info|debug", "info", true,
               "Least severe messages that are logged; info has a line for every request, debug "
               "also for health checks."),
    CHOICE_ROW("log_format", log_format, "text|logfmt|json", "text", false,
               "Format of the log lines on standard error."),
    TEXT_ROW("port_file", SETTING_PATH, port_file, "", "none", false,
             "File to which the addresses served are written, one per line, once they are served; "
             "removed when morphod stops."),
};
const size_t settings_count = sizeof(settings_table) / sizeof(settings_table[0]);
_Static_assert(sizeof(settings_table) / sizeof(settings_table[0]) <= SETTINGS_MAX,
               "settings.source is too short");

void settings_fault(struct settings_faults *faults, bool fatal, const char *format, ...)
{
  char *text = NULL;
  va_list arguments;
  va_start(arguments, format);
  const int n = vasprintf(&text, format, arguments);
  va_end(arguments);
  faults->items = enough(realloc(faults->items, (faults->n + 1) * sizeof(*faults->items)));
  faults->items[faults->n++] = (struct settings_fault){enough(n < 0 ? NULL : text), fatal};
  faults->n_fatal += fatal;
}

void settings_faults_print(const struct settings_faults *faults)
{
  for (size_t i = 0; i < faults->n; i++)
    fprintf(stderr, "morphod: %s%s\n",
            faults->items[i].fatal ? "" : "warning: ", faults->items[i].text);
}

void settings_faults_free(struct settings_faults *faults)
{
  for (size_t i = 0; i < faults->n; i++)
    free(faults->items[i].text);
  free(faults->items);
  *faults = (struct settings_faults){0};
}

static void list_free(struct setting_list *list)
{
  for (size_t i = 0; i < list->n; i++)
    free(list->items[i]);
  free(list->items);
  *list = (struct setting_list){0};
}

static int set_list(struct setting_list *list, const char *text, bool append,
                    struct mo_message *message)
{
  if (!append)
    list_free(list);
  for (const char *c = text; *c != 0;) {
    size_t gap = strspn(c, ", \t");
    c += gap;
    size_t length = strcspn(c, ", \t");
    if (length > 0 && list->n >= 64)
      return mo_fail(message, MO_ERR_LIMIT, "a list can have at most 64 items");
    if (length > 0) {
      list->items = enough(realloc(list->items, (list->n + 1) * sizeof(*list->items)));
      list->items[list->n++] = enough(strndup(c, length));
    }
    c += length;
  }
  return MO_OK;
}

/* Units, the largest first. A number is written with the first unit that divides it and is not
 * merely an alias. */
static const struct unit {
  enum setting_type type;
  const char *name;
  uint64_t factor;
  bool is_other_name;
} units[] = {{SETTING_NUMBER, "", 1, false},
             {SETTING_BYTES, "G", GIB, false},
             {SETTING_BYTES, "GiB", GIB, true},
             {SETTING_BYTES, "M", MIB, false},
             {SETTING_BYTES, "MiB", MIB, true},
             {SETTING_BYTES, "K", KIB, false},
             {SETTING_BYTES, "KiB", KIB, true},
             {SETTING_BYTES, "", 1, false},
             {SETTING_DURATION, "d", DAY, false},
             {SETTING_DURATION, "h", HOUR, false},
             {SETTING_DURATION, "min", 60 * SECOND, true},
             {SETTING_DURATION, "s", SECOND, false},
             {SETTING_DURATION, "", SECOND, true},
             {SETTING_DURATION, "ms", 1, false}};
enum { N_UNITS = sizeof(units) / sizeof(units[0]) };

void settings_number_text(enum setting_type type, uint64_t value, char *text, size_t capacity)
{
  const struct unit *unit = units;
  while (unit->type != type || unit->is_other_name || value % unit->factor != 0 ||
         (value == 0 && unit->factor > SECOND)) /* 0 is "0" or "0s" */
    unit++;
  snprintf(text, capacity, "%" PRIu64 "%s", value / unit->factor, unit->name);
}

static int set_number(const struct setting *setting, const char *text, uint64_t *number,
                      struct mo_message *message)
{
  static const char *const wanted[] = {[SETTING_NUMBER] = "a whole number",
                                       [SETTING_BYTES] = "a size such as 64M",
                                       [SETTING_DURATION] = "a duration such as 10s"};
  char *rest = NULL;
  errno = 0;
  unsigned long long value = strtoull(text, &rest, 10);
  const char *end = isdigit((unsigned char)*text) ? rest + strspn(rest, " ") : "none";
  size_t u = 0;
  while (u < N_UNITS && (units[u].type != setting->type || strcmp(end, units[u].name) != 0))
    u++;
  if (u == N_UNITS)
    return mo_fail(message, MO_ERR_INVALID, "\"%.60s\" is not %s", text, wanted[setting->type]);
  uint64_t scaled;
  if (errno == ERANGE || __builtin_mul_overflow((uint64_t)value, units[u].factor, &scaled) ||
      scaled < setting->min || scaled > setting->max) {
    char low[32], high[32];
    settings_number_text(setting->type, setting->min, low, sizeof(low));
    settings_number_text(setting->type, setting->max, high, sizeof(high));
    return mo_fail(message, MO_ERR_RANGE, "%.60s is not between %s and %s", text, low, high);
  }
  *number = scaled;
  return MO_OK;
}

static int choice_at(const char *choices, const char *text)
{
  size_t length = strlen(text);
  int position = 0;
  for (const char *c = choices;; position++) {
    size_t n = strcspn(c, "|");
    if (n == length && strncmp(c, text, n) == 0)
      return position;
    c += n;
    if (*c == 0)
      return -1;
    c++;
  }
}

int setting_read(void *values, const struct setting *setting, const char *text, bool append,
                 struct mo_message *message)
{
  int status = MO_OK;
  switch (setting->type) {
  case SETTING_PATH: {
    char **value = AT(values, setting);
    free(*value);
    *value = *text != 0 ? enough(strdup(text)) : NULL;
    break;
  }
  case SETTING_LIST: status = set_list(AT(values, setting), text, append, message); break;
  case SETTING_NUMBER:
  case SETTING_BYTES:
  case SETTING_DURATION: {
    uint64_t number = 0;
    status = set_number(setting, text, &number, message);
    if (status == MO_OK)
      *(uint64_t *)AT(values, setting) = number;
    break;
  }
  case SETTING_CHOICE: {
    int position = choice_at(setting->choices, text);
    if (position < 0)
      return mo_fail(message, MO_ERR_INVALID, "\"%.60s\" is not one of %s", text, setting->choices);
    *(int *)AT(values, setting) = position;
    break;
  }
  }
  return status;
}

void setting_free(void *values, const struct setting *setting)
{
  if (setting->type == SETTING_PATH)
    free(*(char **)AT(values, setting));
  else if (setting->type == SETTING_LIST)
    list_free(AT(values, setting));
}

int settings_set(struct settings *settings, const struct setting *setting, const char *text,
                 enum setting_source source, bool append, struct mo_message *message)
{
  /* An empty text resets other settings to their default. Here it probably comes from an unset
   * variable in a script. */
  if (*text == 0 && source != SOURCE_DEFAULT &&
      setting->offset == offsetof(struct settings, state_dir))
    return mo_fail(message, MO_ERR_INVALID, "the path is empty");
  const int status = setting_read(settings, setting, text, append, message);
  if (status == MO_OK)
    settings->source[setting - settings_table] = (uint8_t)source;
  return status;
}

void settings_init(struct settings *settings)
{
  *settings = (struct settings){0};
  for (size_t i = 0; i < settings_count; i++)
    (void)settings_set(settings, &settings_table[i], settings_table[i].initial, SOURCE_DEFAULT,
                       false, NULL);
}

void settings_free(struct settings *settings)
{
  for (size_t i = 0; i < settings_count; i++)
    setting_free(settings, &settings_table[i]);
  *settings = (struct settings){0};
}

char *settings_value_text(const struct settings *settings, const struct setting *setting)
{
  char number[32];
  switch (setting->type) {
  case SETTING_PATH: {
    const char *path = *(char *const *)CAT(settings, setting);
    return enough(strdup(path != NULL ? path : ""));
  }
  case SETTING_LIST: {
    const struct setting_list *list = CAT(settings, setting);
    char *text = NULL;
    size_t length = 0;
    FILE *file = enough(open_memstream(&text, &length));
    for (size_t i = 0; i < list->n; i++)
      fprintf(file, "%s%s", i > 0 ? ", " : "", list->items[i]);
    return enough(fclose(file) == 0 ? text : NULL);
  }
  case SETTING_NUMBER:
  case SETTING_BYTES:
  case SETTING_DURATION:
    settings_number_text(setting->type, *(const uint64_t *)CAT(settings, setting), number,
                         sizeof(number));
    return enough(strdup(number));
  case SETTING_CHOICE: {
    const char *c = setting->choices;
    for (int position = *(const int *)CAT(settings, setting); position > 0; position--)
      c += strcspn(c, "|") + 1;
    return enough(strndup(c, strcspn(c, "|")));
  }
  }
  return NULL;
}

void settings_flag_name(const struct setting *setting, char *text, size_t capacity)
{
  snprintf(text, capacity, "--%s", setting->name);
  for (char *c = text; *c != 0; c++)
    if (*c == '_')
      *c = '-';
}

void settings_variable_name(const char *prefix, const struct setting *setting, char *text,
                            size_t capacity)
{
  snprintf(text, capacity, "%s_%s", prefix, setting->name);
  for (char *c = text; *c != 0; c++)
    *c = (char)toupper((unsigned char)*c);
}
