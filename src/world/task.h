/* task.h: what rooms need to know about a task beyond <morpho/task.h>. */
#ifndef MORPHO_WORLD_TASK_H
#define MORPHO_WORLD_TASK_H

#include <morpho/task.h>

/* Returns whether a task adds up more than one sum: efficient, jump and weighted sums. */
bool mo_task_has_tally(const struct mo_task *task);

#endif
