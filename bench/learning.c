/* learning.c: trainings from random weights, step by step, and what their losses were;
 * `morpho-bench learning`.
 *
 * Every combination of sensor, schedule, clipping and seed asked for is one training;
 * inverse_square has one recipe more. They run one after the other: the first recipe with all its
 * seeds, then all others with the first seed, and so on. Each step is a row of the CSV file; every
 * ten steps a checkpoint is written beside it. So the program may be stopped at any time: it goes
 * on where it was, and gives the same numbers. */
#include "learning.h"

#include <errno.h>
#include <getopt.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum {
  SEEDS_MAX = 16,
  GROUPS_MAX = 2 * 2 * 2 + 1,
  RUNS_MAX = GROUPS_MAX * SEEDS_MAX,
  SAVE_EVERY = 10,
  DRAW_THREADS = 8
};

/* What inverse_square learns fastest by. */
#define TIGHT_PEAK         3e-3
#define TIGHT_WARMUP_STEPS 5
#define TIGHT_BOUND        0.2
#define TIGHT_BETA1        0.8

static const char usage[] =
    "Usage: morpho-bench learning [OPTION…]\n"
    "\n"
    "  --sensor inverse_sqrt|inverse_square|both   (default both)\n"
    "  --schedule cosine|restarts|both             one cosine, or the paper's restarts (default "
    "both)\n"
    "  --clip on|off|both                          bound of the adjoint (default both)\n"
    "  --seeds 1,2,3      (the default)\n"
    "  --batch N          robots of a step (default 256)\n"
    "  --steps N          of a training (default 100)\n"
    "  --peak X           highest rate (default: 2e-3 for one cosine, 1e-3 for the restarts)\n"
    "  --warmup N         steps of warm-up of the cosine (default 10)\n"
    "  --bound X          of the adjoint with --clip on (default 2)\n"
    "  --rule clip|restart  above the bound with --clip on (default clip)\n"
    "  --restart-weight X  of what a restarted adjoint begins with, with --rule restart (default "
    "3)\n"
    "  --norm-limit X     of the batch gradient (default 1; 0: none)\n"
    "  --beta1 X, --beta2 X  of Adam (default 0.9, 0.999)\n"
    "                     With none of these eight, inverse_square with one cosine and clipping is "
    "trained twice:\n"
    "                     once more with --peak 3e-3 --warmup 5 --bound 0.2 --beta1 0.8.\n"
    "  --workers N        threads (default: one per processor)\n"
    "  --module PATH      gradients on GPUs, by this morphod-cuda.so: other bits, so give it a CSV "
    "file of its own\n"
    "  --isa NAME         x86-64, avx2 or avx512 (default: the best that runs here)\n"
    "  --csv PATH         rows of the steps, read at the start and appended to (default "
    "learning.csv)\n"
    "  --folder PATH      for checkpoints (default: where the CSV file is)\n"
    "  --svg PATH         draw the losses\n"
    "  --report           run nothing: only the table and the drawing of what the CSV file holds\n"
    "\n"
    "  --finetune         instead: finetune a controller on random bodies; held-out score before "
    "and after; by the\n"
    "                     paper's schedule with --schedule restarts\n"
    "  --controller PATH  to finetune (default data/controllers/bootstrap.safetensors)\n"
    "  --designs N        random bodies to finetune on (default 64)\n"
    "  --environments N   held-out environments to score them in (default 64)\n";

static const char columns[] = "sensor,schedule,peak,warmup_steps,adjoint_bound,adjoint_rule,norm_"
                              "limit,beta1,beta2,batch,steps,seed,step,"
                              "mean_loss,gradient_norm,rate,clipped_share,clipped_robots_share,"
                              "diverged,zeroed,skipped,seconds\n";

struct plan {
  bool sensors[2], schedules[2], clips[2]; /* schedules: cosine, restarts; clips: on, off */
  uint64_t seeds[SEEDS_MAX];
  size_t n_seeds;
  uint32_t batch, steps, warmup, designs, environments;
  double peak, bound; /* peak 0: the schedule's own */
  enum mo_adjoint_rule rule;
  double restart_weight;
  double norm_limit, beta1, beta2;
  bool own_recipe; /* one of them, the rule or warmup was given */
  bool report, finetune;
  const char *folder;
};

