// The conformance program of the C++ header, see docs/reference/client-conformance.md.

#include <mutex>
#include <nlohmann/json.hpp>
#include <numbers>
#include <thread>

#include "afspm.hpp"

using Json = nlohmann::json;
using afspm::Client, afspm::Packet;

static constexpr double degrees = 180.0 / std::numbers::pi;
static const std::string digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

static std::string to_base64(std::span<const std::uint8_t> bytes) {
  std::string text;
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    unsigned three = 0;
    for (std::size_t j = i; j < i + 3; ++j) three = three << 8 | (j < bytes.size() ? bytes[j] : 0);
    for (std::size_t j = 0; j < 4; ++j) text += i + j > bytes.size() ? '=' : digits[three >> (18 - 6 * j) & 63];
  }
  return text;
}

static std::vector<std::uint8_t> from_base64(const std::string &text) {
  std::vector<std::uint8_t> bytes;
  unsigned held = 0, bits = 0;
  for (const char digit : text.substr(0, text.find('='))) {
    held = held << 6 | static_cast<unsigned>(digits.find(digit));
    if ((bits += 6) >= 8) bytes.push_back(static_cast<std::uint8_t>(held >> (bits -= 8)));
  }
  return bytes;
}

static Json facts(const Packet &packet) {
  const auto time_ns = packet.time_ns();
  Json facts{{"envelope", packet.envelope()}, {"message", packet.message()}, {"timestamp_ns", time_ns ? Json(*time_ns) : Json()}};
  const bool is_spectrum = packet.message() == "Spec1d";
  if (is_spectrum) {
    facts["kind"] = packet.channel();
    facts["names"] = facts["units"] = Json::array();
    for (int i = 0; i < packet.columns(); ++i) {
      facts["names"].push_back(packet.column_name(i));
      facts["units"].push_back(packet.column_unit(i));
    }
    const auto place = packet.position_m();
    facts["position_m"] = place ? Json{place->first, place->second} : Json();
  } else if (packet.message() == "Scan2d" || packet.message() == "ScanLines") {
    const auto region = packet.region();
    facts.update({{"channel", packet.channel()}, {"unit", packet.unit()}, {"center_m", {region.x_m, region.y_m}},
                  {"size_m", {region.width_m, region.height_m}}, {"angle_deg", region.angle_rad * degrees}});
  } else {
    return facts;
  }
  const auto values = packet.values();
  double sum = 0, moment = 0;
  for (std::size_t i = 0; i < values.size(); ++i) sum += values[i], moment += static_cast<double>(i) * values[i];
  facts["shape"] = {packet.rows(), packet.columns()};
  facts["view"] = packet.is_view();
  facts["values"] = {{"count", values.size()}, {"sum", sum}, {"moment", moment},
                     {"first", values.empty() ? Json() : Json(values.front())}, {"last", values.empty() ? Json() : Json(values.back())}};
  return facts;
}

static Json measured(const char *name, const afspm::Measured &found) {
  Json all = Json::array();
  for (const auto &packet : found) all.push_back(facts(packet));
  return {{"ok", true}, {name, all}, {"interruptions", found.interruptions.size()}};
}

static Json decoded(const std::string &message, const std::vector<std::uint8_t> &bytes) {
  std::string json(1 << 20, '\0');
  int length = 0;
  if (afspm_to_json(message.c_str(), bytes.data(), bytes.size(), json.data(), json.size(), &length) != AFSPM_OK)
    throw std::runtime_error("it can't be decoded");
  return Json::parse(json.substr(0, length));
}

static std::string encoded(const std::string &message, const Json &fields) {
  std::vector<std::uint8_t> bytes(1 << 20);
  std::int64_t size = 0;
  if (afspm_from_json(message.c_str(), fields.dump().c_str(), bytes.data(), bytes.size(), &size) != AFSPM_OK)
    throw std::runtime_error("it can't be encoded");
  return to_base64({bytes.data(), static_cast<std::size_t>(size)});
}

