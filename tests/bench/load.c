/* load.c: does the service answer while the cores compute?
 *
 * Starts morphod on a free port with an empty state, keeps its cores busy with a batch of 10,000 designs in the paper's test set, and
 * measures from outside, with a client that waits in poll(2) and costs little itself:
 *   1. how long a request of 10,000 designs takes to be accepted (which means: durable), idle and under load;
 *   2. the latency of /healthz over 64 connections that ask without a pause;
 *   3. how long one interactive design takes from the request to its score. */
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include "bench.h"

#define N_DESIGNS     10000
#define N_CONNECTIONS 64
#define N_INTERACTIVE 20
#define SAMPLES_MAX   2000000

struct daemon {
  pid_t pid;
  uint16_t port;
  char folder[64];
};

static void die(const char *what)
{
  fprintf(stderr, "morpho-bench: %s: %s\n", what, errno != 0 ? strerror(errno) : "failed");
  exit(1);
}

static void start_daemon(struct daemon *daemon, const char *program, const char *controller)
{
  char state[96], ports[96], defaults[4200], address[128] = "";
  snprintf(daemon->folder, sizeof(daemon->folder), "/tmp/morphod-load-XXXXXX");
  if (mkdtemp(daemon->folder) == NULL)
    die("a temporary folder");
  snprintf(state, sizeof(state), "--state-dir=%s/state", daemon->folder);
  snprintf(ports, sizeof(ports), "--port-file=%s/addresses", daemon->folder);
  snprintf(defaults, sizeof(defaults), "--default-controller=%s", controller);
  daemon->pid = fork();
  if (daemon->pid < 0)
    die("fork");
  if (daemon->pid == 0) {
    int log = open("/dev/null", O_WRONLY);
    dup2(log, STDOUT_FILENO);
    dup2(log, STDERR_FILENO);
    execl(program, program, state, ports, defaults, "--listen=127.0.0.1:0", "--log-level=error", (char *)NULL);
    _exit(127);
  }
  const char *path = strchr(ports, '=') + 1;
  for (int i = 0; i < 1000 && strchr(address, '\n') == NULL; i++) {
    usleep(10000);
    FILE *file = fopen(path, "r");
    if (file == NULL)
      continue;
    if (fgets(address, sizeof(address), file) == NULL)
      address[0] = '\0';
    fclose(file);
  }
  const char *colon = strrchr(address, ':');
  if (colon == NULL) {
    fprintf(stderr, "morpho-bench: %s does not start\n", program);
    exit(1);
  }
  daemon->port = (uint16_t)strtoul(colon + 1, NULL, 10);
}

static void stop_daemon(const struct daemon *daemon)
{
  char command[160];
  int status = 0;
  kill(daemon->pid, SIGTERM);
  waitpid(daemon->pid, &status, 0);
  snprintf(command, sizeof(command), "rm -rf '%s'", daemon->folder);
  if (system(command) != 0) /* NOLINT(cert-env33-c): a fixed command on a folder of our own making */
    fprintf(stderr, "morpho-bench: %s remains\n", daemon->folder);
  if (!WIFEXITED(status) || WEXITSTATUS(status) != 0)
    fprintf(stderr, "morpho-bench: morphod ended with status %d\n", status);
}

static int dial(const struct daemon *daemon)
{
  struct sockaddr_in address = {
      .sin_family = AF_INET, .sin_port = htons(daemon->port), .sin_addr = {htonl(INADDR_LOOPBACK)}};
  int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0), one = 1;
  if (fd < 0 || connect(fd, (struct sockaddr *)&address, sizeof(address)) != 0)
    die("connect");
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
  return fd;
}

static void send_all(int fd, const char *bytes, size_t n)
{
  while (n > 0) {
    ssize_t sent = send(fd, bytes, n, MSG_NOSIGNAL);
    if (sent < 0 && errno != EINTR)
      die("send");
    if (sent > 0) {
      bytes += sent;
      n -= (size_t)sent;
    }
  }
}

