/* memory.h: how much memory the service may use by default, and allocations that end the process on
 * failure. */
#ifndef MORPHO_DAEMON_MEMORY_H
#define MORPHO_DAEMON_MEMORY_H

#include <stdint.h>

/* Returns the least of the machine's memory, the limits of the cgroup (both versions), and
 * RLIMIT_AS minus 1 GiB for address space that is only reserved. From this it subtracts the larger
 * of an eighth and 64 MiB, but at most half. The result is positive. */
uint64_t memory_limit(void);
/* Returns the setting max_memory, or memory_limit() for its default 0. */
static inline uint64_t memory_limit_of(uint64_t max_memory)
{
  return max_memory > 0 ? max_memory : memory_limit();
}

/* Returns `memory`. If it is NULL, ends the process as if it had been killed: the next start
 * recovers. */
void *enough(void *memory);
/* Formats a text as asprintf does (malloc). */
char *format_text(const char *format, ...) __attribute__((format(printf, 1, 2)));

#endif
