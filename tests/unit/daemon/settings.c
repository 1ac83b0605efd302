/* The settings table: every way to set a value, precedence, and messages about mistakes. */
#include "../check.h"

#include <unistd.h>

#include "daemon/log.h"
#include "daemon/settings.h"

static const struct setting *row(const char *name)
{
  for (size_t i = 0; i < settings_count; i++)
    if (strcmp(settings_table[i].name, name) == 0)
      return &settings_table[i];
  return NULL;
}

static struct settings settings;
static struct settings_faults faults;
static struct settings_request request;

static void begin(void)
{
  settings_init(&settings);
}

static void end(void)
{
  settings_request_free(&request);
  settings_faults_free(&faults);
  settings_free(&settings);
}

static bool has_fault(const char *part)
{
  for (size_t i = 0; i < faults.n; i++)
    if (strstr(faults.items[i].text, part) != NULL)
      return true;
  for (size_t i = 0; i < faults.n; i++)
    printf("# fault: %s\n", faults.items[i].text);
  return false;
}

static void read_text(const char *text)
{
  settings_read_text(&settings, "t.conf", text, strlen(text), &faults);
}

static void table_is_sound(void)
{
  begin();
  for (size_t i = 0; i < settings_count; i++) {
    const struct setting *setting = &settings_table[i];
    CHECK(strspn(setting->name, "abcdefghijklmnopqrstuvwxyz_") == strlen(setting->name));
    CHECK(strlen(setting->help) > 20 && setting->help[strlen(setting->help) - 1] == '.');
    for (size_t j = 0; j < i; j++) {
      CHECK(strcmp(setting->name, settings_table[j].name) != 0);
      CHECK(setting->offset != settings_table[j].offset);
    }
    /* The default is read back unchanged. */
    char *text = settings_value_text(&settings, setting);
    REQUIRE(text != NULL);
    struct mo_message message = {{0}};
    CHECK_INT(settings_set(&settings, setting, text, SOURCE_DEFAULT, false, &message), MO_OK);
    char *again = settings_value_text(&settings, setting);
    CHECK_TEXT(again, text);
    free(text);
    free(again);
  }
  CHECK_INT(settings.log_level, LOG_LEVEL_INFO);
  CHECK_INT(settings.log_format, LOG_FORMAT_TEXT);
  CHECK_INT(settings.max_recorded_bytes, 64 << 20);
  CHECK_INT(settings.header_timeout_ms, 10000);
  end();
}

static void file_values(void)
{
  begin();
  read_text("# a comment\n\n  workers=3 # two\r\nlisten = 127.0.0.1:1, unix:/run/a#b  [::1]:2\n"
            "max_body = 2 MiB\nbody_timeout = 1500ms\nidle_timeout=2min\nisa = avx2\nstate_dir = "
            "/var/a b");
  CHECK_INT(faults.n, 0);
  CHECK_INT(settings.workers, 3);
  CHECK_INT(settings.listen.n, 3);
  CHECK_TEXT(settings.listen.items[1], "unix:/run/a#b");
  CHECK_INT(settings.max_body_bytes, 2 << 20);
  CHECK_INT(settings.body_timeout_ms, 1500);
  CHECK_INT(settings.idle_timeout_ms, 120000);
  CHECK_INT(settings.isa, 2);
  CHECK_TEXT(settings.state_dir, "/var/a b");
  end();
}

static void file_mistakes(void)
{
  static const struct {
    const char *line, *fault; /* NULL if it must be accepted */
  } lines[] = {{"worker = 3", "unknown setting \"worker\"; did you mean \"workers\"?"},
               {"zebra = 1", "unknown setting \"zebra\""},
               {"workers 3", "\"=\" is missing"},
               {"workers = many", "workers: \"many\" is not a whole number"},
               {"max_body = 99G", "max_body: 99G is not between 1K and 1G"},
               {"worker_nice = -1", "worker_nice: \"-1\" is not a whole number"},
               {"isa = sse", "isa: \"sse\" is not one of auto|x86-64|avx2|avx512"},
               {"events_kept = 99999999999999999999999",
                "events_kept: 99999999999999999999999 is not between 1000 and 100000000"},
               {"log_level = debug", NULL},
               {"log_level = info", "\"log_level\" is already set in line 9"},
               {"header_timeout = 10 parsecs",
                "header_timeout: \"10 parsecs\" is not a duration such as 10s"}};
  enum { N_LINES = sizeof(lines) / sizeof(lines[0]) };
  char text[1024] = "", fault[160];
  begin();
  for (size_t i = 0; i < N_LINES; i++)
    sprintf(text + strlen(text), "%s\n", lines[i].line);
  read_text(text);
  for (size_t i = 0; i < N_LINES; i++) {
    snprintf(fault, sizeof(fault), "t.conf:%zu: %s", i + 1, lines[i].fault);
    CHECK(lines[i].fault == NULL || has_fault(fault));
  }
  CHECK_INT(faults.n, N_LINES - 1);
  CHECK_INT(faults.n_fatal, N_LINES - 1);
  CHECK_INT(settings.workers, 0); /* faulty lines keep the default */
  settings_faults_free(&faults);
  settings_read_text(&settings, "t.conf", "workers = 1\0", 12, &faults);
  CHECK(has_fault("t.conf:1: the line has a NUL byte"));
  end();
}

