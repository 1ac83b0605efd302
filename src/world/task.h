/* task.h: what rooms need to know of a task besides <morpho/task.h>. */
#ifndef MORPHO_WORLD_TASK_H
#define MORPHO_WORLD_TASK_H

#include <morpho/task.h>

/* Returns whether devices compute a task's objective: not efficient, jump and sums. */
bool mo_task_suits_devices(const struct mo_task *task);

#endif
