/* worker.c: see worker.h. One thread runs the loop: it handles one reply, then `tend` starts the
 * next requests. Only the numbers at the end of the struct are shared with other threads.
 */
#include "worker/worker.h"

#include <inttypes.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>

#include "base/clock.h"
#include "base/text.h"
#include "worker/holding.h"
#include "worker/protocol.h"

#define ROUND_MS     1000 /* the longest wait of the loop */
#define PAUSE_MIN_MS 100
#define PAUSE_MAX_MS 5000
#define STEADY_MS    5000 /* after this time a session counts as stable */
#define CALM_MS      50   /* first pause after an empty reply that arrived immediately */
#define CALM_MAX_MS  250
/* Pause before weights that the daemon could not send are requested again. */
#define BUSY_MS       1000
#define DRAIN_MS      20000 /* limit of a drain that is not urgent */
#define LEAVE_MS      5000  /* timeout of the last request: a busy machine is slow */
#define ORDERS_WAIT_S 2
#define EXCHANGE_MS   15000 /* timeout of a call that does not wait */
#define JOIN_MS       10000
#define SMALL_REPLY   65536
#define LEASES_REPLY  (48u << 20)
#define WEIGHTS_REPLY (64u << 20)
#define WARN_AGAIN_MS 30000

enum phase { JOINING, ACTIVE, LEAVING, ENDED };

struct mo_worker {
  struct mo_worker_config config;
  struct mo_link *link;
  struct mo_holding *holding;
  struct mo_worker_session session;
  enum mo_worker_end end;
  struct mo_message why;
  int64_t joined_ms, leased_ms; /* leased: when the worker last held a lease */
  int64_t lost_ms;              /* start of the time without a stable session; −1: one exists */
  int64_t next_join_ms, next_leases_ms, next_weights_ms;
  int64_t warned_ms;
  int64_t give_back_ms, end_ms; /* when a drain cancels running leases; when the worker leaves in
                                 * any case */
  uint32_t calm_ms, leases_wait_s;
  int64_t leases_asked_ms;
  bool is_draining;
  char wanted[32]; /* the version required by a drain for an upgrade; "": none */
  struct mo_sha256 weights_asked;
  atomic_int phase, stops; /* stops: number of stop requests */
};

static int64_t now_ms(void)
{
  return mo_clock_us() / 1000;
}

static void say(const struct mo_worker *worker, enum mo_worker_news news, const char *what,
                const char *detail)
{
  worker->config.say(worker->config.context, news, what, detail);
}

static void finish(struct mo_worker *worker, enum mo_worker_end end, const char *why)
{
  worker->end = end;
  snprintf(worker->why.text, sizeof(worker->why.text), "%s", why);
  worker->phase = ENDED;
}

/* Finishes a drain. */
static void finish_leaving(struct mo_worker *worker)
{
  char why[64];
  snprintf(why, sizeof(why), "the daemon requires version %s", worker->wanted);
  if (worker->wanted[0] != '\0')
    finish(worker, MO_WORKER_UNWANTED, why);
  else
    finish(worker, MO_WORKER_LEFT, "");
}

static bool out_of_memory(struct mo_worker *worker, int error)
{
  if (error == MO_ERR_NO_MEMORY)
    finish(worker, MO_WORKER_FAILED, "out of memory");
  return error == MO_ERR_NO_MEMORY;
}

/* ---- losing the daemon ---- */

/* Draws a pause below a quarter of the outage so far, so that a short outage costs little, and
 * after a long one the workers do not all return at once. */
static int64_t pause_ms(int64_t outage_ms)
{
  int64_t most = outage_ms / 4;
  uint32_t random = 0;
  most = most < PAUSE_MIN_MS ? PAUSE_MIN_MS : most > PAUSE_MAX_MS ? PAUSE_MAX_MS : most;
  (void)!getrandom(&random, sizeof(random), GRND_NONBLOCK);
  return random % most;
}

static void warn_of_outage(struct mo_worker *worker, int64_t now, const char *why)
{
  if (worker->warned_ms >= 0 && now - worker->warned_ms < WARN_AGAIN_MS)
    return;
  worker->warned_ms = now;
  say(worker, MO_WORKER_WARNING, "no session with the daemon; retrying", why);
}

