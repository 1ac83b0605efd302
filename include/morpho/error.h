/* error.h: the result codes of every function that can fail.
 *
 * A function returns MO_OK (0) or one of these negative codes. Unless its comment says otherwise,
 * it never exits, never logs, and leaves its outputs unchanged on failure. If a person must act on
 * an error, the function also takes a `struct mo_message *` (nullable) and writes one sentence that
 * says what is wrong and what to do. */
#ifndef MORPHO_ERROR_H
#define MORPHO_ERROR_H

#ifdef __cplusplus
extern "C" {
#endif

enum mo_error {
  MO_OK = 0,
  MO_ERR_NO_MEMORY = -1,      /* an allocation failed */
  MO_ERR_INVALID = -2,        /* a value is not of the required kind */
  MO_ERR_RANGE = -3,          /* a value is of the right kind, but outside its bounds */
  MO_ERR_EMPTY = -4,          /* a body without voxels */
  MO_ERR_NOT_CONTIGUOUS = -5, /* a body in more than one piece */
  MO_ERR_DUPLICATE = -6,      /* the same thing twice where once is allowed */
  MO_ERR_FORMAT = -7,         /* bytes are not in the expected format */
  MO_ERR_LIMIT = -8,          /* larger than this build or this configuration accepts */
  MO_ERR_NOT_FOUND = -9,      /* no such thing */
  MO_ERR_CONFLICT = -10,      /* contradicts what already exists */
  MO_ERR_IO = -11,            /* a read or write failed */
  MO_ERR_NO_SPACE = -12,      /* the disk is full */
  MO_ERR_CANCELLED = -13,     /* the caller requested a stop */
  MO_ERR_BUSY = -14,          /* try again later */
  MO_ERR_EXHAUSTED = -15,     /* there are no more items */
  MO_ERR_CORRUPT = -16,       /* stored data contradicts itself */
  MO_ERR_UNSUPPORTED = -17,   /* valid, but this build or machine cannot do it */
  MO_ERR_DEVICE = -18         /* a computing device is lost or has failed */
};

/* One sentence for people, NUL-terminated, without a trailing newline. */
struct mo_message {
  char text[256];
};

/* Returns a description of a code ("out of memory"); "unknown error" for other numbers. Never NULL;
 * static storage. */
const char *mo_error_text(int code);

/* Returns the name of a code for programs ("no_memory"); "unknown" for other numbers. */
const char *mo_error_name(int code);

/* Formats into `message` (nullable) and returns `code`, so that a caller can write `return
 * mo_fail(message, MO_ERR_RANGE, "…", …);`. */
int mo_fail(struct mo_message *message, int code, const char *format, ...)
    __attribute__((format(printf, 3, 4)));

#ifdef __cplusplus
}
#endif
#endif
