/* crash.h: handles crashes of the process itself.
 *
 * A handler of SIGSEGV, SIGBUS, SIGFPE, SIGILL and SIGABRT writes the job that the faulting thread
 * was computing into a marker file that was opened beforehand, reports the crash on standard error,
 * and lets the signal end the process. The next start counts the crash against that job only. The
 * marker begins with the id of the boot. A marker of this boot without a job means that the earlier
 * process was killed. A normal stop removes the marker. */
#ifndef MORPHO_DAEMON_CRASH_H
#define MORPHO_DAEMON_CRASH_H

#include <stdint.h>

#include <morpho/error.h>

/* Renames the marker of an earlier process to <state_dir>/crash-marker.last (path in *last, malloc;
 * NULL: none), opens a new <state_dir>/crash-marker, and installs the handlers. *killed_us: when
 * the last process began (wall clock), if it was killed, and not by a power cut; else 0.
 * MO_ERR_NO_MEMORY, MO_ERR_IO, MO_ERR_NO_SPACE. */
int crash_open(const char *state_dir, char **last, int64_t *killed_us, struct mo_message *message);
/* Empties the marker, so that the end of the process counts against no job. Async-signal-safe. */
void crash_forgive(void);
/* Restores the default handlers and removes the marker. */
void crash_close(const char *state_dir);

#endif
