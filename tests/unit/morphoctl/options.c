/* The command line, and the request that options produce. */
#include "../check.h"

#include <jansson.h>

#include "commands.h"

/* Parses the words of a line, as if they followed "morphoctl". */
static struct ctl parse(const char *line)
{
  static char words[256];
  const char *argv[32] = {"morphoctl"};
  int argc = 1;
  struct ctl ctl = {.commands = commands, .n_commands = n_commands};
  snprintf(words, sizeof(words), "%s", line);
  for (char *word = strtok(words, " "); word != NULL; word = strtok(NULL, " "))
    argv[argc++] = word;
  options_parse(&ctl, argc, argv);
  return ctl;
}

static void commands_are_sound(void)
{
  for (size_t i = 0; i < n_commands; i++) {
    CHECK(commands[i].run != NULL);
    CHECK(commands[i].summary[strlen(commands[i].summary) - 1] == '.');
    for (const struct option_spec *spec = commands[i].options; spec != NULL && spec->name != NULL;
         spec++)
      for (const struct option_spec *other = common_options; other->name != NULL; other++) {
        CHECK(strcmp(spec->name, other->name) != 0);
        CHECK(spec->letter == 0 || spec->letter != other->letter);
        CHECK(spec->letter != 'e' || strncmp(spec->value, "SET", 3) == 0); /* not a number */
      }
  }
}

static void forms(void)
{
  struct ctl ctl = parse("eval a --controller=x -c y -q -- --b -");
  CHECK_TEXT(ctl.command->name, "eval");
  CHECK_INT(ctl.n_operands, 3);
  CHECK_TEXT(ctl.operands[1], "--b");
  CHECK_TEXT(option_text(&ctl, "controller", "z"), "y");
  CHECK_TEXT(option_text(&ctl, "label", "none"), "none");
  CHECK(option_is_set(&ctl, "quiet") && !option_is_set(&ctl, "json"));
  ctl = parse("job list -n7");
  CHECK_INT(option_number(&ctl, "limit", 1, 10, 50), 7);
  CHECK_INT(option_number(&ctl, "retry", 1, 10, 50), 50);
  ctl = parse("--server unix:/x -j --retry=3 job list -q -s y");
  CHECK_TEXT(ctl.command->name, "job list");
  CHECK(option_is_set(&ctl, "json") && option_is_set(&ctl, "quiet"));
  CHECK_TEXT(option_text(&ctl, "retry", ""), "3");
  CHECK_TEXT(option_text(&ctl, "server", ""), "y"); /* the last one */
  CHECK_INT(ctl.n_operands, 0);
}

static void request(void)
{
  const struct ctl ctl = parse("eval -c sha --precision float64 -p n_steps=9 -p dt_s=0.002 -p "
                               "impact=bisection8 -e paper-test");
  json_t *object = json_object();
  request_fill(&ctl, object);
  char *text = json_dumps(object, JSON_COMPACT | JSON_SORT_KEYS);
  CHECK_TEXT(text, "{\"controller\":\"sha\",\"environments\":\"paper-test\",\"physics\":{\"dt_s\":"
                   "0.002,\"impact\":\"bisection8\",\"n_steps\":9},\"precision\":\"float64\"}");
  free(text);
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
    options_print_help(memory, NULL, &commands[i]);
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
    {"commands are consistent", commands_are_sound},
    {"forms of options", forms},
    {"request", request},
    {"help and manual", help_and_manual},
};
CHECK_MAIN(cases)
