// Presses the middle of a tissue: `touch URL SCENE SECONDS`. Prints one line of JSON.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <palpate.hpp>
#include <thread>

static int failed(const palpate::Error& error) { return std::fprintf(stderr, "%s\n", error.words.c_str()), 1; }

int main(int count, char** arguments) {
    if (count != 4) return std::fprintf(stderr, "usage: %s URL SCENE SECONDS\n", arguments[0]), 2;
    auto server = palpate::Server::connect(arguments[1]);
    if (!server) return failed(server.error());
    auto session = server->create(arguments[2]);
    if (!session) return failed(session.error());
    palpate::TouchOptions options;
    palpate_limits_of("omega3", &options.limits);
    options.in_tissue_frame = 1;
    options.limits.workspace_radius_m = 1.0;
    auto touch = session->touch(options);
    if (!touch) return failed(touch.error());

    // Down from 5 mm above the middle until there is a force, then 3 mm further.
    const auto extent = session->extent();
    palpate::Reading reading{{extent.middle_m.x, extent.middle_m.y, extent.most_m.z + 0.005}, 1};
    double lowest_m = extent.least_m.z - 0.02, most_n = 0.0;
    const auto begin = std::chrono::steady_clock::now();
    int ticks = 0;
    for (; ticks < 1000 * std::atof(arguments[3]); ticks++) {
        const std::chrono::duration<double> time = std::chrono::steady_clock::now() - begin;
        const auto felt = touch->tick(reading, time.count());
        const double force_n = std::hypot(felt.force_n.x, felt.force_n.y, felt.force_n.z);
        if (most_n < 0.02 && force_n >= 0.02) lowest_m = reading.position.z - 0.003;
        most_n = std::fmax(most_n, force_n);
        if (reading.position.z > lowest_m) reading.position.z -= 20e-6;
        std::this_thread::sleep_until(begin + std::chrono::milliseconds(ticks + 1));
    }
    std::printf("{\"ticks\":%d,\"force_max_n\":%.4f}\n", ticks, most_n);
    session->remove();
}
