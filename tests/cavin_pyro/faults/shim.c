/* Faults of the disk, on purpose: loaded with LD_PRELOAD (shim.py builds it), idle until `fault_arm` is called.

   Counts write, pwrite, writev, fsync, fdatasync and rename on what lies beneath one folder, in this process and in
   those that it starts, appends a line for each to a record, and lets one of them go wrong:

     kill-before, kill-after  SIGKILL before or after the call
     torn                     half of the bytes arrive, then SIGKILL
     no-space                 half of the bytes arrive; from then on the disk is full (ENOSPC)
     io-error                 EIO, once

   It makes system calls itself, so it needs no symbol of the library that it stands before. Standard streams are not
   counted. Calls within the C library (fwrite) do not pass through here; no part of the program writes with them. */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum kind { NONE, KILL_BEFORE, KILL_AFTER, TORN, NO_SPACE, IO_ERROR };
static const char *const KINDS[] = {"none", "kill-before", "kill-after", "torn", "no-space", "io-error"};

struct counts { /* shared by all of these processes */
    atomic_int seen, full;
};

static struct counts *counts;
static char folder[PATH_MAX], operation[16], name[PATH_MAX];
static enum kind kind;
static int count, record = -1;

static const char *set(const char *variable) {
    const char *value = getenv(variable);
    return value ? value : "";
}

/* Begin as the environment says: FAULT_FOLDER, where calls count; FAULT_RECORD, a file that gets a line for each; and
   which one goes wrong how: FAULT_KIND, FAULT_OPERATION (write, fsync, rename, or any of any file), FAULT_NAME (of a
   file within the folder, as `label` has it), FAULT_COUNT (the first such call is 1). Programs that are started inherit it all.
   Returns 0, or -1 for an unknown kind or a failure to begin. */
