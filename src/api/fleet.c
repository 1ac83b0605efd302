/* fleet.c: the routes of workers: sessions, leases and results, orders, weights.
 *
 * A request for leases or orders waits under its session's id, and mo_api_wake_session wakes it. If
 * there is nothing for it, it continues to wait. A worker always has a request for orders open as
 * its heartbeat: when the client of this request leaves, the session is lost at once. */
#include "api/fleet.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/submission.h"
#include "base/clock.h"
#include "exchange/values.h"
#include "http/connection.h"
#include "http/pool.h"

void mo_api_wake_session(struct mo_api *api, uint64_t session)
{
  struct mo_http *http = atomic_load(&api->fleet_http);
  if (http != NULL)
    mo_waits_end(http, (int64_t)session, INT64_MIN);
}

struct mo_fleet *mo_path_session(struct mo_request *request, uint64_t *session)
{
  struct mo_fleet *fleet = atomic_load(&mo_api_of(request)->fleet);
  int64_t id;
  if (fleet != NULL && mo_id(request->parameters[0], &id)) {
    *session = (uint64_t)id;
    return fleet;
  }
  mo_reply_error(request, MO_ERR_NOT_FOUND, "session");
  return NULL;
}

/* Finds the session in the path of a worker's request. The session must have been opened with the
 * same token; any other token gets 404, even with the right id. Returns NULL after a reply. */
static struct mo_fleet *own_session(struct mo_request *request, uint64_t *session)
{
  struct mo_fleet *fleet = mo_path_session(request, session);
  if (fleet == NULL || mo_fleet_is_of(fleet, *session, request->caller.name))
    return fleet;
  mo_reply_error(request, MO_ERR_NOT_FOUND, "session");
  return NULL;
}

/* ---- waiting ---- */

/* Reads the time that the request may wait. */
static void read_wait(struct mo_request *request)
{
  if (request->wait_over)
    return;
  mo_read_wait(request);
  const int wait_s = request->wait_s < MO_FLEET_WAIT_S ? request->wait_s : MO_FLEET_WAIT_S;
  request->wait_deadline_us = mo_clock_us() + (int64_t)wait_s * 1000000;
}

/* Begins to wait, if there is time left. Call it before looking for work, so that work that arrives
 * in between is not missed. */
static bool begin_wait(struct mo_request *request, uint64_t session)
{
  const bool may_wait = request->wait_s > 0 && request->wait_deadline_us > mo_clock_us() &&
                        !mo_connection_has_left(request->connection);
  if (may_wait)
    mo_wait_begin(request, (int64_t)session, request->wait_deadline_us);
  return may_wait;
}

/* ---- sessions ---- */

/* A request for a session. */
struct parsed {
  uint32_t protocol;
  struct mo_fleet_offer offer;
};

#define AT(member)    offsetof(struct parsed, member)
#define CLASS(member) (AT(offer.classes[0].member) - AT(offer.classes[0]))
#define TEXT(member)  .min = 1, .max = sizeof(((struct parsed *)NULL)->member) - 1
static const struct mo_field class_rows[] = {
    {"scores", MO_FIELD_TEXT, 0, CLASS(scores), TEXT(offer.classes[0].scores)},
    {"gradients", MO_FIELD_TEXT, 0, CLASS(gradients), TEXT(offer.classes[0].gradients)},
    {"canary", MO_FIELD_OWN, 0, CLASS(canary), .own = &mo_hash_field},
};
static const struct mo_fields class_fields = MO_FIELDS(class_rows);
static const struct mo_field classes_rows[] = {
    {"cpu", MO_FIELD_GROUP, 0, AT(offer.classes[MO_ON_CPU]), .group = &class_fields},
    {"device", MO_FIELD_GROUP, 0, AT(offer.classes[MO_ON_DEVICE]), .group = &class_fields},
};
static const struct mo_fields classes_fields = MO_FIELDS(classes_rows);
static const struct mo_field offer_rows[] = {
    {"protocol", MO_FIELD_COUNT, 0, AT(protocol), .min = 0, .max = UINT32_MAX, .unit = ""},
    {"name", MO_FIELD_TEXT, 0, AT(offer.name), TEXT(offer.name)},
    {"host", MO_FIELD_TEXT, 0, AT(offer.host), TEXT(offer.host)},
    {"version", MO_FIELD_TEXT, 0, AT(offer.version), TEXT(offer.version)},
    {"n_threads", MO_FIELD_COUNT, 0, AT(offer.n_threads), .min = 0, .max = 65536, .unit = ""},
    {"n_devices", MO_FIELD_COUNT, 0, AT(offer.n_devices), .min = 0, .max = 1024, .unit = ""},
    {"classes", MO_FIELD_GROUP, 0, 0, .group = &classes_fields},
};
static const struct mo_fields offer_fields = MO_FIELDS(offer_rows),
                              protocol_field = {offer_rows, 1};
