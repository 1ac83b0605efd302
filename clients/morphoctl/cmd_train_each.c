/* cmd_train_each.c: train each: the designs of a training run that finetuned each one
 * separately. */
#include "commands.h"

static void print_summary(const struct ctl *ctl, const json_t *summary)
{
  static const struct fact facts[] = {
      {"designs", "{bodies_done:,} of {bodies:,}[, {compared:,} with both scores]"},
      {"before", "[mean score {mean_zero_shot:.4f}]"},
      {"after", "[mean score {mean_finetuned:.4f}; {improved:,} design{improved:s} improved]"},
      {"gain", "[{mean_gain:.4f}[, 95 % interval {mean_gain_interval.0:.4f} to "
               "{mean_gain_interval.1:.4f}]]"},
      {"tau", "[{tau:.2f}[, 95 % interval {tau_interval.0:.2f} to {tau_interval.1:.2f}]]"},
      {NULL, NULL}};
  print_facts(ctl, summary, facts);
}

void run_train_each(struct ctl *ctl)
{
  const char *path = path_to("/v1/trainings/%s/each", job_id(ctl->operands[0]));
  if (ctl->json && option_is_set(ctl, "csv"))
    fail(STATUS_USAGE, "give --json or --csv, not both");
  if (option_is_set(ctl, "csv")) {
    save_reply(ctl, path, "text/csv", "-");
    return;
  }
  json_t *summary = json_object_get(get_json(ctl, "%s?limit=1", path), "summary");
  json_t *items = collect(ctl, path, 0);
  if (ctl->json) {
    print_json(keep(json_pack("{s:O, s:O}", "items", items, "summary", summary)));
    return;
  }
  print_summary(ctl, summary);
  putchar('\n');
  print_table(stdout, ctl, items,
              ">position={position}|>place=[{place:,}]|design={robot}|>before={zero_shot:.4f}|>"
              "after={finetuned:.4f}"
              "|>gain={gain:.4f}|>last loss={last_loss:.4f}|controller=[{controller.name}]");
}
