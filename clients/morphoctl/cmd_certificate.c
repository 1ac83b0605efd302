/* cmd_certificate.c: certify and certificate: how much scores depend on the simulation. */
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "commands.h"
#include "results.h"

#define BEST_MAX 256

static void check_form(const struct ctl *ctl)
{
  if (ctl->json && option_is_set(ctl, "csv"))
    fail(STATUS_USAGE, "give --json or --csv, not both");
}

/* ---- the report ---- */

/* Prints text from the server in lines, each after `indent` spaces. */
static void print_wrapped(int indent, const char *text)
{
  char *plain = need(plain_text(text));
  mo_words_wrap(stdout, indent, plain);
  free(plain);
}

static void print_remarks(const json_t *report, const char *list, const char *key,
                          const char *format)
{
  const json_t *remark;
  size_t i;
  json_array_foreach(json_object_get(report, list), i, remark)
      print_wrapped(0, keep(format_text(format, text_of(remark, "axis"), text_of(remark, key))));
}

/* Returns the designs, best first, ties in the order of the request. */
static json_t *ranked_designs(const json_t *report)
{
  const json_t *designs = json_object_get(report, "designs");
  const size_t n = json_array_size(designs);
  json_t *ranked = keep(json_array()), *design;
  for (size_t i = 0; i < n; i++) {
    size_t at = json_array_size(ranked);
    design = json_array_get(designs, i);
    while (at > 0 && number_of(json_array_get(ranked, at - 1), "rank") > number_of(design, "rank"))
      at--;
    json_array_insert(ranked, at, design);
    json_object_set_new(design, "flagged", json_string(words_of(json_object_get(design, "flags"))));
  }
  return ranked;
}

/* Returns what computed the losses: a class for each precision and device that was used. */
static const char *classes_of(const json_t *report)
{
  json_t *classes = keep(json_array());
  const json_t *level, *known;
  size_t i, k;
  json_array_foreach(json_object_get(report, "levels"), i, level)
  {
    json_t *name = json_object_get(level, "fingerprint");
    bool is_new = true;
    json_array_foreach(classes, k, known) is_new = is_new && !json_equal(known, name);
    if (is_new)
      json_array_append(classes, name);
  }
  return words_of(classes);
}

static void print_report(const struct ctl *ctl, const json_t *report)
{
  static const struct fact facts[] = {
      {"certificate", "{id}[{complete=false}, incomplete: only the levels so far]"},
      {"controller", CONTROLLER_WORDS("controller", "")},
      {"environments", "[{environments}|{environments.count} from the request]"},
      {"physics", "{physics.n_steps} steps of {physics.dt_s:g} s, integrator {physics.integrator}"},
      {"class", "[{classes}]"},
      {"seed", "{seed}"},
      {"designs", "{n_designs}; regret of choosing the [best {top>1}|best one]"},
      {NULL, NULL}};
  json_t *designs = ranked_designs(report);
  const json_t *design;
  size_t i;
  json_object_set_new((json_t *)report, "classes", json_string(classes_of(report)));
  print_facts(ctl, report, facts);
  putchar('\n');
  print_wrapped(0, text_of(report, "verdict"));
  putchar('\n');
  print_table(
      stdout, ctl, json_object_get(report, "levels"),
      "axis={axis}|>level=[{level:g}]|>worlds={environments}|precision={precision}|>tau={tau:.2f}"
      "|95 % interval=[{tau_interval.0:.2f} to {tau_interval.1:.2f}]"
      "|>regret={regret:.4f}|>mean score={mean_score:.4f}"
      "|>diverged=[{diverged_designs>0}]");
  print_remarks(report, "left_out", "reason", "left out: %s: %s");
  print_remarks(report, "axis_notes", "note", "%s: %s");
  putchar('\n');
  print_table(stdout, ctl, designs,
              ">rank={rank}|design={design}|>score={score:.4f}"
              "|95 % interval=[{interval.0:.4f} to {interval.1:.4f}]|flags=[{flagged}]");
  json_array_foreach(designs, i, design)
  {
    putchar('\n');
    print_from(stdout, design, "{rank}  {design}");
    print_wrapped(4, text_of(design, "verdict"));
  }
}

