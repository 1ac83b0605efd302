/* suspects.c: see suspects.h. A table of fixed size. In a full set, the entry with the fewest lost
 * sessions is replaced, so that bodies that end sessions repeatedly remain. */
#include "fleet/suspects.h"

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

static struct mo_suspect *find(const struct mo_suspects *suspects, uint64_t hash)
{
  const struct mo_suspect *set = suspects->sets[hash % MO_SUSPECT_SETS];
  for (uint32_t i = 0; i < MO_SUSPECT_WAYS; i++)
    if (set[i].hash == hash)
      return (struct mo_suspect *)&set[i];
  return NULL;
}

static struct mo_suspect *find_or_add(struct mo_suspects *suspects, uint64_t hash)
{
  struct mo_suspect *found = find(suspects, hash), *set = suspects->sets[hash % MO_SUSPECT_SETS];
  if (found != NULL)
    return found;
  found = &set[0];
  for (uint32_t i = 1; i < MO_SUSPECT_WAYS; i++)
    if (set[i].lost < found->lost)
      found = &set[i];
  suspects->n += found->hash == 0;
  *found = (struct mo_suspect){.hash = hash, .limit = UINT32_MAX};
  return found;
}

/* A worker counts once, even if it joins several times. */
static void add_alone(struct mo_suspect *suspect, uint64_t worker)
{
  for (uint32_t i = 0; i < suspect->n_alone; i++)
    if (suspect->alone[i] == worker)
      return;
  if (suspect->n_alone < MO_PATIENT)
    suspect->alone[suspect->n_alone++] = worker;
}

bool mo_suspects_add(struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                     uint64_t session, uint64_t worker, bool is_only, bool *is_kept)
{
  bool is_proven = false, is_stubborn = false;
  for (uint32_t b = 0; b < lease->n_blocks; b++) {
    struct mo_suspect *suspect = find_or_add(suspects, hash_of(&lease->blocks[b]));
    if (suspect->session == session)
      continue;
    suspect->session = session;
    suspect->lost++;
    if (is_only && lease->n_blocks == 1) {
      suspect->lost_alone++;
      add_alone(suspect, worker);
    }
    if (suspect->lost >= MO_PATIENT)
      suspect->limit = lease->n_blocks > 1 ? lease->n_blocks / 2 : 1;
    is_proven = suspect->n_alone == MO_PATIENT;
    is_stubborn = suspect->lost_alone >= 2 * MO_PATIENT;
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
    const struct mo_suspect *suspect = find(suspects, hash_of(&lease->blocks[b]));
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
    struct mo_suspect *suspect = find(suspects, hash_of(&lease->blocks[b]));
    if (suspect == NULL)
      continue;
    *suspect = (struct mo_suspect){0};
    suspects->n--;
  }
}
