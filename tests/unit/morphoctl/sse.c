/* Server-sent events, split anywhere. */
#include "../check.h"

#include "follow.h"

static char seen[4096];

static int note(void *context, const char *type, const char *data)
{
  int *count = context;
  size_t n = strlen(seen);
  snprintf(seen + n, sizeof(seen) - n, "%s|%s;", type, data);
  (*count)++;
  return strcmp(data, "stop") == 0;
}

static const char stream[] =
    "retry: 2000\n\n: hello\n\nid: 1\nevent: job.created\ndata: {\"a\":1}\n\n"
    "id: 2\ndata: two\n\n: \n\nid: 3\ndata: \n\ndata: last\n\n"
    "id: 4\ndata: half";
static const char expected[] = "job.created|{\"a\":1};message|two;message|;message|last;";

static void every_cut(void)
{
  for (size_t cut = 0; cut < sizeof(stream); cut++) {
    struct sse sse = {0};
    int count = 0;
    *seen = 0;
    CHECK_INT(sse_feed(&sse, stream, cut, note, &count), 0);
    CHECK_INT(sse_feed(&sse, stream + cut,
                       sizeof(stream) - 1 - (cut < sizeof(stream) - 1 ? cut : sizeof(stream) - 1),
                       note, &count),
              0);
    CHECK_TEXT(seen, expected);
    CHECK_TEXT(sse.last_id, "3"); /* the incomplete event does not count */
    sse_free(&sse);
  }
}

static void byte_by_byte(void)
{
  struct sse sse = {0};
  int count = 0;
  *seen = 0;
  for (size_t i = 0; i + 1 < sizeof(stream); i++)
    CHECK_INT(sse_feed(&sse, stream + i, 1, note, &count), 0);
  CHECK_TEXT(seen, expected);
  sse.n_bytes = 0;
  CHECK_INT(sse_feed(&sse, "data: new\n\n", 11, note, &count), 0);
  CHECK(strstr(seen, "message|new;") != NULL);
  CHECK_TEXT(sse.last_id, "3");
  sse_free(&sse);
}

static void ends(void)
{
  struct sse sse = {0};
  int count = 0;
  *seen = 0;
  CHECK_INT(sse_feed(&sse, "data: stop\n\ndata: more\n\n", 24, note, &count), 1);
  CHECK_INT(count, 1);
  sse_free(&sse);
}

static void too_large(void)
{
  struct sse sse = {0};
  int count = 0, status = 0;
  char *large = malloc(65536);
  REQUIRE(large != NULL);
  memset(large, 'x', 65536);
  for (int i = 0; i < 64 && status == 0; i++)
    status = sse_feed(&sse, large, 65536, note, &count);
  CHECK_INT(status, -1);
  free(large);
  sse_free(&sse);
}

static const struct check_case cases[] = {{"cut anywhere", every_cut},
                                          {"byte by byte", byte_by_byte},
                                          {"a listener stops the stream", ends},
                                          {"too large", too_large}};
CHECK_MAIN(cases)
