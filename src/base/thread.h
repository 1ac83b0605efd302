/* thread.h: threads that leave signals to others. */
#ifndef MORPHO_BASE_THREAD_H
#define MORPHO_BASE_THREAD_H

#include <pthread.h>
#include <stdint.h>

/* Whose work the calling thread does, e.g. a job's id; −1: nobody's. mo_parallel hands it on to its
 * threads. Readable in handlers of signals. */
extern _Thread_local volatile int64_t mo_thread_tag;

/* As pthread_create. The thread takes no signal but those of its own faults: where these are
 * blocked, they end the process before anybody can note what it was working on. name: up to 15
 * characters, or NULL. */
int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context),
                     void *context);

#endif