static void precedence(void)
{
  char path[] = "/tmp/morphod-settings-XXXXXX";
  int file = mkstemp(path);
  REQUIRE(file >= 0);
  const char text[] = "workers = 2\nworker_nice = 2\nevents_kept = 2000\nlisten = 127.0.0.1:2\n";
  REQUIRE(write(file, text, sizeof(text) - 1) == (ssize_t)sizeof(text) - 1);
  close(file);
  char config[64];
  snprintf(config, sizeof(config), "--config=%s", path);
  const char *argv[] = {
      "morphod",      "--workers", "4", config, "--listen", "127.0.0.1:4", "--listen=127.0.0.1:5",
      "--foreground", NULL};
  const char *environment[] = {"MORPHOD_WORKERS=3",
                               "MORPHOD_WORKER_NICE=3",
                               "MORPHOD_LISTEN=127.0.0.1:3",
                               "MORPHOD_SERVER=x",
                               "MORPHOD_WORKERZ=1",
                               "HOME=/h",
                               NULL};
  begin();
  settings_load(&settings, 8, argv, environment, &request, &faults);
  unlink(path);
  CHECK_INT(faults.n_fatal, 0);
  CHECK(has_fault("MORPHOD_WORKERZ is not a setting; did you mean MORPHOD_WORKERS?"));
  CHECK_INT(settings.workers, 4);
  CHECK_INT(settings.worker_nice, 3);
  CHECK_INT(settings.events_kept, 2000);
  CHECK_INT(settings.listen.n, 2);
  CHECK_TEXT(settings.listen.items[0], "127.0.0.1:4");
  CHECK_INT(settings.source[row("workers") - settings_table], SOURCE_FLAG);
  CHECK_INT(settings.source[row("worker_nice") - settings_table], SOURCE_ENVIRONMENT);
  CHECK_INT(settings.source[row("events_kept") - settings_table], SOURCE_FILE);
  CHECK_INT(settings.source[row("isa") - settings_table], SOURCE_DEFAULT);
  CHECK_TEXT(request.config_found, path);
  CHECK_INT(request.action, ACTION_RUN);
  settings_complete(&settings, environment);
  CHECK_TEXT(settings.state_dir, "/h/.local/state/morphod");
  end();
}

static void flag_mistakes(void)
{
  const char *argv[] = {
      "morphod",       "--worker=3", "--check-config", "--isa",
      "mmx",           "stray",      "--config",       "/nonexistent/morphod.conf",
      "--events-kept", NULL};
  const char *environment[] = {"MORPHOD_MAX_BODY=1", NULL};
  begin();
  settings_load(&settings, 9, argv, environment, &request, &faults);
  CHECK(request.usage_fault);
  CHECK_INT(request.action, ACTION_CHECK);
  CHECK(has_fault("--worker: is not a flag; did you mean --workers?"));
  CHECK(has_fault("--isa: \"mmx\" is not one of"));
  CHECK(has_fault("stray: is not a flag; see --help"));
  CHECK(has_fault("/nonexistent/morphod.conf: No such file or directory"));
  CHECK(has_fault("--events-kept: needs a value"));
  CHECK(has_fault("environment: MORPHOD_MAX_BODY: 1 is not between 1K and 1G"));
  end();
}

static void surroundings(void)
{
  struct {
    const char *environment[4];
    const char *expected;
  } trials[] = {{{"STATE_DIRECTORY=/var/lib/morphod:/b", "XDG_STATE_HOME=/x", "HOME=/h", NULL},
                 "/var/lib/morphod"},
                {{"XDG_STATE_HOME=/x", "HOME=/h", NULL}, "/x/morphod"},
                {{"XDG_STATE_HOME=relative", "HOME=/h", NULL}, "/h/.local/state/morphod"},
                {{NULL}, "/var/lib/morphod"}};
  for (size_t i = 0; i < sizeof(trials) / sizeof(trials[0]); i++) {
    begin();
    settings_complete(&settings, trials[i].environment);
    CHECK_TEXT(settings.state_dir, trials[i].expected);
    end();
  }
}

static const struct check_case cases[] = {
    {"the table is consistent", table_is_sound},
    {"a file's values", file_values},
    {"a file's mistakes", file_mistakes},
    {"precedence", precedence},
    {"mistakes on the command line", flag_mistakes},
    {"values that depend on the environment", surroundings},
};
CHECK_MAIN(cases)
