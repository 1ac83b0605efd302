/* Which share is served next, with blocks that only have a cost and workers that only wait: time by
 * weight, for any mix of costs, any number of workers, and shares that come and go. */
#include "compute/fair.h"

#include <morpho/random.h>

#include "../check.h"

#include <stdbool.h>

enum { SHARES_MAX = 8, WORKERS_MAX = 64, BLOCKS = 512 };

/* One submitter: keeps `depth` blocks waiting while it is active. */
struct submitter {
  struct mo_compute_share share;
  double least_s, most_s; /* costs of its blocks */
  uint32_t depth;         /* waiting and running together */
  uint32_t inside;
  bool off;
  double got_s; /* worker seconds that its finished blocks took, counted here */
};

struct world {
  struct mo_fair fair;
  struct submitter submitters[SHARES_MAX];
  uint32_t n_submitters, n_workers;
  struct mo_block blocks[BLOCKS];
  bool used[BLOCKS];
  struct {
    struct mo_block *block; /* NULL: idle */
    struct mo_fair_charge charge;
    double cost_s, end_s;
  } workers[WORKERS_MAX];
  double now_s;
  struct mo_random random;
};

static struct world world;

static void begin(uint32_t n_workers)
{
  memset(&world, 0, sizeof(world));
  world.n_workers = n_workers;
  mo_fair_init(&world.fair, n_workers);
  mo_random_init(&world.random, 7, MO_PURPOSE_CHECK, 0, n_workers);
}

static struct submitter *add(double weight, double least_s, double most_s, uint32_t depth)
{
  struct submitter *submitter = &world.submitters[world.n_submitters++];
  submitter->least_s = least_s;
  submitter->most_s = most_s;
  submitter->depth = depth;
  mo_fair_add(&world.fair, &submitter->share, weight);
  return submitter;
}

static void submit(struct submitter *submitter)
{
  uint32_t i = 0;
  while (world.used[i])
    i++;
  world.used[i] = true;
  world.blocks[i] = (struct mo_block){.n_environments = 1 + mo_random_below(&world.random, 16)};
  world.blocks[i].physics.scheme.n_steps = 1000;
  submitter->inside++;
  mo_fair_push(&world.fair, &submitter->share, &world.blocks[i]);
}

/* Lets the workers run until `end_s`. */
static void run_until(double end_s)
{
  for (;;) {
    for (uint32_t k = 0; k < world.n_submitters; k++)
      while (!world.submitters[k].off && world.submitters[k].inside < world.submitters[k].depth)
        submit(&world.submitters[k]);
    uint32_t first = WORKERS_MAX;
    for (uint32_t w = 0; w < world.n_workers; w++) {
      if (world.workers[w].block == NULL) {
        world.workers[w].block = mo_fair_take(&world.fair, &world.workers[w].charge, NULL, NULL);
        if (world.workers[w].block != NULL) {
          const struct submitter *submitter =
              (const struct submitter *)world.workers[w].charge.share;
          world.workers[w].cost_s = submitter->least_s + (submitter->most_s - submitter->least_s) *
                                                             mo_random_uniform(&world.random);
          world.workers[w].end_s = world.now_s + world.workers[w].cost_s;
        }
      }
      if (world.workers[w].block != NULL &&
          (first == WORKERS_MAX || world.workers[w].end_s < world.workers[first].end_s))
        first = w;
    }
    if (first == WORKERS_MAX || world.workers[first].end_s > end_s)
      break;
    world.now_s = world.workers[first].end_s;
    struct submitter *submitter = (struct submitter *)world.workers[first].charge.share;
    mo_fair_correct(&world.fair, &world.workers[first].charge, world.workers[first].cost_s, true);
    submitter->got_s += world.workers[first].cost_s;
    submitter->inside--;
    world.used[world.workers[first].block - world.blocks] = false;
    world.workers[first].block = NULL;
  }
  world.now_s = end_s;
}

static void forget(void)
{
  for (uint32_t k = 0; k < world.n_submitters; k++)
    world.submitters[k].got_s = 0;
}

static double part_of(const struct submitter *submitter)
{
  double sum = 0;
  for (uint32_t k = 0; k < world.n_submitters; k++)
    sum += world.submitters[k].got_s;
  return sum > 0 ? submitter->got_s / sum : 0;
}

static void by_weight_whatever_blocks_cost(void)
{
  const uint32_t workers[] = {1, 2, 3, 16, 64};
  for (int i = 0; i < 5; i++) {
    begin(workers[i]);
    struct submitter *slow = add(1, 0.5, 1.5, 2 * workers[i]); /* as with blocks of gradients */
    struct submitter *quick = add(2, 0.005, 0.02, 2 * workers[i]);
    struct submitter *mixed = add(4, 0.001, 0.4, 2 * workers[i]);
    run_until(20);
    forget();
    run_until(320);
    CHECK_NEAR(part_of(slow), 1.0 / 7, 0.1 / 7);
    CHECK_NEAR(part_of(quick), 2.0 / 7, 0.1 * 2 / 7);
    CHECK_NEAR(part_of(mixed), 4.0 / 7, 0.1 * 4 / 7);
    CHECK(atomic_load(&mixed->share.blocks_done) > 0);
  }
}

/* Equal weights, and one has ten times as many blocks waiting. */
static void numbers_of_blocks_do_not_count(void)
{
  begin(2);
  struct submitter *many = add(1, 0.01, 0.02, 100);
  struct submitter *few = add(1, 0.05, 0.15, 4);
  run_until(100);
  CHECK_NEAR(part_of(many), 0.5, 0.01);
  CHECK_NEAR(part_of(few), 0.5, 0.01);
}

