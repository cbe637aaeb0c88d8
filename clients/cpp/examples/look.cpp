// Watches a tissue: `look URL SCENE SECONDS`. Prints one line of JSON.
#include <algorithm>
#include <chrono>
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
    auto surface = session->surface();
    if (!surface) return failed(surface.error());
    palpate_dirty dirty{};
    for (int frame = 0; frame < 60 * std::atof(arguments[3]); frame++) {
        dirty = surface->read();
        std::this_thread::sleep_for(std::chrono::milliseconds(16));
    }
    float least_m = 1e9f, most_m = -1e9f;
    for (std::size_t k = 2; k < surface->positions().size(); k += 3) {
        least_m = std::min(least_m, surface->positions()[k]);
        most_m = std::max(most_m, surface->positions()[k]);
    }
    std::printf("{\"vertices\":%zu,\"triangles\":%zu,\"frames\":%llu,\"z_m\":[%.6f,%.6f]}\n",
                surface->positions().size() / 3, surface->indices().size() / 3,
                static_cast<unsigned long long>(dirty.frames), least_m, most_m);
    session->remove();
}
