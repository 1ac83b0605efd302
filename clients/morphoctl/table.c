/* table.c: see table.h. */
#include "table.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#include "base/text.h"

#define DASH        "–"
#define WORD_BYTES  64
#define COLUMNS_MAX 40

const json_t *value_at(const json_t *json, const char *place)
{
  char key[WORD_BYTES];
  while (*place != 0) {
    const size_t n = strcspn(place, ".");
    snprintf(key, sizeof(key), "%.*s", (int)n, place);
    json = json_is_array(json) ? json_array_get(json, strtoul(key, NULL, 10))
                               : json_object_get(json, key);
    place += n + (place[n] == '.');
  }
  return json;
}

/* ---- formats ---- */

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

static void put_time(FILE *file, const char *value)
{
  char text[32];
  struct tm utc = {0}, local;
  const char *rest = strptime(value, "%Y-%m-%dT%H:%M:%S", &utc);
  const time_t seconds = rest != NULL ? timegm(&utc) : 0;
  if (rest == NULL || localtime_r(&seconds, &local) == NULL ||
      strftime(text, sizeof(text), "%Y-%m-%d %H:%M:%S %Z", &local) == 0)
    snprintf(text, sizeof(text), "%s", value);
  print_plain(file, "%s", text);
}

static void put_duration(FILE *file, double seconds)
{
  if (!(seconds >= 0) || seconds > 1e9) {
    fputs(DASH, file);
    return;
  }
  const long whole = lround(seconds);
  if (whole >= 2 * 86400)
    fprintf(file, "%ld d %02ld:%02ld", whole / 86400, whole / 3600 % 24, whole / 60 % 60);
  else
    fprintf(file, "%ld:%02ld:%02ld", whole / 3600, whole / 60 % 60, whole % 60);
}

/* Writes a number in the format .4f, .4g, g, .1%, duration, GiB or MB. */
static void put_number(FILE *file, double number, const char *form)
{
  char *end = NULL;
  const int precision = *form == '.' ? (int)strtol(form + 1, &end, 10) : 6;
  const char kind = end != NULL ? *end : *form;
  if (strcmp(form, "duration") == 0)
    put_duration(file, number);
  else if (strcmp(form, "GiB") == 0)
    fprintf(file, "%.1f", number / (1 << 30));
  else if (strcmp(form, "MB") == 0)
    fprintf(file, "%.1f", number * 1e-6);
  else if (kind == '%')
    fprintf(file, "%.*f %%", precision, 100 * number);
  else
    fprintf(file, kind == 'f' ? "%.*f" : "%.*g", precision, number);
}

static void put_value(FILE *file, const json_t *value, const char *form)
{
  char digits[32];
  if (*form == '#')
    fputs(count_text((int64_t)json_array_size(value), digits), file);
  else if (*form == 's')
    fputs((json_is_array(value) ? (json_int_t)json_array_size(value) : json_integer_value(value)) ==
                  1
              ? ""
              : "s",
          file);
  else if (*form == ',')
    fputs(count_text(json_integer_value(value), digits), file);
  else if (json_is_string(value) && strcmp(form, "time") == 0)
    put_time(file, json_string_value(value));
  else if (json_is_string(value))
    print_plain(file, "%.*s", *form == '.' ? (int)strtol(form + 1, NULL, 10) : -1,
                json_string_value(value));
  else if (json_is_integer(value) && *form == 0)
    fprintf(file, "%" PRId64, (int64_t)json_integer_value(value));
  else if (json_is_number(value))
    put_number(file, json_number_value(value), form);
  else if (*form != 0 && strspn(form + 1, "0123456789") + 1 != strlen(form))
    fputs(DASH, file);
}

/* ---- templates ---- */

/* Writes the fraction of two counts, "part/whole". */
static bool put_share(FILE *file, const json_t *json, char *places)
{
  char *slash = strchr(places, '/');
  *slash = 0;
  const json_int_t part = json_integer_value(value_at(json, places)),
                   whole = json_integer_value(value_at(json, slash + 1));
  fprintf(file, "%d %%", whole > 0 ? (int)(100 * part / whole) : 0);
  return whole > 0;
}

