/* training.c: train show and watch: a training run with its curves.
 *
 * On a terminal, train watch draws a plot of the loss and the numbers of the newest step; elsewhere
 * it prints a line per event. */
#include <inttypes.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "live.h"
#include "plot.h"

#define ASK_S         10   /* waiting produces no events */
#define LINES_BESIDES 6    /* lines of the view in addition to the plot */
#define POINTS_MAX    4000 /* above this many, every other point is dropped */

struct curve {
  const char *key; /* the value to draw */
  struct plot_point *points;
  size_t n, capacity;
};

struct training {
  struct live live;
  struct curve losses, validations;
};

/* ---- curves ---- */

/* Drops every other point, but keeps the newest. */
static void thin(struct curve *curve)
{
  size_t kept = 0;
  for (size_t i = (curve->n + 1) % 2; i < curve->n; i += 2)
    curve->points[kept++] = curve->points[i];
  curve->n = kept;
}

/* Adds a point, and removes earlier points at or beyond its x: after a crash, a run may resume from
 * an earlier step. */
static void add_point(struct curve *curve, double x, double y)
{
  while (curve->n > 0 && curve->points[curve->n - 1].x >= x)
    curve->n--;
  if (curve->n >= POINTS_MAX)
    thin(curve);
  if (curve->n == curve->capacity) {
    curve->capacity = curve->capacity * 2 + 256;
    curve->points = need(realloc(curve->points, curve->capacity * sizeof(*curve->points)));
  }
  curve->points[curve->n++] = (struct plot_point){x, y};
}

static void add_row(void *context, json_t *row)
{
  struct curve *curve = context;
  add_point(curve, (double)number_of(row, "step"), real_at(row, curve->key));
}

static void load_curve(struct live *live, const char *what, int64_t stride, struct curve *curve)
{
  const char *path = path_to("/v1/trainings/%s/%s%s", live->id, what,
                             stride > 0 ? path_to("?stride=%" PRId64, stride) : "");
  walk_items(live->ctl, path, curve->n > 0 ? (int64_t)curve->points[curve->n - 1].x : -1, 0,
             add_row, curve);
}

static void load(struct live *live)
{
  struct training *training = (struct training *)live;
  int64_t step = number_of(json_object_get(live->job, "progress"), "step");
  training->losses.key = "mean_loss";
  training->validations.key = "mean_score";
  load_curve(live, "steps", step / (POINTS_MAX / 2) + 1, &training->losses);
  load_curve(live, "validations", 0, &training->validations);
}

/* Plots both curves (malloc). Returns NULL if there are no values yet. */
static char *draw_plot(const struct training *training, int width, int height)
{
  const struct ctl *ctl = training->live.ctl;
  const struct curve *losses = &training->losses, *validations = &training->validations;
  if (losses->n + validations->n == 0)
    return NULL;
  double end = losses->n > 0 ? losses->points[losses->n - 1].x : 0;
  if (validations->n > 0 && validations->points[validations->n - 1].x > end)
    end = validations->points[validations->n - 1].x;
  struct plot plot = {.curve = losses->points,
                      .n_curve = losses->n,
                      .marks = validations->points,
                      .n_marks = validations->n,
                      .x_end = end,
                      .width = width,
                      .height = height,
                      .utf8 = ctl->utf8,
                      .color = ctl->color};
  return plot_draw(&plot);
}

/* ---- show ---- */

static void print_code(const struct ctl *ctl, const json_t *code)
{
  size_t i;
  const json_t *entry;
  json_array_foreach(code, i, entry)
  {
    print_facts(
        ctl, entry,
        (const struct fact[]){{i == 0 ? "code" : "",
                               i == 0 ? "{fingerprint}" : "{fingerprint} after step {from_step}"},
                              {NULL, NULL}});
  }
}

#define LOST_WORDS                                                                                 \
  "{progress.diverged} robot{progress.diverged:s} diverged, {progress.zeroed} had no finite "      \
  "gradient"

