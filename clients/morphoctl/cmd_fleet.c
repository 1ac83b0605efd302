/* cmd_fleet.c: fleet, fleet drain, verify: workers on other machines. */
#include <string.h>

#include "commands.h"

static bool is_open(const json_t *session)
{
  return json_is_null(json_object_get(session, "ended_at"));
}

/* Returns the open sessions; with --all, all sessions. */
static json_t *shown_of(const struct ctl *ctl, const json_t *sessions)
{
  json_t *shown = keep(json_array()), *session;
  size_t i;
  json_array_foreach(sessions, i, session)
  {
    if (option_is_set(ctl, "all") || is_open(session))
      json_array_append(shown, session);
  }
  return shown;
}

static void print_fleet(const struct ctl *ctl, const json_t *fleet)
{
  static const struct fact facts[] = {
      {"compute", "{compute}"},
      {"workers", "{classes.cpu.sessions:,} of class {classes.cpu.scores}"},
      {"workers", "[{classes.device.sessions:,} of class {classes.device.scores}]"},
      {"older", "[{n_older>0:,} than version {version}]"},
      {"threads", "{n_threads:,}[, {n_devices>0:,} GPUs]"},
      {"rollouts",
       "{rollouts_done:,} done, {rollouts_out:,} in flight, {rollouts_per_s:.0f} per second"},
      {"leases", "{leases_done:,} done, {leases:,} in flight, {leases_again:,} reissued"},
      {"audits", "{audits:,}, {audits_failed:,} with different bits"},
      {"lost", "{lost:,} of {joined:,} sessions"},
      {NULL, NULL}};
  if (!json_is_true(json_object_get(fleet, "listening"))) {
    print_plain_line(stdout, "no workers can join: the server has no fleet_listen");
    return;
  }
  print_facts(ctl, fleet, facts);
  const json_t *shown = shown_of(ctl, json_object_get(fleet, "sessions"));
  if (json_array_size(shown) > 0)
    print_table(
        stdout, ctl, shown,
        "id={id}|name={name}|host={host}|version={version}|state={state}|>threads={n_threads:,}"
        "|>GPUs={n_devices:,}|>rollouts/s={rollouts_per_s:.0f}|>leases held={leases:,}"
        "|>rollouts={rollouts_done:,}|>leases "
        "lost={leases_lost:,}|since={joined_at:time}|why={why}");
}

void run_fleet(struct ctl *ctl)
{
  show(ctl, "/v1/fleet", print_fleet);
}

/* ---- drains ---- */

#define LOOK_S  0.5
#define LEAVE_S 40 /* a worker takes at most 22 s to finish its leases */

static bool is_same(const json_t *session, const json_t *other, const char *key)
{
  return strcmp(text_of(session, key), text_of(other, key)) == 0;
}

static const json_t *find(const json_t *fleet, const json_t *session)
{
  const json_t *found;
  size_t i;
  json_array_foreach(json_object_get(fleet, "sessions"), i, found)
  {
    if (is_same(found, session, "id"))
      return found;
  }
  return NULL;
}

/* Returns the session of a worker that joined after `before`, or NULL. */
static const json_t *find_return(const json_t *before, const json_t *now, const json_t *worker)
{
  const json_t *session;
  size_t i;
  json_array_foreach(json_object_get(now, "sessions"), i, session)
  {
    if (is_open(session) && is_same(session, worker, "name") && is_same(session, worker, "host") &&
        find(before, session) == NULL)
      return session;
  }
  return NULL;
}

/* Waits until a worker has left and is back. Returns the version that it then has, or "" if it is
 * not back. */
static const char *await_return(struct ctl *ctl, const json_t *before, const json_t *worker,
                                int64_t within_s)
{
  static char version[64];
  const struct request look = {.method = "GET", .path = "/v1/fleet"};
  double left_s = LEAVE_S;
  bool has_left = false;
  version[0] = '\0';
  while (version[0] == '\0' && left_s > 0) {
    pause_s(LOOK_S);
    if (interrupted())
      leave(STATUS_INTERRUPTED);
    left_s -= LOOK_S;
    json_t *now = send_json(ctl, &look, NULL);
    const json_t *old = find(now, worker);
    if (!has_left && (old == NULL || !is_open(old))) {
      has_left = true;
      left_s = (double)within_s;
    }
    const json_t *back = has_left ? find_return(before, now, worker) : NULL;
    if (back != NULL)
      snprintf(version, sizeof(version), "%s", text_of(back, "version"));
    json_decref(now);
  }
  if (!has_left)
    fail(STATUS_NEGATIVE, "%s has not left", text_of(worker, "name"));
  return version;
}

static void upgrade(struct ctl *ctl, const json_t *worker, const char *wanted, int64_t within_s)
{
  const char *name = text_of(worker, "name"), *old = text_of(worker, "version");
  const struct request drain = {
      .method = "POST",
      .path = path_to("/v1/fleet/sessions/%s/drain?upgrade=true", text_of(worker, "id"))};
  struct reply reply;
  const json_t *before = get_json(ctl, "/v1/fleet");
  transport_send(ctl, &drain, &reply);
  reply_free(&reply);
  const char *version = await_return(ctl, before, worker, within_s);
  if (strcmp(version, old) == 0)
    fail(STATUS_NEGATIVE, "%s is back with the old version %s: install %s there first", name, old,
         wanted);
  if (!ctl->quiet && !ctl->json)
    print_plain_line(stdout, "%s has left and is %s%s", name,
                     *version != '\0' ? "back with version " : "not back", version);
  fflush(stdout);
}

