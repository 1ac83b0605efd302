/* thread.h: threads that block signals. */
#ifndef MORPHO_BASE_THREAD_H
#define MORPHO_BASE_THREAD_H

#include <pthread.h>
#include <stdint.h>

/* Identifies whose work this thread does, e.g. a job's id; −1: nobody's. mo_parallel passes it on
 * to its threads. Signal handlers may read it. */
extern _Thread_local volatile int64_t mo_thread_tag;

/* Starts a thread like pthread_create. The thread blocks all signals except those of its own
 * faults: a blocked fault would end the process before a handler can note the work. name: up to 15
 * characters, or NULL. */
int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context),
                     void *context);

#endif
