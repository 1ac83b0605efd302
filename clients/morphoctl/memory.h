/* memory.h: memory, without which the program ends with STATUS_ERROR. */
#ifndef MORPHOCTL_MEMORY_H
#define MORPHOCTL_MEMORY_H

#include <stdio.h>

void *need(void *memory); /* returns what was allocated, or opened in memory */
char *format_text(const char *format, ...)
    __attribute__((format(printf, 1, 2))); /* as asprintf: malloc */
void close_text(FILE *file);               /* of open_memstream */

#endif
