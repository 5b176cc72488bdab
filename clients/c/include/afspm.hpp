// afspm.hpp: the C library for C++20, with handles that free themselves, exceptions and spans. Units as in afspm.h.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "afspm.h"

namespace afspm {

/// What went wrong; `code` is one of AFSPM_REFUSED …
struct Error : std::runtime_error {
  Error(int code, const std::string &message) : std::runtime_error(message), code(code) {}
  int code;
};

/// Scheduler, limit or microscope said no.
struct Refused : Error {
  Refused(const std::string &message, int response, std::string reason, int detail)
      : Error(AFSPM_REFUSED, message), response(response), reason(std::move(reason)), detail(detail) {}
  int response;        ///< number of a ControlResponse
  std::string reason;  ///< for a person
  int detail;          ///< 1: not sent; 2: it may have been carried out; 3: the experiment has ended; 0 for none
};

constexpr double forever = -1.0;

namespace detail {

/// Return the text of a call that copies it.
template <typename Copy> std::string text(Copy copy) {
  std::string found(static_cast<std::size_t>(copy(nullptr, 0)), '\0');
  copy(found.data(), static_cast<int>(found.size()) + 1);
  return found;
}

inline void check(int code, const char *what) {
  if (code != AFSPM_OK) throw Error(code, what);
}

}  // namespace detail

/// A rectangle turned counter-clockwise about its centre.
struct Region {
  double x_m = 0, y_m = 0, width_m = 0, height_m = 0, angle_rad = 0;
};

/// One packet: a channel of a scan, a spectrum, or another message. It keeps what it belongs to alive.
class Packet {
 public:
  Packet(std::shared_ptr<afspm_packets> packets, int index) : packets_(std::move(packets)), index_(index) {}

  std::string envelope() const { return text(afspm_envelope); }
  std::string message() const { return text(afspm_message); }
  std::string channel() const { return text(afspm_channel); }  ///< of a spectrum: its kind
  std::string unit() const { return text(afspm_unit); }
  int rows() const { return shape().first; }
  int columns() const { return shape().second; }
  bool is_view() const { return afspm_is_view(packets_.get(), index_) != 0; }

  /// Return the values, row after row, without a copy: valid as long as this or another packet of the same measurement.
  std::span<const double> values() const {
    const double *values = nullptr;
    const auto count = afspm_values(packets_.get(), index_, &values);
    return {values, static_cast<std::size_t>(count)};
  }
  double at(int row, int column) const { return values()[static_cast<std::size_t>(row) * columns() + column]; }

  Region region() const {
    std::array<double, 5> five{};
    detail::check(afspm_region(packets_.get(), index_, five.data()), "this packet is no scan");
    return {five[0], five[1], five[2], five[3], five[4]};
  }
  /// Return (x, y) in m of a pixel.
  std::pair<double, double> pixel_m(int row, int column) const {
    double x = 0, y = 0;
    detail::check(afspm_pixel(packets_.get(), index_, row, column, &x, &y), "there is no such pixel");
    return {x, y};
  }
  std::optional<std::pair<double, double>> position_m() const {
    double x = 0, y = 0;
    if (afspm_position(packets_.get(), index_, &x, &y) != AFSPM_OK) return std::nullopt;
    return std::pair{x, y};
  }
  std::optional<std::int64_t> time_ns() const { return time(afspm_time_ns); }
  std::optional<std::int64_t> finished_ns() const { return time(afspm_finished_ns); }
  std::string column_name(int column) const {
    return detail::text([&](char *out, int room) { return afspm_column_name(packets_.get(), index_, column, out, room); });
  }
  std::string column_unit(int column) const {
    return detail::text([&](char *out, int room) { return afspm_column_unit(packets_.get(), index_, column, out, room); });
  }
  /// Return the bytes of a message that is neither measurement nor state.
  std::span<const std::uint8_t> bytes() const {
    const std::uint8_t *bytes = nullptr;
    const auto size = afspm_bytes(packets_.get(), index_, &bytes);
    return {bytes, static_cast<std::size_t>(size)};
  }

 private:
  std::pair<int, int> shape() const {
    int rows = 0, columns = 0;
    detail::check(afspm_shape(packets_.get(), index_, &rows, &columns), "this packet has no shape");
    return {rows, columns};
  }
  template <typename Copy> std::string text(Copy copy) const {
    return detail::text([&](char *out, int room) { return copy(packets_.get(), index_, out, room); });
  }
  template <typename Read> std::optional<std::int64_t> time(Read read) const {
    std::int64_t found = 0;
    return read(packets_.get(), index_, &found) == AFSPM_OK ? std::optional(found) : std::nullopt;
  }

