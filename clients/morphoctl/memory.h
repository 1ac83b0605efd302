/* memory.h: memory, and the end of the program. An error ends it where it is found: it has nothing
 * to lose, and the system takes its memory back. */
#ifndef MORPHOCTL_MEMORY_H
#define MORPHOCTL_MEMORY_H

#include <stdbool.h>
#include <stdio.h>

void *need(void *memory); /* returns what was allocated, or opened in memory; else ends */
/* The same, for what stays until the end. Keeps it reachable, so that it is no leak. */
void *keep(void *memory);
char *format_text(const char *format, ...)
    __attribute__((format(printf, 1, 2))); /* as asprintf: malloc */
void close_text(FILE *file);               /* of open_memstream */

/* Prints "morphoctl: …" on standard error, as plain text; returns `status`. */
int complain(int status, const char *format, ...) __attribute__((format(printf, 2, 3)));
/* Ends the program with a status, once standard output is written. */
_Noreturn void leave(int status);
/* Complains, and ends the program. */
_Noreturn void fail(int status, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* True after SIGINT or SIGTERM, once catch_interrupts was called. Commands call it before they wait
 * for something that goes on without them. words: what is told then at the end; nullable, kept. */
bool interrupted(void);
void catch_interrupts(const char *words);

#endif
