/* campaign_history.h: everything that a campaign did, read from the store, and the same by plain
 * loops over the functions of evolution and learning, without jobs, threads, blocks or store. The
 * two must be equal, bit for bit. */
#ifndef MORPHO_TESTS_JOBS_CAMPAIGN_HISTORY_H
#define MORPHO_TESTS_JOBS_CAMPAIGN_HISTORY_H

#include "../check.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"

#define HISTORY_DESIGNS     1024
#define HISTORY_GENERATIONS 32
#define HISTORY_POPULATION  24

struct history {
  uint32_t n_designs;
  struct {
    struct mo_bits genotype;
    struct mo_descent descent;
    uint32_t born;
    int64_t died;
    double score;
  } designs[HISTORY_DESIGNS];
  uint32_t n_generations;
  struct {
    uint32_t n, numbers[HISTORY_POPULATION];
    double scores[HISTORY_POPULATION];
    uint32_t learning_steps;
    double first_loss, last_loss;
    struct mo_variation_counts variation;
    uint64_t rollouts;
  } generations[HISTORY_GENERATIONS];
  struct mo_sha256 result; /* of the controller's file; zeros: none */
};

/* How the test computes. */
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

/* What a campaign begins with. */
struct origin {
  struct mo_campaign_settings settings;
  const struct mo_environment *environments;
  uint32_t n_environments;
  const struct mo_controller *controller; /* NULL: random weights */
  const char *digits;                     /* of its file */
  const struct mo_bits *given;            /* (n_given) placed */
  uint32_t n_given;
  const struct mo_form_set *excluded;
};

static inline void plain_steps(const struct plain *plain, struct mo_training *training,
                               const struct mo_bits *designs, uint32_t n, uint32_t n_steps,
                               struct history *history, uint32_t generation)
{
  const struct mo_training_settings *settings = mo_training_settings_of(training);
  struct mo_outcome *outcomes = calloc(settings->batch, sizeof(*outcomes));
  double *gradient = calloc(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  if (n_steps > 0)
    CHECK_INT(mo_training_set_designs(training, designs[0].words, n, NULL), MO_OK);
  for (uint32_t i = 0; i < n_steps; i++) {
    const struct mo_robot *robots = NULL;
    struct mo_gradient_counts counts = {0};
    struct mo_training_report report = {.step = 0};
    CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_OK);
    plain->gradient(plain->context, mo_training_controller(training), robots, settings->batch,
                    &settings->physics, gradient, outcomes, &counts);
    CHECK_INT(mo_training_apply(training, gradient, outcomes, &counts, &report), MO_OK);
    if (history->generations[generation].learning_steps++ == 0)
      history->generations[generation].first_loss = report.mean_loss;
    history->generations[generation].last_loss = report.mean_loss;
  }
  free(outcomes);
  free(gradient);
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
  CHECK_INT(mo_training_create(&settings, random != NULL ? random : origin->controller,
                               designs[0].words, n, &training, NULL),
            MO_OK);
  mo_controller_free(random);
  return training;
}

static inline double plain_score(const struct plain *plain, const struct origin *origin,
                                 const struct mo_bits *genotype,
                                 const struct mo_controller *controller)
{
  double sum = 0;
  for (uint32_t k = 0; k < origin->n_environments; k++)
    sum += plain->loss(plain->context, genotype, controller, &origin->environments[k],
                       &origin->settings.physics);
  return sum / origin->n_environments;
}

