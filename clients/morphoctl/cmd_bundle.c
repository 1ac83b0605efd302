/* cmd_bundle.c: campaigns as files: out of a server, checked, and into another one. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "transport.h"

#define BUNDLE_TYPE      "application/zstd"
#define BUNDLE_BYTES_MAX ((size_t)4 << 30)
#define RECOMPUTE_MAX    1000

/* ---- out ---- */

int run_bundle_export(struct ctl *ctl)
{
  static const char *const filters[] = {"label", "experiment", "group"};
  const char *output = ctl->operands[0];
  char *path = NULL;
  size_t size = 0;
  FILE *text = open_memstream(&path, &size);
  if (text == NULL)
    return complain(STATUS_ERROR, "out of memory");
  fputs("/v1/bundles", text);
  for (size_t i = 1; i < ctl->n_operands; i++) {
    if (!check_job_id(ctl->operands[i])) {
      fclose(text);
      free(path);
      return STATUS_USAGE;
    }
    fprintf(text, "%s%s", i == 1 ? "?campaigns=" : ",", ctl->operands[i]);
  }
  int ways = ctl->n_operands > 1;
  for (size_t i = 0; i < sizeof(filters) / sizeof(filters[0]); i++) {
    const char *value = option_text(ctl, filters[i], NULL);
    char *escaped = value != NULL ? escape(value) : NULL;
    if (escaped != NULL)
      fprintf(text, "?%s=%s", filters[i], escaped);
    ways += value != NULL;
    free(escaped);
  }
  if (option_is_set(ctl, "recordings"))
    fputs("&recordings=true", text); /* behind what says which campaigns */
  int status = fclose(text) == 0 ? STATUS_OK : complain(STATUS_ERROR, "out of memory");
  if (ways == 0)
    status = complain(STATUS_USAGE, "which campaigns? Give their ids, --label, --experiment or "
                                    "--group");
  else if (ways > 1)
    status = complain(STATUS_USAGE, "give either ids, --label, --experiment or --group");
  if (status == STATUS_OK)
    status = save_reply(ctl, path, BUNDLE_TYPE, output);
  free(path);
  return status;
}

/* ---- in ---- */

/* Makes the request that computes the stored scores of the best designs again. */
static int recompute_request(struct ctl *ctl, const char *id, int64_t n, json_t **request)
{
  json_t *campaign = NULL, *population = NULL, *worlds = NULL, *item;
  json_t *designs = json_array(), *environments = json_array();
  size_t i;
  int status = get_json(ctl, &campaign, "/v1/campaigns/%s", id);
  if (status == STATUS_OK)
    status = get_json(ctl, &population, "/v1/campaigns/%s/population?limit=%" PRId64, id, n);
  if (status == STATUS_OK)
    status = get_json(ctl, &worlds, "/v1/campaigns/%s/environments", id);
  json_array_foreach(json_object_get(population, "items"), i, item)
  {
    json_array_append_new(designs, json_pack("{s:O}", "voxels", json_object_get(item, "genotype")));
  }
  json_array_foreach(json_object_get(worlds, "items"), i, item)
  {
    json_array_append_new(
        environments, json_pack("{s:O,s:O}", "light_xy_m", json_object_get(item, "light_xy_m"),
                                "terrain_heights_m", json_object_get(item, "terrain_heights_m")));
  }
  const char *hash = text_of(json_object_get(campaign, "controller"), "sha256");
  *request = NULL;
  if (status == STATUS_OK && strcmp(text_of(campaign, "mode"), "zero-shot") == 0)
    *request =
        json_pack("{s:O,s:O,s:s+,s:O,s:b}", "designs", designs, "environments", environments,
                  "controller", "sha256:", hash, "physics",
                  json_object_get(json_object_get(campaign, "settings"), "physics"), "verify", 1);
  json_decref(campaign);
  json_decref(population);
  json_decref(worlds);
  json_decref(designs);
  json_decref(environments);
  return status;
}

