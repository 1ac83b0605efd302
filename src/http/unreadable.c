/* unreadable.c: see unreadable.h. */
#include "http/unreadable.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/field.h"

#define WORDS_BYTES (MO_DAMAGE_BYTES + 64)

static void describe(const struct mo_job *job, char words[WORDS_BYTES])
{
  snprintf(words, WORDS_BYTES, "%s %lld cannot be read: %s",
           (int)job->kind < MO_JOB_KINDS ? mo_job_kind_name(job->kind) : "job", (long long)job->id, job->damage);
}

static void note(struct mo_unreadable *list, const char *words)
{
  const size_t used = strlen(list->note);
  if (list->n_noted == list->n && used + strlen(words) + 2 + sizeof(list->more) < sizeof(list->note)) {
    snprintf(list->note + used, sizeof(list->note) - used, "%s%s", used > 0 ? "; " : "", words);
    list->n_noted++;
  }
  list->n++;
}

void mo_unreadable_add_other(struct mo_unreadable *list, const char *kind, const char *id, const char *damage)
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

void mo_unreadable_add(struct mo_unreadable *list, const struct mo_job *job)
{
  char words[WORDS_BYTES];
  mo_text_format(&list->items, "%s{\"id\":\"%lld\",\"kind\":", list->n > 0 ? "," : "", (long long)job->id);
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

/* What of the rows of a job cannot be read, in its damage. */
static bool find_damage(struct mo_store *store, int64_t id, struct mo_job *job)
{
  int code = mo_store_job(store, id, job);
  struct mo_training_status *training =
      code == MO_OK && job->kind == MO_JOB_TRAINING ? malloc(sizeof(*training)) : NULL;
  struct mo_campaign_status *campaign =
      code == MO_OK && job->kind == MO_JOB_CAMPAIGN ? malloc(sizeof(*campaign)) : NULL;
  if (training != NULL && (code = mo_store_training(store, id, training)) == MO_ERR_CORRUPT)
    memcpy(job->damage, training->job.damage, sizeof(job->damage));
  if (campaign != NULL && (code = mo_store_campaign(store, id, campaign)) == MO_ERR_CORRUPT)
    memcpy(job->damage, campaign->job.damage, sizeof(job->damage));
  free(training);
  free(campaign);
  return code == MO_ERR_CORRUPT && job->damage[0] != '\0';
}

static bool path_is_of_job(const struct mo_request *request)
{
  static const char *const paths[] = {"/v1/jobs/", "/v1/evaluations/", "/v1/trainings/", "/v1/campaigns/"};
  for (size_t i = 0; i < sizeof(paths) / sizeof(paths[0]); i++)
    if (strncmp(request->path, paths[i], strlen(paths[i])) == 0)
      return true;
  return false;
}

bool mo_reply_unreadable(struct mo_request *request)
{
  const char *digits = request->parameters[0];
  struct mo_job *job = NULL;
  bool damaged = false;
  int64_t id;
  if (path_is_of_job(request) && mo_decimal(digits, strlen(digits), 1, INT64_MAX, &id))
    job = malloc(sizeof(*job));
  if (job != NULL && find_damage(request->http->services.store, id, job)) {
    char words[WORDS_BYTES];
    describe(job, words);
    if (words[0] >= 'a' && words[0] <= 'z')
      words[0] = (char)(words[0] - 'a' + 'A');
    mo_reply_problem(request, 500, NULL, "%s. The log of the service has the request's id.", words);
    damaged = true;
  }
  free(job);
  return damaged;
}
