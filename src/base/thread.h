/* thread.h: threads that leave signals to others. */
#ifndef MORPHO_BASE_THREAD_H
#define MORPHO_BASE_THREAD_H

#include <pthread.h>

/* As pthread_create. The thread takes no signal but those of its own faults: where these are blocked, they end the process before anybody can
 * note what it was working on. name: up to 15 characters, or NULL. */
int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context), void *context);

#endif