/* ---- one step ---- */

void learning_machine_create(struct learning_machine *machine, const struct bench_options *options,
                             uint32_t batch)
{
  struct mo_controller *controller = NULL;
  machine->compute = bench_compute(options->workers, options->isa);
  machine->back_end = MO_ON_CPU;
  if (options->module != NULL) {
    const struct mo_devices_config devices = {.module = options->module};
    struct mo_message message = {""};
    if (mo_compute_add_devices(machine->compute, &devices, &message) != MO_OK) {
      fprintf(stderr, "morpho-bench: %s\n", message.text);
      exit(1);
    }
    machine->back_end = MO_ON_DEVICE;
  }
  bench_check(mo_gradient_state_create(machine->compute, &machine->gradients), "gradients");
  bench_check(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller),
              "controller");
  machine->d_parameters = bench_zeros(controller->n_parameters, sizeof(double));
  machine->outcomes = bench_zeros(batch, sizeof(struct mo_outcome));
  mo_controller_free(controller);
}

void learning_machine_free(struct learning_machine *machine)
{
  mo_gradient_state_free(machine->gradients);
  mo_compute_free(machine->compute);
  free(machine->d_parameters);
  free(machine->outcomes);
}

struct mo_training_report learning_step(struct learning_machine *machine,
                                        struct mo_training *training)
{
  const struct mo_training_settings *settings = mo_training_settings_of(training);
  struct mo_gradient_batch batch = {.controller = mo_training_controller(training),
                                    .n = settings->batch,
                                    .physics = settings->physics,
                                    .adjoint_bound = settings->learning.adjoint_bound,
                                    .adjoint_rule = settings->learning.adjoint_rule,
                                    .restart_weight = settings->learning.restart_weight,
                                    .back_end = machine->back_end,
                                    .d_parameters = machine->d_parameters,
                                    .outcomes = machine->outcomes};
  struct mo_training_report report;
  bench_check(mo_training_draw(training, NULL, NULL, &batch.robots), "draw");
  bench_check(mo_compute_gradient(machine->gradients, &batch), "gradient");
  bench_check(
      mo_training_apply(training, batch.d_parameters, batch.outcomes, &batch.counts, &report),
      "step");
  return report;
}

/* ---- the CSV file ---- */

static void read_rows(const char *path, struct learning_run *runs, size_t n_runs)
{
  FILE *file = fopen(path, "r");
  char line[512];
  while (file != NULL && fgets(line, sizeof(line), file) != NULL)
    for (size_t r = 0; r < n_runs; r++) {
      const size_t length = strlen(runs[r].key);
      if (strncmp(line, runs[r].key, length) != 0 || line[length] != ',' ||
          strchr(line, '\n') == NULL)
        continue;
      char *at = line + length + 1;
      const unsigned long step = strtoul(at, &at, 10);
      const char *last = strrchr(line, ',');
      if (step < 1 || step > runs[r].settings.n_steps || *at != ',')
        continue;
      runs[r].loss[step] = strtod(at + 1, NULL);
      runs[r].seconds[step] = strtod(last + 1, NULL);
      if (step == runs[r].known + 1)
        runs[r].known++;
    }
  if (file != NULL)
    fclose(file);
}

/* Opens it to append, if its columns are these; a row that was cut short by a crash is ended first.
 */
static FILE *open_rows(const char *path)
{
  FILE *file = fopen(path, "a+");
  if (file == NULL) {
    fprintf(stderr, "morpho-bench: %s: %s\n", path, strerror(errno));
    exit(1);
  }
  fseek(file, 0, SEEK_END);
  if (ftell(file) == 0) {
    fputs(columns, file);
  } else {
    char line[sizeof(columns)];
    rewind(file);
    if (fgets(line, sizeof(line), file) == NULL || strcmp(line, columns) != 0) {
      fprintf(stderr, "morpho-bench: %s has other columns; name another file\n", path);
      exit(1);
    }
    fseek(file, -1, SEEK_END);
    const int last = fgetc(file);
    fseek(file, 0, SEEK_END);
    if (last != '\n')
      fputc('\n', file);
  }
  return file;
}

