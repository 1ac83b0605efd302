/* query.c: see query.h. */
#include "http/query.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "base/words.h"
#include "http/field.h"
#include "http/server.h"

#define WAIT_MAX_S 60
#define BELOW_MAX  16 /* largest number of paths that a fault lists */

/* ---- query parameters ---- */

/* Finds a name in the route's list. Returns NULL if the route does not have this parameter. */
static const char *find_name(const char *list, const char *name)
{
  size_t size = strlen(name);
  if (size == 0 || strchr(name, ' ') != NULL)
    return NULL;
  for (const char *at = list; (at = strstr(at, name)) != NULL; at += size)
    if ((at == list || at[-1] == ' ') && (at[size] == ' ' || at[size] == '\0'))
      return at;
  return NULL;
}

/* Adds the fault of an unknown parameter, with the paths below this one that have it. */
static void add_unknown(struct mo_faults *faults, const struct mo_request *request,
                        const char *name)
{
  const struct mo_routes *routes = &request->http->service.routes;
  const size_t size = strlen(request->route->path);
  const char *below[BELOW_MAX + 1] = {NULL};
  char list[MO_WORDS_BYTES];
  size_t n = 0;
  for (size_t i = 0; i < routes->n && n < BELOW_MAX; i++) {
    const struct mo_route *route = &routes->items[i];
    if (strncmp(route->path, request->route->path, size) == 0 && route->path[size] == '/' &&
        find_name(route->query, name) != NULL)
      below[n++] = route->path + size + 1;
  }
  if (n > 0)
    mo_faults_add(faults, MO_FAULT_PARAMETER, name,
                  "unknown parameter for this path; give it to %s below it",
                  mo_words_join(below, "", list));
  else
    mo_faults_add(faults, MO_FAULT_PARAMETER, name, "unknown parameter for this path");
}

/* Reads one parameter. text: space for the name and the value. Returns the space used. */
static size_t read_item(struct mo_request *request, const struct mo_query_item *item, char *text,
                        struct mo_faults *faults)
{
  struct mo_query *query = &request->query;
  char *value = text + item->name_size + 1;
  size_t room =
      item->value_size + 1 < MO_QUERY_VALUE_BYTES ? item->value_size + 1 : MO_QUERY_VALUE_BYTES;
  bool good = mo_percent_decode(item->name, item->name_size, true, text, item->name_size + 1);
  if (!good || find_name(request->route->query, text) == NULL)
    add_unknown(faults, request, good ? text : "?");
  else if (mo_query(request, text) != NULL || query->n == MO_QUERY_MAX)
    mo_faults_add(faults, MO_FAULT_PARAMETER, text, "duplicate parameter; give it once");
  else if (!mo_percent_decode(item->value, item->value_size, true, value, room))
    mo_faults_add(faults, MO_FAULT_PARAMETER, text,
                  "the value must be UTF-8 in percent escapes, and at most 200 characters");
  else {
    query->items[query->n].name = text;
    query->items[query->n++].value = value;
  }
  return item->name_size + item->value_size + 2;
}

static bool read_query(struct mo_request *request)
{
  const char *at = request->target.query;
  struct mo_query_item item;
  if (*at == '\0')
    return true;
  struct mo_faults faults = {0};
  request->query.text = malloc(2 * strlen(at) + 2); /* a NUL after each name and value */
  if (request->query.text == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return false;
  }
  for (size_t used = 0; mo_query_next(&at, &item);)
    used += read_item(request, &item, request->query.text + used, &faults);
  if (faults.n > 0)
    mo_reply_problem(request, 400, &faults, NULL);
  return faults.n == 0;
}

bool mo_query_begin(struct mo_request *request)
{
  static const char *const json[] = {"application/json", NULL};
  int form;
  return read_query(request) &&
         (!(request->route->flags & MO_ROUTE_JSON) || mo_accept(request, json, &form));
}

void mo_query_end(struct mo_request *request)
{
  free(request->query.text);
  request->query = (struct mo_query){0};
}

const char *mo_query(const struct mo_request *request, const char *name)
{
  for (unsigned i = 0; i < request->query.n; i++)
    if (strcmp(request->query.items[i].name, name) == 0)
      return request->query.items[i].value;
  return NULL;
}

