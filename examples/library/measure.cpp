// Measure the slopes of one raw frame of uint16 in C++; see measure.c.
#include <cstdint>
#include <fstream>
#include <iostream>
#include <memory>
#include <vector>
#include "faintspot.h"

int main(int argc, char **argv) {
    if (argc != 3) return std::cerr << "usage: measure BUNDLE FRAME\n", 2;
    const char *error = nullptr;
    std::unique_ptr<faintspot, decltype(&faintspot_destroy)> sensor(
        faintspot_open(argv[1], FAINTSPOT_UINT16, 1, &error), faintspot_destroy);
    if (!sensor) return std::cerr << error << '\n', 1;
    const faintspot_sensor &size = *faintspot_describe(sensor.get());
    std::vector<std::uint16_t> frame(static_cast<std::size_t>(size.frame_height) * size.frame_width);
    std::ifstream(argv[2], std::ios::binary).read(reinterpret_cast<char *>(frame.data()), 2 * frame.size());
    faintspot_measure(sensor.get(), 0, frame.data(), 0, size.groups);
    faintspot_finish(sensor.get(), 0, frame.data());
    const faintspot_slopes &slopes = *faintspot_results(sensor.get());
    for (int k = 0; k < size.subapertures; k++) std::cout << slopes.x[k] << ' ' << slopes.y[k] << ' ' << int(slopes.flags[k]) << '\n';
}
