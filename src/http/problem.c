/* problem.c: see problem.h. */
#include "http/problem.h"

#include <string.h>

const char *mo_status_title(unsigned status)
{
  switch (status) {
  case 400: return "Bad Request";
  case 401: return "Unauthorized";
  case 403: return "Forbidden";
  case 404: return "Not Found";
  case 405: return "Method Not Allowed";
  case 406: return "Not Acceptable";
  case 408: return "Request Timeout";
  case 409: return "Conflict";
  case 411: return "Length Required";
  case 412: return "Precondition Failed";
  case 413: return "Content Too Large";
  case 414: return "URI Too Long";
  case 415: return "Unsupported Media Type";
  case 417: return "Expectation Failed";
  case 422: return "Unprocessable Content";
  case 429: return "Too Many Requests";
  case 431: return "Request Header Fields Too Large";
  case 500: return "Internal Server Error";
  case 501: return "Not Implemented";
  case 503: return "Service Unavailable";
  case 505: return "HTTP Version Not Supported";
  case 507: return "Insufficient Storage";
  default: return "Error";
  }
}

void mo_problem_write(struct mo_text *text, unsigned status, const char *type, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults)
{
  static const char *const places[] = {"pointer", "parameter", "header"};
  mo_text_format(text, "{\"status\":%u", status);
  mo_text_member(text, "type", type);
  mo_text_member(text, "title", mo_status_title(status));
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