static void write_row(FILE *file, const struct learning_run *run,
                      const struct mo_training_report *report, double seconds)
{
  fprintf(file, "%s,%u,%.6g,%.6g,%.6g,%.6g,%.6g,%u,%u,%d,%.3f\n", run->key, report->step,
          report->mean_loss, report->gradient_norm, report->rate, report->clipped_share,
          report->clipped_robots_share, report->diverged, report->zeroed, report->skipped, seconds);
  fflush(file);
}

/* ---- runs ---- */

static struct mo_training *open_training(const struct learning_run *run, const char *path)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  FILE *file = fopen(path, "rb");
  uint8_t *bytes = malloc(MO_CHECKPOINT_BYTES_MAX);
  int error = bytes == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (error == MO_OK && file != NULL)
    error = mo_training_decode(bytes, fread(bytes, 1, MO_CHECKPOINT_BYTES_MAX, file), &training,
                               &message);
  else if (error == MO_OK)
    error = mo_training_create(&run->settings, NULL, NULL, 0, &training, &message);
  if (error != MO_OK) {
    fprintf(stderr, "morpho-bench: %s: %s\n", path, message.text);
    exit(1);
  }
  if (file != NULL)
    fclose(file);
  free(bytes);
  return training;
}

/* Saves a checkpoint in one step: a file that was being written when the program ended is not
 * read. */
static void save_training(const struct mo_training *training, const char *path)
{
  char temporary[1040];
  uint8_t *bytes = NULL;
  size_t size = 0;
  bench_check(mo_training_encode(training, &bytes, &size), "a checkpoint");
  snprintf(temporary, sizeof(temporary), "%s.tmp", path);
  FILE *file = fopen(temporary, "wb");
  if (file == NULL || fwrite(bytes, 1, size, file) != size || fclose(file) != 0 ||
      rename(temporary, path) != 0) {
    perror(temporary);
    exit(1);
  }
  free(bytes);
}

static void run_one(struct learning_machine *machine, struct learning_run *run, const char *folder,
                    FILE *rows)
{
  char path[1024], name[LEARNING_KEY_BYTES];
  if (run->known == run->settings.n_steps)
    return;
  snprintf(name, sizeof(name), "%s", run->key);
  for (char *c = name; *c != '\0'; c++)
    if (*c == ',')
      *c = '_';
  snprintf(path, sizeof(path), "%s/%s.checkpoint", folder, name);
  struct mo_training *training = open_training(run, path);
  const uint32_t n_steps = run->settings.n_steps;
  if (machine->back_end == MO_ON_DEVICE) /* else drawing is a small part of a step */
    mo_training_set_threads(training, DRAW_THREADS);
  printf("%s: from step %u\n", run->key, mo_training_step(training));
  while (mo_training_step(training) < n_steps) {
    const double start = bench_now_s();
    const struct mo_training_report report = learning_step(machine, training);
    const double seconds = bench_now_s() - start;
    if (report.step > run->known) {
      write_row(rows, run, &report, seconds);
      run->known = report.step;
      run->loss[report.step] = report.mean_loss;
      run->seconds[report.step] = seconds;
    }
    if (report.step % SAVE_EVERY == 0 || report.step == n_steps) {
      printf("  step %4u  loss %.4f  norm %8.3f  rate %.2e  clipped %.1f %% of robots  diverged %u "
             " zeroed %u  %.1f bodies/s\n",
             report.step, report.mean_loss, report.gradient_norm, report.rate,
             100.0 * report.clipped_robots_share, report.diverged, report.zeroed,
             run->settings.batch / seconds);
      if (report.step < n_steps)
        save_training(training, path);
    }
  }
  unlink(path); /* all its rows are there */
  mo_training_free(training);
}

