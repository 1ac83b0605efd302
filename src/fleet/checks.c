/* checks.c: see checks.h. */
#include "fleet/checks.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fleet/content.h"
#include "store/scores.h"

#define NEW_LEASES     500 /* number of results after which a session is audited less often */
#define AUDITS_NEW     10  /* one lease in this many is audited */
#define AUDITS_TRUSTED 200
/* Time that an audit waits for a session with a different name and host. */
#define CHOOSY_NS (2 * MO_S_NS)

/* ---- votes ---- */

/* Takes 10 ms for a gradient. */
static struct mo_sha256 sum_of(const struct mo_wire_result *result)
{
  struct mo_sha256 hashes[2] = {{{0}}}, hash = {{0}};
  if (result->n_parameters == 0)
    return hash;
  mo_sha256_of(result->d_parameters, result->n_parameters * sizeof(double), &hashes[0]);
  mo_sha256_of(&result->counts, sizeof(result->counts), &hashes[1]);
  mo_sha256_of(hashes, sizeof(hashes), &hash);
  return hash;
}

/* Returns the vote of a session. Its arrays belong to the result. */
static struct mo_vote vote_of(const struct mo_session *session, const struct mo_wire_result *result)
{
  struct mo_vote vote = {.session = session->id,
                         .losses = result->losses,
                         .diverged_steps = result->diverged_steps,
                         .measures = result->measures,
                         .sum = sum_of(result)};
  memcpy(vote.name, session->offer.name, sizeof(vote.name));
  memcpy(vote.host, session->offer.host, sizeof(vote.host));
  return vote;
}

/* Copies a vote with its arrays. */
static bool add_vote(struct mo_lease *lease, const struct mo_vote *vote)
{
  const size_t n = lease->content.n_rows;
  struct mo_vote *copy = &lease->votes[lease->n_votes];
  double *losses = malloc(n * sizeof(*losses));
  uint32_t *diverged_steps = malloc(n * sizeof(*diverged_steps));
  double(*measures)[MO_MEASURES] = vote->measures != NULL ? malloc(n * sizeof(*measures)) : NULL;
  if (losses == NULL || diverged_steps == NULL || (vote->measures != NULL && measures == NULL)) {
    free(losses);
    free(diverged_steps);
    free(measures);
    return false;
  }
  *copy = *vote;
  copy->losses = memcpy(losses, vote->losses, n * sizeof(*losses));
  copy->diverged_steps = memcpy(diverged_steps, vote->diverged_steps, n * sizeof(*diverged_steps));
  copy->measures = measures;
  if (measures != NULL)
    memcpy(measures, vote->measures, n * sizeof(*measures));
  lease->n_votes++;
  return true;
}

/* Returns the first measure of a row that differs, or MO_MEASURES. Either both votes on a lease
 * have measures, or neither has. */
static unsigned different_measure(const struct mo_vote *a, const struct mo_vote *b, uint32_t row)
{
  unsigned m = 0;
  if (a->measures == NULL || b->measures == NULL)
    return MO_MEASURES;
  while (m < MO_MEASURES && ((isnan(a->measures[row][m]) && isnan(b->measures[row][m])) ||
                             mo_same_bits(a->measures[row][m], b->measures[row][m])))
    m++;
  return m;
}

/* Returns the first row that differs, or n. Returns 0 for gradients that differ only in their
 * sums. */
static uint32_t first_difference(const struct mo_vote *a, const struct mo_vote *b, uint32_t n)
{
  uint32_t row = 0;
  while (row < n && mo_same_bits(a->losses[row], b->losses[row]) &&
         a->diverged_steps[row] == b->diverged_steps[row] &&
         different_measure(a, b, row) == MO_MEASURES)
    row++;
  return row == n && !mo_sha256_equal(&a->sum, &b->sum) ? 0 : row;
}

/* Keeps n blocks, starting with `first`, and their rows of the votes. */
static void cut(struct mo_lease *lease, uint32_t first, uint32_t n)
{
  const uint32_t row = mo_content_cut(&lease->content, first, n), rows = lease->content.n_rows;
  lease->steps = (uint64_t)rows * lease->content.physics.scheme.n_steps;
  for (uint32_t i = 0; i < lease->n_votes; i++) {
    struct mo_vote *vote = &lease->votes[i];
    memmove(vote->losses, vote->losses + row, rows * sizeof(*vote->losses));
    memmove(vote->diverged_steps, vote->diverged_steps + row, rows * sizeof(*vote->diverged_steps));
    if (vote->measures != NULL)
      memmove(vote->measures, vote->measures + row, rows * sizeof(*vote->measures));
  }
}

