/* evolution.c: the cost of a campaign's bookkeeping, without its rollouts; `morpho-bench
 * evolution`.
 *
 * Variation of a real population against a set of as many forms as a large pretraining run has,
 * selection and statistics are real. Only the scores do not come from rollouts, but from an
 * artificial landscape over the voxels. They are heritable, so that the population converges and
 * children that were seen before become frequent, as in a real campaign. With --store, each
 * generation is also committed, with ten losses per design. */
#include "bench.h"
#include "evolution_store.h"

#include <morpho/evolution.h>

#include <getopt.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define W MO_DEFAULT_WORDS

/* On one core, at the defaults. */
#define BOUND_S   1.0
#define BOUND_MIB 600.0

static const char usage[] =
    "Usage: morpho-bench evolution [OPTION…]\n\n  --population N    default 8192\n  --generations "
    "N   default 100\n  --forms N         bodies of a pretraining run that count as seen (default "
    "12000000)\n  --threads N       threads that draw these (default 1)\n  --selection NAME  one "
    "of docs/evolution.md (default truncation)\n  --seed N          of the campaign (default 1)\n  "
    "--store PATH      commit every generation to a new state folder there, and read it back\n";

enum phase { VARIATION, SELECTION, STATISTICS, STORING, PHASES };
static const char *const phase_names[PHASES] = {"variation", "selection", "statistics", "storing"};

struct evolution {
  struct mo_campaign_settings settings;
  uint64_t n_forms;
  uint32_t n_threads;              /* that draw the forms */
  const char *store_path;          /* nullable */
  struct bench_campaign *campaign; /* with store_path */

  struct mo_form_set *excluded;
  struct mo_seen *seen;
  struct mo_lattice *lattice;
  uint32_t n, n_children;          /* parents, children */
  uint64_t *genotypes, *next;      /* (2 population, W) parents, then children */
  struct mo_candidate *candidates; /* (2 population) */
  struct mo_design_size *sizes;    /* (2 population) */
  struct mo_candidate *next_candidates;
  struct mo_design_size *next_sizes;
  struct mo_birth *births; /* (population) */
  uint32_t *survivors;     /* (2 population) */
  double *scores;          /* (population) */
  uint64_t n_designs;
  double *seconds[PHASES], *total;   /* (generations) */
  struct mo_variation_counts counts; /* of all generations */
};

/* Returns 1 / (1 + e^f), where f is a sum of random weights over voxels and pairs of neighbors, in
 * their order. */
static double made_up_score(const uint64_t *genotype)
{
  static double weights[2][MO_DEFAULT_VOXELS];
  static bool ready;
  if (!ready) {
    struct mo_random random;
    mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, 0);
    for (int i = 0; i < 2 * MO_DEFAULT_VOXELS; i++)
      weights[i / MO_DEFAULT_VOXELS][i % MO_DEFAULT_VOXELS] = mo_random_normal(&random);
    ready = true;
  }
  double sum = 0.0;
  for (uint32_t w = 0; w < W; w++) {
    const uint64_t next = genotype[w] >> 1 | (w + 1 < W ? genotype[w + 1] << 63 : 0);
    for (uint64_t rest = genotype[w]; rest != 0; rest &= rest - 1) {
      const int bit = __builtin_ctzll(rest);
      sum += weights[0][64 * w + (uint32_t)bit] +
             (next >> bit & 1 ? weights[1][64 * w + (uint32_t)bit] : 0.0);
    }
  }
  return 1.0 / (1.0 + exp(0.1 * sum));
}

/* Computes scores and sizes of the designs at places from … to − 1, born in this generation. */
static void describe(struct evolution *evolution, uint32_t generation, uint32_t from, uint32_t to)
{
  for (uint32_t i = from; i < to; i++) {
    const uint64_t number = evolution->n_designs++;
    evolution->candidates[i] =
        (struct mo_candidate){.score = made_up_score(evolution->genotypes + (size_t)W * i),
                              .number = number,
                              .born = generation};
  }
}

