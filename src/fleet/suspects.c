/* suspects.c: see suspects.h. A table of fixed size: in a full set the entry with the fewest losses
 * gives way, so that what ends sessions again and again stays. */
#include "fleet/suspects.h"

#include <stdlib.h>
#include <string.h>

#define SETS    4096
#define WAYS    4
#define PATIENT 3 /* lost sessions that are taken for chance */

struct suspect {
  uint64_t hash, session; /* session: the last that was lost */
  uint32_t lost, alone, limit;
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

bool mo_suspects_add(struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                     uint64_t session, bool is_only)
{
  bool is_proven = false;
  for (uint32_t b = 0; b < lease->n_blocks; b++) {
    struct suspect *suspect = find_or_add(suspects, hash_of(&lease->blocks[b]));
    if (suspect->session == session)
      continue;
    suspect->session = session;
    suspect->lost++;
    suspect->alone += is_only && lease->n_blocks == 1;
    if (suspect->lost >= PATIENT)
      suspect->limit = lease->n_blocks > 1 ? lease->n_blocks / 2 : 1;
    is_proven = suspect->alone >= PATIENT;
  }
  return is_proven && lease->n_blocks == 1;
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
