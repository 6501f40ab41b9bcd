/* Slopes of the frames in a stream of ImageStreamIO (milk, cacao), published as another stream.
 *
 *     faintspot export library faintspot.toml -o library
 *     cc -O2 -Ilibrary -o streams streams.c -Llibrary -lfaintspot -Wl,-rpath,$PWD/library
 *     ./streams library/faintspot.bundle wfs wfs_slopes [poll]
 *
 * Frames are uint16 or float32 and are measured where they are, by one thread. It waits on a semaphore; with
 * "poll" it reads the counter all the time, which takes a processor. Slopes are float32, size (2 n, 1): all x, then
 * all y [px]; the keyword FRAME is the frame's counter less one. A frame that changes while it is measured is
 * not published. SIGINT and SIGTERM end it, and the end of the frames' stream. */
#include "image_stream.h"
#include "faintspot.h"

static volatile sig_atomic_t stopped;
static void stop(int number) { stopped = number; }
static int failed(const char *name, const char *error) { return fprintf(stderr, "streams: %s: %s\n", name, error), 1; }

int main(int argc, char **argv) {
    int polls = argc == 5 && !strcmp(argv[4], "poll");
    if (argc != 4 + polls || !strcmp(argv[2], argv[3])) return fprintf(stderr, "usage: streams BUNDLE FRAMES SLOPES [poll]\n"), 2;
    stream frames, out;
    const char *error = stream_open(&frames, argv[2]);
    if (error) return failed(argv[2], error);
    faintspot *sensor = faintspot_open(argv[1], frames.head->type == UINT16 ? FAINTSPOT_UINT16 : FAINTSPOT_FLOAT32, 1, &error);
    if (!sensor) return failed(argv[1], error);
    const faintspot_sensor *size = faintspot_describe(sensor);
    const faintspot_slopes *slopes = faintspot_results(sensor);
    size_t n = size->subapertures, measured = 0;
    if ((int)frames.head->size[0] != size->frame_width || (int)frames.head->size[1] != size->frame_height)
        return fprintf(stderr, "streams: %s: %u x %u pixels, expected %d x %d\n", argv[2], frames.head->size[0], frames.head->size[1], size->frame_width, size->frame_height), 1;
    faintspot_measure(sensor, 0, frames.values, 0, size->groups); /* code and tables are in memory then */
    uint64_t first = frames.head->count, last = first;
    if (!polls && !stream_join(&frames)) return failed(argv[2], "other programs wait on all semaphores; end one, or poll");
    sigaction(SIGINT, &(struct sigaction){.sa_handler = stop}, NULL);
    sigaction(SIGTERM, &(struct sigaction){.sa_handler = stop}, NULL);
    if ((error = stream_create(&out, argv[3], FLOAT32, 2 * n, 1))) return stream_leave(&frames), failed(argv[3], error);
    float *values = out.values;
    for (unsigned idle = 0; !stopped;) {
        uint64_t count = frames.head->count;
        if (count == last || frames.head->writing) {
            if ((polls ? ++idle % (1u << 20) != 0 : stream_wait(&frames)) || stream_is_same(&frames)) continue;
            error = "was removed or created again";
            break;
        }
        faintspot_measure(sensor, 0, frames.values, 0, size->groups);
        faintspot_finish(sensor, 0, frames.values);
        atomic_thread_fence(memory_order_seq_cst);
        if (frames.head->writing || frames.head->count != count) continue;
        stream_begin(&out);
        memcpy(values, slopes->x, n * sizeof *values);
        memcpy(values + n, slopes->y, n * sizeof *values);
        stream_publish(&out, (int64_t)count - 1);
        last = count, measured++;
    }
    printf("%zu frames, %lld lost\n", measured, (long long)(last - first - measured));
    stream_leave(&frames);
    if (stream_is_same(&out)) unlink(out.path);
    faintspot_destroy(sensor);
    return error ? failed(argv[2], error) : 0;
}
