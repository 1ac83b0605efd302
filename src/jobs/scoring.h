/* scoring.h: scores designs in environments under one controller, as blocks of one design and up to
 * MO_BLOCK_LANES environments. Evaluations, campaigns and validations use it. */
#ifndef MORPHO_JOBS_SCORING_H
#define MORPHO_JOBS_SCORING_H

#include "jobs/state.h"

/* A cell is one design in one environment. */
enum mo_cell {
  MO_CELL_TO_DO = 0,
  MO_CELL_DEFERRED, /* another job is computing it */
  MO_CELL_IN_FLIGHT,
  MO_CELL_DONE,
  MO_CELL_LATER /* closed until mo_grid_open */
};

/* Designs × environments, and the state of each cell. */
struct mo_grid {
  struct mo_block block;                     /* shared by all blocks */
  const struct mo_bits *genotypes;           /* (n_designs) placed */
  const struct mo_environment *environments; /* (n_sets, n_environments) */
  uint32_t n_designs, n_environments;
  uint32_t n_sets; /* design d has the environments of set d / (n_designs / n_sets); 0: one set */
  uint8_t *cells;  /* (n_designs, n_environments) enum mo_cell */
  uint8_t *left;   /* (n_designs) cells that are not done */
  uint32_t cursor; /* no earlier design has an open cell, except the designs in `again` */
  /* A ring buffer of the designs whose cells mo_grid_open opened. NULL: mo_grid_open is never
   * called. */
  uint32_t *again, first_again, n_again;
};
/* Returns the fields that all blocks of a job share, except its controller, and the share and
 * `cancel`, which mo_score sets. */
struct mo_block mo_block_of(const struct mo_jobs *jobs, const struct mo_job *job);
/* Allocates the cells of a grid whose other fields are filled in. MO_ERR_NO_MEMORY. */
int mo_grid_create(struct mo_grid *grid);
void mo_grid_free(struct mo_grid *grid);
static inline uint8_t *mo_grid_cell(const struct mo_grid *grid, uint32_t design, uint32_t k)
{
  return &grid->cells[(size_t)design * grid->n_environments + k];
}
static inline bool mo_grid_is_open(const struct mo_grid *grid, uint32_t design, uint32_t k)
{
  return *mo_grid_cell(grid, design, k) <= MO_CELL_DEFERRED;
}
/* Closes the open cells of all designs, starting at `first`. Call it once. MO_ERR_NO_MEMORY. */
int mo_grid_close(struct mo_grid *grid, uint32_t first);
/* Opens those of n cells of a design that are closed; they are scored before other open cells. */
void mo_grid_open(struct mo_grid *grid, uint32_t design, const uint8_t *cells, uint32_t n);
/* Marks a cell as done. Returns whether its design is done. */
bool mo_grid_finish(struct mo_grid *grid, uint32_t design, uint32_t k);
void mo_grid_finish_design(struct mo_grid *grid, uint32_t design);

/* Blocks that have come back, for the thread that submitted them. */
struct mo_inbox {
  pthread_mutex_t *mutex;
  pthread_cond_t *news;
  struct mo_flight *finished; /* under the mutex */
};

/* One block in the back end (malloc). */
struct mo_flight {
  struct mo_block block;
  struct mo_window *window;
  uint32_t design;
  uint8_t places[MO_BLOCK_LANES]; /* its environments */
  struct mo_flight *next;         /* in the list of finished flights */
};

/* The blocks of one grid in the back end. */
struct mo_window {
  struct mo_compute *compute;
  struct mo_inbox *inbox;
  struct mo_grid *grid;     /* created */
  uint32_t most, n_flights; /* number of blocks that may be in flight, and that are */
  size_t flight_bytes;      /* size of a struct that begins with struct mo_flight */
  void *context;
  /* All nullable. look_up: finishes the known cells of a design before its cells are taken. joins:
   * returns whether a cell may join a block now; otherwise it is deferred. prepare: completes a
   * block. */
  int (*look_up)(void *context, uint32_t design);
  int (*joins)(void *context, struct mo_flight *flight, uint32_t k);
  int (*prepare)(void *context, struct mo_flight *flight);
};
/* Cuts the next block and submits it. If a block is rejected, it comes back at once with the error.
 * Returns 1, or 0 if the window is full, no cell is open, or *budget designs were visited, or an
 * error code from the functions above, or MO_ERR_NO_MEMORY. */
int mo_window_launch(struct mo_window *window, unsigned *budget);
/* Takes a finished block out of the window, and marks its cells as done. *is_done: its design is
 * done. Returns the error of the block and describes it in `text` for its job; the cells then stay
 * in flight. A diverged rollout has the loss +infinity. NaN and −infinity must not be stored. No
 * input should produce these, so they are an error. */
int mo_window_take(struct mo_window *window, const struct mo_flight *flight, bool *is_done,
                   char text[128]);

/* Scores all open cells of a grid, for a job with its own thread. The back end holds two blocks per
 * worker, or some thousands per device. */
struct mo_scoring {
  struct mo_runner *runner;
  struct mo_grid grid; /* created; known cells are done */
  void *context;
  /* Takes the outcomes of a block without an error. is_done: the design has no cell left. */
  void (*take)(void *context, const struct mo_flight *flight, bool is_done);
  /* Saves the outcomes that were taken; nullable. Called when blocks have arrived, or after a
   * second if they arrive in bursts from devices and other machines. The caller must save the rest
   * at the end. */
  int (*save)(void *context);
  const uint32_t *n_unsaved;
  bool measures; /* all rollouts are measured: block.measuring->values of each flight */
  void (*show)(void *context, double rollouts_per_s); /* nullable; 0: unknown */
};
/* Leaves no block in flight, even after an error; the runner then has the error's text.
 * MO_ERR_CANCELLED: a request arrived. */
int mo_score(struct mo_scoring *scoring);

#endif
