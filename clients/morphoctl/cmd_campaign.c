/* cmd_campaign.c: campaign start, list, show, extend, prune. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "campaign.h"
#include "commands.h"
#include "fields.h"
#include "table.h"
#include "training.h"
#include "transport.h"

/* ---- start ---- */

/* Adds --selection NAME. The options of a kind need it. */
static int fill_selection(const struct ctl *ctl, json_t *request)
{
  static const char *const options[][2] = {{"tournament", "tournament-size"},
                                           {"novelty", "novelty-weight"},
                                           {"age-layered", "layers"},
                                           {"age-layered", "age-gap"}};
  const char *kind = option_text(ctl, "selection", NULL);
  for (size_t i = 0; i < sizeof(options) / sizeof(options[0]); i++)
    if (option_is_set(ctl, options[i][1]) && (kind == NULL || strcmp(kind, options[i][0]) != 0))
      return complain(STATUS_USAGE, "--%s needs --selection %s", options[i][1], options[i][0]);
  if (kind != NULL)
    json_object_set_new(request, "selection", json_pack("{s:s}", "kind", kind));
  return STATUS_OK;
}

/* Adds --workspace X,Y,Z. */
static int fill_workspace(const struct ctl *ctl, json_t *request)
{
  const char *text = option_text(ctl, "workspace", NULL);
  int x, y, z, end = 0;
  if (text == NULL)
    return STATUS_OK;
  /* NOLINTNEXTLINE(cert-err34-c): 5 digits fit */
  if (sscanf(text, "%5d,%5d,%5d%n", &x, &y, &z, &end) != 3 || text[end] != 0)
    return complain(STATUS_USAGE, "--workspace: \"%s\" is not X,Y,Z, e.g. 6,6,4", text);
  json_object_set_new(request, "workspace", json_pack("[i, i, i]", x, y, z));
  return STATUS_OK;
}

/* Adds the initial population: the operands, or that of another campaign. */
static int fill_initial(struct ctl *ctl, json_t *request)
{
  const char *from = option_text(ctl, "from", NULL);
  if (from != NULL && ctl->n_operands > 1)
    return complain(
        STATUS_USAGE,
        "an initial population comes from designs or --from a campaign: give one of the two");
  if (from != NULL) {
    if (!check_job_id(from))
      return STATUS_USAGE;
    json_object_set_new(request, "initial", json_pack("{s:s}", "campaign", from));
  }
  if (ctl->n_operands < 2)
    return STATUS_OK;
  struct designs designs = {0};
  int status = STATUS_OK;
  for (size_t i = 1; i < ctl->n_operands && status == STATUS_OK; i++)
    status = designs_add_operand(&designs, ctl->operands[i]);
  if (status == STATUS_OK)
    json_object_set_new(request, "initial", json_pack("{s:O}", "designs", designs.list));
  designs_free(&designs);
  return status;
}

static int fill_request(struct ctl *ctl, json_t *request)
{
  int status = fill_selection(ctl, request);
  if (status == STATUS_OK)
    status = fill_workspace(ctl, request);
  if (status == STATUS_OK)
    status = fill_schedule(ctl, request, "learning.schedule");
  if (status == STATUS_OK)
    status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = fill_initial(ctl, request);
  if (status == STATUS_OK)
    status = request_fill(ctl, request); /* controller, environments, physics */
  const char *controller = option_text(ctl, "controller", NULL);
  if (status == STATUS_OK && controller != NULL && strcmp(controller, "random") == 0)
    json_object_set_new(request, "controller", json_null());
  if (status == STATUS_OK && option_is_set(ctl, "no-exclusions"))
    json_object_set_new(request, "exclude_pretraining", json_false());
  return status;
}

int run_campaign_start(struct ctl *ctl)
{
  json_t *request = json_pack("{s:s}", "mode", ctl->operands[0]), *campaign = NULL;
  int status = request != NULL ? fill_request(ctl, request)
                               : complain(STATUS_USAGE, "the mode is not UTF-8");
  if (status == STATUS_OK)
    status = post_job(ctl, "/v1/campaigns", request, 0, &campaign);
  json_decref(request);
  bool watch = option_is_set(ctl, "watch");
  if (status == STATUS_OK && ctl->json && !watch) {
    print_json(campaign);
  } else if (status == STATUS_OK) {
    const json_t *settings = json_object_get(campaign, "settings"),
                 *group = json_object_get(campaign, "group");
    int64_t replicates = number_of(group, "replicates"),
            first = strtoll(text_of(campaign, "id"), NULL, 10);
    char id[24], population[32], generations[32];
    snprintf(id, sizeof(id), "%" PRId64, first);
    for (int64_t i = 0; i < replicates && !watch; i++)
      printf("%" PRId64 "\n", first + i);
    if (!ctl->quiet && !ctl->json)
      print_plain_line(stderr, "campaign %s is accepted: %s, %s designs, %s generations%s%s%s", id,
                       text_of(campaign, "mode"),
                       count_text(number_of(settings, "population"), population),
                       count_text(number_of(settings, "generations"), generations),
                       replicates > 1 ? ", with its replicates" : "",
                       watch ? "" : "; morphoctl campaign watch ", watch ? "" : id);
    if (watch)
      status = watch_started(ctl, id, watch_campaign);
  }
  json_decref(campaign);
  return status;
}

/* ---- list, show ---- */