#undef TEXT
#undef CLASS
#undef AT

static int check_offer(struct mo_json *json, void *any)
{
  const struct mo_fleet_offer *offer = &((struct parsed *)any)->offer;
  static const char *const places[] = {"/classes/cpu", "/classes/device"};
  if (json->faults->n > 0)
    return MO_OK;
  if (offer->name[0] == '\0' || offer->host[0] == '\0' || offer->version[0] == '\0')
    mo_json_fault_at(json, 0, "", "protocol, name, host, version and classes are required");
  bool serves = false;
  for (size_t i = 0; i < 2; i++) {
    const bool scores = offer->classes[i].scores[0] != '\0';
    serves |= scores;
    if (scores != (offer->classes[i].gradients[0] != '\0'))
      mo_json_fault_at(json, 0, places[i], "scores, gradients and canary are required");
    if (strpbrk(offer->classes[i].scores, "\"\\") != NULL ||
        strpbrk(offer->classes[i].gradients, "\"\\") != NULL) /* copied into events without
                                                               * escapes */
      mo_json_fault_at(json, 0, places[i], "a class must not have quotation marks or backslashes");
  }
  if (!serves)
    mo_json_fault_at(json, 0, "/classes", "at least one of cpu and device is required");
  return MO_OK;
}

static void reply_session(struct mo_request *request, int64_t id)
{
  const struct mo_api *api = mo_api_of(request);
  const struct mo_workspace workspace = api->lattice->workspace;
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_member_id(&text, "session", id);
  mo_text_member_id(&text, "epoch", (int64_t)api->fleet_epoch);
  mo_text_member_number(&text, "silence_s", MO_FLEET_SILENCE_MS / 1000.0);
  mo_text_member_count(&text, "wait_s", MO_FLEET_WAIT_S);
  mo_text_format(&text, ",\"workspace\":[%u,%u,%u]}", workspace.nx, workspace.ny, workspace.nz);
  mo_reply_json(request, 201, &text);
  snprintf(request->reply.location, sizeof(request->reply.location), "/v1/fleet/sessions/%lld",
           (long long)id);
}

void mo_api_post_session(struct mo_request *request)
{
  struct mo_fleet *fleet = atomic_load(&mo_api_of(request)->fleet);
  struct mo_message message = {""};
  struct mo_faults faults = {0};
  struct parsed parsed = {.protocol = MO_FLEET_PROTOCOL};
  if (!mo_check_content(request, "application/json", NULL))
    return;
  /* If the protocol differs, the rest of the body is not checked. */
  mo_read_words(request->body, request->body_size, &protocol_field, &parsed, NULL);
  if (parsed.protocol != MO_FLEET_PROTOCOL) {
    mo_faults_add(&faults, MO_FAULT_BODY, "/protocol",
                  "must be %d, the protocol of morphod %s, got %u", MO_FLEET_PROTOCOL,
                  mo_api_of(request)->version, parsed.protocol);
    mo_reply_problem(request, 422, &faults, NULL);
    return;
  }
  if (!mo_read_request(request, &offer_fields, &parsed, NULL, check_offer, "session"))
    return;
  memcpy(parsed.offer.user, request->caller.name, sizeof(parsed.offer.user));
  const int64_t id = mo_fleet_join(fleet, &parsed.offer, mo_clock_ns(), &message);
  if (id > 0)
    reply_session(request, id);
  else if (id == MO_ERR_UNSUPPORTED)
    mo_reply_problem(request, 422, NULL, "%s.", message.text);
  else if (id == MO_ERR_CONFLICT)
    mo_reply_problem(request, 409, NULL, "%s.", message.text);
  else
    mo_reply_error(request, id == MO_ERR_LIMIT ? MO_ERR_BUSY : (int)id, "session");
}

void mo_api_delete_session(struct mo_request *request)
{
  uint64_t session;
  struct mo_fleet *fleet = own_session(request, &session);
  if (fleet == NULL)
    return;
  const int error = mo_fleet_leave(fleet, session, false, mo_clock_ns());
  if (error != MO_OK)
    mo_reply_error(request, error, "session");
  else
    mo_reply_static(request, 204, NULL, "", 0);
}

/* ---- orders ---- */

static void reply_orders(struct mo_request *request, const struct mo_fleet_orders *orders)
{
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_member(&text, "state", mo_session_state_words[orders->state]);
  mo_text_add(&text, ",\"dropped\":[");
  for (uint32_t i = 0; i < orders->n_dropped; i++)
    mo_text_format(&text, "%s[\"%llu\",\"%llu\"]", i > 0 ? "," : "",
                   (unsigned long long)orders->dropped[i].epoch,
                   (unsigned long long)orders->dropped[i].number);
  mo_text_add(&text, "]");
  if (orders->wanted[0] != '\0')
    mo_text_member(&text, "wanted", orders->wanted);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}

