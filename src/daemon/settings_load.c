/* settings_load.c: reads file, environment and flags, and prints the table as help, as a file and
 * as Markdown. */
#include "settings.h"
#include "settings_rows.h"

#include <ctype.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include <unistd.h>

#include "base/words.h"
#include "daemon/memory.h"

#define FILE_MAX (1 << 20)

struct flag {
  const char *name;
  enum settings_action action;
  const char *help;
};
static const struct flag action_flags[] = {
    {"--foreground", ACTION_RUN, "Accepted for clarity; no other mode exists."},
    {"--help", ACTION_HELP, "Print this text."},
    {"--version", ACTION_VERSION, "Print the version."},
    {"--check-config", ACTION_CHECK,
     "Check the configuration and everything that it refers to, report faults, and exit with 0 or "
     "78."},
    {"--print-config", ACTION_PRINT,
     "Print the current values as a configuration file, with the source of each."},
    {"--print-settings", ACTION_TABLE, "Print the table of all settings as Markdown."},
};
static const size_t n_action_flags = sizeof(action_flags) / sizeof(action_flags[0]);

/* Returns the setting with the name nearest to a mistyped one, or NULL if none is near. */
static const struct setting *nearest(const char *name)
{
  const int i =
      mo_word_nearest(name, &settings_table[0].name, settings_count, sizeof(settings_table[0]));
  return i >= 0 ? &settings_table[i] : NULL;
}

static const struct setting *find(const char *name)
{
  for (size_t i = 0; i < settings_count; i++)
    if (strcmp(settings_table[i].name, name) == 0)
      return &settings_table[i];
  return NULL;
}

static char *trim(char *text)
{
  text += strspn(text, " \t\r");
  size_t n = strlen(text);
  while (n > 0 && strchr(" \t\r", text[n - 1]) != NULL)
    n--;
  text[n] = 0;
  return text;
}

static void read_line(struct settings *settings, const char *file, size_t number, char *line,
                      unsigned *lines_seen, struct settings_faults *faults)
{
  char *text = trim(line);
  if (*text == 0 || *text == '#')
    return;
  char *equals = strchr(text, '=');
  if (equals == NULL) {
    settings_fault(faults, true,
                   "%s:%zu: \"=\" is missing in \"%.60s\"; a line must be \"name = value\"", file,
                   number, text);
    return;
  }
  *equals = 0;
  char *name = trim(text);
  char *value = trim(equals + 1);
  /* A comment may follow the value; a # inside a word is part of the word. */
  for (char *c = value; *c != 0; c++)
    if (*c == '#' && (c == value || c[-1] == ' ' || c[-1] == '\t')) {
      *c = 0;
      value = trim(value);
      break;
    }
  const struct setting *setting = find(name);
  if (setting == NULL) {
    const struct setting *near = nearest(name);
    if (near != NULL)
      settings_fault(faults, true, "%s:%zu: unknown setting \"%.60s\"; did you mean \"%s\"?", file,
                     number, name, near->name);
    else
      settings_fault(faults, true, "%s:%zu: unknown setting \"%.60s\"", file, number, name);
    return;
  }
  unsigned *seen = &lines_seen[setting - settings_table];
  if (*seen != 0) {
    settings_fault(faults, true, "%s:%zu: \"%s\" is already set in line %u", file, number, name,
                   *seen);
    return;
  }
  *seen = (unsigned)number;
  struct mo_message message = {{0}};
  if (settings_set(settings, setting, value, SOURCE_FILE, false, &message) != MO_OK)
    settings_fault(faults, true, "%s:%zu: %s: %s", file, number, name, message.text);
}

void settings_read_text(struct settings *settings, const char *file, const char *text,
                        size_t length, struct settings_faults *faults)
{
  unsigned lines_seen[SETTINGS_MAX] = {0};
  size_t number = 0;
  for (size_t start = 0; start < length;) {
    const char *newline = memchr(text + start, '\n', length - start);
    size_t n = newline != NULL ? (size_t)(newline - (text + start)) : length - start;
    number++;
    if (memchr(text + start, 0, n) != NULL) {
      settings_fault(faults, true, "%s:%zu: the line has a NUL byte", file, number);
    } else {
      char *line = enough(strndup(text + start, n));
      read_line(settings, file, number, line, lines_seen, faults);
      free(line);
    }
    start += n + 1;
  }
}

