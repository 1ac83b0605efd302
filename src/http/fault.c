/* fault.c: see fault.h. */
#include "http/fault.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

/* Cuts a text at most one UTF-8 sequence short of its buffer, so that no half character remains. */
static void trim_utf8(char *text)
{
  size_t n = strlen(text), at = 0;
  while (at < n) {
    unsigned length = mo_utf8_sequence((const unsigned char *)text + at, n - at);
    if (length == 0 && n - at < 4)
      break;
    at += length == 0 ? 1 : length;
  }
  text[at] = '\0';
}

void mo_faults_add(struct mo_faults *faults, enum mo_fault_place place, const char *where,
                   const char *format, ...)
{
  if (mo_faults_full(faults))
    return;
  struct mo_fault *fault = &faults->items[faults->n++];
  fault->place = place;
  snprintf(fault->where, sizeof(fault->where), "%s", where);
  trim_utf8(fault->where);
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(fault->detail, sizeof(fault->detail), format, arguments);
  va_end(arguments);
  trim_utf8(fault->detail);
}

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
  case 415: return "Unsupported Media Type";
  case 417: return "Expectation Failed";
  case 422: return "Unprocessable Content";
  case 429: return "Too Many Requests";
  case 431: return "Request Header Fields Too Large";
  case 500: return "Internal Server Error";
  case 501: return "Not Implemented";
  case 503: return "Service Unavailable";
  case 507: return "Insufficient Storage";
  default: return "Error";
  }
}

static void member(struct mo_text *text, const char *name, const char *value)
{
  mo_text_format(text, ",\"%s\":", name);
  mo_text_json_string(text, value, strlen(value));
}

void mo_problem_write(struct mo_text *text, unsigned status, const char *type, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults)
{
  static const char *const places[] = {"pointer", "parameter", "header"};
  mo_text_format(text, "{\"status\":%u", status);
  member(text, "type", type);
  member(text, "title", mo_status_title(status));
  member(text, "detail", detail);
  member(text, "instance", instance);
  member(text, "request_id", request_id);
  if (faults != NULL && faults->n > 0) {
    mo_text_add(text, ",\"errors\":[");
    for (unsigned i = 0; i < faults->n; i++) {
      const struct mo_fault *fault = &faults->items[i];
      mo_text_add(text, i > 0 ? ",{\"detail\":" : "{\"detail\":");
      mo_text_json_string(text, fault->detail, strlen(fault->detail));
      member(text, places[fault->place], fault->where);
      mo_text_add(text, "}");
    }
    mo_text_add(text, "]");
  }
  mo_text_add(text, "}");
}
