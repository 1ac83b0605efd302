/* shares.c: several jobs at once: does each get its part of the cores, and do small evaluations
 * keep their speed?
 *
 * Starts morphod with an empty state and gives it a batch evaluation of 10,000 designs, a training
 * and four zero-shot campaigns, of different weights. The training's rollouts are short: a block of
 * gradients over 1000 steps takes seconds, and with it a fair measurement would take many minutes.
 * Once all of them compute, it compares the worker seconds that each gets with its weight, and
 * then, with all of them still at work, measures how long one design takes from the request to its
 * score. */
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "served.h"

#define N_CAMPAIGNS   4
#define N_JOBS        (2 + N_CAMPAIGNS)
#define N_DESIGNS     10000
#define N_INTERACTIVE 60

struct job {
  char what[32], path[64];
  double weight, before_s, got_s;
};

static double number_after(const char *text, const char *words)
{
  const char *found = strstr(text, words);
  return found != NULL ? strtod(found + strlen(words), NULL) : NAN;
}

/* Worker seconds so far. Of a training or campaign it is in its progress; the evaluation is the
 * only one of its kind that runs. */
static double busy_s(const struct bench_daemon *daemon, const struct job *job)
{
  char *text = NULL;
  errno = 0;
  if (bench_ask(daemon, "GET", job->path, "", "", 0, &text) != 200)
    bench_die(job->path);
  double seconds = number_after(text, strcmp(job->path, "/metrics") == 0
                                          ? "morphod_job_worker_seconds_total{kind=\"evaluation\"} "
                                          : "\"busy_s\":");
  free(text);
  return isfinite(seconds) ? seconds : 0;
}

static void submit(const struct bench_daemon *daemon, const char *kind, const char *body,
                   size_t size, struct job *job)
{
  char path[32], *reply = NULL;
  snprintf(path, sizeof(path), "/v1/%s", kind);
  errno = 0;
  if (bench_ask(daemon, "POST", path, "", body, size, &reply) != 202) {
    fprintf(stderr, "%s\n", reply);
    bench_die(path);
  }
  snprintf(job->what, sizeof(job->what), "%.*s %.0f", (int)strlen(kind) - 1, kind,
           number_after(reply, "\"id\":\""));
  if (strcmp(kind, "evaluations") == 0)
    snprintf(job->path, sizeof(job->path), "/metrics");
  else
    snprintf(job->path, sizeof(job->path), "%s/%.0f", path, number_after(reply, "\"id\":\""));
  job->weight = number_after(reply, "\"weight\":");
  free(reply);
}

static void submit_all(const struct bench_daemon *daemon, const struct bench_options *options,
                       struct mo_body_stream *stream, struct job jobs[N_JOBS])
{
  static const double weights[N_CAMPAIGNS] = {1, 1, 2, 4};
  size_t size;
  char *evaluation =
           bench_request_of(stream, N_DESIGNS, ",\"priority\":\"batch\",\"weight\":2", &size),
       text[256];
  submit(daemon, "evaluations", evaluation, size, &jobs[0]);
  free(evaluation);
  int n =
      snprintf(text, sizeof(text),
               "{\"kind\":\"pretrain\",\"steps\":100000,\"batch\":256,\"seed\":%llu,\"weight\":2,"
               "\"physics\":{\"n_steps\":100},\"validation\":{\"every_steps\":0}}",
               (unsigned long long)options->seed);
  submit(daemon, "trainings", text, (size_t)n, &jobs[1]);
  for (int i = 0; i < N_CAMPAIGNS; i++) {
    n = snprintf(text, sizeof(text),
                 "{\"mode\":\"zero-shot\",\"preset\":\"demo\",\"population\":64,\"generations\":"
                 "10000,\"seed\":%llu,"
                 "\"exclude_pretraining\":false,\"weight\":%g}",
                 (unsigned long long)options->seed + (unsigned)i, weights[i]);
    submit(daemon, "campaigns", text, (size_t)n, &jobs[2 + i]);
  }
}