/* Returns whether the file exists. */
static bool read_file(struct settings *settings, const char *path, bool required,
                      struct settings_faults *faults)
{
  struct stat status;
  if (stat(path, &status) == 0 &&
      S_ISFIFO(status.st_mode)) { /* a reload would block on its writer */
    settings_fault(faults, true, "%s is a pipe, not a file", path);
    return false;
  }
  FILE *file = fopen(path, "re");
  if (file == NULL) {
    if (required || errno != ENOENT)
      settings_fault(faults, true, "%s: %s", path, strerror(errno));
    return false;
  }
  char *text = enough(malloc(FILE_MAX + 1));
  const size_t n = fread(text, 1, FILE_MAX + 1, file);
  if (ferror(file))
    settings_fault(faults, true, "%s: %s", path, strerror(errno));
  else if (n > FILE_MAX)
    settings_fault(faults, true, "%s: the file is larger than %d bytes", path, FILE_MAX);
  else
    settings_read_text(settings, path, text, n, faults);
  free(text);
  fclose(file);
  return true;
}

static void read_environment(struct settings *settings, const char *const *environment,
                             struct settings_faults *faults)
{
  /* Variables with this prefix that are not settings: the variables for morphoctl, and the name of
   * the file. */
  static const char *const others[] = {"config", "server", "token"};
  for (const char *const *entry = environment; entry != NULL && *entry != NULL; entry++) {
    if (strncmp(*entry, "MORPHOD_", 8) != 0)
      continue;
    const char *equals = strchr(*entry, '=');
    char name[64];
    size_t length = equals != NULL ? (size_t)(equals - *entry) - 8 : sizeof(name);
    if (length >= sizeof(name))
      continue;
    for (size_t i = 0; i < length; i++)
      name[i] = (char)tolower((unsigned char)(*entry)[8 + i]);
    name[length] = 0;
    bool other = false;
    for (size_t i = 0; i < sizeof(others) / sizeof(others[0]); i++)
      other |= strcmp(name, others[i]) == 0;
    other |= strncmp(name, "worker_", 7) == 0 && find(name) == NULL; /* of `morphod worker` */
    if (other)
      continue;
    const struct setting *setting = find(name);
    if (setting == NULL) {
      const struct setting *near = nearest(name);
      char variable[80] = "";
      if (near != NULL)
        settings_variable_name("MORPHOD", near, variable, sizeof(variable));
      settings_fault(faults, false, "environment: %.*s is not a setting%s%s%s", (int)length + 8,
                     *entry, near != NULL ? "; did you mean " : "", variable,
                     near != NULL ? "?" : "");
      continue;
    }
    struct mo_message message = {{0}};
    if (settings_set(settings, setting, equals + 1, SOURCE_ENVIRONMENT, false, &message) != MO_OK)
      settings_fault(faults, true, "environment: %.*s: %s", (int)length + 8, *entry, message.text);
  }
}

static void usage(struct settings_request *request, struct settings_faults *faults,
                  const char *flag, size_t length, const char *why)
{
  request->usage_fault = true;
  settings_fault(faults, true, "%.*s: %s", (int)length, flag, why);
}

static void apply_flag(struct settings *settings, const struct setting *setting, const char *flag,
                       size_t length, const char *value, struct settings_faults *faults)
{
  struct mo_message message = {{0}};
  bool again = settings->source[setting - settings_table] == SOURCE_FLAG;
  if (settings_set(settings, setting, value, SOURCE_FLAG, again, &message) != MO_OK)
    settings_fault(faults, true, "%.*s: %s", (int)length, flag, message.text);
}

const struct setting *setting_of_flag(const struct setting *rows, size_t n, const char *flag,
                                      size_t length)
{
  char name[80];
  for (size_t i = 0; i < n; i++) {
    settings_flag_name(&rows[i], name, sizeof(name));
    if (strlen(name) == length && strncmp(name, flag, length) == 0)
      return &rows[i];
  }
  return NULL;
}

static void unknown_flag(struct settings_request *request, struct settings_faults *faults,
                         const char *flag, size_t length)
{
  char name[64] = "", why[128] = "is not a flag; see --help", meant[80];
  if (length > 2 && length < sizeof(name))
    snprintf(name, sizeof(name), "%.*s", (int)length - 2, flag + 2);
  for (char *c = name; *c != 0; c++)
    if (*c == '-')
      *c = '_';
  const struct setting *near = *name != 0 ? nearest(name) : NULL;
  if (near != NULL) {
    settings_flag_name(near, meant, sizeof(meant));
    snprintf(why, sizeof(why), "is not a flag; did you mean %s?", meant);
  }
  usage(request, faults, flag, length, why);
}

static const struct flag *find_action(const char *flag, size_t length)
{
  for (size_t a = 0; a < n_action_flags; a++)
    if (strlen(action_flags[a].name) == length && strncmp(flag, action_flags[a].name, length) == 0)
      return &action_flags[a];
  return NULL;
}

