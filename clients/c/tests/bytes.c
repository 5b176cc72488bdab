/* Bytes to and from the C face, to be run under AddressSanitizer: the reference packets, each also cut short at every byte and
 * with every byte changed, random bytes, and arguments that make no sense. It passes if nothing is read or written that is
 * not ours, and if what is whole says what it should. */

#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "afspm.h"

static int failures, tried;

static void expect(int holds, const char *what) {
  tried++;
  if (holds) return;
  failures++;
  fprintf(stderr, "FAILED: %s\n", what);
}

static char *whole_file(const char *path) {
  FILE *file = fopen(path, "rb");
  if (!file) return NULL;
  char *found = calloc(1, 1 << 22);
  const size_t size = fread(found, 1, (1 << 22) - 1, file);
  fclose(file);
  return size ? found : NULL;
}

/* Return bytes in a block of exactly their size, so that a read past its end is seen. */
static uint8_t *exactly(const uint8_t *bytes, size_t size) {
  uint8_t *copy = malloc(size ? size : 1);
  memcpy(copy, bytes, size);
  return copy;
}

static size_t from_hex(const char *hex, uint8_t *bytes) {
  size_t size = 0;
  for (unsigned byte; sscanf(hex + 2 * size, "%2x", &byte) == 1; size++) bytes[size] = (uint8_t)byte;
  return size;
}

/* Ask everything that can be asked of a packet, with buffers of all sizes. */
static double look_at(const afspm_packets *packets) {
  double sum = 0, five[5], x, y;
  int64_t time_ns;
  int rows = 0, columns = 0, first;
  for (int i = -1; i < 3; i++) {
    for (int room = 0; room < 40; room++) {
      char *text = malloc((size_t)room + 1);
      text[room] = 'x';
      afspm_envelope(packets, i, text, room), afspm_message(packets, i, text, room), afspm_channel(packets, i, text, room);
      afspm_unit(packets, i, text, room), afspm_interruption(packets, i, text, room);
      afspm_column_name(packets, i, room - 2, text, room), afspm_column_unit(packets, i, room - 2, text, room);
      expect(text[room] == 'x', "no byte is written behind a buffer");
      free(text);
    }
    const double *values;
    const uint8_t *bytes;
    const int64_t count = afspm_values(packets, i, &values);
    for (int64_t k = 0; k < count; k++) sum += values[k];
    double *copied = malloc(sizeof(double) * (size_t)(count + 1));
    expect(afspm_copy_values(packets, i, copied, count) == AFSPM_OK, "values are copied into as much room as they need");
    expect(!count || !memcmp(values, copied, sizeof(double) * (size_t)count), "a copy has the same values");
    expect(!count || afspm_copy_values(packets, i, copied, count - 1) == AFSPM_TOO_SMALL, "too little room is told");
    free(copied);
    const int64_t size = afspm_bytes(packets, i, &bytes);
    for (int64_t k = 0; k < size; k++) sum += bytes[k];
    afspm_time_ns(packets, i, &time_ns), afspm_finished_ns(packets, i, &time_ns), afspm_shape(packets, i, &rows, &columns);
    afspm_first_row(packets, i, &first), afspm_region(packets, i, five), afspm_position(packets, i, &x, &y);
    afspm_pixel(packets, i, rows, columns, &x, &y), afspm_pixel(packets, i, -1, 0, &x, NULL), afspm_is_view(packets, i);
  }
  return sum;
}

static int decode(const char *envelope, const uint8_t *bytes, size_t size) {
  uint8_t *own = exactly(bytes, size);
  afspm_packets *packets = NULL;
  const int code = afspm_decode(envelope, own, (int64_t)size, &packets);
  free(own); /* a packet keeps what it needs */
  expect((code == AFSPM_OK) == (packets != NULL), "there is a packet exactly if the code says so");
  if (packets) look_at(packets);
  afspm_packets_free(packets);
  return code;
}

static void golden_packet(const char *envelope, const char *hex) {
  static uint8_t bytes[1 << 16];
  const size_t size = from_hex(hex, bytes);
  expect(decode(envelope, bytes, size) == AFSPM_OK, envelope);
  for (size_t at = 0; at < size; at++) {
    decode(envelope, bytes, at);
    const uint8_t was = bytes[at];
    for (int bit = 0; bit < 8; bit += 3) {
      bytes[at] = was ^ (uint8_t)(1u << bit);
      decode(envelope, bytes, size);
    }
    bytes[at] = was;
  }
}

static void golden_message(const char *name, const char *hex) {
  static uint8_t bytes[1 << 16];
  static char json[1 << 18];
  const size_t size = from_hex(hex, bytes);
  uint8_t *own = exactly(bytes, size), *again = malloc(size ? size : 1);
  int length = 0;
  int64_t encoded = 0;
  expect(afspm_to_json(name, own, (int64_t)size, json, 4, &length) == AFSPM_TOO_SMALL || length < 4, "JSON may need more room");
  expect(afspm_to_json(name, own, (int64_t)size, json, length + 1, NULL) == AFSPM_OK, "JSON fits into what it says it needs");
  expect((int)strlen(json) == length, "the length of JSON is told");
  expect(afspm_from_json(name, json, again, (int64_t)size, &encoded) == AFSPM_OK && encoded == (int64_t)size, name);
  expect(!memcmp(own, again, size), "bytes to JSON and back are the same");
  for (size_t at = 0; at < size; at++) {
    own[at] ^= 0x55;
    afspm_to_json(name, own, (int64_t)size, json, sizeof json, &length);
    afspm_to_json(name, own, (int64_t)at, json, sizeof json, &length);
  }
  free(own), free(again);
}

