/* A disk that breaks: while the file CANGATE_TEST_BROKEN exists, what is written below CANGATE_TEST_DISK ends with EIO. For
   LD_PRELOAD; built by tests/disks.rs with the compiler that links Rust programs. */

#define _GNU_SOURCE
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static int is_broken(int file)
{
    const char *disk = getenv("CANGATE_TEST_DISK"), *broken = getenv("CANGATE_TEST_BROKEN");
    char link[32], place[4096];
    ssize_t length;
    if (!disk || !broken || access(broken, F_OK) != 0)
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    length = readlink(link, place, sizeof place - 1);
    if (length < 0)
        return 0;
    place[length] = 0;
    return strncmp(place, disk, strlen(disk)) == 0;
}

#define UNLESS_BROKEN(file, call)                                                                                              \
    do {                                                                                                                       \
        int before = errno;                                                                                                    \
        if (is_broken(file)) {                                                                                                 \
            errno = EIO;                                                                                                       \
            return -1;                                                                                                         \
        }                                                                                                                      \
        errno = before;                                                                                                        \
        return call;                                                                                                           \
    } while (0)

ssize_t write(int file, const void *bytes, size_t count) { UNLESS_BROKEN(file, syscall(SYS_write, file, bytes, count)); }

ssize_t writev(int file, const struct iovec *parts, int count) { UNLESS_BROKEN(file, syscall(SYS_writev, file, parts, count)); }

ssize_t pwrite64(int file, const void *bytes, size_t count, off64_t at)
{
    UNLESS_BROKEN(file, syscall(SYS_pwrite64, file, bytes, count, at));
}

int fsync(int file) { UNLESS_BROKEN(file, (int)syscall(SYS_fsync, file)); }

int fdatasync(int file) { UNLESS_BROKEN(file, (int)syscall(SYS_fdatasync, file)); }

int ftruncate64(int file, off64_t length) { UNLESS_BROKEN(file, (int)syscall(SYS_ftruncate, file, length)); }
