/* results.c: see results.h. */
#include "fleet/results.h"

#include "fleet/checks.h"

/* Fraction of the sums of a pace that remains after each message: about ten leases count. */
#define MEMORY       0.9
#define FAILURES_MAX 5  /* failed leases in a row, after which a session gets no more */
#define REFUSALS_MAX 10 /* refused leases in a row after which the rest no longer gets longer */

/* Adds up the results of one message for the pace of a session on one back end. */
struct part {
  uint64_t steps, rows, begun_ns;
};

/* Returns the lease that a result belongs to, if the session holds it. */
static struct mo_lease *held_lease(struct mo_fleet *fleet, const struct mo_session *session,
                                   struct mo_lease_id id, uint32_t *place)
{
  struct mo_lease *lease = id.epoch == fleet->config.epoch ? mo_lease_find(fleet, id.number) : NULL;
  int at = lease != NULL ? mo_lease_held_by(lease, session) : MO_ERR_NOT_FOUND;
  if (at < 0)
    return NULL;
  *place = (uint32_t)at;
  return lease;
}

static int check(struct mo_fleet *fleet, const struct mo_session *session,
                 const struct mo_wire_results *results, struct mo_message *message)
{
  for (uint32_t i = 0; i < results->n; i++) {
    const struct mo_wire_result *result = &results->items[i];
    uint32_t place = 0;
    const struct mo_lease *lease = held_lease(fleet, session, result->id, &place);
    if (lease == NULL || result->state != MO_RESULT_DONE)
      continue;
    if (result->n_rows != lease->content.n_rows)
      return mo_fail(message, MO_ERR_FORMAT, "result %u: the lease has %u rows, got %u", i,
                     lease->content.n_rows, result->n_rows);
    if (result->n_parameters != lease->content.n_parameters)
      return mo_fail(message, MO_ERR_FORMAT, "result %u: the sum has %u parameters, got %u", i,
                     lease->content.n_parameters, result->n_parameters);
    if ((result->measures != NULL) != lease->content.has_measures)
      return mo_fail(message, MO_ERR_FORMAT, "result %u: measures are %s", i,
                     lease->content.has_measures ? "missing" : "unexpected");
    for (uint32_t row = 0; row < result->n_rows; row++)
      if (result->diverged_steps[row] > lease->content.physics.scheme.n_steps)
        return mo_fail(message, MO_ERR_FORMAT,
                       "result %u, row %u: divergence step must be at most %u, got %u", i, row,
                       result->diverged_steps[row], lease->content.physics.scheme.n_steps);
  }
  return MO_OK;
}

/* Returns the time that is charged to a share. This is the time that the worker reports, limited to
 * the time of all its threads and devices since it got the lease. */
static double busy_s_of(const struct mo_session *session, const struct mo_wire_result *result,
                        uint64_t given_ns, uint64_t now_ns)
{
  const double units = (double)session->offer.n_threads + session->offer.n_devices;
  const double most_s = 1e-9 * (double)(now_ns - given_ns) * (units > 1 ? units : 1);
  return now_ns > given_ns && result->busy_s < most_s ? result->busy_s
         : now_ns > given_ns                          ? most_s
                                                      : 0;
}

static void take_rows(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                      const struct mo_wire_result *result, uint64_t given_ns, uint64_t now_ns,
                      struct mo_after *after)
{
  const double busy_s = busy_s_of(session, result, given_ns, now_ns);
  session->leases_done++;
  session->rows_done += result->n_rows;
  session->busy_s += busy_s;
  session->n_failures = session->n_refusals = 0;
  if (lease->parcel == NULL) {
    mo_check_result(fleet, lease, session, result, now_ns, after);
    return;
  }
  fleet->counts.leases_done++;
  fleet->counts.rows_done += result->n_rows;
  if (lease->is_suspect)
    mo_suspects_clear(&fleet->suspects, &lease->content);
  mo_lease_deliver(
      lease,
      &(struct mo_remote_result){.status = MO_OK,
                                 .losses = result->losses,
                                 .diverged = result->diverged_steps,
                                 .measures = (const double(*)[MO_MEASURES])result->measures,
                                 .origin = session->origin,
                                 .busy_s = busy_s,
                                 .d_parameters = result->d_parameters,
                                 .counts = result->counts},
      after);
  mo_check_begin(fleet, lease, session, result, now_ns, after);
}

