/* The order in which waiting requests are handled: clients take turns. */
#include "http/queue.h"

#include "unit/check.h"

#define N 8

/* A request of the client "a", "b", … */
static struct mo_request *push(struct mo_queue *queue, struct mo_request *request,
                               const char *whose)
{
  *request = (struct mo_request){.stage = MO_STAGE_HANDLING};
  request->client_key[0] = (unsigned char)whose[0];
  mo_queue_push(queue, request);
  return request;
}

static void clients_take_turns(void)
{
  struct mo_queue queue = {.n_new = 0};
  struct mo_request requests[N];
  static const char *const whose[N] = {"a", "a", "a", "b", "a", "c", "b", "c"};
  static const int order[N] = {0, 3, 5, 1, 6, 7, 2, 4};
  mo_queue_init(&queue, 1);
  for (int i = 0; i < N; i++)
    push(&queue, &requests[i], whose[i]);
  CHECK_INT(queue.n_new, N);
  for (int i = 0; i < N; i++) {
    struct mo_request *request = mo_queue_take(&queue);
    REQUIRE(request != NULL);
    CHECK_INT(request - requests, order[i]);
    CHECK_INT(request->is_crowded, order[i] != 4 && order[i] != 6 && order[i] != 7);
    CHECK_INT(queue.n_new, N - 1 - i);
    mo_queue_done(&queue, request->client_key);
  }
  CHECK(mo_queue_take(&queue) == NULL);
}

/* A new client is next while another one's requests wait, no matter how often those return. */
static void newcomers_are_next(void)
{
  struct mo_queue queue = {.n_new = 0};
  struct mo_request many[N], one;
  mo_queue_init(&queue, 1);
  for (int i = 0; i < 4; i++)
    push(&queue, &many[i], "a");
  CHECK(mo_queue_take(&queue) == &many[0]);
  push(&queue, &one, "b");
  push(&queue, &many[0], "a"); /* the next piece of its reply */
  mo_queue_done(&queue, many[0].client_key);
  CHECK(mo_queue_take(&queue) == &many[1]); /* its turn had come before */
  CHECK(mo_queue_take(&queue) == &one);
}

/* One client's requests do not occupy all threads. */
static void a_client_has_a_limit(void)
{
  struct mo_queue queue = {.n_new = 0};
  struct mo_request many[N], one;
  mo_queue_init(&queue, 2);
  for (int i = 0; i < 4; i++)
    push(&queue, &many[i], "a");
  CHECK(mo_queue_take(&queue) == &many[0] && mo_queue_take(&queue) == &many[1]);
  CHECK(mo_queue_take(&queue) == NULL);
  push(&queue, &one, "b");
  CHECK(mo_queue_take(&queue) == &one && !one.is_crowded);
  CHECK(mo_queue_take(&queue) == NULL);
  mo_queue_done(&queue, many[0].client_key);
  CHECK(mo_queue_take(&queue) == &many[2] && many[2].is_crowded);
  mo_queue_done(&queue, many[1].client_key);
  CHECK(mo_queue_take(&queue) == &many[3] && many[3].is_crowded);
  CHECK_INT(queue.n_running, 3);
}

/* A resumed request does not count as new, so it is never refused. */
static void only_new_ones_count(void)
{
  struct mo_queue queue = {.n_new = 0};
  struct mo_request piece, woken, fresh;
  mo_queue_init(&queue, 3);
  push(&queue, &fresh, "a");
  piece = (struct mo_request){.stage = MO_STAGE_REPLY, .client_key = "b"};
  mo_queue_push(&queue, &piece);
  woken = (struct mo_request){.stage = MO_STAGE_HANDLING, .wait_over = true, .client_key = "c"};
  mo_queue_push(&queue, &woken);
  CHECK_INT(queue.n_new, 1);
  CHECK(mo_queue_take(&queue) == &fresh);
  CHECK(mo_queue_take(&queue) == &piece && mo_queue_take(&queue) == &woken);
  CHECK_INT(queue.n_new, 0);
}

static const struct check_case cases[] = {
    {"clients take turns", clients_take_turns},
    {"a new client is next", newcomers_are_next},
    {"one client does not occupy all threads", a_client_has_a_limit},
    {"only new requests count", only_new_ones_count}};
CHECK_MAIN(cases)
