/* thread.c: see thread.h. The program decides which threads handle other signals. */
#include "base/thread.h"

#include <signal.h>

_Thread_local volatile int64_t mo_thread_tag = -1;

int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context),
                     void *context)
{
  static const int faults[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGTRAP, SIGSYS};
  sigset_t blocked, before;
  sigfillset(&blocked);
  for (size_t i = 0; i < sizeof(faults) / sizeof(faults[0]); i++)
    sigdelset(&blocked, faults[i]);
  pthread_sigmask(SIG_SETMASK, &blocked, &before);
  const int error = pthread_create(thread, NULL, run, context);
  pthread_sigmask(SIG_SETMASK, &before, NULL);
  if (error == 0 && name != NULL)
    (void)pthread_setname_np(*thread, name);
  return error;
}
