/* crash.c: writes which job a dying process was working on. */
#include <unistd.h>

#include "base/thread.h"
#include "jobs/state.h"

static size_t put_number(char *to, int64_t value)
{
  char digits[24];
  size_t n = 0, length = 0;
  do {
    digits[n++] = (char)('0' + value % 10);
    value /= 10;
  } while (value > 0);
  while (n > 0)
    to[length++] = digits[--n];
  return length;
}

void mo_jobs_crash_note(int fd, int signal_number)
{
  int64_t block_tag = mo_compute_current_tag();
  int64_t tag = block_tag > 0 ? block_tag : mo_thread_tag;
  char line[64];
  size_t n;
  if (tag <= 0 || signal_number < 0)
    return;
  n = put_number(line, tag);
  line[n++] = ' ';
  n += put_number(line + n, signal_number);
  line[n++] = '\n';
  if (write(fd, line, n) < 0)
    return; /* nothing more can be done here */
}
