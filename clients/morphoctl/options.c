/* options.c: parses the command line. Options may be anywhere, the common ones even before the
 * command; "--" ends them. "--name=value" and "--name value" are the same. */
#include "base/words.h"
#include "ctl.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

const struct option_spec common_options[] = {
    {"server", 's', "ADDRESS",
     "Server: http://host:port or unix:/path (default: $MORPHOD_SERVER, else "
     "http://127.0.0.1:8765)."},
    {"token-file", 0, "FILE",
     "File with the bearer token, or with lines of NAME RIGHT TOKEN as morphod reads them "
     "(default: the token in $MORPHOD_TOKEN)."},
    {"token-name", 0, "NAME", "Name of the token to use, if the file has several."},
    {"json", 'j', NULL, "Print the API's JSON instead of tables."},
    {"quiet", 'q', NULL, "Do not show progress or notes."},
    {"retry", 0, "SECONDS",
     "How long to retry a failing connection (default: 2, and 60 once the server has "
     "answered)."},
    {"help", 'h', NULL, "Print this text."},
    {NULL, 0, NULL, NULL},
};

const char *did_you_mean(const char *dashes, const char *name, const char *const *first, size_t n,
                         size_t stride)
{
  static char words[96];
  const int nearest = mo_word_nearest(name, first, n, stride);
  if (nearest < 0)
    return "";
  const char *near = *(const char *const *)((const char *)first + (size_t)nearest * stride);
  snprintf(words, sizeof(words), "; did you mean %s%s?", dashes, near);
  return words;
}

/* ---- help ---- */

static void print_options(FILE *file, const struct option_spec *options)
{
  for (const struct option_spec *spec = options; spec != NULL && spec->name != NULL; spec++) {
    char letter[8] = "";
    if (spec->letter != 0)
      snprintf(letter, sizeof(letter), "-%c, ", spec->letter);
    fprintf(file, "  %s--%s%s%s\n", letter, spec->name, spec->value != NULL ? " " : "",
            spec->value != NULL ? spec->value : "");
    mo_words_wrap(file, 6, spec->help);
  }
}

void options_print_help(FILE *file, const struct ctl *ctl, const struct command *command)
{
  if (command != NULL) {
    fprintf(file, "Usage: morphoctl %s [OPTION]...%s%s\n", command->name,
            *command->operands != 0 ? " " : "", command->operands);
    mo_words_wrap(file, 0, command->summary);
    if (command->details != NULL) {
      fputc('\n', file);
      mo_words_wrap(file, 0, command->details);
    }
    if (command->options != NULL) {
      fputs("\nOptions:\n", file);
      print_options(file, command->options);
    }
    fputs("\nCommon options:\n", file);
    print_options(file, common_options);
    return;
  }
  fputs("Usage: morphoctl COMMAND [OPTION]... [OPERAND]...\n"
        "Scores voxel robots and manages the jobs of a morphod server.\n\nCommands:\n",
        file);
  for (size_t i = 0; i < ctl->n_commands; i++)
    fprintf(file, "  %-18s %s\n", ctl->commands[i].name, ctl->commands[i].summary);
  fputs("\nCommon options:\n", file);
  print_options(file, common_options);
  fputs("\nExit status: 0 done; 1 error; 2 wrong usage; 3 not found, or negative result; 4 no "
        "connection;\n"
        "5 not allowed; 6 rejected by the server; 7 server too busy; 130 interrupted.\n"
        "For a command, see morphoctl COMMAND --help; for everything, see morphoctl(1).\n",
        file);
}