static void print(struct live *live)
{
  static const struct fact facts[] = {
      {"training", "{id} ({kind})"},
      {"name", "{name}"},
      JOB_STATE_FACTS("[{!reason}{phase!=idle}]"),
      {"from", CONTROLLER_WORDS("parent", "|random weights, sensor {settings.sensor}")},
      {"batch", "{settings.batch:,} robot{settings.batch:s}, seed {settings.seed}"},
      {"designs", "[{settings.n_designs:,}[ of evaluation {settings.population.evaluation}"
                  "| of campaign {settings.population.campaign}"
                  "| of the ranking of atlas {settings.population.atlas}, seed "
                  "{settings.population.seed}]]"},
      {"atlas", "[{sample.bodies:,} bodies ranked[, {sample.diverged>0:,} without a score left "
                "out], {sample.orientations}, environments [{sample.environments}|of its own], "
                "sha256 {settings.population.sha256}]"},
      {"each", "[{settings.each=true}learns alone; controllers kept: [the best {settings.best}"
               "|{settings.keep}]; {progress.bodies_done:,} of {progress.bodies:,} done]"},
      {"worlds", "[{settings.environments}|{settings.environments.count} from the request"
                 "|{settings.tasks:#} tasks in random terrains]"},
      {"varies", VARY_WORDS("settings.vary.")},
      {"schedule", "{settings.schedule.kind}, {settings.schedule.peak:.4g} down to "
                   "{settings.schedule.floor:.4g}"},
      {"adam", "{settings.adam.beta1:.4g}, {settings.adam.beta2:.4g}, "
               "{settings.adam.epsilon:.4g}"},
      {"limits", "gradient {settings.gradient_norm_limit:.4g}, adjoint "
                 "{settings.adjoint_bound:.4g} ({settings.adjoint_rule}"
                 "[{settings.adjoint_rule=restart}, weight {settings.restart_weight:.4g}])"},
      {"physics", "{settings.physics.n_steps} steps of {settings.physics.dt_s:.4g} s, integrator "
                  "{settings.physics.integrator}, impact {settings.physics.impact}"
                  "[, outputs held for {settings.physics.control_period_s>0:g} s]"},
      {"validates", "[every {settings.validation.every_steps>0} steps on "
                    "{settings.validation.designs} designs in {settings.validation.environments} "
                    "environments]"},
      {"checkpoints", "[every {settings.checkpoint.every_steps>0} steps"
                      "[ or every {settings.checkpoint.every_s>0} s]"
                      "|every {settings.checkpoint.every_s>0} s|at pauses, stops and the end], "
                      "the newest {settings.checkpoint.keep} kept"},
      {"progress", STEP_WORDS("progress.")},
      {"last step", "[{progress.step>0:-}" NUMBER_WORDS("progress.") PACE_WORDS("progress.") "]"},
      {"", "[{progress.diverged>0:-}" LOST_WORDS "|{progress.zeroed>0:-}" LOST_WORDS "]"},
      {"validation", VALIDATION_WORDS("validation.")},
      {"checkpoint", "[of step {checkpoint_step}]"},
      {NULL, NULL}};
  static const struct fact last[] = {
      {"controller", CONTROLLER_WORDS("controller", "")}, JOB_TIME_FACTS, {NULL, NULL}};
  const struct training *training = (const struct training *)live;
  print_facts(live->ctl, live->job, facts);
  /* Usually one line, or more if different code continued the run. */
  print_code(live->ctl, json_object_get(live->job, "code"));
  print_facts(live->ctl, live->job, last);
  char *plot = draw_plot(training, 78, 14);
  if (plot != NULL)
    printf("\n%s", plot);
  free(plot);
}

/* ---- watch ---- */

