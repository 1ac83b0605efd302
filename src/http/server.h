/* server.h: the inside of the HTTP room. See http.h for the threads.
 *
 * Life of a request:  created when its target is known (libmicrohttpd's URI callback) → header
 * checked → body received → answered at once (direct routes, refusals), or set aside (connection
 * suspended) and given to the API pool → handled; perhaps parked until a job ends → the connection
 * is resumed and the reply is queued on its I/O thread → completed, logged, freed. Only one thread
 * has a request at a time; hand-overs go through the pool's lock or libmicrohttpd's suspend and
 * resume.
 *
 * Locks, in the order in which they may be taken: streams → pool → clients → connections →
 * libmicrohttpd's own. */
#ifndef MORPHO_HTTP_SERVER_H
#define MORPHO_HTTP_SERVER_H

#include <netinet/in.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>

#include <microhttpd.h>

#include "http/fault.h"
#include "http/guard.h"
#include "http/http.h"
#include "http/metrics.h"
#include "http/route.h"
#include "http/text.h"
#include "jobs/campaigns.h"
#include "jobs/jobs.h"
#include "jobs/trainings.h"
#include "store/store.h"

#define MO_NEVER INT64_MAX

int64_t mo_http_clock_us(void); /* monotonic */

/* ---- connections (accept.c) ---- */

enum mo_transport { MO_TRANSPORT_LOOPBACK, MO_TRANSPORT_TCP, MO_TRANSPORT_UNIX };

struct mo_connection {
  int fd;
  enum mo_transport transport;
  unsigned char client_key[16]; /* who it is, for limits: the address, or the peer's user */
  char client[64];              /* in words */
  _Atomic int64_t deadline_us;  /* when the clock cuts it off */
};

/* ---- clients (client.c): what one address has under way ---- */

struct mo_client;
struct mo_clients {
  pthread_mutex_t lock;
  struct mo_client *buckets[256];
};
int mo_clients_init(struct mo_clients *clients);
void mo_clients_free(struct mo_clients *clients);
/* Takes one of the client's `max` places; NULL: all are taken, or no memory (*refused false). */
struct mo_client *mo_client_enter(struct mo_clients *clients, const unsigned char key[16],
                                  uint32_t max, bool *refused);
void mo_client_leave(struct mo_clients *clients, struct mo_client *client, int64_t now_us);
/* Memory for the body of a request that holds `held` bytes: `more` of them, if its client's bodies
 * hold at most `most` then, or this one is the only one. NULL: they would hold more, or no memory.
 */
struct mo_client *mo_client_hold(struct mo_clients *clients, const unsigned char key[16],
                                 uint64_t held, uint64_t more, uint64_t most);
void mo_client_give_back(struct mo_clients *clients, struct mo_client *client, uint64_t bytes,
                         int64_t now_us);
/* One submission: true if the rate (per second, burst of as many, at least 1) allows it. */
bool mo_client_spend(struct mo_clients *clients, struct mo_client *client, uint32_t rate_per_s,
                     int64_t now_us);
void mo_clients_sweep(struct mo_clients *clients,
                      int64_t now_us); /* forgets those with nothing under way */

/* ---- requests ---- */

struct mo_reply {
  unsigned status; /* 0: none yet */
  const char *type;
  char *body;        /* malloc; or */
  const char *fixed; /* static */
  size_t size;
  bool close, authenticate, etagged;
  unsigned retry_after_s;
  char etag[80], location[160], allow[64], applied[24];
  unsigned n_extra;
  struct {
    const char *name;
    char value[64];
  } extra[6];
};

#define MO_REASON_BYTES 640 /* of what the log tells of a request besides its reply */

enum mo_stage { MO_STAGE_TARGET, MO_STAGE_BODY, MO_STAGE_HANDLING, MO_STAGE_REPLY };

