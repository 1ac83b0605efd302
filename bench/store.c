/* store.c: the cost of durability; `morpho-bench store [folder]`.
 *
 * Runs on a new state folder in `folder` (default: $TMPDIR or /tmp; name one on the disk of
 * interest), which is removed at the end. Prints the time of each operation as its callers see it,
 * fsync included. */
#include "bench.h"
#include "state.h"

#include <math.h>
#include <pthread.h>
#include <sqlite3.h>
#include <stdlib.h>
#include <string.h>

#define DESIGNS      10000
#define ENVIRONMENTS 10
#define CLIENTS      64
#define SUBMISSIONS  100 /* of each client */
#define SAVE_ROWS    160
#define JOBS         1000000
#define PAGES        200

struct bed {
  const char *path;
  struct mo_store *store;
  struct mo_bits *forms, *genotypes; /* (DESIGNS) */
};

static void prepare(struct bed *bed, const char *folder)
{
  struct mo_body_stream *stream = NULL;
  bed->path = bench_state_make(folder);
  bed->store = bench_state_open(bed->path);
  bed->forms = bench_zeros(DESIGNS, sizeof(*bed->forms));
  bed->genotypes = bench_zeros(DESIGNS, sizeof(*bed->genotypes));
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, 1, &stream), "body stream");
  for (uint32_t i = 0; i < DESIGNS; i++) {
    bench_check(mo_body_stream_next(stream, bed->genotypes[i].words, NULL), "body stream");
    mo_genotype_place(MO_DEFAULT_WORKSPACE, bed->genotypes[i].words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, bed->genotypes[i].words, bed->forms[i].words);
  }
  mo_body_stream_free(stream);
}

static struct mo_evaluation_request submission_of(const struct bed *bed, uint32_t first, uint32_t n)
{
  return (struct mo_evaluation_request){.forms = bed->forms + first,
                                        .genotypes = bed->genotypes + first,
                                        .n_designs = n,
                                        .environment_set = "paper-test",
                                        .controller = "default",
                                        .physics = mo_paper_physics(),
                                        .record_stride = 1};
}

struct client {
  const struct bed *bed;
  uint32_t number;
  double *latencies_s; /* (SUBMISSIONS) */
};

static void *be_a_client(void *context)
{
  const struct client *client = context;
  for (uint32_t i = 0; i < SUBMISSIONS; i++) {
    const struct mo_evaluation_request submission =
        submission_of(client->bed, (client->number * SUBMISSIONS + i) % DESIGNS, 1);
    const double start = bench_now_s();
    int64_t id;
    bool replayed;
    bench_check(mo_store_submit(client->bed->store, &submission, &id, &replayed), "submission");
    client->latencies_s[i] = bench_now_s() - start;
  }
  return NULL;
}

