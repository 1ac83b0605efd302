/* scoring.c: scores designs in environments under one controller.
 *
 * A grid is cut, in order, into blocks of one design and up to MO_BLOCK_LANES environments. Before
 * that, cells with stored results are marked as done. The thread that submits blocks takes them
 * back from an inbox, stores their results, and submits more, so that the back end always holds a
 * window of blocks. A crash loses the blocks in flight and the results that wait for their
 * commit. */
#include "jobs/scoring.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"

#define NOT_A_LOSS     MO_ERR_RANGE /* a code that back ends do not return */
#define RATE_AFTER_US  INT64_C(500000)
#define SAVED_AFTER_US INT64_C(1000000)

/* ---- grids ---- */

struct mo_block mo_block_of(const struct mo_jobs *jobs, const struct mo_job *job)
{
  return (struct mo_block){.lattice = jobs->lattice,
                           .physics = job->physics,
                           .precision = job->precision,
                           .urgency = mo_back_end_urgency(jobs, job),
                           .back_end = job->back_end,
                           .tag = job->id};
}

int mo_grid_create(struct mo_grid *grid)
{
  grid->cells = calloc((size_t)grid->n_designs * grid->n_environments + 1, 1);
  grid->left = malloc((size_t)grid->n_designs + 1);
  if (grid->cells == NULL || grid->left == NULL)
    return MO_ERR_NO_MEMORY;
  memset(grid->left, (int)grid->n_environments, grid->n_designs);
  return MO_OK;
}

void mo_grid_free(struct mo_grid *grid)
{
  free(grid->cells);
  free(grid->left);
  free(grid->again);
  grid->cells = grid->left = NULL;
  grid->again = NULL;
}

int mo_grid_close(struct mo_grid *grid, uint32_t first)
{
  grid->again = malloc(((size_t)grid->n_designs + 1) * sizeof(*grid->again));
  if (grid->again == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = (size_t)first * grid->n_environments;
       i < (size_t)grid->n_designs * grid->n_environments; i++)
    if (grid->cells[i] == MO_CELL_TO_DO)
      grid->cells[i] = MO_CELL_LATER;
  return MO_OK;
}

void mo_grid_open(struct mo_grid *grid, uint32_t design, const uint8_t *cells, uint32_t n)
{
  bool any = false;
  for (uint32_t i = 0; i < n; i++)
    if (*mo_grid_cell(grid, design, cells[i]) == MO_CELL_LATER) {
      *mo_grid_cell(grid, design, cells[i]) = MO_CELL_TO_DO;
      any = true;
    }
  if (any)
    grid->again[(grid->first_again + grid->n_again++) % (grid->n_designs + 1)] = design;
}

bool mo_grid_finish(struct mo_grid *grid, uint32_t design, uint32_t k)
{
  *mo_grid_cell(grid, design, k) = MO_CELL_DONE;
  return --grid->left[design] == 0;
}

void mo_grid_finish_design(struct mo_grid *grid, uint32_t design)
{
  memset(mo_grid_cell(grid, design, 0), MO_CELL_DONE, grid->n_environments);
  grid->left[design] = 0;
}

static bool has_open(const struct mo_grid *grid, uint32_t design)
{
  for (uint32_t k = 0; k < grid->n_environments; k++)
    if (mo_grid_is_open(grid, design, k))
      return true;
  return false;
}

/* Moves past the design that `seek` found. The ring may contain the first design twice, because a
 * design is passed only when it has no open cell, but may be reopened after that. */
static void pass(struct mo_grid *grid)
{
  if (grid->n_again > 0) {
    grid->first_again = (grid->first_again + 1) % (grid->n_designs + 1);
    grid->n_again--;
  } else {
    grid->cursor++;
  }
}

/* Finds the next design with an open cell. Reopened designs come first. Returns false if there is
 * none. */
static bool seek(struct mo_grid *grid, uint32_t *design)
{
  while (grid->n_again > 0 || grid->cursor < grid->n_designs) {
    *design = grid->n_again > 0 ? grid->again[grid->first_again] : grid->cursor;
    if (has_open(grid, *design))
      return true;
    pass(grid);
  }
  return false;
}

/* ---- blocks ---- */

static void arrive(struct mo_block *block, void *context)
{
  struct mo_flight *flight = context;
  struct mo_inbox *inbox = flight->window->inbox;
  (void)block;
  MO_GUARD(inbox->mutex);
  flight->next = inbox->finished;
  inbox->finished = flight;
  pthread_cond_broadcast(inbox->news);
}

static struct mo_flight *begin(struct mo_window *window, uint32_t design)
{
  struct mo_grid *grid = window->grid;
  struct mo_flight *flight = calloc(1, window->flight_bytes);
  if (flight == NULL)
    return NULL;
  flight->block = grid->block;
  flight->block.genotype = grid->genotypes[design].words;
  flight->block.done = arrive;
  flight->block.context = flight;
  flight->window = window;
  flight->design = design;
  return flight;
}

