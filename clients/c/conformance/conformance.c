/* The conformance program of the C library, see docs/reference/client-conformance.md. */

#include <cjson/cJSON.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "afspm.h"

#define DEGREES (180.0 / 3.14159265358979323846)
enum { ROOM = 1 << 20 };

struct step {
  afspm_client *client;
  cJSON *about;
};

static const char *text(const cJSON *step, const char *name) {
  const char *found = cJSON_GetStringValue(cJSON_GetObjectItem(step, name));
  return found ? found : "";
}

static double number(const cJSON *step, const char *name, double otherwise) {
  const cJSON *found = cJSON_GetObjectItem(step, name);
  return cJSON_IsNumber(found) ? found->valuedouble : otherwise;
}

static double of_pair(const cJSON *step, const char *name, int i) {
  return cJSON_GetArrayItem(cJSON_GetObjectItem(step, name), i)->valuedouble;
}

static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

static void add_bytes(cJSON *to, const char *name, const uint8_t *bytes, int64_t size) {
  char *encoded = calloc(1, (size_t)size / 3 * 4 + 5), *at = encoded;
  for (int64_t i = 0; i < size; i += 3) {
    uint32_t three = 0;
    for (int64_t j = i; j < i + 3; j++) three = three << 8 | (j < size ? bytes[j] : 0);
    for (int j = 0; j < 4; j++) *at++ = i + j > size ? '=' : digits[three >> (18 - 6 * j) & 63];
  }
  cJSON_AddStringToObject(to, name, encoded);
  free(encoded);
}

static int64_t bytes_of(const cJSON *step, const char *name, uint8_t *bytes) {
  uint32_t held = 0, bits = 0;
  int64_t size = 0;
  for (const char *at = text(step, name); *at && *at != '='; at++) {
    held = held << 6 | (uint32_t)(strchr(digits, *at) - digits);
    if ((bits += 6) >= 8) bytes[size++] = (uint8_t)(held >> (bits -= 8));
  }
  return size;
}

static void add_pair(cJSON *to, const char *name, double a, double b) {
  const double pair[] = {a, b};
  cJSON_AddItemToObject(to, name, cJSON_CreateDoubleArray(pair, 2));
}

static void add_text_or_null(cJSON *to, const char *name, const char *found) {
  cJSON_AddItemToObject(to, name, *found ? cJSON_CreateString(found) : cJSON_CreateNull());
}

/* 64 bits of nanoseconds do not fit into the double that cJSON writes. */
static void add_time(cJSON *to, const afspm_packets *packets, int i) {
  int64_t time_ns;
  char raw[32] = "null";
  if (afspm_time_ns(packets, i, &time_ns) == AFSPM_OK) snprintf(raw, sizeof raw, "%lld", (long long)time_ns);
  cJSON_AddRawToObject(to, "timestamp_ns", raw);
}

static void add_values(cJSON *to, const afspm_packets *packets, int i) {
  const double *values;
  const int64_t count = afspm_values(packets, i, &values);
  double sum = 0, moment = 0;
  for (int64_t k = 0; k < count; k++) sum += values[k], moment += (double)k * values[k];
  cJSON *about = cJSON_AddObjectToObject(to, "values");
  cJSON_AddNumberToObject(about, "count", (double)count);
  cJSON_AddNumberToObject(about, "sum", sum);
  cJSON_AddNumberToObject(about, "moment", moment);
  cJSON_AddItemToObject(about, "first", count ? cJSON_CreateNumber(values[0]) : cJSON_CreateNull());
  cJSON_AddItemToObject(about, "last", count ? cJSON_CreateNumber(values[count - 1]) : cJSON_CreateNull());
}

static void add_facts(cJSON *to, const afspm_packets *packets, int i) {
  char found[1024];
  double region[5], x, y;
  int rows, columns;
  afspm_envelope(packets, i, found, sizeof found);
  cJSON_AddStringToObject(to, "envelope", found);
  afspm_message(packets, i, found, sizeof found);
  cJSON_AddStringToObject(to, "message", found);
  add_time(to, packets, i);
  if (afspm_shape(packets, i, &rows, &columns) != AFSPM_OK) return;
  add_pair(to, "shape", rows, columns);
  cJSON_AddBoolToObject(to, "view", afspm_is_view(packets, i));
  afspm_channel(packets, i, found, sizeof found);
  if (afspm_region(packets, i, region) == AFSPM_OK) {
    cJSON_AddStringToObject(to, "channel", found);
    afspm_unit(packets, i, found, sizeof found);
    cJSON_AddStringToObject(to, "unit", found);
    add_pair(to, "center_m", region[0], region[1]);
    add_pair(to, "size_m", region[2], region[3]);
    cJSON_AddNumberToObject(to, "angle_deg", region[4] * DEGREES);
  } else {
    cJSON_AddStringToObject(to, "kind", found);
    if (afspm_position(packets, i, &x, &y) == AFSPM_OK) add_pair(to, "position_m", x, y);
    cJSON *names = cJSON_AddArrayToObject(to, "names"), *units = cJSON_AddArrayToObject(to, "units");
    for (int k = 0; k < columns; k++) {
      afspm_column_name(packets, i, k, found, sizeof found);
      cJSON_AddItemToArray(names, cJSON_CreateString(found));
      afspm_column_unit(packets, i, k, found, sizeof found);
      cJSON_AddItemToArray(units, cJSON_CreateString(found));
    }
  }
  add_values(to, packets, i);
}

