/* table.c: see table.h. */
#include "table.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

void table_open(struct table *table, const char *heads)
{
  *table = (struct table){0};
  for (const char *c = heads; table->n_columns < COLUMNS_MAX; c++) {
    size_t column = table->n_columns++;
    table->right[column] = *c == '>';
    table->heads[column] = c + table->right[column];
    c = strchr(c, '|');
    if (c == NULL)
      break;
  }
}

static size_t head_length(const char *head)
{
  return strcspn(head, "|");
}

void table_add(struct table *table, const char *const *cells)
{
  if (table->n_rows == table->capacity) {
    size_t capacity = table->capacity + table->capacity / 2 + 64;
    char **grown = realloc(table->cells, capacity * table->n_columns * sizeof(*grown));
    if (grown == NULL) {
      table->failed = true;
      return;
    }
    table->cells = grown;
    table->capacity = capacity;
  }
  char **row = table->cells + table->n_rows * table->n_columns;
  for (size_t i = 0; i < table->n_columns; i++) {
    row[i] = plain_text(cells[i] != NULL ? cells[i] : "–");
    table->failed |= row[i] == NULL;
  }
  table->n_rows++;
}

void table_drop(struct table *table, size_t column)
{
  size_t n = table->n_columns;
  for (size_t r = 0; r < table->n_rows; r++) {
    free(table->cells[r * n + column]);
    for (size_t c = 0, kept = 0; c < n; c++)
      if (c != column)
        table->cells[r * (n - 1) + kept++] = table->cells[r * n + c];
  }
  for (size_t c = column; c + 1 < n; c++) {
    table->heads[c] = table->heads[c + 1];
    table->right[c] = table->right[c + 1];
  }
  table->n_columns--;
  table->capacity = table->n_rows; /* in rows of the new width; may be less than is allocated */
}

size_t text_width(const char *text)
{
  size_t width = 0;
  for (; *text != 0; text++)
    width += ((unsigned char)*text & 0xc0) != 0x80;
  return width;
}

static void pad(FILE *file, size_t n)
{
  for (; n > 0; n--)
    fputc(' ', file);
}

void table_print(struct table *table, FILE *file, const struct ctl *ctl)
{
  size_t widths[COLUMNS_MAX];
  for (size_t c = 0; c < table->n_columns; c++) {
    widths[c] = head_length(table->heads[c]);
    for (size_t r = 0; r < table->n_rows; r++) {
      const char *cell = table->cells[r * table->n_columns + c];
      size_t width = cell != NULL ? text_width(cell) : 0;
      if (width > widths[c])
        widths[c] = width;
    }
  }
  if (ctl->color)
    fputs("\033[1m", file);
  for (size_t c = 0; c < table->n_columns; c++) {
    size_t length = head_length(table->heads[c]);
    if (table->right[c])
      pad(file, widths[c] - length);
    fprintf(file, "%.*s", (int)length, table->heads[c]);
    if (c + 1 < table->n_columns)
      pad(file, 2 + (table->right[c] ? 0 : widths[c] - length));
  }
  fprintf(file, "%s\n", ctl->color ? "\033[0m" : "");
  for (size_t r = 0; r < table->n_rows; r++) {
    size_t owed = 0; /* spaces before the next cell; lines must not end in spaces */
    for (size_t c = 0; c < table->n_columns; c++) {
      char *cell = table->cells[r * table->n_columns + c];
      size_t width = cell != NULL ? text_width(cell) : 0;
      if (table->right[c])
        owed += widths[c] - width;
      if (width > 0) {
        pad(file, owed);
        fputs(cell, file);
        owed = 0;
      }
      owed += 2 + (table->right[c] ? 0 : widths[c] - width);
      free(cell);
    }
    fputc('\n', file);
  }
  if (table->failed)
    complain(0, "out of memory: the table is not complete");
  free(table->cells);
  *table = (struct table){0};
}

const char *score_text(const json_t *score, char text[32])
{
  if (!json_is_number(score))
    return "–";
  snprintf(text, 32, "%.4f", json_number_value(score));
  return text;
}

const char *time_text(const json_t *time, char text[32])
{
  const char *value = json_string_value(time);
  struct tm utc = {0}, local;
  if (value == NULL)
    return "–";
  const char *rest = strptime(value, "%Y-%m-%dT%H:%M:%S", &utc);
  time_t seconds = rest != NULL ? timegm(&utc) : 0;
  if (rest == NULL || localtime_r(&seconds, &local) == NULL ||
      strftime(text, 32, "%Y-%m-%d %H:%M:%S", &local) == 0)
    snprintf(text, 32, "%s", value);
  return text;
}

const char *count_text(int64_t n, char text[32])
{
  char digits[24];
  int length = snprintf(digits, sizeof(digits), "%" PRId64, n < 0 ? -n : n);
  char *out = text;
  if (n < 0)
    *out++ = '-';
  for (int i = 0; i < length; i++) {
    if (i > 0 && (length - i) % 3 == 0)
      *out++ = ',';
    *out++ = digits[i];
  }
  *out = 0;
  return text;
}

/* ---- progress ---- */

double monotonic_s(void)
{
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

void progress_show(struct progress *progress, const struct ctl *ctl, const char *state,
                   int64_t done, int64_t total)
{
  if (!ctl->progress || ctl->quiet)
    return;
  double now = monotonic_s();
  if (!progress->shown) {
    progress->begin_s = now;
    progress->first_done = done;
  }
  progress->shown = true;
  struct winsize window = {0};
  int columns =
      ioctl(STDERR_FILENO, TIOCGWINSZ, &window) == 0 && window.ws_col > 0 ? window.ws_col : 80;
  char a[32], b[32], tail[96] = "";
  double share = total > 0 ? (double)done / (double)total : 0;
  double elapsed = now - progress->begin_s;
  double rate = elapsed > 0.5 ? (double)(done - progress->first_done) / elapsed : 0;
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
  progress->last_s = now;
}

void progress_end(struct progress *progress)
{
  if (progress->shown)
    fputs("\r\033[K", stderr);
  progress->shown = false;
}
