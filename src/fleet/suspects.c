/* suspects.c: see suspects.h. A table of fixed size: in a full set the entry with the fewest losses
 * gives way, so that what ends sessions again and again stays. */
#include "fleet/suspects.h"

#include <stdlib.h>
#include <string.h>

#define SETS    4096
#define WAYS    4
#define PATIENT 3 /* lost sessions that are taken for chance; workers that prove a body */

struct suspect {
  uint64_t hash, session;  /* session: the last that was lost */
  uint64_t alone[PATIENT]; /* workers that were lost with this body only */
  uint32_t lost, lost_alone, n_alone, limit;
};
struct mo_suspects {
  uint32_t n;
  struct suspect sets[SETS][WAYS];
};

struct mo_suspects *mo_suspects_create(void)
{
  return calloc(1, sizeof(struct mo_suspects));
}

void mo_suspects_free(struct mo_suspects *suspects)
{
  free(suspects);
}

/* Never 0, which marks an empty entry. */
static uint64_t hash_of(const struct mo_wire_block *block)
{
  uint64_t hash = 1;
  for (uint32_t w = 0; w < MO_WIRE_WORDS_MAX; w++) {
    hash = (hash ^ block->genotype[w]) * UINT64_C(0x9e3779b97f4a7c15);
    hash ^= hash >> 29;
  }
  return hash != 0 ? hash : 1;
}

static struct suspect *find(const struct mo_suspects *suspects, uint64_t hash)
{
  const struct suspect *set = suspects->sets[hash % SETS];
  for (uint32_t i = 0; i < WAYS; i++)
    if (set[i].hash == hash)
      return (struct suspect *)&set[i];
  return NULL;
}

static struct suspect *find_or_add(struct mo_suspects *suspects, uint64_t hash)
{
  struct suspect *found = find(suspects, hash), *set = suspects->sets[hash % SETS];
  if (found != NULL)
    return found;
  found = &set[0];
  for (uint32_t i = 1; i < WAYS; i++)
    if (set[i].lost < found->lost)
      found = &set[i];
  suspects->n += found->hash == 0;
  *found = (struct suspect){.hash = hash, .limit = UINT32_MAX};
  return found;
}

/* A worker counts once, however often it joins. */
static void add_alone(struct suspect *suspect, uint64_t worker)
{
  for (uint32_t i = 0; i < suspect->n_alone; i++)
    if (suspect->alone[i] == worker)
      return;
  if (suspect->n_alone < PATIENT)
    suspect->alone[suspect->n_alone++] = worker;
}

bool mo_suspects_add(struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                     uint64_t session, uint64_t worker, bool is_only, bool *is_kept)
{
  bool is_proven = false, is_stubborn = false;
  for (uint32_t b = 0; b < lease->n_blocks; b++) {
    struct suspect *suspect = find_or_add(suspects, hash_of(&lease->blocks[b]));
    if (suspect->session == session)
      continue;
    suspect->session = session;
    suspect->lost++;
    if (is_only && lease->n_blocks == 1) {
      suspect->lost_alone++;
      add_alone(suspect, worker);
    }
    if (suspect->lost >= PATIENT)
      suspect->limit = lease->n_blocks > 1 ? lease->n_blocks / 2 : 1;
    is_proven = suspect->n_alone == PATIENT;
    is_stubborn = suspect->lost_alone >= 2 * PATIENT;
  }
  is_proven &= lease->n_blocks == 1;
  *is_kept = is_stubborn && !is_proven && lease->n_blocks == 1;
  return is_proven;
}

uint32_t mo_suspects_limit(const struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                           bool *is_suspect)
{
  uint32_t limit = UINT32_MAX;
  *is_suspect = false;
  for (uint32_t b = 0; b < lease->n_blocks && suspects->n > 0; b++) {
    const struct suspect *suspect = find(suspects, hash_of(&lease->blocks[b]));
    if (suspect == NULL)
      continue;
    *is_suspect = true;
    limit = suspect->limit < limit ? suspect->limit : limit;
  }
  return limit;
}

void mo_suspects_clear(struct mo_suspects *suspects, const struct mo_wire_lease *lease)
{
  for (uint32_t b = 0; b < lease->n_blocks && suspects->n > 0; b++) {
    struct suspect *suspect = find(suspects, hash_of(&lease->blocks[b]));
    if (suspect == NULL)
      continue;
    *suspect = (struct suspect){0};
    suspects->n--;
  }
}