/* Bytes of the whole reply at the beginning of `text` once its header is there, else 0. */
static size_t reply_size(const char *text, size_t n)
{
  const char *end = memmem(text, n, "\r\n\r\n", 4);
  if (end == NULL)
    return 0;
  const char *length = memmem(text, (size_t)(end - text) + 2, "Content-Length: ", 16);
  return (size_t)(end - text) + 4 + (length != NULL ? strtoul(length + 16, NULL, 10) : 0);
}

/* One request on a connection of its own; the reply's status and body (malloc, terminated). */
static int ask(const struct daemon *daemon, const char *method, const char *path, const char *headers, const char *body,
               size_t size, char **ret)
{
  char head[512];
  int fd = dial(daemon);
  int n =
      snprintf(head, sizeof(head),
               "%s %s HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: %zu\r\n%s\r\n",
               method, path, size, headers);
  send_all(fd, head, (size_t)n);
  send_all(fd, body, size);
  size_t got = 0, capacity = 65536, wanted = 0;
  char *text = malloc(capacity);
  while (text != NULL && (wanted == 0 || got < wanted)) {
    if (capacity - got < 2)
      text = realloc(text, capacity *= 2);
    if (text == NULL)
      break;
    ssize_t part = recv(fd, text + got, capacity - got - 1, 0);
    if (part <= 0)
      die("recv");
    got += (size_t)part;
    text[got] = '\0';
    wanted = reply_size(text, got);
  }
  close(fd);
  if (text == NULL)
    die("memory");
  int status = (int)strtol(text + 9, NULL, 10);
  char *start = strstr(text, "\r\n\r\n") + 4;
  memmove(text, start, strlen(start) + 1);
  if (ret != NULL)
    *ret = text;
  else
    free(text);
  return status;
}

/* A request of n distinct random designs, as voxels. */
static char *request_of(struct mo_body_stream *stream, int n, const char *more, size_t *size)
{
  char *text = malloc((size_t)n * 170 + 256), digits[MO_DEFAULT_VOXELS + 1];
  uint64_t bits[MO_DEFAULT_WORDS];
  if (text == NULL)
    die("memory");
  size_t at = (size_t)sprintf(text, "{\"designs\":[");
  for (int i = 0; i < n; i++) {
    bench_check(mo_body_stream_next(stream, bits), "a random body");
    mo_genotype_to_text(MO_DEFAULT_WORKSPACE, bits, digits);
    at += (size_t)sprintf(text + at, "%s{\"voxels\":\"%s\"}", i > 0 ? "," : "", digits);
  }
  at += (size_t)sprintf(text + at, "]%s}", more);
  *size = at;
  return text;
}

static double submit(const struct daemon *daemon, struct mo_body_stream *stream, int *status)
{
  size_t size;
  char *body = request_of(stream, N_DESIGNS, ",\"priority\":\"batch\"", &size);
  double begun = bench_now_s();
  *status = ask(daemon, "POST", "/v1/evaluations", "", body, size, NULL);
  double taken = bench_now_s() - begun;
  free(body);
  return taken;
}