static void submit_small(const struct bed *bed)
{
  enum { N = CLIENTS * SUBMISSIONS };
  static double latencies_s[N];
  struct client clients[CLIENTS];
  pthread_t threads[CLIENTS];
  struct mo_store_stats before, after;
  mo_store_get_stats(bed->store, &before);
  const double start = bench_now_s();
  for (uint32_t i = 0; i < CLIENTS; i++) {
    clients[i] = (struct client){bed, i, latencies_s + (size_t)i * SUBMISSIONS};
    pthread_create(&threads[i], NULL, be_a_client, &clients[i]);
  }
  for (uint32_t i = 0; i < CLIENTS; i++)
    pthread_join(threads[i], NULL);
  const double elapsed_s = bench_now_s() - start;
  mo_store_get_stats(bed->store, &after);
  printf("submissions of 1 design, %d clients  %.0f/s, median %.2f ms, p99 %.2f ms, %.1f per "
         "commit\n",
         CLIENTS, N / elapsed_s, 1e3 * bench_median(latencies_s, N),
         1e3 * bench_quantile(latencies_s, N, 0.99),
         (double)(after.operations - before.operations) / (double)(after.commits - before.commits));
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

static void save_now(struct mo_store *store, struct mo_save *save)
{
  struct saver saver = {
      .mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER, .pending = 1};
  save->done = saved;
  save->context = &saver;
  bench_check(mo_store_save(store, save), "save");
  pthread_mutex_lock(&saver.mutex);
  while (saver.pending)
    pthread_cond_wait(&saver.changed, &saver.mutex);
  pthread_mutex_unlock(&saver.mutex);
  bench_check(saver.status, "save");
}

/* Saves all losses of the large job, as many at a time as a tenth of a second produces, and
 * finishes it. */
static void save_all(const struct bed *bed, int64_t id)
{
  struct mo_job_update update = {.job = id, .step = MO_STEP_START};
  struct mo_saved_block blocks[SAVE_ROWS / ENVIRONMENTS];
  struct mo_save save = {.updates = &update, .n_updates = 1};
  struct mo_work *work = NULL;
  int64_t fingerprint = 0;
  uint32_t saves = 0;
  bench_check(mo_store_fingerprint(bed->store, "bench", &fingerprint), "fingerprint");
  const struct mo_classes classes = {{fingerprint, fingerprint}, fingerprint};
  bench_check(mo_store_load_work(bed->store, id, &classes, &work), "work");
  update.fingerprint = update.workers = fingerprint;
  save_now(bed->store, &save);
  const double start = bench_now_s();
  save.blocks = blocks;
  for (uint32_t n = 0; n < DESIGNS;) {
    save.n_blocks = 0;
    for (; n < DESIGNS && save.n_blocks < SAVE_ROWS / ENVIRONMENTS; n++) {
      struct mo_saved_block *block = &blocks[save.n_blocks++];
      *block = (struct mo_saved_block){.genotype = work->genotype_rows[n],
                                       .condition = {.controller = work->controller,
                                                     .physics = work->physics_rows[0],
                                                     .fingerprint = fingerprint,
                                                     .n = ENVIRONMENTS}};
      memcpy(block->condition.environments, work->environment_rows,
             ENVIRONMENTS * sizeof(*work->environment_rows));
      for (uint32_t k = 0; k < ENVIRONMENTS; k++)
        block->losses[k] = 0.5;
    }
    update.step = n == DESIGNS ? MO_STEP_SUCCEED : MO_STEP_PROGRESS;
    save_now(bed->store, &save);
    saves++;
  }
  const double elapsed_s = bench_now_s() - start;
  printf("saves of %d losses                    %.2f ms each, %.0f losses/s\n", SAVE_ROWS,
         1e3 * elapsed_s / saves, DESIGNS * (double)ENVIRONMENTS / elapsed_s);
  mo_work_free(work);
}

static void read_results(const struct bed *bed, int64_t id)
{
  double best_s = INFINITY;
  for (int run = 0; run < 5; run++) {
    struct mo_evaluation_results *results = NULL;
    const double start = bench_now_s();
    bench_check(mo_store_results(bed->store, id, &results), "results");
    best_s = fmin(best_s, bench_now_s() - start);
    mo_evaluation_results_free(results);
  }
  printf("results of %d losses             %.1f ms\n", DESIGNS * ENVIRONMENTS, 1e3 * best_s);
}

/* ---- lists ---- */

static void fill_jobs(struct bed *bed)
{
  static const char sql[] =
      "BEGIN; WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n LIMIT 1000000)"
      " INSERT INTO "
      "jobs(kind,state,priority,weight,back_end,version,epoch,attempts,created_us,started_us,"
      "finished_us,error)"
      " SELECT 0,3,0,1,0,1,1,0,i,i,i,0 FROM n;"
      "INSERT OR IGNORE INTO evaluations(job,controller,controller_name,physics,environment_set,"
      "n_designs,n_environments,verify,record,record_stride,done,cached,diverged)"
      " SELECT j.id,e.controller,e.controller_name,e.physics,e.environment_set,1,10,0,0,1,10,0,0"
      " FROM jobs j, (SELECT * FROM evaluations LIMIT 1) e; COMMIT";
  const struct mo_store_config config = {.path = bed->path};
  char path[600];
  sqlite3 *db = NULL;
  mo_store_close(bed->store);
  snprintf(path, sizeof(path), "%s/morphod.db", bed->path);
  if (sqlite3_open(path, &db) != SQLITE_OK ||
      sqlite3_exec(db, sql, NULL, NULL, NULL) != SQLITE_OK) {
    fprintf(stderr, "morpho-bench: %s\n", sqlite3_errmsg(db));
    exit(1);
  }
  sqlite3_close(db);
  bench_check(mo_store_open(&config, &bed->store, NULL), "store");
}

static void list_jobs(const struct bed *bed)
{
  struct mo_job *page = bench_zeros(100, sizeof(*page));
  double times_s[PAGES];
  for (int i = 0; i < PAGES; i++) {
    const struct mo_job_query query = {
        .before = 1 + (int64_t)(i + 1) * (JOBS / PAGES), .state = i % 2 == 0 ? -1 : 3, .kind = -1};
    const double start = bench_now_s();
    const int64_t n = mo_store_jobs(bed->store, &query, page, 100);
    times_s[i] = bench_now_s() - start;
    bench_check(n < 0 ? (int)n : MO_OK, "jobs");
  }
  printf("pages of 100 among %d jobs       median %.2f ms, p99 %.2f ms\n", JOBS,
         1e3 * bench_median(times_s, PAGES), 1e3 * bench_quantile(times_s, PAGES, 0.99));
  free(page);
}

int bench_store(int argc, char **argv)
{
  struct bed bed;
  const char *base = argc > 1 ? argv[1] : getenv("TMPDIR");
  int64_t id = 0, again = 0;
  bool replayed;
  prepare(&bed, base != NULL ? base : "/tmp");
  const struct mo_evaluation_request submission = submission_of(&bed, 0, DESIGNS);
  double start = bench_now_s();
  bench_check(mo_store_submit(bed.store, &submission, &id, &replayed), "submission");
  printf("submission of %d new designs       %.0f ms\n", DESIGNS, 1e3 * (bench_now_s() - start));
  start = bench_now_s();
  bench_check(mo_store_submit(bed.store, &submission, &again, &replayed), "submission");
  printf("submission of the same again          %.0f ms\n", 1e3 * (bench_now_s() - start));
  submit_small(&bed);
  save_all(&bed, id);
  read_results(&bed, id);
  fill_jobs(&bed);
  list_jobs(&bed);
  mo_store_close(bed.store);
  return 0;
}