static void add_campaign(struct table *table, const json_t *item)
{
  const json_t *progress = json_object_get(item, "progress"),
               *newest = json_object_get(item, "newest");
  const json_t *score = json_object_get(newest, "score"),
               *settings = json_object_get(item, "settings");
  char designs[32], generation[32], generations[32], mean[32], best[32], diversity[32], time[32];
  const char *cells[] = {
      text_of(item, "id"),
      text_of(item, "mode"),
      text_of(item, "state"),
      count_text(number_of(settings, "population"), designs),
      json_is_object(newest) ? count_text(number_of(newest, "generation"), generation) : NULL,
      count_text(number_of(progress, "generations"), generations),
      score_text(json_object_get(score, "mean"), mean),
      score_text(json_object_get(json_object_get(score, "quantiles"), "p0"), best),
      score_text(json_object_get(newest, "diversity"), diversity),
      time_text(json_object_get(item, "created_at"), time),
      text_of(item, "label")};
  table_add(table, cells);
}

int run_campaign_list(struct ctl *ctl)
{
  json_t *items = NULL;
  int status = collect_states(ctl, "/v1/campaigns", &items);
  return print_list(
      ctl, status, items,
      ">campaign|mode|state|>designs|>generation|>of|>mean|>best|>diversity|created|label",
      add_campaign);
}

static void print_campaign(const struct ctl *ctl, const json_t *campaign)
{
  char a[32], b[32], text[256];
  const json_t *settings = json_object_get(campaign, "settings"),
               *group = json_object_get(campaign, "group");
  const json_t *mutation = json_object_get(settings, "mutation"),
               *learning = json_object_get(settings, "learning");
  const json_t *progress = json_object_get(campaign, "progress");
  const json_t *result = json_object_get(json_object_get(campaign, "result"), "controller");
  print_fact(ctl, "campaign", "%s (%s%s%s)", text_of(campaign, "id"), text_of(campaign, "mode"),
             *text_of(campaign, "preset") != 0 ? ", " : "", text_of(campaign, "preset"));
  print_job_state(ctl, campaign, "");
  print_controller_fact(ctl, "controller", json_object_get(campaign, "controller"),
                        text_of(learning, "sensor"));
  print_fact(ctl, "population", "%s designs, seed %" PRId64,
             count_text(number_of(settings, "population"), a), number_of(settings, "seed"));
  if (number_of(group, "replicates") > 1)
    print_fact(ctl, "replicate", "%" PRId64 " of %" PRId64 " of campaign %s",
               number_of(group, "replicate") + 1, number_of(group, "replicates"),
               text_of(group, "id"));
  print_fact(ctl, "mutation", "%s of the population, rate %s, growth %s",
             share_text(json_object_get(mutation, "share"), text),
             real_text(json_object_get(mutation, "rate"), a),
             real_text(json_object_get(mutation, "growth"), b));
  print_fact(ctl, "selection", "%s", text_of(json_object_get(settings, "selection"), "kind"));
  if (json_is_object(learning))
    print_fact(ctl, "learning",
               "%" PRId64 " + %" PRId64 " steps a generation, %s from %s down to %s",
               number_of(learning, "parent_steps"), number_of(learning, "child_steps"),
               text_of(json_object_get(learning, "schedule"), "kind"),
               real_text(json_object_get(json_object_get(learning, "schedule"), "peak"), a),
               real_text(json_object_get(json_object_get(learning, "schedule"), "floor"), b));
  campaign_generation_text(json_is_integer(json_object_get(progress, "generation"))
                               ? number_of(progress, "generation")
                               : -1,
                           number_of(progress, "generations"), text, sizeof(text));
  print_fact(ctl, "progress", "%s, %s designs born", text,
             count_text(number_of(progress, "designs"), a));
  campaign_progress_text(campaign, text, sizeof(text));
  if (*text != 0)
    print_fact(ctl, "now", "%s", text);
  if (*text_of(campaign, "end") != 0)
    print_fact(ctl, "end", "%s", text_of(campaign, "end"));
  if (json_is_object(result))
    print_controller_fact(ctl, "result", result, "");
  print_job_times(ctl, campaign);
}

static void print_line(void *context, const char *text)
{
  (void)context;
  print_plain_line(stdout, "%s", text);
}

int run_campaign_show(struct ctl *ctl)
{
  struct campaign campaign = {.json = NULL};
  const char *id = ctl->operands[0];
  char path[64];
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(campaign.id, sizeof(campaign.id), "%s", id);
  snprintf(path, sizeof(path), "/v1/campaigns/%s", id);
  if (ctl->json)
    return show_json(ctl, path);
  int status = campaign_load(ctl, &campaign);
  if (status == STATUS_OK) {
    print_campaign(ctl, campaign.json);
    if (campaign.n > 0) {
      putchar('\n');
      campaign_draw(ctl, &campaign, 92, 10, print_line, NULL);
    }
  }
  campaign_free(&campaign);
  return status;
}

/* ---- extend ---- */

int run_campaign_extend(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *more = ctl->operands[1];
  char path[64], *end;
  long long generations = strtoll(more, &end, 10);
  if (!check_job_id(id))
    return STATUS_USAGE;
  if (*more == 0 || *end != 0 || generations < 1 || generations > 1000000)
    return complain(STATUS_USAGE, "\"%s\" is not a number of further generations", more);
  snprintf(path, sizeof(path), "/v1/campaigns/%s/extend", id);
  json_t *request = json_pack("{sI}", "generations", (json_int_t)generations), *campaign = NULL;
  int status = request != NULL ? post_job(ctl, path, request, 0, &campaign)
                               : complain(STATUS_ERROR, "out of memory");
  if (campaign != NULL && ctl->json)
    print_json(campaign);
  else if (campaign != NULL && !ctl->quiet)
    print_plain_line(stdout, "campaign %s is %s, to generation %" PRId64, id,
                     text_of(campaign, "state"),
                     number_of(json_object_get(campaign, "progress"), "generations"));
  json_decref(request);
  json_decref(campaign);
  return status;
}

int run_campaign_prune(struct ctl *ctl)
{
  return prune_checkpoints(ctl, "campaign", "");
}