static struct learning_run make_run(const struct plan *plan, int sensor, int restarts, int off,
                                    uint64_t seed)
{
  struct learning_run run = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN)};
  struct mo_training_settings *s = &run.settings;
  char rule[40] = "clip";
  s->sensor = (enum mo_sensor)sensor;
  s->seed = seed;
  s->batch = plan->batch;
  s->n_steps = plan->steps;
  s->learning.schedule = restarts ? mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN]
                                  : mo_schedule_presets[MO_SCHEDULE_ONE_COSINE];
  if (!restarts)
    s->learning.schedule.warmup_steps = plan->warmup;
  if (plan->peak > 0.0)
    s->learning.schedule.peak = plan->peak;
  s->learning.adjoint_bound = off ? 0.0 : plan->bound;
  s->learning.adjoint_rule = off ? MO_ADJOINT_CLIP : plan->rule;
  s->learning.restart_weight = plan->restart_weight;
  s->learning.norm_limit = plan->norm_limit;
  s->learning.beta1 = plan->beta1;
  s->learning.beta2 = plan->beta2;
  if (s->learning.adjoint_rule == MO_ADJOINT_RESTART)
    snprintf(rule, sizeof(rule), "restart %g", s->learning.restart_weight);
  snprintf(run.key, sizeof(run.key), "%s,%s,%g,%u,%g,%s,%g,%g,%g,%u,%u,%llu",
           mo_sensor_name(s->sensor), mo_schedule_words[s->learning.schedule.kind],
           s->learning.schedule.peak, s->learning.schedule.warmup_steps, s->learning.adjoint_bound,
           rule, s->learning.norm_limit, s->learning.beta1, s->learning.beta2, s->batch, s->n_steps,
           (unsigned long long)seed);
  struct mo_message message = {""};
  if (mo_training_settings_check(s, &message) != MO_OK) {
    fprintf(stderr, "morpho-bench: %s\n", message.text);
    exit(2);
  }
  run.loss = bench_zeros(s->n_steps + (size_t)1, sizeof(double));
  run.seconds = bench_zeros(s->n_steps + (size_t)1, sizeof(double));
  for (uint32_t i = 0; i <= s->n_steps; i++)
    run.loss[i] = NAN;
  return run;
}

static struct curves_group *make_group(const struct plan *plan, int sensor, int restarts, int off,
                                       struct learning_run *runs, struct curves_group *group)
{
  *group = (struct curves_group){.runs = runs, .n_runs = plan->n_seeds};
  for (size_t s = 0; s < plan->n_seeds; s++)
    runs[s] = make_run(plan, sensor, restarts, off, plan->seeds[s]);
  return group;
}

/* Recipe by recipe, each with all its seeds. */
static size_t make_runs(const struct plan *plan, struct learning_run runs[RUNS_MAX],
                        struct curves_group groups[GROUPS_MAX])
{
  size_t n_groups = 0;
  for (int sensor = 0; sensor < 2; sensor++)
    for (int off = 0; off < 2; off++)
      for (int restarts = 0; restarts < 2; restarts++) {
        if (!plan->sensors[sensor] || !plan->clips[off] || !plan->schedules[restarts])
          continue;
        struct curves_group *group = make_group(plan, sensor, restarts, off,
                                                runs + n_groups * plan->n_seeds, &groups[n_groups]);
        snprintf(group->name, sizeof(group->name), "%s, adjoint %s",
                 restarts ? "the paper's restarts" : "one cosine",
                 off                                ? "not clipped"
                 : plan->rule == MO_ADJOINT_RESTART ? "restarted"
                                                    : "clipped");
        n_groups++;
      }
  if (plan->sensors[MO_SENSOR_INVERSE_SQUARE] && plan->schedules[0] && plan->clips[0] &&
      !plan->own_recipe) {
    struct plan tight = *plan;
    tight.peak = TIGHT_PEAK;
    tight.warmup = TIGHT_WARMUP_STEPS;
    tight.bound = TIGHT_BOUND;
    tight.beta1 = TIGHT_BETA1;
    struct curves_group *group = make_group(&tight, MO_SENSOR_INVERSE_SQUARE, 0, 0,
                                            runs + n_groups * plan->n_seeds, &groups[n_groups]);
    snprintf(group->name, sizeof(group->name), "one cosine, peak %g, beta1 %g, clipped at %g",
             TIGHT_PEAK, TIGHT_BETA1, TIGHT_BOUND);
    n_groups++;
  }
  return n_groups;
}

