/* download.h: replies of any size, written to a file as they arrive. */
#ifndef MORPHOCTL_DOWNLOAD_H
#define MORPHOCTL_DOWNLOAD_H

#include <stdint.h>

#include "ctl.h"

/* Shows on a terminal how many bytes have passed. what NULL: erases that. */
void show_bytes(const struct ctl *ctl, const char *what, uint64_t bytes);

/* Writes the reply of a GET to a file, which is opened when the first bytes arrive, and reports its
 * size. output "-": standard output, unless it is a terminal. what: "scores are". */
void download(struct ctl *ctl, const char *path, const char *type, const char *output,
              const char *what);

#endif
