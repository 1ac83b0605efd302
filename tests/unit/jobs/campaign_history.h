/* campaign_history.h: the whole history of a campaign, read from the store, and the same history
 * computed by plain loops over the functions of evolution and learning, without jobs, threads,
 * blocks or store. The two must be equal, bit for bit. */
#ifndef MORPHO_TESTS_JOBS_CAMPAIGN_HISTORY_H
#define MORPHO_TESTS_JOBS_CAMPAIGN_HISTORY_H

#include "../store/fixture.h"

#define HISTORY_DESIGNS     1024
#define HISTORY_GENERATIONS 32
#define HISTORY_POPULATION  24

struct history {
  uint32_t n_designs;
  struct mo_campaign_design designs[HISTORY_DESIGNS];
  uint32_t n_generations;
  struct mo_campaign_generation generations[HISTORY_GENERATIONS];
  struct {
    uint32_t n, numbers[HISTORY_POPULATION];
    double scores[HISTORY_POPULATION];
  } populations[HISTORY_GENERATIONS];
  struct mo_sha256 result; /* of the controller's file; zeros if none */
};

/* How the test computes losses and gradients. */
struct plain {
  double (*loss)(void *context, const struct mo_bits *genotype,
                 const struct mo_controller *controller, const struct mo_environment *environment,
                 const struct mo_physics *physics);
  void (*gradient)(void *context, const struct mo_controller *controller,
                   const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                   double *d_parameters, struct mo_outcome *outcomes,
                   struct mo_gradient_counts *counts);
  void *context;
  const char *code_version;
};

/* What a campaign starts with. */
struct origin {
  struct mo_campaign_settings settings;
  const struct mo_environment *environments;
  uint32_t n_environments;
  const struct mo_controller *controller; /* NULL for random weights */
  const char *digits;                     /* of its file */
  const struct mo_bits *given;            /* (n_given) placed */
  uint32_t n_given;
  const struct mo_form_set *excluded;
};

