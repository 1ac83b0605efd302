/* disk_state.h: the parts of a simulated disk: files with their unsynced writes, and the names that
 * refer to them. Only for disk*.c.
 *
 * Running out of memory aborts the test. These allocations never fail on demand. */
#ifndef MORPHO_TESTS_STORE_DISK_STATE_H
#define MORPHO_TESTS_STORE_DISK_STATE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define SECTOR 512

void *disk_memory(void *old, size_t size); /* like realloc, but never returns NULL */

/* ---- data ---- */

struct piece { /* a write; if bytes is NULL, a truncation or extension to `at` */
  int64_t at;
  size_t size;
  uint8_t *bytes;
};
struct inode {
  uint8_t *bytes; /* (size) durable content */
  int64_t size, room;
  struct piece *pending; /* (n) writes since then, in order */
  size_t n, pending_room;
  struct inode *next;
};
struct inode *inode_new(struct inode **list);
void inodes_free(struct inode **list);
void inode_write(struct inode *inode, int64_t at, const void *bytes, size_t size);
void inode_truncate(struct inode *inode, int64_t size);
void inode_sync(struct inode *inode);

/* Chooses a file's content after a cut. */
struct content {
  uint8_t *bytes;
  bool *written; /* by sector; changes since the last sync */
  int64_t size, room;
};
void content_start(struct content *content, const struct inode *inode); /* the durable part */
void content_write(struct content *content, int64_t at, const uint8_t *bytes, size_t size);
void content_truncate(struct content *content, int64_t size);
void content_resize(struct content *content, int64_t size);   /* if longer, filled with zeros */
void inode_set(struct inode *inode, struct content *content); /* durable; takes the content */

/* ---- names ---- */

struct name {
  char path[240];
  struct inode *inode; /* NULL for a folder */
};
struct names { /* folders before their contents */
  struct name *list;
  size_t n, room;
};
enum name_kind { NAME_CREATED, NAME_REMOVED, NAME_RENAMED, NAME_MADE, NAME_FOLDER_REMOVED };
struct name_change {
  enum name_kind kind;
  char path[240], to[240];
  struct inode *inode; /* for creations and renames */
};
bool name_is_in(const char *path, const char *folder); /* "" is the state folder itself */
struct inode *names_inode(const struct names *names,
                          const char *path); /* NULL if missing, or if it is a folder */
void names_apply(struct names *names,
                 const struct name_change *change); /* as far as the change applies */
void names_copy(struct names *to, const struct names *from);
void names_drop_orphans(struct names *names); /* removes names inside folders that do not exist */
void names_free(struct names *names);

#endif