/* Prints the report in the form that the options request. */
static void show_report(struct ctl *ctl, const char *id)
{
  const char *path = path_to("/v1/certificates/%s/report", id);
  if (option_is_set(ctl, "csv"))
    save_reply(ctl, path_to("%s.csv", path), "text/csv", "-");
  else
    show(ctl, path, print_report);
}

void run_certificate(struct ctl *ctl)
{
  check_form(ctl);
  show_report(ctl, job_id(ctl->operands[0]));
}

/* ---- certify ---- */

/* Adds the designs of the operands, or those of another job. */
static void fill_designs(struct ctl *ctl, json_t *request)
{
  const char *campaign = option_text(ctl, "campaign", NULL),
             *evaluation = option_text(ctl, "evaluation", NULL);
  const int64_t best = option_number(ctl, "best", 1, BEST_MAX, 0);
  if (campaign == NULL && evaluation == NULL) {
    if (best > 0)
      fail(STATUS_USAGE, "--best needs --campaign or --evaluation");
    json_object_set(request, "designs", given_designs(ctl, 0, NULL).list);
    return;
  }
  if (campaign != NULL && evaluation != NULL)
    fail(STATUS_USAGE, "give --campaign or --evaluation, not both");
  if (ctl->n_operands > 0)
    fail(STATUS_USAGE, "give designs or --%s, not both",
         campaign != NULL ? "campaign" : "evaluation");
  json_t *population = json_pack("{s:s}", campaign != NULL ? "campaign" : "evaluation",
                                 job_id(campaign != NULL ? campaign : evaluation));
  if (best > 0)
    json_object_set_new(population, "best", json_integer(best));
  json_object_set_new(request, "population", population);
}

/* Reports what the job with the designs provided, and the designs that are skipped, or were chosen
 * for an id. */
static void print_notes(const struct ctl *ctl, const json_t *job)
{
  const json_t *notes = json_object_get(job, "notes"), *note;
  const char *taken = words_of(value_at(job, "certificate.from_population")), *kind;
  json_t *population = json_object_get(job, "population"), *id;
  size_t i;
  json_object_foreach(population, kind, id)
  {
    if (*taken != 0 && !ctl->quiet && !ctl->json)
      print_plain_line(stderr, "taken from %s %s: %s", kind, json_string_value(id), taken);
  }
  json_array_foreach(notes, i, note)
  {
    if (json_is_object(json_object_get(note, "fault")) && !ctl->quiet)
      print_from(stderr, note, "design {place} is left out: {fault.pointer}: {fault.detail}");
  }
  say_orientations(ctl, notes);
}

void run_certify(struct ctl *ctl)
{
  const bool wait = option_is_set(ctl, "wait"), speaks = !ctl->json && !ctl->quiet;
  json_t *request = keep(json_object());
  check_form(ctl);
  if (option_is_set(ctl, "csv") && !wait)
    fail(STATUS_USAGE, "--csv needs the report: give --wait");
  fill_designs(ctl, request);
  request_fill(ctl, request);
  const json_t *job = post_job(ctl, "/v1/certificates", request, 0);
  const char *id = text_of(job, "id");
  print_notes(ctl, job);
  if (!wait) {
    if (ctl->json)
      print_json(job);
    else
      print_from(stdout, job, "{id}");
    if (speaks)
      print_from(stderr, job,
                 "certificate {id} accepted: {certificate.designs} design{certificate.designs:s}, "
                 "{certificate.trials} trial{certificate.trials:s}, {certificate.rollouts:,} "
                 "rollouts; morphoctl watch {id}");
    complain_of_warnings("job", job);
    return;
  }
  await_job(ctl, job, "certificate");
  job = get_json(ctl, "/v1/certificates/%s", id);
  if (number_of(json_object_get(job, "certificate"), "trials_done") > 0)
    show_report(ctl, id);
  expect_success("job", job);
}