/* Returns the environments of a design. */
static const struct mo_environment *environments_of(const struct mo_grid *grid, uint32_t design)
{
  const uint32_t set = grid->n_sets > 1 ? design / (grid->n_designs / grid->n_sets) : 0;
  return &grid->environments[(size_t)set * grid->n_environments];
}

/* Adds the open cells of the design that may join, until the block is full. */
static int gather(struct mo_window *window, struct mo_flight *flight)
{
  struct mo_grid *grid = window->grid;
  const struct mo_environment *environments = environments_of(grid, flight->design);
  struct mo_block *block = &flight->block;
  int joins = 1;
  for (uint32_t k = 0; k < grid->n_environments && block->n_environments < MO_BLOCK_LANES; k++) {
    if (!mo_grid_is_open(grid, flight->design, k))
      continue;
    if (window->joins != NULL && (joins = window->joins(window->context, flight, k)) < 0)
      return joins;
    *mo_grid_cell(grid, flight->design, k) = joins > 0 ? MO_CELL_IN_FLIGHT : MO_CELL_DEFERRED;
    if (joins > 0) {
      flight->places[block->n_environments] = (uint8_t)k;
      block->environments[block->n_environments++] = &environments[k];
    }
  }
  return MO_OK;
}

/* Submits a block of a design. Returns 1, or 0 if all its cells are done or deferred. */
static int launch(struct mo_window *window, uint32_t design)
{
  int error = window->look_up != NULL ? window->look_up(window->context, design) : MO_OK;
  struct mo_flight *flight = error == MO_OK ? begin(window, design) : NULL;
  if (flight == NULL)
    return error != MO_OK ? error : MO_ERR_NO_MEMORY;
  error = gather(window, flight);
  if (flight->block.n_environments == 0) {
    free(flight);
    return error;
  }
  window->n_flights++;
  if (window->prepare != NULL)
    error = window->prepare(window->context, flight);
  if (error == MO_OK)
    error = mo_compute_submit(window->compute, &flight->block);
  if (error != MO_OK) {
    flight->block.status = error;
    arrive(&flight->block, flight);
  }
  return 1;
}

int mo_window_launch(struct mo_window *window, unsigned *budget)
{
  uint32_t design;
  int launched = 0;
  while (launched == 0 && window->n_flights<window->most && * budget> 0 &&
         seek(window->grid, &design)) {
    launched = launch(window, design);
    if (launched == 0) /* the rest of the design is deferred */
      pass(window->grid);
    (*budget)--;
  }
  return launched;
}

int mo_window_take(struct mo_window *window, const struct mo_flight *flight, bool *is_done,
                   char text[128])
{
  const struct mo_block *block = &flight->block;
  int error = mo_back_end_error(block->back_end, block->status);
  *is_done = false;
  window->n_flights--;
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++)
    error = block->outcomes[i].loss > -INFINITY ? MO_OK : NOT_A_LOSS;
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++)
    *is_done = mo_grid_finish(window->grid, flight->design, flight->places[i]);
  /* Passed on unchanged, this error would end a campaign. */
  if (block->status == MO_ERR_EXHAUSTED) {
    char robot[MO_SMALL_VOXELS / 4 + 3] = "";
    (void)mo_genotype_robot(block->lattice->workspace, block->genotype, robot);
    error = NOT_A_LOSS;
    snprintf(text, 128, "workers crash repeatedly while they compute design %.64s", robot);
  } else if (error == NOT_A_LOSS)
    snprintf(text, 128, "the rollout runner returned a loss that is not a number");
  else if (error != MO_OK && error != MO_ERR_CANCELLED)
    snprintf(text, 128, "the rollout runner failed: %s", mo_error_text(error));
  return error;
}

/* ---- a whole grid ---- */

struct run {
  struct mo_scoring *scoring;
  struct mo_window window;
  int64_t begin_us;
  int64_t unsaved_us; /* time of the oldest unsaved result; 0: none */
  uint64_t computed;
  pthread_mutex_t mutex;
  pthread_cond_t news;
  struct mo_inbox inbox;
};

/* A flight whose rollouts are measured. All measures are computed, as for evaluations. */
struct measured_flight {
  struct mo_flight flight;
  struct mo_measuring measuring;
  double values[MO_BLOCK_LANES][MO_MEASURES];
};

static int prepare_measures(void *context, struct mo_flight *flight)
{
  struct measured_flight *measured = (struct measured_flight *)flight;
  (void)context;
  measured->measuring = (struct mo_measuring){.set = MO_MEASURES_ALL, .values = measured->values};
  flight->block.measuring = &measured->measuring;
  return MO_OK;
}