/* Ends the session in any state, and plans the next one. */
static void lose(struct mo_worker *worker, uint32_t retry_after_s, const char *why)
{
  const int64_t now = now_ms();
  for (int call = 0; call < MO_CALLS; call++)
    mo_link_abort(worker->link, (enum mo_call)call);
  mo_holding_drop(worker->holding, NULL);
  if (worker->is_draining) {
    finish_leaving(worker);
    return;
  }
  if (worker->lost_ms < 0)
    worker->lost_ms = now;
  int64_t pause = pause_ms(now - worker->lost_ms);
  if (retry_after_s > 0 && pause < PAUSE_MAX_MS)
    pause = (retry_after_s < 5 ? 1000 * (int64_t)retry_after_s : PAUSE_MAX_MS) + pause;
  worker->next_join_ms = now + pause;
  worker->phase = JOINING;
  warn_of_outage(worker, now, why);
}

static void found(struct mo_worker *worker)
{
  if (worker->lost_ms >= 0 && worker->warned_ms >= 0)
    say(worker, MO_WORKER_INFO, "the daemon is available again", worker->config.link.server);
  worker->lost_ms = -1;
  worker->warned_ms = -1;
}

/* Handles replies other than success; returns whether the reply is a success. */
static bool is_good(struct mo_worker *worker, const struct mo_link_reply *reply)
{
  struct mo_message detail = {""};
  char why[sizeof(detail.text)];
  if (reply->error == MO_OK && reply->status >= 200 && reply->status < 300)
    return true;
  if (reply->error == MO_OK)
    mo_protocol_get_detail((const char *)reply->body, reply->size, &detail);
  snprintf(why, sizeof(why), "%d: %.160s%s", reply->status, detail.text,
           worker->phase == JOINING && reply->status == 404
               ? "; --server must be the address of the daemon's fleet_listen, not of its API"
               : "");
  if (reply->error == MO_ERR_INVALID)
    finish(worker, MO_WORKER_DENIED, reply->why);
  else if (reply->error != MO_OK)
    lose(worker, 0, reply->why);
  else if (reply->status == 401 || reply->status == 403)
    finish(worker, MO_WORKER_DENIED, why);
  else if (reply->status == 409)
    finish(worker, MO_WORKER_REFUSED, why);
  else if (worker->phase == JOINING && reply->status == 422)
    finish(worker, MO_WORKER_UNWANTED, why);
  else if (worker->phase == JOINING && reply->status >= 300 && reply->status < 500 &&
           reply->status != 408 && reply->status != 429)
    finish(worker, MO_WORKER_MISPLACED, why);
  else
    lose(worker, reply->retry_after_s, reply->status == 404 ? "the session no longer exists" : why);
  return false;
}

/* ---- requests ---- */

static void request(struct mo_worker *worker, enum mo_call call,
                    const struct mo_link_request *request)
{
  (void)out_of_memory(worker, mo_link_start(worker->link, call, request));
}

static const char *path_of(const struct mo_worker *worker, const char *rest, char path[96])
{
  snprintf(path, 96, "/v1/fleet/sessions/%s%s", worker->session.id, rest);
  return path;
}

static void ask_for_session(struct mo_worker *worker)
{
  struct mo_text text = {0};
  mo_protocol_put_offer(&worker->config.offer, &text);
  if (text.failed)
    (void)out_of_memory(worker, MO_ERR_NO_MEMORY);
  else
    request(worker, MO_CALL_SESSION,
            &(struct mo_link_request){.method = "POST",
                                      .path = "/v1/fleet/sessions",
                                      .type = "application/json",
                                      .body = text.data,
                                      .size = text.size,
                                      .timeout_ms = JOIN_MS,
                                      .limit = SMALL_REPLY});
  mo_text_free(&text);
}

static void ask_for_orders(struct mo_worker *worker)
{
  char path[96];
  request(worker, MO_CALL_ORDERS,
          &(struct mo_link_request){.method = "GET",
                                    .path = path_of(worker, "/orders", path),
                                    .wait_s = ORDERS_WAIT_S,
                                    .timeout_ms = worker->session.silence_ms,
                                    .limit = SMALL_REPLY});
}

/* Sends results or waits for leases, never both, so that a wait can be aborted without loss. */
static void exchange(struct mo_worker *worker, struct mo_wire_results *results, uint32_t wait_s)
{
  char path[96];
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int error = mo_wire_put_results(results, &bytes, &size);
  if (error != MO_OK)
    finish(worker, MO_WORKER_FAILED, mo_error_text(error));
  else
    request(worker, wait_s > 0 ? MO_CALL_LEASES : MO_CALL_RESULTS,
            &(struct mo_link_request){.method = "POST",
                                      .path = path_of(worker, "/exchange", path),
                                      .type = "application/octet-stream",
                                      .body = bytes,
                                      .size = size,
                                      .wait_s = wait_s,
                                      .timeout_ms = EXCHANGE_MS + 1000 * wait_s,
                                      .limit = LEASES_REPLY,
                                      .has_digest = true});
  free(bytes);
  mo_wire_free_results(results);
}

