/* cmd_export.c: saves any list, curve or phylogeny of the server in a file. */
#include <string.h>

#include "commands.h"

/* Returns the form that the end of a file's name tells, else csv. */
static const char *form_of(const char *output)
{
  static const struct {
    const char *end, *form;
  } ends[] = {{".csv", "csv"}, {".ndjson", "ndjson"}, {".jsonl", "ndjson"}, {".nwk", "newick"}};
  const char *end = strrchr(output, '.');
  for (size_t i = 0; end != NULL && i < sizeof(ends) / sizeof(ends[0]); i++)
    if (strcmp(end, ends[i].end) == 0)
      return ends[i].form;
  return "csv";
}

void run_export(struct ctl *ctl)
{
  static const char *const forms[] = {"csv", "ndjson", "newick", "columns", NULL};
  const char *list = ctl->operands[0], *output = option_text(ctl, "output", "-");
  const char *form = option_word(ctl, "format", forms, form_of(output));
  if (strncmp(list, "/v1/", 4) == 0)
    list += 4;
  for (const char *c = list; *c != '\0'; c++)
    if (*c <= ' ' || *c > '~' || *c == '#')
      fail(STATUS_USAGE, "\"%s\" is not a list: write other characters as %%20", list);
  const char between = strchr(list, '?') != NULL ? '&' : '?';
  save_reply(ctl, path_to("/v1/%s%cformat=%s", list, between, form), "*/*", output);
}
