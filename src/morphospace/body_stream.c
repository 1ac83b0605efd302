/* body_stream.c: random bodies without repetition. */
#include <morpho/morphospace.h>

#include "morphospace/bits.h"

#define FRUITLESS_MAX (UINT32_C(1) << 20)

struct mo_body_stream {
  struct mo_workspace workspace;
  uint64_t seed;
  uint64_t draws;
  struct mo_form_set *seen;
  uint64_t *body, *form; /* scratch, one allocation */
};

int mo_body_stream_create(struct mo_workspace workspace, uint64_t seed, struct mo_body_stream **stream)
{
  struct mo_form_set *seen = NULL;
  int code = mo_form_set_create(workspace, &seen);
  if (code != MO_OK) {
    return code;
  }
  struct mo_body_stream *made = calloc(1, sizeof(*made));
  uint64_t *scratch = calloc(2 * (size_t)mo_workspace_words(workspace), sizeof(uint64_t));
  if (made == NULL || scratch == NULL) {
    free(scratch);
    free(made);
    mo_form_set_free(seen);
    return MO_ERR_NO_MEMORY;
  }
  *made = (struct mo_body_stream){.workspace = workspace, .seed = seed, .seen = seen, .body = scratch};
  made->form = scratch + mo_workspace_words(workspace);
  *stream = made;
  return MO_OK;
}

void mo_body_stream_free(struct mo_body_stream *stream)
{
  if (stream == NULL) {
    return;
  }
  mo_form_set_free(stream->seen);
  free(stream->body);
  free(stream);
}

int mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits)
{
  for (uint32_t fruitless = 0; fruitless < FRUITLESS_MAX; fruitless++) {
    if (stream->draws > MO_RANDOM_INDEX_MAX) {
      return MO_ERR_EXHAUSTED;
    }
    struct mo_random random;
    mo_random_init(&random, stream->seed, MO_PURPOSE_BODY, 0, stream->draws);
    int code = mo_genotype_random(stream->workspace, &random, stream->body);
    if (code != MO_OK) {
      return code;
    }
    mo_genotype_canonical(stream->workspace, stream->body, stream->form);
    code = mo_form_set_add(stream->seen, stream->form);
    if (code < 0) {
      return code; /* the same draw is tried again by the next call */
    }
    stream->draws++;
    if (code == 1) {
      memcpy(bits, stream->body, mo_workspace_words(stream->workspace) * sizeof(uint64_t));
      return MO_OK;
    }
  }
  return MO_ERR_EXHAUSTED;
}

uint64_t mo_body_stream_draws(const struct mo_body_stream *stream)
{
  return stream->draws;
}

size_t mo_body_stream_bytes(const struct mo_body_stream *stream)
{
  return sizeof(*stream) + 2 * mo_workspace_words(stream->workspace) * sizeof(uint64_t) +
         mo_form_set_bytes(stream->seen);
}

int mo_body_stream_exclude(struct mo_body_stream *stream, const uint64_t *form)
{
  int code = mo_form_set_add(stream->seen, form);
  return code < 0 ? code : MO_OK;
}
