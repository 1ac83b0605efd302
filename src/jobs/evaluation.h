/* evaluation.h: the state of the running evaluations. Only for the files evaluation*.c.
 *
 * One thread serves all evaluations and owns what is here; other threads only add to the inbox.
 *
 * - active: a running job and the grid of its cells
 * - rollout: one (genotype, controller, physics, environment) that is being computed or waits for
 *   its commit; other jobs that need it defer the cell until the store has the score
 * - pending: what the next save will write; at most one save is in progress */
#ifndef MORPHO_JOBS_EVALUATION_H
#define MORPHO_JOBS_EVALUATION_H

#include <morpho/evolution.h>

#include "jobs/controllers.h"
#include "jobs/pace.h"
#include "jobs/scoring.h"
#include "store/runner.h"

#define MO_ROLLOUT_BUCKETS 131072

struct mo_active {
  struct mo_evaluations *all;
  struct mo_work *work; /* NULL: could not be loaded */
  int64_t id;
  enum mo_urgency priority;
  struct mo_loaded *controller;
  struct mo_grid grid;
  struct mo_window window; /* of the grid */
  struct mo_best *race;    /* NULL: all rollouts are computed */
  uint64_t n_asked;        /* rollouts of the race's round that are not done */
  /* done has cut: rollouts that a race does not need. */
  uint64_t total, done, cached, diverged, cut;
  /* Counts reported before this claim of a job that shares rollouts. The job finds its cells in the
   * store again, in any order; meanwhile the reported counts never decrease. */
  uint64_t done_before, cached_before, diverged_before, cut_before;
  uint64_t own_before; /* rollouts computed before this claim; found in the store, but not counted
                          as cached */
  bool private_runs;   /* verify or recording: shares no rollouts and skips look-ups */
  bool has_deferred;   /* cells; they are visited again after the next save */
  bool detached; /* cancelled, paused or failed: makes no new blocks; finished ones still count */
  volatile int cancel; /* set when detached: ends its blocks */
  bool failing;        /* detached, and its error is not committed yet */
  bool finishing;      /* a save contains its end */
  bool changed;        /* counts differ from those last saved */
  int64_t last_event_us;
  uint64_t computed;   /* rollouts, since this claim */
  struct mo_pace pace; /* of `computed` */
  int64_t shown_us;    /* time of the last live figures; 0: none */
  int64_t until_us;    /* after an error: the job is not claimed again before */
  uint32_t references; /* from saves */
  struct mo_active *next;
};

struct mo_rollout {
  int64_t key[5];          /* genotype, environment, controller, physics, the class of its jobs */
  struct mo_rollout *next; /* in its bucket */
  struct mo_rollout *next_save; /* in pending or in the current save */
};

/* A growing array. */
struct mo_rows {
  void *rows;
  size_t n, room;
};
/* What one save writes. */
struct mo_pending {
  struct mo_rows blocks, trajectories, designs, updates; /* an update refers to its active */
  struct mo_rollout *rollouts;                           /* to forget after the commit */
  struct mo_save save; /* points to the rows, while it is in progress */
  uint64_t n_losses, recorded_bytes;
  int64_t since_us; /* time of the first entry; 0: empty */
  bool urgent;
};

struct mo_evaluations {
  struct mo_jobs *jobs;
  struct mo_runners *runners;
  /* The inbox, under the mutex of the runners. */
  struct mo_inbox inbox;
  bool saved;
  int save_error;

  uint64_t seen, seen_requests; /* of runners->look and ->requests */
  struct mo_active *actives;
  uint64_t recording_bytes; /* of recordings in flight */
  struct mo_rollout *buckets[MO_ROLLOUT_BUCKETS];
  struct mo_pending pending, saving;
  bool is_saving;
  int64_t retry_save_us; /* time of the next try after lack of space */
  bool broken;           /* the store is lost: no more work is started */
  bool look_again;       /* there may be queued jobs */
  bool review_again;     /* a job could not be read */
  bool visit_again;      /* rollouts were forgotten: deferred cells can be looked up */
  pthread_t drawer;
  bool draws;         /* there is a drawer */
  int64_t unstored;   /* of it, if its designs cannot be stored; under the runners' mutex */
  int unstored_error; /* why */
};

/* ---- evaluation_draw.c ---- */
/* Starts the thread that draws the designs of evaluations of random bodies. It ends with a stop of
 * the runners. */
int mo_drawer_start(struct mo_evaluations *all);
void mo_drawer_join(struct mo_evaluations *all);
/* Says why designs of a queued evaluation cannot be stored. False: they can, as far as is known. */
bool mo_drawer_reason(struct mo_evaluations *all, int64_t id, char reason[160]);

/* ---- evaluation_save.c ---- */
/* Adds a row of `size` bytes to one of the arrays of all->pending. Returns the row there, valid
 * until the next one, or NULL: no memory. */
void *mo_pending_add(struct mo_evaluations *all, struct mo_rows *rows, const void *row,
                     size_t size);
/* Returns the update, valid until the next one, or NULL. */
struct mo_job_update *mo_pending_update(struct mo_evaluations *all, struct mo_active *active,
                                        enum mo_job_step step, int error, const char *text);
void mo_pending_touch(struct mo_evaluations *all); /* marks that something must be saved */
void mo_pending_clear(struct mo_pending *pending); /* empties it, but keeps its arrays */
void mo_pending_free(struct mo_pending *pending);
/* Starts a save when one is due, or at once. Returns the time when the next one is due, INT64_MAX
 * for none. */
int64_t mo_saver_run(struct mo_evaluations *all, bool at_once);
bool mo_saver_idle(const struct mo_evaluations *all); /* nothing pending or in progress */
/* Returns whether unsaved recordings take so much memory that no new recording may start. */
bool mo_saver_is_full(const struct mo_evaluations *all);
/* Returns whether the store lags so far that no new work may start. */
bool mo_saver_is_behind(const struct mo_evaluations *all);

/* ---- evaluation_race.c ---- */
/* Begins the race of a loaded job that asks for its best designs, with its grid. MO_ERR_NO_MEMORY.
 */
int mo_active_race(struct mo_active *active);
/* Begins the race's next round when the one before is done. Returns whether there is one. */
bool mo_active_race_on(struct mo_active *active);
/* Estimates the rollouts that a job has left, of which it has done so many; < 0: unknown, as its
 * race has just begun. */
double mo_active_left(const struct mo_active *active, uint64_t done);

/* ---- evaluation_blocks.c ---- */
/* Opens the window of a loaded job: its blocks come to mo_active_take_back. */
void mo_active_open_window(struct mo_active *active);
/* Makes no new blocks of the job, and ends those in flight. */
void mo_active_detach(struct mo_active *active);
/* Requeues the job with one more attempt; with MO_ERR_DEVICE, pauses it. */
void mo_active_fail(struct mo_evaluations *all, struct mo_active *active, int error,
                    const char *text);
/* Stores the results of a finished block and frees it. */
void mo_active_take_back(struct mo_evaluations *all, struct mo_flight *flight);
void mo_rollout_forget(struct mo_evaluations *all, struct mo_rollout *rollout);

#endif
