/* evolution_store.c: the cost of storing a campaign: commits, the database, the pages that clients
 * read. */
#include "evolution_store.h"

#include "bench.h"
#include "state.h"

#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/runner.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>

#define PAGE_ROWS 1000
#define PAGES     200

struct bench_campaign {
  const char *path;
  struct mo_store *store;
  int64_t id, fingerprint;
  uint32_t population;
  uint64_t n_designs;
  int64_t generation;
  double *processor_s; /* (generations + 1) of each commit, by all threads */
  struct mo_bits *forms, *genotypes;
  struct mo_campaign_loss *losses;
  uint32_t *numbers;
  double *parent_scores, *child_scores;
};

struct bench_campaign *bench_campaign_create(const struct mo_campaign_settings *settings,
                                             const char *folder)
{
  struct bench_campaign *campaign = bench_zeros(1, sizeof(*campaign));
  const struct mo_campaign_request submission = {
      .record = {.settings = *settings, .environment_set = "paper-test", .replicates = 1},
      .controller = "default"};
  const size_t n = settings->population;
  bool replayed;
  campaign->path = bench_state_make(folder);
  campaign->store = bench_state_open(campaign->path);
  bench_check(mo_store_fingerprint(campaign->store, "no rollouts", &campaign->fingerprint),
              "fingerprint");
  bench_check(mo_store_submit_campaign(campaign->store, &submission, &campaign->id, &replayed),
              "submission");
  bench_check(mo_store_run_start(campaign->store, campaign->id), "start");
  campaign->population = settings->population;
  campaign->generation = -1;
  campaign->processor_s =
      bench_zeros((size_t)settings->generations + 1, sizeof(*campaign->processor_s));
  campaign->forms = bench_zeros(n, sizeof(*campaign->forms));
  campaign->genotypes = bench_zeros(n, sizeof(*campaign->genotypes));
  campaign->losses = bench_zeros(n, sizeof(*campaign->losses));
  campaign->numbers = bench_zeros(n, sizeof(*campaign->numbers));
  campaign->parent_scores = bench_zeros(n, sizeof(*campaign->parent_scores));
  campaign->child_scores = bench_zeros(n, sizeof(*campaign->child_scores));
  return campaign;
}

static double processor_s(void)
{
  struct rusage used;
  getrusage(RUSAGE_SELF, &used);
  return (double)(used.ru_utime.tv_sec + used.ru_stime.tv_sec) +
         1e-6 * (double)(used.ru_utime.tv_usec + used.ru_stime.tv_usec);
}

double bench_campaign_commit(struct bench_campaign *campaign,
                             const struct bench_generation *generation)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  const uint32_t n_parents = generation->n_parents, n_children = generation->n_children;
  const struct mo_campaign_commit commit = {.row = {.generation = generation->generation,
                                                    .born_before = campaign->n_designs,
                                                    .n_children = n_children,
                                                    .stats = generation->stats,
                                                    .variation = generation->counts},
                                            .births = generation->births,
                                            .forms = campaign->forms,
                                            .genotypes = campaign->genotypes,
                                            .sizes = generation->sizes + n_parents,
                                            .child_scores = campaign->child_scores,
                                            .parent_numbers = campaign->numbers,
                                            .parent_scores = campaign->parent_scores,
                                            .n_parents = n_parents,
                                            .survivors = generation->survivors,
                                            .n_survivors = generation->n_survivors,
                                            .losses = campaign->losses,
                                            .n_losses = n_children,
                                            .fingerprint = campaign->fingerprint,
                                            .event_data = "{}"};
  for (uint32_t i = 0; i < n_parents; i++) {
    campaign->numbers[i] = (uint32_t)generation->candidates[i].number;
    campaign->parent_scores[i] = generation->candidates[i].score;
  }
  const double start = bench_now_s(), processor_start = processor_s();
  for (uint32_t i = 0; i < n_children; i++) {
    const uint64_t *genotype = generation->genotypes + (size_t)MO_DEFAULT_WORDS * (n_parents + i);
    struct mo_campaign_loss *loss = &campaign->losses[i];
    memcpy(campaign->genotypes[i].words, genotype, sizeof(campaign->genotypes[i].words));
    mo_genotype_canonical(workspace, genotype, campaign->forms[i].words);
    campaign->child_scores[i] = generation->candidates[n_parents + i].score;
    loss->place = i;
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
      loss->losses[k] = campaign->child_scores[i];
  }
  bench_check(mo_store_campaign_commit(campaign->store, campaign->id, &commit), "commit");
  campaign->processor_s[generation->generation] = processor_s() - processor_start;
  campaign->n_designs += n_children;
  campaign->generation = generation->generation;
  return bench_now_s() - start;
}

/* ---- reading ---- */

enum page { DESIGNS, POPULATION, GENERATIONS, DESCENTS, ANCESTORS, PLACES, PAGE_KINDS };
static const char *const page_names[PAGE_KINDS] = {
    "1000 designs", "1000 of a population",    "100 generations",
    "all descents", "all descents, ancestors", "campaigns of a design"};

