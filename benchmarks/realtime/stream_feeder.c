/* Publish frames in a stream of ImageStreamIO every millisecond, and note when the slopes of each are published.
 *
 * Usage: stream_feeder FRAMES SLOPES PIXELS COLUMNS ROWS COUNT TIMES. PIXELS has raw frames of uint16, which are
 * repeated. TIMES gets four int64 [ns, TAI] for each of COUNT frames, after SETTLING others: when its counter
 * changed, when that of its slopes was seen to change (0: never), the stamp of the slopes, and for how long this
 * process had not looked. */
#include "image_stream.h"

enum { PERIOD_NS = 1000000, SETTLING = 1000, PATIENCE = 120000, AFTER = 100 };
typedef struct { int64_t sent, seen, stamp, away; } times;

static int64_t in_ns(const struct timespec *t) { return t->tv_sec * 1000000000LL + t->tv_nsec; }
static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_TAI, &t);
    return in_ns(&t);
}

int main(int argc, char **argv) {
    if (argc != 8) return 2;
    long columns = atol(argv[4]), rows = atol(argv[5]), count = atol(argv[6]), first = -1;
    size_t bytes = 2 * columns * rows;
    stream frames, slopes;
    struct stat status;
    int file = open(argv[3], O_RDONLY);
    const char *error = stream_create(&frames, argv[1], UINT16, columns, rows);
    const char *pixels = file < 0 || fstat(file, &status) ? MAP_FAILED : mmap(NULL, status.st_size, PROT_READ, MAP_SHARED | MAP_POPULATE, file, 0);
    times *noted = calloc(count, sizeof *noted);
    if (error || pixels == MAP_FAILED || !noted) return fprintf(stderr, "stream_feeder: %s\n", error ? error : strerror(errno)), 1;
    uint64_t published = 0;
    int64_t due = now_ns(), looked = due;
    for (long number = 0; first < 0 ? number < PATIENCE : number < first + count + AFTER; number++) {
        stream_begin(&frames);
        memcpy(frames.values, pixels + number % (status.st_size / bytes) * bytes, bytes);
        stream_publish(&frames, number);
        if (first >= 0 && number >= first && number < first + count) noted[number - first].sent = in_ns(&frames.head->written);
        if (first < 0 && !stream_open(&slopes, argv[2])) first = number + SETTLING;
        due = now_ns() > due + PERIOD_NS ? now_ns() : due + PERIOD_NS; /* no haste after a delay */
        for (int64_t now; (now = now_ns()) < due; looked = now) {
            if (first < 0 || slopes.head->count == published) continue;
            long place = slopes.keywords->value - first;
            published = slopes.head->count;
            if (place < 0 || place >= count) continue;
            noted[place] = (times){noted[place].sent, now, in_ns(&slopes.head->written), now - looked};
            if (place % (count / 20 + 1) == 0) fprintf(stderr, "\r  %3ld %%", 100 * place / count); /* seldom: it takes time */
        }
    }
    fputs("\r         \r", stderr);
    FILE *out = first < 0 ? NULL : fopen(argv[7], "wb");
    return !out || fwrite(noted, sizeof *noted, count, out) != (size_t)count || fclose(out);
}
