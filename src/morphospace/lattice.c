/* lattice.c: the numbers of voxels, masses and springs of a workspace; the masses and springs
 * themselves, and which of them each voxel expresses.
 *
 * From a mass, springs lead to at most nine masses of higher index: three edges and six face
 * diagonals, `steps` below, in the order of the far end. A spring's index is therefore first[a] +
 * the number of earlier steps that exist at a, where first[a] counts the springs of all lower
 * masses. One allocation holds a lattice and its arrays. */
#include <morpho/morphospace.h>

#include <stdlib.h>

/* ---- workspaces ---- */

int mo_workspace_check(struct mo_workspace workspace)
{
  if (workspace.nx == 0 || workspace.ny == 0 || workspace.nz == 0)
    return MO_ERR_RANGE;
  uint64_t voxels = (uint64_t)workspace.nx * workspace.ny * workspace.nz;
  return voxels > MO_VOXELS_MAX ? MO_ERR_LIMIT : MO_OK;
}

bool mo_workspace_equal(struct mo_workspace a, struct mo_workspace b)
{
  return a.nx == b.nx && a.ny == b.ny && a.nz == b.nz;
}

uint32_t mo_workspace_voxels(struct mo_workspace workspace)
{
  return (uint32_t)workspace.nx * workspace.ny * workspace.nz;
}

uint32_t mo_workspace_words(struct mo_workspace workspace)
{
  return (mo_workspace_voxels(workspace) + 63) / 64;
}

uint32_t mo_workspace_masses(struct mo_workspace workspace)
{
  return (workspace.nx + UINT32_C(1)) * (workspace.ny + UINT32_C(1)) * (workspace.nz + UINT32_C(1));
}

/* Edges along x, y, z, and two diagonals for each unit square normal to z, y, x. */
uint32_t mo_workspace_springs(struct mo_workspace workspace)
{
  uint32_t nx = workspace.nx;
  uint32_t ny = workspace.ny;
  uint32_t nz = workspace.nz;
  uint32_t edges = nx * (ny + 1) * (nz + 1) + (nx + 1) * ny * (nz + 1) + (nx + 1) * (ny + 1) * nz;
  uint32_t squares = nx * ny * (nz + 1) + nx * (ny + 1) * nz + (nx + 1) * ny * nz;
  return edges + 2 * squares;
}

/* ---- lattices ---- */

#define STEPS 9

struct step {
  int8_t x, y, z;
};

static const struct step steps[STEPS] = {{0, 0, 1},  {0, 1, -1}, {0, 1, 0}, {0, 1, 1}, {1, -1, 0},
                                         {1, 0, -1}, {1, 0, 0},  {1, 0, 1}, {1, 1, 0}};

static double rest_of(struct step step)
{
  const int axes = (step.x != 0) + (step.y != 0) + (step.z != 0);
  return axes > 1 ? MO_DIAGONAL_M : MO_VOXEL_M;
}

/* Returns a bit mask: bit i is set if step i leads to a mass of the workspace. */
static unsigned steps_at(struct mo_workspace workspace, int32_t x, int32_t y, int32_t z)
{
  unsigned mask = 0;
  for (int i = 0; i < STEPS; i++) {
    int32_t far_x = x + steps[i].x;
    int32_t far_y = y + steps[i].y;
    int32_t far_z = z + steps[i].z;
    if (far_x <= workspace.nx && far_y >= 0 && far_y <= workspace.ny && far_z >= 0 &&
        far_z <= workspace.nz)
      mask |= 1U << i;
  }
  return mask;
}

static uint32_t mass_at(struct mo_workspace workspace, int32_t x, int32_t y, int32_t z)
{
  return ((uint32_t)x * (workspace.ny + UINT32_C(1)) + (uint32_t)y) * (workspace.nz + UINT32_C(1)) +
         (uint32_t)z;
}

