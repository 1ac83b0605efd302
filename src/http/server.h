/* server.h: what the files of the HTTP room share. See http.h for the threads.
 *
 * Life of a request:
 * - libmicrohttpd's URI callback creates the request when its target is known.
 * - The header is checked and the body is received.
 * - Direct routes and refusals are answered at once. For other routes the connection is suspended
 *   and the request is queued for the API pool.
 * - An API thread handles the request. The request may be parked until a job ends.
 * - The connection is resumed, and its I/O thread sends the reply, logs the request and frees it.
 *
 * The connection owns the request: a request that the library never completes ends with its
 * connection. Only one thread has a request at a time; requests are handed over under the pool's
 * lock, or by libmicrohttpd's suspend and resume.
 *
 * Order in which locks may be taken: streams → pool → bodies → clients → connections →
 * libmicrohttpd's own. */
#ifndef MORPHO_HTTP_SERVER_H
#define MORPHO_HTTP_SERVER_H

#include <netinet/in.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>

#include <microhttpd.h>

#include "base/text.h"
#include "http/guard.h"
#include "http/http.h"
#include "http/metrics.h"
#include "http/problem.h"
#include "http/route.h"
#include "jobs/campaigns.h"
#include "jobs/evaluations.h"
#include "jobs/trainings.h"
#include "store/store.h"

#define MO_NEVER INT64_MAX

/* ---- connections (accept.c) ---- */

enum mo_transport { MO_TRANSPORT_LOOPBACK, MO_TRANSPORT_TCP, MO_TRANSPORT_UNIX };

/* A few connections are reserved: some for the unix socket, some for health requests. */
enum mo_place { MO_PLACE_ORDINARY, MO_PLACE_UNIX, MO_PLACE_HEALTH, MO_PLACES };

#define MO_GAVE_WAY INT64_MIN
#define MO_STALL_US 1000000 /* a request without progress for this long may be dropped */

struct mo_connection {
  struct mo_http *http;
  struct mo_request *request; /* the request in flight; used by the I/O thread only */
  int fd;
  enum mo_place place;
  enum mo_transport transport;
  unsigned char client_key[16]; /* the client, for limits: the peer's user if it is on this machine,
                                   else its address */
  char client[64];              /* for people */
  _Atomic int64_t deadline_us;  /* the clock thread cuts the connection then */
  bool lingers; /* closing at once could lose the last reply, while the client still sends */
  /* Says whether this connection may be cut when a new one needs its place. spare_us is the time
   * since which the connection is idle, or since which its request (receiving: one has begun) makes
   * no progress. MO_NEVER: a whole request has arrived. */
  atomic_bool receiving;
  _Atomic int64_t spare_us; /* MO_GAVE_WAY: already cut */
};
/* Sets spare_us. False: the connection was already cut; what it received must not be handled. */
bool mo_connection_spare(struct mo_connection *connection, int64_t since_us);

bool mo_address_is_loopback(const struct sockaddr_storage *address); /* in listen.c */
/* Finds the user at the other end of a connection from a loopback address (peer.c). False: not
 * known. Called by the acceptor. */
void mo_peers_open(struct mo_http *http);
bool mo_peer_uid(struct mo_http *http, int fd, const struct sockaddr_storage *peer, uid_t *uid);

/* ---- clients (client.c): limits per user or address ---- */

struct mo_client;
struct mo_clients {
  pthread_mutex_t lock;
  struct mo_client *buckets[256];
};
int mo_clients_init(struct mo_clients *clients);
void mo_clients_free(struct mo_clients *clients);
/* Takes one of the client's `max` places. NULL: all are taken (*refused is true), or no memory. */
struct mo_client *mo_client_enter(struct mo_clients *clients, const unsigned char key[16],
                                  uint32_t max, bool *refused);
void mo_client_leave(struct mo_clients *clients, struct mo_client *client, int64_t now_us);
/* Parks or wakes a client's request. A request that waits for a job takes no place; when it wakes
 * it takes one again, even beyond `max`. */
void mo_client_park(struct mo_clients *clients, struct mo_client *client, bool parked);
/* Reserves `more` bytes for the body of a request that already holds `held` bytes. Allowed if the
 * client's bodies then hold at most `most` bytes, or if no other body of the client holds any.
 * NULL: not allowed, or no memory. */
