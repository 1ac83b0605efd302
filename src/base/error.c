/* error.c: texts for error codes. */
#include <morpho/error.h>

#include <stdarg.h>
#include <stdio.h>

struct error {
  int code;
  const char *name, *text;
};

static const struct error *find(int code)
{
  static const struct error unknown = {0, "unknown", "unknown error"};
  static const struct error errors[] = {
      {MO_OK, "ok", "no error"},
      {MO_ERR_NO_MEMORY, "no_memory", "out of memory"},
      {MO_ERR_INVALID, "invalid", "invalid value"},
      {MO_ERR_RANGE, "range", "value out of range"},
      {MO_ERR_EMPTY, "empty", "empty body"},
      {MO_ERR_NOT_CONTIGUOUS, "not_contiguous", "body is not contiguous"},
      {MO_ERR_DUPLICATE, "duplicate", "duplicate"},
      {MO_ERR_FORMAT, "format", "wrong format"},
      {MO_ERR_LIMIT, "limit", "limit exceeded"},
      {MO_ERR_NOT_FOUND, "not_found", "not found"},
      {MO_ERR_CONFLICT, "conflict", "conflict"},
      {MO_ERR_IO, "io", "input or output failed"},
      {MO_ERR_NO_SPACE, "no_space", "no space left on the device"},
      {MO_ERR_CANCELLED, "cancelled", "cancelled"},
      {MO_ERR_BUSY, "busy", "busy"},
      {MO_ERR_EXHAUSTED, "exhausted", "exhausted"},
      {MO_ERR_CORRUPT, "corrupt", "stored data is corrupt"},
      {MO_ERR_UNSUPPORTED, "unsupported", "not supported here"},
      {MO_ERR_DEVICE, "device", "device failed"},
  };
  for (size_t i = 0; i < sizeof(errors) / sizeof(errors[0]); i++)
    if (errors[i].code == code)
      return &errors[i];
  return &unknown;
}

const char *mo_error_text(int code)
{
  return find(code)->text;
}

const char *mo_error_name(int code)
{
  return find(code)->name;
}

int mo_fail(struct mo_message *message, int code, const char *format, ...)
{
  if (message != NULL) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message->text, sizeof(message->text), format, arguments);
    va_end(arguments);
  }
  return code;
}
