/* protocol.c: see protocol.h. Unknown members are skipped, because a newer daemon may send more. */
#include "worker/protocol.h"

#include <stdio.h>
#include <stdlib.h>

#include "base/json.h"

/* ---- the offer ---- */

static void put_class(const struct mo_fleet_offer *offer, enum mo_back_end back_end,
                      const char *name, struct mo_text *text)
{
  char canary[MO_SHA256_DIGITS + 1];
  if (offer->classes[back_end].scores[0] == '\0')
    return;
  mo_sha256_to_hex(&offer->classes[back_end].canary, canary);
  mo_text_name(text, name);
  mo_text_object(text);
  mo_text_member(text, "scores", offer->classes[back_end].scores);
  mo_text_member(text, "gradients", offer->classes[back_end].gradients);
  mo_text_member(text, "canary", canary);
  mo_text_add(text, "}");
}

void mo_protocol_put_offer(const struct mo_fleet_offer *offer, struct mo_text *text)
{
  mo_text_object(text);
  mo_text_member_count(text, "protocol", MO_FLEET_PROTOCOL);
  mo_text_member(text, "name", offer->name);
  mo_text_member(text, "host", offer->host);
  mo_text_member(text, "version", offer->version);
  mo_text_member_count(text, "n_threads", offer->n_threads);
  mo_text_member_count(text, "n_devices", offer->n_devices);
  mo_text_name(text, "classes");
  mo_text_object(text);
  put_class(offer, MO_ON_CPU, "cpu", text);
  put_class(offer, MO_ON_DEVICE, "device", text);
  mo_text_add(text, "}}");
}

/* ---- replies ---- */

struct reading {
  struct mo_json json;
  struct mo_faults faults;
};

static struct reading *begin(const char *text, size_t size)
{
  struct reading *reading = calloc(1, sizeof(*reading));
  if (reading != NULL)
    mo_json_start(&reading->json, text != NULL ? text : "", size, &reading->faults);
  return reading;
}

/* what: the expected kind of reply. */
static int end(struct reading *reading, bool is_complete, const char *what,
               struct mo_message *message)
{
  int error = MO_OK;
  if (!mo_json_finish(&reading->json) || reading->faults.n > 0)
    error = mo_fail(message, MO_ERR_FORMAT, "the daemon's reply is not a valid %s: %.100s: %.80s",
                    what, reading->faults.items[0].where, reading->faults.items[0].detail);
  else if (!is_complete)
    error = mo_fail(message, MO_ERR_FORMAT,
                    "the daemon's reply is not a valid %s: a member is missing", what);
  free(reading);
  return error;
}

/* Reads a number of 64 bits, which is sent as a string of digits. */
static bool read_number(struct mo_json *json, uint64_t *number)
{
  struct mo_json_slice slice;
  uint64_t value = 0;
  if (!mo_json_string(json, &slice))
    return false;
  bool is_number = slice.size > 0;
  for (size_t i = 0; is_number && i < slice.size; i++)
    is_number = slice.bytes[i] >= '0' && slice.bytes[i] <= '9' &&
                !__builtin_mul_overflow(value, (uint64_t)10, &value) &&
                !__builtin_add_overflow(value, (uint64_t)(slice.bytes[i] - '0'), &value);
  if (!is_number)
    mo_json_fault(json, "must be a string of digits");
  *number = value;
  return is_number;
}

static uint32_t read_positive(struct mo_json *json, int64_t max)
{
  int64_t value = 0;
  (void)mo_json_integer(json, 1, max, &value);
  return (uint32_t)value;
}