/* Until every job has computed for a while: what the first blocks cost is a guess. */
static void await_all(const struct bench_daemon *daemon, const struct job jobs[N_JOBS])
{
  double begun = bench_now_s();
  for (int i = 0; i < N_JOBS; i++)
    while (busy_s(daemon, &jobs[i]) <= 1) {
      errno = 0;
      if (bench_now_s() - begun > 120)
        bench_die(jobs[i].what);
      usleep(100000);
    }
}

static int compare_parts(struct job jobs[N_JOBS])
{
  double weights = 0, seconds = 0, most = 0;
  for (int i = 0; i < N_JOBS; i++) {
    weights += jobs[i].weight;
    seconds += jobs[i].got_s;
  }
  printf("%-16s %8s %12s %12s %12s %10s\n", "job", "weight", "worker s", "part", "by weight",
         "off by");
  for (int i = 0; i < N_JOBS; i++) {
    double part = jobs[i].got_s / seconds, wanted = jobs[i].weight / weights;
    printf("%-16s %8g %12.2f %11.1f%% %11.1f%% %9.1f%%\n", jobs[i].what, jobs[i].weight,
           jobs[i].got_s, 100 * part, 100 * wanted, 100 * (part / wanted - 1));
    most = fmax(most, fabs(part / wanted - 1));
  }
  printf("largest difference %.1f %%, bound 10 %%  %s\n", 100 * most,
         most <= 0.1 ? "ok" : "MISSED");
  return most > 0.1;
}

static int ask_small_ones(const struct bench_daemon *daemon, struct mo_body_stream *stream)
{
  double taken[N_INTERACTIVE];
  for (int i = 0; i < N_INTERACTIVE; i++) {
    size_t size;
    char *body = bench_request_of(stream, 1, "", &size), *reply = NULL;
    double begun = bench_now_s();
    int status =
        bench_ask(daemon, "POST", "/v1/evaluations", "Prefer: wait=30\r\n", body, size, &reply);
    taken[i] = bench_now_s() - begun;
    errno = 0;
    if (status != 200 || strstr(reply, "\"results\"") == NULL)
      bench_die("an interactive design");
    free(reply);
    free(body);
    usleep(100000);
  }
  double p95_s = bench_quantile(taken, N_INTERACTIVE, 0.95);
  printf("one interactive design × 10 environments, %d times beside them: median %.0f ms, 95th "
         "percentile %.0f ms, longest %.0f ms, bound of the percentile 1500 ms  %s\n",
         N_INTERACTIVE, 1e3 * bench_median(taken, N_INTERACTIVE), 1e3 * p95_s,
         1e3 * taken[N_INTERACTIVE - 1], p95_s <= 1.5 ? "ok" : "MISSED");
  return p95_s > 1.5;
}

int bench_shares(const struct bench_options *options)
{
  static const char *const flags[] = {"--max-campaigns=4", NULL};
  struct bench_daemon daemon;
  struct mo_body_stream *stream;
  struct job jobs[N_JOBS];
  int missed = 0;
  signal(SIGPIPE, SIG_IGN);
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed, &stream), "random bodies");
  bench_daemon_start(&daemon, options, flags);
  submit_all(&daemon, options, stream, jobs);
  await_all(&daemon, jobs);
  sleep(10);
  const unsigned seconds = options->quick ? 15 : 60;
  double begun = bench_now_s();
  for (int i = 0; i < N_JOBS; i++)
    jobs[i].before_s = busy_s(&daemon, &jobs[i]);
  sleep(seconds);
  for (int i = 0; i < N_JOBS; i++)
    jobs[i].got_s = busy_s(&daemon, &jobs[i]) - jobs[i].before_s;
  printf("worker seconds in %.0f s\n", bench_now_s() - begun);
  missed += compare_parts(jobs);
  missed += ask_small_ones(&daemon, stream);
  mo_body_stream_free(stream);
  bench_daemon_stop(&daemon);
  return missed > 0;
}
