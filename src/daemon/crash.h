/* crash.h: what happens when the process itself faults.
 *
 * A handler of SIGSEGV, SIGBUS, SIGFPE, SIGILL and SIGABRT notes which job the faulting thread was
 * computing in a marker file that was opened beforehand, says so on standard error, and lets the
 * signal end the process. The next start counts the crash against that job alone. A kill, a power
 * cut or a plain stop leaves the marker empty. */
#ifndef MORPHO_DAEMON_CRASH_H
#define MORPHO_DAEMON_CRASH_H

#include <morpho/error.h>

/* Keeps the marker of an earlier life as <state_dir>/crash-marker.last (path in *last, malloc;
 * NULL: there is none), opens a new <state_dir>/crash-marker, and installs the handlers.
 * MO_ERR_NO_MEMORY, MO_ERR_IO. */
int crash_open(const char *state_dir, char **last, struct mo_message *message);
/* Orderly end: default handlers, marker removed. */
void crash_close(const char *state_dir);

#endif
