/* body.c: the masses, springs and voxels that one genotype expresses.
 *
 * Voxels mark their masses and springs in two bit arrays over the lattice; reading the marks in
 * order yields both lists ascending and without duplicates, and the number of marks below a mass is
 * its position. One allocation holds the body. */
#include <morpho/morphospace.h>

#include "base/memory.h"
#include "morphospace/bits.h"
#include "morphospace/grid.h"

#include <stdlib.h>

struct marks {
  uint64_t *mass;       /* one bit per lattice mass */
  uint64_t *spring;     /* one bit per lattice spring */
  uint32_t *mass_below; /* number of marked masses in the words before this one */
  uint32_t mass_words, spring_words;
};

void mo_body_mark(const struct mo_lattice *lattice, const uint64_t *bits, uint64_t *masses,
                  uint64_t *springs)
{
  uint32_t words = mo_workspace_words(lattice->workspace);
  for (uint32_t w = 0; w < words; w++) {
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      size_t voxel = (size_t)w * 64 + (size_t)__builtin_ctzll(rest);
      for (int i = 0; i < 8; i++)
        mo_bits_set(masses, lattice->voxel_mass[8 * voxel + i]);
      for (int i = 0; i < 24; i++)
        mo_bits_set(springs, lattice->voxel_spring[24 * voxel + i]);
    }
  }
}

static uint32_t position(const struct marks *marks, uint32_t mass)
{
  uint64_t lower = marks->mass[mass >> 6] & ((UINT64_C(1) << (mass & 63)) - 1);
  return marks->mass_below[mass >> 6] + mo_bits_count_word(lower);
}

/* The arrays of a body, widest elements first, after the structure itself. */
struct arrays {
  double *spring_rest_m;
  uint32_t *mass_lattice, *spring_lattice, *spring_a, *spring_b, *voxel_mass;
  uint16_t *mass_xyz;
};

static struct mo_body *allocate(uint32_t n_voxels, uint32_t n_masses, uint32_t n_springs,
                                struct arrays *arrays)
{
  const size_t header = (sizeof(struct mo_body) + MO_CACHE_LINE_BYTES - 1) / MO_CACHE_LINE_BYTES *
                        MO_CACHE_LINE_BYTES;
  size_t bytes = header + n_masses * (sizeof(uint32_t) + 3 * sizeof(uint16_t)) +
                 n_springs * (sizeof(double) + 3 * sizeof(uint32_t)) +
                 (size_t)n_voxels * 8 * sizeof(uint32_t);
  char *memory = mo_alloc_aligned(bytes, 1);
  if (memory == NULL)
    return NULL;
  arrays->spring_rest_m = (double *)(void *)(memory + header);
  arrays->mass_lattice = (uint32_t *)(arrays->spring_rest_m + n_springs);
  arrays->spring_lattice = arrays->mass_lattice + n_masses;
  arrays->spring_a = arrays->spring_lattice + n_springs;
  arrays->spring_b = arrays->spring_a + n_springs;
  arrays->voxel_mass = arrays->spring_b + n_springs;
  arrays->mass_xyz = (uint16_t *)(void *)(arrays->voxel_mass + 8 * (size_t)n_voxels);
  struct mo_body *body = (struct mo_body *)(void *)memory;
  body->n_voxels = n_voxels;
  body->n_masses = n_masses;
  body->n_springs = n_springs;
  body->mass_lattice = arrays->mass_lattice;
  body->mass_xyz = arrays->mass_xyz;
  body->spring_lattice = arrays->spring_lattice;
  body->spring_a = arrays->spring_a;
  body->spring_b = arrays->spring_b;
  body->spring_rest_m = arrays->spring_rest_m;
  body->voxel_mass = arrays->voxel_mass;
  return body;
}

static void fill(const struct mo_lattice *lattice, const uint64_t *bits, const struct marks *marks,
                 struct arrays *arrays)
{
  const uint32_t side_y = lattice->workspace.ny + UINT32_C(1);
  const uint32_t side_z = lattice->workspace.nz + UINT32_C(1);
  uint32_t n = 0;
  for (uint32_t w = 0; w < marks->mass_words; w++) {
    for (uint64_t rest = marks->mass[w]; rest != 0; rest &= rest - 1) {
      uint32_t mass = w * 64 + (uint32_t)__builtin_ctzll(rest);
      arrays->mass_lattice[n] = mass;
      arrays->mass_xyz[3 * (size_t)n] = (uint16_t)(mass / side_z / side_y);
      arrays->mass_xyz[3 * (size_t)n + 1] = (uint16_t)(mass / side_z % side_y);
      arrays->mass_xyz[3 * (size_t)n + 2] = (uint16_t)(mass % side_z);
      n++;
    }
  }
  n = 0;
  for (uint32_t w = 0; w < marks->spring_words; w++) {
    for (uint64_t rest = marks->spring[w]; rest != 0; rest &= rest - 1) {
      uint32_t spring = w * 64 + (uint32_t)__builtin_ctzll(rest);
      arrays->spring_lattice[n] = spring;
      arrays->spring_a[n] = position(marks, lattice->spring_a[spring]);
      arrays->spring_b[n] = position(marks, lattice->spring_b[spring]);
      arrays->spring_rest_m[n] = lattice->spring_rest_m[spring];
      n++;
    }
  }
  n = 0;
  for (uint32_t w = 0; w < mo_workspace_words(lattice->workspace); w++) {
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      const size_t voxel = (size_t)w * 64 + (size_t)__builtin_ctzll(rest);
      for (int i = 0; i < 8; i++)
        arrays->voxel_mass[n++] = position(marks, lattice->voxel_mass[8 * voxel + i]);
    }
  }
}

int mo_body_create(const struct mo_lattice *lattice, const uint64_t *bits, struct mo_body **body)
{
  uint32_t n_voxels = mo_genotype_count(lattice->workspace, bits);
  if (n_voxels == 0)
    return MO_ERR_EMPTY;
  struct marks marks = {.mass_words = (lattice->n_masses + 63) / 64,
                        .spring_words = (lattice->n_springs + 63) / 64};
  struct mo_scratch memory;
  if (mo_scratch_open(&memory, 2 * marks.mass_words + marks.spring_words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  marks.mass = memory.bits;
  marks.spring = marks.mass + marks.mass_words;
  marks.mass_below = (uint32_t *)(marks.spring + marks.spring_words);
  mo_body_mark(lattice, bits, marks.mass, marks.spring);
  for (uint32_t w = 1; w < marks.mass_words; w++)
    marks.mass_below[w] = marks.mass_below[w - 1] + mo_bits_count_word(marks.mass[w - 1]);
  int code = MO_ERR_NO_MEMORY;
  struct arrays arrays;
  struct mo_body *made = allocate(n_voxels, mo_bits_count(marks.mass, marks.mass_words),
                                  mo_bits_count(marks.spring, marks.spring_words), &arrays);
  if (made != NULL) {
    made->workspace = lattice->workspace;
    fill(lattice, bits, &marks, &arrays);
    *body = made;
    code = MO_OK;
  }
  mo_scratch_close(&memory);
  return code;
}

void mo_body_free(struct mo_body *body)
{
  free(body);
}
