/* several.c: finds the campaigns that a request selects: by ids, label, experiment or group, or all
 * campaigns. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/jobs.h"

#define CAMPAIGNS_MAX 10000

/* Lists campaigns, ascending. MO_ERR_LIMIT: too many. */
static int list(struct mo_store *store, struct mo_job_query query, int64_t *ids, uint32_t *n)
{
  struct mo_job *page = malloc(MO_LIST_MAX * sizeof(*page));
  int64_t read = page != NULL ? MO_LIST_MAX : MO_ERR_NO_MEMORY;
  uint32_t filled = CAMPAIGNS_MAX; /* filled from the end, because lists begin with the newest */
  while (read == MO_LIST_MAX) {
    read = mo_store_jobs(store, &query, page, MO_LIST_MAX);
    for (int64_t i = 0; i < read && filled > 0; i++)
      ids[--filled] = query.before = page[i].id;
    if (read == MO_LIST_MAX && filled == 0)
      read = MO_ERR_LIMIT;
  }
  free(page);
  *n = CAMPAIGNS_MAX - filled;
  memmove(ids, ids + filled, *n * sizeof(*ids));
  return read < 0 ? (int)read : MO_OK;
}

/* Reads ascending ids that are separated by commas. Returns false if it has replied. */
static bool read_ids(struct mo_request *request, const char *text, int64_t *ids, uint32_t *n)
{
  struct mo_job job;
  for (;; text++) {
    char id[24] = "";
    int64_t *member = &ids[*n];
    const size_t size = strcspn(text, ",");
    snprintf(id, sizeof(id), "%.*s", (int)(size < sizeof(id) ? size : sizeof(id) - 1), text);
    if (!mo_id(id, member) || (*n > 0 && *member <= member[-1])) {
      mo_reply_bad_parameter(request, "campaigns",
                             "must be ascending ids of campaigns, separated by commas");
      return false;
    }
    if (!mo_job_of_kind(request, &mo_campaign_resource, *member, &job))
      return false;
    ++*n;
    text += size;
    if (*text == '\0')
      return true;
  }
}

bool mo_find_campaigns(struct mo_request *request, int64_t **ids, uint32_t *n)
{
  const char *listed = mo_query(request, "campaigns");
  struct mo_job_query query = {.state = -1, .kind = MO_JOB_CAMPAIGN};
  char label[MO_LABEL_BYTES_MAX + 1];
  *ids = NULL;
  *n = 0;
  if (!mo_read_job_filters(request, &query, label) ||
      !mo_query_id(request, "group", "must be the id of a group, in decimal digits", &query.group))
    return false;
  if ((listed != NULL) + (query.label != NULL) + (query.experiment != NULL) + (query.group > 0) >
      1) {
    mo_reply_bad_parameter(request, "campaigns",
                           "give only one of campaigns, group, label and experiment");
    return false;
  }
  int64_t *found = malloc(CAMPAIGNS_MAX * sizeof(*found));
  int error = found == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  bool good = error == MO_OK;
  if (good && listed != NULL) {
    good = read_ids(request, listed, found, n);
  } else {
    error = good ? list(mo_api_of(request)->store, query, found, n) : error;
    good = error == MO_OK;
    if (error == MO_ERR_LIMIT)
      mo_reply_bad_parameter(request, query.label != NULL ? "label" : "campaigns",
                             "more than 10,000 campaigns match; select fewer");
    else if (error != MO_OK)
      mo_reply_error(request, error, "campaign");
  }
  if (good)
    *ids = found;
  else
    free(found);
  return good;
}
