/* download.c: see download.h. */
#include "download.h"

#include <errno.h>
#include <inttypes.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"

void show_bytes(const struct ctl *ctl, const char *what, uint64_t bytes)
{
  if (!ctl->progress || ctl->quiet)
    return;
  fputs("\r\033[K", stderr);
  if (what != NULL)
    fprintf(stderr, "%s  %.1f MB", what, (double)bytes / 1e6);
}

struct saving {
  const struct ctl *ctl;
  const char *path;
  FILE *file;
  uint64_t bytes;
};

static int save_piece(void *context, const char *bytes, size_t n)
{
  struct saving *saving = context;
  if (saving->file == NULL)
    saving->file = strcmp(saving->path, "-") == 0 ? stdout : fopen(saving->path, "we");
  if (saving->file == NULL || fwrite(bytes, 1, n, saving->file) != n)
    fail(STATUS_ERROR, "%s: %s", saving->path, strerror(errno));
  saving->bytes += n;
  show_bytes(saving->ctl, "received", saving->bytes);
  return 0;
}

void download(struct ctl *ctl, const char *path, const char *type, const char *output,
              const char *what)
{
  struct saving saving = {.ctl = ctl, .path = output};
  if (strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    fail(STATUS_USAGE, "%s cannot be written to a terminal: name a file, or use a pipe", what);
  catch_interrupts(NULL);
  transport_download(ctl, path, type, save_piece, &saving);
  show_bytes(ctl, NULL, 0);
  if (saving.file != NULL && saving.file != stdout && fclose(saving.file) != 0)
    fail(STATUS_ERROR, "%s: %s", output, strerror(errno));
  if (!ctl->quiet && saving.file != stdout)
    print_plain_line(stderr, "%s: %" PRIu64 " bytes", output, saving.bytes);
}
