/* disk_state.c: files with their unsynced writes, and the names that refer to them. */
#include "disk_state.h"

#include <malloc.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void *disk_memory(void *old, size_t size)
{
  const size_t before = old != NULL ? malloc_usable_size(old) : 0;
  void *bytes = NULL;
  if (posix_memalign(&bytes, 16, size > 0 ? size : 1) != 0)
    abort();
  if (before > 0)
    memcpy(bytes, old, before < size ? before : size);
  free(old);
  return bytes;
}

/* ---- data ---- */

struct inode *inode_new(struct inode **list)
{
  struct inode *inode = disk_memory(NULL, sizeof(*inode));
  *inode = (struct inode){.next = *list};
  *list = inode;
  return inode;
}

static void forget_pending(struct inode *inode)
{
  for (size_t i = 0; i < inode->n; i++)
    free(inode->pending[i].bytes);
  inode->n = 0;
}

void inodes_free(struct inode **list)
{
  while (*list != NULL) {
    struct inode *inode = *list;
    *list = inode->next;
    forget_pending(inode);
    free(inode->pending);
    free(inode->bytes);
    free(inode);
  }
}

static struct piece *add_piece(struct inode *inode)
{
  if (inode->n == inode->pending_room) {
    inode->pending_room = 2 * inode->pending_room + 16;
    inode->pending = disk_memory(inode->pending, inode->pending_room * sizeof(*inode->pending));
  }
  return &inode->pending[inode->n++];
}

void inode_write(struct inode *inode, int64_t at, const void *bytes, size_t size)
{
  struct piece *piece = add_piece(inode);
  *piece = (struct piece){at, size, disk_memory(NULL, size)};
  memcpy(piece->bytes, bytes, size);
}

void inode_truncate(struct inode *inode, int64_t size)
{
  *add_piece(inode) = (struct piece){.at = size};
}

static void set_size(struct inode *inode, int64_t size)
{
  if (size > inode->room) {
    inode->room = 2 * size;
    inode->bytes = disk_memory(inode->bytes, (size_t)inode->room);
  }
  if (size > inode->size)
    memset(inode->bytes + inode->size, 0, (size_t)(size - inode->size));
  inode->size = size;
}

void inode_sync(struct inode *inode)
{
  for (size_t i = 0; i < inode->n; i++) {
    const struct piece *piece = &inode->pending[i];
    const int64_t end = piece->at + (int64_t)piece->size;
    if (piece->bytes == NULL || end > inode->size)
      set_size(inode, end);
    if (piece->bytes != NULL && piece->size > 0)
      memcpy(inode->bytes + piece->at, piece->bytes, piece->size);
  }
  forget_pending(inode);
}

void content_resize(struct content *content, int64_t size)
{
  if (size > content->room) {
    const int64_t room = 2 * size;
    const size_t before = (size_t)(content->room / SECTOR + 1), after = (size_t)(room / SECTOR + 1);
    content->bytes = disk_memory(content->bytes, (size_t)room);
    content->written = disk_memory(content->written, after * sizeof(*content->written));
    memset(content->written + (content->room > 0 ? before : 0), 0,
           (after - (content->room > 0 ? before : 0)) * sizeof(*content->written));
    content->room = room;
  }
  if (size > content->size)
    memset(content->bytes + content->size, 0, (size_t)(size - content->size));
  content->size = size;
}

void content_start(struct content *content, const struct inode *inode)
{
  content_resize(content, inode->size);
  if (inode->size > 0)
    memcpy(content->bytes, inode->bytes, (size_t)inode->size);
}

void content_write(struct content *content, int64_t at, const uint8_t *bytes, size_t size)
{
  const int64_t end = at + (int64_t)size;
  if (end > content->size)
    content_resize(content, end);
  memcpy(content->bytes + at, bytes, size);
  content->written[at / SECTOR] = true;
}

void content_truncate(struct content *content, int64_t size)
{
  content_resize(content, size);
}

void inode_set(struct inode *inode, struct content *content)
{
  inode->bytes = content->bytes;
  inode->size = content->size;
  inode->room = content->room;
  free(content->written);
  *content = (struct content){0};
}

/* ---- names ---- */

bool name_is_in(const char *path, const char *folder)
{
  const size_t n = strlen(folder);
  if (n == 0)
    return strchr(path, '/') == NULL;
  return strncmp(path, folder, n) == 0 && path[n] == '/' && strchr(path + n + 1, '/') == NULL;
}

static size_t find(const struct names *names, const char *path)
{
  size_t i = 0;
  while (i < names->n && strcmp(names->list[i].path, path) != 0)
    i++;
  return i;
}

struct inode *names_inode(const struct names *names, const char *path)
{
  const size_t i = find(names, path);
  return i < names->n ? names->list[i].inode : NULL;
}

static void put(struct names *names, const char *path, struct inode *inode)
{
  const size_t i = find(names, path);
  if (i == names->room) {
    names->room = 2 * names->room + 16;
    names->list = disk_memory(names->list, names->room * sizeof(*names->list));
  }
  names->n += i == names->n;
  memmove(names->list[i].path, path, strlen(path) + 1);
  names->list[i].inode = inode;
}

static void take(struct names *names, size_t i)
{
  memmove(&names->list[i], &names->list[i + 1], (--names->n - i) * sizeof(*names->list));
}

void names_apply(struct names *names, const struct name_change *change)
{
  const size_t i = find(names, change->path), length = strlen(change->path);
  const bool is_there = i < names->n;
  switch (change->kind) {
  case NAME_CREATED: put(names, change->path, change->inode); break;
  case NAME_MADE: put(names, change->path, NULL); break;
  case NAME_REMOVED:
    if (is_there)
      take(names, i);
    break;
  case NAME_RENAMED: /* another file with this name, or no file: the name's creation has not
                        happened */
    if (!is_there || names->list[i].inode != change->inode)
      break;
    take(names, i);
    put(names, change->to, change->inode);
    break;
  case NAME_FOLDER_REMOVED:
    for (size_t k = names->n; k-- > 0;)
      if (strcmp(names->list[k].path, change->path) == 0 ||
          (strncmp(names->list[k].path, change->path, length) == 0 &&
           names->list[k].path[length] == '/'))
        take(names, k);
    break;
  }
}

void names_copy(struct names *to, const struct names *from)
{
  *to = (struct names){.n = from->n, .room = from->n};
  to->list = disk_memory(NULL, from->n * sizeof(*to->list));
  if (from->n > 0)
    memcpy(to->list, from->list, from->n * sizeof(*to->list));
}

static int compare_names(const void *a, const void *b)
{
  return strcmp(((const struct name *)a)->path, ((const struct name *)b)->path);
}

void names_drop_orphans(struct names *names)
{
  size_t left = 0;
  if (names->n > 0)
    qsort(names->list, names->n, sizeof(*names->list),
          compare_names); /* true if the path lies inside the folder */
  for (size_t i = 0; i < names->n; i++) {
    const char *slash = strrchr(names->list[i].path, '/');
    char folder[240] = "";
    size_t k = 0;
    if (slash != NULL)
      memcpy(folder, names->list[i].path, (size_t)(slash - names->list[i].path));
    while (slash != NULL && k < left && strcmp(names->list[k].path, folder) != 0)
      k++;
    if (slash == NULL || k < left)
      names->list[left++] = names->list[i];
  }
  names->n = left;
}

void names_free(struct names *names)
{
  free(names->list);
  *names = (struct names){0};
}
