/* store.c: what durability costs; `morpho-bench store [folder]`.
 *
 * Runs on a new state folder in `folder` (default: $TMPDIR or /tmp; name one on the disk that
 * counts), which is removed at the end. Prints the time of each operation as its callers see it,
 * fsync included. */
#include "bench.h"

#include "base/clock.h"
#include "store/runner.h"

#include <ftw.h>
#include <pthread.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define DESIGNS      10000
#define ENVIRONMENTS 10
#define CLIENTS      64
#define SUBMISSIONS  100 /* of each client */
#define SAVE_ROWS    160
#define JOBS         1000000
#define PAGES        200

struct bench_store_state {
  char path[512];
  struct mo_store *store;
  struct mo_bits *forms, *genotypes;
};

static double since(uint64_t start_ns)
{
  return 1e-9 * (double)(mo_clock_ns() - start_ns);
}

static int remove_entry(const char *path, const struct stat *status, int kind, struct FTW *place)
{
  (void)status;
  (void)kind;
  (void)place;
  return remove(path);
}

static int prepare(struct bench_store_state *state)
{
  struct mo_store_config config = {.path = state->path};
  struct mo_message message;
  struct mo_controller *controller = NULL;
  struct mo_controller_record record;
  struct mo_body_stream *stream = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created;
  int error = mo_store_open(&config, &state->store, &message);
  if (error == MO_OK)
    error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller);
  if (error == MO_OK)
    error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_controller_put(state->store, "default", bytes, size, controller, &record,
                                    &created);
  if (error == MO_OK)
    error = mo_body_stream_create(MO_DEFAULT_WORKSPACE, 1, &stream);
  state->forms = calloc(DESIGNS, sizeof(*state->forms));
  state->genotypes = calloc(DESIGNS, sizeof(*state->genotypes));
  if (state->forms == NULL || state->genotypes == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < DESIGNS && error == MO_OK; i++) {
    error = mo_body_stream_next(stream, state->genotypes[i].words);
    if (error == MO_OK) {
      mo_genotype_place(MO_DEFAULT_WORKSPACE, state->genotypes[i].words);
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, state->genotypes[i].words, state->forms[i].words);
    }
  }
  mo_body_stream_free(stream);
  mo_controller_free(controller);
  free(bytes);
  return error;
}

static struct mo_submission submission_of(const struct bench_store_state *state, uint32_t first,
                                          uint32_t n)
{
  return (struct mo_submission){.forms = state->forms + first,
                                .genotypes = state->genotypes + first,
                                .n_designs = n,
                                .environment_set = "paper-test",
                                .controller = "default",
                                .physics = mo_default_physics(),
                                .record_stride = 1};
}

struct client {
  const struct bench_store_state *state;
  uint32_t number;
  double latency_s[SUBMISSIONS];
  int error;
};

static void *be_a_client(void *context)
{
  struct client *client = context;
  for (uint32_t i = 0; i < SUBMISSIONS && client->error == MO_OK; i++) {
    struct mo_submission submission =
        submission_of(client->state, (client->number * SUBMISSIONS + i) % DESIGNS, 1);
    uint64_t start = mo_clock_ns();
    int64_t id;
    bool replayed;
    client->error = mo_store_submit(client->state->store, &submission, &id, &replayed);
    client->latency_s[i] = since(start);
  }
  return NULL;
}