/* ---- what came of it ---- */

/* The mean over the seeds whose training has come so far, and each of them. */
static void cell(const struct curves_group *group, uint32_t step)
{
  double sum = 0.0;
  int n = 0;
  char each[256] = "";
  for (size_t s = 0; s < group->n_runs; s++) {
    const double loss = group->runs[s].loss[step];
    if (isnan(loss))
      continue;
    sum += loss;
    snprintf(each + strlen(each), sizeof(each) - strlen(each), "%s%.3f", n++ > 0 ? ", " : "", loss);
  }
  if (n > 0)
    printf(" **%.3f** (%s) |", sum / n, each);
  else
    printf(" – |");
}

static void print_table(const struct plan *plan, const struct curves_group *groups, size_t n_groups)
{
  const uint32_t marks[3] = {plan->steps / 10 > 0 ? plan->steps / 10 : 1, (plan->steps + 1) / 2,
                             plan->steps};
  printf("\n| sensor | recipe | step %u | step %u | step %u | bodies/s |\n| --- | --- | --- | --- "
         "| --- | --- |\n",
         marks[0], marks[1], marks[2]);
  for (size_t g = 0; g < n_groups; g++) {
    double seconds = 0.0, bodies = 0.0;
    for (size_t s = 0; s < groups[g].n_runs; s++)
      for (uint32_t i = 1; i <= groups[g].runs[s].known; i++) {
        seconds += groups[g].runs[s].seconds[i];
        bodies += groups[g].runs[s].settings.batch;
      }
    printf("| %s | %s |", mo_sensor_name(groups[g].runs[0].settings.sensor), groups[g].name);
    for (int m = 0; m < 3; m++)
      cell(&groups[g], marks[m]);
    printf(" %.0f |\n", seconds > 0.0 ? bodies / seconds : 0.0);
  }
}

static void draw(const char *path, const struct plan *plan, const struct curves_group *groups,
                 size_t n_groups)
{
  struct curves_panel panels[2] = {0};
  size_t n_panels = 0;
  for (size_t g = 0; g < n_groups; g++) {
    const char *sensor = mo_sensor_name(groups[g].runs[0].settings.sensor);
    if (groups[g].runs[0].known == 0)
      continue; /* not begun */
    if (n_panels == 0 || strcmp(panels[n_panels - 1].title, sensor) != 0)
      panels[n_panels++] = (struct curves_panel){.title = sensor};
    struct curves_panel *panel = &panels[n_panels - 1];
    panel->groups[panel->n_groups++] = &groups[g];
  }
  if (bench_draw_curves(path, plan->steps, panels, n_panels) < 0) {
    fprintf(stderr, "morpho-bench: %s: %s\n", path, strerror(errno));
    exit(1);
  }
}

/* ---- options ---- */

static void wrong(const char *option, const char *text)
{
  fprintf(stderr, "morpho-bench: --%s \"%s\" is not understood\n%s", option, text, usage);
  exit(2);
}

static uint64_t whole(const char *option, const char *text, uint64_t most)
{
  char *end = NULL;
  errno = 0;
  const unsigned long long value = strtoull(text, &end, 10);
  if (errno != 0 || end == text || *end != '\0' || text[0] == '-' || value > most)
    wrong(option, text);
  return value;
}

static double real(const char *option, const char *text)
{
  char *end = NULL;
  const double value = strtod(text, &end);
  if (end == text || *end != '\0' || !isfinite(value) || value < 0.0)
    wrong(option, text);
  return value;
}

static void choose(const char *option, const char *text, const char *const *words, bool chosen[2])
{
  for (int i = 0; i < 2; i++)
    chosen[i] = strcmp(text, words[i]) == 0 || strcmp(text, "both") == 0;
  if (!chosen[0] && !chosen[1])
    wrong(option, text);
}

static void read_seeds(char *text, struct plan *plan)
{
  plan->n_seeds = 0;
  for (char *part = strtok(text, ","); part != NULL; part = strtok(NULL, ",")) {
    if (plan->n_seeds == SEEDS_MAX)
      wrong("seeds", part);
    plan->seeds[plan->n_seeds++] = whole("seeds", part, UINT64_MAX);
  }
  if (plan->n_seeds == 0)
    wrong("seeds", "");
}