static void read_workspace(struct mo_json *json, struct mo_workspace *workspace)
{
  uint16_t sides[3] = {0};
  uint32_t n = 0;
  if (mo_json_array(json))
    while (mo_json_item(json)) {
      const uint16_t side = (uint16_t)read_positive(json, 1024);
      if (n < 3)
        sides[n] = side;
      n++;
    }
  *workspace = (struct mo_workspace){sides[0], sides[1], sides[2]};
  if (n != 3 || mo_workspace_check(*workspace) != MO_OK ||
      mo_workspace_words(*workspace) > MO_WIRE_WORDS_MAX)
    mo_json_fault(json, "must be three side lengths of at most %d voxels", 64 * MO_WIRE_WORDS_MAX);
}

int mo_protocol_get_session(const char *text, size_t size, struct mo_worker_session *session,
                            struct mo_message *message)
{
  struct reading *reading = begin(text, size);
  struct mo_json_slice key;
  uint64_t id = 0;
  if (reading == NULL)
    return MO_ERR_NO_MEMORY;
  struct mo_json *json = &reading->json;
  *session = (struct mo_worker_session){0};
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "session"))
        (void)read_number(json, &id);
      else if (mo_json_is(key, "workspace"))
        read_workspace(json, &session->workspace);
      else if (mo_json_is(key, "silence_s"))
        session->silence_ms = 1000 * read_positive(json, 3600);
      else if (mo_json_is(key, "wait_s"))
        session->wait_s = read_positive(json, 3600);
      else
        mo_json_skip(json);
    }
  snprintf(session->id, sizeof(session->id), "%llu", (unsigned long long)id);
  return end(reading,
             id > 0 && session->workspace.nx > 0 && session->silence_ms > 0 && session->wait_s > 0,
             "session", message);
}

static void read_dropped(struct mo_json *json, struct mo_fleet_orders *orders)
{
  const uint32_t most = sizeof(orders->dropped) / sizeof(orders->dropped[0]);
  if (mo_json_array(json))
    while (mo_json_item(json)) {
      uint64_t pair[2] = {0};
      uint32_t n = 0;
      if (mo_json_array(json))
        while (mo_json_item(json))
          if (read_number(json, &pair[n % 2]))
            n++;
      if (n != 2 || orders->n_dropped == most)
        mo_json_fault(json, "must be at most %u pairs of epoch and number", most);
      else
        orders->dropped[orders->n_dropped++] = (struct mo_lease_id){pair[0], pair[1]};
    }
}

int mo_protocol_get_orders(const char *text, size_t size, struct mo_fleet_orders *orders,
                           struct mo_message *message)
{
  struct reading *reading = begin(text, size);
  struct mo_json_slice key, word;
  bool has_state = false;
  if (reading == NULL)
    return MO_ERR_NO_MEMORY;
  struct mo_json *json = &reading->json;
  *orders = (struct mo_fleet_orders){0};
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "dropped")) {
        read_dropped(json, orders);
      } else if (mo_json_is(key, "wanted")) {
        if (mo_json_string(json, &word))
          snprintf(orders->wanted, sizeof(orders->wanted), "%.*s", (int)word.size, word.bytes);
      } else if (!mo_json_is(key, "state")) {
        mo_json_skip(json);
      } else if (mo_json_string(json, &word)) {
        has_state = true;
        orders->state = mo_json_is(word, "draining")  ? MO_SESSION_DRAINING
                        : mo_json_is(word, "refused") ? MO_SESSION_REFUSED
                                                      : MO_SESSION_ACTIVE;
      }
    }
  return end(reading, has_state, "set of orders", message);
}

void mo_protocol_get_detail(const char *text, size_t size, struct mo_message *message)
{
  struct reading *reading = begin(text, size);
  struct mo_json_slice key, word;
  *message = (struct mo_message){""};
  if (reading == NULL)
    return;
  if (mo_json_object(&reading->json))
    while (mo_json_member(&reading->json, &key)) {
      if (!mo_json_is(key, "detail"))
        mo_json_skip(&reading->json);
      else if (mo_json_string(&reading->json, &word))
        snprintf(message->text, sizeof(message->text), "%.*s", (int)word.size, word.bytes);
    }
  free(reading);
}