static int compare(const void *a, const void *b)
{
  double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static int submit_small(const struct bench_store_state *state)
{
  struct client *clients = calloc(CLIENTS, sizeof(*clients));
  double *latencies = calloc((size_t)CLIENTS * SUBMISSIONS, sizeof(*latencies));
  pthread_t threads[CLIENTS];
  struct mo_store_stats before, after;
  uint64_t start = mo_clock_ns();
  double elapsed_s;
  size_t n = (size_t)CLIENTS * SUBMISSIONS;
  int error = clients == NULL || latencies == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (error == MO_OK) {
    mo_store_get_stats(state->store, &before);
    for (uint32_t i = 0; i < CLIENTS; i++) {
      clients[i].state = state;
      clients[i].number = i;
      pthread_create(&threads[i], NULL, be_a_client, &clients[i]);
    }
    for (uint32_t i = 0; i < CLIENTS; i++) {
      pthread_join(threads[i], NULL);
      error = clients[i].error != MO_OK ? clients[i].error : error;
      memcpy(latencies + (size_t)i * SUBMISSIONS, clients[i].latency_s,
             sizeof(clients[i].latency_s));
    }
    elapsed_s = since(start);
    mo_store_get_stats(state->store, &after);
    qsort(latencies, n, sizeof(*latencies), compare);
    printf("submissions of 1 design, %d clients  %.0f/s, median %.2f ms, p99 %.2f ms, %.1f per "
           "commit\n",
           CLIENTS, (double)n / elapsed_s, 1e3 * latencies[n / 2], 1e3 * latencies[n * 99 / 100],
           (double)(after.operations - before.operations) /
               (double)(after.commits - before.commits));
  }
  free(clients);
  free(latencies);
  return error;
}

/* ---- saves ---- */

struct saver {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  int pending, status;
};

static void saved(struct mo_save *save, int status)
{
  struct saver *saver = save->context;
  pthread_mutex_lock(&saver->mutex);
  saver->pending = 0;
  saver->status = status;
  pthread_cond_signal(&saver->changed);
  pthread_mutex_unlock(&saver->mutex);
}

static int save_now(struct mo_store *store, struct mo_save *save)
{
  struct saver saver = {
      .mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER, .pending = 1};
  int error;
  save->done = saved;
  save->context = &saver;
  error = mo_store_save(store, save);
  if (error != MO_OK)
    return error;
  pthread_mutex_lock(&saver.mutex);
  while (saver.pending)
    pthread_cond_wait(&saver.changed, &saver.mutex);
  pthread_mutex_unlock(&saver.mutex);
  return saver.status;
}

/* All losses of the large job, in saves of the size that a tenth of a second brings, then its end.
 */
static int save_all(const struct bench_store_state *state, int64_t id)
{
  struct mo_job_update update = {.job = id, .step = MO_STEP_START};
  struct mo_saved_score scores[SAVE_ROWS];
  struct mo_save save = {.updates = &update, .n_updates = 1};
  struct mo_work *work = NULL;
  int64_t fingerprint = 0;
  uint64_t start;
  uint32_t saves = 0;
  int error = mo_store_fingerprint(state->store, "bench", &fingerprint);
  if (error == MO_OK)
    error = mo_store_load_work(
        state->store, id, &(struct mo_classes){{fingerprint, fingerprint}, fingerprint}, &work);
  update.fingerprint = update.workers = fingerprint;
  if (error == MO_OK)
    error = save_now(state->store, &save);
  start = mo_clock_ns();
  save.scores = scores;
  for (uint32_t n = 0; n < DESIGNS && error == MO_OK;) {
    save.n_scores = 0;
    for (; n < DESIGNS && save.n_scores + ENVIRONMENTS <= SAVE_ROWS; n++)
      for (uint32_t k = 0; k < ENVIRONMENTS; k++)
        scores[save.n_scores++] = (struct mo_saved_score){.genotype = work->genotype_rows[n],
                                                          .controller = work->controller,
                                                          .physics = work->physics,
                                                          .environment = work->environment_rows[k],
                                                          .fingerprint = fingerprint,
                                                          .loss = 0.5};
    update.step = n == DESIGNS ? MO_STEP_SUCCEED : MO_STEP_PROGRESS;
    error = save_now(state->store, &save);
    saves++;
  }
  printf("saves of %d losses                    %.2f ms each, %.0f losses/s\n", SAVE_ROWS,
         1e3 * since(start) / saves, DESIGNS * (double)ENVIRONMENTS / since(start));
  mo_work_free(work);
  return error;
}

static int read_results(const struct bench_store_state *state, int64_t id)
{
  double best = 1e9;
  for (int run = 0; run < 5; run++) {
    struct mo_evaluation_results *results = NULL;
    uint64_t start = mo_clock_ns();
    int error = mo_store_results(state->store, id, &results);
    double elapsed_s = since(start);
    if (error != MO_OK)
      return error;
    best = elapsed_s < best ? elapsed_s : best;
    mo_evaluation_results_free(results);
  }
  printf("results of %d losses             %.1f ms\n", DESIGNS * ENVIRONMENTS, 1e3 * best);
  return MO_OK;
}

/* ---- lists ---- */

static int fill_jobs(struct bench_store_state *state)
{
  static const char sql[] =
      "BEGIN; WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n LIMIT 1000000)"
      " INSERT INTO "
      "jobs(kind,state,priority,weight,back_end,version,epoch,attempts,created_us,started_us,"
      "finished_us,error)"
      " SELECT 0,3,0,1,0,1,1,0,i,i,i,0 FROM n;"
      "INSERT OR IGNORE INTO evaluations SELECT "
      "j.id,e.controller,e.controller_name,e.physics,e.environment_set,1,10,0,0,1,"
      "10,0,0,NULL,NULL FROM jobs j, (SELECT * FROM evaluations LIMIT 1) e; COMMIT";
  struct mo_store_config config = {.path = state->path};
  char path[600];
  sqlite3 *db = NULL;
  int result;
  mo_store_close(state->store);
  state->store = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", state->path);
  result = sqlite3_open(path, &db);
  if (result == SQLITE_OK)
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  sqlite3_close(db);
  return result == SQLITE_OK ? mo_store_open(&config, &state->store, NULL) : MO_ERR_IO;
}

static int list_jobs(const struct bench_store_state *state)
{
  struct mo_job *page = calloc(100, sizeof(*page));
  double *times = calloc(PAGES, sizeof(*times));
  int error = page == NULL || times == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  for (int i = 0; i < PAGES && error == MO_OK; i++) {
    struct mo_job_query query = {
        .before = 1 + (int64_t)(i + 1) * (JOBS / PAGES), .state = i % 2 == 0 ? -1 : 3, .kind = -1};
    uint64_t start = mo_clock_ns();
    int64_t n = mo_store_jobs(state->store, &query, page, 100);
    times[i] = since(start);
    error = n < 0 ? (int)n : MO_OK;
  }
  if (error == MO_OK) {
    qsort(times, PAGES, sizeof(*times), compare);
    printf("pages of 100 among %d jobs       median %.2f ms, p99 %.2f ms\n", JOBS,
           1e3 * times[PAGES / 2], 1e3 * times[PAGES * 99 / 100]);
  }
  free(page);
  free(times);
  return error;
}

static int measure(struct bench_store_state *state)
{
  struct mo_submission submission;
  int64_t id = 0, again = 0;
  bool replayed;
  uint64_t start;
  int error = prepare(state);
  if (error != MO_OK)
    return error;
  submission = submission_of(state, 0, DESIGNS);
  start = mo_clock_ns();
  error = mo_store_submit(state->store, &submission, &id, &replayed);
  printf("submission of %d new designs       %.0f ms\n", DESIGNS, 1e3 * since(start));
  start = mo_clock_ns();
  if (error == MO_OK)
    error = mo_store_submit(state->store, &submission, &again, &replayed);
  printf("submission of the same again          %.0f ms\n", 1e3 * since(start));
  if (error == MO_OK)
    error = submit_small(state);
  if (error == MO_OK)
    error = save_all(state, id);
  if (error == MO_OK)
    error = read_results(state, id);
  if (error == MO_OK)
    error = fill_jobs(state);
  return error == MO_OK ? list_jobs(state) : error;
}

int bench_store(int argc, char **argv)
{
  struct bench_store_state state = {.store = NULL};
  const char *base = argc > 1 ? argv[1] : getenv("TMPDIR");
  int error;
  snprintf(state.path, sizeof(state.path), "%s/morpho-bench-XXXXXX", base != NULL ? base : "/tmp");
  if (mkdtemp(state.path) == NULL) {
    fprintf(stderr, "morpho-bench: cannot make a folder in %s\n", base != NULL ? base : "/tmp");
    return 1;
  }
  error = measure(&state);
  mo_store_close(state.store);
  (void)nftw(state.path, remove_entry, 16, FTW_DEPTH | FTW_PHYS);
  free(state.forms);
  free(state.genotypes);
  if (error != MO_OK)
    fprintf(stderr, "morpho-bench: %s\n", mo_error_text(error));
  return error != MO_OK;
}