static void a_rest_earns_nothing_and_costs_nothing(void)
{
  begin(4);
  struct submitter *steady = add(1, 0.02, 0.03, 12);
  struct submitter *rests = add(1, 0.02, 0.03, 12);
  run_until(10);
  rests->off = true;
  run_until(110);
  rests->off = false;
  forget();
  run_until(110.5); /* two worker seconds: half of them, less the credit */
  CHECK(steady->got_s > (2 - 4 * MO_FAIR_CREDIT_S) / 2 - 0.2);
  CHECK(rests->got_s > 0.8);
  forget();
  run_until(130);
  CHECK_NEAR(part_of(rests), 0.5, 0.02);
}

/* Gaps of 0.1 s every half second, longer than those between the steps of a training. */
static void short_gaps_cost_nothing(void)
{
  begin(4);
  struct submitter *steady = add(1, 0.02, 0.03, 12);
  struct submitter *gaps = add(1, 0.005, 0.01, 5);
  for (int i = 0; i < 200; i++) {
    gaps->off = false;
    run_until(0.5 * i + 0.4);
    gaps->off = true;
    run_until(0.5 * i + 0.5);
  }
  CHECK_NEAR(part_of(gaps), 0.5, 0.02);
  CHECK_NEAR(part_of(steady), 0.5, 0.02);
}

/* A share with almost all of the weight submits one block at a time for a long while, then another
 * share joins: the unused time has not accumulated. */
static void what_cannot_be_used_is_not_saved_up(void)
{
  begin(4);
  struct submitter *one = add(1000, 0.02, 0.03, 1);
  struct submitter *many = add(1, 0.02, 0.03, 12);
  run_until(100);
  CHECK(one->got_s > 90 && many->got_s > 290);
  struct submitter *late = add(1, 0.02, 0.03, 12);
  forget();
  run_until(102);
  CHECK(many->got_s > 2.4 && late->got_s > 2.4);
  one->depth = 12;
  forget();
  run_until(104);
  CHECK(one->got_s > 7);
  one->off = true;
  forget();
  run_until(106);
  CHECK(many->got_s > 3.2 && late->got_s > 3.2);
}

static void a_new_weight_counts_from_now_on(void)
{
  begin(2);
  struct submitter *a = add(0.001, 0.02, 0.03, 6);
  struct submitter *b = add(1, 0.02, 0.03, 6);
  run_until(60);
  CHECK(a->got_s > 0.04 && a->got_s < 1);
  mo_fair_set_weight(&world.fair, &a->share, 3);
  forget();
  run_until(70); /* a's old debt is at most one block */
  CHECK_NEAR(part_of(a), 0.75, 0.03);
  mo_fair_set_weight(&world.fair, &b->share, 3e9);
  mo_fair_set_weight(&world.fair, &a->share, NAN);
  CHECK(b->share.weight == MO_SHARE_WEIGHT_MAX && a->share.weight == MO_SHARE_WEIGHT_MIN);
  mo_fair_set_weight(&world.fair, &b->share, 1);
  mo_fair_set_weight(&world.fair, &a->share, 1);
  forget();
  run_until(90);
  CHECK_NEAR(part_of(a), 0.5, 0.03);
}

/* While costs are unknown, workers that become free at the same time take different shares; ties go
 * in order of creation. */
static void estimates_spread_the_workers(void)
{
  begin(3);
  struct mo_fair_charge charge;
  add(1, 1, 1, 4);
  add(1, 1, 1, 4);
  add(1, 1, 1, 4);
  for (int k = 0; k < 3; k++)
    for (int i = 0; i < 4; i++)
      submit(&world.submitters[k]);
  for (int k = 0; k < 3; k++) {
    REQUIRE(mo_fair_take(&world.fair, &charge, NULL, NULL) != NULL);
    CHECK(charge.share == &world.submitters[k].share);
  }
  CHECK_INT(atomic_load(&world.fair.waiting), 9);
  CHECK_INT(atomic_load(&world.submitters[0].share.queue.n), 3);
}

static void first_in_first_out_and_removal(void)
{
  begin(1);
  struct mo_fair_charge charge;
  struct mo_block blocks[3] = {{.tag = 0}, {.tag = 1}, {.tag = 2}};
  struct submitter *a = add(1, 1, 1, 0), *b = add(1, 1, 1, 0), *c = add(1, 1, 1, 0);
  mo_fair_remove(&world.fair, &b->share);
  for (int i = 0; i < 3; i++)
    mo_fair_push(&world.fair, &c->share, &blocks[i]);
  for (int i = 0; i < 3; i++) {
    struct mo_block *block = mo_fair_take(&world.fair, &charge, NULL, NULL);
    REQUIRE(block != NULL && charge.share == &c->share);
    CHECK_INT(block->tag, i);
    mo_fair_correct(&world.fair, &charge, 0, false);
  }
  CHECK(mo_fair_take(&world.fair, &charge, NULL, NULL) == NULL);
  mo_fair_remove(&world.fair, &c->share);
  mo_fair_remove(&world.fair, &a->share);
  CHECK(world.fair.shares == NULL);
}

static const struct check_case cases[] = {
    {"by weight, regardless of cost", by_weight_whatever_blocks_cost},
    {"numbers of blocks do not count", numbers_of_blocks_do_not_count},
    {"a rest earns nothing and costs nothing", a_rest_earns_nothing_and_costs_nothing},
    {"short gaps cost nothing", short_gaps_cost_nothing},
    {"unused time does not accumulate", what_cannot_be_used_is_not_saved_up},
    {"a new weight counts at once", a_new_weight_counts_from_now_on},
    {"estimates spread the workers", estimates_spread_the_workers},
    {"first in, first out, and removal", first_in_first_out_and_removal},
};
CHECK_MAIN(cases)