static void measure_sizes(struct evolution *evolution, uint32_t from, uint32_t to)
{
  for (uint32_t i = from; i < to; i++)
    bench_check(mo_design_size(evolution->lattice, evolution->genotypes + (size_t)W * i,
                               &evolution->sizes[i]),
                "sizes");
}

static void store_initial(struct evolution *evolution)
{
  struct bench_generation generation = {.n_children = evolution->n,
                                        .n_survivors = evolution->n,
                                        .genotypes = evolution->genotypes,
                                        .candidates = evolution->candidates,
                                        .sizes = evolution->sizes,
                                        .births = evolution->births,
                                        .survivors = evolution->survivors};
  for (uint32_t i = 0; i < evolution->n; i++) {
    evolution->births[i] = (struct mo_birth){
        .op = MO_BORN_RANDOM, .parents = {MO_NO_PARENT, MO_NO_PARENT}, .attempts = 1};
    evolution->survivors[i] = i;
  }
  evolution->campaign = bench_campaign_create(&evolution->settings, evolution->store_path);
  printf("its commit: %.3f s\n", bench_campaign_commit(evolution->campaign, &generation));
}

static void create(struct evolution *evolution)
{
  const struct mo_campaign_settings *settings = &evolution->settings;
  const size_t n = settings->population;
  evolution->genotypes = bench_zeros(2 * n, W * sizeof(uint64_t));
  evolution->next = bench_zeros(2 * n, W * sizeof(uint64_t));
  evolution->candidates = bench_zeros(2 * n, sizeof(*evolution->candidates));
  evolution->next_candidates = bench_zeros(2 * n, sizeof(*evolution->candidates));
  evolution->sizes = bench_zeros(2 * n, sizeof(*evolution->sizes));
  evolution->next_sizes = bench_zeros(2 * n, sizeof(*evolution->sizes));
  evolution->births = bench_zeros(n, sizeof(*evolution->births));
  evolution->survivors = bench_zeros(2 * n, sizeof(*evolution->survivors));
  evolution->scores = bench_zeros(n, sizeof(*evolution->scores));
  for (int phase = 0; phase < PHASES; phase++)
    evolution->seconds[phase] = bench_zeros(settings->generations, sizeof(double));
  evolution->total = bench_zeros(settings->generations, sizeof(double));
  bench_check(mo_lattice_create(settings->workspace, &evolution->lattice), "lattice");
  bench_check(mo_form_set_create(settings->workspace, &evolution->excluded), "set of forms");
  double start = bench_now_s();
  bench_check(mo_pretraining_forms(1, evolution->n_forms, settings->workspace, evolution->n_threads,
                                   NULL, NULL, evolution->excluded),
              "bodies of the pretraining");
  printf("excluded: the first %llu bodies of the pretraining of seed 1, redrawn by %u threads "
         "in %.1f s, %.1f MiB\n",
         (unsigned long long)mo_form_set_count(evolution->excluded), evolution->n_threads,
         bench_now_s() - start, (double)mo_form_set_bytes(evolution->excluded) / 0x1p20);
  bench_check(mo_seen_create(settings->workspace, evolution->excluded, &evolution->seen), "seen");
  start = bench_now_s();
  bench_check(mo_population_initial(settings, evolution->seen, evolution->genotypes, 0,
                                    &evolution->n, NULL, NULL),
              "initial population");
  printf("initial population of %u random bodies: %.3f s\n", evolution->n, bench_now_s() - start);
  describe(evolution, 0, 0, evolution->n);
  measure_sizes(evolution, 0, evolution->n);
  if (evolution->store_path != NULL)
    store_initial(evolution);
}

/* ---- one generation ---- */

static struct mo_variation_counts vary(struct evolution *evolution, uint32_t generation)
{
  struct mo_variation_counts counts;
  bench_check(mo_variation(&evolution->settings, generation, evolution->genotypes, evolution->n,
                           evolution->seen, evolution->genotypes + (size_t)W * evolution->n,
                           evolution->births, &evolution->n_children, &counts, NULL),
              "variation");
  evolution->counts.mutation_attempts += counts.mutation_attempts;
  evolution->counts.crossover_attempts += counts.crossover_attempts;
  evolution->counts.mutants += counts.mutants;
  evolution->counts.recombinants += counts.recombinants;
  evolution->counts.fallbacks += counts.fallbacks;
  evolution->counts.exhausted |= counts.exhausted;
  return counts;
}