static Json done(const Client &client, const Json &step) {
  const std::string what = step.at("do");
  const double timeout_s = step.value("timeout_s", afspm::forever);
  if (what == "ready") client.wait_ready(timeout_s);
  else if (what == "decode") {
    const auto fields = decoded(step.at("message"), from_base64(step.at("bytes")));
    return {{"ok", true}, {"fields", fields}, {"bytes", encoded(step.at("message"), fields)}};
  } else if (what == "encode") return {{"ok", true}, {"bytes", encoded(step.at("message"), step.at("fields"))}};
  else if (what == "wait") {
    Json answer = facts(client.next(step.at("prefix"), timeout_s));
    answer["ok"] = true;
    return answer;
  } else if (what == "request") {
    const auto answer = client.request(step.at("number"), from_base64(step.value("object", "")));
    return {{"ok", true}, {"response", "REP_SUCCESS"}, {"object", to_base64(answer)}};
  } else if (what == "request_control") client.request_control(step.at("problem"), timeout_s);
  else if (what == "release_control") client.release_control();
  else if (what == "get_parameter" || what == "set_parameter") {
    const std::string name = step.at("name"), unit = step.value("unit", Json()).is_string() ? step["unit"] : Json("");
    if (what == "set_parameter") client.set(name, step.at("value"), unit);
    const auto found = client.get_parameter(name);
    return {{"ok", true}, {"value", found.value}, {"unit", found.unit.empty() ? Json() : Json(found.unit)}};
  } else if (what == "action") client.action(step.at("name"));
  else if (what == "problem") step.at("set") ? client.flag(step.at("number")) : client.clear(step.at("number"));
  else if (what == "mode") client.set_mode(step.at("mode") == "CM_MANUAL" ? AFSPM_MANUAL : AFSPM_AUTOMATED);
  else if (what == "scan") {
    const afspm::Region region{step["center_m"][0], step["center_m"][1], step["size_m"][0], step["size_m"][1],
                               step.value("angle_deg", 0.0) / degrees};
    return measured("scans", client.scan(region, step["shape"][0], step["shape"][1], "", timeout_s));
  } else if (what == "spectrum") {
    const std::pair<double, double> place{step["position_m"][0], step["position_m"][1]};
    return measured("spectra", client.spectrum(place, step.at("kind"), "", timeout_s));
  } else if (what == "state") {
    static const char *const modes[] = {"CM_UNDEFINED", "CM_MANUAL", "CM_AUTOMATED"};
    static const char *const states[] = {"SS_UNDEFINED", "SS_MOVING", "SS_SCANNING", "SS_FREE", "SS_INTERRUPTED",
                                         "SS_COARSE_MOTOR", "SS_BUSY_PARAM", "SS_SPEC"};
    int in_control = 0, mode = 0, state = 0;
    client.check(afspm_state(client.get(), &in_control, &mode, &state));
    const auto holder = client.holder();
    return {{"ok", true}, {"in_control", in_control != 0}, {"holder", holder.empty() ? Json() : Json(holder)},
            {"mode", modes[mode]}, {"problems", client.problems()}, {"scope_state", states[state]}};
  } else if (what == "end") client.end_experiment();
  else throw std::runtime_error("there is no step " + what);
  return {{"ok", true}};
}

static void answer(const Client &client, const Json &step) {
  static std::mutex one_line_at_a_time;
  Json answer;
  try {
    answer = done(client, step);
  } catch (const afspm::Refused &refused) {
    const auto name = afspm::detail::text([&](char *out, int room) { return afspm_response_name(refused.response, out, room); });
    answer = {{"ok", false}, {"response", name.starts_with("REP_") ? Json(name) : Json(refused.response)},
              {"reason", refused.reason}, {"detail", refused.detail}};
  } catch (const std::exception &error) {
    answer = {{"ok", false}, {"error", error.what()}};
  }
  answer["id"] = step.at("id");
  const std::lock_guard lock(one_line_at_a_time);
  std::cout << answer.dump() << std::endl;
}

int main() {
  return afspm::run([](const Client &client) {
    for (;;) {
      const auto step = Json::parse(client.line());
      const std::string what = step.at("do");
      if (what == "scan" || what == "spectrum" || what == "wait" || what == "request_control")
        std::thread([own = client.clone(), step] { answer(own, step); }).detach();
      else
        answer(client, step);
    }
  });
}
