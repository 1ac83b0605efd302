/* cmd_fleet.c: fleet, fleet drain, quarantine, release, verify: workers of other machines. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "template.h"
#include "transport.h"

/* Keeps the open sessions, or with --all all of them. */
static json_t *shown_of(const struct ctl *ctl, const json_t *sessions)
{
  json_t *shown = json_array(), *session;
  size_t i;
  json_array_foreach(sessions, i, session)
  {
    if (option_is_set(ctl, "all") || json_is_null(json_object_get(session, "ended_at")))
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
      {"threads", "{n_threads:,}[, {n_devices>0:,} GPUs]"},
      {"rollouts", "{rollouts_done:,} done, {rollouts_out:,} out, {rollouts_per_s:.0f} a second"},
      {"leases", "{leases_done:,} done, {leases:,} out, {leases_again:,} given out again"},
      {"audits", "{audits:,}, {audits_failed:,} with other bits"},
      {"lost", "{lost:,} of {joined:,} sessions"},
      {NULL, NULL}};
  if (!json_is_true(json_object_get(fleet, "listening"))) {
    print_plain_line(stdout, "no workers can join: the server has no fleet_listen");
    return;
  }
  print_facts(ctl, fleet, facts);
  json_t *shown = shown_of(ctl, json_object_get(fleet, "sessions"));
  if (json_array_size(shown) > 0)
    print_table(stdout, ctl, shown,
                "id={id}|name={name}|host={host}|state={state}|>threads={n_threads:,}"
                "|>GPUs={n_devices:,}|>rollouts/s={rollouts_per_s:.0f}|>leases={leases:,}"
                "|>done={rollouts_done:,}|>lost={leases_lost:,}|since={joined_at:time}|why={why}");
  json_decref(shown);
  if (json_array_size(json_object_get(fleet, "quarantine")) > 0) {
    print_plain_line(stdout, "In quarantine:");
    print_table(stdout, ctl, json_object_get(fleet, "quarantine"),
                "name={name}|host={host}|token={user}|since={quarantined_at:time}|why={why}");
  }
}

int run_fleet(struct ctl *ctl)
{
  return show(ctl, "/v1/fleet", print_fleet);
}

/* Sends a request without a reply's body, and says what it did. */
static int act(struct ctl *ctl, struct request request, const char *words)
{
  struct reply reply = {0};
  const int status = transport_send(ctl, &request, &reply);
  if (status == STATUS_OK && !ctl->quiet && !ctl->json)
    print_plain_line(stdout, "%s %s", ctl->operands[0], words);
  reply_free(&reply);
  return status;
}

int run_fleet_drain(struct ctl *ctl)
{
  if (!check_job_id(ctl->operands[0]))
    return STATUS_USAGE;
  char *path = format_text("/v1/fleet/sessions/%s/drain", ctl->operands[0]);
  const int status = act(ctl, (struct request){.method = "POST", .path = path, .repeatable = true},
                         "gets no more work");
  free(path);
  return status;
}

int run_fleet_quarantine(struct ctl *ctl)
{
  if (!check_job_id(ctl->operands[0]))
    return STATUS_USAGE;
  char *path = format_text("/v1/fleet/sessions/%s/quarantine", ctl->operands[0]);
  json_t *why = ctl->n_operands > 1 ? json_pack("{s:s}", "why", ctl->operands[1]) : json_object();
  char *body = dump_json(why, JSON_COMPACT);
  const int status = act(ctl,
                         (struct request){.method = "POST",
                                          .path = path,
                                          .content_type = "application/json",
                                          .body = body,
                                          .body_bytes = strlen(body),
                                          .repeatable = true},
                         "is in quarantine");
  free(body);
  json_decref(why);
  free(path);
  return status;
}

int run_fleet_release(struct ctl *ctl)
{
  char *escaped = escape(ctl->operands[0]);
  char *path = format_text("/v1/fleet/quarantine/%s", escaped);
  const int status = act(ctl, (struct request){.method = "DELETE", .path = path}, "may join again");
  free(path);
  free(escaped);
  return status;
}

/* Adds what a page says to the whole: counts and what differs. */
static void add_page(json_t *whole, const json_t *page)
{
  static const char *const counts[] = {"checked", "skipped"};
  for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
    json_object_set_new(whole, counts[i],
                        json_integer(number_of(whole, counts[i]) + number_of(page, counts[i])));
  json_array_extend(json_object_get(whole, "different"), json_object_get(page, "different"));
}

/* Asks for page after page. The transport waits where the server says that it is busy. */
static int verify_all(struct ctl *ctl, json_t *whole)
{
  json_t *request = json_pack("{s:s, s:b}", "origin", ctl->operands[0], "repair",
                              option_is_set(ctl, "repair")),
         *page = NULL;
  int status;
  do {
    json_decref(page);
    status = post_again(ctl, "/v1/fleet/verify", request, &page);
    add_page(whole, page);
    json_object_set(request, "after", json_object_get(page, "next"));
  } while (status == STATUS_OK && !interrupted() && text_of(page, "next")[0] != '\0');
  const bool is_cut = text_of(page, "next")[0] != '\0';
  json_decref(page);
  json_decref(request);
  return status == STATUS_OK && is_cut ? STATUS_INTERRUPTED : status;
}

int run_fleet_verify(struct ctl *ctl)
{
  const bool repairs = option_is_set(ctl, "repair");
  json_t *whole = json_pack("{s:s, s:i, s:i, s:b, s:[]}", "origin", ctl->operands[0], "checked", 0,
                            "skipped", 0, "repaired", repairs, "different");
  json_t *different = json_object_get(whole, "different");
  catch_interrupts();
  int status = verify_all(ctl, whole);
  /* What was found is told in any case: after a repair nothing finds it again. */
  if (json_array_size(different) > 0 && !ctl->json)
    print_table(stdout, ctl, different,
                "id={id}|>stored={stored.loss:.17g}|>computed={computed.loss:.17g}"
                "|environment={environment:.12}|controller={controller:.12}"
                "|physics={physics:.12}|since={computed_at:time}");
  if (status == STATUS_OK || json_array_size(different) > 0)
    tell(ctl, whole,
         repairs ? "{checked:,} losses computed again, {different:#} were replaced"
                   "[; {skipped>0:,} are of a class that the server does not have]"
                 : "{checked:,} losses computed again, {different:#} differ"
                   "[; {skipped>0:,} are of a class that the server does not have]");
  if (status == STATUS_OK && json_array_size(different) > 0 && !repairs)
    status = STATUS_NEGATIVE;
  json_decref(whole);
  return status;
}