static int64_t read_descents(struct bench_campaign *campaign, bool with_ancestors, uint32_t number)
{
  struct mo_descent *descents = NULL;
  uint32_t *born = NULL, n = 0;
  const int status =
      mo_store_campaign_descents(campaign->store, campaign->id, &descents, &born, &n);
  if (status == MO_OK && with_ancestors) {
    uint8_t *marks = bench_zeros(n, 1);
    mo_ancestors(descents, n, number, marks);
    free(marks);
  }
  free(descents);
  free(born);
  return status;
}

static int64_t read_page(struct bench_campaign *campaign, enum page kind, uint32_t number,
                         struct mo_campaign_design *rows)
{
  struct mo_campaign_generation generations[100];
  struct mo_campaign_place place;
  int64_t last = campaign->generation;
  uint32_t n = 0;
  switch (kind) {
  case DESIGNS:
    return mo_store_campaign_designs(campaign->store, campaign->id, (int64_t)number - 1, rows,
                                     PAGE_ROWS);
  case POPULATION:
    return mo_store_campaign_population(campaign->store, campaign->id, number % (last + 1),
                                        number % (campaign->population / 2 + 1), rows, PAGE_ROWS,
                                        &n);
  case GENERATIONS:
    return mo_store_campaign_generations(campaign->store, campaign->id, number % (last / 2 + 1), 1,
                                         generations, 100);
  case DESCENTS:
  case ANCESTORS: return read_descents(campaign, kind == ANCESTORS, number);
  default:
    if (mo_store_campaign_designs_of(campaign->store, campaign->id, &number, 1, rows) != MO_OK)
      return MO_ERR_CORRUPT;
    return mo_store_campaigns_of_design(campaign->store, &rows[0].form, 0, &place, 1) == 1
               ? MO_OK
               : MO_ERR_CORRUPT;
  }
}

static void read_pages(struct bench_campaign *campaign)
{
  struct mo_campaign_design *rows = bench_zeros(PAGE_ROWS, sizeof(*rows));
  double ms[PAGES];
  printf("\n%-24s     median        p99    longest (ms, %d reads at random places)\n", "reading",
         PAGES);
  for (enum page kind = DESIGNS; kind < PAGE_KINDS; kind++) {
    for (uint32_t i = 0; i < PAGES; i++) {
      struct mo_random random;
      mo_random_init(&random, 1, MO_PURPOSE_CHECK, (uint64_t)kind, i);
      const uint32_t number = mo_random_below(&random, (uint32_t)campaign->n_designs);
      const double start = bench_now_s();
      const int64_t status = read_page(campaign, kind, number, rows);
      bench_check(status < 0 ? (int)status : MO_OK, page_names[kind]);
      ms[i] = 1e3 * (bench_now_s() - start);
    }
    const double median = bench_median(ms, PAGES); /* sorts */
    printf("%-24s %10.2f %10.2f %10.2f\n", page_names[kind], median, ms[PAGES * 99 / 100],
           ms[PAGES - 1]);
  }
  free(rows);
}

/* Does what a process does when it resumes the campaign. */
static void resume(struct bench_campaign *campaign)
{
  struct mo_campaign_state *state = NULL;
  struct mo_seen *seen = NULL;
  double start = bench_now_s();
  bench_check(mo_store_campaign_state(campaign->store, campaign->id, &state), "state");
  const double state_s = bench_now_s() - start;
  start = bench_now_s();
  bench_check(mo_seen_create(MO_DEFAULT_WORKSPACE, NULL, &seen), "seen");
  bench_check(mo_store_campaign_each(campaign->store, campaign->id, mo_seen_take, seen), "designs");
  printf("resumed: the population in %.3f s, the forms of %llu designs in %.2f s\n", state_s,
         (unsigned long long)mo_seen_count(seen), bench_now_s() - start);
  mo_campaign_state_free(state);
  mo_seen_free(seen);
}

static double mebibytes(const struct bench_campaign *campaign, const char *file)
{
  char path[600];
  struct stat status;
  snprintf(path, sizeof(path), "%s/%s", campaign->path, file);
  return stat(path, &status) == 0 ? (double)status.st_size / 0x1p20 : 0.0;
}

void bench_campaign_report(struct bench_campaign *campaign)
{
  const size_t n = (size_t)campaign->generation + 1;
  const double median = bench_median(campaign->processor_s, n); /* sorts */
  printf("\nprocessor time of a commit: median %.3f s, worst %.3f s\n", median,
         campaign->processor_s[n - 1]);
  printf("database %.1f MiB, its log %.1f MiB\n", mebibytes(campaign, "morphod.db"),
         mebibytes(campaign, "morphod.db-wal"));
  read_pages(campaign);
  resume(campaign);
  mo_store_close(campaign->store);
}
