/* server.c: start, stop, and the clock thread. See http.h for the threads. */
#include "http/server.h"

#include <linux/netlink.h>
#include <malloc.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/processors.h"

#define MANY_CONNECTIONS 64 /* peak from which freed memory is returned to the system */
#define ROUND_MS         100
#define TICK_MS          1000

/* ---- the clock ---- */

/* Returns memory to the system when most of many connections have been closed; malloc would keep
 * it. */
static void trim_memory(uint32_t n_connections, uint32_t *peak)
{
  if (n_connections > *peak)
    *peak = n_connections;
  if (*peak < MANY_CONNECTIONS || n_connections > *peak / 4)
    return;
  malloc_trim(0);
  *peak = n_connections;
}

/* Returns whether `period_ms` have passed since the last time. */
static bool is_due(int64_t *last_us, int period_ms, int64_t now_us)
{
  const bool due = now_us - *last_us >= (int64_t)period_ms * 1000;
  if (due)
    *last_us = now_us;
  return due;
}

static void *clock_thread(void *context)
{
  struct mo_http *http = context;
  const int tick_ms = http->service.tick_ms > 0 ? (int)http->service.tick_ms : TICK_MS;
  int64_t round_us = 0, tick_us = 0, second_us = 0;
  uint32_t peak = 0;
  while (!atomic_load(&http->clock_stop)) {
    const bool some_left = mo_connections_watch(http, tick_ms < ROUND_MS ? tick_ms : ROUND_MS);
    const int64_t now_us = mo_clock_us();
    const bool is_round = is_due(&round_us, ROUND_MS, now_us);
    if (some_left || is_round)
      mo_waits_end(http, -1, now_us);
    if (is_round) {
      mo_connections_expire(http, now_us);
      mo_linger_on(&http->lingering, now_us);
      trim_memory(atomic_load(&http->n_connections), &peak);
    }
    if (is_due(&second_us, 1000, now_us)) {
      mo_streams_tick(http, now_us);
      mo_clients_sweep(&http->clients, now_us);
    }
    const bool is_wanted = atomic_exchange(&http->tick_wanted, false);
    if (http->service.tick != NULL && (is_due(&tick_us, tick_ms, now_us) || is_wanted))
      http->service.tick(http->service.context);
    atomic_store(&http->clock_us, now_us);
  }
  return NULL;
}

void mo_http_tick_soon(struct mo_http *http)
{
  const uint64_t one = 1;
  atomic_store(&http->tick_wanted, true);
  (void)!write(http->tick_fd, &one, sizeof(one));
}

/* ---- start and stop ---- */

void mo_http_refuse_listeners(const struct mo_http_config *config)
{
  for (size_t i = 0; i < config->n_listeners; i++)
    close(config->listeners[i]);
}

/* Takes ownership of the listening sockets, and checks whether one is not on loopback. */
static int adopt_listeners(struct mo_http *http, const struct mo_http_config *config,
                           struct mo_message *message)
{
  http->listeners = calloc(config->n_listeners + 1, sizeof(*http->listeners));
  if (http->listeners == NULL) {
    mo_http_refuse_listeners(config);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the server");
  }
  int code = MO_OK;
  for (size_t i = 0; i < config->n_listeners; i++) {
    char address[128] = "";
    bool beyond = false;
    int described =
        mo_http_describe(config->listeners[i], address, &beyond, code == MO_OK ? message : NULL);
    if (code == MO_OK)
      code = described;
    http->beyond_loopback |= beyond;
    http->listeners[i] = (struct mo_listener){config->listeners[i],
                                              strncmp(address, "unix:", 5) == 0 ? MO_TRANSPORT_UNIX
                                              : beyond                          ? MO_TRANSPORT_TCP
                                                       : MO_TRANSPORT_LOOPBACK};
    http->n_listeners = i + 1;
  }
  if (code == MO_OK && config->n_listeners == 0)
    code = mo_fail(message, MO_ERR_INVALID, "no address to listen on is configured");
  return code;
}

static void destroy(struct mo_http *http)
{
  mo_tokens_free(&http->tokens);
  mo_clients_free(&http->clients);
  mo_linger_end(&http->lingering);
  const int files[] = {http->stop_fd, http->peers_fd, http->watch_fd, http->tick_fd};
  for (size_t i = 0; i < sizeof(files) / sizeof(files[0]); i++)
    if (files[i] >= 0)
      close(files[i]);
  /* If the library has not begun to serve a connection, it closes it without a callback. */
  for (size_t fd = 0; fd < http->connections_top; fd++)
    free(http->connections[fd]);
  free(http->connections);
  free(http->listeners);
  free(http);
}