void mo_api_get_orders(struct mo_request *request)
{
  struct mo_fleet_orders orders = {.state = MO_SESSION_ACTIVE};
  uint64_t session;
  struct mo_fleet *fleet = own_session(request, &session);
  if (fleet == NULL)
    return;
  read_wait(request);
  if (request->wait_over && mo_connection_has_left(request->connection)) {
    mo_fleet_leave(fleet, session, true, mo_clock_ns());
    mo_reply_error(request, MO_ERR_NOT_FOUND, "session");
    return;
  }
  const bool may_wait = begin_wait(request, session);
  const int some = mo_fleet_orders(fleet, session, mo_clock_ns(), &orders);
  if (some == 0 && may_wait)
    return;
  if (may_wait)
    mo_wait_end(request);
  if (some < 0)
    mo_reply_error(request, some, "session");
  else
    reply_orders(request, &orders);
}

/* ---- leases and results ---- */

static void add_digest(struct mo_request *request, const struct mo_sha256 *hash)
{
  char digest[MO_CONTENT_DIGEST_BYTES];
  mo_sha256_to_content_digest(hash, digest);
  mo_reply_extra(request, "Content-Digest", "%s", digest);
}

static void reply_bytes(struct mo_request *request, uint8_t *bytes, size_t size)
{
  struct mo_sha256 hash;
  mo_sha256_of(bytes, size, &hash);
  mo_reply_bytes(request, 200, "application/octet-stream", (char *)bytes, size);
  add_digest(request, &hash);
}

/* Checks a worker's request. Returns false if it has replied. */
static bool check_results(struct mo_request *request)
{
  if (!mo_check_content(request, "application/octet-stream", NULL))
    return false;
  if (mo_content_digest_matches(request->framing.content_digest, request->body, request->body_size))
    return true;
  mo_reply_bad_header(request, "Content-Digest",
                      "must be the SHA-256 of the body, as in sha-256=:…:; nothing was taken");
  return false;
}

static void reply_refusal(struct mo_request *request, int error, const struct mo_message *message)
{
  if (error == MO_ERR_FORMAT)
    mo_reply_problem(request, 400, NULL, "The exchange is invalid: %s. Nothing was taken.",
                     message->text);
  else if (error == MO_ERR_UNSUPPORTED)
    mo_reply_problem(request, 422, NULL, "%s.", message->text);
  else if (error == MO_ERR_CONFLICT)
    mo_reply_problem(request, 409, NULL, "%s.",
                     message->text[0] != '\0' ? message->text : "The session was refused");
  else
    mo_reply_error(request, error, "session");
}

void mo_api_post_exchange(struct mo_request *request)
{
  struct mo_message message = {""};
  uint64_t session;
  uint8_t *down = NULL;
  size_t down_size = 0;
  uint32_t n_leases = 0;
  struct mo_fleet *fleet = own_session(request, &session);
  if (fleet == NULL || (!request->wait_over && !check_results(request)))
    return;
  read_wait(request);
  /* Do not lease to a client that has left, or while shutting down. */
  const bool has_left = mo_connection_has_left(request->connection);
  if (request->wait_over && (has_left || !mo_http_is_ready(request->http))) {
    mo_reply_error(request, has_left ? MO_ERR_NOT_FOUND : MO_ERR_CANCELLED, "session");
    return;
  }
  const bool may_wait = begin_wait(request, session);
  const int error =
      mo_fleet_exchange(fleet, session, (const uint8_t *)request->body, request->body_size,
                        mo_clock_ns(), &down, &down_size, &n_leases, &message);
  mo_request_drop_body(request); /* its results were taken; the body is not needed during the
                                  * wait */
  if (error == MO_OK && n_leases == 0 && may_wait) {
    free(down);
    return;
  }
  if (may_wait)
    mo_wait_end(request);
  if (error != MO_OK)
    reply_refusal(request, error, &message);
  else
    reply_bytes(request, down, down_size);
}

void mo_api_get_weights(struct mo_request *request)
{
  struct mo_fleet *fleet = atomic_load(&mo_api_of(request)->fleet);
  const char *digits = request->parameters[0];
  struct mo_sha256 hash;
  struct mo_fleet_file *file;
  int error = mo_sha256_from_hex(digits, strlen(digits), &hash);
  if (error == MO_OK)
    error = mo_fleet_controller(fleet, &hash, &file);
  if (error != MO_OK) {
    mo_reply_error(request, error == MO_ERR_FORMAT ? MO_ERR_NOT_FOUND : error, "controller");
    return;
  }
  mo_reply_borrowed(request, "application/octet-stream", file->bytes, file->size,
                    mo_fleet_file_release, file);
  add_digest(request, &hash);
}
