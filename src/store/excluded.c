/* excluded.c: see excluded.h. */
#include "store/excluded.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/statvfs.h>

#include "base/thread.h"
#include "store/folder.h"

#define SYNC_BYTES (UINT64_C(16) << 20) /* per sync, so that a shutdown does not wait for more */

/* ---- existing files ---- */

struct file {
  char name[MO_EXCLUDED_NAME_BYTES];
  uint64_t key, bytes;
  struct timespec used;
};

bool mo_excluded_name_read(const char *name, struct mo_sha256 *controller, uint64_t *key)
{
  const size_t digits = strspn(name, "0123456789abcdef");
  char again[MO_EXCLUDED_NAME_BYTES];
  if (mo_sha256_from_hex(name, digits, controller) != MO_OK || name[digits] != '-')
    return false;
  *key = strtoull(name + digits + 1, NULL, 16);
  snprintf(again, sizeof(again), MO_EXCLUDED_NAME, MO_SHA256_HEX(controller), *key);
  return strcmp(again, name) == 0;
}

/* Calls `see` with each file until it returns false. */
static void each(const struct mo_store *store, bool (*see)(void *context, const struct file *file),
                 void *context)
{
  DIR *folder = opendir(store->excluded_path);
  const struct dirent *entry;
  bool goes_on = folder != NULL;
  while (goes_on && (entry = readdir(folder)) != NULL) {
    struct mo_sha256 controller;
    struct file file;
    struct stat status;
    if (!mo_excluded_name_read(entry->d_name, &controller, &file.key) ||
        fstatat(dirfd(folder), entry->d_name, &status, AT_SYMLINK_NOFOLLOW) != 0 ||
        !S_ISREG(status.st_mode))
      continue;
    memcpy(file.name, entry->d_name, sizeof(file.name)); /* the length of the name was checked */
    file.bytes = (uint64_t)status.st_size;
    file.used = status.st_mtim;
    goes_on = see(context, &file);
  }
  if (folder != NULL)
    (void)closedir(folder);
}

static void remove_file(struct mo_store *store, const char *name)
{
  char path[PATH_MAX];
  snprintf(path, sizeof(path), "%s/%s", store->excluded_path, name);
  (void)store->files->unlink(path);
}

/* ---- space ---- */

struct counting {
  uint64_t bytes; /* of all */
  struct file oldest;
};

static bool is_before(const struct timespec *a, const struct timespec *b)
{
  return a->tv_sec != b->tv_sec ? a->tv_sec < b->tv_sec : a->tv_nsec < b->tv_nsec;
}

static bool count(void *context, const struct file *file)
{
  struct counting *counting = context;
  counting->bytes += file->bytes;
  if (counting->oldest.name[0] == '\0' || is_before(&file->used, &counting->oldest.used))
    counting->oldest = *file;
  return true;
}

/* Removes files until `bytes` more fit into the budget. */
static int make_room(struct mo_store *store, uint64_t bytes)
{
  const uint64_t most = store->max_excluded_bytes;
  struct statvfs disk;
  if (bytes > most)
    return most == 0 ? MO_ERR_UNSUPPORTED : MO_ERR_LIMIT;
  for (;;) {
    struct counting counting = {.bytes = 0};
    each(store, count, &counting);
    if (counting.bytes <= most - bytes)
      break;
    remove_file(store, counting.oldest.name);
    const uint64_t before = counting.bytes;
    counting = (struct counting){.bytes = 0};
    each(store, count, &counting);
    if (counting.bytes >= before)
      return MO_ERR_IO; /* it cannot be removed */
  }
  if (atomic_load(&store->is_short) ||
      (statvfs(store->excluded_path, &disk) == 0 && disk.f_bavail * disk.f_frsize / 2 < bytes))
    return MO_ERR_NO_SPACE;
  return MO_OK;
}

/* ---- use ---- */

struct looking {
  uint64_t key;
  struct file found;
};

static bool is_of_key(void *context, const struct file *file)
{
  struct looking *looking = context;
  if (file->key == looking->key)
    looking->found = *file;
  return file->key != looking->key;
}

