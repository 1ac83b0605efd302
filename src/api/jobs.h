/* jobs.h: the kinds of jobs as the interface shows them, and replies about jobs of any kind. */
#ifndef MORPHO_API_JOBS_H
#define MORPHO_API_JOBS_H

#include "api/handlers.h"
#include "jobs/live.h"
#include "store/atlases.h"
#include "store/campaign_designs.h"
#include "store/campaigns.h"
#include "store/certificates.h"
#include "store/trainings.h"

/* The row of a job in the store, of any kind. */
union mo_job_status {
  struct mo_job job; /* all begin with this */
  struct mo_training_status training;
  struct mo_campaign_status campaign;
  struct mo_atlas_status atlas;
  struct mo_certificate_status certificate;
};

/* A kind of job. */
struct mo_resource {
  enum mo_job_kind kind;
  const char *path;   /* "/v1/trainings" */
  size_t status_size; /* if larger than a job, an item of the list of jobs needs the whole status */
  int (*read)(struct mo_store *store, int64_t id, union mo_job_status *status);
  /* Reads a page of statuses, newest first. Returns their number or an error. */
  int64_t (*page)(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                  size_t limit);
  /* Write the whole resource or its item in the list of its kind; and its item in the list of jobs.
   * page and write are NULL for a kind without its own list. */
  int (*write)(struct mo_api *api, struct mo_text *text, const void *status,
               const struct mo_live *live, bool is_listed);
  void (*write_job)(struct mo_text *text, const void *status, const struct mo_live *live);
  bool versioned; /* the version of the row covers everything that is written about a job that is
                     not running */
};
extern const struct mo_resource mo_evaluation_resource, mo_training_resource, mo_campaign_resource,
    mo_atlas_resource, mo_certificate_resource;

/* ---- job_reply.c ---- */

/* Replies with the problem of an error that concerns a job. what: its kind, or "job". */
void mo_reply_job_error(struct mo_request *request, int error, const char *what, int64_t id);

/* Reads the live state of a job; empty if the job has ended. */
void mo_read_live(struct mo_api *api, const struct mo_job *job, struct mo_live *live);
/* Replies with a job as it stands now: whole, or as an item of the list of jobs. On an error,
 * replies with the error and returns it. */
int mo_reply_job(struct mo_request *request, unsigned http_status, const struct mo_resource *kind,
                 int64_t id, bool whole);
/* Replies 202 to a submission, or 200 if the job is done and the client waited. */
void mo_reply_submitted(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                        bool done);
/* Reads a job, or lets the request wait until the job ends if its Prefer field says so. Returns
 * false if the request is waiting or has its reply. kind NULL: any kind. */
bool mo_await_job(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                  struct mo_job *job);
/* Reads a job of this kind. Returns false if it has replied. */
bool mo_job_of_kind(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                    struct mo_job *job);

/* ---- jobs.c ---- */

/* Returns the kind whose path begins the request's route, or NULL if there is none. */
const struct mo_resource *mo_resource_of(const struct mo_request *request);
/* Reads the id in the path of a job of the route's kind. Returns false after replying with a 404.
 */
bool mo_path_job(struct mo_request *request, int64_t *id);
/* Reads the filters that the lists of all kinds share. label: a buffer for a label without its
 * star. Returns false if it has replied. */
bool mo_read_job_filters(struct mo_request *request, struct mo_job_query *query,
                         char label[MO_LABEL_BYTES_MAX + 1]);

/* ---- several.c ---- */

/* Finds the campaigns that the parameters campaigns, group, label or experiment select, or all
 * campaigns, in ascending order: (n), malloc. Returns false if it has replied. */
bool mo_find_campaigns(struct mo_request *request, int64_t **ids, uint32_t *n);

#endif
