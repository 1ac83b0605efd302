/* queue.c: libmicrohttpd's own MHD_queue_response, which last_reply.c replaces in this program. */
#include <dlfcn.h>
#include <pthread.h>
#include <string.h>

#include "http/reply.h"

typedef enum MHD_Result (*queue_function)(struct MHD_Connection *mhd, unsigned status,
                                          struct MHD_Response *response);
static queue_function library_queue;

static void find_library_queue(void)
{
  void *found = dlsym(RTLD_NEXT, "MHD_queue_response");
  memcpy(&library_queue, &found, sizeof(library_queue));
}

bool mo_last_replies_init(void)
{
  static pthread_once_t once = PTHREAD_ONCE_INIT;
  return pthread_once(&once, find_library_queue) == 0 && library_queue != NULL;
}

enum MHD_Result mo_queue_response(struct MHD_Connection *mhd, unsigned status,
                                  struct MHD_Response *response)
{
  return library_queue(mhd, status, response);
}
