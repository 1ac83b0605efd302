/* server.c: the server from inside: limits, heartbeats, logs, and an orderly shutdown no matter
 * what its clients do. */
#include "unit/check.h"

#include <arpa/inet.h>
#include <dirent.h>
#include <errno.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>

#include "api/api.h"
#include "store/internal.h"
#include "unit/jobs/service.h"

static char address[128];
static uint16_t port;
static atomic_uint logged[600];
static char last_path[64], last_method[16];
static pthread_mutex_t last_lock = PTHREAD_MUTEX_INITIALIZER;

static void log_request(void *context, const struct mo_http_log_entry *entry)
{
  (void)context;
  atomic_fetch_add(&logged[entry->status], 1);
  pthread_mutex_lock(&last_lock);
  snprintf(last_path, sizeof(last_path), "%s", entry->path);
  snprintf(last_method, sizeof(last_method), "%s", entry->method);
  pthread_mutex_unlock(&last_lock);
}

static struct mo_api *api; /* of the current case */

/* Fills in what a case leaves out, with the daemon's defaults. */
static void fill(struct mo_http_config *config)
{
  uint32_t *const counts[] = {&config->max_connections, &config->max_streams,
                              &config->max_in_flight,   &config->header_timeout_ms,
                              &config->body_timeout_ms, &config->idle_timeout_ms};
  static const uint32_t usual[] = {1024, 256, 64, 10000, 60000, 60000};
  for (size_t i = 0; i < sizeof(usual) / sizeof(usual[0]); i++)
    if (*counts[i] == 0)
      *counts[i] = usual[i];
  if (config->max_body_bytes == 0)
    config->max_body_bytes = UINT64_C(32) << 20;
  config->max_file_bytes = UINT64_C(16) << 20;
  if (config->max_body_memory == 0)
    config->max_body_memory = UINT64_C(256) << 20;
}

static bool start(struct mo_http_config config)
{
  struct mo_message message = {""};
  int fd = -1;
  if (mo_http_listen("127.0.0.1:0", &fd, address, &message) != MO_OK) {
    printf("# %s\n", message.text);
    return false;
  }
  port = (uint16_t)strtoul(strrchr(address, ':') + 1, NULL, 10);
  config.listeners = &fd;
  config.n_listeners = 1;
  config.log = log_request;
  fill(&config);
  const struct mo_api_services services = {store,  service.jobs, service.compute,
                                           "test", NULL,         MO_DASHBOARD_ON};
  int code = mo_api_start(&config, &services, &api, &message);
  if (code != MO_OK)
    printf("# %s\n", message.text);
  else
    mo_http_set_ready(mo_api_http(api), true);
  return code == MO_OK;
}

static int dial(void)
{
  struct sockaddr_in name = {
      .sin_family = AF_INET, .sin_port = htons(port), .sin_addr = {htonl(INADDR_LOOPBACK)}};
  struct timeval limit = {.tv_sec = 30};
  int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (fd >= 0 && connect(fd, (struct sockaddr *)&name, sizeof(name)) != 0) {
    close(fd);
    return -1;
  }
  setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof(limit));
  return fd;
}

/* Sends a request; returns the socket, or −1. */
static int say(const char *method, const char *path, const char *headers, const char *body)
{
  char request[2048];
  int fd = dial();
  int n = snprintf(request, sizeof(request),
                   "%s %s HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Type: "
                   "application/json\r\nContent-Length: %zu\r\n%s\r\n%s",
                   method, path, strlen(body), headers, body);
  if (fd >= 0 && send(fd, request, (size_t)n, MSG_NOSIGNAL) != n) {
    close(fd);
    return -1;
  }
  return fd;
}

/* Reads to the end; returns the status, or 0 without a reply. */
static int receive(int fd, char *text, size_t size)
{
  size_t n = 0;
  ssize_t part = 0;
  while (fd >= 0 && n + 1 < size && (part = recv(fd, text + n, size - n - 1, 0)) > 0)
    n += (size_t)part;
  text[n] = '\0';
  if (fd >= 0)
    close(fd);
  return n > 12 ? (int)strtol(text + 9, NULL, 10) : 0;
}