static void ask_for_weights(struct mo_worker *worker, const struct mo_sha256 *hash)
{
  char digits[MO_SHA256_DIGITS + 1], path[96];
  mo_sha256_to_hex(hash, digits);
  snprintf(path, sizeof(path), "/v1/fleet/controllers/%s", digits);
  worker->weights_asked = *hash;
  request(
      worker, MO_CALL_WEIGHTS,
      &(struct mo_link_request){
          .method = "GET", .path = path, .timeout_ms = 2 * EXCHANGE_MS, .limit = WEIGHTS_REPLY});
}

static void leave(struct mo_worker *worker)
{
  char path[96];
  /* The request for orders stays open, because its end would look like a lost session. */
  worker->phase = LEAVING;
  request(worker, MO_CALL_SESSION,
          &(struct mo_link_request){.method = "DELETE",
                                    .path = path_of(worker, "", path),
                                    .timeout_ms = LEAVE_MS,
                                    .limit = SMALL_REPLY});
}

/* ---- replies ---- */

static void joined(struct mo_worker *worker, const struct mo_link_reply *reply)
{
  struct mo_message why = {""};
  const int64_t now = now_ms();
  if (!is_good(worker, reply))
    return;
  int error =
      mo_protocol_get_session((const char *)reply->body, reply->size, &worker->session, &why);
  if (error == MO_OK)
    error = mo_holding_set_workspace(worker->holding, worker->session.workspace);
  if (out_of_memory(worker, error))
    return;
  if (error != MO_OK) {
    finish(worker, MO_WORKER_MISPLACED, why.text);
    return;
  }
  worker->phase = ACTIVE;
  worker->joined_ms = now;
  worker->next_leases_ms = now;
  worker->calm_ms = CALM_MS;
  say(worker, MO_WORKER_INFO, "joined the daemon", worker->config.link.server);
}

static void take_leases(struct mo_worker *worker, const struct mo_link_reply *reply, bool waited)
{
  struct mo_wire_leases leases = {0};
  struct mo_message why = {""};
  const int64_t now = now_ms();
  if (!is_good(worker, reply))
    return;
  int error = reply->size == 0 ? MO_OK
                               : mo_wire_get_leases(reply->body, reply->size,
                                                    worker->session.workspace, &leases, &why);
  const uint32_t n = leases.n;
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    error = mo_holding_add(worker->holding, &leases.items[i]);
  mo_wire_free_leases(&leases);
  if (out_of_memory(worker, error))
    return;
  if (error != MO_OK) {
    lose(worker, 0, why.text[0] != '\0' ? why.text : "the daemon sent too many leases");
    return;
  }
  found(worker);
  if (n > 0) {
    worker->calm_ms = CALM_MS;
    worker->next_leases_ms = now;
  } else if (waited && now - worker->leases_asked_ms < 500 * (int64_t)worker->leases_wait_s) {
    /* The daemon replied at once instead of letting the request wait. */
    worker->next_leases_ms = now + worker->calm_ms;
    worker->calm_ms = worker->calm_ms * 2 < CALM_MAX_MS ? worker->calm_ms * 2 : CALM_MAX_MS;
  }
}

static void take_weights(struct mo_worker *worker, const struct mo_link_reply *reply)
{
  struct mo_message why = {""};
  if (reply->error == MO_OK && (reply->status == 404 || reply->status == 503)) {
    /* 404: the leases of the session no longer exist, either. 503: the leases are returned, because
     * the bodies of leases that a lost session held become suspects. */
    if (reply->status == 503)
      worker->next_weights_ms = now_ms() + BUSY_MS;
    mo_holding_miss_weights(worker->holding, &worker->weights_asked);
    return;
  }
  if (!is_good(worker, reply))
    return;
  const int error = mo_holding_add_weights(worker->holding, &worker->weights_asked, reply->body,
                                           reply->size, &why);
  if (error == MO_ERR_EXHAUSTED)
    mo_holding_miss_weights(worker->holding, &worker->weights_asked);
  else if (error != MO_OK && !out_of_memory(worker, error))
    lose(worker, 0, why.text[0] != '\0' ? why.text : mo_error_text(error));
}

