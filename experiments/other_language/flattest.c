/* Takes an overview, finds its flattest place, and scans that: a component in C, with the library in clients/c. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "afspm.h"

/* Return the root mean square of the heights of a square tile about its plane. */
static double roughness_m(const double *heights_m, int columns, int row, int column, int edge) {
  const double middle = (edge - 1) / 2.0;
  double sum = 0, sum_x = 0, sum_y = 0, squares = 0, sum_xx = 0;
  for (int y = 0; y < edge; y++) {
    for (int x = 0; x < edge; x++) {
      const double z = heights_m[(row + y) * columns + column + x];
      sum += z;
      sum_x += z * (x - middle);
      sum_y += z * (y - middle);
      squares += z * z;
      sum_xx += (x - middle) * (x - middle);
    }
  }
  const double count = (double)edge * edge;
  return sqrt(fmax(0, squares - sum * sum / count - (sum_x * sum_x + sum_y * sum_y) / sum_xx) / count);
}

/* Return the index of the first channel of heights; 0 if there is none. */
static int heights_in(const afspm_packets *scans) {
  char unit[16];
  for (int i = 0; i < afspm_count(scans); i++) {
    afspm_unit(scans, i, unit, sizeof unit);
    if (!strcmp(unit, "m")) return i;
  }
  return 0;
}

static int find_flattest(const afspm_client *client) {
  double size_m, tiles, pixels, best_m = INFINITY, x_m = 0, y_m = 0;
  int code, rows, columns;
  if ((code = afspm_setting_number(client, "size_m", &size_m)) || (code = afspm_setting_number(client, "tiles", &tiles)) ||
      (code = afspm_setting_number(client, "pixels", &pixels)))
    return code;

  /* a key has a scan taken once: started again after a crash, this program gets the scan of its earlier life */
  afspm_packets *scans;
  if ((code = afspm_scan(client, 0, 0, size_m, size_m, 0, (int)pixels, (int)pixels, "overview", -1, &scans))) return code;
  const int heights = heights_in(scans), edge = (int)(pixels / tiles);
  const double *heights_m;
  afspm_values(scans, heights, &heights_m);
  afspm_shape(scans, heights, &rows, &columns);
  for (int row = 0; row + edge <= rows; row += edge) {
    for (int column = 0; column + edge <= columns; column += edge) {
      const double rough_m = roughness_m(heights_m, columns, row, column, edge);
      if (rough_m >= best_m) continue;
      best_m = rough_m;
      afspm_pixel(scans, heights, row + edge / 2, column + edge / 2, &x_m, &y_m);
    }
  }
  afspm_packets_free(scans);

  const double tile_m = size_m / tiles;
  if ((code = afspm_scan(client, x_m, y_m, tile_m, tile_m, 0, (int)pixels, (int)pixels, "flattest", -1, &scans))) return code;
  char text[100];
  int64_t finished_ns = INT64_MIN;
  afspm_finished_ns(scans, 0, &finished_ns);
  afspm_packets_free(scans);
  snprintf(text, sizeof text, "the flattest place, %.3f nm rms, is at (%.0f, %.0f) nm", best_m * 1e9, x_m * 1e9, y_m * 1e9);
  afspm_log(client, "INFO", text);
  if ((code = afspm_note(client, text, finished_ns))) return code;
  return afspm_end_experiment(client);
}

int main(void) {
  afspm_client *client;
  int code = afspm_launched(&client);
  if (code == AFSPM_OK) code = find_flattest(client);
  if (code != AFSPM_OK) {
    char message[500];
    afspm_error_message(client, message, sizeof message);
    fprintf(stderr, "ERROR %s\n", message);
  }
  afspm_free(client); /* leaves the experiment */
  return code;
}