static void choose(struct evolution *evolution, uint32_t generation)
{
  const uint32_t n = evolution->n + evolution->n_children;
  bench_check(mo_select(&evolution->settings, generation, evolution->genotypes,
                        evolution->candidates, n, evolution->survivors, &evolution->n),
              "selection");
  for (uint32_t i = 0; i < evolution->n; i++) {
    const uint32_t from = evolution->survivors[i];
    memcpy(evolution->next + (size_t)W * i, evolution->genotypes + (size_t)W * from,
           W * sizeof(uint64_t));
    evolution->next_candidates[i] = evolution->candidates[from];
    evolution->next_sizes[i] = evolution->sizes[from];
    evolution->scores[i] = evolution->candidates[from].score;
  }
  uint64_t *genotypes = evolution->genotypes;
  struct mo_candidate *candidates = evolution->candidates;
  struct mo_design_size *sizes = evolution->sizes;
  evolution->genotypes = evolution->next;
  evolution->candidates = evolution->next_candidates;
  evolution->sizes = evolution->next_sizes;
  evolution->next = genotypes;
  evolution->next_candidates = candidates;
  evolution->next_sizes = sizes;
}

static void advance(struct evolution *evolution, uint32_t generation)
{
  double *seconds[PHASES];
  for (int phase = 0; phase < PHASES; phase++)
    seconds[phase] = &evolution->seconds[phase][generation - 1];
  const uint32_t n_parents = evolution->n;
  double start = bench_now_s();
  const struct mo_variation_counts counts = vary(evolution, generation);
  *seconds[VARIATION] = bench_now_s() - start;
  describe(evolution, generation, evolution->n,
           evolution->n + evolution->n_children); /* not measured: takes the place of rollouts */
  start = bench_now_s();
  measure_sizes(evolution, evolution->n, evolution->n + evolution->n_children);
  *seconds[STATISTICS] = bench_now_s() - start;
  start = bench_now_s();
  choose(evolution, generation);
  *seconds[SELECTION] = bench_now_s() - start;
  struct mo_population_stats stats;
  start = bench_now_s();
  bench_check(mo_population_stats(evolution->settings.workspace, evolution->genotypes,
                                  evolution->scores, evolution->sizes, evolution->n, &stats),
              "statistics");
  *seconds[STATISTICS] += bench_now_s() - start;
  if (evolution->campaign !=
      NULL) { /* the other arrays now hold parents and children as they were before selection */
    const struct bench_generation stored = {generation,
                                            n_parents,
                                            evolution->n_children,
                                            evolution->n,
                                            evolution->next,
                                            evolution->next_candidates,
                                            evolution->next_sizes,
                                            evolution->births,
                                            evolution->survivors,
                                            stats,
                                            counts};
    *seconds[STORING] = bench_campaign_commit(evolution->campaign, &stored);
  }
  for (int phase = 0; phase < PHASES; phase++)
    evolution->total[generation - 1] += *seconds[phase];
  if (generation == 1 || generation % 10 == 0)
    printf("%10u %10.4f %10.4f %10.4f %10.4f %10.4f %8.4f %9.3f %10.1f\n", generation,
           *seconds[VARIATION], *seconds[SELECTION], *seconds[STATISTICS], *seconds[STORING],
           stats.mean_score, stats.diversity, stats.voxels.mean, stats.masses.mean);
}

