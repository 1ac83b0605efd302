/* query.h: reads the parts of a request other than its body: query parameters, Accept,
 * Content-Type, ids in its path. If a function returns false, it has made the reply (4xx). */
#ifndef MORPHO_HTTP_QUERY_H
#define MORPHO_HTTP_QUERY_H

#include "http/request.h"

#define MO_QUERY_VALUE_BYTES 808 /* longest value, with its NUL: 200 characters of UTF-8 fit */
#define MO_LIST_MAX          1000

/* Checks the route's own rules: each query parameter must be known and given once; Accept must
 * allow JSON (MO_ROUTE_JSON). Reads the parameters into request->query. */
bool mo_query_begin(struct mo_request *request);
void mo_query_end(struct mo_request *request);
/* Returns the value of a parameter, or NULL if it is absent. */
const char *mo_query(const struct mo_request *request, const char *name);
/* Reads `limit`: 1 to MO_LIST_MAX, 100 if absent. */
bool mo_query_limit(struct mo_request *request, size_t *limit);
/* Reads an integer within bounds; *number does not change if it is absent. */
bool mo_query_number(struct mo_request *request, const char *name, int64_t min, int64_t max,
                     int64_t *number);
/* Reads the id of a row in the same way as mo_query_number. words: the detail for invalid
 * values. */
bool mo_query_id(struct mo_request *request, const char *name, const char *words, int64_t *id);
#define MO_CURSOR_WORDS "must be the next_cursor of an earlier page"
#define MO_CURSOR_MAX   INT64_C(9999999999)
/* Reads a `cursor` that is the number of a row, 0 to MO_CURSOR_MAX; −1 if it is absent. */
bool mo_query_cursor(struct mo_request *request, int64_t *number);
/* Reads one of a list of words (base/words.h); *i, its index, does not change if the parameter is
 * absent. */
bool mo_query_word(struct mo_request *request, const char *name, const char *const *words, int *i);
/* Chooses a representation: by the parameter `format` (one of `names`) or else by Accept (`types`,
 * in the server's order of preference). Both lists end with NULL. */
bool mo_query_form(struct mo_request *request, const char *const *names, const char *const *types,
                   int *form);
/* Chooses a type by Accept. */
bool mo_accept(struct mo_request *request, const char *const *types, int *form);
/* Checks that Content-Type is `expected` or `also` (nullable), and that there is no content
 * coding. */
bool mo_check_content(struct mo_request *request, const char *expected, const char *also);
/* Reads a job's id from a path parameter. Replies with 404 to anything except a positive
 * integer. */
bool mo_path_id(struct mo_request *request, unsigned parameter, int64_t *id);
/* Reads Prefer: wait=N into request->wait_s, unless the wait is over. */
void mo_read_wait(struct mo_request *request);

#endif