static char text[4 << 20]; /* the last complete reply */

static int finish(int fd)
{
  return receive(fd, text, sizeof(text));
}

static int ask(const char *method, const char *path, const char *headers, const char *body)
{
  return finish(say(method, path, headers, body));
}

/* Sends an evaluation of one robot. */
static int submit(int n_steps, const char *headers)
{
  char body[256];
  snprintf(body, sizeof(body), "{\"designs\":[{\"cells\":[[0,0,0]]}],\"physics\":{\"n_steps\":%d}}",
           n_steps);
  return say("POST", "/v1/evaluations", headers, body);
}

static int descriptors(void)
{
  int n = 0;
  DIR *folder = opendir("/proc/self/fd");
  while (folder != NULL && readdir(folder) != NULL)
    n++;
  if (folder != NULL)
    closedir(folder);
  return n;
}

static void pause_ms(long ms)
{
  struct timespec time = {ms / 1000, ms % 1000 * 1000000};
  nanosleep(&time, NULL);
}

/* ---- cases ---- */

static void configuration(void)
{
  static const struct mo_token brief[] = {{"admin", MO_RIGHT_ADMIN, "short"}},
                               good[] = {{"admin", MO_RIGHT_ADMIN, "a-token-that-is-long-enough"}};
  const struct mo_api_services services = {store,  service.jobs, service.compute,
                                           "test", NULL,         MO_DASHBOARD_ON};
  struct mo_http_config config = {0};
  struct mo_message message;
  int fd;
  fill(&config);
  CHECK_INT(mo_api_start(&config, &services, &api, &message), MO_ERR_INVALID); /* no listener */
  REQUIRE(mo_http_listen("0.0.0.0:0", &fd, address, &message) == MO_OK);
  config.listeners = &fd;
  config.n_listeners = 1;
  CHECK_INT(mo_api_start(&config, &services, &api, &message), MO_ERR_INVALID); /* no token */
  CHECK(strstr(message.text, "token") != NULL);
  REQUIRE(mo_http_listen("127.0.0.1:0", &fd, address, &message) == MO_OK);
  config.tokens = brief;
  config.n_tokens = 1;
  CHECK_INT(mo_api_start(&config, &services, &api, &message),
            MO_ERR_INVALID); /* a token that is too short */
  REQUIRE(mo_http_listen("0.0.0.0:0", &fd, address, &message) == MO_OK);
  config.tokens = good;
  REQUIRE(mo_api_start(&config, &services, &api, &message) == MO_OK);
  CHECK_INT(mo_http_set_tokens(mo_api_http(api), NULL, 0, &message), MO_ERR_INVALID);
  CHECK_INT(mo_http_set_tokens(mo_api_http(api), brief, 1, &message), MO_ERR_INVALID);
  CHECK_INT(mo_http_set_tokens(mo_api_http(api), good, 1, &message), MO_OK);
  mo_api_stop(api, 0);
  mo_api_stop(NULL, 0);
}

static void addresses(void)
{
  struct mo_message message;
  char path[300], where[320];
  int fd, other;
  char unused[128];
  bool beyond;
  static const char *const bad[] = {"",           "127.0.0.1",       ":80",
                                    "127.0.0.1:", "127.0.0.1:99999", "127.0.0.1:8x",
                                    "::1:80",     "unix:relative",   "[::1:80"};
  for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
    CHECK_INT(mo_http_listen(bad[i], &fd, address, &message), MO_ERR_INVALID);
  REQUIRE(mo_http_listen("127.0.0.1:0", &fd, address, &message) == MO_OK);
  CHECK(strncmp(address, "http://127.0.0.1:", 17) == 0);
  CHECK_INT(mo_http_listen(address + 7, &other, unused, &message), MO_ERR_CONFLICT);
  CHECK(mo_http_describe(fd, address, &beyond, &message) == MO_OK && !beyond);
  close(fd);
  CHECK_INT(mo_http_describe(0, address, &beyond, &message), MO_ERR_INVALID);
  snprintf(path, sizeof(path), "%s/socket", fixture.path);
  snprintf(where, sizeof(where), "unix:%s", path);
  REQUIRE(mo_http_listen(where, &fd, address, &message) == MO_OK);
  CHECK_TEXT(address, where);
  /* A server is listening. */
  CHECK_INT(mo_http_listen(where, &other, unused, &message), MO_ERR_CONFLICT);
  close(fd);
  REQUIRE(mo_http_listen(where, &fd, address, &message) == MO_OK); /* nothing listens */
  close(fd);
  unlink(path);
  FILE *file = fopen(path, "w");
  REQUIRE(file != NULL);
  fclose(file);
  CHECK_INT(mo_http_listen(where, &fd, NULL, &message),
            MO_ERR_CONFLICT); /* not a socket: left untouched */
  CHECK(access(path, F_OK) == 0);
  unlink(path);
}

