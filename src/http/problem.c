/* problem.c: problem documents. */
#include "http/reply.h"

static const struct {
  unsigned status;
  const char *type;
} types[] = {{400, "/problems/bad-request"},
             {401, "/problems/unauthorized"},
             {403, "/problems/forbidden"},
             {404, "/problems/not-found"},
             {405, "/problems/method-not-allowed"},
             {406, "/problems/not-acceptable"},
             {409, "/problems/conflict"},
             {410, "/problems/gone"},
             {411, "/problems/length-required"},
             {413, "/problems/too-large"},
             {414, "/problems/target-too-long"},
             {415, "/problems/unsupported-type"},
             {417, "/problems/expectation-failed"},
             {422, "/problems/invalid-request"},
             {429, "/problems/too-many"},
             {431, "/problems/header-too-large"},
             {500, "/problems/internal-error"},
             {501, "/problems/not-implemented"},
             {503, "/problems/unavailable"},
             {505, "/problems/version-not-supported"},
             {507, "/problems/no-space"}};

static const char *type_of(unsigned status, const struct mo_faults *faults)
{
  if (faults != NULL && faults->malformed)
    return "/problems/malformed-json";
  for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
    if (types[i].status == status)
      return types[i].type;
  return "about:blank"; /* found by the HTTP library itself: the status says it all */
}

void mo_problem_write(struct mo_text *text, unsigned status, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults)
{
  static const char *const places[] = {"pointer", "parameter", "header"};
  mo_text_format(text, "{\"status\":%u", status);
  mo_text_member(text, "type", type_of(status, faults));
  mo_text_member(text, "title", MHD_get_reason_phrase_for(status));
  mo_text_member(text, "detail", detail);
  mo_text_member(text, "instance", instance);
  mo_text_member(text, "request_id", request_id);
  if (faults != NULL && faults->n > 0) {
    mo_text_add(text, ",\"errors\":[");
    for (const struct mo_fault *fault = faults->items; fault < faults->items + faults->n; fault++) {
      mo_text_object(text);
      mo_text_member(text, "detail", fault->detail);
      mo_text_member(text, places[fault->place], fault->where);
      mo_text_add(text, "}");
    }
    mo_text_add(text, "]");
  }
  mo_text_add(text, "}");
}
