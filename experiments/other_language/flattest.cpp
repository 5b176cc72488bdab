// Takes an overview, finds its flattest place, and scans that: a component in C++, with the header in clients/c.

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "afspm.hpp"

/// Return the root mean square of the heights of a square tile about its plane.
static double roughness_m(const afspm::Packet &heights, int row, int column, int edge) {
  const auto values = heights.values();
  const int columns = heights.columns();
  const double middle = (edge - 1) / 2.0, count = static_cast<double>(edge) * edge;
  double sum = 0, sum_x = 0, sum_y = 0, squares = 0, sum_xx = 0;
  for (int y = 0; y < edge; ++y) {
    for (int x = 0; x < edge; ++x) {
      const double z = values[static_cast<std::size_t>(row + y) * columns + column + x];
      sum += z;
      sum_x += z * (x - middle);
      sum_y += z * (y - middle);
      squares += z * z;
      sum_xx += (x - middle) * (x - middle);
    }
  }
  return std::sqrt(std::max(0.0, squares - sum * sum / count - (sum_x * sum_x + sum_y * sum_y) / sum_xx) / count);
}

static void find_flattest(const afspm::Client &client) {
  const double size_m = client.setting_number("size_m");
  const int tiles = static_cast<int>(client.setting_number("tiles")), pixels = static_cast<int>(client.setting_number("pixels"));

  // a key has a scan taken once: started again after a crash, this program gets the scan of its earlier life
  const auto overview = client.scan({.width_m = size_m, .height_m = size_m}, pixels, pixels, "overview");
  const auto heights = std::ranges::find_if(overview, [](const auto &scan) { return scan.unit() == "m"; });
  if (heights == overview.end()) throw std::runtime_error("the overview has no heights");

  const int edge = pixels / tiles;
  double best_m = INFINITY;
  std::pair<double, double> place_m;
  for (int row = 0; row + edge <= pixels; row += edge) {
    for (int column = 0; column + edge <= pixels; column += edge) {
      const double rough_m = roughness_m(*heights, row, column, edge);
      if (rough_m < best_m) best_m = rough_m, place_m = heights->pixel_m(row + edge / 2, column + edge / 2);
    }
  }

  const auto [x_m, y_m] = place_m;
  const auto detail = client.scan({x_m, y_m, size_m / tiles, size_m / tiles}, pixels, pixels, "flattest");
  char text[100];
  std::snprintf(text, sizeof text, "the flattest place, %.3f nm rms, is at (%.0f, %.0f) nm", best_m * 1e9, x_m * 1e9, y_m * 1e9);
  client.log("INFO", text);
  client.note(text, detail[0].finished_ns());
  client.end_experiment();
}

int main() { return afspm::run(find_flattest); }