bool mo_query_number(struct mo_request *request, const char *name, int64_t min, int64_t max,
                     int64_t *number)
{
  const char *value = mo_query(request, name);
  char detail[96];
  if (value == NULL || mo_decimal(value, strlen(value), min, max, number))
    return true;
  snprintf(detail, sizeof(detail), "must be an integer from %lld to %lld", (long long)min,
           (long long)max);
  mo_reply_bad_parameter(request, name, detail);
  return false;
}

bool mo_query_id(struct mo_request *request, const char *name, const char *words, int64_t *id)
{
  const char *value = mo_query(request, name);
  if (value == NULL || mo_id(value, id))
    return true;
  mo_reply_bad_parameter(request, name, words);
  return false;
}

bool mo_query_cursor(struct mo_request *request, int64_t *number)
{
  const char *cursor = mo_query(request, "cursor");
  *number = -1;
  if (cursor == NULL || mo_decimal(cursor, strlen(cursor), 0, MO_CURSOR_MAX, number))
    return true;
  mo_reply_bad_parameter(request, "cursor", MO_CURSOR_WORDS);
  return false;
}

bool mo_query_limit(struct mo_request *request, size_t *limit)
{
  int64_t number = 100;
  bool good = mo_query_number(request, "limit", 1, MO_LIST_MAX, &number);
  *limit = (size_t)number;
  return good;
}

/* ---- words ---- */

bool mo_query_word(struct mo_request *request, const char *name, const char *const *words, int *i)
{
  const char *value = mo_query(request, name);
  const int found = value != NULL ? mo_word_index(words, value) : *i;
  char list[MO_WORDS_BYTES], detail[MO_WORDS_BYTES + 16];
  if (value == NULL || found >= 0) {
    *i = found;
    return true;
  }
  snprintf(detail, sizeof(detail), "must be %s", mo_words_join(words, "", list));
  mo_reply_bad_parameter(request, name, detail);
  return false;
}

bool mo_accept(struct mo_request *request, const char *const *types, int *form)
{
  char list[MO_WORDS_BYTES];
  /* If problems are the only JSON that a path returns, generated clients accept only their type. */
  static const char *const of_problems[] = {"application/problem+json"};
  *form = mo_accept_choose(request->framing.accept, types, mo_words_count(types));
  if (*form < 0)
    *form = mo_accept_choose(request->framing.accept, of_problems, 1);
  if (*form >= 0)
    return true;
  mo_reply_problem(request, 406, NULL,
                   "This path returns %s, which the Accept field does not allow.",
                   mo_words_join(types, "", list));
  return false;
}

bool mo_query_form(struct mo_request *request, const char *const *names, const char *const *types,
                   int *form)
{
  return mo_query(request, "format") != NULL ? mo_query_word(request, "format", names, form)
                                             : mo_accept(request, types, form);
}

bool mo_check_content(struct mo_request *request, const char *expected, const char *also)
{
  char type[64], charset[32];
  const char *field = request->framing.content_type;
  const char *coding = request->framing.content_encoding;
  if (coding != NULL && strcasecmp(coding, "identity") != 0) {
    mo_reply_problem(request, 415, NULL,
                     "The body has a content coding, which this service does not support.");
    mo_reply_extra(request, "Accept-Encoding", "identity");
  } else if (field == NULL || !mo_content_type(field, type, charset) ||
             (strcmp(type, expected) != 0 && (also == NULL || strcmp(type, also) != 0)))
    mo_reply_problem(request, 415, NULL, "The Content-Type must be %s.", expected);
  else if (charset[0] != '\0' && strcmp(charset, "utf-8") != 0)
    mo_reply_problem(request, 415, NULL, "The charset must be UTF-8.");
  else
    return true;
  return false;
}

/* ---- ids and preferences ---- */

bool mo_path_id(struct mo_request *request, unsigned parameter, int64_t *id)
{
  if (mo_id(request->parameters[parameter], id))
    return true;
  mo_reply_problem(request, 404, NULL,
                   "There is no job \"%s\": an id must be a positive integer in decimal digits.",
                   MO_SHOWN(request->parameters[parameter]));
  return false;
}

void mo_read_wait(struct mo_request *request)
{
  if (!request->wait_over)
    request->wait_s = mo_prefer_wait(request->framing.prefer, WAIT_MAX_S);
}
