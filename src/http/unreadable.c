/* unreadable.c: see unreadable.h. */
#include "http/unreadable.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/number.h"
#include "http/field.h"

#define WORDS_BYTES (MO_DAMAGE_BYTES + 64)

static void describe(const struct mo_job *job, char words[WORDS_BYTES])
{
  snprintf(words, WORDS_BYTES, "%s %lld cannot be read: %s",
           (int)job->kind < MO_JOB_KINDS ? mo_job_kind_name(job->kind) : "job", (long long)job->id,
           job->damage);
}

static void note(struct mo_unreadable *list, const char *words)
{
  const size_t used = strlen(list->note);
  if (list->n_noted == list->n &&
      used + strlen(words) + 2 + sizeof(list->more) < sizeof(list->note)) {
    snprintf(list->note + used, sizeof(list->note) - used, "%s%s", used > 0 ? "; " : "", words);
    list->n_noted++;
  }
  list->n++;
}

void mo_unreadable_add_other(struct mo_unreadable *list, const char *kind, const char *id,
                             const char *damage)
{
  char words[WORDS_BYTES];
  mo_text_add(&list->items, list->n > 0 ? ",{\"id\":" : "{\"id\":");
  mo_text_json_string(&list->items, id, strlen(id));
  mo_text_member(&list->items, "kind", kind);
  mo_text_member(&list->items, "detail", damage);
  mo_text_add(&list->items, "}");
  snprintf(words, sizeof(words), "%s %s cannot be read: %s", kind, id, damage);
  note(list, words);
}

void mo_unreadable_row(struct mo_request *request, struct mo_unreadable *list, int64_t job,
                       const char *kind, const char *id, const char *place,
                       const struct mo_row_damage *damage)
{
  char words[MO_DAMAGE_BYTES];
  snprintf(words, sizeof(words), "%s of job %" PRId64 " and %s is %s", damage->column, job, place,
           MO_NUMBER(damage->value));
  if (list != NULL)
    mo_unreadable_add_other(list, kind, id, words);
  else if (request->reason[0] == '\0')
    mo_request_note(request, "%s %s cannot be read: %s", kind, id, words);
}

void mo_unreadable_add(struct mo_unreadable *list, const struct mo_job *job)
{
  char words[WORDS_BYTES];
  mo_text_format(&list->items, "%s{\"id\":\"%lld\",\"kind\":", list->n > 0 ? "," : "",
                 (long long)job->id);
  if ((int)job->kind < MO_JOB_KINDS)
    mo_text_format(&list->items, "\"%s\"", mo_job_kind_name(job->kind));
  else
    mo_text_add(&list->items, "null");
  mo_text_member(&list->items, "detail", job->damage);
  mo_text_add(&list->items, "}");
  describe(job, words);
  note(list, words);
}

void mo_unreadable_end(struct mo_request *request, struct mo_text *text, struct mo_unreadable *list)
{
  if (list->n > 0) {
    mo_text_add(text, ",\"unreadable\":[");
    mo_text_bytes(text, list->items.data, list->items.size);
    mo_text_add(text, "]");
    text->failed |= list->items.failed;
    if (list->n > list->n_noted)
      snprintf(list->more, sizeof(list->more), "; and %u more", list->n - list->n_noted);
    mo_request_note(request, "%s%s", list->note, list->more);
  }
  mo_text_free(&list->items);
}

/* "Design 7 cannot be read: …", of what the path names. */
static void reply(struct mo_request *request, const char *words)
{
  mo_reply_problem(request, 500, NULL, "%c%s. The log of the service has the request's id.",
                   words[0] >= 'a' && words[0] <= 'z' ? words[0] - 'a' + 'A' : words[0], words + 1);
}

static bool path_begins(const struct mo_request *request, const char *beginning)
{
  return strncmp(request->path, beginning, strlen(beginning)) == 0;
}

static bool find_job(struct mo_store *store, const char *digits, char words[WORDS_BYTES])
{
  struct mo_job *job = malloc(sizeof(*job));
  int64_t id;
  const bool found = job != NULL && mo_decimal(digits, strlen(digits), 1, INT64_MAX, &id) &&
                     mo_store_job_damage(store, id, job) == MO_OK;
  if (found)
    describe(job, words);
  free(job);
  return found;
}

static bool find_design(struct mo_store *store, const char *digits, char words[WORDS_BYTES])
{
  char damage[MO_DAMAGE_BYTES];
  struct mo_bits form;
  int64_t row;
  if (mo_genotype_from_id(MO_DEFAULT_WORKSPACE, digits, strlen(digits), form.words) != MO_OK ||
      mo_store_design_damage(store, &form, &row, damage) != MO_OK)
    return false;
  snprintf(words, WORDS_BYTES, "design %" PRId64 " cannot be read: %s", row, damage);
  return true;
}

static bool find_controller(struct mo_store *store, const char *name, char words[WORDS_BYTES])
{
  struct mo_controller_record record;
  if (mo_store_controller(store, name, &record) != MO_ERR_CORRUPT || record.damage[0] == '\0')
    return false;
  snprintf(words, WORDS_BYTES, "controller %s cannot be read: %s", name, record.damage);
  return true;
}

bool mo_reply_unreadable(struct mo_request *request)
{
  struct mo_store *store = request->http->services.store;
  const char *name = request->parameters[0];
  char words[WORDS_BYTES];
  const bool found =
      path_begins(request, "/v1/designs/")       ? find_design(store, name, words)
      : path_begins(request, "/v1/controllers/") ? find_controller(store, name, words)
      : path_begins(request, "/v1/jobs/") || path_begins(request, "/v1/evaluations/") ||
              path_begins(request, "/v1/trainings/") || path_begins(request, "/v1/campaigns/")
          ? find_job(store, name, words)
          : false;
  if (found)
    reply(request, words);
  return found;
}

void mo_reply_cancelled_unreadable(struct mo_request *request)
{
  char words[WORDS_BYTES];
  if (find_job(request->http->services.store, request->parameters[0], words))
    mo_request_note(request, "%s", words);
  mo_reply_static(request, 204, NULL, "", 0);
}
