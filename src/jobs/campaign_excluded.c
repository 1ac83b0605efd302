/* campaign_excluded.c: the bodies that a campaign's controller was pretrained on, which count as seen.
 *
 * The bodies of every pretraining of the controller's lineage (campaign_lineage.c) are drawn again into one set, on as many threads as there
 * are workers, 16 at most, and with their niceness. The set is const once it is made, and campaigns with the same lineage and workspace share it: the first one makes it, the
 * others wait. */
#include <stdlib.h>

#include "base/thread.h"
#include "jobs/campaign_run.h"

#define WAIT_MS     50
#define THREADS_MAX 16

enum state { MAKING = 0, READY, FAILED /* its maker gave up: nobody finds it any more */ };

struct mo_exclusion {
  struct mo_workspace workspace;
  struct mo_lineage lineage;
  struct mo_form_set *forms;
  enum state state;
  uint32_t users;
  struct mo_exclusion *next;
};

const struct mo_form_set *mo_exclusion_forms(const struct mo_exclusion *exclusion)
{
  return exclusion != NULL ? exclusion->forms : NULL;
}

static bool is_same(const struct mo_exclusion *a, const struct mo_exclusion *b)
{
  if (a->state == FAILED || a->lineage.n_parts != b->lineage.n_parts || a->workspace.nx != b->workspace.nx ||
      a->workspace.ny != b->workspace.ny || a->workspace.nz != b->workspace.nz)
    return false;
  for (uint32_t i = 0; i < a->lineage.n_parts; i++)
    if (a->lineage.parts[i].seed != b->lineage.parts[i].seed ||
        a->lineage.parts[i].n_bodies != b->lineage.parts[i].n_bodies)
      return false;
  return true;
}

static void free_exclusion(struct mo_exclusion *exclusion)
{
  mo_form_set_free(exclusion->forms);
  free(exclusion);
}

/* Takes out of the list what nobody uses. Under the mutex. */
static void drop(struct mo_jobs *jobs, struct mo_exclusion *exclusion)
{
  struct mo_exclusion **link = &jobs->exclusions;
  if (--exclusion->users > 0)
    return;
  while (*link != exclusion)
    link = &(*link)->next;
  *link = exclusion->next;
  free_exclusion(exclusion);
}

void mo_exclusion_release(struct mo_jobs *jobs, struct mo_exclusion *exclusion)
{
  if (exclusion == NULL)
    return;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  drop(jobs, exclusion);
  pthread_mutex_unlock(&jobs->exclusions_mutex);
}

struct drawing {
  struct mo_campaign_run *run;
  const struct mo_lineage_part *part;
  struct mo_exclusion *made;
  uint32_t n_threads;
  int error;
};

static void draw(struct drawing *drawing)
{
  struct mo_runner *runner = drawing->run->attempt.runner;
  drawing->error =
      mo_pretraining_forms(drawing->part->seed, drawing->part->n_bodies, drawing->made->workspace, drawing->n_threads,
                           &runner->interrupt, &runner->replayed, drawing->made->forms);
}

static void *draw_nicely(void *context)
{
  struct drawing *drawing = context;
  mo_thread_tag = drawing->run->id;
  mo_compute_settle(drawing->run->jobs->compute);
  draw(drawing);
  return NULL;
}

/* On a thread of its own, because niceness is not for coming back from; without one, alone on this one. */
static int draw_part(struct mo_campaign_run *run, const struct mo_lineage_part *part, struct mo_exclusion *made)
{
  struct drawing drawing = {.run = run, .part = part, .made = made};
  struct mo_compute_stats stats;
  pthread_t thread;
  mo_compute_get_stats(run->jobs->compute, &stats);
  drawing.n_threads = stats.n_workers < THREADS_MAX ? stats.n_workers : THREADS_MAX;
  if (mo_thread_create(&thread, NULL, draw_nicely, &drawing) == 0) {
    pthread_join(thread, NULL);
  } else {
    drawing.n_threads = 1;
    draw(&drawing);
  }
  return drawing.error;
}

static int draw_forms(struct mo_campaign_run *run, struct mo_exclusion *made)
{
  struct mo_runner *runner = run->attempt.runner;
  uint64_t total = 0, drawn = 0;
  int error = mo_form_set_create(made->workspace, &made->forms);
  for (uint32_t i = 0; i < made->lineage.n_parts; i++)
    total += made->lineage.parts[i].n_bodies;
  (void)mo_campaign_enter(run, MO_CAMPAIGN_PREPARE, total);
  for (uint32_t i = 0; i < made->lineage.n_parts && error == MO_OK; i++) {
    error = draw_part(run, &made->lineage.parts[i], made);
    drawn += made->lineage.parts[i].n_bodies;
    __atomic_store_n(&runner->replayed, 0, __ATOMIC_RELAXED);
    mo_campaign_advance(run, drawn);
  }
  return error;
}

/* The set of that lineage, with one user more, or `mine` put into the list for this run to fill (*is_mine). */
static struct mo_exclusion *find_or_add(struct mo_jobs *jobs, struct mo_exclusion *mine, bool *is_mine)
{
  struct mo_exclusion *found;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  for (found = jobs->exclusions; found != NULL; found = found->next)
    if (is_same(found, mine))
      break;
  *is_mine = found == NULL;
  if (found == NULL) {
    found = mine;
    mine->next = jobs->exclusions;
    jobs->exclusions = mine;
  }
  found->users++;
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return found;
}

static enum state look(struct mo_jobs *jobs, const struct mo_exclusion *exclusion)
{
  enum state state;
  pthread_mutex_lock(&jobs->exclusions_mutex);
  state = exclusion->state;
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return state;
}

static int fill(struct mo_campaign_run *run, struct mo_exclusion *mine)
{
  struct mo_jobs *jobs = run->jobs;
  int error = draw_forms(run, mine);
  pthread_mutex_lock(&jobs->exclusions_mutex);
  mine->state = error == MO_OK ? READY : FAILED;
  if (error != MO_OK)
    drop(jobs, mine);
  pthread_mutex_unlock(&jobs->exclusions_mutex);
  return error;
}

int mo_exclusion_acquire(struct mo_campaign_run *run, struct mo_exclusion **exclusion)
{
  struct mo_exclusion wanted = {.workspace = run->status.record.settings.workspace};
  int error = mo_lineage_read(run, &wanted.lineage);
  *exclusion = NULL;
  while (error == MO_OK && wanted.lineage.n_parts > 0) {
    struct mo_exclusion *mine = malloc(sizeof(*mine)), *found;
    enum state state = MAKING;
    bool is_mine;
    if (mine == NULL)
      return MO_ERR_NO_MEMORY;
    *mine = wanted;
    found = find_or_add(run->jobs, mine, &is_mine);
    if (is_mine) {
      error = fill(run, mine);
      *exclusion = error == MO_OK ? mine : NULL;
      return error;
    }
    free(mine);
    while (state == MAKING && error == MO_OK) {
      state = look(run->jobs, found);
      if (state == MAKING)
        mo_runner_sleep(run->attempt.runner, WAIT_MS, MO_WISH_PAUSE);
      if (mo_runner_is_interrupted(run->attempt.runner))
        error = MO_ERR_CANCELLED;
    }
    if (error == MO_OK && state == READY) {
      *exclusion = found;
      return MO_OK;
    }
    mo_exclusion_release(run->jobs, found);
  }
  return error;
}