void mo_check_fit(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t max_steps)
{
  const uint32_t n_blocks = lease->content.n_blocks;
  if (lease->is_disputed || lease->content.n_parameters > 0 || lease->steps <= max_steps ||
      n_blocks == 1)
    return;
  const uint64_t fitting = max_steps * n_blocks / lease->steps;
  const uint32_t n = fitting > 1 ? (uint32_t)fitting : 1;
  struct mo_random random;
  mo_random_init(&random, fleet->config.seed, MO_PURPOSE_AUDIT, 1, lease->number);
  cut(lease, mo_random_below(&random, n_blocks - n + 1), n);
  mo_lease_renumber(fleet, lease);
}

bool mo_check_suits(const struct mo_lease *lease, const struct mo_session *session, uint64_t now_ns)
{
  const struct mo_vote *vote = &lease->votes[0];
  if (lease->n_votes == 0)
    return true;
  if (vote->session == session->id)
    return false;
  return now_ns >= lease->listed_ns + CHOOSY_NS || (strcmp(vote->name, session->offer.name) != 0 &&
                                                    strcmp(vote->host, session->offer.host) != 0);
}

/* ---- beginning ---- */

/* The choice depends only on the lease number, which a session cannot influence. */
static bool is_drawn(const struct mo_fleet *fleet, const struct mo_lease *lease,
                     const struct mo_session *session)
{
  struct mo_random random;
  mo_random_init(&random, fleet->config.seed, MO_PURPOSE_AUDIT, 0, lease->number);
  return mo_random_below(&random,
                         session->leases_done <= NEW_LEASES ? AUDITS_NEW : AUDITS_TRUSTED) == 0;
}

void mo_check_begin(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                    const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after)
{
  const struct mo_class *class = &fleet->classes[lease->content.back_end];
  lease->is_audit =
      class->n_sessions >= 2 && fleet->n_checks < MO_CHECKS_MAX && is_drawn(fleet, lease, session);
  fleet->n_checks += lease->is_audit;
  bool is_checked = lease->n_holds > 0 || lease->is_audit;
  if (is_checked) {
    const struct mo_vote vote = vote_of(session, result);
    is_checked = add_vote(lease, &vote);
  }
  if (!is_checked) {
    mo_lease_end(fleet, lease, after);
    return;
  }
  for (uint32_t i = 0; i < lease->n_holds; i++)
    mo_lease_drop(lease, lease->holds[i].session, after);
  if (lease->n_holds == 0)
    mo_lease_list(fleet, lease, now_ns, after);
}

/* ---- comparing ---- */

static void count(struct mo_fleet *fleet, uint64_t id, bool has_failed)
{
  struct mo_session *session = mo_session_find(fleet, id);
  if (session == NULL)
    return;
  session->audits++;
  session->audits_failed += has_failed;
}

/* m: a measure that differs; MO_MEASURES: no measure differs. */
static void describe(struct mo_text *text, const struct mo_vote *vote, uint32_t row, unsigned m)
{
  mo_event_session(text, vote->name, vote->host, "");
  mo_text_member_number(text, "loss", vote->losses[row]);
  mo_text_member_count(text, "diverged_step", vote->diverged_steps[row]);
  if (m < MO_MEASURES)
    mo_text_member_number(text, mo_measure_info[m].name, vote->measures[row][m]);
  mo_text_add(text, "}");
}

static void note_difference(const struct mo_fleet *fleet, const struct mo_lease *lease,
                            const struct mo_vote *second, uint32_t row, struct mo_after *after)
{
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_event_member(&text, "class", fleet->config.classes[lease->content.back_end].scores,
                  MO_EVENT_NAME_BYTES);
  mo_text_name(&text, "results");
  mo_text_add(&text, "[");
  const unsigned m = different_measure(&lease->votes[0], second, row);
  describe(&text, &lease->votes[0], row, m);
  describe(&text, second, row, m);
  mo_text_add(&text, "]");
  mo_after_event(after, "fleet.differs", &text);
}