/* Path of a recording of many megabytes: if a client does not read it, its request stays in
 * flight. */
static bool record(char path[64])
{
  int status = ask("POST", "/v1/evaluations", "Prefer: wait=20\r\n",
                   "{\"designs\":[{\"cells\":[[0,0,0]]}],\"environments\":[{\"light_xy_m\":[4,2],"
                   "\"terrain_sigma_m\":0,\"seed\":1}],"
                   "\"physics\":{\"n_steps\":100000},\"record\":[\"masses\"],\"record_stride\":1}");
  const char *id = strstr(text, "/v1/evaluations/");
  if (id != NULL)
    snprintf(path, 64, "%.*s/trajectories/0", (int)strcspn(id, "\r"), id);
  return status == 200 && id != NULL;
}

/* The start of a reply has arrived; the rest is not read. */
static bool begins(int fd)
{
  return fd >= 0 && recv(fd, text, sizeof(text), MSG_WAITALL) == sizeof(text) &&
         memcmp(text + 9, "200", 3) == 0;
}

/* After clients have left, the service notices it soon, and then serves the path. */
static bool is_free_again(const char *path)
{
  int status = 0;
  for (int i = 0; i < 300 && status != 200; i++) {
    pause_ms(100);
    status = ask("GET", path, "", "");
  }
  return status == 200;
}

static void limits(void)
{
  char path[64];
  REQUIRE(start((struct mo_http_config){.max_in_flight = 2}));
  atomic_store(&fake_plan.delay_us, 1000000);
  int first = submit(11, "Prefer: wait=20\r\n");
  int second = submit(12, "Prefer: wait=20\r\n");
  struct mo_http_stats stats = {0};
  for (int i = 0; i < 500 && stats.in_flight < 2; i++) {
    pause_ms(2);
    mo_http_get_stats(mo_api_http(api), &stats);
  }
  int status = 429;
  for (int i = 0; i < 100 && status == 429; i++, pause_ms(5))
    status = ask("GET", "/v1/jobs", "", "");
  CHECK_INT(status, 200); /* these wait, but occupy no thread */
  mo_http_get_stats(mo_api_http(api), &stats);
  CHECK(stats.in_flight >= 2 && stats.requests >= 1 && stats.heartbeat_us > 0);
  atomic_store(&fake_plan.delay_us, 0);
  CHECK_INT(finish(first), 200);
  CHECK_INT(finish(second), 200);
  REQUIRE(record(path));
  first = say("GET", path, "", "");
  second = say("GET", path, "", "");
  CHECK(begins(first) && begins(second));
  CHECK_INT(ask("GET", "/v1/jobs", "", ""), 429);
  CHECK(strstr(text, "Retry-After: 1") != NULL);
  CHECK_INT(ask("GET", "/healthz", "", ""), 200);
  close(first);
  close(second);
  CHECK(is_free_again("/v1/jobs"));
  mo_api_stop(api, 1000);
}

