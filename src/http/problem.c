/* problem.c: see problem.h. */
#include "http/problem.h"

#include <microhttpd.h>

void mo_problem_write(struct mo_text *text, unsigned status, const char *type, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults)
{
  static const char *const places[] = {"pointer", "parameter", "header"};
  mo_text_format(text, "{\"status\":%u", status);
  mo_text_member(text, "type", type);
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