static int report(struct evolution *evolution)
{
  const uint32_t n = evolution->settings.generations;
  const struct mo_variation_counts *counts = &evolution->counts;
  printf("\nseconds per generation     median      worst\n");
  for (int phase = 0; phase <= PHASES; phase++) {
    if (phase == STORING && evolution->campaign == NULL)
      continue;
    double *seconds = phase < PHASES ? evolution->seconds[phase] : evolution->total;
    const double median = bench_median(seconds, n); /* sorts */
    printf("%-22s %10.4f %10.4f\n", phase < PHASES ? phase_names[phase] : "together", median,
           seconds[n - 1]);
  }
  const double worst = evolution->total[n - 1];
  printf("\n");
  printf("%llu designs; attempts per mutant %.2f, per recombinant %.2f; %u mutants instead of "
         "recombinants\n",
         (unsigned long long)evolution->n_designs,
         (double)counts->mutation_attempts / (counts->mutants > 0 ? counts->mutants : 1),
         (double)counts->crossover_attempts / (counts->recombinants > 0 ? counts->recombinants : 1),
         counts->fallbacks);
  const double peak = bench_peak_mib();
  printf("memory: excluded forms %.1f MiB, process at its largest %.1f MiB\n",
         (double)mo_form_set_bytes(evolution->excluded) / 0x1p20, peak);
  const int good = worst <= BOUND_S && peak <= BOUND_MIB && !counts->exhausted;
  printf("bounds: worst generation %.1f s, %.0f MiB: %s\n", BOUND_S, BOUND_MIB,
         good ? "kept" : "MISSED");
  return good ? EXIT_SUCCESS : EXIT_FAILURE;
}

static void read_options(struct evolution *evolution, int argc, char **argv)
{
  static const struct option options[] = {{"population", required_argument, NULL, 'p'},
                                          {"generations", required_argument, NULL, 'g'},
                                          {"forms", required_argument, NULL, 'f'},
                                          {"threads", required_argument, NULL, 'T'},
                                          {"selection", required_argument, NULL, 's'},
                                          {"seed", required_argument, NULL, 'S'},
                                          {"store", required_argument, NULL, 't'},
                                          {"help", no_argument, NULL, 'h'},
                                          {NULL, 0, NULL, 0}};
  struct mo_campaign_settings *settings = &evolution->settings;
  int option;
  while ((option = getopt_long(argc, argv, "h", options, NULL)) != -1)
    switch (option) {
    case 'p':
      settings->population = (uint32_t)bench_number(optarg, MO_POPULATION_MIN, MO_POPULATION_MAX);
      break;
    case 'g': settings->generations = (uint32_t)bench_number(optarg, 1, MO_GENERATIONS_MAX); break;
    case 'f': evolution->n_forms = bench_number(optarg, 0, MO_TRAINING_BODIES_MAX); break;
    case 'T': evolution->n_threads = (uint32_t)bench_number(optarg, 1, 64); break;
    case 's':
      settings->selection.kind = (enum mo_selection_kind)bench_word(mo_selection_words, optarg);
      break;
    case 'S': settings->seed = bench_number(optarg, 0, UINT64_MAX); break;
    case 't': evolution->store_path = optarg; break;
    case 'h': fputs(usage, stdout); exit(0);
    default: fputs(usage, stderr); exit(2);
    }
  if (optind != argc) {
    fputs(usage, stderr);
    exit(2);
  }
}

int bench_evolution(int argc, char **argv)
{
  struct evolution evolution = {.settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_PAPER),
                                .n_forms = 12000000,
                                .n_threads = 1};
  setvbuf(stdout, NULL, _IOLBF, 0);
  read_options(&evolution, argc, argv);
  printf("population %u, %u generations, selection by %s; real variation; artificial scores: a "
         "random landscape over voxels, no rollouts\n",
         evolution.settings.population, evolution.settings.generations,
         mo_selection_words[evolution.settings.selection.kind]);
  create(&evolution);
  printf("%10s %10s %10s %10s %10s %10s %8s %9s %10s\n", "generation", "variation", "selection",
         "statistics", "storing", "mean score", "diversity", "voxels", "masses");
  for (uint32_t generation = 1; generation <= evolution.settings.generations; generation++)
    advance(&evolution, generation);
  const int status = report(&evolution);
  if (evolution.campaign != NULL)
    bench_campaign_report(evolution.campaign);
  return status;
}