/* Reads the command line once. `settings` NULL: looks only for the action and --config, which
 * precede everything else. */
static void read_flags(struct settings *settings, int argc, const char *const *argv,
                       struct settings_request *request, struct settings_faults *faults)
{
  bool first_walk = settings == NULL;
  for (int i = 1; i < argc; i++) {
    const char *flag = argv[i], *equals = strchr(flag, '=');
    size_t length = equals != NULL ? (size_t)(equals - flag) : strlen(flag);
    const struct flag *action = find_action(flag, length);
    if (action != NULL) {
      if (first_walk && equals != NULL)
        usage(request, faults, flag, length, "takes no value");
      if (first_walk && request->action != ACTION_HELP && action->action != ACTION_RUN)
        request->action = action->action;
      continue;
    }
    const struct setting *setting = setting_of_flag(settings_table, settings_count, flag, length);
    bool is_config = length == 8 && strncmp(flag, "--config", length) == 0;
    if (setting == NULL && !is_config) {
      if (first_walk)
        unknown_flag(request, faults, flag, length);
      continue;
    }
    if (equals == NULL && i + 1 >= argc) {
      if (first_walk)
        usage(request, faults, flag, length, "needs a value");
      break;
    }
    const char *value = equals != NULL ? equals + 1 : argv[++i];
    if (is_config)
      request->config = value;
    else if (!first_walk)
      apply_flag(settings, setting, flag, length, value, faults);
  }
}

static const char *variable(const char *const *environment, const char *name)
{
  size_t length = strlen(name);
  for (const char *const *entry = environment; entry != NULL && *entry != NULL; entry++)
    if (strncmp(*entry, name, length) == 0 && (*entry)[length] == '=')
      return *entry + length + 1;
  return NULL;
}

void settings_load(struct settings *settings, int argc, const char *const *argv,
                   const char *const *environment, struct settings_request *request,
                   struct settings_faults *faults)
{
  *request = (struct settings_request){0};
  read_flags(NULL, argc, argv, request, faults);
  if (request->config == NULL)
    request->config = variable(environment, "MORPHOD_CONFIG");
  if (request->config != NULL && *request->config != 0) {
    if (read_file(settings, request->config, true, faults))
      request->config_found = enough(strdup(request->config));
  } else if (request->config == NULL) {
    /* systemd passes the folder of ConfigurationDirectory=; otherwise, the usual place is used. */
    const char *folder = variable(environment, "CONFIGURATION_DIRECTORY");
    char *path =
        format_text("%s/morphod.conf", folder != NULL && *folder != 0 ? folder : "/etc/morphod");
    if (read_file(settings, path, false, faults))
      request->config_found = path;
    else
      free(path);
  }
  read_environment(settings, environment, faults);
  read_flags(settings, argc, argv, request, faults);
}

void settings_request_free(struct settings_request *request)
{
  free(request->config_found);
  *request = (struct settings_request){0};
}

char *credential_path(const char *folder)
{
  char *path = folder != NULL && *folder != 0 ? format_text("%s/token", folder) : NULL;
  if (path != NULL && access(path, R_OK) == 0)
    return path;
  free(path);
  return NULL;
}

void settings_complete(struct settings *settings, const char *const *environment)
{
  /* systemd passes a list separated by colons; morphod uses only one folder. */
  const char *state = variable(environment, "STATE_DIRECTORY");
  const char *xdg = variable(environment, "XDG_STATE_HOME");
  const char *home = variable(environment, "HOME");
  if (settings->state_dir == NULL && state != NULL && *state != 0)
    settings->state_dir = enough(strndup(state, strcspn(state, ":")));
  else if (settings->state_dir == NULL && xdg != NULL && *xdg == '/')
    settings->state_dir = format_text("%s/morphod", xdg);
  else if (settings->state_dir == NULL && home != NULL && *home == '/')
    settings->state_dir = format_text("%s/.local/state/morphod", home);
  else if (settings->state_dir == NULL)
    settings->state_dir = enough(strdup("/var/lib/morphod"));
  if (settings->token_file == NULL)
    settings->token_file = credential_path(variable(environment, "CREDENTIALS_DIRECTORY"));
}

static void bounds_text(const struct setting *setting, char *text, size_t capacity)
{
  char low[32], high[32];
  *text = 0;
  if (setting->type == SETTING_CHOICE) {
    char *out = text;
    for (const char *c = setting->choices; *c != 0 && (size_t)(out - text) + 3 < capacity; c++) {
      if (*c == '|')
        out = stpcpy(out, ", ");
      else
        *out++ = *c;
    }
    *out = 0;
  } else if (setting->type != SETTING_PATH && setting->type != SETTING_LIST) {
    settings_number_text(setting->type, setting->min, low, sizeof(low));
    settings_number_text(setting->type, setting->max, high, sizeof(high));
    snprintf(text, capacity, "%s to %s", low, high);
  }
}