struct mo_client *mo_client_hold(struct mo_clients *clients, const unsigned char key[16],
                                 uint64_t held, uint64_t more, uint64_t most);
void mo_client_give_back(struct mo_clients *clients, struct mo_client *client, uint64_t bytes,
                         int64_t now_us);
/* Counts one submission. True: the rate (per second, with a burst of as many, at least 1) allows
 * it. */
bool mo_client_spend(struct mo_clients *clients, struct mo_client *client, uint32_t rate_per_s,
                     int64_t now_us);
void mo_clients_sweep(struct mo_clients *clients,
                      int64_t now_us); /* forgets clients that are idle */

/* ---- requests ---- */

struct mo_reply {
  unsigned status; /* 0: no reply yet */
  const char *type;
  char *body;        /* malloc; NULL: see fixed */
  const char *fixed; /* static */
  size_t size;
  bool close, authenticate, etagged;
  unsigned retry_after_s;
  char etag[112], location[160], allow[64], applied[24];
  unsigned n_extra;
  struct {
    const char *name;
    char value[64];
  } extra[6];
};

#define MO_REASON_BYTES 640 /* size of a note for the log */

enum mo_stage { MO_STAGE_TARGET, MO_STAGE_BODY, MO_STAGE_HANDLING, MO_STAGE_REPLY };

struct mo_request {
  struct mo_http *http;
  struct MHD_Connection *mhd;
  struct mo_connection *connection;
  enum mo_stage stage;
  char id[17];
  char *raw_target; /* as received */
  struct mo_target target;
  char path[256]; /* for logs: truncated, control bytes replaced */
  char method_text[16];
  enum mo_method method;
  enum mo_route route;
  char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES];
  struct mo_framing framing;
  /* Body. */
  uint64_t body_limit, body_seen, body_reserved;
  struct mo_client *body_client; /* the client whose share `body_held` counts in */
  uint64_t body_held;
  char *body;
  size_t body_size, body_capacity;
  bool body_coming, body_gave_way; /* body.c */
  struct mo_request *next_body, *previous_body;
  struct mo_reply reply;
  char reason[MO_REASON_BYTES]; /* for the log: why the service failed, or what it could not read;
                                   "": nothing */
  struct mo_client *client;
  int64_t started_us;
  uint64_t sent;
  bool in_flight, answered; /* answered: by mo_reply_last */
  /* Prefer: wait (pool.c). */
  int64_t wait_job, wait_deadline_us;
  int wait_s; /* requested seconds; −1: none */
  bool wait_fired, wait_parked, wait_over;
  int64_t submitted; /* the evaluation that this POST stored; 0: none yet */
  struct mo_request *next_waiting, *previous_waiting;
  struct mo_request *next_queued;
  struct mo_stream *stream;     /* not NULL: the reply is an event stream */
  struct mo_download *download; /* not NULL: the reply is made piece by piece */
};

/* Creates the request of a connection that has none. NULL: no memory. */
struct mo_request *mo_request_begin(struct mo_connection *connection, struct MHD_Connection *mhd,
                                    const char *target);

enum mo_handled { MO_HANDLED, MO_PARKED, MO_STREAMED };

/* reply.c */
void mo_reply_json(struct mo_request *request, unsigned status,
                   struct mo_text *text); /* takes over the text's data */
void mo_reply_static(struct mo_request *request, unsigned status, const char *type,
                     const char *body, size_t size);
void mo_reply_bytes(struct mo_request *request, unsigned status, const char *type, char *body,
                    size_t size);
/* Replies with a problem document. faults nullable. detail NULL: that of the first fault, or the
 * title of the status. */
void mo_reply_problem(struct mo_request *request, unsigned status, const struct mo_faults *faults,
                      const char *detail, ...) __attribute__((format(printf, 4, 5)));
