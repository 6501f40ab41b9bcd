/* Modules of DARC for trials without hardware, BSD-3-Clause; see faintspot_slope.c on DARC's own licence.
 *
 * Camera: frames of the file CAMERA_FRAMES (uint16, raw), again and again, CAMERA_PERIOD_US apart (0: at once),
 * whose rows arrive within CAMERA_READOUT_US. Reconstructor: writes into the file RING (4097 doubles) how long
 * after the last pixel of a frame its last slope was there [us], and in its first number the last frame. */
#include <fcntl.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>
#include "rtccamera.h"
#include "rtcrecon.h"

static struct { unsigned short *all, *now; unsigned int *number; long pixels, count, period_ns, readout_ns; double due, last; arrayStruct *arrays; } camera;
static struct { double *ring; arrayStruct *arrays; atomic_uint count; int threads; } clocks;

static double now_s(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}
static void wait_until(double s) { /* the last 0.1 ms without sleep, which may take longer */
    double wake = s - 1e-4;
    struct timespec t = {(time_t)wake, (long)(1e9 * (wake - (time_t)wake))};
    prctl(PR_SET_TIMERSLACK, 1);
    if (now_s() < wake) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
    while (now_s() < s) continue;
}
static long number_of(const char *name) { return getenv(name) ? atol(getenv(name)) : 0; }

int camOpen(CAMOPENARGS) {
    FILE *file = fopen(getenv("CAMERA_FRAMES"), "rb");
    if (!file) return 1;
    if (arr->pxlbuftype != 'H' || arr->pxlbufsSize != (int)sizeof(short) * npxls) {
        free(arr->pxlbufs);
        arr->pxlbufs = calloc(npxls, sizeof(short));
        arr->pxlbufsSize = sizeof(short) * npxls;
        arr->pxlbuftype = 'H';
        arr->pxlbufelsize = sizeof(short);
    }
    if (*camframenoSize < ncam) {
        free(*camframeno);
        *camframeno = calloc(ncam, sizeof(int));
        *camframenoSize = ncam;
    }
    fseek(file, 0, SEEK_END);
    camera.pixels = npxls;
    camera.count = ftell(file) / (long)sizeof(short) / npxls;
    rewind(file);
    camera.all = malloc(camera.count * npxls * sizeof(short));
    camera.count = fread(camera.all, npxls * sizeof(short), camera.count, file);
    fclose(file);
    camera.now = arr->pxlbufs;
    camera.number = *camframeno;
    camera.number[0] = -1;
    camera.readout_ns = 1000 * number_of("CAMERA_READOUT_US");
    camera.period_ns = 1000 * number_of("CAMERA_PERIOD_US");
    camera.due = now_s();
    addUserArray(camera.arrays = arr, "lastPixel", &camera.last, 'd', sizeof camera.last);
    *handle = &camera;
    return 0;
}

int camClose(CAMCLOSEARGS) {
    if (*camHandle) removeUserArray(camera.arrays, "lastPixel"), free(camera.all);
    *camHandle = NULL;
    return 0;
}

int camNewFrameSync(CAMNEWFRAMESYNCARGS) {
    double now = now_s();
    camera.due += 1e-9 * camera.period_ns;
    if (!camera.period_ns || now > camera.due) camera.due = now; /* too slow */
    else wait_until(camera.due);
    camera.last = camera.due + 1e-9 * camera.readout_ns;
    camera.number[0]++;
    memcpy(camera.now, camera.all + camera.number[0] % camera.count * camera.pixels, camera.pixels * sizeof(short));
    return 0;
}

int camWaitPixels(CAMWAITPIXELSARGS) {
    if (camera.readout_ns) wait_until(camera.due + 1e-9 * camera.readout_ns * (n < camera.pixels ? n : camera.pixels) / camera.pixels);
    return 0;
}

int reconOpen(RECONOPENARGS) {
    int file = open(getenv("RING"), O_RDWR | O_CREAT, 0600);
    if (file < 0 || ftruncate(file, 4097 * sizeof(double))) return 1;
    clocks.ring = mmap(0, 4097 * sizeof(double), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    clocks.arrays = arr;
    clocks.threads = nthreads;
    *handle = &clocks;
    return clocks.ring == MAP_FAILED;
}
int reconClose(RECONCLOSEARGS) {
    *reconHandle = NULL;
    return 0;
}
int reconEndFrame(RECONENDFRAMEARGS) {
    unsigned done = atomic_fetch_add(&clocks.count, 1);
    UserArrayStruct *last = getUserArray(clocks.arrays, "lastPixel");
    if (!last || (done + 1) % clocks.threads) return 0; /* not the last thread of the frame */
    clocks.ring[1 + done / clocks.threads % 4096] = 1e6 * (now_s() - *(double *)last->ptr);
    clocks.ring[0] = done / clocks.threads;
    return 0;
}