/* 64 connections that ask again as soon as they are answered; latencies in seconds. */
static size_t ask_health(const struct daemon *daemon, double duration_s, double *samples, double *rate)
{
  static const char request[] = "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n";
  struct pollfd polled[N_CONNECTIONS];
  double asked[N_CONNECTIONS];
  char text[N_CONNECTIONS][2048];
  size_t got[N_CONNECTIONS] = {0}, n = 0;
  double begun = bench_now_s();
  for (int i = 0; i < N_CONNECTIONS; i++) {
    polled[i] = (struct pollfd){.fd = dial(daemon), .events = POLLIN};
    asked[i] = bench_now_s();
    send_all(polled[i].fd, request, sizeof(request) - 1);
  }
  while (bench_now_s() - begun < duration_s && n < SAMPLES_MAX) {
    if (poll(polled, N_CONNECTIONS, 1000) < 0)
      die("poll");
    for (int i = 0; i < N_CONNECTIONS; i++) {
      if (!(polled[i].revents & (POLLIN | POLLHUP)))
        continue;
      ssize_t part = recv(polled[i].fd, text[i] + got[i], sizeof(text[i]) - got[i], 0);
      if (part <= 0)
        die("recv");
      got[i] += (size_t)part;
      size_t wanted = reply_size(text[i], got[i]);
      if (wanted == 0 || got[i] < wanted)
        continue;
      if (strncmp(text[i], "HTTP/1.1 200", 12) != 0 || got[i] > wanted) {
        errno = 0;
        die("/healthz");
      }
      double now = bench_now_s();
      if (n < SAMPLES_MAX)
        samples[n++] = now - asked[i];
      got[i] = 0;
      asked[i] = now;
      send_all(polled[i].fd, request, sizeof(request) - 1);
    }
  }
  *rate = (double)n / (bench_now_s() - begun);
  for (int i = 0; i < N_CONNECTIONS; i++)
    close(polled[i].fd);
  return n;
}

static int verdict(const char *what, double value, double bound, const char *unit)
{
  printf("%-56s %10.1f %-3s bound %6.0f  %s\n", what, value, unit, bound, value <= bound ? "ok" : "MISSED");
  return value > bound;
}

int bench_load(const char *program, const struct bench_options *options)
{
  struct daemon daemon;
  struct mo_body_stream *stream, *others;
  int missed = 0, status = 0, second_status = 0;
  double *samples = malloc(SAMPLES_MAX * sizeof(*samples)), rate = 0, interactive[N_INTERACTIVE];
  if (samples == NULL)
    die("memory");
  signal(SIGPIPE, SIG_IGN);
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed, &stream), "random bodies");
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed + 1, &others), "random bodies");
  start_daemon(&daemon, program, options->controller);
  double idle_s = submit(&daemon, stream, &status);
  sleep(2); /* now every core computes */
  size_t n = ask_health(&daemon, options->quick ? 3 : 15, samples, &rate);
  for (int i = 0; i < N_INTERACTIVE; i++) {
    size_t size;
    char *body = request_of(others, 1, "", &size), *reply;
    double begun = bench_now_s();
    int got = ask(&daemon, "POST", "/v1/evaluations", "Prefer: wait=30\r\n", body, size, &reply);
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
  ask(&daemon, "GET", "/v1/jobs?state=running", "", "", 0, &job);
  const char *done = strstr(job, "\"rollouts_done\":");
  printf("morphod under a batch of %d designs (%s rollouts done when the last figure was taken)\n", N_DESIGNS,
         done != NULL ? strtok(job + (done - job) + 16, ",") : "all");
  missed += status != 202 || second_status != 202;
  missed += verdict("10,000 designs accepted, idle", idle_s * 1e3, 1000, "ms");
  missed += verdict("10,000 designs accepted while the cores compute", loaded_s * 1e3, 1000, "ms");
  missed += verdict("/healthz over 64 connections, 99th percentile", bench_quantile(samples, n, 0.99) * 1e3, 50, "ms");
  printf("  (median %.2f ms, longest %.1f ms, %.0f requests per second)\n", bench_median(samples, n) * 1e3,
         samples[n - 1] * 1e3, rate);
  missed += verdict("one interactive design × 10 environments, longest of 20",
                    bench_quantile(interactive, N_INTERACTIVE, 1) * 1e3, 1000, "ms");
  printf("  (median %.1f ms)\n", bench_median(interactive, N_INTERACTIVE) * 1e3);
  free(job);
  free(samples);
  mo_body_stream_free(stream);
  mo_body_stream_free(others);
  stop_daemon(&daemon);
  return missed > 0;
}