/* Returns false when the campaign had no more children. */
static inline bool plain_generation(const struct plain *plain, const struct origin *origin,
                                    uint32_t g, struct mo_seen *seen, struct mo_training **training,
                                    struct history *history)
{
  const struct mo_campaign_settings *settings = &origin->settings;
  const size_t words = mo_workspace_words(settings->workspace);
  static uint64_t genotypes[2 * HISTORY_POPULATION * MO_DEFAULT_WORDS];
  struct mo_bits bits[2 * HISTORY_POPULATION];
  struct mo_birth births[HISTORY_POPULATION];
  struct mo_candidate candidates[2 * HISTORY_POPULATION];
  uint32_t survivors[HISTORY_POPULATION], n_survivors = 0, n_parents = 0, n = 0;
  const uint32_t *numbers = g > 0 ? history->generations[g - 1].numbers : NULL;
  if (g > 0)
    n_parents = history->generations[g - 1].n;
  for (uint32_t i = 0; i < n_parents; i++) {
    bits[i] = history->designs[numbers[i]].genotype;
    CHECK_INT(mo_genotype_move(MO_DEFAULT_WORKSPACE, bits[i].words, settings->workspace,
                               genotypes + words * i),
              MO_OK);
  }
  if (g == 0) {
    for (uint32_t i = 0; i < origin->n_given; i++)
      CHECK_INT(mo_genotype_move(MO_DEFAULT_WORKSPACE, origin->given[i].words, settings->workspace,
                                 genotypes + words * i),
                MO_OK);
    CHECK_INT(mo_population_initial(settings, seen, genotypes, origin->n_given, &n, NULL, NULL),
              MO_OK);
    for (uint32_t i = 0; i < n; i++)
      births[i] = (struct mo_birth){
          i < origin->n_given ? MO_BORN_LISTED : MO_BORN_RANDOM, {MO_NO_PARENT, MO_NO_PARENT}, 1};
  } else {
    CHECK_INT(mo_variation(settings, g, genotypes, n_parents, seen, genotypes + words * n_parents,
                           births, &n, &history->generations[g].variation, NULL),
              MO_OK);
  }
  if (n == 0)
    return false;
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t number = history->n_designs + i;
    CHECK_INT(mo_genotype_move(settings->workspace, genotypes + words * (n_parents + i),
                               MO_DEFAULT_WORKSPACE, bits[n_parents + i].words),
              MO_OK);
    history->designs[number].genotype = bits[n_parents + i];
    history->designs[number].born = g;
    history->designs[number].died = -1;
    history->designs[number].descent.op = (uint8_t)births[i].op;
    for (int k = 0; k < 2; k++)
      history->designs[number].descent.parents[k] =
          births[i].parents[k] == MO_NO_PARENT ? MO_NO_PARENT : numbers[births[i].parents[k]];
  }
  history->generations[g].first_loss = history->generations[g].last_loss = NAN;
  if (settings->mode != MO_ZERO_SHOT) {
    if (settings->mode == MO_FEW_SHOT || g == 0) {
      mo_training_free(*training);
      *training = plain_training(origin, g, bits + n_parents, n);
    }
    if (g > 0)
      plain_steps(plain, *training, bits, n_parents, settings->parent_steps, history, g);
    plain_steps(plain, *training, bits + n_parents, n, settings->child_steps, history, g);
  }
  for (uint32_t i = 0; i < n_parents + n; i++) {
    const uint32_t number = i < n_parents ? numbers[i] : history->n_designs + i - n_parents;
    if (settings->mode != MO_ZERO_SHOT || i >= n_parents) {
      history->designs[number].score = plain_score(
          plain, origin, &bits[i],
          settings->mode == MO_ZERO_SHOT ? origin->controller : mo_training_controller(*training));
      history->generations[g].rollouts += origin->n_environments;
    }
    candidates[i] = (struct mo_candidate){history->designs[number].score, number,
                                          history->designs[number].born};
  }
  CHECK_INT(mo_select(settings, g, genotypes, candidates, n_parents + n, survivors, &n_survivors),
            MO_OK);
  for (uint32_t i = 0; i < n_parents + n; i++) {
    bool lives = false;
    for (uint32_t k = 0; k < n_survivors; k++)
      lives = lives || survivors[k] == i;
    if (!lives)
      history->designs[candidates[i].number].died = g;
  }
  history->generations[g].n = n_survivors;
  for (uint32_t i = 0; i < n_survivors; i++) {
    history->generations[g].numbers[i] = (uint32_t)candidates[survivors[i]].number;
    history->generations[g].scores[i] = candidates[survivors[i]].score;
  }
  history->n_designs += n;
  history->n_generations = g + 1;
  return true;
}

/* The whole campaign (calloc). */
static inline struct history *plain_history(const struct plain *plain, const struct origin *origin)
{
  struct history *history = calloc(1, sizeof(*history));
  struct mo_training *training = NULL;
  struct mo_controller *controller = NULL;
  struct mo_seen *seen = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  CHECK_INT(mo_seen_create(origin->settings.workspace, origin->excluded, &seen), MO_OK);
  for (uint32_t g = 0; g <= origin->settings.generations; g++)
    if (!plain_generation(plain, origin, g, seen, &training, history))
      break;
  if (training != NULL &&
      mo_training_export(training, origin->digits, plain->code_version, NULL, &controller) ==
          MO_OK &&
      mo_controller_encode(controller, &bytes, &size) == MO_OK)
    mo_sha256_of(bytes, size, &history->result);
  free(bytes);
  mo_controller_free(controller);
  mo_training_free(training);
  mo_seen_free(seen);
  return history;
}