/* A worker that cannot compute a lease must rest for one second per failure, so that another worker
 * takes the bodies. After several failures it gets no more work. */
static void take_failure(struct mo_fleet *fleet, struct mo_session *session, uint64_t now_ns,
                         struct mo_after *after)
{
  session->rest_ns = now_ns + ++session->n_failures * MO_S_NS;
  if (session->n_failures == FAILURES_MAX)
    mo_session_drain(fleet, session, "failed five leases in a row", after);
}

/* Bodies that a worker cannot compute are computed by this process. A worker that refuses one lease
 * after another would empty the queue, so it must rest for longer each time, but it gets more
 * leases. */
static void take_refusal(struct mo_session *session, uint64_t now_ns)
{
  session->rest_ns = now_ns + session->n_refusals * MO_S_NS;
  session->n_refusals += session->n_refusals < REFUSALS_MAX;
}

/* Measures the pace of a session by this process's clock, from its previous result or from when it
 * got the lease. */
static void keep_pace(struct mo_pace *pace, const struct part *part, uint64_t now_ns)
{
  const uint64_t since_ns = part->begun_ns > pace->result_ns ? part->begun_ns : pace->result_ns;
  const double s = 1e-9 * (double)(now_ns > since_ns ? now_ns - since_ns : 1);
  pace->steps = MEMORY * pace->steps + (double)part->steps;
  pace->rows = MEMORY * pace->rows + (double)part->rows;
  pace->s = MEMORY * pace->s + s;
  pace->result_ns = now_ns;
  pace->lease_steps = part->steps;
}

bool mo_results_count(struct mo_fleet *fleet, const struct mo_session *session,
                      const struct mo_wire_results *results)
{
  uint32_t n = 0, place = 0;
  for (uint32_t i = 0; i < results->n; i++)
    n += results->items[i].state == MO_RESULT_DONE &&
         held_lease(fleet, session, results->items[i].id, &place) != NULL;
  return n > 0 && check(fleet, session, results, NULL) == MO_OK;
}

int mo_results_take(struct mo_fleet *fleet, struct mo_session *session,
                    const struct mo_wire_results *results, uint64_t now_ns, struct mo_after *after,
                    struct mo_message *message)
{
  struct part parts[2] = {{0, 0, UINT64_MAX}, {0, 0, UINT64_MAX}};
  int error = check(fleet, session, results, message);
  if (error != MO_OK)
    return error;
  for (uint32_t i = 0; i < results->n; i++) {
    const struct mo_wire_result *result = &results->items[i];
    uint32_t place = 0;
    struct mo_lease *lease = held_lease(fleet, session, result->id, &place);
    if (lease == NULL) {
      fleet->counts.results_ignored++;
      continue;
    }
    if (result->state != MO_RESULT_DONE) {
      /* The daemon's CPUs can compute blocks that devices cannot. A worker's CPUs can compute all
       * blocks. */
      const bool is_shard = lease->content.n_parameters > 0 && lease->content.back_end == MO_ON_CPU;
      const bool has_failed =
          result->state == MO_RESULT_FAILED || (result->state == MO_RESULT_UNSUPPORTED && is_shard);
      lease->is_kept |= result->state == MO_RESULT_UNSUPPORTED && !is_shard;
      (void)mo_lease_release(fleet, lease, place, has_failed, now_ns, after);
      if (has_failed)
        take_failure(fleet, session, now_ns, after);
      else if (result->state == MO_RESULT_UNSUPPORTED)
        take_refusal(session, now_ns);
      continue;
    }
    struct part *part = &parts[lease->content.back_end];
    const uint64_t given_ns = lease->holds[place].given_ns;
    part->steps += lease->steps;
    part->rows += lease->content.n_rows;
    part->begun_ns = given_ns < part->begun_ns ? given_ns : part->begun_ns;
    mo_lease_unhold(lease, place);
    take_rows(fleet, lease, session, result, given_ns, now_ns, after);
  }
  for (uint32_t b = 0; b < 2; b++)
    if (parts[b].steps > 0)
      keep_pace(&session->pace[b], &parts[b], now_ns);
  return MO_OK;
}
