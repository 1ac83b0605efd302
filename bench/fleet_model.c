/* fleet_model.c: a daemon with up to 10,000 cores of workers, as a simulation of events.
 *
 * Sessions and leases are the real code of src/fleet, on a clock that jumps from event to event.
 * Hosts, the network and the rest of the daemon are a few numbers: measured rates and costs
 * (docs/fleet.md). The daemon serves exchanges on several threads; a single thread then stores the
 * results. Prints the throughput of the cores and the load of both stages.
 *
 * With `forecast WORKERS CORES RATE ROLLOUTS`, prints the seconds in which this many new workers
 * with one thread each, which share this many cores of that rate, compute one evaluation
 * (fleet_workers.py). */
#include "../tests/unit/fleet/fake.h"

#include "bench.h"
#include "fleet/sessions.h"

#define HOST_CORES     50
#define ROLLOUTS_PER_S 320.0 /* of a core, 1000 steps */
#define BODY_ROWS      10    /* the paper's test set */
#define GENERATION     8192
#define LATENCY_NS     200000 /* one way */
#define API_THREADS    8
#define EXCHANGE_NS    60000    /* of one thread: HTTP, TLS, digests */
#define TAKE_NS        450      /* the same, per rollout */
#define EVALUATION_NS  970      /* of the storing thread, per rollout of an evaluation */
#define COMMIT_NS      1400     /* the same, of a campaign's generation */
#define GAP_NS         55000000 /* from the last score of a generation to the next blocks */
#define TICK_NS        20000000

struct event {
  uint64_t ns;
  int host; /* −1: a tick; −2 − n: campaign n begins a generation */
  bool is_wake;
};

struct host {
  uint64_t session, free_ns; /* free: when its cores will have computed everything that it holds */
  struct {
    struct mo_lease_id id;
    uint32_t rows;
    uint64_t ready_ns;
  } held[8];
  uint32_t n_held;
  bool is_asked; /* an exchange is in flight */
};

struct model {
  struct fake *fake;
  struct host *hosts;
  struct event *heap;
  size_t n_events, capacity;
  uint32_t n_hosts, cores, campaigns; /* campaigns 0: endless evaluations */
  double host_rate;                   /* rollouts per second */
  bool is_finite;                     /* one evaluation, which exists from the start */
  uint64_t api_free_ns[API_THREADS], store_free_ns, api_ns, submitted;
};

/* ---- events ---- */

static void push(struct model *model, struct event event)
{
  if (model->n_events == model->capacity) {
    model->capacity = 2 * model->capacity + 64;
    model->heap = realloc(model->heap, model->capacity * sizeof(*model->heap));
    make_check(model->heap != NULL ? MO_OK : MO_ERR_NO_MEMORY, "events");
  }
  size_t at = model->n_events++;
  for (; at > 0 && model->heap[(at - 1) / 2].ns > event.ns; at = (at - 1) / 2)
    model->heap[at] = model->heap[(at - 1) / 2];
  model->heap[at] = event;
}

static struct event pop(struct model *model)
{
  const struct event first = model->heap[0], last = model->heap[--model->n_events];
  size_t at = 0;
  for (size_t child = 1; child < model->n_events; child = 2 * at + 1) {
    if (child + 1 < model->n_events && model->heap[child + 1].ns < model->heap[child].ns)
      child++;
    if (model->heap[child].ns >= last.ns)
      break;
    model->heap[at] = model->heap[child];
    at = child;
  }
  model->heap[at] = last;
  return first;
}

/* ---- the daemon ---- */

static void submit(struct model *model, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++)
    fake_submit(model->fake, model->submitted++)->block.n_environments = BODY_ROWS;
}

static uint64_t store_cost_ns(const struct model *model)
{
  return model->campaigns > 0 ? COMMIT_NS : EVALUATION_NS;
}

/* Returns the number of rows that were delivered but are not stored yet. */
static uint64_t unstored(const struct model *model)
{
  const uint64_t now_ns = model->fake->now_ns;
  return model->store_free_ns > now_ns ? (model->store_free_ns - now_ns) / store_cost_ns(model) : 0;
}

/* Passes the rows that were delivered since then to the storing thread. */
static void store(struct model *model, uint64_t rows)
{
  struct fake *fake = model->fake;
  const uint64_t begin = model->store_free_ns > fake->now_ns ? model->store_free_ns : fake->now_ns;
  model->store_free_ns = begin + rows * store_cost_ns(model);
}

/* Evaluations keep the wanted number of blocks in flight, minus those that wait to be stored. */
static void refill(struct model *model)
{
  struct fake *fake = model->fake;
  if (model->campaigns > 0 || model->is_finite)
    return;
  const uint64_t there = fake->n_waiting + fake->n_taken + unstored(model) / BODY_ROWS;
  if (there < fake->wanted)
    submit(model, (uint32_t)(fake->wanted - there));
}

