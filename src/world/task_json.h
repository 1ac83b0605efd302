/* task_json.h: tasks and environments in JSON. docs/tasks.md describes the members.
 *
 * A task is a word of mo_task_words, or {"guide": {"kind": …}, "objective": …}. An objective is a
 * word, or the weights of a sum: {"travel": 1, "work_j": -0.001}. The light of a guide that moves
 * it from its own starting place is a member of the guide; the light of a fixed guide is a member
 * of the environment, and the other guides have none. */
#ifndef MORPHO_WORLD_TASK_JSON_H
#define MORPHO_WORLD_TASK_JSON_H

#include <morpho/world.h>

#include "base/json.h"
#include "base/text.h"

/* The named tasks: "photo", "photo-auc", "walk", … A name never changes its meaning. */
extern const char *const mo_task_words[]; /* NULL after the last */
/* Sets the task, and the light of a task whose guide has one. */
void mo_task_named(int i, struct mo_environment *environment);

/* Reads a task of either kind. It also sets the light, to (0, 0) if the guide has none. An invalid
 * task adds a fault and leaves the environment unchanged. */
void mo_task_read(struct mo_json *json, struct mo_environment *environment);
/* Writes a task as an object. */
void mo_task_write(struct mo_text *text, const struct mo_environment *environment);

/* Reads a member that mo_environment_write_members writes. Returns false if there is no such
 * member. */
bool mo_environment_read_member(struct mo_json *json, struct mo_json_slice key,
                                struct mo_environment *environment);
/* Writes the members of an environment, with commas between them: light_xy_m unless the guide has
 * it or needs none, terrain_heights_m or, of a profile, terrain, the task unless it is plain,
 * damage if there is any, factors if any is not 1, and drop_m if it is not 0. */
void mo_environment_write_members(struct mo_text *text, const struct mo_environment *environment);
/* Writes only terrain, task, damage, factors and drop_m. */
void mo_environment_write_tasks(struct mo_text *text, const struct mo_environment *environment);

#endif