/* Lists that all wait for the store leave threads to requests that do not need it. */
static void lists_leave_threads(void)
{
  enum { LISTS = 12 };
  struct mo_connection **held = calloc(store->n_readers, sizeof(struct mo_connection *));
  int lists[LISTS];
  REQUIRE(start((struct mo_http_config){0}) && held != NULL);
  for (uint32_t i = 0; i < store->n_readers; i++)
    held[i] = mo_reader_acquire(store);
  for (int i = 0; i < LISTS; i++)
    lists[i] = say("GET", i % 2 == 0 ? "/v1/jobs" : "/v1/trainings?limit=1", "", "");
  pause_ms(300);
  CHECK_INT(ask("POST", "/v1/evaluations", "", "{"), 400);
  for (uint32_t i = 0; i < store->n_readers; i++)
    mo_reader_release(store, held[i]);
  for (int i = 0; i < LISTS; i++)
    CHECK_INT(finish(lists[i]), 200);
  free(held);
  mo_api_stop(api, 1000);
}

static void streams_take_no_place(void)
{
  int streams[3];
  REQUIRE(start((struct mo_http_config){.max_in_flight = 2, .max_streams = 3}));
  for (int i = 0; i < 3; i++) {
    streams[i] = say("GET", "/v1/events", "", "");
    CHECK(streams[i] >= 0 && recv(streams[i], text, 12, MSG_WAITALL) == 12 &&
          memcmp(text + 9, "200", 3) == 0);
  }
  CHECK_INT(ask("GET", "/v1/jobs", "", ""), 200);
  CHECK_INT(ask("GET", "/v1/events", "", ""), 503); /* streams have their own limit */
  for (int i = 0; i < 3; i++)
    close(streams[i]);
  mo_api_stop(api, 1000);
}

/* ---- replies in several pieces: the phylogeny of a campaign ---- */

#define PHYLOGENY "/v1/campaigns/%lld/phylogeny?format=%s"
static long long campaign;

static void evolve(void)
{
  static const char body[] =
      "{\"mode\":\"zero-shot\",\"population\":1500,\"generations\":1,\"exclude_pretraining\":false,"
      "\"environments\":[{\"light_xy_m\":[4,2.5],\"terrain_sigma_m\":0.1,\"seed\":1}]}";
  char path[64];
  if (campaign != 0 || ask("POST", "/v1/campaigns", "", body) != 202)
    return;
  campaign = strtoll(strstr(text, "\"id\":\"") + 6, NULL, 10);
  snprintf(path, sizeof(path), "/v1/campaigns/%lld", campaign);
  for (int i = 0; i < 60 && strstr(text, "\"succeeded\"") == NULL; i++)
    ask("GET", path, "Prefer: wait=5\r\n", "");
}

/* Each reply in flight counts toward the memory of replies, no matter what its client does. */
static void long_replies(void)
{
  char path[96];
  REQUIRE(start((struct mo_http_config){.max_body_bytes = 1 << 20, .max_body_memory = 8 << 20}));
  evolve();
  REQUIRE(campaign > 0);
  snprintf(path, sizeof(path), PHYLOGENY, campaign, "csv");
  int fds[12], refused = 0;
  for (int i = 0; i < 12; i++) {
    int small = 2048;
    fds[i] = say("GET", path, "", "");
    if (i % 2 == 0)
      setsockopt(fds[i], SOL_SOCKET, SO_RCVBUF, &small, sizeof(small));
  }
  for (int i = 0; i < 12; i++)
    refused += recv(fds[i], text, 12, MSG_WAITALL) == 12 && memcmp(text + 9, "503", 3) == 0;
  printf("# %d of 12 refused\n", refused);
  for (int i = 0; i < 12; i += 2)
    close(fds[i]);
  for (int i = 1; i < 12; i += 2)
    CHECK(finish(fds[i]) >= 0);
  CHECK_INT(ask("GET", path, "", ""), 200); /* their memory has been released */
  mo_api_stop(api, 50);
}

