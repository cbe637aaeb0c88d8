// Two hands with a grasper each, through ports: `hands URL SCENE SECONDS`. This thread is the loop of both, a thousand times a
// second; simulated hands lead the graspers into the tissue, and close their jaws there. Ends when both have felt the tissue
// for half a second, or after SECONDS. Prints one line of JSON.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <palpate.hpp>
#include <thread>
#include <vector>

static int failed(const palpate::Error& error) { return std::fprintf(stderr, "%s\n", error.words.c_str()), 1; }

static double length(const palpate::Vector& v) { return std::hypot(v.x, v.y, v.z); }

/// A grasper in a simulated hand: a spring of 300 N/m and a damping of 5.5 N·s/m.
struct Grasper {
    palpate::Touch touch;
    palpate::Vector place_m;
    palpate::InstrumentFelt felt{};
    double most_n = 0.0, most_n_m = 0.0;
    int ticks_in_tissue = 0;

    /// Returns where the hand moves a coordinate.
    static double moved(double from_m, double goal_m, double force_n) {
        return from_m + 1e-3 * (300.0 * (goal_m - from_m) + force_n) / 5.5;
    }
    /// Leads the grasper towards a place in the tissue's frame.
    void tick(const palpate::Vector& goal_m, double jaw_rad, bool enable, double time_s) {
        place_m.x = moved(place_m.x, goal_m.x, felt.force_n.x);
        place_m.y = moved(place_m.y, goal_m.y, felt.force_n.y);
        place_m.z = moved(place_m.z, goal_m.z, felt.force_n.z);
        // The library turns the grasper so that its shaft passes through the port, and felt.orientation is that of the shaft.
        const palpate::Quaternion down{std::sqrt(0.5), 0.0, std::sqrt(0.5), 0.0};
        felt = touch.tick(palpate::InstrumentReading{place_m, down, jaw_rad, enable}, time_s);
        most_n = std::max(most_n, length(felt.force_n));
        most_n_m = std::max(most_n_m, length(felt.torque_n_m));
        ticks_in_tissue += length(felt.force_n) > 0.02;
    }
};

int main(int count, char** arguments) {
    if (count != 4) return std::fprintf(stderr, "usage: %s URL SCENE SECONDS\n", arguments[0]), 2;
    auto server = palpate::Server::connect(arguments[1]);
    if (!server) return failed(server.error());
    auto session = server->create(arguments[2]);
    if (!session) return failed(session.error());
    auto hands = palpate::Hand::two();
    if (!hands) return failed(hands.error());
    palpate::TouchOptions options;
    palpate_limits_of("sigma7", &options.limits);
    options.max_torque_n_m = 0.4;
    options.in_tissue_frame = 1;
    options.limits.workspace_radius_m = 1.0;
    options.jaws_m = 0.015;
    options.shaft_m = 0.02;
    options.tip_radius_m = 0.003;
    options.has_port = 1;
    auto tools = options.tool_count();
    if (!tools) return failed(tools.error());

    const auto top_m = session->extent().top_m;
    const auto above_m = [&](double x_m, double z_m) { return palpate::Vector{top_m.x + x_m, top_m.y, top_m.z + z_m}; };
    const double sides[] = {-1.0, 1.0};
    std::vector<Grasper> graspers;
    for (int hand = 0; hand < 2; hand++) {
        options.tool = std::uint32_t(hand) * *tools;
        options.hand = (*hands)[hand].get();
        options.port = above_m(0.05 * sides[hand], 0.12);
        auto touch = session->touch(options);
        if (!touch) return failed(touch.error());
        graspers.push_back(Grasper{std::move(*touch), above_m(0.008 * sides[hand], 0.006)});
    }
    const auto in_tissue = [&] { return std::min(graspers[0].ticks_in_tissue, graspers[1].ticks_in_tissue); };
    const auto begin = std::chrono::steady_clock::now();
    int ticks = 0;
    for (; ticks < 1000 * std::atof(arguments[3]) && in_tissue() < 500; ticks++) {
        const std::chrono::duration<double> time = std::chrono::steady_clock::now() - begin;
        // From 6 mm above the tissue down to 3 mm below, and up, in 2 s; open above, closed in it.
        const double part = std::cos(3.14159265358979 * ticks / 1000.0);
        for (int hand = 0; hand < 2; hand++)
            graspers[hand].tick(above_m(0.008 * sides[hand], 0.0015 + 0.0045 * part), 0.3 + 0.25 * part, ticks % 500 < 250,
                                time.count());
        std::this_thread::sleep_until(begin + std::chrono::milliseconds(ticks + 1));
    }
    std::printf("{\"tools\":%u,\"ticks\":%d,\"force_max_n\":[%.4f,%.4f],\"torque_max_n_m\":[%.5f,%.5f]}\n", *tools, ticks,
                graspers[0].most_n, graspers[1].most_n, graspers[0].most_n_m, graspers[1].most_n_m);
    session->remove();
}
