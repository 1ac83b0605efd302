/* common.c: helpers for several commands: JSON, facts, files, paged lists. */
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/words.h"
#include "commands.h"

const char *text_of(const json_t *object, const char *key)
{
  const char *text = json_string_value(json_object_get(object, key));
  return text != NULL ? text : "";
}

int64_t number_of(const json_t *object, const char *key)
{
  return json_integer_value(json_object_get(object, key));
}

void add_number(json_t *sum, const json_t *part, const char *key)
{
  json_object_set_new(sum, key, json_integer(number_of(sum, key) + number_of(part, key)));
}

double real_at(const json_t *json, const char *place)
{
  const json_t *value = value_at(json, place);
  return json_is_number(value) ? json_number_value(value) : (double)NAN;
}

json_t *real_or_null(double value)
{
  return isfinite(value) ? json_real(value) : json_null();
}

bool is_final(const char *state)
{
  static const char *const states[] = {"succeeded", "failed", "cancelled", NULL};
  return mo_word_index(states, state) >= 0;
}

const char *job_id(const char *text)
{
  size_t length = strlen(text);
  if (length == 0 || length > 18 || strspn(text, "0123456789") != length || *text == '0')
    fail(STATUS_USAGE, "\"%s\" is not a job id; expected a positive whole number", text);
  return text;
}

void complain_of_warnings(const char *noun, const json_t *job)
{
  size_t i;
  const json_t *warning;
  json_array_foreach(json_object_get(job, "warnings"), i, warning)
      complain(0, "warning: %s %s: %s", noun, text_of(job, "id"), text_of(warning, "detail"));
}

void expect_success(const char *noun, const json_t *job)
{
  complain_of_warnings(noun, job);
  if (strcmp(text_of(job, "state"), "succeeded") == 0)
    return;
  const char *words = keep(text_from(job, "{id} [{state}: {error.detail}|is {state}]"));
  fail(STATUS_NEGATIVE, "%s %s", noun, words);
}

/* ---- output ---- */

void put_json(const json_t *json, size_t flags)
{
  char *text = need(dump_json(json, flags));
  puts(text);
  free(text);
}

void print_json(const json_t *json)
{
  put_json(json, isatty(STDOUT_FILENO) ? JSON_INDENT(2) : JSON_COMPACT);
}

void tell(const struct ctl *ctl, const json_t *json, const char *words)
{
  if (ctl->json)
    print_json(json);
  else if (!ctl->quiet)
    print_from(stdout, json, words);
}

void show(struct ctl *ctl, const char *path,
          void (*print)(const struct ctl *ctl, const json_t *json))
{
  const json_t *json = get_json(ctl, "%s", path);
  if (ctl->json)
    print_json(json);
  else
    print(ctl, json);
}

void print_items(const struct ctl *ctl, const json_t *page, const char *columns)
{
  if (ctl->json)
    print_json(page);
  else
    print_table(stdout, ctl, json_object_get(page, "items"), columns);
}

static void print_name(const struct ctl *ctl, const char *name)
{
  printf("%s%s%s%*s ", ctl->color ? "\033[1m" : "", name, ctl->color ? "\033[0m" : "",
         (int)(14 - strlen(name)), "");
}

void print_fact(const struct ctl *ctl, const char *name, const char *format, ...)
{
  va_list arguments;
  print_name(ctl, name);
  va_start(arguments, format);
  print_plain_list(stdout, format, arguments);
  va_end(arguments);
  putchar('\n');
}

void print_facts(const struct ctl *ctl, const json_t *json, const struct fact *facts)
{
  for (const struct fact *fact = facts; fact->name != NULL; fact++) {
    char *words = text_from(json, fact->words);
    const char *color = NULL;
    if (*words == 0) {
      free(words);
      continue;
    }
    if (ctl->color && strcmp(fact->name, "state") == 0)
      color = strcmp(words, "succeeded") == 0 ? "\033[32m"
              : strcmp(words, "failed") == 0  ? "\033[31m"
                                              : NULL;
    print_name(ctl, fact->name);
    printf("%s%s%s\n", color != NULL ? color : "", words, color != NULL ? "\033[0m" : "");
    free(words);
  }
}