/* Campaigns are alike and in step: a generation ends when all its rows were delivered. */
static void end_generation(struct model *model)
{
  struct fake *fake = model->fake;
  if (model->campaigns == 0 || fake->n_waiting + fake->n_taken > 0)
    return;
  /* The next generation begins while this one is being committed, but not before the previous one
   * has been committed.
   */
  const uint64_t begin = fake->now_ns + GAP_NS;
  const uint64_t cost = (uint64_t)GENERATION * BODY_ROWS * model->campaigns * COMMIT_NS;
  push(model,
       (struct event){begin > model->store_free_ns - cost ? begin : model->store_free_ns - cost, -2,
                      false});
}

/* Sends finished results to the daemon, which serves them when a thread is free. */
static void exchange(struct model *model, int number)
{
  struct host *host = &model->hosts[number];
  struct fake *fake = model->fake;
  struct mo_wire_results results = {0};
  struct mo_wire_leases leases;
  uint32_t thread = 0, rows = 0;
  for (uint32_t i = host->n_held; i-- > 0;) {
    if (host->held[i].ready_ns > fake->now_ns)
      continue;
    struct mo_wire_result *result = &results.items[results.n++];
    *result = (struct mo_wire_result){.id = host->held[i].id, .n_rows = host->held[i].rows};
    result->losses = calloc(result->n_rows, sizeof(*result->losses));
    result->diverged_steps = calloc(result->n_rows, sizeof(*result->diverged_steps));
    rows += result->n_rows;
    host->held[i] = host->held[--host->n_held];
  }
  for (uint32_t i = 1; i < API_THREADS; i++)
    thread = model->api_free_ns[i] < model->api_free_ns[thread] ? i : thread;
  const uint64_t now_ns = fake->now_ns, cost = EXCHANGE_NS + (uint64_t)rows * TAKE_NS;
  uint64_t *free_ns = &model->api_free_ns[thread];
  *free_ns = (*free_ns > now_ns + LATENCY_NS ? *free_ns : now_ns + LATENCY_NS) + cost;
  model->api_ns += cost;
  const uint64_t before = fake->rows_done;
  make_check(fake_exchange(fake, host->session, &results, &leases), "an exchange");
  store(model, fake->rows_done - before);
  const uint64_t there_ns = *free_ns + LATENCY_NS;
  for (uint32_t i = 0; i < leases.n; i++) {
    host->free_ns = (host->free_ns > there_ns ? host->free_ns : there_ns) +
                    (uint64_t)(1e9 * leases.items[i].n_rows / model->host_rate);
    host->held[host->n_held].id = leases.items[i].id;
    host->held[host->n_held].rows = leases.items[i].n_rows;
    host->held[host->n_held++].ready_ns = host->free_ns;
    push(model, (struct event){host->free_ns, number, false});
  }
  mo_wire_free_leases(&leases);
  refill(model);
  if (rows > 0)
    end_generation(model);
}

/* Sessions that were woken send their requests again. */
static void follow_wakes(struct model *model, uint32_t before)
{
  struct fake *fake = model->fake;
  for (uint32_t i = before; i < fake->n_wakes; i++)
    for (uint32_t h = 0; h < model->n_hosts; h++)
      if (model->hosts[h].session == fake->woken[i % COUNT(fake->woken)] &&
          fake->n_wakes - i <= COUNT(fake->woken))
        push(model, (struct event){fake->now_ns + EXCHANGE_NS, (int)h, true});
}

static void handle(struct model *model, const struct event *event)
{
  struct fake *fake = model->fake;
  const uint32_t wakes = fake->n_wakes;
  if (event->host >= 0) {
    exchange(model, event->host);
  } else if (event->host == -1) {
    struct mo_fleet_orders orders;
    for (uint32_t h = 0; h < model->n_hosts; h++)
      mo_fleet_orders(fake->fleet, model->hosts[h].session, fake->now_ns, &orders);
    mo_fleet_tick(fake->fleet, fake->now_ns);
    refill(model);
    push(model, (struct event){event->ns + TICK_NS, -1, false});
  } else {
    submit(model, GENERATION * model->campaigns);
    mo_fleet_tick(fake->fleet, fake->now_ns);
  }
  follow_wakes(model, wakes);
}