int mo_store_excluded_open(struct mo_store *store, uint64_t key)
{
  struct looking looking = {.key = key};
  char path[PATH_MAX];
  (void)make_room(store, 0); /* the budget may have shrunk */
  each(store, is_of_key, &looking);
  if (looking.found.name[0] == '\0')
    return MO_ERR_NOT_FOUND;
  snprintf(path, sizeof(path), "%s/%s", store->excluded_path, looking.found.name);
  const int fd = store->files->open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW);
  if (fd < 0)
    return errno == ENOENT ? MO_ERR_NOT_FOUND : mo_file_error();
  (void)futimens(fd, NULL);
  return fd;
}

void mo_store_excluded_remove(struct mo_store *store, uint64_t key)
{
  struct looking looking = {.key = key};
  for (int i = 0; i < 1000; i++) { /* a file that cannot be removed does not stop the service */
    looking.found.name[0] = '\0';
    each(store, is_of_key, &looking);
    if (looking.found.name[0] == '\0')
      return;
    remove_file(store, looking.found.name);
  }
}

/* ---- writing ---- */

struct writing {
  struct mo_store *store;
  const volatile int *cancel;
  int fd;
  uint64_t unsynced;
};

static int put(void *context, const void *bytes, size_t size)
{
  struct writing *writing = context;
  const struct mo_file_operations *files = writing->store->files;
  for (size_t written = 0; written < size;) {
    if (mo_is_cancelled(writing->cancel))
      return MO_ERR_CANCELLED;
    if (atomic_load(&writing->store->is_short))
      return MO_ERR_NO_SPACE;
    const ssize_t n = files->write(writing->fd, (const char *)bytes + written, size - written);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return mo_file_error();
    written += (size_t)n;
  }
  writing->unsynced += size;
  if (writing->unsynced < SYNC_BYTES)
    return MO_OK;
  writing->unsynced = 0;
  return files->sync(writing->fd) == 0 ? MO_OK : mo_file_error();
}

/* If the folder is not synced, the name may be lost, but nothing else. */
static void sync_folder(const struct mo_store *store)
{
  const int fd = store->files->open(store->excluded_path, O_RDONLY | O_CLOEXEC | O_DIRECTORY);
  if (fd >= 0) {
    (void)store->files->sync(fd);
    (void)store->files->close(fd);
  }
}

int mo_store_excluded_write(struct mo_store *store, const struct mo_sha256 *controller,
                            uint64_t key, uint64_t bytes, const volatile int *cancel,
                            int (*make)(void *context,
                                        int (*put)(void *file, const void *bytes, size_t size),
                                        void *file),
                            void *context)
{
  const struct mo_file_operations *files = store->files;
  struct writing writing = {.store = store, .cancel = cancel};
  char temporary[PATH_MAX], path[PATH_MAX];
  MO_GUARD(&store->excluded_mutex);
  int error = store->files->mkdir(store->excluded_path, 0700) == 0 || errno == EEXIST
                  ? make_room(store, bytes)
                  : mo_file_error();
  if (error != MO_OK)
    return error;
  snprintf(temporary, sizeof(temporary), "%s/.tmp-%u", store->excluded_path,
           atomic_fetch_add(&store->file_counter, 1));
  snprintf(path, sizeof(path), "%s/" MO_EXCLUDED_NAME, store->excluded_path,
           MO_SHA256_HEX(controller), key);
  writing.fd = files->open(temporary, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (writing.fd < 0)
    return mo_file_error();
  error = make(context, put, &writing);
  if (error == MO_OK && files->sync(writing.fd) != 0)
    error = mo_file_error();
  if (files->close(writing.fd) != 0 && error == MO_OK)
    error = mo_file_error();
  if (error == MO_OK && files->rename(temporary, path) != 0)
    error = mo_file_error();
  if (error != MO_OK)
    (void)files->unlink(temporary);
  else
    sync_folder(store);
  return error;
}