/* Performs steps of a training. row (nullable): counts them and keeps the first and last loss. */
static inline void plain_steps(const struct plain *plain, struct mo_training *training,
                               uint32_t n_steps, struct mo_campaign_generation *row)
{
  const struct mo_training_settings *settings = mo_training_settings_of(training);
  struct mo_outcome *outcomes = calloc(settings->batch, sizeof(*outcomes));
  double *gradient = calloc(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  for (uint32_t i = 0; i < n_steps; i++) {
    const struct mo_robot *robots = NULL;
    struct mo_gradient_counts counts = {0};
    struct mo_training_report report = {.step = 0};
    CHECK_OK(mo_training_draw(training, NULL, NULL, &robots));
    plain->gradient(plain->context, mo_training_controller(training), robots, settings->batch,
                    &settings->physics, gradient, outcomes, &counts);
    CHECK_OK(mo_training_apply(training, gradient, outcomes, &counts, &report));
    if (row != NULL && row->learning_steps++ == 0)
      row->first_loss = report.mean_loss;
    if (row != NULL)
      row->last_loss = report.mean_loss;
  }
  free(outcomes);
  free(gradient);
}

/* Returns the hash of the file that a training run exports. */
static inline struct mo_sha256 plain_result(const struct mo_training *training, const char *parent,
                                            const char *code_version,
                                            const struct mo_training_lineage *lineage)
{
  struct mo_controller *controller = NULL;
  struct mo_sha256 sha256;
  uint8_t *bytes = NULL;
  size_t size = 0;
  CHECK_OK(mo_training_export(training, parent, code_version, lineage, &controller));
  CHECK_OK(mo_controller_encode(controller, &bytes, &size));
  mo_sha256_of(bytes, size, &sha256);
  free(bytes);
  mo_controller_free(controller);
  return sha256;
}

static inline struct mo_training *plain_training(const struct origin *origin, uint32_t generation,
                                                 const struct mo_bits *designs, uint32_t n)
{
  struct mo_training_settings settings = mo_campaign_training(&origin->settings, generation);
  struct mo_controller *random = NULL;
  struct mo_training *training = NULL;
  if (origin->controller == NULL &&
      mo_controller_create(MO_DEFAULT_WORKSPACE, settings.sensor, &random) == MO_OK)
    mo_controller_randomize(random, settings.seed);
  CHECK_OK(mo_training_create(&settings, random != NULL ? random : origin->controller,
                              designs[0].words, n, &training));
  mo_controller_free(random);
  return training;
}

/* Learns during a generation, on the parents followed by the children. */
static inline void plain_learning(const struct plain *plain, const struct origin *origin,
                                  const struct mo_bits *bits, uint32_t n_parents, uint32_t n,
                                  struct mo_training **training, struct mo_campaign_generation *row)
{
  const struct mo_campaign_settings *settings = &origin->settings;
  if (settings->mode == MO_FEW_SHOT || row->generation == 0) {
    mo_training_free(*training);
    *training = plain_training(origin, row->generation, bits + n_parents, n);
  }
  if (n_parents > 0 && settings->parent_steps > 0) {
    CHECK_OK(mo_training_set_designs(*training, bits[0].words, n_parents));
    plain_steps(plain, *training, settings->parent_steps, row);
  }
  if (settings->child_steps > 0) {
    CHECK_OK(mo_training_set_designs(*training, bits[n_parents].words, n));
    plain_steps(plain, *training, settings->child_steps, row);
  }
}

static inline double plain_score(const struct plain *plain, const struct origin *origin,
                                 const struct mo_bits *genotype,
                                 const struct mo_controller *controller, double *losses)
{
  double sum = 0;
  for (uint32_t k = 0; k < origin->n_environments; k++)
    sum += losses[k] = plain->loss(plain->context, genotype, controller, &origin->environments[k],
                                   &origin->settings.physics);
  return origin->settings.aggregate.kind == MO_AGGREGATE_MEAN
             ? sum / origin->n_environments
             : mo_aggregate_score(&origin->settings.aggregate, losses, origin->n_environments);
}

/* Cuts a child short after the first wave that shows that it cannot survive. Returns the rollouts
 * up to there; *blocks: their number of blocks. */
static inline uint32_t plain_race(const struct mo_race *race, const struct mo_aggregate *aggregate,
                                  const double *losses, struct mo_campaign_design *design,
                                  uint32_t *blocks)
{
  *blocks = 1;
  for (uint32_t wave = 0; wave + 1 < race->n_waves; wave++, ++*blocks) {
    double known[MO_ENVIRONMENTS_MAX] = {0}, sum = 0;
    for (uint32_t i = 0; i < race->ends[wave]; i++)
      known[race->order[i]] = losses[race->order[i]];
    for (uint32_t k = 0; k < race->n_environments; k++)
      sum += known[k];
    const double bound = aggregate->kind == MO_AGGREGATE_MEAN
                             ? sum / race->n_environments
                             : mo_aggregate_score(aggregate, known, race->n_environments);
    if (bound > race->bound) {
      design->score = bound;
      design->is_cut = isfinite(design->score);
      return race->ends[wave];
    }
  }
  return race->n_environments;
}

static inline void plain_move(const struct mo_bits *from, struct mo_workspace workspace,
                              uint64_t *genotype)
{
  CHECK_OK(mo_genotype_move(MO_DEFAULT_WORKSPACE, from->words, workspace, genotype));
}

/* Returns false if the campaign found no more children. */
static inline bool plain_generation(const struct plain *plain, const struct origin *origin,
                                    uint32_t g, struct mo_seen *seen, struct mo_training **training,
                                    struct history *history)
{
  const struct mo_campaign_settings *settings = &origin->settings;
  const struct mo_workspace workspace = settings->workspace;
  const size_t words = mo_workspace_words(workspace);
  const bool is_zero_shot = settings->mode == MO_ZERO_SHOT;
  static uint64_t genotypes[2 * HISTORY_POPULATION * MO_DEFAULT_WORDS];
  struct mo_campaign_generation *row = &history->generations[g];
  struct mo_bits bits[2 * HISTORY_POPULATION];
  struct mo_birth births[HISTORY_POPULATION];
  struct mo_candidate candidates[2 * HISTORY_POPULATION];
  uint32_t survivors[HISTORY_POPULATION], n_survivors = 0, n = 0;
  const uint32_t n_parents = g > 0 ? history->populations[g - 1].n : 0;
  const uint32_t *numbers = g > 0 ? history->populations[g - 1].numbers : NULL;
  for (uint32_t i = 0; i < n_parents; i++) {
    memcpy(bits[i].words, history->designs[numbers[i]].genotype.words, sizeof(bits[i]));
    plain_move(&bits[i], workspace, genotypes + words * i);
  }
  *row = (struct mo_campaign_generation){.generation = g, .first_loss = NAN, .last_loss = NAN};
  if (g == 0) {
    for (uint32_t i = 0; i < origin->n_given; i++)
      plain_move(&origin->given[i], workspace, genotypes + words * i);
    CHECK_OK(mo_population_initial(settings, seen, genotypes, origin->n_given, &n, NULL, NULL));
    for (uint32_t i = 0; i < n; i++)
      births[i] = (struct mo_birth){
          i < origin->n_given ? MO_BORN_LISTED : MO_BORN_RANDOM, {MO_NO_PARENT, MO_NO_PARENT}, 1};
  } else {
    CHECK_OK(mo_variation(settings, g, genotypes, n_parents, seen, genotypes + words * n_parents,
                          births, &n, &row->variation, NULL));
  }
  if (n == 0)
    return false;
  for (uint32_t i = 0; i < n; i++) {
    struct mo_campaign_design *design = &history->designs[history->n_designs + i];
    CHECK_OK(mo_genotype_move(workspace, genotypes + words * (n_parents + i), MO_DEFAULT_WORKSPACE,
                              bits[n_parents + i].words));
    *design = (struct mo_campaign_design){
        .number = history->n_designs + i,
        .genotype = mo_genotype_of(MO_DEFAULT_WORKSPACE, &bits[n_parents + i]),
        .born = g,
        .descent.op = (uint8_t)births[i].op};
    for (int k = 0; k < 2; k++)
      design->descent.parents[k] =
          births[i].parents[k] == MO_NO_PARENT ? MO_NO_PARENT : numbers[births[i].parents[k]];
  }
  if (!is_zero_shot)
    plain_learning(plain, origin, bits, n_parents, n, training, row);
  const uint32_t e = origin->n_environments;
  double *losses = calloc((size_t)2 * HISTORY_POPULATION * e, sizeof(*losses));
  double scores[2 * HISTORY_POPULATION];
  struct mo_race race = {.n_waves = 0};
  static bool race_pays; /* whether a race saved time in the previous generation, or would have */
  double saved = 0;      /* with a race, where a block costs as much as two rollouts */
  race_pays = race_pays && g > 0;
  for (uint32_t i = 0; i < n_parents + n; i++) {
    const uint32_t number = i < n_parents ? numbers[i] : history->n_designs + i - n_parents;
    struct mo_campaign_design *design = &history->designs[number];
    scores[i] = plain_score(plain, origin, &bits[i],
                            is_zero_shot ? origin->controller : mo_training_controller(*training),
                            losses + (size_t)i * e);
    design->score = scores[i];
    candidates[i] = (struct mo_candidate){design->score, number, design->born};
    if (i + 1 == n_parents && mo_race_is_possible(settings))
      mo_race_plan(settings, losses, scores, n_parents, e, race_pays, &race);
    uint32_t rollouts = i >= n_parents || !is_zero_shot ? e : 0, blocks;
    if (i >= n_parents && race.n_waves > 0) {
      struct mo_campaign_design raced = *design;
      const uint32_t n_raced =
          plain_race(&race, &settings->aggregate, losses + (size_t)i * e, &raced, &blocks);
      saved += (double)(e - n_raced) + 2.0 * (e > 16 ? 2 : 1) - 2.0 * blocks;
      if (race_pays) {
        *design = raced;
        rollouts = n_raced;
      }
    }
    row->rollouts += rollouts;
    row->children_cut += design->is_cut;
  }
  free(losses);
  if (race.n_waves > 0 && isfinite(race.bound))
    race_pays = saved > 0;
  /* Selection by full scores must agree: a child that was cut short would not have survived. */
  CHECK_OK(mo_select(settings, g, genotypes, candidates, n_parents + n, survivors, &n_survivors));
  for (uint32_t i = 0; i < n_parents + n; i++)
    history->designs[candidates[i].number].died = g;
  history->populations[g].n = n_survivors;
  for (uint32_t i = 0; i < n_survivors; i++) {
    const struct mo_candidate *survivor = &candidates[survivors[i]];
    history->designs[survivor->number].died = -1;
    history->populations[g].numbers[i] = (uint32_t)survivor->number;
    history->populations[g].scores[i] = survivor->score;
  }
  history->n_designs += n;
  history->n_generations = g + 1;
  return true;
}

/* Returns the whole history of a campaign (calloc). */
static inline struct history *plain_history(const struct plain *plain, const struct origin *origin)
{
  struct history *history = calloc(1, sizeof(*history));
  struct mo_training *training = NULL;
  struct mo_seen *seen = NULL;
  CHECK_OK(mo_seen_create(origin->settings.workspace, origin->excluded, &seen));
  for (uint32_t g = 0; g <= origin->settings.generations; g++)
    if (!plain_generation(plain, origin, g, seen, &training, history))
      break;
  if (training != NULL)
    history->result = plain_result(training, origin->digits, plain->code_version, NULL);
  mo_training_free(training);
  mo_seen_free(seen);
  return history;
}

/* Returns the history that the store has of a campaign (calloc). */
static inline struct history *stored_history(int64_t id)
{
  struct history *history = calloc(1, sizeof(*history));
  struct mo_campaign_design rows[HISTORY_POPULATION];
  struct mo_campaign_status status;
  int64_t n_designs = mo_store_campaign_designs(store, id, -1, history->designs, MO_PAGE_MAX);
  int64_t n =
      mo_store_campaign_generations(store, id, -1, 1, history->generations, HISTORY_GENERATIONS);
  CHECK(n_designs >= 0 && n >= 0);
  CHECK_OK(mo_store_campaign(store, id, &status));
  history->n_designs = (uint32_t)n_designs;
  history->n_generations = (uint32_t)n;
  for (int64_t g = 0; g < n; g++) {
    uint32_t *size = &history->populations[g].n;
    CHECK_INT(mo_store_campaign_population(store, id, g, 0, rows, HISTORY_POPULATION, size), *size);
    for (uint32_t i = 0; i < *size; i++) {
      history->populations[g].numbers[i] = rows[i].number;
      history->populations[g].scores[i] = rows[i].score;
    }
  }
  if (status.job.has_result)
    history->result = status.job.result_sha256;
  return history;
}

static inline bool same_number(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0 || (isnan(a) && isnan(b));
}

static inline bool same_design(const struct history *x, const struct history *y, uint32_t i)
{
  const struct mo_campaign_design *a = &x->designs[i], *b = &y->designs[i];
  return a->number == i && b->number == i && mo_genotype_equal(&a->genotype, &b->genotype) &&
         a->descent.op == b->descent.op && a->descent.parents[0] == b->descent.parents[0] &&
         a->descent.parents[1] == b->descent.parents[1] && a->born == b->born &&
         a->died == b->died && same_number(a->score, b->score) && a->is_cut == b->is_cut;
}

static inline bool same_generation(const struct history *x, const struct history *y, uint32_t g)
{
  const struct mo_campaign_generation *a = &x->generations[g], *b = &y->generations[g];
  bool same =
      a->generation == g && b->generation == g && x->populations[g].n == y->populations[g].n &&
      a->learning_steps == b->learning_steps && same_number(a->first_loss, b->first_loss) &&
      same_number(a->last_loss, b->last_loss) && a->variation.mutants == b->variation.mutants &&
      a->variation.recombinants == b->variation.recombinants && a->rollouts == b->rollouts &&
      a->children_cut == b->children_cut;
  for (uint32_t i = 0; same && i < x->populations[g].n; i++)
    same = x->populations[g].numbers[i] == y->populations[g].numbers[i] &&
           same_number(x->populations[g].scores[i], y->populations[g].scores[i]);
  return same;
}

/* Prints the first difference. */
static inline bool same_history(const struct history *a, const struct history *b)
{
  if (a->n_generations != b->n_generations || a->n_designs != b->n_designs) {
    printf("# %u generations and %u designs, expected %u and %u\n", a->n_generations, a->n_designs,
           b->n_generations, b->n_designs);
    return false;
  }
  for (uint32_t i = 0; i < a->n_designs; i++)
    if (!same_design(a, b, i)) {
      printf("# design %u differs: born %u, died %lld, score %.17g; expected %u, %lld, %.17g\n", i,
             a->designs[i].born, (long long)a->designs[i].died, a->designs[i].score,
             b->designs[i].born, (long long)b->designs[i].died, b->designs[i].score);
      return false;
    }
  for (uint32_t g = 0; g < a->n_generations; g++)
    if (!same_generation(a, b, g)) {
      printf("# generation %u differs: n %u/%u, steps %u/%u, rollouts %llu/%llu\n", g,
             a->populations[g].n, b->populations[g].n, a->generations[g].learning_steps,
             b->generations[g].learning_steps, (unsigned long long)a->generations[g].rollouts,
             (unsigned long long)b->generations[g].rollouts);
      return false;
    }
  if (!mo_sha256_equal(&a->result, &b->result)) {
    printf("# the resulting controllers differ\n");
    return false;
  }
  return true;
}

/* Returns whether the store holds this history. */
static inline bool is_history(int64_t id, const struct history *expected)
{
  struct history *stored = stored_history(id);
  const bool same = same_history(stored, expected);
  free(stored);
  return same;
}

/* Returns whether the store holds the history that plain loops compute. */
static inline bool is_as_plain(int64_t id, const struct plain *plain, const struct origin *origin)
{
  struct history *expected = plain_history(plain, origin);
  const bool same = is_history(id, expected);
  free(expected);
  return same;
}

#endif