static int fill(struct run *run)
{
  struct mo_compute *compute = run->window.compute;
  unsigned budget = UINT_MAX;
  int launched = 1;
  /* The window grows and shrinks as remote takers connect and disconnect. */
  run->window.most =
      mo_back_end_window(run->scoring->runner->jobs, run->scoring->grid.block.back_end);
  mo_compute_begin_blocks(compute);
  while (launched > 0)
    launched = mo_window_launch(&run->window, &budget);
  mo_compute_end_blocks(compute);
  return launched;
}

static int take_one(struct run *run, struct mo_flight *flight)
{
  struct mo_scoring *scoring = run->scoring;
  bool is_done;
  const int error = mo_window_take(&run->window, flight, &is_done, scoring->runner->text);
  if (error == MO_OK) {
    run->computed += flight->block.n_environments;
    scoring->take(scoring->context, flight, is_done);
  }
  free(flight);
  return error;
}

/* Returns whether results arrive in bursts: a device, or a machine on a slow connection, returns
 * many blocks at once. */
static bool arrive_in_bursts(const struct run *run)
{
  const enum mo_back_end back_end = run->scoring->grid.block.back_end;
  return back_end == MO_ON_DEVICE || mo_compute_remote_wanted(run->window.compute, back_end) > 0;
}

/* Returns whether results must be saved now. Bursts, which arrive within fractions of a second,
 * wait for a second, so a generation that takes less time is saved only by its commit. */
static bool saves_later(const struct run *run)
{
  return run->unsaved_us != 0 && arrive_in_bursts(run) &&
         mo_clock_us() < run->unsaved_us + SAVED_AFTER_US;
}

/* Waits for a block, or until results have to be saved, and takes the finished ones. If there is a
 * request, all blocks end soon. */
static int take_all(struct run *run)
{
  const bool later = saves_later(run);
  bool in_time = true;
  int error = MO_OK;
  pthread_mutex_lock(&run->mutex);
  while (run->inbox.finished == NULL && in_time)
    if (later)
      in_time = mo_wait_until(&run->news, &run->mutex, run->unsaved_us + SAVED_AFTER_US);
    else
      pthread_cond_wait(&run->news, &run->mutex);
  struct mo_flight *flight = run->inbox.finished;
  run->inbox.finished = NULL;
  pthread_mutex_unlock(&run->mutex);
  while (flight != NULL) {
    struct mo_flight *next = flight->next;
    const int taken = take_one(run, flight);
    if (error == MO_OK || error == MO_ERR_CANCELLED)
      error = taken != MO_OK ? taken : error;
    flight = next;
  }
  return error;
}

/* Saves the results that arrived. */
static int save_arrived(struct run *run)
{
  const struct mo_scoring *scoring = run->scoring;
  if (scoring->save == NULL || *scoring->n_unsaved == 0)
    return MO_OK;
  if (run->unsaved_us == 0)
    run->unsaved_us = mo_clock_us();
  if (saves_later(run))
    return MO_OK;
  run->unsaved_us = 0;
  return scoring->save(scoring->context);
}

static void show(const struct run *run)
{
  const double passed_s = (double)(mo_clock_us() - run->begin_us) * 1e-6;
  if (run->scoring->show != NULL)
    run->scoring->show(run->scoring->context,
                       passed_s >= 1e-6 * RATE_AFTER_US ? (double)run->computed / passed_s : 0);
}

static int compute(struct run *run)
{
  int error = MO_OK;
  for (;;) {
    int taken;
    if (error == MO_OK && mo_runner_is_interrupted(run->scoring->runner))
      error = MO_ERR_CANCELLED;
    if (error == MO_OK)
      error = fill(run);
    if (run->window.n_flights == 0)
      return error;
    if (error == MO_OK)
      error = save_arrived(run);
    taken = take_all(run);
    if (error == MO_OK)
      error = taken;
    show(run);
  }
}

int mo_score(struct mo_scoring *scoring)
{
  struct mo_runner *runner = scoring->runner;
  struct run run = {.scoring = scoring,
                    .window = {.compute = runner->jobs->compute,
                               .inbox = &run.inbox,
                               .grid = &scoring->grid,
                               .flight_bytes = sizeof(struct mo_flight)},
                    .begin_us = mo_clock_us(),
                    .mutex = PTHREAD_MUTEX_INITIALIZER,
                    .news = PTHREAD_COND_INITIALIZER,
                    .inbox = {.mutex = &run.mutex, .news = &run.news}};
  scoring->grid.block.share = runner->share;
  scoring->grid.block.cancel = &runner->interrupt;
  if (scoring->measures) {
    run.window.flight_bytes = sizeof(struct measured_flight);
    run.window.prepare = prepare_measures;
  }
  return compute(&run);
}