  std::shared_ptr<afspm_packets> packets_;
  int index_;
};

/// What was measured: all channels of a scan, or a spectrum.
class Measured {
 public:
  explicit Measured(afspm_packets *packets) : packets_(packets, afspm_packets_free) {
    for (int i = 0; i < afspm_count(packets); ++i) all_.emplace_back(packets_, i);
    for (int i = 0; i < afspm_interruptions(packets); ++i)
      interruptions.push_back(
          detail::text([&](char *out, int room) { return afspm_interruption(packets, i, out, room); }));
  }
  auto begin() const { return all_.begin(); }
  auto end() const { return all_.end(); }
  std::size_t size() const { return all_.size(); }
  const Packet &operator[](std::size_t index) const { return all_.at(index); }
  /// Return a channel by its name. Throws std::out_of_range: there is none.
  const Packet &channel(const std::string &name) const {
    for (const auto &packet : all_)
      if (packet.channel() == name) return packet;
    throw std::out_of_range("there is no channel " + name);
  }

  std::vector<std::string> interruptions;  ///< why it was begun anew, each time

 private:
  std::shared_ptr<afspm_packets> packets_;
  std::vector<Packet> all_;
};

/// A parameter's value, as text, in its unit.
struct Parameter {
  std::string value, unit;
};

class Client;

/// Keeps control until it goes out of scope.
class Control {
 public:
  explicit Control(const Client &client) : client_(&client) {}
  Control(const Control &) = delete;
  Control &operator=(const Control &) = delete;
  ~Control();

 private:
  const Client *client_;
};

/// A handle on an experiment. Every call may throw Error; hand the code of Ended, Stopped and Config on as exit code.
class Client {
 public:
  static Client launched() { return opened([](auto out) { return afspm_launched(out); }); }
  static Client join(const std::string &run_folder, const std::string &name) {
    return opened([&](auto out) { return afspm_join(run_folder.c_str(), name.c_str(), out); });
  }
  static Client open(const std::string &launch_line) {
    return opened([&](auto out) { return afspm_open(launch_line.c_str(), out); });
  }
  /// Return another handle of the same connection, for another thread.
  Client clone() const {
    return opened([&](auto out) { return afspm_clone(get(), out); });
  }
  afspm_client *get() const { return handle_.get(); }
  void leave() const { check(afspm_leave(get())); }

  std::string name() const { return text(afspm_name); }
  std::string run_folder() const { return text(afspm_run_folder); }
  std::string holder() const { return text(afspm_holder); }
  double setting_number(const std::string &name) const {
    double value = 0;
    check(afspm_setting_number(get(), name.c_str(), &value));
    return value;
  }
  std::string setting(const std::string &name) const {
    std::string found(64, '\0');
    int code;
    while ((code = afspm_setting(get(), name.c_str(), found.data(), static_cast<int>(found.size()))) == AFSPM_TOO_SMALL)
      found.resize(found.size() * 4);
    check(code);
    return found.c_str();
  }
  void log(const char *level, const std::string &line) const { check(afspm_log(get(), level, line.c_str())); }
  void allow_step(double longest_s) const { check(afspm_allow_step(get(), longest_s)); }

  void wait_ready(double timeout_s = forever) const { check(afspm_wait_ready(get(), timeout_s)); }
  Packet next(const std::string &prefix = "", double timeout_s = forever) const {
    return packets([&](auto out) { return afspm_next(get(), prefix.c_str(), timeout_s, out); })[0];
  }
  std::string line(double timeout_s = forever) const {
    std::string found(1 << 16, '\0');
    int code;
    while ((code = afspm_line(get(), timeout_s, found.data(), static_cast<int>(found.size()))) == AFSPM_TOO_SMALL)
      found.resize(found.size() * 4);
    check(code);
    return found.c_str();
  }

  /// Keep control as long as what is returned lives; waits for it first.
  [[nodiscard]] Control control(int solving = 0, double timeout_s = forever) const {
    request_control(solving, timeout_s);
    return Control(*this);
  }
  void request_control(int solving = 0, double timeout_s = forever) const {
    check(afspm_request_control(get(), solving, timeout_s));
  }
  void release_control() const { check(afspm_release_control(get())); }
  int problem(const std::string &name) const {
    int number = 0;
    check(afspm_problem(get(), name.c_str(), &number));
    return number;
  }
  void flag(int problem) const { check(afspm_flag(get(), problem)); }
  void clear(int problem) const { check(afspm_clear(get(), problem)); }
  void set_mode(int mode) const { check(afspm_set_mode(get(), mode)); }
  void end_experiment() const { check(afspm_end_experiment(get())); }
  std::vector<int> problems() const {
    std::array<int, 256> numbers{};
    int count = 0;
    check(afspm_problems(get(), numbers.data(), 256, &count));
    return {numbers.begin(), numbers.begin() + count};
  }

