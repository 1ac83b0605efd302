/* study.c: the body of POST …/tell. An accepted body must be complete and valid, a refused one must
 * have a fault, and jansson decides what is JSON, as in evaluation.c. */
#include "target.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"

static void check_words(const char words[][MO_STUDY_WORD_MAX + 1], uint32_t n, uint32_t most)
{
  FUZZ_PROMISE(n <= most);
  for (uint32_t i = 0; i < n; i++)
    FUZZ_PROMISE(words[i][0] != '\0' && strlen(words[i]) <= MO_STUDY_WORD_MAX &&
                 strpbrk(words[i], ",\"\\ \n") == NULL);
}

static void check_telling(const struct mo_study_telling *telling)
{
  const struct mo_study_batch *batch = &telling->batch;
  FUZZ_PROMISE(batch->number <= MO_GENERATIONS_MAX && batch->n_children <= MO_DESIGNS_MAX);
  FUZZ_PROMISE(batch->n_survivors <= MO_POPULATION_MAX);
  FUZZ_PROMISE(telling->sampler == NULL ||
               (telling->sampler_size > 0 && telling->sampler_size <= MO_SAMPLER_BYTES_MAX));
  check_words(telling->words.operators, telling->words.n_operators, MO_STUDY_OPERATORS_MAX);
  check_words(telling->words.measures, telling->words.n_measures, MO_STUDY_MEASURES_MAX);
  FUZZ_PROMISE(batch->n_measures == telling->words.n_measures);
  for (uint32_t i = 0; i < batch->n_children; i++) {
    const struct mo_study_child *child = &batch->children[i];
    FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, child->genotype.words) == 1);
    FUZZ_PROMISE(child->descent.op < MO_OPERATORS + telling->words.n_operators);
    FUZZ_PROMISE(i == 0 || child->place > batch->children[i - 1].place);
    for (uint32_t m = 0; m < batch->n_measures; m++)
      FUZZ_PROMISE(!isinf(batch->measures[(size_t)batch->n_measures * i + m]));
    FUZZ_PROMISE(batch->scores == NULL || isfinite(batch->scores[i]));
  }
}

/* Declared as body.h reads requests; `parse` checks and frees everything. */
struct parsed {
  int request;
  struct mo_parts parts;
};

static int parse(const char *text, size_t size, struct parsed *parsed, struct mo_faults *faults)
{
  struct mo_parsed_telling telling;
  struct mo_campaign_record study = {.settings.workspace = MO_DEFAULT_WORKSPACE};
  if (memmem(text, size, "score", 5) != NULL)
    study.own_score = (struct mo_own_score){"cost", "J/m"};
  const int error = mo_tell_parse(text, size, &study, &telling, faults);
  if (error == MO_OK)
    check_telling(&telling.telling);
  mo_tell_free(&telling);
  *parsed = (struct parsed){.request = 0};
  return error;
}

static void check_accepted(const int *request)
{
  (void)request;
}

#define READER_PARSED struct parsed
#define READER_PARSE  parse
#include "body.h"