struct mo_request {
  struct mo_http *http;
  struct MHD_Connection *mhd;
  struct mo_connection *connection;
  enum mo_stage stage;
  char id[17];
  char *raw_target; /* as it came */
  struct mo_target target;
  char path[256]; /* for people: cut, control bytes replaced */
  char method_text[16];
  enum mo_method method;
  enum mo_route route;
  char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES];
  struct mo_framing framing;
  /* Body. */
  uint64_t body_limit, body_seen, body_reserved;
  struct mo_client *body_client; /* whose share `body_held` counts in */
  uint64_t body_held;
  char *body;
  size_t body_size, body_capacity;
  bool body_dropped; /* refused or too large: read and thrown away */
  struct mo_reply reply;
  char reason[MO_REASON_BYTES]; /* for the log: why the service failed, or what it could not read;
                                   "": nothing */
  struct mo_client *client;
  int64_t started_us;
  uint64_t sent;
  bool in_flight;
  /* Prefer: wait (pool.c). */
  int64_t wait_job, wait_deadline_us;
  int wait_s; /* what was asked for; −1: nothing */
  bool wait_fired, wait_parked, wait_over;
  int64_t submitted; /* the evaluation that this POST has stored; 0: none yet */
  struct mo_request *next_waiting, *previous_waiting;
  struct mo_request *next_queued;
  struct mo_stream *stream;     /* not NULL: the reply is an event stream */
  struct mo_download *download; /* not NULL: the reply is made piece by piece */
};

enum mo_handled { MO_HANDLED, MO_PARKED, MO_STREAMED };

/* reply.c */
void mo_reply_json(struct mo_request *request, unsigned status,
                   struct mo_text *text); /* takes the text's data */
void mo_reply_static(struct mo_request *request, unsigned status, const char *type,
                     const char *body, size_t size);
void mo_reply_bytes(struct mo_request *request, unsigned status, const char *type, char *body,
                    size_t size);
/* A problem; faults nullable. detail NULL: the first fault's, or the status's title. */
void mo_reply_problem(struct mo_request *request, unsigned status, const struct mo_faults *faults,
                      const char *detail, ...) __attribute__((format(printf, 4, 5)));
