// C++17 over libpalpate: handles that free themselves, and results instead of exceptions. Header only; link palpate.
// The rules of palpate.h apply: which thread may call what, and which calls wait.
#ifndef PALPATE_HPP
#define PALPATE_HPP

#include <palpate.h>

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace palpate {

using Vector = palpate_vector;
using Quaternion = palpate_quaternion;
using Extent = palpate_extent;
using Reading = palpate_reading;
using Felt = palpate_felt;
using InstrumentReading = palpate_instrument_reading;
using InstrumentFelt = palpate_instrument_felt;
using Limits = palpate_limits;
using Traffic = palpate_traffic;
using Report = palpate_bridge_report;
using Status = palpate_session_status;
using Tie = palpate_tie;

/// What went wrong.
struct Error {
    palpate_result code = PALPATE_OK;
    std::string words;
};

/// A value, or the error why there is none.
template <class T>
class Result {
public:
    Result(T value) : value_(std::move(value)) {}
    Result(Error error) : error_(std::move(error)) {}
    explicit operator bool() const { return value_.has_value(); }
    T& operator*() { return *value_; }
    T* operator->() { return &*value_; }
    /// May be called only if there is no value.
    const Error& error() const { return error_; }

private:
    std::optional<T> value_;
    Error error_;
};

namespace detail {
template <auto Free>
struct Freed {
    template <class T>
    void operator()(T* handle) const {
        Free(handle);
    }
};
template <class T, auto Free>
using Handle = std::unique_ptr<T, Freed<Free>>;

inline Error error(palpate_result code) { return Error{code, palpate_last_error()}; }

inline void end_bridge(palpate_bridge* bridge) { palpate_bridge_end(bridge, nullptr); }

/// Gets a text from the library, which returns its size first.
template <class Write>
Result<std::string> text(Write write) {
    std::size_t needed = 0;
    if (auto code = write(nullptr, 0, &needed)) return error(code);
    std::string text(needed, '\0');
    if (auto code = write(text.data(), text.size(), &needed)) return error(code);
    text.resize(needed - 1);
    return text;
}
}  // namespace detail

/// Options for touching. The fields are those of palpate_touch_options.
struct TouchOptions : palpate_touch_options {
    TouchOptions() { palpate_touch_options_init(this, sizeof(palpate_touch_options)); }
    /// Returns how many tools a loop with these options moves: one for each tip of an instrument.
    Result<std::uint32_t> tool_count() const {
        std::uint32_t count = 0;
        if (auto code = palpate_tool_count(this, &count)) return detail::error(code);
        return count;
    }
};

/// Options of a thread or clip. The fields are those of palpate_tie_options; Session sets the bites and the length.
struct TieOptions : palpate_tie_options {
    TieOptions() { palpate_tie_options_init(this, sizeof(palpate_tie_options)); }
};

/// One of the two hands of a program, for `hand` of TouchOptions; see palpate_two_hands.
class Hand {
public:
    /// Returns the two hands of a program.
    static Result<std::array<Hand, 2>> two() {
        palpate_hand *left = nullptr, *right = nullptr;
        if (auto code = palpate_two_hands(&left, &right)) return detail::error(code);
        return std::array<Hand, 2>{Hand(left), Hand(right)};
    }
    /// Returns the handle, which is valid as long as this object.
    const palpate_hand* get() const { return hand_.get(); }
    explicit Hand(palpate_hand* hand) : hand_(hand) {}

private:
    detail::Handle<palpate_hand, palpate_hand_free> hand_;
};

/// Options for a surface. The fields are those of palpate_surface_options.
struct SurfaceOptions : palpate_surface_options {
    SurfaceOptions() { palpate_surface_options_init(this, sizeof(palpate_surface_options)); }
};

/// Options for connecting. The fields are those of palpate_connect_options.
struct ConnectOptions : palpate_connect_options {
    ConnectOptions() { palpate_connect_options_init(this, sizeof(palpate_connect_options)); }
};

/// A change of the tissue. The fields are those of palpate_change; fields that you do not set are left unchanged.
struct Change : palpate_change {
    Change() { palpate_change_init(this); }
};

/// A tool that your own loop moves.
class Touch {
public:
    /// Returns the force until the next tick. Call it on your own thread, a thousand times a second. It never waits.
    /// After an error the force is zero.
    Felt tick(const Reading& reading, double time_s) noexcept {
        Felt felt{};
        palpate_touch_tick(touch_.get(), &reading, time_s, &felt);
        return felt;
    }
    /// Returns force and torque until the next tick, for options with an instrument. The rules are those of the other
    /// tick.
    InstrumentFelt tick(const InstrumentReading& reading, double time_s) noexcept {
        InstrumentFelt felt{};
        palpate_touch_tick_instrument(touch_.get(), &reading, time_s, &felt);
        return felt;
    }
    /// Stops rendering until `enable` goes from 0 to 1 again.
    void disable() noexcept { palpate_touch_disable(touch_.get()); }
    /// Returns the network traffic.
    Traffic traffic() const noexcept {
        Traffic traffic{};
        palpate_touch_traffic(touch_.get(), &traffic);
        return traffic;
    }
    /// Delivers a recorded message; see palpate_touch_arrive.
    std::optional<Error> arrive(const std::uint8_t* bytes, std::size_t count) {
        if (auto code = palpate_touch_arrive(touch_.get(), bytes, count)) return detail::error(code);
        return std::nullopt;
    }
    /// Creates a touch that replays recorded messages; see palpate_touch_begin_offline.
    static Result<Touch> offline(const TouchOptions& options, Vector middle_m) {
        palpate_touch* touch = nullptr;
        if (auto code = palpate_touch_begin_offline(&options, middle_m, &touch)) return detail::error(code);
        return Touch(touch);
    }
    explicit Touch(palpate_touch* touch) : touch_(touch) {}

private:
    detail::Handle<palpate_touch, palpate_touch_end> touch_;
};

/// A device of your own: derive from this class. A thread of the library calls it a thousand times a second.
class Device {
public:
    virtual ~Device() = default;
    /// Returns the limits of the device.
    virtual Limits limits() = 0;
    /// Reads the state of the device; false if it fails.
    virtual bool read(Reading& reading) = 0;
    /// Renders a force until the next tick, N; false if it fails.
    virtual bool write(const Vector& force_n) = 0;

    /// Returns the device in the form that the library expects.
    palpate_device called() {
        palpate_device device{};
        device.user = this;
        device.descriptor = [](void* user, palpate_limits* limits) noexcept {
            *limits = static_cast<Device*>(user)->limits();
            return 0;
        };
        device.read = [](void* user, palpate_reading* reading) noexcept {
            return static_cast<Device*>(user)->read(*reading) ? 0 : 1;
        };
        device.write = [](void* user, const palpate_vector* force_n) noexcept {
            return static_cast<Device*>(user)->write(*force_n) ? 0 : 1;
        };
        return device;
    }
};

/// A device of your own with six axes, which leads an instrument: derive from this class. A thread of the library calls it
/// a thousand times a second.
class InstrumentDevice {
public:
    virtual ~InstrumentDevice() = default;
    /// Returns the limits of the device. The largest torque is `max_torque_n_m` of the options.
    virtual Limits limits() = 0;
    /// Reads the state of the device; false if it fails. The orientation is not turned before the call.
    virtual bool read(InstrumentReading& reading) = 0;
    /// Renders a force and a torque until the next tick, N and N·m; false if it fails.
    virtual bool write(const Vector& force_n, const Vector& torque_n_m) = 0;

    /// Returns the device in the form that the library expects.
    palpate_instrument_device called() {
        palpate_instrument_device device{};
        device.user = this;
        device.descriptor = [](void* user, palpate_limits* limits) noexcept {
            *limits = static_cast<InstrumentDevice*>(user)->limits();
            return 0;
        };
        device.read = [](void* user, palpate_instrument_reading* reading) noexcept {
            return static_cast<InstrumentDevice*>(user)->read(*reading) ? 0 : 1;
        };
        device.write = [](void* user, const palpate_vector* force_n, const palpate_vector* torque_n_m) noexcept {
            return static_cast<InstrumentDevice*>(user)->write(*force_n, *torque_n_m) ? 0 : 1;
        };
        return device;
    }
};

/// The loop that drives a device, on a thread of the library. It ends when this object is destroyed.
class Bridge {
public:
    /// Returns the state of the loop.
    palpate_bridge_state look() const noexcept {
        palpate_bridge_state state{};
        palpate_bridge_look(bridge_.get(), &state);
        return state;
    }
    /// Returns where the instrument is and what is rendered; zeros if the device leads none.
    palpate_instrument_state look_instrument() const noexcept {
        palpate_instrument_state state{};
        palpate_bridge_look_instrument(bridge_.get(), &state);
        return state;
    }
    /// Stops rendering until `enable` goes from 0 to 1 again. Can be called on any thread.
    void disable() noexcept { palpate_bridge_disable(bridge_.get()); }
    /// Ends the loop and returns its statistics, or the error of a device that failed.
    Result<Report> end() {
        Report report{};
        if (auto error = end(report)) return *error;
        return report;
    }
    /// Ends the loop. `report` is set even if the device failed.
    std::optional<Error> end(Report& report) {
        if (auto code = palpate_bridge_end(bridge_.release(), &report)) return detail::error(code);
        return std::nullopt;
    }
    explicit Bridge(palpate_bridge* bridge) : bridge_(bridge) {}

private:
    detail::Handle<palpate_bridge, detail::end_bridge> bridge_;
};

/// The surface of a session, in its own vectors.
class Surface {
public:
    /// Returns x, y, z of each vertex, one vertex after the other.
    const std::vector<float>& positions() const { return positions_; }
    /// Returns x, y, z of each vertex normal, in the same order as the positions.
    const std::vector<float>& normals() const { return normals_; }
    /// Returns three vertex indices for each triangle.
    const std::vector<std::uint32_t>& indices() const { return indices_; }
    /// Returns u, v of each vertex; empty if the mesh has no texture coordinates.
    const std::vector<float>& uv() const { return uv_; }
    /// Updates positions and normals, and returns which vertices changed. Never waits.
    palpate_dirty read() {
        palpate_dirty dirty{};
        lost_ = palpate_surface_read(surface_.get(), &buffers_, &dirty) != PALPATE_OK;
        buffers_.everything = 0;
        return dirty;
    }
    /// Returns how burnt each vertex is by cautery, 0 to 1, as of the last `read_burns`; see palpate_surface_burns.
    const std::vector<float>& burns() const { return burns_; }
    /// Updates how burnt each vertex is, and returns whether that has changed. Never waits.
    bool read_burns() {
        std::uint32_t version = 0;
        if (palpate_surface_burns(surface_.get(), nullptr, 0, 0, &version) != PALPATE_OK || version == burn_version_) return false;
        return palpate_surface_burns(surface_.get(), burns_.data(), sizeof(float), burns_.size(), &burn_version_) == PALPATE_OK;
    }
    /// Returns whether the surface will receive no more updates.
    bool lost() const { return lost_; }

    explicit Surface(palpate_surface* surface) : surface_(surface) {
        palpate_surface_size size{};
        palpate_surface_size_of(surface, &size);
        positions_.resize(3 * size.vertices);
        normals_.resize(3 * size.vertices);
        burns_.resize(size.vertices);
        indices_.resize(size.indices);
        palpate_surface_indices(surface, indices_.data(), indices_.size());
        if (size.has_uv) {
            uv_.resize(2 * size.vertices);
            palpate_surface_uv(surface, uv_.data(), 2 * sizeof(float), size.vertices);
        }
        const std::size_t stride = 3 * sizeof(float);
        buffers_ = {positions_.data(), stride, normals_.data(), stride, size.vertices, 1};
    }

private:
    detail::Handle<palpate_surface, palpate_surface_free> surface_;
    std::vector<float> positions_, normals_, uv_, burns_;
    std::uint32_t burn_version_ = 0;
    std::vector<std::uint32_t> indices_;
    palpate_buffers buffers_{};
    bool lost_ = false;
};

/// A session: one tissue in use.
class Session {
public:
    /// Returns the id with which others join the session.
    std::string id() const {
        auto id = detail::text([&](auto... place) { return palpate_session_id(session_.get(), place...); });
        return id ? *id : std::string();
    }
    /// Returns the bounding box of the tissue at rest, in Palpate's own axes, m.
    Extent extent() const {
        Extent extent{};
        palpate_session_extent(session_.get(), &extent);
        return extent;
    }
    /// Takes a tool for a loop of your own. Waits for the server.
    Result<Touch> touch(const TouchOptions& options = {}) const {
        palpate_touch* touch = nullptr;
        if (auto code = palpate_touch_begin(session_.get(), &options, &touch)) return detail::error(code);
        return Touch(touch);
    }
    /// Connects a device, which must outlive the bridge. Waits for the server.
    Result<Bridge> bridge(Device& device, const TouchOptions& options = {}) const {
        palpate_bridge* bridge = nullptr;
        const palpate_device called = device.called();
        if (auto code = palpate_bridge_begin(session_.get(), &called, &options, &bridge)) return detail::error(code);
        return Bridge(bridge);
    }
    /// Connects a device of six axes, which must outlive the bridge. The options need `jaws_m` or `shaft_m`. Waits for the
    /// server.
    Result<Bridge> bridge(InstrumentDevice& device, const TouchOptions& options) const {
        palpate_bridge* bridge = nullptr;
        const palpate_instrument_device called = device.called();
        auto code = palpate_bridge_begin_instrument(session_.get(), &called, &options, &bridge);
        if (code) return detail::error(code);
        return Bridge(bridge);
    }
    /// Gets the surface. Waits for the server.
    Result<Surface> surface(const SurfaceOptions& options = {}) const {
        palpate_surface* surface = nullptr;
        if (auto code = palpate_surface_open(session_.get(), &options, &surface)) return detail::error(code);
        return Surface(surface);
    }
    /// Changes the tissue. Waits for the server.
    std::optional<Error> change(const Change& change) const {
        if (auto code = palpate_session_change(session_.get(), &change)) return detail::error(code);
        return std::nullopt;
    }
    /// Returns the state of the session: its time, and what is cut. Waits for the server.
    Result<Status> status() const {
        Status status{};
        if (auto code = palpate_session_status_of(session_.get(), &status)) return detail::error(code);
        return status;
    }
    /// Returns how many anchor springs are severed. Waits for the server.
    Result<std::uint32_t> severed_anchors() const {
        std::uint32_t count = 0;
        if (auto code = palpate_session_severed_anchors(session_.get(), &count)) return detail::error(code);
        return count;
    }
    /// Lays a thread through bites, or changes one that has these bites; see palpate_session_thread. Waits for the server.
    std::optional<Error> thread(std::uint32_t number, const std::vector<Vector>& bites, double length_m,
                                TieOptions options = {}) const {
        options.length_m = length_m;
        return tied(palpate_session_thread, number, bites, options);
    }
    /// Closes a clip on two bites; see palpate_session_clip. Waits for the server.
    std::optional<Error> clip(std::uint32_t number, const std::vector<Vector>& bites, TieOptions options = {}) const {
        return tied(palpate_session_clip, number, bites, options);
    }
    /// Cuts a thread or clip by a tool, and takes it out. Waits for the server.
    std::optional<Error> untie(std::uint32_t tool, std::uint32_t number) const {
        if (auto code = palpate_session_untie(session_.get(), tool, number)) return detail::error(code);
        return std::nullopt;
    }
    /// Releases a tool that has laid threads or clips, which stay. Waits for the server.
    std::optional<Error> release(std::uint32_t tool) const {
        if (auto code = palpate_session_release(session_.get(), tool)) return detail::error(code);
        return std::nullopt;
    }
    /// Returns the threads and clips of the session, of all its users. Waits for the server.
    Result<std::vector<Tie>> ties() const {
        for (;;) {
            std::size_t count = 0;
            if (auto code = palpate_session_ties(session_.get(), nullptr, 0, &count)) return detail::error(code);
            std::vector<Tie> ties(count);
            const auto code = palpate_session_ties(session_.get(), ties.data(), ties.size(), &count);
            // Another user may lay one in between.
            if (code == PALPATE_BUFFER) continue;
            if (code) return detail::error(code);
            ties.resize(count);
            return ties;
        }
    }
    /// Deletes the session on the server, for all users. Waits for the server.
    std::optional<Error> remove() const {
        if (auto code = palpate_session_delete(session_.get())) return detail::error(code);
        return std::nullopt;
    }
    explicit Session(palpate_session* session) : session_(session) {}

private:
    template <class Lay>
    std::optional<Error> tied(Lay lay, std::uint32_t number, const std::vector<Vector>& bites, TieOptions& options) const {
        options.bites = bites.data();
        options.bite_count = bites.size();
        if (auto code = lay(session_.get(), number, &options)) return detail::error(code);
        return std::nullopt;
    }
    detail::Handle<palpate_session, palpate_session_free> session_;
};

/// A connection to a server.
class Server {
public:
    /// Connects to a server. Waits for the server.
    static Result<Server> connect(const std::string& url, const ConnectOptions& options = {}) {
        palpate_server* server = nullptr;
        if (auto code = palpate_connect(url.c_str(), &options, &server)) return detail::error(code);
        return Server(server);
    }
    /// Returns the names of the server's scenes. Waits for the server.
    Result<std::vector<std::string>> scenes() const {
        auto lines = detail::text([&](auto... place) { return palpate_scenes(server_.get(), place...); });
        if (!lines) return lines.error();
        std::vector<std::string> names;
        std::istringstream text(*lines);
        for (std::string name; std::getline(text, name);) names.push_back(name);
        return names;
    }
    /// Creates a session from a scene that the server has. Waits for the server.
    Result<Session> create(const std::string& scene) const { return made(palpate_session_create, scene); }
    /// Creates a session from the text of a scene that refers to no file. Waits for the server.
    Result<Session> create_from_text(const std::string& text) const {
        return made(palpate_session_create_from_text, text);
    }
    /// Creates a session from a local scene file, and sends its mesh. Waits for the server.
    Result<Session> create_from_file(const std::string& path) const {
        return made(palpate_session_create_from_file, path);
    }
    /// Creates a session from the text of a scene and the bytes of a mesh file. `[mesh]` of the scene refers to this
    /// file as `mesh_name`. Waits for the server.
    Result<Session> create_from_mesh(const std::string& text, const std::string& mesh_name, const std::string& bytes) const {
        palpate_session* session = nullptr;
        auto data = reinterpret_cast<const unsigned char*>(bytes.data());
        auto code = palpate_session_create_from_mesh(server_.get(), text.c_str(), mesh_name.c_str(), data, bytes.size(), &session);
        if (code) return detail::error(code);
        return Session(session);
    }
    /// Joins a session by its id. Waits for the server.
    Result<Session> join(const std::string& id) const { return made(palpate_session_join, id); }
    explicit Server(palpate_server* server) : server_(server) {}

private:
    template <class Make>
    Result<Session> made(Make make, const std::string& text) const {
        palpate_session* session = nullptr;
        if (auto code = make(server_.get(), text.c_str(), &session)) return detail::error(code);
        return Session(session);
    }
    detail::Handle<palpate_server, palpate_server_free> server_;
};

}  // namespace palpate

#endif
