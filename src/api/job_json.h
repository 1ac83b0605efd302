/* job_json.h: writes jobs, and designs of campaigns, as in the contract. */
#ifndef MORPHO_API_JOB_JSON_H
#define MORPHO_API_JOB_JSON_H

#include "base/text.h"
#include "exchange/values.h"
#include "jobs/campaigns.h"
#include "jobs/trainings.h"

/* Writes how the orientation of a design was chosen, or null if the request gave it. */
void mo_member_orientation(struct mo_text *text, enum mo_orientation orientation);
/* Writes the members of a design in a request: id, robot, genotype, sizes, and the content of its
 * note (nullable). If the genotype is empty, id, robot, genotype and sizes are null. May fail with
 * MO_ERR_NO_MEMORY. */
int mo_members_design(struct mo_text *text, const struct mo_lattice *lattice,
                      const struct mo_genotype *form, const struct mo_genotype *genotype,
                      const struct mo_design_note *note);
/* Writes the member "own_score" of a list with scores that the client of a study sent; nothing if
 * the service computed them. */
void mo_member_own_score(struct mo_text *text, const struct mo_own_score *own);
/* Writes how the fresh worlds of re-evaluations differ in kind from the campaign's, as the member
 * "fresh_worlds" of a list of designs; null: they do not differ. Writes nothing if the campaign has
 * no re-evaluations. */
void mo_member_fresh_worlds(struct mo_text *text, const struct mo_campaign_record *record);
/* Writes notes with their places, as a member. */
void mo_member_notes(struct mo_text *text, const char *name, const struct mo_design_note *notes,
                     uint32_t n);
/* Writes a controller as an object of name ("": null) and hash. */
void mo_member_controller(struct mo_text *text, const char *member, bool known, const char *name,
                          const struct mo_sha256 *sha256);
/* Writes the name of a set of environments; set "": writes the number of environments in the
 * request. */
void mo_member_environments(struct mo_text *text, const char *set, uint32_t n);

/* Reads the environments of a job if one of them has a task that is not plain; else *environments
 * is NULL. The caller frees them. set: the job's named set, or "". */
int mo_tasks_read(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *set,
                  struct mo_environment **environments);

/* Writes warnings as a member. */
void mo_member_warnings(struct mo_text *text, const struct mo_warning *warnings, uint32_t n);

/* Returns the state to show: a running job that waits for disk space is shown as paused. */
enum mo_job_state mo_job_state_shown(const struct mo_job *job, const struct mo_live *live);
/* Writes the members that jobs of every kind have, from state to error, and why a training run or
 * campaign makes no progress. */
void mo_job_write_head(struct mo_text *text, const struct mo_job *job, const struct mo_live *live);
/* Writes the paths of the resources that belong to a job. below: pairs of member and path, then
 * NULL. */
void mo_links_write(struct mo_text *text, const struct mo_job *job, const char *const *below);

/* Writes a training run and leaves the object open. live: its current live state. population_kind:
 * the kind of the job record.population, if there is one. tasks: (record.n_environments) of a
 * training run with its own tasks; else NULL. */
void mo_training_json_write(struct mo_text *text, const struct mo_training_status *status,
                            enum mo_job_kind population_kind, const struct mo_environment *tasks,
                            const struct mo_live *live);
/* Writes a training run as an item of the list of jobs. status: struct mo_training_status. */
void mo_training_json_job(struct mo_text *text, const void *status, const struct mo_live *live);

/* Writes a campaign and leaves the object open. live: its current live state. */
void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_live *live);
/* Writes a campaign as an item of the list of jobs. status: struct mo_campaign_status. */
void mo_campaign_json_job(struct mo_text *text, const void *status, const struct mo_live *live);

/* How a phylogeny is written for programs that support only trees. */
struct mo_phylogeny_shape {
  bool first_parent;   /* only the first of two parents is written */
  int64_t root;        /* the id of a root that designs without parents descend from; −1: none */
  uint32_t n_measures; /* further columns, of a study */
};
/* Writes a line of the phylogeny in the ALife data standard. end: the last generation to report; a
 * design that died later is written as alive. */
void mo_campaign_csv_design(struct mo_text *text, const struct mo_campaign_design *row, int64_t end,
                            const struct mo_phylogeny_shape *shape);

#endif