void settings_print_rows(const struct setting *rows, size_t n, FILE *file)
{
  static const char *const words[] = {
      [SETTING_PATH] = "PATH",  [SETTING_LIST] = "LIST",     [SETTING_NUMBER] = "NUMBER",
      [SETTING_BYTES] = "SIZE", [SETTING_DURATION] = "TIME", [SETTING_CHOICE] = NULL};
  for (size_t i = 0; i < n; i++) {
    const struct setting *setting = &rows[i];
    char flag[80], bounds[128], text[1024];
    settings_flag_name(setting, flag, sizeof(flag));
    bounds_text(setting, bounds, sizeof(bounds));
    fprintf(file, "  %s %s\n", flag,
            setting->choices != NULL ? setting->choices : words[setting->type]);
    const char *initial =
        setting->initial_words != NULL ? setting->initial_words : setting->initial;
    if (setting->type == SETTING_CHOICE || *bounds == 0)
      snprintf(text, sizeof(text), "%s Default: %s.", setting->help, initial);
    else
      snprintf(text, sizeof(text), "%s Default: %s (%s).", setting->help, initial, bounds);
    mo_words_wrap(file, 6, text);
  }
}

void settings_print_help(FILE *file)
{
  fputs("Usage: morphod [FLAG]...\n       morphod store clean [--yes] [FLAG]...      removes "
        "unused files\n       morphod store check [--sample=N] [FLAG]... reads and checks all "
        "stored data; see morphod(8)\n       morphod store accept-clock [FLAG]...       confirms "
        "that the clock is right\n       morphod worker --server URL [FLAG]...      computes for a "
        "daemon on another machine; see its --help\nScores voxel robots over HTTP. Runs in the "
        "foreground until SIGTERM or SIGINT; SIGHUP reloads tokens and log level.\n\n  --config "
        "PATH\n      Configuration file (default: $CONFIGURATION_DIRECTORY/morphod.conf, else\n    "
        "  /etc/morphod/morphod.conf, if it exists).\n",
        file);
  for (size_t i = 0; i < n_action_flags; i++) {
    fprintf(file, "  %s\n", action_flags[i].name);
    mo_words_wrap(file, 6, action_flags[i].help);
  }
  fputs("\nSettings: a flag overrides an environment variable, which overrides the file, which\n"
        "overrides the default. In the file, --state-dir is state_dir; in the environment, it is\n"
        "MORPHOD_STATE_DIR, and so on.\n\n",
        file);
  settings_print_rows(settings_table, settings_count, file);
}

void settings_print(const struct settings *settings, FILE *file)
{
  static const char *const sources[] = {"default", "file", "environment", "flag"};
  for (size_t i = 0; i < settings_count; i++) {
    const struct setting *setting = &settings_table[i];
    char *text = settings_value_text(settings, setting);
    if (*text == 0)
      fprintf(file, "# %s =  # %s\n", setting->name,
              setting->initial_words != NULL ? setting->initial_words : "empty");
    else
      fprintf(file, "%s = %s  # %s\n", setting->name, text, sources[settings->source[i]]);
    free(text);
  }
}

void settings_print_table(FILE *file)
{
  fputs("| setting | flag | environment | default | values | meaning |\n"
        "| --- | --- | --- | --- | --- | --- |\n",
        file);
  for (size_t i = 0; i < settings_count; i++) {
    const struct setting *setting = &settings_table[i];
    char flag[80], name[80], bounds[128];
    settings_flag_name(setting, flag, sizeof(flag));
    settings_variable_name("MORPHOD", setting, name, sizeof(name));
    bounds_text(setting, bounds, sizeof(bounds));
    const char *kind = setting->type == SETTING_PATH   ? "path"
                       : setting->type == SETTING_LIST ? "list"
                                                       : bounds;
    const bool shown = *setting->initial != 0 || setting->initial_words == NULL;
    fprintf(file, "| `%s` | `%s` | `%s` | ", setting->name, flag, name);
    if (shown)
      fprintf(file, "`%s`", setting->initial);
    if (setting->initial_words != NULL)
      fprintf(file, "%s%s", shown ? ": " : "", setting->initial_words);
    fprintf(file, " | %s | %s%s |\n", kind, setting->help,
            setting->reloads ? " SIGHUP applies it." : "");
  }
}
