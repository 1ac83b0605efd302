/* memory.c: see ctl.h. */
#include <errno.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>

#include "ctl.h"

static volatile sig_atomic_t interrupt_seen;
static const char *farewell;

void *need(void *memory)
{
  if (memory == NULL)
    fail(STATUS_ERROR, "out of memory");
  return memory;
}

void *keep(void *memory)
{
  static void **kept;
  static size_t n;
  if ((n & (n - 1)) == 0) /* a power of two: full */
    kept = need(realloc(kept, (2 * n + 1) * sizeof(*kept)));
  return kept[n++] = need(memory);
}

char *format_text(const char *format, ...)
{
  char *text = NULL;
  va_list arguments;
  va_start(arguments, format);
  const int n = vasprintf(&text, format, arguments);
  va_end(arguments);
  return need(n < 0 ? NULL : text);
}

void close_text(FILE *file)
{
  need(fclose(file) == 0 ? file : NULL);
}

/* ---- exit ---- */

static bool progress_stands;

bool progress_begin(void)
{
  const bool stood = progress_stands;
  progress_stands = true;
  return stood;
}

void progress_end(void)
{
  if (progress_stands)
    fputs("\r\033[K", stderr);
  progress_stands = false;
}

static void complain_list(const char *format, va_list arguments)
{
  progress_end();
  fputs("morphoctl: ", stderr);
  print_plain_list(stderr, format, arguments);
  fputc('\n', stderr);
}

int complain(int status, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  complain_list(format, arguments);
  va_end(arguments);
  return status;
}

void leave(int status)
{
  progress_end();
  if (fflush(stdout) != 0 || ferror(stdout))
    status = complain(STATUS_ERROR, "standard output: %s", strerror(errno));
  if (status == STATUS_INTERRUPTED && farewell != NULL)
    print_plain_line(stderr, "%s", farewell);
  exit(status);
}

void fail(int status, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  complain_list(format, arguments);
  va_end(arguments);
  leave(status);
}

static void interrupt(int number)
{
  (void)number;
  interrupt_seen = 1;
}

bool interrupted(void)
{
  return interrupt_seen != 0;
}

void catch_interrupts(const char *words)
{
  struct sigaction action = {.sa_handler = interrupt,
                             .sa_flags = (int)SA_RESETHAND}; /* a second signal ends the program */
  farewell = words;
  sigemptyset(&action.sa_mask);
  sigaction(SIGINT, &action, NULL);
  sigaction(SIGTERM, &action, NULL);
}
