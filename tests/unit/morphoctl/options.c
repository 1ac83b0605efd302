/* The command line, and the request that options make. */
#include "../check.h"

#include <jansson.h>

#include "commands.h"

static int parse(struct ctl *ctl, int argc, const char *const *argv)
{
  *ctl = (struct ctl){0};
  return options_parse(ctl, argc, argv);
}
#define PARSE(ctl, ...)                                                                            \
  parse((ctl), (int)(sizeof((const char *[]){__VA_ARGS__}) / sizeof(char *)),                      \
        (const char *[]){__VA_ARGS__})

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
  CHECK_INT(
      PARSE(&ctl, "morphoctl", "eval", "a", "--controller=x", "-c", "y", "-q", "--", "--b", "-"),
      -1);
  CHECK_TEXT(ctl.command->name, "eval");
  CHECK_INT(ctl.n_operands, 3);
  CHECK_TEXT(ctl.operands[1], "--b");
  CHECK_TEXT(option_text(&ctl, "controller", "z"), "y");
  CHECK_TEXT(option_text(&ctl, "label", "none"), "none");
  CHECK(option_is_set(&ctl, "quiet") && !option_is_set(&ctl, "json"));
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "job", "list", "-n7"), -1);
  int64_t n = 50;
  CHECK(option_number(&ctl, "limit", 1, 10, &n));
  CHECK_INT(n, 7);
  CHECK(!option_number(&ctl, "limit", 8, 10, &n));
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "--server", "unix:/x", "-j", "--retry=3", "job", "list", "-q",
                  "-s", "y"),
            -1);
  CHECK_TEXT(ctl.command->name, "job list");
  CHECK(option_is_set(&ctl, "json") && option_is_set(&ctl, "quiet"));
  CHECK_TEXT(option_text(&ctl, "retry", ""), "3");
  CHECK_TEXT(option_text(&ctl, "server", ""), "y"); /* the last one */
  CHECK_INT(ctl.n_operands, 0);
  options_free(&ctl);
}

static void mistakes(void)
{
  struct ctl ctl;
  CHECK_INT(PARSE(&ctl, "morphoctl"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "evil"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "--limit", "3", "job", "list"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "--server"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "--json=1", "job", "list"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "job"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "job", "lost"), STATUS_USAGE);
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "--verify"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "--label"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "--no-wait=1"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "-qj"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "design", "show"), STATUS_USAGE);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "status", "x"), STATUS_USAGE);
  options_free(&ctl);
}

static void physics(void)
{
  json_t *object = json_object();
  CHECK_INT(request_physics(object, "dt_s=0.002"), STATUS_OK);
  CHECK_INT(request_physics(object, "n_steps=200"), STATUS_OK);
  CHECK_INT(request_physics(object, "impact=bisection8"), STATUS_OK);
  CHECK_INT(request_physics(object, "dt=0.002"), STATUS_USAGE);
  CHECK_INT(request_physics(object, "dt_s"), STATUS_USAGE);
  CHECK_INT(request_physics(object, "=1"), STATUS_USAGE);
  CHECK_INT(request_physics(object, "dt_s=fast"), STATUS_USAGE);
  CHECK_INT(request_physics(object, "dt_s=inf"), STATUS_USAGE);
  CHECK_INT(request_physics(object, "n_steps=1.5"), STATUS_USAGE);
  char *text = json_dumps(object, JSON_COMPACT | JSON_SORT_KEYS);
  CHECK_TEXT(text, "{\"dt_s\":0.002,\"impact\":\"bisection8\",\"n_steps\":200}");
  free(text);
  json_decref(object);
}

static void request(void)
{
  struct ctl ctl;
  json_t *object = json_object();
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "-c", "sha", "--precision", "float64", "-p",
                  "n_steps=9", "-e", "paper-test"),
            -1);
  CHECK_INT(request_fill(&ctl, object), STATUS_OK);
  char *text = json_dumps(object, JSON_COMPACT | JSON_SORT_KEYS);
  CHECK_TEXT(text, "{\"controller\":\"sha\",\"environments\":\"paper-test\",\"physics\":{\"n_"
                   "steps\":9},\"precision\":\"float64\"}");
  free(text);
  options_free(&ctl);
  CHECK_INT(PARSE(&ctl, "morphoctl", "eval", "--precision", "float16"), -1);
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