static struct model *make_model(uint32_t n_hosts, uint32_t threads, double host_rate)
{
  struct model *model = make_zeros(1, sizeof(*model));
  struct fake *fake = model->fake = make_fake(1);
  fake->frees_done = true;
  model->n_hosts = n_hosts;
  model->host_rate = host_rate;
  model->hosts = make_zeros(n_hosts, sizeof(*model->hosts));
  for (uint32_t h = 0; h < n_hosts; h++) {
    char name[16];
    snprintf(name, sizeof(name), "host %u", h);
    struct mo_fleet_offer offer = fake_offer(name, name);
    offer.n_threads = threads;
    model->hosts[h].session = (uint64_t)mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
    push(model, (struct event){fake->now_ns, (int)h, false});
  }
  push(model, (struct event){fake->now_ns, -1, false});
  return model;
}

/* ---- the forecast of a measured run ---- */

static int forecast(char **argv)
{
  const uint32_t workers = (uint32_t)strtoul(argv[0], NULL, 10);
  const double cores = strtod(argv[1], NULL), rate = strtod(argv[2], NULL);
  const uint32_t rollouts = (uint32_t)strtoul(argv[3], NULL, 10);
  if (workers < 1 || workers > 100 || !(cores > 0) || !(rate > 0) || rollouts < BODY_ROWS)
    return 2;
  struct model *model = make_model(workers, 1, rate * (cores < workers ? cores / workers : 1));
  struct fake *fake = model->fake;
  const uint64_t begin_ns = fake->now_ns;
  model->is_finite = true;
  submit(model, rollouts / BODY_ROWS);
  while (fake->n_waiting + fake->n_taken > 0) {
    const struct event event = pop(model);
    fake->now_ns = event.ns > fake->now_ns ? event.ns : fake->now_ns;
    handle(model, &event);
  }
  printf("%.3f\n", 1e-9 * (double)(fake->now_ns - begin_ns));
  free(model->heap);
  check_drop_to(0);
  return 0;
}

/* ---- the table ---- */

static void simulate(uint32_t cores, uint32_t campaigns, double seconds)
{
  const uint32_t threads = cores < HOST_CORES ? cores : HOST_CORES;
  struct model *model =
      make_model(cores > HOST_CORES ? cores / HOST_CORES : 1, threads, ROLLOUTS_PER_S * threads);
  struct fake *fake = model->fake;
  model->cores = cores;
  model->campaigns = campaigns;
  /* Sessions are trusted already: audits of the first 500 leases would cost a tenth. */
  for (uint32_t h = 0; h < model->n_hosts; h++)
    mo_session_find(fake->fleet, model->hosts[h].session)->leases_done = 501;
  if (campaigns > 0)
    push(model, (struct event){fake->now_ns, -2, false});
  /* The first fifth of the time is left out: rates are still being found. */
  const uint64_t begin_ns = fake->now_ns + (uint64_t)(2e8 * seconds);
  const uint64_t end_ns = fake->now_ns + (uint64_t)(1e9 * seconds);
  uint64_t rows = 0, api_ns = 0, leases = 0;
  bool has_begun = false;
  while (model->heap[0].ns < end_ns) {
    const struct event event = pop(model);
    fake->now_ns = event.ns > fake->now_ns ? event.ns : fake->now_ns;
    if (!has_begun && fake->now_ns >= begin_ns) {
      has_begun = true;
      rows = fake->rows_done - unstored(model);
      api_ns = model->api_ns;
      leases = fake->fleet->counts.leases_done;
    }
    handle(model, &event);
  }
  const double s = 0.8 * seconds, rate = (double)(fake->rows_done - unstored(model) - rows) / s;
  leases = fake->fleet->counts.leases_done - leases;
  printf("%8u %6u %10u %12.0f %9.1f %% %9.1f %% %9.1f %% %10.0f\n", cores, model->n_hosts,
         campaigns, rate, 100 * rate / (ROLLOUTS_PER_S * cores),
         1e-7 * rate * (double)store_cost_ns(model),
         1e-7 * (double)(model->api_ns - api_ns) / s / API_THREADS,
         leases > 0 ? rate * s / (double)leases : 0.0);
  fflush(stdout);
  free(model->heap);
  check_drop_to(0);
}

int bench_fleet_model(int argc, char **argv)
{
  const uint32_t cores[] = {10, 100, 1000, 2000, 3000, 5000, 10000};
  const uint32_t campaigns[] = {0, 1, 4};
  if (argc == 6 && strcmp(argv[1], "forecast") == 0)
    return forecast(argv + 2);
  const bool is_quick = argc > 1 && strcmp(argv[1], "--quick") == 0;
  printf("   cores  hosts  campaigns   rollouts/s   of cores   storing   exchanges  rows/lease\n");
  for (size_t k = 0; k < COUNT(campaigns); k++)
    for (size_t c = 0; c < COUNT(cores); c++)
      if (!is_quick || cores[c] <= 1000)
        simulate(cores[c], campaigns[k], is_quick ? 5 : 20);
  return 0;
}