void save_output(const char *path, const void *head, size_t head_bytes, const void *bytes, size_t n)
{
  bool standard = strcmp(path, "-") == 0;
  FILE *file = standard ? stdout : fopen(path, "we");
  bool ok = file != NULL && fwrite(head, 1, head_bytes, file) == head_bytes &&
            (n == 0 || fwrite(bytes, 1, n, file) == n) && fflush(file) == 0;
  if (ok && !standard)
    ok = fclose(file) == 0;
  if (!ok)
    fail(STATUS_ERROR, "%s: %s", path, strerror(errno));
}

void act(struct ctl *ctl, struct request request, const char *words)
{
  struct reply reply;
  transport_send(ctl, &request, &reply);
  if (!ctl->quiet && !ctl->json)
    print_plain_line(stdout, "%s", words);
  reply_free(&reply);
}

/* Ends the program if the suffix of a file names another format than the one that is accepted, such
 * as .parquet for CSV: programs that open the file would trust it. */
static void check_suffix(const char *accept, const char *output)
{
  static const char *const formats[][3] = {{"text/csv", "CSV", ".csv"},
                                           {"image/svg+xml", "SVG", ".svg"}};
  const char *folder = strrchr(output, '/'), *name = folder != NULL ? folder + 1 : output,
             *suffix = strrchr(name, '.');
  for (size_t i = 0; suffix != NULL && i < sizeof(formats) / sizeof(formats[0]); i++)
    if (strcmp(accept, formats[i][0]) == 0 && strcmp(suffix, formats[i][2]) != 0)
      fail(STATUS_USAGE, "this is a file of %s; name it %s, not \"%s\"", formats[i][1],
           formats[i][2], name);
}

void save_reply(struct ctl *ctl, const char *path, const char *accept, const char *output)
{
  struct reply reply;
  check_suffix(accept, output);
  transport_get(ctl, path, accept, &reply);
  save_output(output, "", 0, reply.body, reply.body_bytes);
  if (!ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %zu bytes", output, reply.body_bytes);
  reply_free(&reply);
}

/* ---- lists ---- */

void walk_items(struct ctl *ctl, const char *path, int64_t after, size_t limit,
                void (*take)(void *context, json_t *item), void *context)
{
  const char *cursor = after >= 0 ? path_to("%" PRId64, after) : NULL;
  size_t n = 0;
  do {
    const size_t left = limit == 0 ? 1000 : limit - n;
    char *page_path = format_text("%s%climit=%zu%s%s", path, strchr(path, '?') != NULL ? '&' : '?',
                                  left < 1000 ? left : 1000, cursor != NULL ? "&cursor=" : "",
                                  cursor != NULL ? cursor : "");
    json_t *item,
        *page = send_json(ctl, &(struct request){.method = "GET", .path = page_path}, NULL);
    size_t i;
    json_array_foreach(json_object_get(page, "items"), i, item)
    {
      take(context, item);
      n++;
    }
    const char *next = json_string_value(json_object_get(page, "next_cursor"));
    if (next != NULL && cursor != NULL && strcmp(escape(next), cursor) == 0)
      fail(STATUS_ERROR, "%s: the list does not end: next_cursor repeats %s", ctl->server, next);
    cursor = next != NULL ? escape(next) : NULL;
    json_decref(page);
    free(page_path);
  } while (cursor != NULL && (limit == 0 || n < limit));
}

static void append(void *items, json_t *item)
{
  json_array_append(items, item);
}

json_t *collect(struct ctl *ctl, const char *path, size_t limit)
{
  json_t *items = keep(json_array());
  walk_items(ctl, path, -1, limit, append, items);
  return items;
}

const char *path_with(const struct ctl *ctl, const char *path, const char *const *options)
{
  for (; *options != NULL; options++) {
    const char *value = option_text(ctl, *options, NULL);
    if (value == NULL)
      continue;
    char *longer = keep(format_text("%s%c%s=%s", path, strchr(path, '?') != NULL ? '&' : '?',
                                    *options, escape(value)));
    for (char *c = longer + strlen(path); *c != '=' && *c != 0; c++)
      *c = *c == '-' ? '_' : *c; /* --submitted-by */
    path = longer;
  }
  return path;
}
