/* scene.h: reads a scene, application/vnd.morphod.scene (docs/scenes.md): bodies, environments and
 * recordings of rollouts, as the service sends them. */
#ifndef MORPHOCTL_FILM_SCENE_H
#define MORPHOCTL_FILM_SCENE_H

#include <stddef.h>
#include <stdint.h>

#include <jansson.h>

/* A body; a track has the positions of its masses. Arrays belong to the scene. */
struct scene_body {
  uint32_t n_masses, n_faces, n_voxels;
  const uint16_t
      *faces; /* (n_faces, 5) four masses, counter-clockwise seen from outside, and the voxel */
  const uint16_t *voxels; /* (n_voxels, 8) masses */
};

struct scene_world {
  double light_xy_m[2];   /* of a light that does not move */
  const float *heights_m; /* (8, 8), row y; of a profile, (n_profile) along x; of a custom grid,
                             (rows, columns) around (2.5, 2.5) */
  uint32_t n_profile;     /* 0: a grid */
  uint32_t columns, rows; /* of a custom grid; otherwise 0 */
  double spacing_m;       /* of a profile, and of a custom grid */
};

struct scene_rollout {
  uint32_t body, world, n_frames;
  const float *masses_m; /* (n_frames, n_masses, 3) */
  const float *lights_m; /* (n_frames, 3) of a light that a task moves; or NULL */
};

struct scene {
  double frame_s; /* seconds between two frames */
  uint32_t n_bodies, n_worlds, n_rollouts;
  struct scene_body *bodies;
  struct scene_world *worlds;
  struct scene_rollout *rollouts;
  const json_t *designs; /* the header's description of the bodies; kept (ctl.h) */
};

/* Reads `size` bytes, which must be aligned to 4 and outlive the scene. Its lists are kept (ctl.h).
 * Bytes that are not a scene end the program. */
struct scene scene_read(const void *bytes, size_t size);
/* Adds the contents of another scene, which must have the same time between its frames. */
void scene_append(struct scene *scene, const struct scene *other);

#endif
