/* task.h: properties of tasks that other rooms need in addition to <morpho/task.h>. */
#ifndef MORPHO_WORLD_TASK_H
#define MORPHO_WORLD_TASK_H

#include <morpho/task.h>

/* Returns whether a task adds up more than one sum: efficient, jump and weighted sums. */
bool mo_task_has_tally(const struct mo_task *task);

#endif