/* What an option's text is, and so what it sets. */
enum kind {
  FLAG,  /* none; bool */
  PAIR,  /* one of two words, or both; bool[2] */
  WHOLE, /* uint32_t */
  REAL,  /* double */
  PATH,  /* const char * */
  SEEDS, /* the plan's seeds */
  RULE,  /* enum mo_adjoint_rule */
  ISA    /* enum mo_isa */
};

struct setting {
  const char *name;
  enum kind kind;
  void *target;
  uint64_t most;        /* WHOLE */
  const char *words[2]; /* PAIR */
  bool own_recipe;
};

static void set(const struct setting *setting, char *text, struct plan *plan)
{
  switch (setting->kind) {
  case FLAG: *(bool *)setting->target = true; break;
  case PAIR: choose(setting->name, text, setting->words, setting->target); break;
  case WHOLE:
    *(uint32_t *)setting->target = (uint32_t)whole(setting->name, text, setting->most);
    break;
  case REAL: *(double *)setting->target = real(setting->name, text); break;
  case PATH: *(const char **)setting->target = text; break;
  case SEEDS: read_seeds(text, plan); break;
  case RULE: plan->rule = (enum mo_adjoint_rule)bench_word(mo_adjoint_words, text); break;
  case ISA: *(enum mo_isa *)setting->target = bench_isa(text); break;
  }
  plan->own_recipe |= setting->own_recipe;
}

static void read_options(int argc, char **argv, struct plan *plan, struct bench_options *options)
{
  const struct setting settings[] = {
      {"sensor", PAIR, plan->sensors, .words = {"inverse_sqrt", "inverse_square"}},
      {"schedule", PAIR, plan->schedules, .words = {"cosine", "restarts"}},
      {"clip", PAIR, plan->clips, .words = {"on", "off"}},
      {"seeds", SEEDS, plan},
      {"batch", WHOLE, &plan->batch, MO_TRAINING_BATCH_MAX},
      {"steps", WHOLE, &plan->steps, MO_TRAINING_STEPS_MAX},
      {"peak", REAL, &plan->peak, .own_recipe = true},
      {"warmup", WHOLE, &plan->warmup, MO_TRAINING_STEPS_MAX, .own_recipe = true},
      {"bound", REAL, &plan->bound, .own_recipe = true},
      {"rule", RULE, &plan->rule, .own_recipe = true},
      {"restart-weight", REAL, &plan->restart_weight, .own_recipe = true},
      {"norm-limit", REAL, &plan->norm_limit, .own_recipe = true},
      {"beta1", REAL, &plan->beta1, .own_recipe = true},
      {"beta2", REAL, &plan->beta2, .own_recipe = true},
      {"workers", WHOLE, &options->workers, 1024},
      {"module", PATH, &options->module},
      {"isa", ISA, &options->isa},
      {"csv", PATH, &options->csv},
      {"folder", PATH, &plan->folder},
      {"svg", PATH, &options->svg},
      {"report", FLAG, &plan->report},
      {"finetune", FLAG, &plan->finetune},
      {"controller", PATH, &options->controller},
      {"designs", WHOLE, &plan->designs, MO_TRAINING_DESIGNS_MAX},
      {"environments", WHOLE, &plan->environments, MO_HELD_OUT_ENVIRONMENTS_MAX},
  };
  enum { N = sizeof(settings) / sizeof(settings[0]), FIRST = 256 };
  struct option long_options[N + 2] = {{0}};
  for (int i = 0; i < N; i++)
    long_options[i] = (struct option){settings[i].name,
                                      settings[i].kind == FLAG ? no_argument : required_argument,
                                      NULL, FIRST + i};
  long_options[N] = (struct option){"help", no_argument, NULL, 'h'};
  int option;
  optind = 0;
  while ((option = getopt_long(argc, argv, "h", long_options, NULL)) != -1) {
    if (option == 'h') {
      fputs(usage, stdout);
      exit(0);
    }
    if (option == '?')
      break;
    set(&settings[option - FIRST], optarg, plan);
  }
  if (option == '?' || optind < argc) {
    fputs(usage, stderr);
    exit(2);
  }
}