  /// Take a scan; rows and columns 0: what is set.
  Measured scan(const Region &at, int rows, int columns, const std::string &key = "", double timeout_s = forever) const {
    return packets([&](auto out) {
      return afspm_scan(get(), at.x_m, at.y_m, at.width_m, at.height_m, at.angle_rad, rows, columns,
                        key.empty() ? nullptr : key.c_str(), timeout_s, out);
    });
  }
  /// Take a spectrum; without a place where the probe stands.
  Measured spectrum(std::optional<std::pair<double, double>> at_m, const std::string &kind = "",
                    const std::string &key = "", double timeout_s = forever) const {
    const auto [x, y] = at_m.value_or(std::pair{std::nan(""), std::nan("")});
    return packets([&, x = x, y = y](auto out) {
      return afspm_spectrum(get(), x, y, kind.empty() ? nullptr : kind.c_str(), key.empty() ? nullptr : key.c_str(),
                            timeout_s, out);
    });
  }
  void forget(const std::string &key) const { check(afspm_forget(get(), key.c_str())); }

  Parameter get_parameter(const std::string &name) const {
    std::array<char, 4096> value{}, unit{};
    check(afspm_get(get(), name.c_str(), value.data(), 4096, unit.data(), 4096));
    return {value.data(), unit.data()};
  }
  void set(const std::string &name, const std::string &value, const std::string &unit = "") const {
    check(afspm_set(get(), name.c_str(), value.c_str(), unit.empty() ? nullptr : unit.c_str()));
  }
  void move_probe(double x_m, double y_m, double timeout_s = forever) const {
    check(afspm_move_probe(get(), x_m, y_m, timeout_s));
  }
  void action(const std::string &name) const { check(afspm_action(get(), name.c_str())); }
  bool supports(const std::string &action) const {
    int yes = 0;
    check(afspm_supports(get(), action.c_str(), &yes));
    return yes != 0;
  }
  void progress(std::int64_t done, std::int64_t of) const { check(afspm_progress(get(), done, of)); }
  void note(const std::string &line, std::optional<std::int64_t> scan_ns = {}) const {
    check(afspm_note(get(), line.c_str(), scan_ns.value_or(std::numeric_limits<std::int64_t>::min())));
  }

  /// Send any request by its number, and return the object of the answer.
  std::vector<std::uint8_t> request(int number, std::span<const std::uint8_t> object = {}) const {
    std::vector<std::uint8_t> answer(1 << 16);
    std::int64_t size = 0;
    check(afspm_request(get(), number, object.data(), static_cast<std::int64_t>(object.size()), answer.data(),
                        static_cast<std::int64_t>(answer.size()), &size));
    answer.resize(static_cast<std::size_t>(size));
    return answer;
  }

  /// Throw what went wrong in the last call.
  void check(int code) const {
    if (code == AFSPM_OK) return;
    const auto message = text(afspm_error_message);
    if (code != AFSPM_REFUSED) throw Error(code, message);
    int response = 0, more = 0;
    afspm_refusal(get(), &response, &more);
    throw Refused(message, response, text(afspm_refusal_reason), more);
  }

 private:
  explicit Client(afspm_client *handle) : handle_(handle, afspm_free) {}

  template <typename Open> static Client opened(Open open) {
    afspm_client *handle = nullptr;
    const int code = open(&handle);
    Client client(handle);
    client.check(code);
    return client;
  }
  template <typename Take> Measured packets(Take take) const {
    afspm_packets *found = nullptr;
    check(take(&found));
    return Measured(found);
  }
  template <typename Copy> std::string text(Copy copy) const {
    return detail::text([&](char *out, int room) { return copy(get(), out, room); });
  }

  std::unique_ptr<afspm_client, void (*)(afspm_client *)> handle_;
};

inline Control::~Control() { afspm_release_control(client_->get()); }

/// Run a component that `afspm run` has started, and return the exit code of main().
template <typename Component> int run(Component component) {
  try {
    const auto client = Client::launched();
    const struct Leave {  // also where other threads have clones
      const Client &client;
      ~Leave() { afspm_leave(client.get()); }
    } leave{client};
    component(client);
    return EXIT_SUCCESS;
  } catch (const Error &error) {
    if (error.code == AFSPM_ENDED || error.code == AFSPM_STOPPED) return error.code;
    std::cerr << "ERROR " << error.what() << std::endl;
    return error.code == AFSPM_CONFIG ? AFSPM_CONFIG : EXIT_FAILURE;
  } catch (const std::exception &error) {
    std::cerr << "ERROR " << error.what() << std::endl;
    return EXIT_FAILURE;
  }
}

}  // namespace afspm