void options_print_completion(FILE *file, const struct ctl *ctl)
{
  fputs("# bash completion of morphoctl; written by `morphoctl completion`.\n"
        "_morphoctl() {\n"
        "  local word=${COMP_WORDS[COMP_CWORD]} first=${COMP_WORDS[1]-} second=${COMP_WORDS[2]-} "
        "options\n"
        "  COMPREPLY=()\n"
        "  if [ \"$COMP_CWORD\" -eq 1 ]; then\n"
        "    mapfile -t COMPREPLY < <(compgen -W \"",
        file);
  for (size_t i = 0; i < ctl->n_commands; i++) {
    size_t length = strcspn(ctl->commands[i].name, " ");
    if (i == 0 || strncmp(ctl->commands[i].name, ctl->commands[i - 1].name, length) != 0 ||
        strcspn(ctl->commands[i - 1].name, " ") != length)
      fprintf(file, "%.*s ", (int)length, ctl->commands[i].name);
  }
  fputs("\" -- \"$word\")\n    return\n  fi\n  case \"$first $second\" in\n", file);
  for (size_t i = 0; i < ctl->n_commands; i++) {
    bool two = strchr(ctl->commands[i].name, ' ') != NULL;
    const size_t n_name = strlen(ctl->commands[i].name);
    fprintf(file, "    \"%s\"%s) options=\"", ctl->commands[i].name, two ? "" : "\\ *");
    for (size_t j = 0; j < ctl->n_commands && !two; j++)
      if (strncmp(ctl->commands[j].name, ctl->commands[i].name, n_name) == 0 &&
          ctl->commands[j].name[n_name] == ' ')
        fprintf(file, "%s ", ctl->commands[j].name + n_name + 1);
    for (const struct option_spec *spec = ctl->commands[i].options;
         spec != NULL && spec->name != NULL; spec++)
      fprintf(file, "--%s ", spec->name);
    for (const struct option_spec *spec = common_options; spec->name != NULL; spec++)
      fprintf(file, "--%s ", spec->name);
    fputs("\" ;;\n", file);
  }
  for (size_t i = 0; i < ctl->n_commands; i++) {
    size_t length = strcspn(ctl->commands[i].name, " ");
    if (ctl->commands[i].name[length] == 0 ||
        (i > 0 && strncmp(ctl->commands[i].name, ctl->commands[i - 1].name, length + 1) == 0))
      continue;
    fprintf(file, "    \"%.*s \"*) options=\"", (int)length, ctl->commands[i].name);
    for (size_t j = i; j < ctl->n_commands &&
                       strncmp(ctl->commands[j].name, ctl->commands[i].name, length + 1) == 0;
         j++)
      fprintf(file, "%s ", ctl->commands[j].name + length + 1);
    fputs("\" ;;\n", file);
  }
  fputs("    *) options= ;;\n  esac\n"
        "  mapfile -t COMPREPLY < <(compgen -W \"$options\" -- \"$word\")\n"
        "  case \"$word\" in -*) ;; *) [ \"${#COMPREPLY[@]}\" -gt 0 ] && [ \"$COMP_CWORD\" -eq 2 ] "
        "|| mapfile -t COMPREPLY < <(compgen -f -- \"$word\") ;; esac\n"
        "}\ncomplete -F _morphoctl morphoctl\n",
        file);
}

/* ---- parsing ---- */

static const struct option_spec *find_option(const struct command *command, const char *name,
                                             size_t length)
{
  const struct option_spec *lists[2] = {command != NULL ? command->options : NULL, common_options};
  for (int l = 0; l < 2; l++)
    for (const struct option_spec *spec = lists[l]; spec != NULL && spec->name != NULL; spec++)
      if ((length == 1 && *name == spec->letter) ||
          (length > 1 && strlen(spec->name) == length && strncmp(spec->name, name, length) == 0))
        return spec;
  return NULL;
}

/* Returns the option of the command that has no letter here, but this letter in other commands.
 * NULL: none. */
static const struct option_spec *find_without_letter(const struct ctl *ctl, char letter)
{
  for (size_t i = 0; i < ctl->n_commands; i++)
    for (const struct option_spec *other = ctl->commands[i].options;
         other != NULL && other->name != NULL; other++) {
      const struct option_spec *spec =
          other->letter == letter ? find_option(ctl->command, other->name, strlen(other->name))
                                  : NULL;
      if (spec != NULL)
        return spec;
    }
  return NULL;
}

static _Noreturn void refuse_option(const struct ctl *ctl, const char *text, size_t length)
{
  const struct command *command = ctl->command;
  const char *names[64];
  char name[64] = "";
  size_t n = 0;
  const struct option_spec *lists[2] = {command->options, common_options};
  for (int l = 0; l < 2; l++)
    for (const struct option_spec *spec = lists[l]; spec != NULL && spec->name != NULL && n < 64;
         spec++)
      names[n++] = spec->name;
  const struct option_spec *spec = text[1] != '-' ? find_without_letter(ctl, text[1]) : NULL;
  if (spec != NULL)
    fail(STATUS_USAGE, "%.2s is not an option of %s; write --%s%s%s", text, command->name,
         spec->name, spec->value != NULL ? " " : "", spec->value != NULL ? spec->value : "");
  if (length > 2)
    snprintf(name, sizeof(name), "%.*s", (int)length - 2, text + 2);
  const char *near = *name != 0 ? did_you_mean("--", name, names, n, sizeof(*names)) : "";
  if (*near != 0)
    fail(STATUS_USAGE, "%.*s is not an option of %s%s", (int)length, text, command->name, near);
  fail(STATUS_USAGE, "%.*s is not an option of %s; see morphoctl %s --help", (int)length, text,
       command->name, command->name);
}

