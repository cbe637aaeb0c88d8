// A complete front end in a terminal: `front_end URL SCENE SECONDS`. A device moves up and down in the middle, on a
// thread of the library; this thread shows the force and the surface along the middle, and makes the tissue softer at
// half time.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <palpate.hpp>
#include <thread>

/// Replace the bodies of its functions with the calls of your device's SDK.
struct Mine : palpate::Device {
    long ticks = 0;
    double most_n = 0.0;
    palpate::Limits limits() override { return {12.0, 12.0, 5000.0, 30.0, 0.075}; }
    bool read(palpate::Reading& reading) override {
        reading.position.z = 0.0005 + 0.0035 * std::cos(3.14159265358979 * double(ticks++) / 1000.0);
        reading.enable = ticks % 500 < 250;  // the button, pressed twice a second
        return true;
    }
    bool write(const palpate::Vector& force_n) override {
        most_n = std::fmax(most_n, force_n.z);
        return true;
    }
};

static int failed(const palpate::Error& error) { return std::fprintf(stderr, "%s\n", error.words.c_str()), 1; }

int main(int count, char** arguments) {
    if (count != 4) return std::fprintf(stderr, "usage: %s URL SCENE SECONDS\n", arguments[0]), 2;
    auto server = palpate::Server::connect(arguments[1]);
    if (!server) return failed(server.error());
    auto session = server->create(arguments[2]);
    if (!session) return failed(session.error());
    auto surface = session->surface();
    if (!surface) return failed(surface.error());
    Mine device;
    auto bridge = session->bridge(device);
    if (!bridge) return failed(bridge.error());
    const int frames = int(60 * std::atof(arguments[3]));
    for (int frame = 0; frame < frames; frame++) {
        const auto dirty = surface->read();
        double deepest_m = 0.0;
        for (std::size_t k = 2; k < surface->positions().size(); k += 3)
            deepest_m = std::fmin(deepest_m, surface->positions()[k]);
        const auto state = bridge->look();
        std::fprintf(stderr, "\rforce %6.3f N, deepest %6.2f mm, %5zu vertices new ", state.force_n.z, 1e3 * deepest_m, dirty.count);
        palpate::Change softer;
        softer.stiffness_n_per_m = 20.0;
        if (frame == frames / 2)
            if (auto error = session->change(softer)) return failed(*error);
        std::this_thread::sleep_for(std::chrono::milliseconds(16));
    }
    auto report = bridge->end();
    if (!report) return failed(report.error());
    std::printf("\n{\"ticks\":%llu,\"force_max_n\":%.4f}\n", static_cast<unsigned long long>(report->ticks), device.most_n);
    session->remove();
}