/* Refuses the session of a vote if it differs from another one. */
static bool judge(struct mo_fleet *fleet, const struct mo_lease *lease, const struct mo_vote *vote,
                  const struct mo_vote *other, uint64_t now_ns, struct mo_after *after)
{
  const uint32_t rows = lease->content.n_rows, row = first_difference(vote, other, rows);
  unsigned m;
  char why[128];
  count(fleet, vote->session, row < rows);
  if (row == rows)
    return true;
  if (lease->content.n_parameters > 0)
    snprintf(why, sizeof(why),
             "returned a different gradient of %" PRIu32 " robots than another worker", rows);
  else if ((m = different_measure(vote, other, row)) < MO_MEASURES &&
           mo_same_bits(vote->losses[row], other->losses[row]))
    snprintf(why, sizeof(why), "returned %s = %.17g where %s %.17g", mo_measure_info[m].name,
             vote->measures[row][m],
             other->session == 0 ? "this machine computed" : "another worker gave",
             other->measures[row][m]);
  else
    snprintf(why, sizeof(why),
             "returned a loss of %.17g (divergence step %" PRIu32 ") where %s %.17g (%" PRIu32 ")",
             vote->losses[row], vote->diverged_steps[row],
             other->session == 0 ? "this machine computed" : "another worker gave",
             other->losses[row], other->diverged_steps[row]);
  mo_session_refuse(fleet, vote->session, vote->name, vote->host, why, now_ns, after);
  return false;
}

static bool can_decide(const struct mo_fleet *fleet, const struct mo_lease *lease)
{
  return fleet->config.source.recompute != NULL && lease->content.n_parameters == 0 &&
         !fleet->config.classes[lease->content.back_end].is_absent;
}

/* Two sessions returned different rows, so this process recomputes the first block that differs. */
static void dispute(struct mo_fleet *fleet, struct mo_lease *lease, uint32_t row, uint64_t now_ns,
                    struct mo_after *after)
{
  uint32_t block = 0;
  while (lease->n_holds > 0) {
    mo_lease_drop(lease, lease->holds[0].session, after);
    mo_lease_unhold(lease, 0);
  }
  for (uint32_t end = lease->content.blocks[0].n_environments; end <= row; block++)
    end += lease->content.blocks[block + 1].n_environments;
  cut(lease, block, 1);
  mo_lease_unlist(fleet, lease);
  mo_lease_renumber(fleet, lease);
  fleet->n_checks += !lease->is_audit;
  lease->is_audit = lease->is_disputed = true;
  mo_lease_list(fleet, lease, now_ns, after);
}

void mo_check_decide(struct mo_fleet *fleet, struct mo_lease *lease, double *losses,
                     uint32_t *diverged_steps, double (*measures)[MO_MEASURES], uint64_t now_ns,
                     struct mo_after *after)
{
  const struct mo_vote ours = {.losses = losses,
                               .diverged_steps = diverged_steps,
                               .measures = lease->content.has_measures ? measures : NULL};
  fleet->counts.rows_twice += lease->content.n_rows;
  fleet->counts.audits++;
  for (uint32_t i = 0; i < lease->n_votes; i++)
    fleet->counts.audits_failed += !judge(fleet, lease, &lease->votes[i], &ours, now_ns, after);
  mo_lease_end(fleet, lease, after);
}

void mo_check_result(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                     const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after)
{
  const struct mo_vote *first = &lease->votes[0], second = vote_of(session, result);
  const uint32_t rows = lease->content.n_rows, row = first_difference(first, &second, rows);
  fleet->counts.rows_twice += rows;
  if (row < rows)
    note_difference(fleet, lease, &second, row, after);
  if (row < rows && can_decide(fleet, lease)) {
    if (add_vote(lease, &second))
      dispute(fleet, lease, row, now_ns, after);
    else
      mo_lease_end(fleet, lease, after);
    return;
  }
  /* Either the bits are the same, or it is not known which ones are wrong. */
  fleet->counts.audits++;
  fleet->counts.audits_failed += row < rows;
  (void)judge(fleet, lease, first, &second, now_ns, after);
  (void)judge(fleet, lease, &second, first, now_ns, after);
  mo_lease_end(fleet, lease, after);
}
