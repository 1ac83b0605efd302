/* scores.c: exports scores as a file, and imports such files. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "api/fleet.h"
#include "exchange/score_block.h"
#include "http/download.h"

/* Memory of a block, and of its members while they are written. */
#define HELD_BYTES ((uint64_t)16 << 20)

/* ---- export ---- */

struct export
{
  struct mo_score_walk *walk;
  struct mo_score_block *block;
  char program[48];
};

static void free_export(void *context)
{
  struct export *export = context;
  if (export != NULL) {
    mo_score_walk_free(export->walk);
    mo_score_block_free(export->block);
  }
  free(export);
}

static int write_more(void *context, struct mo_text *text)
{
  struct export *export = context;
  int error = mo_score_walk_next(export->walk, export->block);
  if (error == MO_OK)
    error = mo_score_block_write(export->block, export->program, text);
  return error != MO_OK ? error : !export->block->is_last;
}

/* Returns whether the text begins with a date and a time of day, in 19 characters. */
static bool begins_with_time(const char *text)
{
  static const char form[] = "0000-00-00T00:00:00";
  size_t i = 0;
  while (form[i] != '\0' &&
         (form[i] == '0' ? text[i] >= '0' && text[i] <= '9' : text[i] == form[i]))
    i++;
  return form[i] == '\0';
}

/* Reads a time in the format of replies, with any number of decimals; the fraction is ignored. */
static bool read_since(struct mo_request *request, int64_t *since_us)
{
  const char *value = mo_query(request, "since");
  struct tm parts = {0};
  if (value == NULL)
    return true;
  const char *end = begins_with_time(value) ? strptime(value, "%Y-%m-%dT%H:%M:%S", &parts) : NULL;
  if (end != NULL && *end == '.' && end[1] >= '0' && end[1] <= '9')
    end += 1 + strspn(end + 1, "0123456789");
  if (end == NULL || strcmp(end, "Z") != 0) {
    mo_reply_bad_parameter(request, "since", "must be a time in UTC, such as 2026-11-21T11:34:04Z");
    return false;
  }
  *since_us = (int64_t)timegm(&parts) * 1000000;
  return true;
}

void mo_api_get_scores(struct mo_request *request)
{
  static const char *const types[] = {MO_ARCHIVE_TYPE, "application/octet-stream", NULL};
  struct mo_api *api = mo_api_of(request);
  struct mo_score_query query = {.controller = mo_query(request, "controller")};
  int form;
  if (!mo_accept(request, types, &form) || !mo_query_class(request, &query.fingerprint) ||
      !read_since(request, &query.since_us))
    return;
  struct export *export = calloc(1, sizeof(*export));
  int error = MO_ERR_NO_MEMORY;
  if (export != NULL && (export->block = mo_score_block_create()) != NULL)
    error = mo_score_walk_create(api->store, &query, &export->walk);
  if (error != MO_OK) {
    free_export(export);
    if (error == MO_ERR_NOT_FOUND && query.controller != NULL)
      mo_reply_missing(request, "controller", query.controller);
    else
      mo_reply_error(request, error, "controller");
    return;
  }
  snprintf(export->program, sizeof(export->program), "morphod %s", api->version);
  mo_download_open(request, MO_ARCHIVE_TYPE, NULL, HELD_BYTES, write_more, export, free_export);
}

/* ---- import ---- */

/* An import: the blocks of one request. */
struct entering {
  struct mo_score_block *block;
  struct mo_scores_imported *entered;
  uint32_t n; /* blocks that were imported */
  size_t at;  /* offset of the next block */
};

static int enter_next(struct mo_request *request, struct entering *entering,
                      struct mo_message *message)
{
  const char *from = request->body + entering->at;
  size_t size = 0;
  if (mo_request_is_over(request))
    return MO_ERR_CANCELLED;
  int error = mo_score_block_head(from, request->body_size - entering->at, &size, message);
  if (error == MO_OK)
    error = mo_score_block_read(from + MO_SCORES_HEAD, size, entering->block, message);
  if (error == MO_OK)
    error = mo_store_scores_import(mo_api_of(request)->store, entering->block, entering->entered,
                                   message);
  if (error != MO_OK)
    return error;
  entering->at += MO_SCORES_HEAD + size;
  entering->n++;
  return MO_OK;
}

static void reply_entered(struct mo_request *request, const struct entering *entering)
{
  const struct mo_scores_imported *entered = entering->entered;
  const struct mo_score_block *block = entering->block;
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_member_count(&text, "blocks", entering->n);
  mo_text_member_bool(&text, "last", block->is_last);
  mo_text_format(&text, ",\"source\":{\"store\":\"%016llx\"", (unsigned long long)block->store);
  mo_text_member(&text, "host", block->host);
  mo_text_add(&text, "}");
  mo_text_member_count(&text, "new", entered->n_new);
  mo_text_member_count(&text, "known", entered->n_known);
  mo_text_member_count(&text, "different", entered->n_different);
  mo_text_add(&text, ",\"differences\":[");
  for (uint32_t i = 0; i < entered->n; i++)
    mo_json_differences(&text, &entered->differences[i]);
  mo_text_add(&text, "]}");
  mo_reply_json(request, 200, &text);
  if (entered->n_different > 0)
    mo_request_note(
        request, "the losses of %s from store %016llx on %s differ from the stored ones",
        MO_COUNTED(entered->n_different, "rollout"), (unsigned long long)block->store, block->host);
}

/* Replies with the reason why a block is rejected. */
static void reply_refusal(struct mo_request *request, int error, const struct entering *entering,
                          const struct mo_message *message)
{
  struct mo_faults faults = {0};
  if (error != MO_ERR_FORMAT && error != MO_ERR_INVALID) {
    mo_reply_error(request, error, "scores");
    return;
  }
  mo_faults_add(&faults, MO_FAULT_BODY, "", "%s", message->text);
  mo_reply_problem(request, 422, &faults,
                   "The block at byte %zu was refused, and nothing in it was stored; imported "
                   "before it: %s.",
                   entering->at, MO_COUNTED(entering->n, "block"));
}

void mo_api_post_scores(struct mo_request *request)
{
  struct mo_message message = {""};
  if (!mo_check_content(request, MO_ARCHIVE_TYPE, "application/octet-stream"))
    return;
  struct entering entering = {.block = mo_score_block_create(),
                              .entered = calloc(1, sizeof(*entering.entered))};
  int error = entering.block != NULL && entering.entered != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    do
      error = enter_next(request, &entering, &message);
    while (error == MO_OK && entering.at < request->body_size);
  if (error != MO_OK)
    reply_refusal(request, error, &entering, &message);
  else
    reply_entered(request, &entering);
  mo_score_block_free(entering.block);
  free(entering.entered);
}
