/* cmd_export.c: saves any list, curve or phylogeny of the server in a file. */
#include <string.h>

#include "commands.h"

/* Returns the form that the end of a file's name tells; NULL: none. */
static const char *form_of(const char *output)
{
  static const struct {
    const char *end, *form;
  } ends[] = {{".csv", "csv"}, {".ndjson", "ndjson"}, {".jsonl", "ndjson"}, {".nwk", "newick"}};
  const char *end = strrchr(output, '.');
  for (size_t i = 0; end != NULL && i < sizeof(ends) / sizeof(ends[0]); i++)
    if (strcmp(end, ends[i].end) == 0)
      return ends[i].form;
  return NULL;
}

void run_export(struct ctl *ctl)
{
  static const char *const forms[] = {"csv", "ndjson", "newick", "columns"};
  const char *list = ctl->operands[0], *output = option_text(ctl, "output", "-");
  const char *form = option_text(ctl, "format", form_of(output));
  if (strncmp(list, "/v1/", 4) == 0)
    list += 4;
  if (form == NULL)
    form = "csv";
  if (!is_one_of(form, forms, sizeof(forms) / sizeof(forms[0])))
    fail(STATUS_USAGE, "--format: \"%s\" is not csv, ndjson, newick or columns", form);
  for (const char *c = list; *c != '\0'; c++)
    if (*c <= ' ' || *c > '~' || *c == '#')
      fail(STATUS_USAGE, "\"%s\" is not a list: write other characters as %%20", list);
  const char between = strchr(list, '?') != NULL ? '&' : '?';
  save_reply(ctl, path_to("/v1/%s%cformat=%s", list, between, form), "*/*", output);
}