static int learn(const struct plan *plan, const struct bench_options *options)
{
  static struct learning_run runs[RUNS_MAX];
  static struct curves_group groups[GROUPS_MAX];
  const size_t n_groups = make_runs(plan, runs, groups), n_runs = n_groups * plan->n_seeds;
  const char *csv = options->csv != NULL ? options->csv : "learning.csv";
  char folder[900] = ".";
  const char *slash = strrchr(csv, '/');
  if (plan->folder != NULL)
    snprintf(folder, sizeof(folder), "%s", plan->folder);
  else if (slash != NULL)
    snprintf(folder, sizeof(folder), "%.*s", (int)(slash - csv + 1), csv);
  read_rows(csv, runs, n_runs);
  if (!plan->report) {
    struct learning_machine machine;
    learning_machine_create(&machine, options, plan->batch);
    printf("%s\n", machine.back_end == MO_ON_DEVICE
                       ? mo_compute_device_gradient_fingerprint(machine.compute)
                       : mo_compute_gradient_fingerprint(machine.compute));
    FILE *rows = open_rows(csv);
    /* The first recipe with all its seeds, then the others with the first seed, the second, … */
    for (size_t seed = 0; seed < plan->n_seeds; seed++)
      run_one(&machine, &runs[seed], folder, rows);
    for (size_t seed = 0; seed < plan->n_seeds; seed++)
      for (size_t g = 1; g < n_groups; g++)
        run_one(&machine, &runs[g * plan->n_seeds + seed], folder, rows);
    fclose(rows);
    learning_machine_free(&machine);
  }
  print_table(plan, groups, n_groups);
  if (options->svg != NULL)
    draw(options->svg, plan, groups, n_groups);
  for (size_t r = 0; r < n_runs; r++) {
    free(runs[r].loss);
    free(runs[r].seconds);
  }
  return EXIT_SUCCESS;
}

int bench_learning(int argc, char **argv)
{
  struct bench_options options = {.isa = mo_isa_best(),
                                  .controller = "data/controllers/bootstrap.safetensors"};
  struct plan plan = {.sensors = {true, true},
                      .schedules = {true, true},
                      .clips = {true, true},
                      .seeds = {1, 2, 3},
                      .n_seeds = 3,
                      .steps = 0,
                      .batch = 256,
                      .warmup = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE].warmup_steps,
                      .bound = MO_ADJOINT_BOUND,
                      .rule = MO_ADJOINT_CLIP,
                      .restart_weight = MO_RESTART_WEIGHT,
                      .norm_limit = mo_training_defaults(MO_TRAINING_PRETRAIN).learning.norm_limit,
                      .beta1 = mo_training_defaults(MO_TRAINING_PRETRAIN).learning.beta1,
                      .beta2 = mo_training_defaults(MO_TRAINING_PRETRAIN).learning.beta2,
                      .designs = 64,
                      .environments = 64};
  read_options(argc, argv, &plan, &options);
  setvbuf(stdout, NULL, _IOLBF, 0);
  if (!plan.finetune) {
    plan.steps = plan.steps > 0 ? plan.steps : 100;
    return learn(&plan, &options);
  }
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_FINETUNE);
  settings.seed = plan.seeds[0];
  settings.batch = plan.batch;
  settings.n_steps = plan.steps > 0 ? plan.steps : settings.n_steps;
  settings.learning.adjoint_bound = plan.clips[0] ? plan.bound : 0.0;
  settings.learning.adjoint_rule = plan.clips[0] ? plan.rule : MO_ADJOINT_CLIP;
  settings.learning.restart_weight = plan.restart_weight;
  if (!plan.schedules[0])
    settings.learning.schedule = mo_schedule_presets[MO_SCHEDULE_PAPER_FINETUNE];
  if (plan.peak > 0.0)
    settings.learning.schedule.peak = plan.peak;
  return bench_finetune(&options, &settings, plan.designs, plan.environments);
}
