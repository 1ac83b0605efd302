/* key.c: see key.h. */
#include "atlas/key.h"

#include "morphospace/bits.h"

void mo_atlas_sets_fill(struct mo_workspace workspace, struct mo_atlas_sets *sets)
{
  sets->voxels = mo_workspace_voxels(workspace);
  for (uint32_t v = 0; v <= MO_ATLAS_WORKSPACE_MAX; v++)
    for (uint32_t n = 0; n <= MO_ATLAS_VOXELS_MAX; n++)
      sets->of[v][n] = n == 0 ? 1 : v == 0 ? 0 : sets->of[v - 1][n] + sets->of[v - 1][n - 1];
}

/* Counts from the end: a later set has, at the first place i where it differs, a larger index, and
 * then any set of larger ones. */
uint64_t mo_atlas_key_of(const struct mo_atlas_sets *sets, const uint32_t *voxels, uint32_t n)
{
  uint64_t later = 0;
  for (uint32_t i = 0; i < n; i++)
    later += sets->of[sets->voxels - 1 - voxels[i]][n - i];
  return sets->of[sets->voxels][n] - 1 - later;
}

void mo_atlas_key_voxels(const struct mo_atlas_sets *sets, uint64_t key, uint32_t n,
                         uint32_t *voxels)
{
  uint64_t later = sets->of[sets->voxels][n] - 1 - key;
  uint32_t left = sets->voxels; /* indices after the previous one */
  for (uint32_t i = 0; i < n; i++) {
    do
      left--;
    while (sets->of[left][n - i] > later);
    voxels[i] = sets->voxels - 1 - left;
    later -= sets->of[left][n - i];
  }
}

uint32_t mo_atlas_voxels_of(struct mo_workspace workspace, const uint64_t *bits,
                            uint32_t voxels[MO_ATLAS_VOXELS_MAX])
{
  const uint32_t words = mo_workspace_words(workspace);
  uint32_t n = 0;
  for (uint32_t w = 0; w < words; w++)
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      if (n < MO_ATLAS_VOXELS_MAX)
        voxels[n] = w * 64 + (uint32_t)__builtin_ctzll(rest);
      n++;
    }
  return n;
}

void mo_atlas_bits_of(struct mo_workspace workspace, const uint32_t *voxels, uint32_t n,
                      uint64_t *bits)
{
  memset(bits, 0, mo_workspace_words(workspace) * sizeof(uint64_t));
  for (uint32_t i = 0; i < n; i++)
    mo_bits_set(bits, voxels[i]);
}

void mo_atlas_sort(uint64_t *items, uint64_t *scratch, size_t n, unsigned bytes)
{
  uint64_t *from = items, *to = scratch;
  for (unsigned byte = 0; byte < bytes; byte++) {
    size_t begins[256] = {0};
    size_t begin = 0;
    for (size_t i = 0; i < n; i++)
      begins[from[i] >> 8 * byte & 255]++;
    for (size_t value = 0; value < 256; value++) {
      const size_t count = begins[value];
      begins[value] = begin;
      begin += count;
    }
    for (size_t i = 0; i < n; i++)
      to[begins[from[i] >> 8 * byte & 255]++] = from[i];
    uint64_t *const sorted = to;
    to = from;
    from = sorted;
  }
  if (from != items && n > 0)
    memcpy(items, from, n * sizeof(*items));
}