static void fill_springs(struct mo_workspace workspace, uint32_t *a, uint32_t *b, double *rest_m,
                         uint32_t *first)
{
  uint32_t spring = 0;
  uint32_t mass = 0;
  for (int32_t x = 0; x <= workspace.nx; x++) {
    for (int32_t y = 0; y <= workspace.ny; y++) {
      for (int32_t z = 0; z <= workspace.nz; z++) {
        unsigned mask = steps_at(workspace, x, y, z);
        first[mass] = spring;
        for (int i = 0; i < STEPS; i++) {
          if (mask >> i & 1) {
            a[spring] = mass;
            b[spring] = mass_at(workspace, x + steps[i].x, y + steps[i].y, z + steps[i].z);
            rest_m[spring] = rest_of(steps[i]);
            spring++;
          }
        }
        mass++;
      }
    }
  }
}

/* Corners in ascending order of mass, steps in ascending order of the far end: so both lists are
 * ascending. */
static void fill_voxel(struct mo_workspace workspace, int32_t x, int32_t y, int32_t z,
                       const uint32_t *first, uint32_t masses[8], uint32_t springs[24])
{
  int n = 0;
  for (int corner = 0; corner < 8; corner++) {
    int32_t corner_x = corner >> 2;
    int32_t corner_y = corner >> 1 & 1;
    int32_t corner_z = corner & 1;
    uint32_t mass = mass_at(workspace, x + corner_x, y + corner_y, z + corner_z);
    unsigned mask = steps_at(workspace, x + corner_x, y + corner_y, z + corner_z);
    masses[corner] = mass;
    for (int i = 0; i < STEPS; i++) {
      int32_t far_x = corner_x + steps[i].x;
      int32_t far_y = corner_y + steps[i].y;
      int32_t far_z = corner_z + steps[i].z;
      if (far_x <= 1 && far_y >= 0 && far_y <= 1 && far_z >= 0 && far_z <= 1) {
        unsigned earlier = mask & ((1U << i) - 1);
        springs[n++] = first[mass] + (uint32_t)__builtin_popcount(earlier);
      }
    }
  }
}

int mo_lattice_create(struct mo_workspace workspace, struct mo_lattice **lattice)
{
  int code = mo_workspace_check(workspace);
  if (code != MO_OK)
    return code;
  const size_t n_voxels = mo_workspace_voxels(workspace), n_masses = mo_workspace_masses(workspace),
               n_springs = mo_workspace_springs(workspace);
  struct mo_lattice *made = malloc(sizeof(*made) + n_springs * sizeof(double) +
                                   (32 * n_voxels + 2 * n_springs) * sizeof(uint32_t));
  uint32_t *first = malloc(n_masses * sizeof(*first));
  if (made == NULL || first == NULL) {
    free(made);
    free(first);
    return MO_ERR_NO_MEMORY;
  }
  double *rest_m = (double *)(made + 1);
  uint32_t *voxel_mass = (uint32_t *)(rest_m + n_springs),
           *voxel_spring = voxel_mass + 8 * n_voxels;
  uint32_t *spring_a = voxel_spring + 24 * n_voxels, *spring_b = spring_a + n_springs;
  *made = (struct mo_lattice){.workspace = workspace,
                              .n_voxels = (uint32_t)n_voxels,
                              .n_masses = (uint32_t)n_masses,
                              .n_springs = (uint32_t)n_springs,
                              .spring_a = spring_a,
                              .spring_b = spring_b,
                              .spring_rest_m = rest_m,
                              .voxel_mass = voxel_mass,
                              .voxel_spring = voxel_spring};
  fill_springs(workspace, spring_a, spring_b, rest_m, first);
  size_t voxel = 0;
  for (int32_t x = 0; x < workspace.nx; x++) {
    for (int32_t y = 0; y < workspace.ny; y++) {
      for (int32_t z = 0; z < workspace.nz; z++) {
        fill_voxel(workspace, x, y, z, first, voxel_mass + 8 * voxel, voxel_spring + 24 * voxel);
        voxel++;
      }
    }
  }
  free(first);
  *lattice = made;
  return MO_OK;
}

void mo_lattice_free(struct mo_lattice *lattice)
{
  free(lattice);
}
