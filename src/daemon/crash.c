/* crash.c: see crash.h. The handler makes only async-signal-safe calls. */
#include "crash.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/memory.h"
#include "jobs/jobs.h"

static const int signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
#define N_SIGNALS (sizeof(signals) / sizeof(signals[0]))

static volatile sig_atomic_t marker = -1;

void crash_forgive(void)
{
  if (marker >= 0 && ftruncate((int)marker, 0) == 0)
    (void)lseek((int)marker, 0, SEEK_SET);
}

static void crashed(int number)
{
  /* If a second thread faults at the same time, or this handler faults, the process ends at
   * once. */
  for (size_t i = 0; i < N_SIGNALS; i++)
    signal(signals[i], SIG_DFL);
  crash_forgive();
  if (marker >= 0)
    mo_jobs_crash_note((int)marker, number);
  static const char text[] = "morphod: crashed\n";
  log_last_words(text, sizeof(text) - 1);
  raise(number); /* blocked until this handler returns */
}

#define BOOT_BYTES 64

/* Writes "boot <id>\n"; without an id, "boot unknown\n", which never counts as the same boot. */
static size_t read_boot(char line[BOOT_BYTES])
{
  char id[BOOT_BYTES / 2 + 8] = "";
  FILE *file = fopen("/proc/sys/kernel/random/boot_id", "re");
  const bool found = file != NULL && fscanf(file, "%39[0-9a-f-]", id) == 1;
  if (file != NULL)
    fclose(file);
  return (size_t)snprintf(line, BOOT_BYTES, "boot %s\n", found ? id : "unknown");
}

/* Reads the marker of the last process. *noted: the marker names the crashed job. *killed_us: the
 * start of the last process, if it was killed in this boot; else 0. */
static void look(const char *path, const char *boot, size_t size, bool *noted, int64_t *killed_us)
{
  struct stat status;
  char text[BOOT_BYTES + 1] = "";
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  const ssize_t n = fd >= 0 ? read(fd, text, BOOT_BYTES) : -1;
  const bool has_boot = n > 0 && strncmp(text, "boot ", 5) == 0;
  const char *end = has_boot ? strchr(text, '\n') : NULL;
  if (fd >= 0)
    close(fd);
  *noted = n > 0 && (!has_boot || (end != NULL && end[1] != '\0'));
  *killed_us = 0;
  if (!*noted && n >= (ssize_t)size && memcmp(text, boot, size) == 0 &&
      strstr(boot, "unknown") == NULL && stat(path, &status) == 0)
    *killed_us = (int64_t)status.st_mtim.tv_sec * 1000000 + status.st_mtim.tv_nsec / 1000;
}

int crash_open(const char *state_dir, char **last, int64_t *killed_us, struct mo_message *message)
{
  char *current = format_text("%s/crash-marker", state_dir), *old = format_text("%s.last", current);
  struct stat status;
  char boot[BOOT_BYTES];
  const size_t boot_size = read_boot(boot);
  bool noted = false;
  int result = MO_OK, fd = -1;
  *last = NULL;
  /* Rename first: a crash before the note is read must not overwrite the note. */
  look(current, boot, boot_size, &noted, killed_us);
  if (noted && rename(current, old) != 0)
    result = mo_fail(message, MO_ERR_IO, "%s: %s", current, strerror(errno));
  if (result == MO_OK) {
    /* Overwrite the old content, because a full disk has no room for another block. */
    fd = open(current, O_WRONLY | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
    if (fd < 0 || pwrite(fd, boot, boot_size, 0) != (ssize_t)boot_size ||
        ftruncate(fd, (off_t)boot_size) != 0)
      result = mo_fail(message, errno == ENOSPC ? MO_ERR_NO_SPACE : MO_ERR_IO, "%s: %s", current,
                       strerror(errno));
  }
  if (result != MO_OK && fd >= 0)
    close(fd);
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
  char *path = format_text("%s/crash-marker", state_dir);
  for (size_t i = 0; i < N_SIGNALS; i++)
    signal(signals[i], SIG_DFL);
  if (marker >= 0)
    close((int)marker);
  marker = -1;
  unlink(path);
  free(path);
}
