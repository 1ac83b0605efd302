/* disk_state.h: the parts of a disk: files with their unsynced writes, and names that lead to them.
 * For disk.c alone.
 *
 * Running out of memory ends the test; the allocators that fail on demand are others. */
#ifndef MORPHO_TESTS_STORE_DISK_STATE_H
#define MORPHO_TESTS_STORE_DISK_STATE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define SECTOR 512

void *disk_memory(void *old, size_t size); /* as realloc; never NULL */

/* ---- data ---- */

struct piece { /* a write, or with bytes NULL a truncation (or extension) to `at` */
  int64_t at;
  size_t size;
  uint8_t *bytes;
};
struct inode {
  uint8_t *bytes; /* (size) certain */
  int64_t size, room;
  struct piece *pending; /* (n) since then, in their order */
  size_t n, pending_room;
  struct inode *next;
};
struct inode *inode_new(struct inode **list);
void inodes_free(struct inode **list);
void inode_write(struct inode *inode, int64_t at, const void *bytes, size_t size);
void inode_truncate(struct inode *inode, int64_t size);
void inode_sync(struct inode *inode);

/* A file as it comes out of a cut. */
struct content {
  uint8_t *bytes;
  bool *written; /* by sector: since the last sync */
  int64_t size, room;
};
void content_start(struct content *content, const struct inode *inode); /* what is certain */
void content_write(struct content *content, int64_t at, const uint8_t *bytes, size_t size);
void content_truncate(struct content *content, int64_t size);
void content_resize(struct content *content, int64_t size); /* longer: zeros */
void inode_set(struct inode *inode,
               struct content *content); /* all of it certain; takes the content */

/* ---- names ---- */

struct name {
  char path[240];
  struct inode *inode; /* NULL: a folder */
};
struct names { /* folders before what is in them */
  struct name *list;
  size_t n, room;
};
enum name_kind { NAME_CREATED, NAME_REMOVED, NAME_RENAMED, NAME_MADE, NAME_FOLDER_REMOVED };
struct name_change {
  enum name_kind kind;
  char path[240], to[240];
  struct inode *inode; /* created, renamed */
};
bool name_is_in(const char *path, const char *folder); /* "" : the state folder */
struct inode *names_inode(const struct names *names,
                          const char *path); /* NULL: none, or a folder */
void names_apply(struct names *names, const struct name_change *change); /* as far as it applies */
void names_copy(struct names *to, const struct names *from);
void names_drop_orphans(struct names *names); /* what is in folders that are not there */
void names_free(struct names *names);

#endif
