/* common.c: helpers of several commands: facts, results, paged lists. */
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

const char *text_of(const json_t *object, const char *key)
{
  const char *text = json_string_value(json_object_get(object, key));
  return text != NULL ? text : "";
}

int64_t number_of(const json_t *object, const char *key)
{
  return json_integer_value(json_object_get(object, key));
}

bool is_final(const char *state)
{
  return strcmp(state, "succeeded") == 0 || strcmp(state, "failed") == 0 ||
         strcmp(state, "cancelled") == 0;
}

bool is_state(const char *word)
{
  static const char *const states[] = {"queued",    "running", "paused",
                                       "succeeded", "failed",  "cancelled"};
  bool known = false;
  for (size_t i = 0; i < 6 && !known; i++)
    known = strcmp(states[i], word) == 0;
  return known;
}

bool check_job_id(const char *text)
{
  size_t length = strlen(text);
  if (length > 0 && length <= 18 && strspn(text, "0123456789") == length && *text != '0')
    return true;
  complain(STATUS_USAGE, "\"%s\" is not the id of a job: a positive whole number", text);
  return false;
}

void print_json(const json_t *json)
{
  put_json(json, isatty(STDOUT_FILENO) ? JSON_INDENT(2) : JSON_COMPACT);
}

int show_json(struct ctl *ctl, const char *path)
{
  json_t *json;
  int status = transport_get_json(ctl, path, 0, &json);
  if (status == STATUS_OK)
    print_json(json);
  json_decref(json);
  return status;
}

int save_output(const char *path, const void *bytes, size_t n)
{
  bool standard = strcmp(path, "-") == 0;
  FILE *file = standard ? stdout : fopen(path, "we");
  bool ok = file != NULL && fwrite(bytes, 1, n, file) == n && fflush(file) == 0;
  int error = errno;
  if (file != NULL && !standard && fclose(file) != 0 && ok) {
    ok = false;
    error = errno;
  }
  return ok ? STATUS_OK : complain(STATUS_ERROR, "%s: %s", path, strerror(error));
}

