/* Streams of ImageStreamIO (milk, cacao), version 2.00, on 64-bit Linux: as much as a program needs that reads or
 * writes images of two axes. Functions return NULL, or what is wrong.
 * SPDX-License-Identifier: BSD-3-Clause */
#ifndef IMAGE_STREAM_H
#define IMAGE_STREAM_H
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <semaphore.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { UINT16 = 3, FLOAT32 = 9, SEMAPHORES = 10, TRACES = 10, MOST_POSTED = 10 };

typedef struct { /* of names that begin with _ the meaning does not matter here */
    char version[32], name[80];
    uint8_t axes;
    uint32_t size[3]; /* columns, rows */
    uint64_t elements;
    uint8_t type;
    uint64_t kind;
    struct timespec created, opened, acquired, written; /* TAI */
    int32_t creator, _owner;
    uint8_t shared;
    uint64_t inode;
    int8_t location; /* -1: not on a GPU */
    uint8_t _status[17];
    uint16_t semaphores, traces;
    _Atomic uint64_t count; /* publications */
    uint64_t _slice, _events;
    _Atomic uint8_t writing;
    uint16_t keywords;
    uint32_t buffered, _buffer[3];
    uint64_t bytes;
    uint8_t _gpu[64];
} stream_head;
typedef struct { char name[16], type; int64_t value, _value; uint64_t count; char comment[80]; } stream_keyword;
_Static_assert(sizeof(stream_head) == 384 && sizeof(stream_keyword) == 128 && sizeof(sem_t) == 32, "64-bit Linux");

typedef struct {
    stream_head *head;
    void *values;
    stream_keyword *keywords; /* the first one of those that are written here: FRAME */
    sem_t *semaphores;        /* and one more, for loggers */
    int32_t *readers, *writers;
    int count, reads;         /* semaphores, and the one that this process has */
    ino_t inode;
    char path[4096];
} stream;

static inline size_t item(uint8_t type) { return type == UINT16 ? 2 : 4; }
static inline size_t whole(size_t bytes) { return (bytes + 7) / 8 * 8; }

/* Set where the parts of a stream are, from the beginning of its memory; return its bytes. */
static inline size_t stream_parts(stream *s, const stream_head *h, char *memory) {
    size_t data = h->elements * item(h->type), list = whole(4 * (size_t)h->semaphores);
    s->head = (void *)memory;
    s->values = memory + sizeof *h;
    s->keywords = (void *)(memory + sizeof *h + whole(data));
    s->semaphores = (void *)(s->keywords + h->keywords);
    s->readers = (void *)(s->semaphores + h->semaphores + 1);
    s->writers = (void *)((char *)s->readers + list);
    s->count = h->semaphores;
    s->reads = -1;
    return (char *)s->readers + 4 * list + 64 * h->traces + 48 * (size_t)h->buffered + whole(data * h->buffered) - memory;
}

static inline int is_alive(pid_t process) { return process > 0 && (!kill(process, 0) || errno == EPERM); }

static inline const char *stream_path(stream *s, const char *name) {
    const char *chosen = getenv("MILK_SHM_DIR"), *usual = access("/milk/shm", X_OK) ? "/tmp" : "/milk/shm";
    const char *folder = chosen && !access(chosen, X_OK) ? chosen : usual;
    if (!*name || strlen(name) > 79 || strchr(name, '/')) return "expected a name of up to 79 characters without /";
    return snprintf(s->path, sizeof s->path, "%s/%s.im.shm", folder, name) < (int)sizeof s->path ? NULL : "the path is too long";
}

/* Open a stream of uint16 or float32 that another program writes. */
static inline const char *stream_open(stream *s, const char *name) {
    struct stat status;
    stream_head h;
    const char *error = stream_path(s, name);
    int file = error ? -1 : open(s->path, O_RDWR | O_NONBLOCK | O_CLOEXEC);
    if (file < 0) return error ? error : strerror(errno);
    char *memory = MAP_FAILED;
    if (fstat(file, &status) || !S_ISREG(status.st_mode) || pread(file, &h, sizeof h, 0) != sizeof h) error = "is not a stream";
    else if (memcmp(h.version, "2.00", 5)) error = "expected version 2.00 of ImageStreamIO";
    else if (h.axes != 2 || !h.elements || h.elements != (uint64_t)h.size[0] * h.size[1]) error = "expected two axes";
    else if ((h.type != UINT16 && h.type != FLOAT32) || h.location != -1) error = "expected uint16 or float32 in CPU memory";
    else if (h.elements > 1 << 28 || stream_parts(s, &h, NULL) != (size_t)status.st_size) error = "its size is not that of its metadata";
    else if ((memory = mmap(NULL, status.st_size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, file, 0)) == MAP_FAILED) error = strerror(errno);
    close(file);
    if (!error) stream_parts(s, &h, memory);
    s->inode = status.st_ino;
    return error;
}