static int prepare(struct mo_http *http, const struct mo_http_config *config,
                   struct mo_message *message)
{
  if (!mo_last_replies_init())
    return mo_fail(message, MO_ERR_INVALID,
                   "libmicrohttpd lacks MHD_queue_response and cannot be used");
  const uint32_t processors = mo_processors();
  if (http->config.n_io_threads == 0)
    http->config.n_io_threads = processors < 2 ? 2 : processors < 4 ? processors : 4;
  if (http->config.heartbeat_ms == 0)
    http->config.heartbeat_ms = 15000;
  if (http->config.max_queued == 0)
    http->config.max_queued = MO_QUEUED_MAX;
  if (getrandom(&http->id_key, sizeof(http->id_key), 0) != (ssize_t)sizeof(http->id_key))
    http->id_key = (uint64_t)mo_clock_us() << 20;
  http->id_key &= ~UINT64_C(0xFFFFFFFF); /* ids are a random prefix and a counter */
  int code = adopt_listeners(http, config, message);
  if (code == MO_OK)
    code = mo_connections_init(http, message);
  if (code == MO_OK)
    code = mo_tokens_set(&http->tokens, config->tokens, config->n_tokens, message);
  if (code == MO_OK && http->is_tls)
    code = mo_http_check_certificate(config->certificate, config->key, message);
  if (code == MO_OK && config->n_tokens == 0 &&
      (http->beyond_loopback || config->token_on_loopback))
    code = mo_fail(
        message, MO_ERR_INVALID,
        "an address that is not on loopback is served, so at least one bearer token is required");
  return code;
}

int mo_http_start(const struct mo_http_config *config, const struct mo_http_service *service,
                  struct mo_http **ret, struct mo_message *message)
{
  struct mo_http *http = malloc(sizeof(*http));
  if (http == NULL) {
    mo_http_refuse_listeners(config);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the server");
  }
  *http = (struct mo_http){
      .config = *config,
      .service = *service,
      .names = {config->allowed_hosts, config->n_allowed_hosts},
      .tokens.lock = PTHREAD_RWLOCK_INITIALIZER,
      .is_tls = config->certificate != NULL,
      .stop_fd = -1,
      .watch_fd = -1,
      .tick_fd = -1,
      .peers_fd = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_SOCK_DIAG),
      .connections_lock = PTHREAD_MUTEX_INITIALIZER,
      .lingering.lock = PTHREAD_MUTEX_INITIALIZER,
      .clients.lock = PTHREAD_MUTEX_INITIALIZER,
      .pool = {.lock = PTHREAD_MUTEX_INITIALIZER, .idle = PTHREAD_COND_INITIALIZER},
      .streams.lock = PTHREAD_MUTEX_INITIALIZER,
      .bodies_lock = PTHREAD_MUTEX_INITIALIZER};
  int code = prepare(http, config, message);
  if (code != MO_OK) {
    mo_acceptor_stop(http);
    destroy(http);
    return code;
  }
  code = mo_pool_start(http);
  if (code != MO_OK)
    mo_fail(message, code, "cannot start the API threads");
  *ret = http; /* set before the service's threads use it */
  if (code == MO_OK && service->start != NULL) {
    code = service->start(service->context, http);
    if (code != MO_OK)
      mo_fail(message, code, "cannot start the service: %s", mo_error_text(code));
  }
  if (code == MO_OK)
    code = mo_daemon_start(http, message);
  atomic_store(&http->clock_us, mo_clock_us());
  if (code == MO_OK && pthread_create(&http->clock, NULL, clock_thread, http) != 0)
    code = mo_fail(message, MO_ERR_NO_MEMORY, "cannot start the clock's thread");
  else
    http->clock_started = code == MO_OK;
  if (code == MO_OK)
    code = mo_acceptor_start(http, message);
  if (code != MO_OK) {
    mo_http_stop(http, 0);
    *ret = NULL;
  }
  return code;
}

void mo_http_set_ready(struct mo_http *http, bool ready)
{
  atomic_store(&http->ready, ready);
}

bool mo_http_is_ready(const struct mo_http *http)
{
  return atomic_load(&http->ready);
}

void *mo_http_context(const struct mo_request *request)
{
  return request->http->service.context;
}

int mo_http_set_tokens(struct mo_http *http, const struct mo_token *tokens, size_t n,
                       struct mo_message *message)
{
  const bool is_closed = http->config.token_if_any && http->tokens.n > 0;
  if (n == 0 && (http->beyond_loopback || http->config.token_on_loopback || is_closed))
    return mo_fail(message, MO_ERR_INVALID,
                   "at least one bearer token is required; the old tokens remain in use");
  return mo_tokens_set(&http->tokens, tokens, n, message);
}

void mo_http_stop(struct mo_http *http, uint32_t grace_ms)
{
  if (http == NULL)
    return;
  atomic_store(&http->ready, false);
  atomic_store(&http->stopping, true); /* from now on replies close their connections */
  mo_acceptor_stop(http);
  mo_streams_close(http);
  mo_pool_close(http); /* now no connection is suspended, which the library requires to stop */
  int64_t until_us = mo_clock_us() + (int64_t)grace_ms * 1000;
  while (atomic_load(&http->n_in_flight) > 0 && mo_clock_us() < until_us) {
    struct timespec pause = {.tv_nsec = 5000000};
    nanosleep(&pause, NULL);
  }
  /* Do not call MHD_quiesce_daemon: with several threads it can abort the process. */
  if (http->daemon != NULL)
    MHD_stop_daemon(http->daemon);
  if (http->clock_started) {
    atomic_store(&http->clock_stop, true);
    pthread_join(http->clock, NULL);
  }
  if (http->service.stop != NULL)
    http->service.stop(http->service.context); /* from now on no more events arrive */
  mo_pool_stop(http);
  destroy(http);
}