int save_reply(struct ctl *ctl, const char *path, const char *accept, const char *output)
{
  struct reply reply;
  int status = transport_send(
      ctl, &(struct request){.method = "GET", .path = path, .accept = accept}, &reply);
  if (status == STATUS_OK)
    status = save_output(output, reply.body != NULL ? reply.body : "", reply.body_bytes);
  if (status == STATUS_OK && !ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %zu bytes", output, reply.body_bytes);
  reply_free(&reply);
  return status;
}

int collect(struct ctl *ctl, const char *path, size_t limit, json_t **items)
{
  json_t *all = json_array();
  char *cursor = NULL;
  int status = all != NULL ? STATUS_OK : complain(STATUS_ERROR, "out of memory");
  while (status == STATUS_OK) {
    size_t left = limit == 0 ? 1000 : limit - json_array_size(all);
    char *page_path = NULL;
    if (asprintf(&page_path, "%s%climit=%zu%s%s", path, strchr(path, '?') != NULL ? '&' : '?',
                 left < 1000 ? left : 1000, cursor != NULL ? "&cursor=" : "",
                 cursor != NULL ? cursor : "") < 0) {
      status = complain(STATUS_ERROR, "out of memory");
      break;
    }
    json_t *page;
    status = transport_get_json(ctl, page_path, 0, &page);
    free(page_path);
    if (status == STATUS_OK) {
      json_array_extend(all, json_object_get(page, "items"));
      const char *next = json_string_value(json_object_get(page, "next_cursor"));
      free(cursor);
      cursor = next != NULL ? escape(next) : NULL;
    }
    json_decref(page);
    if (cursor == NULL || (limit != 0 && json_array_size(all) >= limit))
      break;
  }
  free(cursor);
  if (status != STATUS_OK) {
    json_decref(all);
    all = NULL;
  }
  *items = all;
  return status;
}

int walk_rows(struct ctl *ctl, const char *path, int64_t after,
              bool (*take)(void *context, const json_t *row), void *context)
{
  int status = STATUS_OK;
  for (bool more = true; status == STATUS_OK && more;) {
    char page_path[192];
    int n = snprintf(page_path, sizeof(page_path), "%s", path);
    if (after >= 0)
      snprintf(page_path + n, sizeof(page_path) - (size_t)n, "&cursor=%" PRId64, after);
    json_t *page, *row;
    size_t i;
    status = transport_get_json(ctl, page_path, 0, &page);
    json_array_foreach(json_object_get(page, "items"), i, row)
    {
      if (status == STATUS_OK && !take(context, row))
        status = complain(STATUS_ERROR, "out of memory");
    }
    const int64_t next = strtoll(text_of(page, "next_cursor"), NULL, 10);
    more = json_is_string(json_object_get(page, "next_cursor")) && next > after;
    after = next;
    json_decref(page);
  }
  return status;
}

int collect_states(struct ctl *ctl, const char *list, json_t **items)
{
  static const char *const filters[] = {"state", "label", "group"}; /* group: for campaigns */
  const char *state = option_text(ctl, "state", NULL), *group = option_text(ctl, "group", NULL);
  int64_t limit = 50;
  if (!option_number(ctl, "limit", 1, 1000000, &limit))
    return STATUS_USAGE;
  if (option_is_set(ctl, "all"))
    limit = 0;
  if (state != NULL && !is_state(state))
    return complain(
        STATUS_USAGE,
        "--state: \"%s\" is not queued, running, paused, succeeded, failed or cancelled", state);
  if (group != NULL && !check_job_id(group))
    return STATUS_USAGE;
  char *path = strdup(list);
  for (size_t i = 0; i < 3; i++) {
    const char *given = option_text(ctl, filters[i], NULL);
    char *shorter = path, *escaped = given != NULL ? escape(given) : NULL;
    if (escaped == NULL || shorter == NULL)
      continue;
    if (asprintf(&path, "%s%c%s=%s", shorter, strchr(shorter, '?') != NULL ? '&' : '?', filters[i],
                 escaped) < 0)
      path = NULL;
    free(escaped);
    free(shorter);
  }
  int status = path != NULL ? collect(ctl, path, (size_t)limit, items)
                            : complain(STATUS_ERROR, "out of memory");
  free(path);
  return status;
}

bool print_page(const struct ctl *ctl, json_t *items)
{
  if (!ctl->json)
    return false;
  json_t *page = json_pack("{s:O, s:n}", "items", items, "next_cursor");
  print_json(page);
  json_decref(page);
  return true;
}

int print_list(const struct ctl *ctl, int status, json_t *items, const char *heads,
               void (*add)(struct table *table, const json_t *item))
{
  size_t i;
  const json_t *item;
  if (status == STATUS_OK && !print_page(ctl, items)) {
    struct table table;
    table_open(&table, heads);
    json_array_foreach(items, i, item) add(&table, item);
    table_print(&table, stdout, ctl);
  }
  json_decref(items);
  return status;
}

int job_outcome(const char *noun, const json_t *job)
{
  const char *state = text_of(job, "state");
  if (strcmp(state, "succeeded") == 0)
    return STATUS_OK;
  const json_t *error = json_object_get(job, "error");
  if (json_is_object(error))
    return complain(STATUS_NEGATIVE, "%s %s %s: %s", noun, text_of(job, "id"), state,
                    text_of(error, "detail"));
  return complain(STATUS_NEGATIVE, "%s %s is %s", noun, text_of(job, "id"), state);
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

void print_state(const struct ctl *ctl, const char *state)
{
  const char *color = strcmp(state, "succeeded") == 0 ? "\033[32m"
                      : strcmp(state, "failed") == 0  ? "\033[31m"
                                                      : NULL;
  if (!ctl->color)
    color = NULL;
  print_name(ctl, "state");
  fputs(color != NULL ? color : "", stdout);
  print_plain(stdout, "%s", state);
  puts(color != NULL ? "\033[0m" : "");
}

void print_job_state(const struct ctl *ctl, const json_t *job, const char *phase)
{
  const json_t *error = json_object_get(job, "error");
  print_state(ctl, text_of(job, "state"));
  if (*text_of(job, "reason") != 0)
    print_fact(ctl, "reason", "%s", text_of(job, "reason"));
  else if (*phase != 0)
    print_fact(ctl, "phase", "%s", phase);
  print_fact(ctl, "weight", "%g", json_number_value(json_object_get(job, "weight")));
  print_fact(ctl, "device", "%s", text_of(job, "device"));
  if (*text_of(job, "label") != 0)
    print_fact(ctl, "label", "%s", text_of(job, "label"));
  if (json_is_object(error))
    print_fact(ctl, "error", "%s: %s", text_of(error, "code"), text_of(error, "detail"));
  if (number_of(job, "attempts") > 0)
    print_fact(ctl, "attempts", "%" PRId64, number_of(job, "attempts"));
}

void print_controller_fact(const struct ctl *ctl, const char *fact, const json_t *controller,
                           const char *sensor)
{
  const char *name = text_of(controller, "name");
  if (json_is_object(controller))
    print_fact(ctl, fact, "%s%ssha256:%s", name, *name != 0 ? ", " : "",
               text_of(controller, "sha256"));
  else
    print_fact(ctl, fact, "random weights, sensor %s", sensor);
}

void print_job_times(const struct ctl *ctl, const json_t *job)
{
  char time[32];
  print_fact(ctl, "created", "%s", time_text(json_object_get(job, "created_at"), time));
  print_fact(ctl, "started", "%s", time_text(json_object_get(job, "started_at"), time));
  print_fact(ctl, "finished", "%s", time_text(json_object_get(job, "finished_at"), time));
}

void print_job_facts(const struct ctl *ctl, const json_t *job)
{
  char a[32], b[32];
  print_fact(ctl, "job", "%s (%s, %s)", text_of(job, "id"), text_of(job, "kind"),
             text_of(job, "priority"));
  print_job_state(ctl, job, "");
  const json_t *training = json_object_get(job, "training");
  if (json_is_object(training)) {
    print_fact(ctl, "name", "%s", text_of(training, "name"));
    print_fact(ctl, "progress", "step %s of %s; morphoctl train show %s tells more",
               count_text(number_of(training, "step"), a),
               count_text(number_of(training, "steps"), b), text_of(job, "id"));
    print_job_times(ctl, job);
    return;
  }
  const json_t *campaign = json_object_get(job, "campaign");
  if (json_is_object(campaign)) {
    print_fact(ctl, "mode", "%s", text_of(campaign, "mode"));
    print_fact(ctl, "progress", "generation %s of %s; morphoctl campaign show %s tells more",
               count_text(number_of(campaign, "generation"), a),
               count_text(number_of(campaign, "generations"), b), text_of(job, "id"));
    print_job_times(ctl, job);
    return;
  }
  print_controller_fact(ctl, "controller", json_object_get(job, "controller"), "");
  const json_t *environments = json_object_get(job, "environments");
  if (json_is_string(environments))
    print_fact(ctl, "environments", "%s", json_string_value(environments));
  else
    print_fact(ctl, "environments", "%" PRId64 " of the request", number_of(environments, "count"));
  print_fact(ctl, "precision", "%s", text_of(job, "precision"));
  const json_t *physics = json_object_get(job, "physics");
  print_fact(ctl, "physics", "%" PRId64 " steps of %g s, impact %s", number_of(physics, "n_steps"),
             json_number_value(json_object_get(physics, "dt_s")), text_of(physics, "impact"));
  print_fact(ctl, "designs", "%s", count_text(number_of(job, "n_designs"), a));
  print_fact(ctl, "rollouts", "%s of %s", count_text(number_of(job, "rollouts_done"), a),
             count_text(number_of(job, "rollouts_total"), b));
  if (number_of(job, "rollouts_cached") > 0)
    print_fact(ctl, "from store", "%s", count_text(number_of(job, "rollouts_cached"), a));
  if (number_of(job, "rollouts_diverged") > 0)
    print_fact(ctl, "diverged", "%s", count_text(number_of(job, "rollouts_diverged"), a));
  print_job_times(ctl, job);
}

/* ---- results ---- */

struct ranked {
  size_t place; /* position in the request */
  double score; /* +infinity: diverged */
};

static int compare_ranked(const void *a, const void *b)
{
  const struct ranked *x = a, *y = b;
  if (x->score != y->score)
    return x->score < y->score ? -1 : 1;
  return x->place < y->place ? -1 : x->place > y->place;
}

static int count_voxels(const char *genotype)
{
  int n = 0;
  for (; *genotype != 0; genotype++)
    n += *genotype == '1';
  return n;
}

void print_results(const struct ctl *ctl, const json_t *evaluation, char *const *names,
                   bool by_score, size_t top)
{
  const json_t *results = json_object_get(evaluation, "results");
  size_t n = json_array_size(results);
  struct ranked *order = calloc(n > 0 ? n : 1, sizeof(*order));
  struct table table;
  bool named = false, verified = false;
  if (order == NULL) {
    complain(STATUS_ERROR, "out of memory");
    return;
  }
  for (size_t i = 0; i < n; i++) {
    const json_t *result = json_array_get(results, i);
    const json_t *score = json_object_get(result, "score");
    order[i] =
        (struct ranked){i, json_is_number(score) ? json_number_value(score) : (double)INFINITY};
    named |= names != NULL && names[i] != NULL;
    verified |= json_object_get(result, "agrees") != NULL;
  }
  if (by_score)
    qsort(order, n, sizeof(*order), compare_ranked);
  table_open(&table, verified ? ">#|name|design|>voxels|>score|>best|>worst|bits"
                              : ">#|name|design|>voxels|>score|>best|>worst|note");
  for (size_t r = 0; r < n && (top == 0 || r < top); r++) {
    size_t i = order[r].place;
    const json_t *result = json_array_get(results, i);
    char number[24], voxels[24], score[32], best_text[32], worst_text[32], note[96] = "";
    const json_t *losses = json_object_get(result, "losses");
    const json_t *best = NULL, *worst = NULL, *loss;
    size_t k;
    json_array_foreach(losses, k, loss)
    {
      if (!json_is_number(loss))
        continue;
      if (best == NULL || json_number_value(loss) < json_number_value(best))
        best = loss;
      if (worst == NULL || json_number_value(loss) > json_number_value(worst))
        worst = loss;
    }
    const json_t *diverged = json_object_get(result, "diverged");
    if (verified) {
      const json_t *agrees = json_object_get(result, "agrees");
      snprintf(note, sizeof(note), "%s",
               json_is_true(agrees)    ? "the same"
               : json_is_false(agrees) ? "DIFFERENT"
                                       : "nothing stored");
    } else if (json_array_size(diverged) > 0) {
      const json_t *first = json_array_get(diverged, 0);
      snprintf(note, sizeof(note),
               "diverged in %zu of %zu (environment %" PRId64 ", step %" PRId64 ")",
               json_array_size(diverged), json_array_size(losses), number_of(first, "environment"),
               number_of(first, "step"));
    }
    snprintf(number, sizeof(number), "%zu", i);
    snprintf(voxels, sizeof(voxels), "%d", count_voxels(text_of(result, "genotype")));
    const char *cells[] = {number,
                           names != NULL && names[i] != NULL ? names[i] : "",
                           text_of(result, "id"),
                           voxels,
                           score_text(json_object_get(result, "score"), score),
                           score_text(best, best_text),
                           score_text(worst, worst_text),
                           note};
    table_add(&table, cells);
  }
  if (!named)
    table_drop(&table, 1);
  table_print(&table, stdout, ctl);
  if (top != 0 && n > top)
    printf("… and %zu more\n", n - top);
  free(order);
}