/* Notes something for the log line of the request, which becomes a warning. */
void mo_request_note(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
/* Replies with the usual problem of an error code of store or jobs (500, 503, 507, 404 …). */
void mo_reply_error(struct mo_request *request, int code, const char *what);
/* Sets a strong ETag from parts, and status 304 if the client has that version. Call after a reply
 * of status 200 was made. */
void mo_reply_etag(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
void mo_reply_etag_of_body(
    struct mo_request *request); /* the ETag is the hash of the body; status 200 and 201 */
void mo_reply_extra(struct mo_request *request, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void mo_reply_clear(struct mo_reply *reply);
bool mo_reply_headers(struct mo_request *request, struct MHD_Response *response);
enum MHD_Result mo_reply_send(struct mo_request *request);

/* last_reply.c: replies that bypass libmicrohttpd and end their connection. */
#define MO_HEADER_BYTES 16384
#define MO_HEADER_WORDS "request line and header may have 16384 bytes together."
bool mo_last_replies_init(void); /* false: libmicrohttpd's function is not found */
enum MHD_Result mo_queue_response(struct MHD_Connection *mhd, unsigned status,
                                  struct MHD_Response *response);
/* Sends request->reply. Call on the I/O thread before any reply was queued; libmicrohttpd must
 * close the connection afterwards. */
void mo_reply_last(struct mo_request *request);
/* Lingering: for a moment, read and discard what clients still send after their last reply. Closing
 * at once would reset the connection and lose the reply. */
#define MO_LINGER_MAX 128
struct mo_lingering {
  pthread_mutex_t lock;
  int fd[MO_LINGER_MAX];
  int64_t until_us[MO_LINGER_MAX];
  size_t n;
};
void mo_linger_add(struct mo_lingering *lingering,
                   int fd); /* takes over the descriptor, already shut down for writing */
void mo_linger_on(struct mo_lingering *lingering, int64_t now_us);
void mo_linger_end(struct mo_lingering *lingering);

/* ---- the memory of bodies and of large replies (body.c) ---- */

#define MO_BODY_GAVE_WAY                                                                           \
  "The body did not go on coming, and others needed its memory; try again later."
/* Reserves `more` bytes for a request that already holds `held` bytes. False: too little is left. A
 * request always gets its bytes if no other request holds any. */
bool mo_body_memory_take(struct mo_http *http, uint64_t held, uint64_t more, bool small);
/* Appends a piece to the body. MO_ERR_LIMIT: the client has used its share; MO_ERR_NO_MEMORY;
 * MO_ERR_CANCELLED: the body was dropped. */
int mo_body_add(struct mo_request *request, const char *bytes, size_t n);
bool mo_body_end(
    struct mo_request *request); /* from here on it is never dropped; false: already dropped */
void mo_request_drop_body(
    struct mo_request *request); /* frees the body's memory, after it was read or will not be */

/* handle.c: the routes. Handlers run on API threads, mo_handle_direct on I/O threads. */
enum mo_handled mo_handle(struct mo_request *request);
void mo_handle_direct(struct mo_request *request);
extern const char *const mo_json_type[1];
/* Checks Accept for routes with one representation. False: the 406 is made. */
bool mo_accepts_json(struct mo_request *request);
/* Reads the query parameters: each must be in `names`, none may come twice. Values are decoded into
 * `values` ("" and not present if absent). False: the 400 is made. */
struct mo_query_value {
  bool present;
  char text[MO_LABEL_BYTES_MAX + 8]; /* a label is the longest value */
};
bool mo_query_read(struct mo_request *request, const char *const *names,
                   struct mo_query_value *values, size_t n);
bool mo_query_limit(struct mo_request *request, const struct mo_query_value *value, size_t *limit);
/* Reads a job's id from a path parameter. False: the 404 is made (no job can have such an id). */
bool mo_path_id(struct mo_request *request, unsigned parameter, int64_t *id);
void mo_reply_bad_parameter(struct mo_request *request, const char *name,
                            const char *detail); /* makes a 400 */
/* Reads an integer parameter within bounds; *number stays if it is absent. False: the 400 is
 * made. */
bool mo_query_number(struct mo_request *request, const char *name,
                     const struct mo_query_value *value, int64_t min, int64_t max, int64_t *number);
/* Chooses one of n representations: by the parameter `format` (one of `names`) or else by Accept
 * (`types`, in the server's order of preference). False: the 400 or 406 is made. */
bool mo_query_form(struct mo_request *request, const struct mo_query_value *format,
                   const char *const *names, const char *const *types, int n, int *form);
/* Checks that `id` is a job of this kind. False: the 404, which calls it `what`, is made. */
bool mo_job_is(struct mo_request *request, int64_t id, enum mo_job_kind kind, const char *what);
/* Checks what every submission must satisfy: no parameters, JSON in both directions, a service that
 * takes work, a well-formed Idempotency-Key. Fills in `key` ("": none was sent) and the body's
 * hash. False: the 4xx or 503 is made. */
struct mo_submission_key {
  char key[256];
  struct mo_sha256 body_sha256;
};
bool mo_submission_begin(struct mo_request *request, const char *what,
                         struct mo_submission_key *key);
/* Handles a whole submission: checks it and calls `submit`, which reads the body and stores the job
 * (false: it made a reply). True: stored, and the body's memory is freed. */
bool mo_handle_submission(struct mo_request *request, const char *what,
                          bool (*submit)(struct mo_request *request,
                                         const struct mo_submission_key *key,
                                         struct mo_faults *faults));
/* Returns the key of a request about job `id`, filled into `known`. The same body for another job,
 * or for another action (`what`), counts as another request. NULL: no key was sent. */
const struct mo_request_key *mo_submission_key_of(const struct mo_submission_key *key,
                                                  const char *what, int64_t id,
                                                  struct mo_request_key *known);
/* Says whether the key was used with another body. Needed where MO_ERR_CONFLICT can mean something
 * else, too. */
bool mo_key_conflicts(struct mo_store *store, const struct mo_submission_key *key);
/* Make the usual refusals of submissions: a body that cannot be parsed (faults nullable if out of
 * memory), a key that was used with another body (adds a fault), a full queue. */
void mo_reply_parse_error(struct mo_request *request, int code, const struct mo_faults *faults,
                          const char *what);
void mo_reply_key_conflict(struct mo_request *request, struct mo_faults *faults);
void mo_reply_queue_full(struct mo_request *request);
/* Look up what a request names: a controller of the service's workspace (NULL: none), or a job of
 * this kind (0: none). Add a fault if it does not exist. */
void mo_look_up_controller(struct mo_store *store, const char *reference, struct mo_faults *faults);
void mo_look_up_job(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *pointer,
                    struct mo_faults *faults);
/* Reads Prefer: wait=N into request->wait_s. False: the 400 is made. */
bool mo_read_wait(struct mo_request *request);
/* Reads the job, or parks the request while the job is not final and there is time. *job is filled
 * in unless parked. */
enum mo_handled mo_await_job(struct mo_request *request, int64_t id, struct mo_job *job, int *code);
/* Handles GET of a job by its id, once the job is final or the wait is over. kind −1: any; the 404
 * for another kind calls the job `what`. */
enum mo_handled mo_handle_job_of(struct mo_request *request, int kind, const char *what,
                                 void (*reply)(struct mo_request *request, struct mo_job *job));
/* Says whether the job, read from the store with this code, is of another kind (−1: any). */
bool mo_job_is_another(const struct mo_job *job, int code, int kind);
/* Lists of jobs. mo_query_state reads the state (−1: any), mo_query_before the cursor (0: none);
 * false: the 400 is made. mo_reply_page makes the reply from the n items in `text`, of which the
 * last is job `last` (n negative: an error). */
bool mo_query_state(struct mo_request *request, const struct mo_query_value *value, int *state);
/* Reads the label to filter jobs by; *label stays NULL without one. False: the 400 is made. */
bool mo_query_label(struct mo_request *request, const struct mo_query_value *value,
                    const char **label);
bool mo_query_before(struct mo_request *request, const struct mo_query_value *value,
                     int64_t *before);
void mo_reply_page(struct mo_request *request, struct mo_text *text, int64_t n, size_t limit,
                   int64_t last);
/* Reads a training: its stored and its live state. MO_ERR_NOT_FOUND. */
int mo_read_training(struct mo_http *http, int64_t id, struct mo_training_status *status,
                     struct mo_live *live);
/* Reads a campaign in the same way. */
int mo_read_campaign(struct mo_http *http, int64_t id, struct mo_campaign_status *status,
                     struct mo_live *live);
/* Checks that Content-Type is `expected` or `also` (nullable), without a content coding. False: the
 * 415 is made. */
bool mo_check_content(struct mo_request *request, const char *expected, const char *also);

/* Replies 202 with the evaluation and its location. */
void mo_reply_accepted_evaluation(struct mo_request *request, int64_t id);
enum mo_handled mo_handle_evaluations_post(struct mo_request *request);
enum mo_handled mo_handle_evaluation_get(struct mo_request *request);
void mo_handle_trajectory(struct mo_request *request);
void mo_handle_jobs(struct mo_request *request);
enum mo_handled mo_handle_job_get(struct mo_request *request);
void mo_handle_job_change(struct mo_request *request);
void mo_handle_job_weight(struct mo_request *request);
void mo_handle_trainings_post(struct mo_request *request);
void mo_handle_trainings(struct mo_request *request);
enum mo_handled mo_handle_training(struct mo_request *request);
void mo_handle_training_steps(struct mo_request *request);
void mo_handle_training_validations(struct mo_request *request);
void mo_handle_training_checkpoints(struct mo_request *request);
void mo_handle_training_checkpoints_delete(
    struct mo_request *request); /* one checkpoint, or all that are not needed */
void mo_handle_training_controller(struct mo_request *request);
void mo_handle_training_held_out(struct mo_request *request);
void mo_handle_held_out(struct mo_request *request);
void mo_handle_devices(struct mo_request *request);
void mo_handle_campaigns_post(struct mo_request *request);
void mo_handle_campaigns(struct mo_request *request);
enum mo_handled mo_handle_campaign(struct mo_request *request);
void mo_handle_campaign_change(struct mo_request *request);
void mo_handle_campaign_extend(struct mo_request *request);
enum mo_handled mo_handle_campaign_generations(struct mo_request *request);
enum mo_handled mo_handle_campaign_learning(struct mo_request *request);
enum mo_handled mo_handle_campaign_replicates(struct mo_request *request);
void mo_handle_campaign_population(struct mo_request *request);
void mo_handle_campaign_design(struct mo_request *request);
void mo_handle_campaign_ancestors(struct mo_request *request);
void mo_handle_campaign_descendants(struct mo_request *request);
enum mo_handled mo_handle_campaign_phylogeny(struct mo_request *request);
void mo_handle_campaign_champions(struct mo_request *request);
void mo_handle_campaign_champions_post(struct mo_request *request);
void mo_handle_campaign_checkpoints(struct mo_request *request);
void mo_handle_campaign_checkpoints_delete(struct mo_request *request);
void mo_handle_designs(struct mo_request *request);
void mo_handle_design(struct mo_request *request);
void mo_handle_controllers(struct mo_request *request);
void mo_handle_controller_get(struct mo_request *request);
void mo_handle_controller_put(struct mo_request *request);
void mo_handle_controller_delete(struct mo_request *request);
enum mo_handled mo_handle_events(struct mo_request *request);

/* ---- long replies (download.c) ---- */

struct mo_download;
/* Appends the next part of the reply to `text`, some 100 KB in at most 50 ms, on an API thread.
 * Returns 1: there may be more, 0: that was all, or an error. */
typedef int (*mo_download_more)(void *context, struct mo_text *text);
/* Makes the reply (200, 304 or a problem) from any number of pieces, and takes over `context`. tag:
 * the ETag of the reply; NULL: the hash of a body of one piece, else a tag that is never used
 * again. held: bytes that `context` takes besides a piece. Returns what the handler must return. */
enum mo_handled mo_download_open(struct mo_request *request, const char *type, const char *tag,
                                 uint64_t held, mo_download_more more, void *context,
                                 void (*free_context)(void *context));
void mo_download_refill(
    struct mo_request *request); /* API thread: makes the next piece; resumes the connection */
enum MHD_Result mo_download_send(struct mo_request *request);
void mo_download_free(struct mo_request *request); /* no-op without a download */

/* ---- the API pool and the waiting requests (pool.c) ---- */

struct mo_queue {
  struct mo_request *first, *last;
  uint32_t n; /* without requests taken earlier: ended waits, and further pieces of replies */
};

struct mo_pool {
  pthread_mutex_t lock;
  pthread_cond_t work, idle;
  struct mo_queue others, lists;
  uint32_t n_lists, max_lists; /* being handled */
  atomic_uint n_queued;
  uint32_t n_running;
  uint32_t n_outside; /* requests that are suspended: queued, running or parked */
  bool closed;        /* no new requests are taken */
  bool quit;
  pthread_t *threads;
  uint32_t n_threads;
  struct mo_request *waiting; /* parked, or about to park */
  _Atomic int64_t heartbeat_us;
};
int mo_pool_start(struct mo_http *http);
/* Queues a request and suspends its connection. False: full or closed; the connection is not
 * suspended. */
bool mo_pool_give(struct mo_http *http, struct mo_request *request, bool *closed);
/* Wait for a job: begin, read the job, then park. mo_wait_park returns true when the request is
 * parked (the caller must not touch it any more), false when the wait is already over. */
void mo_wait_begin(struct mo_request *request, int64_t job, int64_t deadline_us);
bool mo_wait_park(struct mo_request *request);
void mo_wait_end(struct mo_request *request);
void mo_waits_job_ended(struct mo_http *http, int64_t job);
void mo_waits_expire(struct mo_http *http, int64_t now_us); /* MO_NEVER: all */
void mo_waits_tick(struct mo_http *http); /* wakes requests whose client has left */
void mo_pool_close(struct mo_http *http); /* returns when no connection is suspended */
void mo_pool_stop(struct mo_http *http);

/* ---- event streams (stream.c) ---- */

struct mo_stream;
struct mo_streams {
  pthread_mutex_t lock;
  struct mo_stream *first;
  atomic_uint n;
  bool closed;
  int listener; /* the subscription to the store's events; −1: none */
};
int mo_streams_start(struct mo_http *http);
/* Opens an event stream. after −1: new events only. MO_ERR_LIMIT, MO_ERR_BUSY (closing),
 * MO_ERR_NO_MEMORY. */
int mo_stream_open(struct mo_request *request, int64_t after, int64_t job);
enum MHD_Result mo_stream_send(struct mo_request *request);
void mo_stream_refill(struct mo_request *request); /* API thread: reads more from the store */
void mo_stream_free(struct mo_request *request);
void mo_streams_tick(struct mo_http *http,
                     int64_t now_us); /* sends heartbeats, drops slow and vanished readers */
void mo_streams_close(struct mo_http *http);
void mo_streams_stop(struct mo_http *http);
void mo_event_write(struct mo_text *text, const struct mo_event *event); /* as a JSON object */

/* ---- the server ---- */

struct mo_http {
  struct mo_http_config config; /* defaults filled in; do not use its pointers */
  struct mo_http_services services;
  char version[32];
  char contract_tag[MO_SHA256_DIGITS + 1]; /* of openapi.json */
  gid_t *unix_groups;
  size_t n_unix_groups;
  struct mo_names names;
  struct mo_tokens tokens;
  bool beyond_loopback;
  int *listeners;
  enum mo_transport *listener_transports;
  size_t n_listeners;
  struct MHD_Daemon *daemon;
  struct mo_lattice *lattice;
  /* accept.c */
  pthread_t acceptor, clock;
  bool acceptor_started, clock_started;
  int stop_fd;  /* eventfd: ends the acceptor */
  int peers_fd; /* netlink socket for the users of loopback peers; −1: not available */
  uint32_t peers_sequence;
  pthread_mutex_t connections_lock;
  struct mo_connection **connections;       /* by descriptor */
  size_t connections_size, connections_top; /* all descriptors are below connections_top */
  atomic_uint n_connections, n_leaving; /* of these, cut, but not yet closed by their I/O threads */
  _Atomic int64_t acceptor_us, clock_us;
  atomic_bool clock_stop, ready, stopping;
  struct mo_lingering lingering;
  struct mo_clients clients;
  struct mo_pool pool;
  struct mo_streams streams;
  struct mo_metrics metrics;
  atomic_uint n_in_flight;
  pthread_mutex_t bodies_lock;
  struct mo_request *bodies; /* being received */
  _Atomic uint64_t body_memory;
  _Atomic uint64_t next_id;
  uint64_t id_key;
  _Atomic uint64_t jobs_by_state[MO_JOB_STATES];
  atomic_bool jobs_changed;
};

int mo_connections_init(struct mo_http *http, struct mo_message *message);
int mo_acceptor_start(struct mo_http *http, struct mo_message *message);
void mo_acceptor_stop(struct mo_http *http);
void mo_connections_expire(struct mo_http *http, int64_t now_us);
struct mo_connection *mo_connection_find(struct mo_http *http, int fd);
void mo_connection_forget(struct mo_http *http, struct mo_connection *connection);
void mo_connection_cut(
    struct mo_http *http,
    const struct mo_connection *connection); /* by shutdown: the I/O thread sees end of file */
/* Cuts the connection after sending 503. Only in the middle of a request, before a reply has
 * begun. */
void mo_connection_refuse(struct mo_http *http, const struct mo_connection *connection,
                          const char *id, const char *detail);
bool mo_connection_has_left(
    const struct mo_connection *connection); /* if suspended: libmicrohttpd does not watch */

#endif
