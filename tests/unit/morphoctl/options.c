/* The command line, and the request that options make. */
#include "../check.h"

#include <jansson.h>

#include "commands.h"

/* Parses the words of a line behind "morphoctl". */
static int parse(struct ctl *ctl, const char *line)
{
  static char words[256];
  const char *argv[32] = {"morphoctl"};
  int argc = 1;
  snprintf(words, sizeof(words), "%s", line);
  for (char *word = strtok(words, " "); word != NULL; word = strtok(NULL, " "))
    argv[argc++] = word;
  *ctl = (struct ctl){0};
  return options_parse(ctl, argc, argv);
}

static void commands_are_sound(void)
{
  for (size_t i = 0; i < n_commands; i++) {
    CHECK(commands[i].run != NULL && commands[i].max_operands >= commands[i].min_operands);
    CHECK(commands[i].summary[strlen(commands[i].summary) - 1] == '.');
    for (const struct option_spec *spec = commands[i].options; spec != NULL && spec->name != NULL;
         spec++)
      for (const struct option_spec *other = common_options; other->name != NULL; other++) {
        CHECK(strcmp(spec->name, other->name) != 0);
        CHECK(spec->letter == 0 || spec->letter != other->letter);
      }
  }
}

static void forms(void)
{
  struct ctl ctl;
  CHECK_INT(parse(&ctl, "eval a --controller=x -c y -q -- --b -"), -1);
  CHECK_TEXT(ctl.command->name, "eval");
  CHECK_INT(ctl.n_operands, 3);
  CHECK_TEXT(ctl.operands[1], "--b");
  CHECK_TEXT(option_text(&ctl, "controller", "z"), "y");
  CHECK_TEXT(option_text(&ctl, "label", "none"), "none");
  CHECK(option_is_set(&ctl, "quiet") && !option_is_set(&ctl, "json"));
  options_free(&ctl);
  CHECK_INT(parse(&ctl, "job list -n7"), -1);
  int64_t n = 50;
  CHECK(option_number(&ctl, "limit", 1, 10, &n));
  CHECK_INT(n, 7);
  CHECK(!option_number(&ctl, "limit", 8, 10, &n));
  options_free(&ctl);
  CHECK_INT(parse(&ctl, "--server unix:/x -j --retry=3 job list -q -s y"), -1);
  CHECK_TEXT(ctl.command->name, "job list");
  CHECK(option_is_set(&ctl, "json") && option_is_set(&ctl, "quiet"));
  CHECK_TEXT(option_text(&ctl, "retry", ""), "3");
  CHECK_TEXT(option_text(&ctl, "server", ""), "y"); /* the last one */
  CHECK_INT(ctl.n_operands, 0);
  options_free(&ctl);
}

static void mistakes(void)
{
  static const char *const lines[] = {
      "",         "evil",        "--limit 3 job list", "--server",     "--json=1 job list",
      "job",      "job lost",    "eval --verify",      "eval --label", "eval --no-wait=1",
      "eval -qj", "design show", "status x",
  };
  for (size_t i = 0; i < sizeof(lines) / sizeof(lines[0]); i++) {
    struct ctl ctl;
    CHECK_INT(parse(&ctl, lines[i]), STATUS_USAGE);
    options_free(&ctl);
  }
}

static void physics(void)
{
  static const char *const good[] = {"dt_s=0.002", "n_steps=200", "impact=bisection8"},
                           *const bad[] = {"dt=0.002",  "dt_s",     "=1",
                                           "dt_s=fast", "dt_s=inf", "n_steps=1.5"};
  json_t *object = json_object();
  for (size_t i = 0; i < sizeof(good) / sizeof(good[0]); i++)
    CHECK_INT(request_physics(object, good[i]), STATUS_OK);
  for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
    CHECK_INT(request_physics(object, bad[i]), STATUS_USAGE);
  char *text = json_dumps(object, JSON_COMPACT | JSON_SORT_KEYS);
  CHECK_TEXT(text, "{\"dt_s\":0.002,\"impact\":\"bisection8\",\"n_steps\":200}");
  free(text);
  json_decref(object);
}

static void request(void)
{
  struct ctl ctl;
  json_t *object = json_object();
  CHECK_INT(parse(&ctl, "eval -c sha --precision float64 -p n_steps=9 -e paper-test"), -1);
  CHECK_INT(request_fill(&ctl, object), STATUS_OK);
  char *text = json_dumps(object, JSON_COMPACT | JSON_SORT_KEYS);
  CHECK_TEXT(text, "{\"controller\":\"sha\",\"environments\":\"paper-test\",\"physics\":{\"n_"
                   "steps\":9},\"precision\":\"float64\"}");
  free(text);
  options_free(&ctl);
  CHECK_INT(parse(&ctl, "eval --precision float16"), -1);
  CHECK_INT(request_fill(&ctl, object), STATUS_USAGE);
  options_free(&ctl);
  json_decref(object);
}

static void help_and_manual(void)
{
  const char *path = getenv("MORPHOCTL_MANUAL");
  REQUIRE(path != NULL);
  char *manual = calloc(1, 1 << 20);
  FILE *file = fopen(path, "re");
  REQUIRE(file != NULL && manual != NULL);
  CHECK(fread(manual, 1, (1 << 20) - 1, file) > 1000);
  fclose(file);
  for (size_t i = 0; i < n_commands; i++) {
    char needle[80];
    snprintf(needle, sizeof(needle), ".Ss %s", commands[i].name);
    if (strstr(manual, needle) == NULL)
      printf("# not in the manual: %s\n", needle);
    CHECK(strstr(manual, needle) != NULL);
    for (const struct option_spec *spec = commands[i].options; spec != NULL && spec->name != NULL;
         spec++) {
      snprintf(needle, sizeof(needle), "Fl -%s", spec->name);
      if (strstr(manual, needle) == NULL)
        printf("# not in the manual: %s of %s\n", needle, commands[i].name);
      CHECK(strstr(manual, needle) != NULL);
    }
    char *text = NULL;
    size_t length = 0;
    FILE *memory = open_memstream(&text, &length);
    REQUIRE(memory != NULL);
    options_print_help(memory, &commands[i]);
    fclose(memory);
    CHECK(strstr(text, commands[i].summary) != NULL || length > 200);
    free(text);
  }
  for (const struct option_spec *spec = common_options; spec->name != NULL; spec++) {
    char needle[80];
    snprintf(needle, sizeof(needle), "Fl -%s", spec->name);
    CHECK(strstr(manual, needle) != NULL);
  }
  free(manual);
}

static const struct check_case cases[] = {
    {"commands are sound", commands_are_sound},
    {"forms of options", forms},
    {"mistakes", mistakes},
    {"physics", physics},
    {"request", request},
    {"help and manual", help_and_manual},
};
CHECK_MAIN(cases)