/* What the store holds of a campaign (calloc). */
static inline struct history *stored_history(struct mo_store *store, int64_t id)
{
  struct history *history = calloc(1, sizeof(*history));
  struct mo_campaign_design *designs = calloc(HISTORY_DESIGNS, sizeof(*designs));
  struct mo_campaign_generation *rows = calloc(HISTORY_GENERATIONS, sizeof(*rows));
  struct mo_campaign_status status;
  int64_t n_designs = mo_store_campaign_designs(store, id, -1, designs, MO_PAGE_MAX);
  int64_t n = mo_store_campaign_generations(store, id, -1, rows, HISTORY_GENERATIONS);
  CHECK(n_designs >= 0 && n >= 0);
  CHECK_INT(mo_store_campaign(store, id, &status), MO_OK);
  for (int64_t i = 0; i < n_designs; i++) {
    CHECK_INT(designs[i].number, i);
    history->designs[i].genotype = designs[i].genotype;
    history->designs[i].descent = designs[i].descent;
    history->designs[i].born = designs[i].born;
    history->designs[i].died = designs[i].died;
    history->designs[i].score = designs[i].score;
  }
  history->n_designs = (uint32_t)n_designs;
  history->n_generations = (uint32_t)n;
  for (int64_t g = 0; g < n; g++) {
    uint32_t size = 0;
    CHECK_INT(rows[g].generation, g);
    CHECK(mo_store_campaign_population(store, id, g, 0, designs, HISTORY_POPULATION, &size) ==
          (int64_t)size);
    history->generations[g].n = size;
    for (uint32_t i = 0; i < size; i++) {
      history->generations[g].numbers[i] = designs[i].number;
      history->generations[g].scores[i] = designs[i].score;
    }
    history->generations[g].learning_steps = rows[g].learning_steps;
    history->generations[g].first_loss = rows[g].first_loss;
    history->generations[g].last_loss = rows[g].last_loss;
    history->generations[g].variation = rows[g].variation;
    history->generations[g].rollouts = rows[g].rollouts;
  }
  if (status.has_result)
    history->result = status.result_sha256;
  free(designs);
  free(rows);
  return history;
}

static inline bool same_number(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0 || (isnan(a) && isnan(b));
}

/* Tells the first difference. */
static inline bool same_history(const struct history *a, const struct history *b)
{
  if (a->n_generations != b->n_generations || a->n_designs != b->n_designs) {
    printf("# %u generations and %u designs, expected %u and %u\n", a->n_generations, a->n_designs,
           b->n_generations, b->n_designs);
    return false;
  }
  for (uint32_t i = 0; i < a->n_designs; i++)
    if (memcmp(&a->designs[i].genotype, &b->designs[i].genotype, sizeof(struct mo_bits)) != 0 ||
        a->designs[i].descent.op != b->designs[i].descent.op ||
        a->designs[i].descent.parents[0] != b->designs[i].descent.parents[0] ||
        a->designs[i].descent.parents[1] != b->designs[i].descent.parents[1] ||
        a->designs[i].born != b->designs[i].born || a->designs[i].died != b->designs[i].died ||
        !same_number(a->designs[i].score, b->designs[i].score)) {
      printf("# design %u differs: born %u, died %lld, score %.17g; expected %u, %lld, %.17g\n", i,
             a->designs[i].born, (long long)a->designs[i].died, a->designs[i].score,
             b->designs[i].born, (long long)b->designs[i].died, b->designs[i].score);
      return false;
    }
  for (uint32_t g = 0; g < a->n_generations; g++) {
    bool same =
        a->generations[g].n == b->generations[g].n &&
        a->generations[g].learning_steps == b->generations[g].learning_steps &&
        same_number(a->generations[g].first_loss, b->generations[g].first_loss) &&
        same_number(a->generations[g].last_loss, b->generations[g].last_loss) &&
        a->generations[g].variation.mutants == b->generations[g].variation.mutants &&
        a->generations[g].variation.recombinants == b->generations[g].variation.recombinants &&
        a->generations[g].rollouts == b->generations[g].rollouts;
    for (uint32_t i = 0; same && i < a->generations[g].n; i++)
      same = a->generations[g].numbers[i] == b->generations[g].numbers[i] &&
             same_number(a->generations[g].scores[i], b->generations[g].scores[i]);
    if (!same) {
      printf(
          "# generation %u differs: n %u/%u, steps %u/%u, losses %g %g/%g %g, rollouts %llu/%llu\n",
          g, a->generations[g].n, b->generations[g].n, a->generations[g].learning_steps,
          b->generations[g].learning_steps, a->generations[g].first_loss,
          a->generations[g].last_loss, b->generations[g].first_loss, b->generations[g].last_loss,
          (unsigned long long)a->generations[g].rollouts,
          (unsigned long long)b->generations[g].rollouts);
      return false;
    }
  }
  if (!mo_sha256_equal(&a->result, &b->result)) {
    printf("# the resulting controllers differ\n");
    return false;
  }
  return true;
}

/* Whether the store holds what plain loops give. */
static inline bool is_as_plain(struct mo_store *store, int64_t id, const struct plain *plain,
                               const struct origin *origin)
{
  struct history *stored = stored_history(store, id), *expected = plain_history(plain, origin);
  bool same = same_history(stored, expected);
  free(stored);
  free(expected);
  return same;
}

#endif