static bool is_there(const json_t *value, const char *form)
{
  return *form == '#'
             ? json_is_array(value)
             : json_is_number(value) || json_is_boolean(value) || json_string_length(value) > 0;
}

/* Returns whether a value is this text, boolean or number. */
static bool is_word(const json_t *value, const char *word)
{
  if (json_is_number(value))
    return json_number_value(value) == strtod(word, NULL);
  const char *text =
      json_is_boolean(value) ? (json_is_true(value) ? "true" : "false") : json_string_value(value);
  return text != NULL && strcmp(text, word) == 0;
}

/* Writes the value that the text after a brace refers to; returns what follows it. */
static const char *put_place(FILE *file, const json_t *json, const char *at, bool *all_there)
{
  char text[WORD_BYTES], *place = text;
  const size_t n = strcspn(at, "}");
  snprintf(text, sizeof(text), "%.*s", (int)n, at);
  char *form = strchr(text, ':');
  if (form != NULL)
    *form++ = 0;
  else
    form = text + strlen(text);
  at += n + 1;
  const bool is_absence = *place == '!';
  place += is_absence;
  char *condition = strpbrk(place, ">!=/");
  const char kind = condition != NULL ? *condition : 0;
  if (kind == '/') {
    *all_there &= put_share(file, json, place);
    return at;
  }
  if (condition != NULL)
    *condition = 0;
  const json_t *value = value_at(json, place);
  bool there = is_there(value, form) != is_absence;
  if (kind == '>')
    there = json_number_value(value) > strtod(condition + 1, NULL);
  else if (kind == '!')
    there = there && !is_word(value, condition + 2);
  else if (kind == '=')
    there = is_word(value, condition + 1);
  *all_there &= there;
  if (kind != '=' && !is_absence && *form != '-')
    put_value(file, value, form);
  return at;
}

static const char *put_choice(FILE *file, const json_t *json, const char *at);

static const char *put_part(FILE *file, const json_t *json, const char *at, bool *all_there)
{
  while (*at != 0 && *at != '|' && *at != ']') {
    if (*at == '{')
      at = put_place(file, json, at + 1, all_there);
    else if (*at == '[')
      at = put_choice(file, json, at + 1);
    else
      fputc(*at++, file);
  }
  return at;
}

/* Writes the first alternative whose values all exist; returns what follows the brackets. */
static const char *put_choice(FILE *file, const json_t *json, const char *at)
{
  for (bool chosen = false; *at != 0; at++) {
    char *text = NULL;
    size_t size = 0;
    bool all_there = true;
    FILE *part = need(open_memstream(&text, &size));
    at = put_part(part, json, at, &all_there);
    close_text(part);
    if (all_there && !chosen) {
      fputs(text, file);
      chosen = true;
    }
    free(text);
    if (*at != '|')
      return at + (*at == ']');
  }
  return at;
}

const char *fill_template(FILE *file, const json_t *json, const char *template)
{
  bool all_there = true;
  return put_part(file, json, template, &all_there);
}

char *text_from(const json_t *json, const char *template)
{
  char *text = NULL;
  size_t size = 0;
  FILE *file = need(open_memstream(&text, &size));
  fill_template(file, json, template);
  close_text(file);
  return text;
}

void print_from(FILE *file, const json_t *json, const char *template)
{
  fill_template(file, json, template);
  fputc('\n', file);
}

/* ---- tables ---- */

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

/* Returns the cells of an item, or the headings if there is no item, each with a NUL (malloc). */
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

void progress_show(const struct ctl *ctl, const char *state, int64_t done, int64_t total,
                   const char *what)
{
  static double begin_s;
  static int64_t first_done;
  static const char *shown; /* what was counted at that time */
  if (!ctl->progress || ctl->quiet)
    return;
  double now = monotonic_s();
  if (!progress_begin() || shown == NULL || strcmp(shown, what) != 0) {
    begin_s = now;
    first_done = done;
    shown = what;
  }
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
  int n = snprintf(text, sizeof(text), "%s  %s of %s %s  %3d %%%s", state, count_text(done, a),
                   count_text(total, b), what, (int)(share * 100), tail);
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
