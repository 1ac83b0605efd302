/* log_writer.h: writes finished log lines to standard error, so that no other thread waits for a
 * slow reader of the log.
 *
 * Lines go into a ring of bounded size, and one thread writes them. If standard error is not read,
 * that thread blocks and the ring fills up. Lines that do not fit are dropped and counted; once
 * half of the ring is free again, one line reports their number. Standard error keeps its inherited
 * mode, because other processes may share it. */
#ifndef MORPHO_DAEMON_LOG_WRITER_H
#define MORPHO_DAEMON_LOG_WRITER_H

#include <stddef.h>
#include <stdint.h>

#define LOG_LINE_BYTES                                                                             \
  4096 /* longest line; at most PIPE_BUF, so that lines of several processes never mix */

/* Starts the thread; before, lines are written at once. `notice` formats the line about `n` dropped
 * lines. 0, or −1: no thread. */
int log_writer_start(size_t (*notice)(char line[LOG_LINE_BYTES], uint64_t n));
/* Writes one or more whole lines of at most LOG_LINE_BYTES together. Never blocks once the thread
 * runs. */
void log_writer_put(const char *line, size_t n);
/* Waits at most `timeout_ms` until everything is written; later lines are kept and not written. */
void log_writer_stop(int timeout_ms);
/* For signal handlers that end the process: gives the thread a moment for pending lines, then
 * writes `text` if standard error accepts it. */
void log_writer_last_words(const char *text, size_t n);

/* Returns the number of lines since the start that did not reach standard error. */
uint64_t log_dropped(void);

#endif
