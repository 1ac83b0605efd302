/* error.c: error codes in words. */
#include <morpho/error.h>

#include <stdarg.h>
#include <stdio.h>

const char *mo_error_text(int code)
{
  switch (code) {
  case MO_OK: return "no error";
  case MO_ERR_NO_MEMORY: return "out of memory";
  case MO_ERR_INVALID: return "invalid value";
  case MO_ERR_RANGE: return "value out of range";
  case MO_ERR_EMPTY: return "empty body";
  case MO_ERR_NOT_CONTIGUOUS: return "body is not contiguous";
  case MO_ERR_DUPLICATE: return "duplicate";
  case MO_ERR_FORMAT: return "wrong format";
  case MO_ERR_LIMIT: return "limit exceeded";
  case MO_ERR_NOT_FOUND: return "not found";
  case MO_ERR_CONFLICT: return "conflict";
  case MO_ERR_IO: return "input or output failed";
  case MO_ERR_NO_SPACE: return "no space left on the device";
  case MO_ERR_CANCELLED: return "cancelled";
  case MO_ERR_BUSY: return "busy";
  case MO_ERR_EXHAUSTED: return "exhausted";
  case MO_ERR_CORRUPT: return "stored data is corrupt";
  case MO_ERR_UNSUPPORTED: return "not supported here";
  case MO_ERR_DEVICE: return "device failed";
  default: return "unknown error";
  }
}

const char *mo_error_name(int code)
{
  switch (code) {
  case MO_OK: return "ok";
  case MO_ERR_NO_MEMORY: return "no_memory";
  case MO_ERR_INVALID: return "invalid";
  case MO_ERR_RANGE: return "range";
  case MO_ERR_EMPTY: return "empty";
  case MO_ERR_NOT_CONTIGUOUS: return "not_contiguous";
  case MO_ERR_DUPLICATE: return "duplicate";
  case MO_ERR_FORMAT: return "format";
  case MO_ERR_LIMIT: return "limit";
  case MO_ERR_NOT_FOUND: return "not_found";
  case MO_ERR_CONFLICT: return "conflict";
  case MO_ERR_IO: return "io";
  case MO_ERR_NO_SPACE: return "no_space";
  case MO_ERR_CANCELLED: return "cancelled";
  case MO_ERR_BUSY: return "busy";
  case MO_ERR_EXHAUSTED: return "exhausted";
  case MO_ERR_CORRUPT: return "corrupt";
  case MO_ERR_UNSUPPORTED: return "unsupported";
  case MO_ERR_DEVICE: return "device";
  default: return "unknown";
  }
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