/* Takes no more leases, and leaves when the current ones are done, or at the time limit. */
static void drain(struct mo_worker *worker, int64_t limit_ms, const char *why)
{
  const int64_t now = now_ms();
  worker->is_draining = true;
  worker->give_back_ms = now + limit_ms;
  worker->end_ms = now + limit_ms + 2 * LEAVE_MS;
  say(worker, MO_WORKER_INFO, "leaving", why);
  mo_link_abort(worker->link, MO_CALL_LEASES);
  if (worker->phase != ACTIVE)
    finish_leaving(worker);
}

static void take_orders(struct mo_worker *worker, const struct mo_link_reply *reply)
{
  struct mo_fleet_orders orders;
  struct mo_message why = {""};
  if (!is_good(worker, reply))
    return;
  const int error = mo_protocol_get_orders((const char *)reply->body, reply->size, &orders, &why);
  if (out_of_memory(worker, error))
    return;
  if (error != MO_OK) {
    lose(worker, 0, why.text);
    return;
  }
  for (uint32_t i = 0; i < orders.n_dropped; i++)
    mo_holding_drop(worker->holding, &orders.dropped[i]);
  if (orders.state == MO_SESSION_REFUSED)
    finish(worker, MO_WORKER_REFUSED,
           "the daemon refused this session because it returned wrong bits");
  else if (orders.state == MO_SESSION_DRAINING && !worker->is_draining) {
    memcpy(worker->wanted, orders.wanted, sizeof(worker->wanted));
    drain(worker, DRAIN_MS,
          orders.wanted[0] != '\0' ? "the daemon is draining this worker for an upgrade"
                                   : "the daemon is draining this worker");
  }
  if (now_ms() - worker->joined_ms >= STEADY_MS)
    found(worker);
}

static void handle(struct mo_worker *worker, enum mo_call call, const struct mo_link_reply *reply)
{
  switch (call) {
  case MO_CALL_SESSION:
    if (worker->phase == LEAVING)
      finish_leaving(worker);
    else
      joined(worker, reply);
    break;
  case MO_CALL_ORDERS: take_orders(worker, reply); break;
  case MO_CALL_RESULTS: take_leases(worker, reply, false); break;
  case MO_CALL_LEASES: take_leases(worker, reply, true); break;
  case MO_CALL_WEIGHTS: take_weights(worker, reply); break;
  case MO_CALLS: break;
  }
}

/* ---- the loop ---- */

/* Gives up, leaves, or continues, depending on the clock. */
static void watch_clock(struct mo_worker *worker, int64_t now)
{
  const struct mo_worker_config *config = &worker->config;
  const int stops = worker->stops;
  if (stops > 0)
    worker->wanted[0] = '\0'; /* the stop was requested here, not by the daemon */
  if (stops > 1 || (worker->is_draining && now >= worker->end_ms))
    finish_leaving(worker);
  else if (stops == 1 && (!worker->is_draining || worker->give_back_ms > now + MO_WORKER_STOP_MS)) {
    drain(worker, MO_WORKER_STOP_MS, "stop requested");
    mo_holding_give_back(worker->holding, false);
  } else if (worker->is_draining) {
    if (now >= worker->give_back_ms)
      mo_holding_give_back(worker->holding, true);
  } else if (config->leave_at_us > 0 && mo_clock_wall_us() >= config->leave_at_us) {
    drain(worker, DRAIN_MS, "the job's time limit is near");
  } else if (config->idle_ms > 0 && now - worker->leased_ms >= (int64_t)config->idle_ms) {
    drain(worker, MO_WORKER_STOP_MS, "no lease within the time set by --leave-when-idle");
  } else if (config->give_up_ms > 0 && worker->lost_ms >= 0 && worker->phase == JOINING &&
             now - worker->lost_ms >= (int64_t)config->give_up_ms) {
    finish(worker, MO_WORKER_UNREACHABLE,
           "could not open a session within the time set by --give-up");
  }
}

/* Returns whether a class that the worker serves has room for another lease. */
static bool has_room(const struct mo_worker *worker, const struct mo_holding_status *status)
{
  for (size_t back_end = 0; back_end < 2; back_end++)
    if (worker->config.offer.classes[back_end].scores[0] != '\0' &&
        status->n_leases[back_end] < MO_FLEET_LEASES)
      return true;
  return false;
}

