/* terrain_json.h: terrains that are not given as the 8 × 8 heights of a grid, in JSON.
 * docs/tasks.md describes the members.
 *
 * {"kind": "profile", "heights_m": […], "spacing_m": …}, {"kind": "grid", "heights_m": [[…], …],
 * "spacing_m": …}, or a family (<morpho/world.h>) with the fields of its recipe; fields that are
 * left out have their defaults. */
#ifndef MORPHO_WORLD_TERRAIN_JSON_H
#define MORPHO_WORLD_TERRAIN_JSON_H

#include <morpho/world.h>

#include "base/json.h"
#include "base/text.h"

/* Reads a terrain. The environment must not have a grid yet. If the terrain is invalid, adds a
 * fault and leaves the environment unchanged. The caller drops the grid (mo_environments_drop). */
void mo_terrain_read(struct mo_json *json, struct mo_environment *environment);
/* Writes the terrain of an environment, a profile or a custom grid, as an object. */
void mo_terrain_write(struct mo_text *text, const struct mo_environment *environment);

#endif