static void add_measured(cJSON *to, const char *name, afspm_packets *packets) {
  cJSON *all = cJSON_AddArrayToObject(to, name);
  for (int i = 0; i < afspm_count(packets); i++) {
    cJSON *facts = cJSON_CreateObject();
    add_facts(facts, packets, i);
    cJSON_AddItemToArray(all, facts);
  }
  cJSON_AddNumberToObject(to, "interruptions", afspm_interruptions(packets));
  afspm_packets_free(packets);
}

static void add_state(cJSON *to, const afspm_client *client) {
  static const char *const modes[] = {"CM_UNDEFINED", "CM_MANUAL", "CM_AUTOMATED"};
  static const char *const states[] = {"SS_UNDEFINED",   "SS_MOVING",       "SS_SCANNING",   "SS_FREE",
                                       "SS_INTERRUPTED", "SS_COARSE_MOTOR", "SS_BUSY_PARAM", "SS_SPEC"};
  char holder[256];
  int in_control, mode, state, count, problems[256];
  afspm_state(client, &in_control, &mode, &state);
  afspm_problems(client, problems, 256, &count);
  afspm_holder(client, holder, sizeof holder);
  cJSON_AddBoolToObject(to, "in_control", in_control);
  add_text_or_null(to, "holder", holder);
  cJSON_AddStringToObject(to, "mode", modes[mode]);
  cJSON_AddItemToObject(to, "problems", cJSON_CreateIntArray(problems, count));
  cJSON_AddStringToObject(to, "scope_state", states[state]);
}

static int add_parameter(cJSON *to, const afspm_client *client, const char *name) {
  char value[1024], unit[256];
  const int code = afspm_get(client, name, value, sizeof value, unit, sizeof unit);
  if (code != AFSPM_OK) return code;
  cJSON_AddStringToObject(to, "value", value);
  add_text_or_null(to, "unit", unit);
  return code;
}

/* `json` and `bytes` have ROOM bytes each. */
static int add_message(cJSON *to, const cJSON *step, int is_decoded, char *json, uint8_t *bytes) {
  int64_t size = 0;
  if (is_decoded) {
    size = bytes_of(step, "bytes", bytes);
    const int code = afspm_to_json(text(step, "message"), bytes, size, json, ROOM, NULL);
    if (code != AFSPM_OK) return code;
    cJSON_AddRawToObject(to, "fields", json);
  } else {
    cJSON_PrintPreallocated(cJSON_GetObjectItem(step, "fields"), json, ROOM, 0);
  }
  const int code = afspm_from_json(text(step, "message"), json, bytes, ROOM, &size);
  if (code == AFSPM_OK) add_bytes(to, "bytes", bytes, size);
  return code;
}

static int request(cJSON *to, const afspm_client *client, const cJSON *step, uint8_t *bytes, uint8_t *answer) {
  int64_t size = bytes_of(step, "object", bytes);
  const int code = afspm_request(client, (int)number(step, "number", 0), bytes, size, answer, ROOM, &size);
  if (code != AFSPM_OK) return code;
  cJSON_AddStringToObject(to, "response", "REP_SUCCESS");
  add_bytes(to, "object", answer, size);
  return code;
}