static void write_view(const struct live *live, FILE *file, int columns, int rows)
{
  const struct training *training = (const struct training *)live;
  const bool color = live->ctl->color, ended = is_final(text_of(live->job, "state"));
  fputs(color ? "\033[1m" : "", file);
  view_words(file, columns, live->job, "{name}  {kind}  {state}[ ({phase!=idle})]   training {id}");
  fputs(color ? "\033[0m" : "", file);
  int height = rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES;
  char *plot = draw_plot(training, columns > 110 ? 110 : columns - 1, height);
  if (plot != NULL && height >= 4)
    view_lines(file, INT_MAX, plot); /* unpadded, because its colors take bytes */
  free(plot);
  /* The rate is next to the step: with the numbers it does not fit into 80 columns. */
  view_words(file, columns, live->job, NUMBER_WORDS("progress."));
  view_words(file, columns, live->job,
             STEP_WORDS("progress.") "[{phase=replaying}, drawing the bodies of earlier steps "
                                     "again: {progress.replayed/progress.replay_total:%}"
                                     "|" PACE_WORDS(
                                         "progress.") "[  checkpoint of step {checkpoint_step}]]");
  view_words(file, columns, live->job,
             live->ctl->utf8 ? PLOT_MARK_UTF8 " validation " VALIDATION_WORDS("validation.")
                             : PLOT_MARK_ASCII " validation " VALIDATION_WORDS("validation."));
  view_words(file, columns, live->job,
             ended ? "{reason}" : "[{reason}|Ctrl-C leaves; the training continues.]");
}

/* Updates known values from an event: events have only the numbers that changed. */
static void merge(json_t *job, const char *key, json_t *data)
{
  if (!json_is_object(json_object_get(job, key)))
    json_object_set_new(job, key, json_object());
  json_object_update(json_object_get(job, key), data);
}

static bool take_event(struct live *live, const char *type, json_t *event, bool *draw)
{
  struct training *training = (struct training *)live;
  const json_t *at = json_object_get(event, "at");
  json_t *data = json_object_get(event, "data");
  const double step = (double)number_of(data, "step");
  live->event_s = monotonic_s();
  *draw = strcmp(type, "training.progress") != 0;
  if (!*draw) {
    merge(live->job, "progress", data);
    add_point(&training->losses, step, real_at(data, "mean_loss"));
    json_object_set_new(live->job, "phase", json_string("learning"));
    live_words(live, at, live->job,
               STEP_WORDS("progress.") "  " NUMBER_WORDS("progress.") PACE_WORDS("progress."));
  } else if (strcmp(type, "training.validation") == 0) {
    merge(live->job, "validation", data);
    add_point(&training->validations, step, real_at(data, "mean_score"));
    live_words(live, at, live->job, "validation " VALIDATION_WORDS("validation."));
  } else if (strcmp(type, "training.checkpoint") == 0) {
    json_object_set(live->job, "checkpoint_step", json_object_get(data, "step"));
    live_words(live, at, live->job, "checkpoint of step {checkpoint_step}");
  } else if (strncmp(type, "job.", 4) == 0) { /* fetches everything else that changed */
    live_load(live);
    json_object_set(event, "state", json_object_get(live->job, "state"));
    live_words(live, at, event, "{type:.64}  {state}");
  }
  return true;
}

static void report_phase(const struct live *live, const char *before, const char *reason_before)
{
  (void)reason_before;
  if (strcmp(before, text_of(live->job, "phase")) != 0 &&
      strcmp(text_of(live->job, "phase"), "idle") != 0)
    live_words(live, NULL, live->job, "{phase}[: {reason:.300}]");
}

static void begin(struct live *live)
{
  if (live->is_drawn || live->ctl->quiet)
    return;
  print_from(stdout, live->job,
             "training {id} ({kind} {name}) is {state}, " STEP_WORDS("progress."));
  fflush(stdout);
}

static void finish(struct live *live)
{
  if (!live->ctl->quiet && json_is_object(json_object_get(live->job, "controller")))
    print_from(stdout, live->job, "controller {controller.name}: sha256:{controller.sha256}");
  expect_success("training", live->job);
}

const struct live_kind training_kind = {
    .size = sizeof(struct training),
    .noun = "training",
    .command = "train",
    .accepted = "training {id} accepted: {settings.steps:,} step{settings.steps:s} of "
                "{settings.batch:,} robot{settings.batch:s}"
                "[{settings.each=true} for each of {settings.n_designs:,} designs; controllers "
                "kept: [the best {settings.best}|{settings.keep}]]",
    .ask_s = ASK_S,
    .load = load,
    .print = print,
    .write = write_view,
    .begin = begin,
    .event = take_event,
    .changed = report_phase,
    .finish = finish};
