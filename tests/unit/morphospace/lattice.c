/* lattice.c: counts, orders and incidence of masses and springs, compared with brute force. */
#include "../make.h"

#include <morpho/morphospace.h>

#include <math.h>

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},
                                                 {1, 1, 2}, {1, 2, 1}, {3, 5, 2},
                                                 {6, 4, 4}, {2, 3, 7}, {12, 9, 10}};
#define WORKSPACES COUNT(workspaces)

static void full_default(void)
{
  struct mo_workspace w = MO_DEFAULT_WORKSPACE;
  CHECK_INT(mo_workspace_voxels(w), 144);
  CHECK_INT(mo_workspace_words(w), 3);
  CHECK_INT(mo_workspace_masses(w), 245);
  CHECK_INT(mo_workspace_springs(w), 1648);
  struct mo_lattice *lattice = make_lattice(w);
  uint64_t bits[3] = {UINT64_MAX, UINT64_MAX, 0xffff};
  const struct mo_body *body = make_body(lattice, bits);
  CHECK_INT(body->n_voxels, 144);
  CHECK_INT(body->n_masses, 245);
  CHECK_INT(body->n_springs, 1648);
  int diagonals = 0;
  for (uint32_t s = 0; s < body->n_springs; s++) {
    CHECK(body->spring_lattice[s] == s && body->spring_a[s] == lattice->spring_a[s] &&
          body->spring_b[s] == lattice->spring_b[s]);
    diagonals += body->spring_rest_m[s] == MO_DIAGONAL_M;
  }
  CHECK_INT(diagonals, 1032);
}

static void limits(void)
{
  CHECK_INT(mo_workspace_check((struct mo_workspace){0, 6, 4}), MO_ERR_RANGE);
  CHECK_INT(mo_workspace_check((struct mo_workspace){6, 0, 4}), MO_ERR_RANGE);
  CHECK_INT(mo_workspace_check((struct mo_workspace){6, 6, 0}), MO_ERR_RANGE);
  CHECK_INT(mo_workspace_check((struct mo_workspace){128, 128, 64}), MO_OK);
  CHECK_INT(mo_workspace_check((struct mo_workspace){128, 128, 65}), MO_ERR_LIMIT);
  CHECK_INT(mo_workspace_check((struct mo_workspace){65535, 65535, 65535}), MO_ERR_LIMIT);
  struct mo_lattice *lattice = NULL;
  CHECK_INT(mo_lattice_create((struct mo_workspace){0, 1, 1}, &lattice), MO_ERR_RANGE);
  CHECK(lattice == NULL);
  mo_lattice_free(NULL);
  mo_body_free(NULL);
}

static void coordinates(struct mo_workspace w, uint32_t mass, int at[3])
{
  at[2] = (int)(mass % (w.nz + 1U));
  at[1] = (int)(mass / (w.nz + 1U) % (w.ny + 1U));
  at[0] = (int)(mass / (w.nz + 1U) / (w.ny + 1U));
}

/* 1 = edge, 2 = face diagonal, 0 = no spring between the two. */
static int relation(struct mo_workspace w, uint32_t a, uint32_t b)
{
  int p[3];
  int q[3];
  coordinates(w, a, p);
  coordinates(w, b, q);
  int far = 0;
  for (int i = 0; i < 3; i++) {
    if (abs(p[i] - q[i]) > 1)
      return 0;
    far += abs(p[i] - q[i]);
  }
  return far == 1 || far == 2 ? far : 0;
}

static void springs_in_order(void)
{
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    struct mo_lattice *lattice = make_lattice(w);
    uint32_t s = 0;
    uint32_t wrong = 0;
    for (uint32_t a = 0; a < lattice->n_masses; a++) {
      for (uint32_t b = a + 1; b < lattice->n_masses; b++) {
        int kind = relation(w, a, b);
        if (kind != 0) {
          wrong += s >= lattice->n_springs || lattice->spring_a[s] != a ||
                   lattice->spring_b[s] != b || lattice->spring_rest_m[s] != 0.1 * sqrt(kind);
          s++;
        }
      }
    }
    CHECK_INT(wrong, 0);
    CHECK_INT(s, lattice->n_springs);
    CHECK_INT(lattice->n_masses, mo_workspace_masses(w));
  }
}

