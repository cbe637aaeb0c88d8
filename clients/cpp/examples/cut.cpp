// Cuts a tissue, sews it and burns it: `cut URL SCENE`, for a sheet such as liver. A device of your own leads a blade; then a thread
// through four places draws the lips of the cut together; then a hot tip is held on a place until that has burnt through.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <palpate.hpp>
#include <thread>

/// Goes down to 6 mm below the surface, 30 mm ahead along y, and up again.
struct Scalpel : palpate::Device {
    long ticks = 0;
    palpate::Limits limits() override { return {12.0, 12.0, 5000.0, 30.0, 0.075}; }
    bool read(palpate::Reading& reading) override {
        const double time_s = 1e-3 * double(ticks++);
        const double down = std::clamp(std::min(time_s, 2.5 - time_s) / 0.5, 0.0, 1.0);
        const double along = std::clamp((time_s - 0.5) / 1.5, 0.0, 1.0);
        reading.position = {-0.00125, -0.015 + 0.03 * along, 0.004 - 0.010 * down};
        reading.enable = 1;
        return true;
    }
    bool write(const palpate::Vector&) override { return true; }
};

/// A hot tip that stays 2 mm below the surface, beside the cut.
struct Cautery : Scalpel {
    bool read(palpate::Reading& reading) override {
        reading.position = {0.02, 0.0, 0.002 - 0.004 * std::min(1e-3 * double(ticks++) / 0.5, 1.0)};
        reading.enable = 1;
        return true;
    }
};

static int failed(const palpate::Error& error) { return std::fprintf(stderr, "%s\n", error.words.c_str()), 1; }

int main(int count, char** arguments) {
    if (count != 3) return std::fprintf(stderr, "usage: %s URL SCENE\n", arguments[0]), 2;
    auto server = palpate::Server::connect(arguments[1]);
    if (!server) return failed(server.error());
    auto session = server->create(arguments[2]);
    if (!session) return failed(session.error());
    palpate::TouchOptions options;
    options.tip_shape = PALPATE_TIP_BLADE;
    options.tip_radius_m = 0.001;
    options.edge.z = 0.02;  // upright
    Scalpel scalpel;
    auto bridge = session->bridge(scalpel, options);
    if (!bridge) return failed(bridge.error());
    const auto wait = [] { std::this_thread::sleep_for(std::chrono::milliseconds(10)); };
    while (!bridge->look().is_over && bridge->look().ticks < 2600) wait();
    if (auto report = bridge->end(); !report) return failed(report.error());

    const auto top_m = session->extent().top_m;
    std::vector<palpate::Vector> bites;
    for (int bite = 0; bite < 4; bite++)
        bites.push_back({top_m.x - 0.00125 + (bite % 2 ? 0.004 : -0.004), top_m.y - 0.006 + 0.004 * bite, top_m.z});
    if (auto error = session->thread(0, bites, 0.02)) return failed(*error);
    palpate::Tie thread{};
    for (int look = 0; look < 5000 && !(thread.tension_n > 0.0 && thread.path_m < 0.021); look++, wait()) {
        auto ties = session->ties();
        if (!ties) return failed(ties.error());
        if (!ties->empty()) thread = ties->front();
    }
    auto status = session->status();
    if (!status) return failed(status.error());
    if (auto error = session->untie(0, 0)) return failed(*error);

    auto surface = session->surface();
    if (!surface) return failed(surface.error());
    palpate::TouchOptions heat;
    heat.tip_radius_m = 0.003;
    heat.burn_s = 0.3;
    heat.tool = 1;  // the thread is by tool 0
    Cautery cautery;
    auto burning = session->bridge(cautery, heat);
    if (!burning) return failed(burning.error());
    long burnt = 0;
    for (int look = 0; look < 6000 && burnt == 0; look++, wait())
        if (surface->read_burns())
            burnt = std::count_if(surface->burns().begin(), surface->burns().end(), [](float burn) { return burn >= 1.0f; });
    if (auto report = burning->end(); !report) return failed(report.error());
    auto anchors = session->severed_anchors();
    if (!anchors) return failed(anchors.error());
    std::printf("{\"severed\":%u,\"pieces\":%u,\"version\":%u,\"thread_m\":%.5f,\"tension_n\":%.4f,\"burnt\":%ld,\"anchors\":%u}\n",
                status->severed, status->pieces, status->topology_version, thread.path_m, thread.tension_n, burnt, *anchors);
    session->remove();
}
