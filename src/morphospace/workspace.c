/* workspace.c: how many voxels, masses and springs a workspace has. */
#include <morpho/morphospace.h>

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
