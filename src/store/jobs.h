/* jobs.h: rows and pages of jobs of every kind. Only for this room. */
#ifndef MORPHO_STORE_JOBS_H
#define MORPHO_STORE_JOBS_H

#include "store/sql.h"
#include "store/store.h"

/* Columns of j jobs, e evaluations, r runs, t training runs, m campaigns, a atlases, k
 * certificates, c the controller, x the result, p physics, s the named set. */
#define MO_JOB_COLUMNS(X)                                                                          \
  X(ID, "j.id")                                                                                    \
  X(VERSION, "j.version")                                                                          \
  X(KIND, "j.kind")                                                                                \
  X(STATE, "j.state")                                                                              \
  X(PRIORITY, "j.priority")                                                                        \
  X(WEIGHT, "j.weight")                                                                            \
  X(BACK_END, "j.back_end")                                                                        \
  X(LABEL, "j.label")                                                                              \
  X(EXPERIMENT, "j.experiment")                                                                    \
  X(NOTE, "j.note")                                                                                \
  X(ARCHIVED_US, "j.archived_us")                                                                  \
  X(WORKER_S, "j.worker_s")                                                                        \
  X(DEVICE_S, "j.device_s")                                                                        \
  X(SUBMITTED_BY, "j.submitted_by")                                                                \
  X(CREATED_US, "j.created_us")                                                                    \
  X(STARTED_US, "j.started_us")                                                                    \
  X(FINISHED_US, "j.finished_us")                                                                  \
  X(ATTEMPTS, "j.attempts")                                                                        \
  X(ERROR, "j.error")                                                                              \
  X(ERROR_TEXT, "j.error_text")                                                                    \
  X(CONTROLLER, "c.sha256")                                                                        \
  X(CONTROLLER_NAME,                                                                               \
    "coalesce(e.controller_name,r.controller_name,a.controller_name,k.controller_name)")           \
  X(ENVIRONMENT_SET, "coalesce(e.suite,s.name)")                                                   \
  X(N_ENVIRONMENTS,                                                                                \
    "coalesce(e.n_environments,m.n_environments,a.n_environments,k.n_environments)")               \
  X(N_DESIGNS, "coalesce(e.n_designs,t.n_designs,k.n_designs)")                                    \
  X(N_SKIPPED, "e.n_skipped")                                                                      \
  X(BEST, "e.best")                                                                                \
  X(N_DISPLACED, "e.n_displaced")                                                                  \
  X(MEASURES, "coalesce(e.measures,a.measures)")                                                   \
  X(TOLERANCE, "e.tolerance")                                                                      \
  X(RANDOM_SEED, "e.random_seed")                                                                  \
  X(RANDOM_FIRST, "e.random_first")                                                                \
  X(N_WAITING, "e.n_waiting")                                                                      \
  X(PHYSICS, "p.encoding")                                                                         \
  X(VERIFY, "e.verify")                                                                            \
  X(RECORD, "e.record")                                                                            \
  X(RECORD_STRIDE, "e.record_stride")                                                              \
  X(RECORDED_BYTES, "e.recorded_bytes")                                                            \
  X(RECORDINGS_REMOVED_US, "e.recordings_removed_us")                                              \
  X(DONE, "e.done")                                                                                \
  X(CACHED, "e.cached")                                                                            \
  X(DIVERGED, "e.diverged")                                                                        \
  X(CUT, "e.cut")                                                                                  \
  X(SETTINGS, "coalesce(r.settings,k.settings)")                                                   \
  X(NAME, "coalesce(r.name,a.name)")                                                               \
  X(RESULT, "x.sha256")                                                                            \
  X(STEP, "t.step")                                                                                \
  X(POPULATION, "coalesce(t.population,k.population)")                                             \
  X(GENERATIONS, "m.generations")                                                                  \
  X(GENERATION, "m.generation")                                                                    \
  X(PRESET, "m.preset")                                                                            \
  X(N_LISTED, "m.n_listed")                                                                        \
  X(INITIAL_CAMPAIGN, "m.initial_campaign")                                                        \
  X(REPLICATES_OF, "m.replicates_of")                                                              \
  X(REPLICATE, "m.replicate")                                                                      \
  X(REPLICATES, "m.replicates")                                                                    \
  X(N_BORN, "m.n_designs")                                                                         \
  X(BEST_SCORE, "m.best_score")                                                                    \
  X(DIVERSITY_MAX, "m.diversity_max")                                                              \
  X(ENDED, "m.ended")                                                                              \
  X(SCORED, "CASE m.scored_generation WHEN m.generation+1 THEN m.scored ELSE 0 END")               \
  X(VOXELS, "a.voxels")                                                                            \
  X(ORIENTATIONS, "a.orientations")                                                                \
  X(BODIES_TOTAL, "a.bodies_total")                                                                \
  X(BODIES_DONE, "a.bodies_done")                                                                  \
  X(ROLLOUTS_DONE, "coalesce(a.rollouts_done,k.rollouts_done)")                                    \
  X(TAKEN, "k.taken")                                                                              \
  X(N_TRIALS, "k.n_trials")                                                                        \
  X(N_ROLLOUTS, "k.n_rollouts")                                                                    \
  X(TRIALS_DONE, "k.trials_done")
#define MO_COLUMN(name, sql) MO_COLUMN_##name,
enum mo_job_column { MO_COLUMN_ZERO = 0, MO_JOB_COLUMNS(MO_COLUMN) };
#undef MO_COLUMN

/* Steps to the row of a job. kind −1: any kind. MO_ERR_NOT_FOUND. */
int mo_job_row(struct mo_connection *connection, int64_t id, int kind, sqlite3_stmt **row);
/* Reads a job and, into `record` (nullable), the struct mo_training_record, mo_campaign_record,
 * mo_atlas_record or mo_certificate_record of its kind. MO_ERR_CORRUPT: the row cannot be decoded.
 */
int mo_job_read(sqlite3_stmt *row, struct mo_job *job, void *record);

/* Reads settings from a column into the record of their kind. MO_ERR_CORRUPT. */
int mo_column_settings(sqlite3_stmt *row, int column, enum mo_job_kind kind, void *record);

/* Reads a page of jobs, newest first, in one transaction: `load` reads each into its
 * place. A query with a group has the kind of campaigns. */
int64_t mo_read_jobs(struct mo_store *store, const struct mo_job_query *query, size_t limit,
                     int (*load)(struct mo_connection *reader, int64_t id, void *status),
                     void *statuses, size_t status_size);

#endif
