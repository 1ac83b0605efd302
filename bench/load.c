/* load.c: measures whether the service answers while the cores compute.
 *
 * Starts morphod on a free port with an empty state, keeps its cores busy with a batch of 10,000
 * designs in the paper's test set, and measures from outside, with a client that waits in poll(2)
 * and costs little itself:
 *   1. how long a request of 10,000 designs takes to be accepted, that is, durable, idle and under
 *      load;
 *   2. the latency of /healthz over 64 connections without pauses;
 *   3. how long one interactive design takes from the request to its score. */
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "served.h"

#define N_DESIGNS     10000
#define N_CONNECTIONS 64
#define N_INTERACTIVE 20
#define SAMPLES_MAX   2000000

static double submit(const struct bench_daemon *daemon, struct mo_body_stream *stream, int *status)
{
  size_t size;
  char *body = bench_request_of(stream, N_DESIGNS, ",\"priority\":\"batch\"", &size);
  double begun = bench_now_s();
  *status = bench_ask(daemon, "POST", "/v1/evaluations", "", body, size, NULL);
  double taken = bench_now_s() - begun;
  free(body);
  return taken;
}

/* 64 connections that ask again as soon as they are answered; latencies in seconds. */
static size_t ask_health(const struct bench_daemon *daemon, double duration_s, double *samples,
                         double *rate)
{
  static const char request[] = "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n";
  struct pollfd polled[N_CONNECTIONS];
  double asked[N_CONNECTIONS];
  char text[N_CONNECTIONS][2048];
  size_t got[N_CONNECTIONS] = {0}, n = 0;
  double begun = bench_now_s();
  for (int i = 0; i < N_CONNECTIONS; i++) {
    polled[i] = (struct pollfd){.fd = bench_dial(daemon), .events = POLLIN};
    asked[i] = bench_now_s();
    bench_send(polled[i].fd, request, sizeof(request) - 1);
  }
  while (bench_now_s() - begun < duration_s && n < SAMPLES_MAX) {
    if (poll(polled, N_CONNECTIONS, 1000) < 0)
      bench_die("poll");
    for (int i = 0; i < N_CONNECTIONS; i++) {
      if (!(polled[i].revents & (POLLIN | POLLHUP)))
        continue;
      ssize_t part = recv(polled[i].fd, text[i] + got[i], sizeof(text[i]) - got[i], 0);
      if (part <= 0)
        bench_die("recv");
      got[i] += (size_t)part;
      size_t wanted = bench_reply_size(text[i], got[i]);
      if (wanted == 0 || got[i] < wanted)
        continue;
      if (strncmp(text[i], "HTTP/1.1 200", 12) != 0 || got[i] > wanted) {
        errno = 0;
        bench_die("/healthz");
      }
      double now = bench_now_s();
      if (n < SAMPLES_MAX)
        samples[n++] = now - asked[i];
      got[i] = 0;
      asked[i] = now;
      bench_send(polled[i].fd, request, sizeof(request) - 1);
    }
  }
  *rate = (double)n / (bench_now_s() - begun);
  for (int i = 0; i < N_CONNECTIONS; i++)
    close(polled[i].fd);
  return n;
}

static int verdict(const char *what, double value, double bound, const char *unit)
{
  printf("%-56s %10.1f %-3s bound %6.0f  %s\n", what, value, unit, bound,
         value <= bound ? "ok" : "MISSED");
  return value > bound;
}

int bench_load(const struct bench_options *options)
{
  struct bench_daemon daemon;
  struct mo_body_stream *stream, *others;
  int missed = 0, status = 0, second_status = 0;
  double *samples = bench_zeros(SAMPLES_MAX, sizeof(*samples)), rate = 0;
  double interactive[N_INTERACTIVE];
  signal(SIGPIPE, SIG_IGN);
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed, &stream), "random bodies");
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed + 1, &others),
              "random bodies");
  bench_daemon_start(&daemon, options, NULL);
  double idle_s = submit(&daemon, stream, &status);
  sleep(2); /* now every core computes */
  size_t n = ask_health(&daemon, options->quick ? 3 : 15, samples, &rate);
  for (int i = 0; i < N_INTERACTIVE; i++) {
    size_t size;
    char *body = bench_request_of(others, 1, "", &size), *reply;
    double begun = bench_now_s();
    int got =
        bench_ask(&daemon, "POST", "/v1/evaluations", "Prefer: wait=30\r\n", body, size, &reply);
    interactive[i] = bench_now_s() - begun;
    if (got != 200 || strstr(reply, "\"results\"") == NULL) {
      printf("an interactive design was not done: %d %s\n", got, reply);
      missed++;
    }
    free(reply);
    free(body);
  }
  double loaded_s = submit(&daemon, stream, &second_status);
  char *job;
  bench_ask(&daemon, "GET", "/v1/jobs?state=running", "", "", 0, &job);
  const char *done = strstr(job, "\"rollouts_done\":");
  printf("morphod under a batch of %d designs (%s rollouts done when the last figure was taken)\n",
         N_DESIGNS, done != NULL ? strtok(job + (done - job) + 16, ",") : "all");
  missed += status != 202 || second_status != 202;
  missed += verdict("10,000 designs accepted, idle", idle_s * 1e3, 1000, "ms");
  missed += verdict("10,000 designs accepted while the cores compute", loaded_s * 1e3, 1000, "ms");
  missed += verdict("/healthz over 64 connections, 99th percentile",
                    bench_quantile(samples, n, 0.99) * 1e3, 50, "ms");
  printf("  (median %.2f ms, longest %.1f ms, %.0f requests per second)\n",
         bench_median(samples, n) * 1e3, samples[n - 1] * 1e3, rate);
  missed += verdict("one interactive design × 10 environments, longest of 20",
                    bench_quantile(interactive, N_INTERACTIVE, 1) * 1e3, 1000, "ms");
  printf("  (median %.1f ms)\n", bench_median(interactive, N_INTERACTIVE) * 1e3);
  free(job);
  free(samples);
  bench_daemon_stop(&daemon);
  return missed > 0;
}