static int done(const afspm_client *client, const cJSON *step, cJSON *to, char *json, uint8_t *bytes) {
  const char *what = text(step, "do"), *name = text(step, "name");
  const double timeout_s = number(step, "timeout_s", -1);
  const int n = (int)number(step, "number", 0);
  afspm_packets *found = NULL;
  int code = AFSPM_OK;
  if (!strcmp(what, "ready")) return afspm_wait_ready(client, timeout_s);
  if (!strcmp(what, "decode") || !strcmp(what, "encode")) return add_message(to, step, *what == 'd', json, bytes);
  if (!strcmp(what, "request")) return request(to, client, step, bytes, (uint8_t *)json);
  if (!strcmp(what, "request_control")) return afspm_request_control(client, (int)number(step, "problem", 0), timeout_s);
  if (!strcmp(what, "release_control")) return afspm_release_control(client);
  if (!strcmp(what, "get_parameter")) return add_parameter(to, client, name);
  if (!strcmp(what, "action")) return afspm_action(client, name);
  if (!strcmp(what, "problem")) return cJSON_IsTrue(cJSON_GetObjectItem(step, "set")) ? afspm_flag(client, n) : afspm_clear(client, n);
  if (!strcmp(what, "mode")) return afspm_set_mode(client, strcmp(text(step, "mode"), "CM_MANUAL") ? AFSPM_AUTOMATED : AFSPM_MANUAL);
  if (!strcmp(what, "state")) return add_state(to, client), AFSPM_OK;
  if (!strcmp(what, "end")) return afspm_end_experiment(client);
  if (!strcmp(what, "set_parameter")) {
    code = afspm_set(client, name, text(step, "value"), cJSON_GetStringValue(cJSON_GetObjectItem(step, "unit")));
    return code == AFSPM_OK ? add_parameter(to, client, name) : code;
  }
  if (!strcmp(what, "wait")) {
    code = afspm_next(client, text(step, "prefix"), timeout_s, &found);
    if (code == AFSPM_OK) add_facts(to, found, 0);
    afspm_packets_free(found);
    return code;
  }
  if (!strcmp(what, "scan")) {
    code = afspm_scan(client, of_pair(step, "center_m", 0), of_pair(step, "center_m", 1), of_pair(step, "size_m", 0),
                      of_pair(step, "size_m", 1), number(step, "angle_deg", 0) / DEGREES, (int)of_pair(step, "shape", 0),
                      (int)of_pair(step, "shape", 1), NULL, timeout_s, &found);
    if (code == AFSPM_OK) add_measured(to, "scans", found);
    return code;
  }
  if (!strcmp(what, "spectrum")) {
    code = afspm_spectrum(client, of_pair(step, "position_m", 0), of_pair(step, "position_m", 1), text(step, "kind"), NULL,
                          timeout_s, &found);
    if (code == AFSPM_OK) add_measured(to, "spectra", found);
    return code;
  }
  return AFSPM_INVALID;
}

static void add_failure(cJSON *to, const afspm_client *client, int code) {
  char found[4096];
  if (code != AFSPM_REFUSED) {
    afspm_error_message(client, found, sizeof found);
    cJSON_AddStringToObject(to, "error", found);
    return;
  }
  int response, detail;
  afspm_refusal(client, &response, &detail);
  const int has_name = afspm_response_name(response, found, sizeof found) > 4 && !strncmp(found, "REP_", 4);
  cJSON_AddItemToObject(to, "response", has_name ? cJSON_CreateString(found) : cJSON_CreateNumber(response));
  afspm_refusal_reason(client, found, sizeof found);
  cJSON_AddStringToObject(to, "reason", found);
  cJSON_AddNumberToObject(to, "detail", detail);
}

static void *answer(void *argument) {
  static pthread_mutex_t one_line_at_a_time = PTHREAD_MUTEX_INITIALIZER;
  struct step *step = argument;
  cJSON *to = cJSON_CreateObject();
  char *json = malloc(ROOM);
  uint8_t *bytes = malloc(ROOM);
  const int code = done(step->client, step->about, to, json, bytes);
  cJSON_AddBoolToObject(to, "ok", code == AFSPM_OK);
  if (code != AFSPM_OK) add_failure(to, step->client, code);
  cJSON_AddNumberToObject(to, "id", number(step->about, "id", 0));
  char *line = cJSON_PrintUnformatted(to);
  pthread_mutex_lock(&one_line_at_a_time);
  puts(line);
  fflush(stdout);
  pthread_mutex_unlock(&one_line_at_a_time);
  free(line), free(json), free(bytes);
  cJSON_Delete(to), cJSON_Delete(step->about);
  afspm_free(step->client);
  free(step);
  return NULL;
}

static int waits(const char *what) {
  return !strcmp(what, "scan") || !strcmp(what, "spectrum") || !strcmp(what, "wait") || !strcmp(what, "request_control");
}

int main(void) {
  static char line[ROOM];
  afspm_client *client;
  int code = afspm_launched(&client);
  while (code == AFSPM_OK && (code = afspm_line(client, -1, line, sizeof line)) == AFSPM_OK) {
    struct step *step = malloc(sizeof *step);
    step->about = cJSON_Parse(line);
    afspm_clone(client, &step->client);
    pthread_t thread;
    if (!waits(text(step->about, "do"))) answer(step);
    else if (pthread_create(&thread, NULL, answer, step) == 0) pthread_detach(thread);
  }
  afspm_leave(client);
  return code;
}
