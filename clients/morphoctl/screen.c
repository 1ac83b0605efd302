/* screen.c: see screen.h. */
#include "screen.h"

#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

#define REDRAW_S 0.1

struct screen screen_open(const struct ctl *ctl)
{
  const char *terminal = getenv("TERM");
  return (struct screen){.live = isatty(STDOUT_FILENO) && terminal != NULL &&
                                 strcmp(terminal, "dumb") != 0 && !ctl->quiet};
}

void screen_line(FILE *file, int columns, const char *before, const char *words, const char *after)
{
  char *text = plain_text(words);
  size_t n = 0;
  int width = 0;
  while (text != NULL && text[n] != 0) {
    width += ((unsigned char)text[n] & 0xc0) != 0x80;
    if (width > columns)
      break;
    n++;
  }
  fprintf(file, "%s%.*s%s\033[K\n", before, (int)n, text != NULL ? text : "", after);
  free(text);
}

void screen_lines(FILE *file, const char *text)
{
  while (*text != 0) {
    size_t n = strcspn(text, "\n");
    fprintf(file, "%.*s\033[K\n", (int)n, text);
    text += n + (text[n] == '\n');
  }
}

void screen_draw(struct screen *screen, bool now,
                 void (*write)(void *context, FILE *file, int columns, int rows), void *context)
{
  struct winsize window = {0};
  if (!screen->live || (!now && monotonic_s() - screen->drawn_s < REDRAW_S))
    return;
  bool known =
      ioctl(STDOUT_FILENO, TIOCGWINSZ, &window) == 0 && window.ws_col > 0 && window.ws_row > 0;
  int columns = known ? window.ws_col : 80, rows = known ? window.ws_row : 24;
  char *text = NULL;
  size_t size = 0;
  FILE *file = open_memstream(&text, &size);
  if (file == NULL)
    return;
  write(context, file, columns, rows);
  if (fclose(file) == 0) {
    if (screen->lines > 0 && screen->columns == columns)
      printf("\033[%dA\r", screen->lines);
    else if (screen->lines > 0)
      fputs("\033[H\033[2J", stdout); /* the width changed, and with it the place of lines */
    fputs(text, stdout);
    fputs("\033[J", stdout);
    fflush(stdout);
    screen->lines = 0;
    for (size_t i = 0; i < size; i++)
      screen->lines += text[i] == '\n';
    screen->columns = columns;
    screen->drawn_s = monotonic_s();
  }
  free(text);
}

void screen_event(const struct screen *screen, const struct ctl *ctl, const json_t *at,
                  const char *words)
{
  char text[32];
  time_t now = time(NULL);
  struct tm local;
  if (screen->live || ctl->quiet)
    return;
  if (at == NULL && localtime_r(&now, &local) != NULL &&
      strftime(text, sizeof(text), "%Y-%m-%d %H:%M:%S", &local) > 0)
    print_plain_line(stdout, "%s  %s", text, words);
  else
    print_plain_line(stdout, "%s  %s", time_text(at, text), words);
  fflush(stdout);
}

void screen_earlier(const struct screen *screen, const struct ctl *ctl, const char *words)
{
  if (screen->live || ctl->quiet)
    return;
  print_plain_line(stdout, "%*s  %s", (int)strlen("2026-01-01 00:00:00"), "", words);
  fflush(stdout);
}

int newest_event(struct ctl *ctl, int64_t *newest)
{
  json_t *page;
  int status =
      transport_get_json(ctl, "/v1/events?format=json&limit=1&after=999999999999999999", 0, &page);
  if (status == STATUS_OK)
    *newest = strtoll(text_of(page, "newest"), NULL, 10);
  json_decref(page);
  return status;
}
