/* memory.h: how much memory the service may use if no setting says so; and the end of the process
 * that has none left for its configuration. */
#ifndef MORPHO_DAEMON_MEMORY_H
#define MORPHO_DAEMON_MEMORY_H

#include <stdint.h>

/* Returns the least of the machine's memory, the limits of the cgroup (both versions), and
 * RLIMIT_AS without 1 GiB that is only reserved; minus the larger of an eighth and 64 MiB, but at
 * most minus half. > 0. */
uint64_t memory_limit(void);
/* Returns the setting max_memory, or memory_limit() for its default 0. */
static inline uint64_t memory_limit_of(uint64_t max_memory)
{
  return max_memory > 0 ? max_memory : memory_limit();
}

/* Returns what was allocated. Without it the process ends, as if it had been killed: the next start
 * recovers. */
void *enough(void *memory);
/* Formats a text as asprintf does (malloc). */
char *format_text(const char *format, ...) __attribute__((format(printf, 1, 2)));

#endif
