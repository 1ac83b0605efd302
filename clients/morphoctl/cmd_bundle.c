/* cmd_bundle.c: bundle export, verify and import: campaigns as files. export: saves any list, curve
 * or phylogeny as a file. */
#include <inttypes.h>
#include <string.h>

#include "base/text.h"
#include "commands.h"

#define BUNDLE_TYPE      "application/zstd"
#define BUNDLE_BYTES_MAX ((size_t)4 << 30)
#define RECOMPUTE_MAX    1000

/* ---- export ---- */

void run_bundle_export(struct ctl *ctl)
{
  static const char *const filters[] = {"label", "experiment", "group", NULL};
  const char *path = "/v1/bundles";
  int ways = ctl->n_operands > 1;
  for (size_t i = 1; i < ctl->n_operands; i++)
    path =
        keep(format_text("%s%s%s", path, i == 1 ? "?campaigns=" : ",", job_id(ctl->operands[i])));
  path = path_with(ctl, path, filters);
  for (size_t i = 0; filters[i] != NULL; i++)
    ways += option_is_set(ctl, filters[i]);
  if (option_is_set(ctl, "recordings"))
    path = path_to("%s&recordings=true", path); /* after the selection of campaigns */
  if (ways == 0)
    fail(STATUS_USAGE, "give campaign ids, --label, --experiment or "
                       "--group");
  if (ways > 1)
    fail(STATUS_USAGE, "give only one of ids, --label, --experiment and --group");
  save_reply(ctl, path, BUNDLE_TYPE, ctl->operands[0]);
}

/* ---- import ---- */

/* Makes the request that recomputes the stored scores of the best designs. Returns NULL if the
 * campaign learns. */
static json_t *recompute_request(struct ctl *ctl, const char *id, int64_t n)
{
  const json_t *campaign = get_json(ctl, "/v1/campaigns/%s", id), *item;
  if (strcmp(text_of(campaign, "mode"), "zero-shot") != 0)
    return NULL;
  const json_t *population = get_json(ctl, "/v1/campaigns/%s/population?limit=%" PRId64, id, n);
  const json_t *worlds = get_json(ctl, "/v1/campaigns/%s/environments", id);
  json_t *designs = keep(json_array()), *environments = keep(json_array());
  size_t i;
  json_array_foreach(json_object_get(population, "items"), i, item)
  {
    json_array_append_new(designs, json_pack("{s:O}", "voxels", json_object_get(item, "genotype")));
  }
  json_array_foreach(json_object_get(worlds, "items"), i, item)
  {
    json_t *world = json_copy((json_t *)item);
    json_object_del(world, "sha256");
    json_array_append_new(environments, world);
  }
  return keep(json_pack(
      "{s:O,s:O,s:s+,s:O,s:b}", "designs", designs, "environments", environments, "controller",
      "sha256:", text_of(json_object_get(campaign, "controller"), "sha256"), "physics",
      json_object_get(json_object_get(campaign, "settings"), "physics"), "verify", 1));
}

/* Recomputes scores of a campaign, and compares them with the imported ones. */
static void recompute(struct ctl *ctl, const char *id, int64_t n)
{
  const json_t *request = recompute_request(ctl, id, n), *item;
  int64_t agree = 0, differ = 0, unknown = 0;
  size_t i;
  if (request == NULL) {
    print_plain_line(stderr, "campaign %s learns, so its scores cannot be recomputed", id);
    return;
  }
  const json_t *evaluation = evaluate(ctl, "/v1/evaluations", request, true);
  expect_success("recomputation", evaluation);
  json_array_foreach(json_object_get(evaluation, "results"), i, item)
  {
    const json_t *agrees = json_object_get(item, "agrees");
    agree += json_is_true(agrees);
    differ += json_is_false(agrees);
    unknown += json_is_null(agrees);
  }
  if (!ctl->quiet)
    print_plain_line(stderr,
                     "campaign %s: of %s the scores of %" PRId64 " agree bit for bit, %" PRId64
                     " differ, %" PRId64 " belong to another class",
                     id, MO_COUNTED((uint64_t)(agree + differ + unknown), "design"), agree, differ,
                     unknown);
  if (differ > 0)
    leave(STATUS_NEGATIVE);
}

