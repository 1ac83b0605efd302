/* problems.c: the pages to which the types of problems lead: the parts of docs/problems.md. */
#include <stdio.h>
#include <string.h>

#include "api/handlers.h"
#include "api/openapi.h"

#define HEADING "\n## "

void mo_api_get_problem(struct mo_request *request)
{
  const char *document = (const char *)mo_problems;
  char heading[sizeof(HEADING) + MO_PATH_PARAMETER_BYTES + 1];
  snprintf(heading, sizeof(heading), HEADING "%s\n", request->parameters[0]);
  const char *part = strstr(document, heading);
  if (part == NULL) {
    mo_reply_problem(request, 404, NULL, "There is no such type of problem.");
    return;
  }
  const char *end = strstr(part + 1, HEADING);
  part += strlen("\n");
  mo_reply_static(request, 200, "text/plain; charset=utf-8", part,
                  end != NULL ? (size_t)(end - part) + 1 : strlen(part));
}