static void tend_session(struct mo_worker *worker, int64_t now)
{
  struct mo_holding_status status;
  struct mo_sha256 hash;
  struct mo_wire_results results = {0};
  struct mo_link *link = worker->link;
  if (!mo_link_is_busy(link, MO_CALL_ORDERS))
    ask_for_orders(worker);
  if (mo_holding_start(worker->holding, &hash) && !mo_link_is_busy(link, MO_CALL_WEIGHTS) &&
      now >= worker->next_weights_ms)
    ask_for_weights(worker, &hash);
  const bool is_sending = mo_link_is_busy(link, MO_CALL_RESULTS);
  if (!is_sending)
    mo_holding_take_results(worker->holding, &results);
  if (results.n > 0) {
    exchange(worker, &results, 0);
    return;
  }
  mo_holding_get_status(worker->holding, &status);
  const uint32_t n_leases = status.n_leases[MO_ON_CPU] + status.n_leases[MO_ON_DEVICE];
  if (n_leases > 0)
    worker->leased_ms = now;
  if (worker->is_draining) {
    if (n_leases + status.n_results == 0 && !is_sending)
      leave(worker);
  } else if (has_room(worker, &status) && !is_sending && !mo_link_is_busy(link, MO_CALL_LEASES) &&
             now >= worker->next_leases_ms) {
    worker->leases_asked_ms = now;
    worker->leases_wait_s = worker->session.wait_s < 30 ? worker->session.wait_s : 30;
    exchange(worker, &results, worker->leases_wait_s);
  }
}

/* Returns how long the loop may wait. */
static uint32_t tend(struct mo_worker *worker)
{
  const int64_t now = now_ms();
  int64_t next = now + ROUND_MS;
  watch_clock(worker, now);
  if (worker->phase == JOINING && !mo_link_is_busy(worker->link, MO_CALL_SESSION)) {
    if (now >= worker->next_join_ms)
      ask_for_session(worker);
    else if (worker->next_join_ms < next)
      next = worker->next_join_ms;
  }
  if (worker->phase == ACTIVE) {
    tend_session(worker, now);
    if (worker->next_leases_ms > now && worker->next_leases_ms < next)
      next = worker->next_leases_ms;
    if (worker->next_weights_ms > now && worker->next_weights_ms < next)
      next = worker->next_weights_ms;
  }
  if (worker->is_draining && worker->give_back_ms > now && worker->give_back_ms < next)
    next = worker->give_back_ms;
  return next > now ? (uint32_t)(next - now) : 0;
}

enum mo_worker_end mo_worker_run(struct mo_worker *worker, struct mo_message *message)
{
  worker->leased_ms = worker->lost_ms = now_ms();
  while (worker->phase != ENDED) {
    struct mo_link_reply reply = {0};
    const uint32_t wait_ms = tend(worker);
    if (worker->phase == ENDED)
      break;
    const int call = mo_link_next(worker->link, wait_ms, &reply);
    if (call >= 0)
      handle(worker, (enum mo_call)call, &reply);
    free(reply.body);
  }
  *message = worker->why;
  return worker->end;
}

/* ---- start and stop ---- */

static void wake(void *context)
{
  struct mo_worker *worker = context;
  mo_link_wake(worker->link);
}

int mo_worker_create(const struct mo_worker_config *config, struct mo_worker **ret,
                     struct mo_message *message)
{
  struct mo_worker *worker = calloc(1, sizeof(*worker));
  if (worker == NULL)
    return MO_ERR_NO_MEMORY;
  worker->config = *config;
  worker->warned_ms = -1;
  int error = mo_link_create(&config->link, &worker->link, message);
  if (error == MO_OK)
    error = mo_holding_create(
        &(struct mo_holding_config){.compute = config->compute, .ended = wake, .context = worker},
        &worker->holding);
  if (error != MO_OK) {
    mo_worker_free(worker);
    return error;
  }
  *ret = worker;
  return MO_OK;
}

void mo_worker_free(struct mo_worker *worker)
{
  if (worker == NULL)
    return;
  mo_holding_free(worker->holding);
  mo_link_free(worker->link);
  free(worker);
}

void mo_worker_stop(struct mo_worker *worker)
{
  atomic_fetch_add(&worker->stops, 1);
  mo_link_wake(worker->link);
}

void mo_worker_describe(struct mo_worker *worker, char *text, size_t capacity)
{
  static const char *const words[] = {
      [JOINING] = "no session", [ACTIVE] = "joined", [LEAVING] = "leaving", [ENDED] = "left"};
  struct mo_holding_status status;
  mo_holding_get_status(worker->holding, &status);
  snprintf(text, capacity, "%s: %s, %s held, %" PRIu64 " done, %s", worker->config.link.server,
           words[worker->phase],
           MO_COUNTED(status.n_leases[MO_ON_CPU] + status.n_leases[MO_ON_DEVICE], "lease"),
           status.leases_done, MO_COUNTED(status.rows_done, "rollout"));
}