/* Clients that do not read keep their replies in memory, up to the limit. */
static void memory(void)
{
  char path[64];
  REQUIRE(start((struct mo_http_config){.max_body_memory = 24 << 20}));
  REQUIRE(record(path));
  int slow = say("GET", path, "", "");
  CHECK(begins(slow));
  CHECK_INT(ask("GET", path, "", ""), 429); /* half of the memory is one client's limit */
  CHECK(strstr(text, "Retry-After") != NULL);
  CHECK_INT(ask("GET", "/v1/jobs", "", ""), 200);
  close(slow);
  CHECK(is_free_again(path));
  mo_api_stop(api, 1000);
  /* A request that waits for its result no longer needs its body. */
  REQUIRE(start((struct mo_http_config){.max_body_memory = 20000}));
  atomic_store(&fake_plan.delay_us, 2000000);
  int waiting = submit(13, "Prefer: wait=20\r\n"), status;
  pause_ms(150);
  while ((status = finish(submit(14, ""))) == 429 && /* its body is still being read */
         recv(waiting, text, 1, MSG_PEEK | MSG_DONTWAIT) < 0)
    pause_ms(20);
  CHECK_INT(status, 202);
  atomic_store(&fake_plan.delay_us, 0);
  CHECK_INT(finish(waiting), 200);
  mo_api_stop(api, 1000);
}

/* Waits until there are this many requests in flight and this many open jobs. */
static bool await_waiting(uint32_t requests, uint64_t jobs)
{
  struct mo_http_stats stats;
  return AWAIT((mo_http_get_stats(mo_api_http(api), &stats),
                stats.in_flight == requests && stats_of().open_jobs == jobs));
}

/* Cancels the evaluation of the last reply and the following ones, n in total: their blocks are
 * long. */
static void cancel(int n)
{
  const char *id = strstr(text, "/v1/evaluations/");
  REQUIRE(id != NULL);
  const int64_t first = strtoll(id + strlen("/v1/evaluations/"), NULL, 10);
  for (int i = 0; i < n; i++)
    CHECK_OK(mo_jobs_cancel(service.jobs, first + i));
  atomic_store(&fake_plan.delay_us, 0);
}

static void waiting_ends_with_its_client(void)
{
  enum { CLIENTS = 7 };
  REQUIRE(start((struct mo_http_config){0}));
  atomic_store(&fake_plan.delay_us, LONG_US);
  REQUIRE(AWAIT(stats_of().open_jobs == 0)); /* those of earlier cases end */
  const int held = submit(51, "Prefer: wait=60\r\n");
  CHECK(await_waiting(1, 1));
  const double begun = now_s();
  for (uint64_t i = 0; i < CLIENTS; i++) {
    const int waiting = submit(51, "Prefer: wait=60\r\n");
    CHECK(await_waiting(2, 2 + i));
    close(waiting);
    CHECK(await_waiting(1, 2 + i));
  }
  CHECK(is_soon_after(begun));
  mo_api_stop(api, 1000);
  CHECK_INT(finish(held), 202);
  cancel(1 + CLIENTS);
}

static void waiting_ends_with_the_server(void)
{
  REQUIRE(start((struct mo_http_config){0}));
  REQUIRE(AWAIT(stats_of().open_jobs == 0)); /* those of earlier cases end */
  atomic_store(&fake_plan.delay_us, LONG_US);
  int waiting = submit(41, "Prefer: wait=60\r\n");
  CHECK(await_waiting(1, 1));
  const double begun = now_s();
  mo_api_stop(api, STOP_MS);
  CHECK(is_soon_after(begun));
  CHECK_INT(finish(waiting), 202); /* accepted unchanged */
  cancel(1);
}

static void heartbeats(void)
{
  REQUIRE(start((struct mo_http_config){.heartbeat_ms = 1000}));
  int fd = say("GET", "/v1/events", "", "");
  size_t n = 0;
  ssize_t part = 0;
  while (n + 1 < sizeof(text) && (part = recv(fd, text + n, sizeof(text) - n - 1, 0)) > 0) {
    n += (size_t)part;
    text[n] = '\0';
    char *first = strstr(text, ": \n\n");
    if (first != NULL && strstr(first + 4, ": \n\n") != NULL)
      break;
  }
  CHECK(part > 0);
  close(fd);
  mo_api_stop(api, 1000);
}

