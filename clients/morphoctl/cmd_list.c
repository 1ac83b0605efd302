/* cmd_list.c: campaign, certificate, controller, design, job and train list: one row per item. */
#include <string.h>

#include "commands.h"

#define STATE "state={state}[ ({warnings.0.code})]"
#define SIZES "|>voxels={voxels}|>masses={masses}|>springs={springs}"

static const struct list {
  const char *command, *path;
  int64_t limit;       /* without --limit and --all; 0 = all */
  const char *columns; /* in the format of print_items */
  const char *ranked;  /* with --sort score; NULL = the same */
} lists[] = {
    {"campaign list", "/v1/campaigns", 50,
     ">campaign={id}|mode={mode}|" STATE "|>designs={settings.population:,}"
     "|>generation=[{newest.generation:,}|–]|>of={progress.generations:,}"
     "|>mean={newest.score.mean:.4f}|>best={newest.score.quantiles.p0:.4f}"
     "|>diversity={newest.diversity:.4f}|created={created_at:time}|label={label}"},
    {"certificate list", "/v1/certificates", 50,
     ">certificate={id}|" STATE "|>designs={certificate.designs}"
     "|environments=[{certificate.environments}|{certificate.environments.count}]"
     "|>trials={certificate.trials_done}|>of={certificate.trials}"
     "|>rollouts={certificate.rollouts:,}|created={created_at:time}|label={label}"},
    {"controller list", "/v1/controllers", 0,
     "name={name}|sensor={sensor}|>parameters={parameters:,}|>bytes={bytes:,}"
     "|stored={stored_at:time}|sha256={sha256}"},
    {"design list", "/v1/designs", 100, "design={id}" SIZES "|first seen={first_seen_at:time}",
     "design={robot}" SIZES "|>score={score:.4f}|first seen={first_seen_at:time}"},
    {"job list", "/v1/jobs", 50,
     ">job={id}|kind=[{training.kind}|{campaign.mode}|{kind}]|" STATE
     "|priority={priority}|>designs=[{campaign.population:,}|{n_designs:,}|{atlas.bodies_total:,}"
     "|{certificate.designs:,}]"
     "|>work=[{training.steps:,} step{training.steps:s}"
     "|{campaign.generations:,} generation{campaign.generations:s}"
     "|{rollouts_total:,} rollout{rollouts_total:s}"
     "|{certificate.rollouts:,} rollout{certificate.rollouts:s}|{atlas.voxels} "
     "voxel{atlas.voxels:s}]"
     "|>done=[{training.step/training.steps:%}"
     "|{campaign.generation/campaign.generations:%}"
     "|{rollouts_done/rollouts_total:%}|{certificate.rollouts_done/certificate.rollouts:%}"
     "|{atlas.bodies_done/atlas.bodies_total:%}|0 %]"
     "|>core time={core_seconds:duration}|created={created_at:time}|label={label}"
     "|experiment={experiment}"},
    {"train list", "/v1/trainings", 50,
     ">training={id}|kind={kind}|name={name}|" STATE "|>step={progress.step:,}"
     "|>of={progress.steps:,}|>loss={progress.mean_loss:.4f}"
     "|>validation={validation.mean_score:.4f}|created={created_at:time}|label={label}"},
};

/* The options filter and sort it. */
void run_list(struct ctl *ctl)
{
  static const char *const orders[] = {"id", "score", NULL};
  static const char *const states[] = {"queued", "running",   "paused", "succeeded",
                                       "failed", "cancelled", NULL};
  static const char *const filters[] = {
      "state", "label", "search",     "submitted-by", "experiment", "archived", "group",
      "sort",  "order", "controller", "environments", "physics",    NULL};
  static const char *const physics[] = {"default", "paper", NULL};
  const struct list *list = lists;
  while (strcmp(list->command, ctl->command->name) != 0)
    list++;
  const bool is_ranked =
      list->ranked != NULL && strcmp(option_word(ctl, "sort", orders, "id"), "score") == 0;
  const char *group = option_text(ctl, "group", NULL);
  const int64_t limit = option_number(ctl, "limit", 1, 1000000, list->limit);
  option_word(ctl, "state", states, NULL);
  option_word(ctl, "physics", physics, NULL);
  if (group != NULL)
    job_id(group);
  json_t *items = collect(ctl, path_with(ctl, list->path, filters),
                          option_is_set(ctl, "all") ? 0 : (size_t)limit);
  print_items(ctl, keep(json_pack("{s:O, s:n}", "items", items, "next_cursor")),
              is_ranked ? list->ranked : list->columns);
}
