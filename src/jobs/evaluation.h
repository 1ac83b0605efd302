/* evaluation.h: the state of the running evaluations. Only for the files evaluation*.c.
 *
 * One thread serves all evaluations and owns everything here; other threads only add to the inbox.
 *
 * - active: a running job and the grid of its cells
 * - rollout: one (genotype, controller, physics, environment) that is being computed or waits for
 *   its commit; other jobs that need it defer the cell until the store has the score
 * - pending: the data that the next save will write; at most one save is in progress */
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
  struct mo_window window;  /* over the grid */
  struct mo_best *race;     /* NULL: all rollouts are computed */
  uint64_t n_asked;         /* rollouts of the current round of the race that are not done */
  struct mo_climbs *climbs; /* evaluation_climb.c; NULL: no tolerance was requested */
  /* done has cut: rollouts that a race or a climb does not need. */
  uint64_t total, done, cached, diverged, cut;
  /* Counts reported before this claim of a job that shares rollouts. The job finds its cells in the
   * store again, in any order. Until it has caught up, the reported counts must not decrease. */
  uint64_t done_before, cached_before, diverged_before, cut_before;
  uint64_t own_before; /* rollouts computed before this claim; found in the store, but not counted
                          as cached */
  bool private_runs;   /* a verify or recording job: shares no rollouts and skips look-ups */
  bool has_deferred;   /* cells that are revisited after the next save */
  bool detached; /* cancelled, paused or failed: makes no new blocks; finished ones still count */
  volatile int cancel; /* set when detached: ends its blocks */
  bool failing;        /* detached, and its error is not committed yet */
  bool finishing;      /* a save contains its end */
  bool changed;        /* counts differ from the saved ones */
  int64_t last_event_us;
  uint64_t computed;   /* rollouts, since this claim */
  struct mo_pace pace; /* rate of `computed` */
  int64_t shown_us;    /* time of the last live figures; 0: none */
  int64_t until_us;    /* after an error: the job is not claimed again before this time */
  uint32_t references; /* held by saves */
  struct mo_active *next;
};

struct mo_rollout {
  int64_t key[5];          /* genotype, environment, controller, physics, the class of its jobs */
  struct mo_rollout *next; /* in its bucket */
  struct mo_rollout *next_save; /* in pending or in the current save */
};

struct mo_rows { /* a growing array */
  void *rows;
  size_t n, room;
};
/* The rows that one save writes. */
struct mo_pending {
  struct mo_rows blocks, trajectories, designs, updates; /* each update refers to its active job */
  struct mo_rollout *rollouts;                           /* to forget after the commit */
  struct mo_save save; /* points to the rows while the save is in progress */
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

  uint64_t seen, seen_requests; /* last seen values of runners->look and ->requests */
  struct mo_active *actives;
  uint64_t recording_bytes; /* memory of recordings in flight */
  struct mo_rollout *buckets[MO_ROLLOUT_BUCKETS];
  struct mo_pending pending, saving;
  bool is_saving;
  int64_t retry_save_us; /* time of the next attempt after the disk was full */
  bool broken;           /* the store is lost, so no more work is started */
  bool look_again;       /* there may be queued jobs */
  bool review_again;     /* a job could not be read */
  bool visit_again;      /* rollouts were forgotten, so deferred cells can be looked up again */
  pthread_t drawer;
  bool draws;         /* a drawing thread exists */
  int64_t unstored;   /* job that the drawing thread cannot store; 0: none; runners' mutex */
  int unstored_error; /* the reason */
};

/* ---- evaluation_draw.c ---- */
/* Starts the thread that draws the designs of evaluations of random bodies. It stops with the
 * runners. */
int mo_drawer_start(struct mo_evaluations *all);
void mo_drawer_join(struct mo_evaluations *all);
/* Returns whether designs of a queued evaluation cannot be stored, and sets the reason. */
bool mo_drawer_reason(struct mo_evaluations *all, int64_t id, char reason[160]);

/* ---- evaluation_save.c ---- */
/* Adds a row of `size` bytes to one of the arrays in all->pending. Returns the row, which is valid
 * until the next one is added, or NULL if memory runs out. */
void *mo_pending_add(struct mo_evaluations *all, struct mo_rows *rows, const void *row,
                     size_t size);
/* Returns the update, which is valid until the next one is added, or NULL. */
struct mo_job_update *mo_pending_update(struct mo_evaluations *all, struct mo_active *active,
                                        enum mo_job_step step, int error, const char *text);
void mo_pending_touch(struct mo_evaluations *all); /* marks that something must be saved */
void mo_pending_clear(struct mo_pending *pending); /* empties it, but keeps its arrays */
void mo_pending_free(struct mo_pending *pending);
/* Starts a save when one is due, or at once. Returns the time when the next one is due, or
 * INT64_MAX if there is none. */
int64_t mo_saver_run(struct mo_evaluations *all, bool at_once);
bool mo_saver_idle(const struct mo_evaluations *all); /* nothing pending or in progress */
/* Returns whether unsaved recordings take so much memory that no new recording may start. */
bool mo_saver_is_full(const struct mo_evaluations *all);
/* Returns whether the store is so far behind that no new work may start. */
bool mo_saver_is_behind(const struct mo_evaluations *all);

/* ---- evaluation_race.c ---- */
/* Begins the race, with its grid, of a loaded job that requested only its best designs.
 * MO_ERR_NO_MEMORY. */
int mo_active_race(struct mo_active *active);
/* Begins the race's next round when the previous one is done. Returns whether there is one. */
bool mo_active_race_on(struct mo_active *active);
/* Estimates the rollouts that a job still needs; `done` are done. < 0: unknown, because its race
 * has just begun. */
double mo_active_left(const struct mo_active *active, uint64_t done);

/* ---- evaluation_blocks.c ---- */
/* Opens the window of a loaded job. Its blocks return through mo_active_take_back. */
void mo_active_open_window(struct mo_active *active);
/* Stops making new blocks of the job, and cancels the blocks in flight. */
void mo_active_detach(struct mo_active *active);
/* Requeues the job with one more attempt, or pauses it on MO_ERR_DEVICE. */
void mo_active_fail(struct mo_evaluations *all, struct mo_active *active, int error,
                    const char *text);
/* Stores the results of a finished block and frees it. */
void mo_active_take_back(struct mo_evaluations *all, struct mo_flight *flight);
void mo_rollout_forget(struct mo_evaluations *all, struct mo_rollout *rollout);

#endif