static void logs(void)
{
  REQUIRE(start((struct mo_http_config){0}));
  const unsigned before = atomic_load(&logged[404]), first = atomic_load(&logged[400]);
  CHECK_INT(ask("GET", "/no%20where/\x7f\"?secret=1", "", ""), 400); /* a control character */
  for (int i = 0; i < 5000 && atomic_load(&logged[400]) == first; i++)
    pause_ms(1); /* the reply closes the connection, and is logged when the connection closes */
  CHECK_INT(ask("DELETE", "/no%20where?secret=1", "", ""), 404);
  mo_api_stop(api, 1000);
  CHECK_INT(atomic_load(&logged[404]) - before, 1);
  CHECK_TEXT(last_path, "/no%20where");
  CHECK_TEXT(last_method, "DELETE");
}

static atomic_bool churning;

/* A client of one of several kinds, some of them rude, until the end. */
static void *client(void *context)
{
  unsigned sort = *(const unsigned *)context, seed = sort * 7919 + 1;
  char own[16384], path[96];
  snprintf(path, sizeof(path), PHYLOGENY, campaign, sort % 2 == 0 ? "csv" : "newick");
  while (atomic_load(&churning)) {
    seed = seed * 1103515245 + 12345;
    int fd;
    switch (sort % 6) {
    case 0: fd = say("GET", "/healthz", "", ""); break;
    case 1: fd = submit((int)(1 + seed % 5000), "Prefer: wait=5\r\n"); break;
    case 2: fd = say("GET", "/v1/events?after=0", "", ""); break;
    case 3: fd = say("GET", "/v1/jobs?limit=20", "", ""); break;
    case 5: fd = say("GET", path, "", ""); break;
    default: fd = dial(); break;
    }
    if (fd < 0)
      continue;
    if (sort % 6 == 2 || seed >> 16 & 1) { /* disconnects before the end */
      struct pollfd polled = {fd, POLLIN, 0};
      poll(&polled, 1, (int)(seed >> 20 & 15));
      if (seed >> 17 & 1) {
        struct linger reset = {1, 0};
        setsockopt(fd, SOL_SOCKET, SO_LINGER, &reset, sizeof(reset));
      }
      close(fd);
    } else if (sort % 6 == 4) {
      (void)!send(fd, "GET /he", 7, MSG_NOSIGNAL);
      close(fd);
    } else {
      receive(fd, own, sizeof(own));
    }
  }
  return NULL;
}

static void ends_under_churn(void)
{
  struct mo_http_config config = {
      .max_connections = 24, .max_streams = 4, .n_io_threads = 4, .header_timeout_ms = 200};
  pthread_t threads[18];
  unsigned sorts[18];
  int rounds = getenv("MORPHO_STOPS") != NULL ? atoi(getenv("MORPHO_STOPS")) : 16,
      before = descriptors();
  atomic_store(&fake_plan.delay_us, 3000);
  for (int round = 0; round < rounds; round++) {
    REQUIRE(start(config));
    atomic_store(&churning, true);
    for (unsigned i = 0; i < 18; i++) {
      sorts[i] = i;
      REQUIRE(pthread_create(&threads[i], NULL, client, &sorts[i]) == 0);
    }
    pause_ms(20 + round % 7 * 5);
    mo_api_stop(api, 50);
    atomic_store(&churning, false);
    for (unsigned i = 0; i < 18; i++)
      pthread_join(threads[i], NULL);
  }
  atomic_store(&fake_plan.delay_us, 0);
  CHECK(atomic_load(&logged[200]) > (unsigned)rounds);
  CHECK_INT(descriptors(), before);
}

static const struct check_case cases[] = {
    {"configuration", configuration},
    {"addresses", addresses},
    {"limits of one client", limits},
    {"lists leave threads to other requests", lists_leave_threads},
    {"streams do not occupy request threads", streams_take_no_place},
    {"long replies", long_replies},
    {"memory of replies", memory},
    {"waiting ends with its client", waiting_ends_with_its_client},
    {"waiting ends with the server", waiting_ends_with_the_server},
    {"heartbeats", heartbeats},
    {"logs", logs},
    {"ends in order under churn", ends_under_churn},
};

int main(int argc, char **argv)
{
  if (service_start(0) != MO_OK) {
    printf("Bail out! no service: %s\n", fixture.message.text);
    return 1;
  }
  return check_run(cases, COUNT(cases), argc, argv);
}