/* Computes scores of a campaign again, and compares them with those that it brought. */
static int recompute(struct ctl *ctl, const char *id, int64_t n)
{
  json_t *request, *evaluation = NULL, *item;
  int64_t agree = 0, differ = 0, unknown = 0;
  size_t i;
  int status = recompute_request(ctl, id, n, &request);
  if (status == STATUS_OK && request == NULL) {
    print_plain_line(stderr, "campaign %s learns: its scores cannot be computed again", id);
    return STATUS_OK;
  }
  if (status == STATUS_OK)
    status = evaluate(ctl, "/v1/evaluations", request, true, &evaluation);
  if (status == STATUS_OK)
    status = job_outcome("recomputation", evaluation);
  json_array_foreach(json_object_get(evaluation, "results"), i, item)
  {
    const json_t *agrees = json_object_get(item, "agrees");
    agree += json_is_true(agrees);
    differ += json_is_false(agrees);
    unknown += json_is_null(agrees);
  }
  json_decref(request);
  json_decref(evaluation);
  if (status != STATUS_OK)
    return status;
  if (!ctl->quiet)
    print_plain_line(stderr,
                     "campaign %s: of %" PRId64 " designs the scores of %" PRId64
                     " agree bit for bit, %" PRId64 " differ, %" PRId64 " are of another class",
                     id, agree + differ + unknown, agree, differ, unknown);
  return differ > 0 ? STATUS_NEGATIVE : STATUS_OK;
}

/* Sends the bundle, and tells of each campaign what became of it. */
static int send_bundle(struct ctl *ctl, const char *path, json_t **entered)
{
  char *bytes = NULL;
  size_t n = 0;
  int status = read_input(ctl->operands[0], BUNDLE_BYTES_MAX, &bytes, &n);
  if (status == STATUS_OK)
    status = send_json(ctl,
                       &(struct request){.method = "POST",
                                         .path = path,
                                         .content_type = BUNDLE_TYPE,
                                         .body = bytes,
                                         .body_bytes = n,
                                         .repeatable = true},
                       NULL, entered);
  free(bytes);
  return status;
}

static void tell_entered(const struct ctl *ctl, const json_t *entered, bool verified)
{
  const json_t *item;
  size_t i;
  if (ctl->json) {
    print_json(entered);
    return;
  }
  json_array_foreach(json_object_get(entered, "items"), i, item)
  {
    const json_t *source = json_object_get(item, "source");
    const char *id = text_of(item, "campaign");
    if (!ctl->quiet)
      print_plain_line(stdout,
                       "campaign %s of store %s: %" PRId64 " designs, %" PRId64 " losses, %" PRId64
                       " recorded evaluations; %s%s",
                       text_of(source, "campaign"), text_of(source, "store"),
                       number_of(item, "designs"), number_of(item, "losses"),
                       number_of(item, "recordings"),
                       json_is_true(json_object_get(item, "entered")) ? "entered as campaign "
                       : id[0] != '\0'                                ? "is here as campaign "
                       : verified                                     ? "whole; not here yet"
                                                                      : "not here",
                       id);
  }
}

int run_bundle_import(struct ctl *ctl)
{
  int64_t n = 0;
  json_t *entered = NULL, *item;
  size_t i;
  if (!option_number(ctl, "recompute", 1, RECOMPUTE_MAX, &n))
    return STATUS_USAGE;
  int status = send_bundle(ctl, "/v1/bundles", &entered);
  if (status == STATUS_OK)
    tell_entered(ctl, entered, false);
  json_array_foreach(json_object_get(entered, "items"), i, item)
  {
    if (status == STATUS_OK && n > 0)
      status = recompute(ctl, text_of(item, "campaign"), n);
  }
  json_decref(entered);
  return status;
}

int run_bundle_verify(struct ctl *ctl)
{
  json_t *entered = NULL;
  const int status = send_bundle(ctl, "/v1/bundles?mode=verify", &entered);
  if (status == STATUS_OK)
    tell_entered(ctl, entered, true);
  json_decref(entered);
  return status;
}