/* Finds the command in the first words. *used: number of its words. */
static const struct command *find_command(const struct ctl *ctl, int argc, const char *const *argv,
                                          int *used)
{
  const size_t length = strlen(argv[1]);
  for (size_t i = 0; i < ctl->n_commands; i++) {
    const char *rest = ctl->commands[i].name + length;
    if (strncmp(ctl->commands[i].name, argv[1], length) != 0)
      continue;
    *used = *rest == 0 ? 1 : 2;
    if (*rest == 0 || (*rest == ' ' && argc > 2 && strcmp(argv[2], rest + 1) == 0))
      return &ctl->commands[i];
  }
  return NULL;
}

static _Noreturn void refuse_command(const struct ctl *ctl, int argc, const char *const *argv)
{
  size_t length = strlen(argv[1]);
  const bool asks = argc > 2 && (strcmp(argv[2], "--help") == 0 || strcmp(argv[2], "-h") == 0);
  FILE *out = asks ? stdout : stderr;
  bool group = false;
  for (size_t i = 0; i < ctl->n_commands; i++)
    if (strncmp(ctl->commands[i].name, argv[1], length) == 0 &&
        ctl->commands[i].name[length] == ' ') {
      if (!group && !asks)
        fprintf(out, "morphoctl: %s%s%s; the commands are\n", argv[1],
                argc > 2 ? " has no command " : " needs a command", argc > 2 ? argv[2] : "");
      group = true;
      fprintf(out, "  morphoctl %-18s %s\n", ctl->commands[i].name, ctl->commands[i].summary);
    }
  if (group)
    leave(asks ? STATUS_OK : STATUS_USAGE);
  const char *near =
      did_you_mean("", argv[1], &ctl->commands->name, ctl->n_commands, sizeof(*ctl->commands));
  fail(STATUS_USAGE, "unknown command \"%s\"%s", argv[1],
       *near != 0 ? near : "; see morphoctl --help");
}

/* A word that is an option, split into its parts. spec NULL: the command (or, for NULL, every
 * command) has no such option. */
struct option_word {
  const struct option_spec *spec;
  const char *value; /* from the word itself; NULL if it has none */
  size_t length;     /* of the word without its value */
};

static bool is_option(const char *word)
{
  return word[0] == '-' && word[1] != 0;
}

static struct option_word read_option(const struct command *command, const char *word)
{
  struct option_word option = {.length = strlen(word)};
  if (word[1] != '-') { /* -n, -nVALUE */
    option.spec = find_option(command, word + 1, 1);
    option.value = word[2] != 0 ? word + 2 : NULL;
    return option;
  }
  option.length = strcspn(word, "=");
  option.value = word[option.length] == '=' ? word + option.length + 1 : NULL;
  if (option.length > 3)
    option.spec = find_option(command, word + 2, option.length - 2);
  return option;
}

/* Counts the words before the command: common options and their values. */
static int count_leading(int argc, const char *const *argv)
{
  int i = 1;
  while (i < argc && is_option(argv[i]) && strcmp(argv[i], "--") != 0) {
    struct option_word option = read_option(NULL, argv[i]);
    if (option.spec == NULL || strcmp(option.spec->name, "help") == 0)
      break;
    i += option.spec->value != NULL && option.value == NULL && i + 1 < argc ? 2 : 1;
  }
  return i - 1;
}

static void parse_words(struct ctl *ctl, int n, const char *const *words)
{
  bool ended = false;
  for (int i = 0; i < n; i++) {
    const char *word = words[i];
    if (ended || !is_option(word)) {
      ctl->operands[ctl->n_operands++] = word;
      continue;
    }
    if (strcmp(word, "--") == 0) {
      ended = true;
      continue;
    }
    struct option_word option = read_option(ctl->command, word);
    if (option.spec == NULL)
      refuse_option(ctl, word, option.length);
    if (option.spec->value == NULL && option.value != NULL)
      fail(STATUS_USAGE, "--%s takes no value", option.spec->name);
    if (option.spec->value != NULL && option.value == NULL) {
      if (i + 1 == n)
        fail(STATUS_USAGE, "--%s needs a value: %s", option.spec->name, option.spec->value);
      option.value = words[++i];
    }
    ctl->given[ctl->n_given++] = (struct given){option.spec->name, option.value};
  }
}

