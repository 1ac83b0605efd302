/* crash.c: see crash.h. Only async-signal-safe calls in the handler. */
#include "crash.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "jobs/jobs.h"

static const int signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
#define N_SIGNALS (sizeof(signals) / sizeof(signals[0]))

static volatile sig_atomic_t marker = -1;

static void crashed(int number)
{
  /* A second thread that faults meanwhile, or a fault in here, ends the process at once. */
  for (size_t i = 0; i < N_SIGNALS; i++)
    signal(signals[i], SIG_DFL);
  if (marker >= 0)
    mo_jobs_crash_note((int)marker, number);
  static const char text[] = "morphod: crashed\n";
  ssize_t written = write(STDERR_FILENO, text, sizeof(text) - 1);
  (void)written;
  raise(number); /* blocked until this handler returns */
}

static int join(const char *folder, const char *name, char **path)
{
  return asprintf(path, "%s/%s", folder, name) < 0 ? MO_ERR_NO_MEMORY : MO_OK;
}

int crash_open(const char *state_dir, char **last, struct mo_message *message)
{
  char *current = NULL, *old = NULL;
  struct stat status;
  *last = NULL;
  int result = join(state_dir, "crash-marker", &current);
  if (result == MO_OK)
    result = join(state_dir, "crash-marker.last", &old);
  if (result != MO_OK) {
    free(current);
    return result;
  }
  /* Renamed first: a crash before the note has been read must not overwrite it. */
  if (stat(current, &status) == 0 && status.st_size > 0 && rename(current, old) != 0)
    result = mo_fail(message, MO_ERR_IO, "%s: %s", current, strerror(errno));
  int fd = -1;
  if (result == MO_OK) {
    fd = open(current, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
      result = mo_fail(message, errno == ENOSPC ? MO_ERR_NO_SPACE : MO_ERR_IO, "%s: %s", current,
                       strerror(errno));
  }
  if (result == MO_OK) {
    marker = fd;
    struct sigaction action = {.sa_handler = crashed};
    sigemptyset(&action.sa_mask);
    for (size_t i = 0; i < N_SIGNALS; i++)
      sigaction(signals[i], &action, NULL);
    if (stat(old, &status) == 0 && status.st_size > 0) { /* empty: an earlier start has read it */
      *last = old;
      old = NULL;
    }
  }
  free(current);
  free(old);
  return result;
}

void crash_close(const char *state_dir)
{
  char *path;
  for (size_t i = 0; i < N_SIGNALS; i++)
    signal(signals[i], SIG_DFL);
  if (marker >= 0)
    close((int)marker);
  marker = -1;
  if (join(state_dir, "crash-marker", &path) == MO_OK) {
    unlink(path);
    free(path);
  }
}