static void voxels_hold_their_springs(void)
{
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    struct mo_lattice *lattice = make_lattice(w);
    uint32_t wrong = 0;
    for (uint32_t v = 0; v < lattice->n_voxels; v++) {
      const int low[3] = {(int)(v / w.nz / w.ny), (int)(v / w.nz % w.ny), (int)(v % w.nz)};
      uint32_t n_mass = 0;
      for (uint32_t m = 0; m < lattice->n_masses; m++) {
        int at[3];
        coordinates(w, m, at);
        int corner = 1;
        for (int k = 0; k < 3; k++)
          corner = corner && (at[k] == low[k] || at[k] == low[k] + 1);
        if (corner) {
          wrong += n_mass >= 8 || lattice->voxel_mass[8 * v + n_mass] != m;
          n_mass++;
        }
      }
      uint32_t n_spring = 0;
      for (uint32_t s = 0; s < lattice->n_springs; s++) {
        int ends = 0;
        for (int k = 0; k < 8; k++) {
          ends += lattice->voxel_mass[8 * v + k] == lattice->spring_a[s];
          ends += lattice->voxel_mass[8 * v + k] == lattice->spring_b[s];
        }
        if (ends == 2) {
          wrong += n_spring >= 24 || lattice->voxel_spring[24 * v + n_spring] != s;
          n_spring++;
        }
      }
      wrong += n_mass != 8 || n_spring != 24;
    }
    CHECK_INT(wrong, 0);
  }
}

/* Compares a body's lists with the definition: the masses and springs of any of its voxels. */
static void bodies(void)
{
  struct mo_random random = dice(7, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    struct mo_lattice *lattice = make_lattice(w);
    static uint8_t mass[2000];
    static uint8_t spring[14000];
    uint64_t bits[20] = {0};
    REQUIRE(lattice->n_masses <= sizeof(mass) && lattice->n_springs <= sizeof(spring) &&
            lattice->n_voxels <= 1280);
    memset(mass, 0, sizeof(mass));
    memset(spring, 0, sizeof(spring));
    struct mo_body *body = NULL;
    CHECK_INT(mo_body_create(lattice, bits, &body), MO_ERR_EMPTY);
    CHECK(body == NULL);
    uint32_t voxels = 0;
    for (uint32_t v = 0; v < lattice->n_voxels; v++) {
      if (mo_random_below(&random, 3) == 0 || v + 1 == lattice->n_voxels) {
        bits[v / 64] |= UINT64_C(1) << v % 64;
        voxels++;
        for (int k = 0; k < 8; k++)
          mass[lattice->voxel_mass[8 * v + k]] = 1;
        for (int k = 0; k < 24; k++)
          spring[lattice->voxel_spring[24 * v + k]] = 1;
      }
    }
    REQUIRE(mo_body_create(lattice, bits, &body) == MO_OK);
    uint32_t n = 0;
    uint32_t wrong = 0;
    for (uint32_t m = 0; m < lattice->n_masses; m++) {
      if (mass[m]) {
        int at[3];
        coordinates(w, m, at);
        wrong += n >= body->n_masses || body->mass_lattice[n] != m ||
                 body->mass_xyz[3 * n] != at[0] || body->mass_xyz[3 * n + 1] != at[1] ||
                 body->mass_xyz[3 * n + 2] != at[2];
        n++;
      }
    }
    CHECK_INT(n, body->n_masses);
    n = 0;
    for (uint32_t s = 0; s < lattice->n_springs; s++) {
      if (spring[s]) {
        wrong += n >= body->n_springs || body->spring_lattice[n] != s ||
                 body->spring_a[n] >= body->n_masses || body->spring_b[n] >= body->n_masses ||
                 body->mass_lattice[body->spring_a[n]] != lattice->spring_a[s] ||
                 body->mass_lattice[body->spring_b[n]] != lattice->spring_b[s] ||
                 body->spring_rest_m[n] != lattice->spring_rest_m[s];
        n++;
      }
    }
    CHECK_INT(n, body->n_springs);
    CHECK_INT(voxels, body->n_voxels);
    n = 0;
    for (uint32_t v = 0; v < lattice->n_voxels; v++) {
      if (bits[v / 64] >> v % 64 & 1) {
        for (uint32_t k = 0; k < 8; k++)
          wrong +=
              body->voxel_mass[8 * n + k] >= body->n_masses ||
              body->mass_lattice[body->voxel_mass[8 * n + k]] != lattice->voxel_mass[8 * v + k];
        n++;
      }
    }
    CHECK_INT(n, voxels);
    CHECK_INT(wrong, 0);
    mo_body_free(body);
  }
}

static const struct check_case cases[] = {
    {"the full default workspace has 245 masses and 1648 springs", full_default},
    {"sizes are bounded", limits},
    {"springs are in the order of their ends", springs_in_order},
    {"voxels have 8 masses and 24 springs, ascending", voxels_hold_their_springs},
    {"a body has what its voxels have", bodies},
};
CHECK_MAIN(cases)