/* Returns whether there may be n operands: "A" is one, "[A]" at most one, "..." any further
 * number. */
static bool is_number_of_operands(const char *operands, size_t n)
{
  size_t min = 0, max = 0;
  for (size_t length; *operands != 0; operands += length + (operands[length] == ' ')) {
    length = strcspn(operands, " ");
    min += *operands != '[';
    max = operands[length - 1] == '.' ? SIZE_MAX : max + 1;
  }
  return n >= min && n <= max;
}

static _Noreturn void print_help(FILE *file, const struct ctl *ctl, const struct command *command,
                                 int status)
{
  options_print_help(file, ctl, command);
  leave(status);
}

void options_parse(struct ctl *ctl, int argc, const char *const *argv)
{
  const char *version[] = {argv[0], "version"};
  int leading = count_leading(argc, argv), n = argc - leading, used = 0;
  const char *const *words = argv + leading; /* words[1] is the command */
  if (n < 2)
    print_help(stderr, ctl, NULL, STATUS_USAGE);
  if (strcmp(words[1], "--help") == 0 || strcmp(words[1], "-h") == 0)
    print_help(stdout, ctl, NULL, STATUS_OK);
  const bool helps = strcmp(words[1], "help") == 0;
  if (helps && (n < 3 || is_option(words[2])))
    print_help(stdout, ctl, NULL, STATUS_OK);
  if (helps) {
    words++;
    n--;
  } else if (strcmp(words[1], "--version") == 0) {
    words = version;
    n = 2;
  }
  if (is_option(words[1]))
    fail(STATUS_USAGE, "%s is not a global option: put a command's options after its name",
         words[1]);
  ctl->command = find_command(ctl, n, words, &used);
  if (ctl->command == NULL)
    refuse_command(ctl, n, words);
  if (helps)
    print_help(stdout, ctl, ctl->command, STATUS_OK);
  ctl->given = keep(calloc((size_t)argc, sizeof(*ctl->given)));
  ctl->operands = keep(calloc((size_t)argc, sizeof(*ctl->operands)));
  parse_words(ctl, leading, argv + 1);
  parse_words(ctl, n - 1 - used, words + 1 + used);
  if (option_is_set(ctl, "help"))
    print_help(stdout, ctl, ctl->command, STATUS_OK);
  if (!is_number_of_operands(ctl->command->operands, ctl->n_operands))
    fail(STATUS_USAGE, "usage: morphoctl %s [OPTION]... %s", ctl->command->name,
         ctl->command->operands);
}

bool option_is_set(const struct ctl *ctl, const char *name)
{
  for (size_t i = 0; i < ctl->n_given; i++)
    if (strcmp(ctl->given[i].name, name) == 0)
      return true;
  return false;
}

const char *option_text(const struct ctl *ctl, const char *name, const char *otherwise)
{
  for (size_t i = ctl->n_given; i-- > 0;)
    if (strcmp(ctl->given[i].name, name) == 0)
      return ctl->given[i].value;
  return otherwise;
}

const char *option_word(const struct ctl *ctl, const char *name, const char *const *words,
                        const char *otherwise)
{
  const char *text = option_text(ctl, name, otherwise);
  char list[MO_WORDS_BYTES];
  if (text != NULL && mo_word_index(words, text) < 0)
    fail(STATUS_USAGE, "--%s: \"%s\" is not %s", name, text, mo_words_join(words, "", list));
  return text;
}

int64_t option_number(const struct ctl *ctl, const char *name, int64_t min, int64_t max,
                      int64_t otherwise)
{
  const char *text = option_text(ctl, name, NULL);
  if (text == NULL)
    return otherwise;
  char *end;
  errno = 0;
  const long long value = strtoll(text, &end, 10);
  if (*text == 0 || *end != 0 || errno != 0 || value < min || value > max)
    fail(STATUS_USAGE, "--%s: \"%s\" is not a whole number from %lld to %lld", name, text,
         (long long)min, (long long)max);
  return value;
}
