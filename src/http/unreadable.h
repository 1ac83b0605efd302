/* unreadable.h: jobs, designs, controllers and events of which the store has rows that cannot be
 * read: what a list, a problem and the log tell of them. */
#ifndef MORPHO_HTTP_UNREADABLE_H
#define MORPHO_HTTP_UNREADABLE_H

#include "http/server.h"

/* Those of a page. All zeros: none. */
struct mo_unreadable {
  struct mo_text items; /* JSON objects with commas between them */
  char note[MO_REASON_BYTES],
      more[40]; /* for the log: those that it has room for, and how many others */
  unsigned n, n_noted;
};
void mo_unreadable_add(struct mo_unreadable *list, const struct mo_job *job); /* one with damage */
/* Something else that a list is of: a design by its row, a controller by its name, an event by its
 * place. */
void mo_unreadable_add_other(struct mo_unreadable *list, const char *kind, const char *id,
                             const char *damage);
/* A row of a curve of `job`, of which `place` says which ("step 5"); `id` is what `after` calls it.
 * It is left out of a CSV (list NULL), and noted for the log if it is the first. */
void mo_unreadable_row(struct mo_request *request, struct mo_unreadable *list, int64_t job,
                       const char *kind, const char *id, const char *place,
                       const struct mo_row_damage *damage);
/* Ends the member `unreadable` of a page, if there are any, notes them for the log, and frees the
 * list. */
void mo_unreadable_end(struct mo_request *request, struct mo_text *text,
                       struct mo_unreadable *list);

/* Whether a row is found that keeps what the path names from being read: then the 500 that says so
 * is made. */
bool mo_reply_unreadable(struct mo_request *request);
/* The job that the path names was cancelled and cannot be read: 204, and a note for the log. */
void mo_reply_cancelled_unreadable(struct mo_request *request);

#endif