static const json_t *send_bundle(struct ctl *ctl, const char *path)
{
  size_t n;
  const char *bytes = read_input(ctl->operands[0], BUNDLE_BYTES_MAX, &n);
  return keep(send_json(ctl,
                        &(struct request){.method = "POST",
                                          .path = path,
                                          .content_type = BUNDLE_TYPE,
                                          .body = bytes,
                                          .body_bytes = n},
                        NULL));
}

static void tell_entered(const struct ctl *ctl, const json_t *entered)
{
  const json_t *item;
  size_t i;
  if (ctl->json) {
    print_json(entered);
    return;
  }
  json_array_foreach(json_object_get(entered, "items"), i, item)
  {
    if (!ctl->quiet)
      print_from(stdout, item,
                 "campaign {source.campaign} of store {source.store}: {designs} design{designs:s}, "
                 "{losses} "
                 "[{losses=1}loss|losses], {recordings} recorded evaluation{recordings:s}; "
                 "[{entered=true}imported as campaign "
                 "{campaign}|already stored as campaign {campaign}|intact, not imported]");
  }
}

void run_bundle_import(struct ctl *ctl)
{
  const int64_t n = option_number(ctl, "recompute", 1, RECOMPUTE_MAX, 0);
  const json_t *entered = send_bundle(ctl, "/v1/bundles"), *item;
  size_t i;
  tell_entered(ctl, entered);
  json_array_foreach(json_object_get(entered, "items"), i, item)
  {
    if (n > 0)
      recompute(ctl, text_of(item, "campaign"), n);
  }
}

void run_bundle_verify(struct ctl *ctl)
{
  tell_entered(ctl, send_bundle(ctl, "/v1/bundles?mode=verify"));
}

/* ---- any list ---- */

/* Returns the format for the suffix of a file name, or csv without a suffix. Ends the program for
 * an unknown suffix, such as .parquet. */
static const char *form_of(const char *output)
{
  static const struct {
    const char *end, *form;
  } ends[] = {{".csv", "csv"}, {".ndjson", "ndjson"}, {".jsonl", "ndjson"}, {".nwk", "newick"}};
  const char *folder = strrchr(output, '/'), *end = strrchr(folder != NULL ? folder : output, '.');
  for (size_t i = 0; end != NULL && i < sizeof(ends) / sizeof(ends[0]); i++)
    if (strcmp(end, ends[i].end) == 0)
      return ends[i].form;
  if (end != NULL)
    fail(STATUS_USAGE,
         "--output: %s is not a known suffix: .csv, .ndjson, .jsonl or .nwk; "
         "for other names, give --format",
         end);
  return "csv";
}

void run_export(struct ctl *ctl)
{
  static const char *const forms[] = {"csv", "ndjson", "newick", "columns", NULL};
  const char *list = ctl->operands[0], *output = option_text(ctl, "output", "-");
  const char *form = option_word(ctl, "format", forms, NULL);
  if (form == NULL)
    form = form_of(output);
  if (strncmp(list, "/v1/", 4) == 0)
    list += 4;
  if (list[strspn(list, "0123456789")] == '\0')
    fail(STATUS_USAGE,
         "\"%s\" is not a list: give one of a job, such as evaluations/7/results, "
         "trainings/7/steps or campaigns/7/population, or one of all, such as jobs",
         list);
  for (const char *c = list; *c != '\0'; c++)
    if (*c <= ' ' || *c > '~' || *c == '#')
      fail(STATUS_USAGE, "\"%s\" is not a list: escape special characters, such as a space as %%20",
           list);
  const char between = strchr(list, '?') != NULL ? '&' : '?';
  save_reply(ctl, path_to("/v1/%s%cformat=%s", list, between, form), "*/*", output);
}