static void upgrade_all(struct ctl *ctl)
{
  const char *version = option_text(ctl, "version", "");
  const int64_t within_s = option_number(ctl, "within", 0, 86400, 60);
  const json_t *fleet = get_json(ctl, "/v1/fleet"), *session;
  const char *wanted = text_of(fleet, "version");
  size_t i, n = 0;
  if (strcmp(version, wanted) == 0)
    fail(STATUS_USAGE, "--version: %s is the version of the server", version);
  catch_interrupts(NULL);
  json_array_foreach(json_object_get(fleet, "sessions"), i, session)
  {
    const bool is_meant = *version != '\0' ? strcmp(text_of(session, "version"), version) == 0
                                           : json_is_true(json_object_get(session, "older"));
    if (!is_meant || strcmp(text_of(session, "state"), "active") != 0)
      continue;
    upgrade(ctl, session, wanted, within_s);
    n++;
  }
  if (n == 0 && !ctl->quiet && !ctl->json)
    print_plain_line(stdout, "no worker has %s version", *version != '\0' ? "that" : "an older");
}

void run_fleet_drain(struct ctl *ctl)
{
  const bool is_one = ctl->n_operands == 1;
  if (is_one + option_is_set(ctl, "older") + option_is_set(ctl, "version") != 1)
    fail(STATUS_USAGE, "fleet drain needs an ID, --older, or --version");
  if (!is_one) {
    upgrade_all(ctl);
    return;
  }
  const char *id = job_id(ctl->operands[0]);
  act(ctl, (struct request){.method = "POST", .path = path_to("/v1/fleet/sessions/%s/drain", id)},
      path_to("%s gets no more work", id));
}

/* ---- verify ---- */

/* Adds a page to the total: counts and differences. */
static void add_page(json_t *whole, const json_t *page)
{
  add_number(whole, page, "checked");
  add_number(whole, page, "skipped");
  json_array_extend(json_object_get(whole, "different"), json_object_get(page, "different"));
}

/* Requests page after page. The transport waits if the server says that it is busy. */
static int verify_all(struct ctl *ctl, json_t *whole)
{
  json_t *request = keep(
      json_pack("{s:s, s:b}", "origin", ctl->operands[0], "repair", option_is_set(ctl, "repair")));
  for (;;) {
    const struct request how = json_request("POST", "/v1/fleet/verify", request);
    json_t *page;
    const int status = try_json(ctl, &how, NULL, &page);
    add_page(whole, page);
    json_object_set(request, "after", json_object_get(page, "next"));
    const bool is_last = text_of(page, "next")[0] == '\0';
    json_decref(page);
    if (status != STATUS_OK || is_last)
      return status;
    if (interrupted())
      return STATUS_INTERRUPTED;
  }
}

/* Returns copies of differences with `measured`: each measure that differs, with both values. */
static json_t *difference_rows(const json_t *different, bool *any_measured)
{
  json_t *rows = keep(json_array());
  const json_t *difference;
  size_t i;
  json_array_foreach(different, i, difference)
  {
    json_t *row = need(json_copy((json_t *)difference)), *stored;
    const char *words = "", *name;
    json_object_foreach(json_object_get(json_object_get(row, "stored"), "measures"), name, stored)
    {
      const json_t *computed =
          json_object_get(json_object_get(json_object_get(row, "computed"), "measures"), name);
      const char *right = keep(need(dump_json(computed, JSON_ENCODE_ANY))),
                 *wrong = keep(need(dump_json(stored, JSON_ENCODE_ANY)));
      words = keep(format_text("%s%s%s %s, not %s", words, words[0] != '\0' ? "; " : "", name,
                               right, wrong));
    }
    *any_measured = *any_measured || words[0] != '\0';
    json_object_set_new(row, "measured", json_string(words));
    json_array_append_new(rows, row);
  }
  return rows;
}

void print_differences(const struct ctl *ctl, const json_t *different)
{
  bool any_measured = false;
  if (json_array_size(different) == 0 || ctl->json)
    return;
  const json_t *rows = difference_rows(different, &any_measured);
  print_table(stdout, ctl, rows,
              keep(format_text("design={robot}|>stored=[{stored.loss:.17g}]"
                               "|>computed=[{computed.loss:.17g}]%s"
                               "|environment={environment:.12}|controller={controller:.12}"
                               "|physics={physics:.12}|since={computed_at:time}",
                               any_measured ? "|measures={measured}" : "")));
}

void run_fleet_verify(struct ctl *ctl)
{
  const bool repairs = option_is_set(ctl, "repair");
  json_t *whole = keep(json_pack("{s:s, s:i, s:i, s:b, s:[]}", "origin", ctl->operands[0],
                                 "checked", 0, "skipped", 0, "repaired", repairs, "different"));
  json_t *different = json_object_get(whole, "different");
  catch_interrupts(NULL);
  int status = verify_all(ctl, whole);
  /* Always print what was found: after a repair it cannot be found again. */
  print_differences(ctl, different);
  if (status == STATUS_OK || json_array_size(different) > 0)
    tell(ctl, whole,
         repairs ? "{checked:,} rollout{checked:s} computed again, {different:#} were replaced"
                   "[; {skipped>0:,} belong to a class that the server does not have]"
                 : "{checked:,} rollout{checked:s} computed again, {different:#} differ"
                   "[; {skipped>0:,} belong to a class that the server does not have]");
  if (status == STATUS_OK && json_array_size(different) > 0 && !repairs)
    status = STATUS_NEGATIVE;
  leave(status);
}