/* Create a stream with the keyword FRAME, unless a living process has one of that name. */
static inline const char *stream_create(stream *s, const char *name, uint8_t type, uint32_t columns, uint32_t rows) {
    char hidden[sizeof s->path + 16];
    struct stat status;
    const char *error = stream_path(s, name);
    if (!error && !access(s->path, F_OK) && !(error = stream_open(s, name)) && is_alive(s->head->creator)) error = "a living process made this stream; stop it";
    if (error) return error;
    snprintf(hidden, sizeof hidden, "%s.%d", s->path, getpid());
    int file = open(hidden, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
    if (file < 0) return strerror(errno);
    stream_head h = {.version = "2.00", .axes = 2, .size = {columns, rows}, .type = type, .kind = 2, .creator = getpid(), .shared = 1, .location = -1, .semaphores = SEMAPHORES, .traces = TRACES, .keywords = 1};
    strcpy(h.name, name);
    h.elements = (uint64_t)columns * rows, h.bytes = h.elements * item(type);
    clock_gettime(CLOCK_TAI, &h.created);
    h.opened = h.created;
    size_t bytes = stream_parts(s, &h, NULL);
    char *memory = MAP_FAILED;
    if (!fstat(file, &status) && !(errno = posix_fallocate(file, 0, bytes))) memory = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, file, 0);
    close(file);
    if (memory != MAP_FAILED) {
        stream_parts(s, &h, memory);
        h.inode = s->inode = status.st_ino;
        *s->head = h;
        strcpy(s->keywords->name, "FRAME"), s->keywords->type = 'L';
        for (int k = 0; k <= SEMAPHORES; k++) sem_init(s->semaphores + k, 1, 0);
        for (int k = 0; k < SEMAPHORES; k++) s->readers[k] = -1, s->writers[k] = h.creator;
    }
    if (memory == MAP_FAILED || rename(hidden, s->path)) error = strerror(errno), unlink(hidden);
    return error;
}

/* Whether the stream's name still leads to it. */
static inline int stream_is_same(const stream *s) {
    struct stat status;
    return !stat(s->path, &status) && status.st_ino == s->inode;
}

/* Take a semaphore that no living process waits on; give it back with stream_leave. */
static inline int stream_join(stream *s) {
    for (int k = 0; k < s->count && s->reads < 0; k++)
        if (!is_alive(s->readers[k])) s->readers[s->reads = k] = getpid();
    return s->reads >= 0;
}
static inline void stream_leave(stream *s) {
    if (s->reads >= 0) s->readers[s->reads] = 0;
}

/* Wait up to 0.1 s for a post, or until a signal; return whether there was one. */
static inline int stream_wait(stream *s) {
    struct timespec end;
    clock_gettime(CLOCK_REALTIME, &end);
    end.tv_nsec += 100000000;
    if (end.tv_nsec >= 1000000000) end.tv_sec++, end.tv_nsec -= 1000000000;
    return !sem_timedwait(s->semaphores + s->reads, &end);
}

/* Publish the values that are written between these two, with the number of their frame. */
static inline void stream_begin(stream *s) {
    s->head->writing = 1;
    atomic_thread_fence(memory_order_seq_cst);
}
static inline void stream_publish(stream *s, int64_t frame) {
    int value;
    s->keywords->value = frame;
    s->keywords->count++;
    clock_gettime(CLOCK_TAI, &s->head->written);
    s->head->acquired = s->head->written;
    s->head->count++;
    s->head->writing = 0;
    for (int k = 0; k <= s->count; k++)
        if (!sem_getvalue(s->semaphores + k, &value) && value < MOST_POSTED) sem_post(s->semaphores + k);
}
#endif