/* For the log line of the request, as a warning. */
void mo_request_note(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
/* The usual problem of an error code of store or jobs (500, 503, 507, 404 …). */
void mo_reply_error(struct mo_request *request, int code, const char *what);
/* A strong tag from parts; sets 304 when the client has it (call after the reply is made, status
 * 200). */
void mo_reply_etag(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
void mo_reply_etag_of_body(
    struct mo_request *request); /* the tag is the hash of the body; of status 200 and 201 */
void mo_reply_extra(struct mo_request *request, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void mo_reply_clear(struct mo_reply *reply);
void mo_request_drop_body(struct mo_request *request); /* gives its memory back: it has been read */
bool mo_reply_headers(struct mo_request *request, struct MHD_Response *response);
enum MHD_Result mo_reply_send(struct mo_request *request);

/* handle.c: the routes. Called on an API thread (mo_handle_direct: on an I/O thread). */
enum mo_handled mo_handle(struct mo_request *request);
void mo_handle_direct(struct mo_request *request);
extern const char *const mo_json_type[1];
/* The Accept check of routes with one representation; false: the 406 is made. */
bool mo_accepts_json(struct mo_request *request);
/* Query parameters: every one must be in `names`, none twice. Values are decoded into `values` (""
 * if absent; present[i]). False: the 400 is made. */
struct mo_query_value {
  bool present;
  char text[520];
};
bool mo_query_read(struct mo_request *request, const char *const *names,
                   struct mo_query_value *values, size_t n);
bool mo_query_limit(struct mo_request *request, const struct mo_query_value *value, size_t *limit);
/* A job's id in a path parameter; false: the 404 is made (no job has such an id). */
bool mo_path_id(struct mo_request *request, unsigned parameter, int64_t *id);
void mo_reply_bad_parameter(struct mo_request *request, const char *name,
                            const char *detail); /* 400 */
/* An integer parameter within bounds; *number stays if it is absent. False: the 400 is made. */
bool mo_query_number(struct mo_request *request, const char *name,
                     const struct mo_query_value *value, int64_t min, int64_t max, int64_t *number);
/* Which of n forms is asked for: by the parameter `format` (one of `names`) or, without it, by
 * Accept (types, the server's favourite first). False: the 400 or 406 is made. */
bool mo_query_form(struct mo_request *request, const struct mo_query_value *format,
                   const char *const *names, const char *const *types, int n, int *form);
/* Whether `id` is a job of this kind; false: the 404 about a `what` is made. */
bool mo_job_is(struct mo_request *request, int64_t id, enum mo_job_kind kind, const char *what);
/* The same for those who only want to be rid of it: its kind has to be readable, no more. */
bool mo_job_is_even_unreadable(struct mo_request *request, int64_t id, enum mo_job_kind kind,
                               const char *what);
/* What a submission begins with: no parameters, JSON in both directions, a service that takes work,
 * and a well-formed Idempotency-Key, which goes into `key` with the body's hash ("": there is
 * none). False: the 4xx or 503 is made. */
struct mo_submission_key {
  char key[256];
  struct mo_sha256 body_sha256;
};
bool mo_submission_begin(struct mo_request *request, const char *what,
                         struct mo_submission_key *key);
/* A whole submission: begins, and calls `submit` with room for faults, which reads the body and
 * stores (false: it made a reply). True: it is stored, and the body's memory is given back. */
bool mo_handle_submission(struct mo_request *request, const char *what,
                          bool (*submit)(struct mo_request *request,
                                         const struct mo_submission_key *key,
                                         struct mo_faults *faults));
/* For a request about a job, by its id: the same body about another job, or to do something else
 * with it (`what`), is another request. NULL: there is no key. `known` is filled in. */
const struct mo_request_key *mo_submission_key_of(const struct mo_submission_key *key,
                                                  const char *what, int64_t id,
                                                  struct mo_request_key *known);
/* Whether the key was used with another body, where MO_ERR_CONFLICT may mean something else, too.
 */
bool mo_key_conflicts(struct mo_store *store, const struct mo_submission_key *key);
/* The usual refusals of submissions: what a reader of a body said (faults nullable without memory),
 * the key with another body (adds its fault), too much work. */
void mo_reply_parse_error(struct mo_request *request, int code, const struct mo_faults *faults,
                          const char *what);
void mo_reply_key_conflict(struct mo_request *request, struct mo_faults *faults);
void mo_reply_queue_full(struct mo_request *request);
/* What a request names: a controller of the service's workspace (NULL: none), a job of this kind
 * (0: none). A fault if it is not there. */
void mo_look_up_controller(struct mo_store *store, const char *reference, struct mo_faults *faults);
void mo_look_up_job(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *pointer,
                    struct mo_faults *faults);
/* Prefer: wait=N into request->wait_s; false: the 400 is made. */
bool mo_read_wait(struct mo_request *request);
/* Reads the job; parks the request while the job is not final and there is time. *job is filled in
 * unless parked. */
enum mo_handled mo_await_job(struct mo_request *request, int64_t id, struct mo_job *job, int *code);
/* GET of a job of this kind (−1: of any; else 404 about a `what`) by its id, once it is over or
 * there is no more time to wait. */
enum mo_handled mo_handle_job_of(struct mo_request *request, int kind, const char *what,
                                 void (*reply)(struct mo_request *request, struct mo_job *job));
/* Whether the job that the store gave with this code is of another kind than that (−1: any), also
 * if it cannot be read. */
bool mo_job_is_another(const struct mo_job *job, int code, int kind);
/* Whether this reading of a job found it, if with damage. */
bool mo_job_is_known(const struct mo_job *job, int code);
/* Lists of jobs: the state that is asked for (−1: any), the cursor (0: none), false: the 400 is
 * made; the reply, from n items of which the last is job `last` (n negative: an error), behind
 * those in `text` and with those that cannot be read (emptied). */
bool mo_query_state(struct mo_request *request, const struct mo_query_value *value, int *state);
bool mo_query_before(struct mo_request *request, const struct mo_query_value *value,
                     int64_t *before);
struct mo_unreadable;
void mo_reply_page(struct mo_request *request, struct mo_text *text, int64_t n, size_t limit,
                   int64_t last, struct mo_unreadable *unreadable);
/* A training, as it is stored and as it runs. MO_ERR_NOT_FOUND. */
int mo_read_training(struct mo_http *http, int64_t id, struct mo_training_status *status,
                     struct mo_training_live *live);
/* A campaign, likewise. */
int mo_read_campaign(struct mo_http *http, int64_t id, struct mo_campaign_status *status,
                     struct mo_campaign_live *live);
/* Content-Type must be `expected` or `also` (nullable), without a coding; false: the 415 is made.
 */
bool mo_check_content(struct mo_request *request, const char *expected, const char *also);

/* 202 with the evaluation as it stands, and where it is. */
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
    struct mo_request *request); /* one of them, or those that are not needed */
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
/* Adds to `text` what comes next, some 100 KB in at most 50 ms, on an API thread: 1: there may be
 * more, 0: that was all, or an error. */
typedef int (*mo_download_more)(void *context, struct mo_text *text);
/* Makes the reply, 200, 304 or a problem, from as many pieces as there are; `context` is taken
 * over. tag: the ETag of what will be told; NULL: that of the body if it is of one piece, else one
 * that never comes again. held: bytes that the context takes besides a piece. Returns what the
 * handler must return. */
enum mo_handled mo_download_open(struct mo_request *request, const char *type, const char *tag,
                                 uint64_t held, mo_download_more more, void *context,
                                 void (*free_context)(void *context));
void mo_download_refill(
    struct mo_request *request); /* API thread: the next piece; resumes the connection */
enum MHD_Result mo_download_send(struct mo_request *request);
void mo_download_free(struct mo_request *request); /* if there is one */

/* ---- the API pool and the waiting requests (pool.c) ---- */

struct mo_pool {
  pthread_mutex_t lock;
  pthread_cond_t work, idle;
  struct mo_request *first, *last;
  atomic_uint n_queued;
  uint32_t n_running;
  uint32_t n_outside; /* requests that are suspended: queued, running or parked */
  bool closed;        /* nothing new is taken */
  bool quit;
  pthread_t *threads;
  uint32_t n_threads;
  struct mo_request *waiting; /* parked, or about to park */
  _Atomic int64_t heartbeat_us;
};
int mo_pool_start(struct mo_http *http);
/* Takes a request whose connection is suspended by this call. False: full or closed, the connection
 * is not suspended. */
bool mo_pool_give(struct mo_http *http, struct mo_request *request, bool *closed);
/* Waiting for a job: begin, look at the job, then park. mo_wait_park gives true when the request is
 * parked (it belongs to others from then on), false when there is no need to wait any longer. */
void mo_wait_begin(struct mo_request *request, int64_t job, int64_t deadline_us);
bool mo_wait_park(struct mo_request *request);
void mo_wait_end(struct mo_request *request);
void mo_waits_job_ended(struct mo_http *http, int64_t job);
void mo_waits_expire(struct mo_http *http, int64_t now_us); /* MO_NEVER: all */
void mo_waits_tick(
    struct mo_http *http); /* lets go of those whose client has left: they hold a place of its */
void mo_pool_close(struct mo_http *http); /* returns when no request is outside */
void mo_pool_stop(struct mo_http *http);

/* ---- event streams (stream.c) ---- */

struct mo_stream;
struct mo_streams {
  pthread_mutex_t lock;
  struct mo_stream *first;
  atomic_uint n;
  bool closed;
  int listener; /* the store's handle; −1: none */
};
int mo_streams_start(struct mo_http *http);
/* MO_ERR_LIMIT, MO_ERR_BUSY (closing), MO_ERR_NO_MEMORY. after −1: from now on. */
int mo_stream_open(struct mo_request *request, int64_t after, int64_t job);
enum MHD_Result mo_stream_send(struct mo_request *request);
void mo_stream_refill(struct mo_request *request); /* API thread: more from the store */
void mo_stream_free(struct mo_request *request);
void mo_streams_tick(struct mo_http *http,
                     int64_t now_us); /* heartbeats, slow and vanished readers */
void mo_streams_close(struct mo_http *http);
void mo_streams_stop(struct mo_http *http);
void mo_event_write(struct mo_text *text, const struct mo_event *event); /* the JSON object */

/* ---- the server ---- */

struct mo_http {
  struct mo_http_config config; /* with defaults filled in; its pointers are not kept */
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
  int stop_fd; /* eventfd: ends the acceptor */
  pthread_mutex_t connections_lock;
  struct mo_connection **connections; /* by descriptor */
  size_t connections_size;
  atomic_uint n_connections;
  _Atomic int64_t acceptor_us, clock_us;
  atomic_bool clock_stop, ready, stopping;
  struct mo_clients clients;
  struct mo_pool pool;
  struct mo_streams streams;
  struct mo_metrics metrics;
  atomic_uint n_in_flight;
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
    const struct mo_connection *connection); /* shutdown: its I/O thread sees the end */
bool mo_connection_has_left(
    const struct mo_connection *connection); /* of one that is suspended: nobody else looks */

#endif