static void random_bytes(void) {
  static const char *const names[] = {"Scan2d", "Spec1d_IV", "ScanLines", "ControlState", "DriftMapping", "Unheard"};
  static uint8_t bytes[300];
  srand(1);
  for (int round = 0; round < 20000; round++) {
    const size_t size = (size_t)(rand() % 300);
    for (size_t k = 0; k < size; k++) bytes[k] = (uint8_t)(rand() % 4 ? rand() % 48 : rand());
    decode(names[round % 6], bytes, size);
  }
}

static void nonsense(void) {
  afspm_client *client = NULL;
  afspm_packets *packets = NULL;
  char text[64];
  int number;
  expect(afspm_open(NULL, &client) == AFSPM_INVALID && client, "a failure to open has a handle with the message");
  expect(afspm_error_message(client, text, sizeof text) > 0, "and the handle says what is wrong");
  expect(afspm_scan(client, 0, 0, 1, 1, 0, 2, 2, NULL, 0, &packets) == AFSPM_INVALID, "it is not connected");
  afspm_free(client);
  expect(afspm_open("{\"name\": 3}", &client) == AFSPM_CONFIG, "a launch line that can't be read");
  afspm_free(client);
  expect(afspm_open("{\"name\": \"c\", \"sockets\": {\"control\": \"tcp://192.0.2.1:9\"}}", &client) == AFSPM_CONFIG,
         "another computer without keys is refused");
  afspm_free(client);
  expect(afspm_open("{\"name\": \"c\", \"keys\": {\"insecure\": \"true\"}, \"sockets\": {\"control\": \"tcp://192.0.2.1:9\"}}", &client)
             == AFSPM_OK, "unless the experiment is insecure");
  afspm_free(client);
  expect(afspm_open("{\"name\": \"c\", \"request_timeout_s\": 0.05, \"request_retries\": 1, "
                    "\"sockets\": {\"control\": \"tcp://127.0.0.1:9\", \"subscribe\": [\"tcp://127.0.0.1:9\"]}}", &client) == AFSPM_OK,
         "a connection is not waited for");
  expect(afspm_wait_ready(client, 0.01) == AFSPM_TIMED_OUT && afspm_next(client, NULL, 0, &packets) == AFSPM_TIMED_OUT, "it times out");
  expect(afspm_get(client, "x", text, sizeof text, text, sizeof text) == AFSPM_REFUSED, "a request without an answer ends");
  expect(afspm_refusal(client, &number, NULL) == AFSPM_OK && number == 3, "by REP_NO_RESPONSE");
  expect(afspm_get(client, "\xff", text, sizeof text, text, sizeof text) == AFSPM_INVALID, "text that is not UTF-8 is refused");
  expect(afspm_scan(client, 0, 0, -1, 1, 0, 2, 2, NULL, 0, &packets) == AFSPM_INVALID, "a region has a size");
  expect(afspm_scan(client, 0, 0, 1, 1, 0, 2, 2, "a/b", 0, &packets) == AFSPM_INVALID, "a key has no slash");
  expect(afspm_flag(client, 300) == AFSPM_INVALID && afspm_set_mode(client, 9) == AFSPM_INVALID, "numbers out of range are refused");
  expect(afspm_request(client, 1, NULL, -1, NULL, 0, NULL) == AFSPM_INVALID, "a size below zero is refused");
  afspm_leave(client);
  expect(afspm_wait_ready(client, -1) == AFSPM_STOPPED, "after leaving every call returns");
  afspm_free(client);
  expect(afspm_scan(NULL, 0, 0, 1, 1, 0, 2, 2, NULL, 0, &packets) == AFSPM_INVALID && !packets, "no handle at all");
  afspm_free(NULL), afspm_packets_free(NULL), look_at(NULL);
  expect(afspm_clone(NULL, &client) == AFSPM_INVALID, "nothing to clone");
  afspm_free(client);
  expect(afspm_to_json("Scan2d", NULL, 5, text, sizeof text, NULL) == AFSPM_INVALID, "bytes that are missing");
  expect(afspm_from_json("NoSuch", "{}", NULL, 0, NULL) == AFSPM_INVALID, "a message that does not exist");
}

int main(int count, char **arguments) {
  char *text = count > 1 ? whole_file(arguments[1]) : NULL;
  cJSON *golden = text ? cJSON_Parse(text) : NULL, *entry;
  if (!golden) return fprintf(stderr, "usage: bytes golden.json\n"), 2;
  cJSON_ArrayForEach(entry, cJSON_GetObjectItem(golden, "messages")) golden_message(
      cJSON_GetStringValue(cJSON_GetObjectItem(entry, "type")), cJSON_GetStringValue(cJSON_GetObjectItem(entry, "hex")));
  cJSON_ArrayForEach(entry, cJSON_GetObjectItem(golden, "published")) golden_packet(
      cJSON_GetStringValue(cJSON_GetObjectItem(entry, "envelope")),
      cJSON_GetStringValue(cJSON_GetArrayItem(cJSON_GetObjectItem(entry, "frames"), 1)));
  random_bytes();
  nonsense();
  cJSON_Delete(golden);
  free(text);
  printf("%d passed, %d failed\n", tried - failures, failures);
  return failures != 0;
}