int fault_arm(void) {
    char shared[PATH_MAX];
    for (kind = NONE; kind <= IO_ERROR && strcmp(KINDS[kind], set("FAULT_KIND"));) kind++;
    if (kind > IO_ERROR) return -1;
    snprintf(folder, sizeof folder, "%s/", set("FAULT_FOLDER"));
    snprintf(operation, sizeof operation, "%s", set("FAULT_OPERATION"));
    snprintf(name, sizeof name, "%s", set("FAULT_NAME"));
    snprintf(shared, sizeof shared, "%s.counts", set("FAULT_RECORD"));
    count = atoi(set("FAULT_COUNT"));
    int file = open(shared, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (file < 0 || ftruncate(file, sizeof *counts)) return -1;
    counts = mmap(NULL, sizeof *counts, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (counts == MAP_FAILED) return -1;
    record = open(set("FAULT_RECORD"), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    return record < 0 ? -1 : 0;
}

__attribute__((constructor)) static void begin(void) {
    if (getenv("FAULT_FOLDER")) fault_arm();
}

static void label(const char *path, char *into, size_t size) {
    /* The path within the folder, with * for what differs from run to run: random digits, times and processes, and the
       names of temporary files that were deleted or never had one. */
    snprintf(into, size, "%s", path + strlen(folder));
    for (char *found = into; (found = strstr(found, ".cavin-")); found += 8) {
        char *digits = found + strlen(".cavin-");
        if (strlen(digits) >= 8) memmove(digits + 1, digits + 8, strlen(digits + 8) + 1), digits[0] = '*';
    }
    char *rest = strstr(into, ".tfevents.");
    if (rest) strcpy(rest + strlen(".tfevents."), "*");
    size_t length = strlen(into), end = strlen(" (deleted)");
    if (length > end && !strcmp(into + length - end, " (deleted)")) {
        rest = strrchr(into, '/');
        strcpy(rest ? rest + 1 : into, "*");
    }
}

/* What happens to this call. */
static enum kind fate(const char *of_call, const char *path) {
    if (record < 0 || strncmp(path, folder, strlen(folder))) return NONE;
    char labelled[PATH_MAX], line[PATH_MAX + 32];
    label(path, labelled, sizeof labelled);
    int any = !strcmp(operation, "any");
    int hit = kind != NONE && (any || (!strcmp(of_call, operation) && !strcmp(labelled, name)));
    hit = hit && atomic_fetch_add(&counts->seen, 1) + 1 == count;
    int length = snprintf(line, sizeof line, "%s\t%s\t%s\n", of_call, labelled, hit ? KINDS[kind] : "");
    syscall(SYS_write, record, line, (size_t)length);
    if (!hit) return atomic_load(&counts->full) && !strcmp(of_call, "write") ? NO_SPACE : NONE;
    return kind;
}

static enum kind fate_of_descriptor(const char *of_call, int descriptor) {
    if (record < 0 || descriptor <= 2 || descriptor == record) return NONE;
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return NONE;
    path[length] = 0;
    return fate(of_call, path);
}

static void die(void) {
    syscall(SYS_kill, getpid(), SIGKILL);
    for (;;) pause();
}

static ssize_t refuse(int number) {
    errno = number;
    return -1;
}

/* A write of several pieces at a place, or at the current one where `at` is negative. */
static ssize_t pieces_at(int descriptor, const struct iovec *pieces, int number, off_t at) {
    if (at < 0) return syscall(SYS_writev, descriptor, pieces, number);
    return syscall(SYS_pwritev, descriptor, pieces, number, (unsigned long)at, 0UL);
}

static ssize_t half_of(int descriptor, const struct iovec *pieces, int number, size_t total, off_t at) {
    size_t left = total / 2;
    ssize_t done = 0;
    for (int one = 0; one < number && left; one++) {
        struct iovec piece = {pieces[one].iov_base, pieces[one].iov_len < left ? pieces[one].iov_len : left};
        ssize_t made = pieces_at(descriptor, &piece, 1, at < 0 ? at : at + done);
        if (made < 0) return made;
        done += made, left -= piece.iov_len;
    }
    return done;
}

static ssize_t write_pieces(int descriptor, const struct iovec *pieces, int number, off_t at) {
    size_t total = 0;
    for (int one = 0; one < number; one++) total += pieces[one].iov_len;
    enum kind now = total ? fate_of_descriptor("write", descriptor) : NONE;
    if (now == KILL_BEFORE) die();
    if (now == IO_ERROR) return refuse(EIO);
    if (now == NO_SPACE) {
        if (atomic_exchange(&counts->full, 1) || total < 2) return refuse(ENOSPC);
        return half_of(descriptor, pieces, number, total, at);
    }
    if (now == TORN) half_of(descriptor, pieces, number, total, at), die();
    ssize_t done = pieces_at(descriptor, pieces, number, at);
    if (now == KILL_AFTER) die();
    return done;
}

ssize_t write(int descriptor, const void *bytes, size_t size) {
    if (record < 0) return syscall(SYS_write, descriptor, bytes, size);
    struct iovec piece = {(void *)bytes, size};
    return write_pieces(descriptor, &piece, 1, -1);
}

ssize_t writev(int descriptor, const struct iovec *pieces, int number) {
    return write_pieces(descriptor, pieces, number, -1);
}

ssize_t pwrite(int descriptor, const void *bytes, size_t size, off_t at) {
    struct iovec piece = {(void *)bytes, size};
    return write_pieces(descriptor, &piece, 1, at);
}

ssize_t pwrite64(int descriptor, const void *bytes, size_t size, off_t at) {
    return pwrite(descriptor, bytes, size, at);
}

/* A call without bytes. */
#define FAULTY(NOW, CALL)                                     \
    do {                                                      \
        enum kind now = NOW;                                  \
        if (now == KILL_BEFORE || now == TORN) die();         \
        if (now == IO_ERROR) return (int)refuse(EIO);         \
        if (now == NO_SPACE) {                                \
            atomic_store(&counts->full, 1);                   \
            return (int)refuse(ENOSPC);                       \
        }                                                     \
        int done = (int)(CALL);                               \
        if (now == KILL_AFTER) die();                         \
        return done;                                          \
    } while (0)

int fsync(int descriptor) { FAULTY(fate_of_descriptor("fsync", descriptor), syscall(SYS_fsync, descriptor)); }

int fdatasync(int descriptor) { FAULTY(fate_of_descriptor("fsync", descriptor), syscall(SYS_fdatasync, descriptor)); }

static enum kind fate_of_name(int directory, const char *path) {
    if (record < 0) return NONE;
    char whole[PATH_MAX], link[64];
    if (path[0] == '/') return fate("rename", path);
    snprintf(link, sizeof link, directory == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", directory);
    ssize_t length = readlink(link, whole, sizeof whole - 2);
    if (length < 0 || (size_t)length + 1 + strlen(path) >= sizeof whole) return NONE;
    whole[length] = '/';
    strcpy(whole + length + 1, path);
    return fate("rename", whole);
}

int renameat(int from, const char *old, int to, const char *new) {
    FAULTY(fate_of_name(to, new), syscall(SYS_renameat2, from, old, to, new, 0));
}

int rename(const char *old, const char *new) { return renameat(AT_FDCWD, old, AT_FDCWD, new); }
