/* table.c: see table.h. */
#include "table.h"

#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#include "base/text.h"
#include "template.h"

#define COLUMNS_MAX 16

struct column {
  const char *head, *words; /* words: its template, up to a | */
  int head_bytes;
  bool right;
  size_t width;
};

static size_t read_columns(const char *text, struct column columns[COLUMNS_MAX])
{
  size_t n = 0, depth = 0;
  while (n < COLUMNS_MAX) {
    struct column *column = &columns[n++];
    column->right = *text == '>';
    column->head = text + column->right;
    column->head_bytes = (int)strcspn(column->head, "=");
    column->words = column->head + column->head_bytes + 1;
    for (text = column->words; *text != 0 && (depth > 0 || *text != '|'); text++)
      depth = depth + (*text == '[') - (*text == ']');
    if (*text++ == 0)
      break;
  }
  return n;
}

/* Returns the cells of an item, or without one the heads, each with a NUL (malloc). */
static char *make_row(const json_t *item, struct column *columns, size_t n)
{
  char *row = NULL;
  size_t size = 0;
  FILE *file = need(open_memstream(&row, &size));
  for (size_t c = 0; c < n; c++) {
    if (item != NULL)
      fill_template(file, item, columns[c].words);
    else
      fprintf(file, "%.*s", columns[c].head_bytes, columns[c].head);
    fputc(0, file);
  }
  close_text(file);
  const char *cell = row;
  for (size_t c = 0; c < n; c++, cell += strlen(cell) + 1)
    if (text_width(cell) > columns[c].width)
      columns[c].width = text_width(cell);
  return row;
}

size_t text_width(const char *text)
{
  return mo_utf8_length(text, strlen(text));
}

static void print_row(FILE *file, const char *row, const struct column *columns, size_t n)
{
  size_t owed = 0; /* spaces before the next cell; lines must not end in spaces */
  for (size_t c = 0; c < n; c++, row += strlen(row) + 1) {
    const size_t width = text_width(row), gap = columns[c].width - width;
    owed += columns[c].right ? gap : 0;
    if (width > 0) {
      fprintf(file, "%*s%s", (int)owed, "", row);
      owed = 0;
    }
    owed += 2 + (columns[c].right ? 0 : gap);
  }
}

void print_table(FILE *file, const struct ctl *ctl, const json_t *items, const char *columns)
{
  struct column parts[COLUMNS_MAX] = {{.width = 0}};
  const size_t n = read_columns(columns, parts), n_rows = json_array_size(items) + 1;
  char **rows = need(calloc(n_rows, sizeof(*rows)));
  for (size_t r = 0; r < n_rows; r++)
    rows[r] = make_row(r > 0 ? json_array_get(items, r - 1) : NULL, parts, n);
  for (size_t r = 0; r < n_rows; r++) {
    const bool bold = r == 0 && ctl->color;
    fputs(bold ? "\033[1m" : "", file);
    print_row(file, rows[r], parts, n);
    fputs(bold ? "\033[0m\n" : "\n", file);
    free(rows[r]);
  }
  free(rows);
}

/* ---- progress ---- */

double monotonic_s(void)
{
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

static bool is_shown;

void progress_show(const struct ctl *ctl, const char *state, int64_t done, int64_t total)
{
  static double begin_s;
  static int64_t first_done;
  if (!ctl->progress || ctl->quiet)
    return;
  double now = monotonic_s();
  if (!is_shown) {
    begin_s = now;
    first_done = done;
  }
  is_shown = true;
  struct winsize window = {0};
  int columns =
      ioctl(STDERR_FILENO, TIOCGWINSZ, &window) == 0 && window.ws_col > 0 ? window.ws_col : 80;
  char a[32], b[32], tail[96] = "";
  double share = total > 0 ? (double)done / (double)total : 0;
  double elapsed = now - begin_s;
  double rate = elapsed > 0.5 ? (double)(done - first_done) / elapsed : 0;
  if (rate > 0) {
    double left = (double)(total - done) / rate;
    if (left < 360000)
      snprintf(tail, sizeof(tail), "  %.3g/s  %d:%02d:%02d left", rate, (int)left / 3600,
               (int)left / 60 % 60, (int)left % 60);
  }
  char text[256];
  int n = snprintf(text, sizeof(text), "%s  %s of %s rollouts  %3d %%%s", state,
                   count_text(done, a), count_text(total, b), (int)(share * 100), tail);
  int bar = columns - n - 5;
  fputs("\r\033[K", stderr);
  print_plain(stderr, "%s", text);
  if (bar >= 10) {
    if (bar > 40)
      bar = 40;
    fputs("  [", stderr);
    for (int i = 0; i < bar; i++)
      fputc((double)i < share * bar ? '#' : ' ', stderr);
    fputc(']', stderr);
  }
  fflush(stderr);
}

void progress_end(void)
{
  if (is_shown)
    fputs("\r\033[K", stderr);
  is_shown = false;
}
