/* afspm.h: components for afspm experiments, which automate scanning probe microscopes, in C and all that can call it.
 *
 * Conventions
 *   Lengths are in metres, angles in radians, times in nanoseconds since 1970. Texts are UTF-8 and end with a zero byte.
 *   Timeouts are in seconds of real time; a negative one waits for as long as it takes.
 *   A call returns a code: AFSPM_OK (0), or what is wrong; afspm_error_message() then says it in words, for each handle.
 *   A call with `char *text, int capacity` that returns a length copies as much as fits, and a zero byte; it returns the
 *   length in bytes of the whole text. `text` may be NULL with a capacity of 0.
 *   Results may be NULL where they are not wanted. No structure is passed by value, and nothing is called back.
 *   A handle may be used by several threads; give each thread its own by afspm_clone(), so that each has its own message.
 */
#ifndef AFSPM_H
#define AFSPM_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(_WIN32) && !defined(AFSPM_STATIC)
#define AFSPM_API __declspec(dllimport)
#else
#define AFSPM_API
#endif

typedef struct afspm_client afspm_client;   /* a connection to an experiment */
typedef struct afspm_packets afspm_packets; /* the channels of a scan, a spectrum, or one packet that was published */

enum {
  AFSPM_OK = 0,
  AFSPM_REFUSED = 1,            /* scheduler, limit or microscope said no: see afspm_refusal() */
  AFSPM_TIMED_OUT = 2,          /* the time given was up */
  AFSPM_MEASUREMENT_FAILED = 3, /* again and again, without a reason: a person should look */
  AFSPM_INVALID = 4,            /* an argument makes no sense, or the handle is not connected */
  AFSPM_WIRE = 5,               /* bytes that are no message */
  AFSPM_TRANSPORT = 6,          /* an address can't be used */
  AFSPM_FILE = 7,               /* a file can't be read or written */
  AFSPM_TOO_SMALL = 9,          /* the buffer has no room for all of it */
  AFSPM_FAULT = 10,             /* of the library: please report it */
  /* The next three are exit codes: return them from main(). */
  AFSPM_CONFIG = 78,            /* settings that can't work */
  AFSPM_ENDED = 80,             /* the experiment has ended */
  AFSPM_STOPPED = 81            /* the process was asked to stop: standard input has ended */
};

enum { AFSPM_MODE_UNDEFINED = 0, AFSPM_MANUAL = 1, AFSPM_AUTOMATED = 2 };

enum { /* what the microscope does */
  AFSPM_UNDEFINED = 0, AFSPM_MOVING = 1, AFSPM_SCANNING = 2, AFSPM_FREE = 3, AFSPM_INTERRUPTED = 4,
  AFSPM_COARSE_MOTOR = 5, AFSPM_BUSY_PARAMETER = 6, AFSPM_SPECTRUM = 7
};

/* --- joining and leaving ---
 * Each makes a handle, also where it fails: then the handle only has the message. Free it in both cases. */

/* Take part in the experiment that has started this process; standard input then belongs to the library. */
AFSPM_API int afspm_launched(afspm_client **client);
/* Join a running experiment by the folder of its run, under a name of its own. */
AFSPM_API int afspm_join(const char *run_folder, const char *name, afspm_client **client);
/* Connect as a launch line (JSON) says. */
AFSPM_API int afspm_open(const char *launch_line, afspm_client **client);
/* Make another handle of the same connection. */
AFSPM_API int afspm_clone(const afspm_client *client, afspm_client **other);
/* Leave the experiment: give back control, and end every call that waits, of all handles of the connection. */
AFSPM_API int afspm_leave(const afspm_client *client);
/* Free a handle; the last one of a connection leaves. NULL is fine. */
AFSPM_API void afspm_free(afspm_client *client);

/* --- what went wrong in the last call of this handle --- */

AFSPM_API int afspm_error_message(const afspm_client *client, char *text, int capacity);
/* The number of the response (ControlResponse of proto/control.proto), and the detail: 1, the request was not sent;
 * 2, it may or may not have been carried out; 3, the experiment has ended; 0 for none. */
AFSPM_API int afspm_refusal(const afspm_client *client, int *response, int *detail);
AFSPM_API int afspm_refusal_reason(const afspm_client *client, char *text, int capacity);
/* "REP_NOT_FREE" for 7; a number that has no name as digits. */
AFSPM_API int afspm_response_name(int response, char *text, int capacity);

/* --- about the component --- */

AFSPM_API int afspm_name(const afspm_client *client, char *text, int capacity);
AFSPM_API int afspm_run_folder(const afspm_client *client, char *text, int capacity);
/* A setting of the component's table in the experiment file: text as it is, all else as JSON. Returns a code. */
AFSPM_API int afspm_setting(const afspm_client *client, const char *name, char *text, int capacity);
AFSPM_API int afspm_setting_number(const afspm_client *client, const char *name, double *value);
AFSPM_API int afspm_now_ns(const afspm_client *client, int64_t *time_ns); /* of the experiment's clock */
/* Write a line into the log; `level` is "INFO", "WARNING", "ERROR" or "DEBUG". */
AFSPM_API int afspm_log(const afspm_client *client, const char *level, const char *text);
/* Allow the program to compute for so long between two calls (30 s by default); beyond that it counts as frozen. */
AFSPM_API int afspm_allow_step(const afspm_client *client, double longest_s);

/* What the client holds to be true now: whether it is in control, AFSPM_MANUAL …, AFSPM_FREE … */
AFSPM_API int afspm_state(const afspm_client *client, int *in_control, int *mode, int *scope_state);
AFSPM_API int afspm_holder(const afspm_client *client, char *text, int capacity); /* "" if nobody is in control */
/* The numbers of the problems that are flagged. */
AFSPM_API int afspm_problems(const afspm_client *client, int *numbers, int capacity, int *count);

/* --- what comes --- */

/* Wait until the scheduler is connected and all packets of its cache have arrived. */
AFSPM_API int afspm_wait_ready(const afspm_client *client, double timeout_s);
/* The oldest packet that was not given out yet and whose envelope begins with `prefix` ("" for all). */
AFSPM_API int afspm_next(const afspm_client *client, const char *prefix, double timeout_s, afspm_packets **packet);
/* The next line of standard input after the launch line, of afspm_launched(). After AFSPM_TOO_SMALL it is still there. */
AFSPM_API int afspm_line(const afspm_client *client, double timeout_s, char *text, int capacity);

/* --- control --- */

/* Have control; it is waited for while it may come. `problem`: the flagged problem that will be solved, 0 for none. */
AFSPM_API int afspm_request_control(const afspm_client *client, int problem, double timeout_s);
AFSPM_API int afspm_release_control(const afspm_client *client);
AFSPM_API int afspm_problem(const afspm_client *client, const char *name, int *number);
AFSPM_API int afspm_flag(const afspm_client *client, int problem);
AFSPM_API int afspm_clear(const afspm_client *client, int problem);
AFSPM_API int afspm_set_mode(const afspm_client *client, int mode);
AFSPM_API int afspm_end_experiment(const afspm_client *client);

/* --- measuring ---
 * Control is asked for, waited for, and given back unless it was there before. A measurement that is interrupted (a problem,
 * MANUAL, a restart) is begun anew when control is back. `key`: NULL, or 1 to 100 characters without '/': it is then taken
 * once in the run, also when this program is killed meanwhile. Free what comes with afspm_packets_free(). */

/* Centre, size, angle and pixels of the scan. Width and height 0: the region that is set; rows and columns 0: likewise. */
AFSPM_API int afspm_scan(const afspm_client *client, double x_m, double y_m, double width_m, double height_m,
                         double angle_rad, int rows, int columns, const char *key, double timeout_s,
                         afspm_packets **scans);
/* NAN for x_m: where the probe stands. `kind`: such as "IV"; NULL: what is set. */
AFSPM_API int afspm_spectrum(const afspm_client *client, double x_m, double y_m, const char *kind, const char *key,
                             double timeout_s, afspm_packets **spectrum);
/* Remove what is kept of a key. */
AFSPM_API int afspm_forget(const afspm_client *client, const char *key);

/* --- settings and actions; all but afspm_get() and afspm_supports() need control --- */

AFSPM_API int afspm_get(const afspm_client *client, const char *parameter, char *value, int value_capacity, char *unit,
                        int unit_capacity);
AFSPM_API int afspm_set(const afspm_client *client, const char *parameter, const char *value, const char *unit);
/* `on`: 1, 0, or -1 to leave it; NAN leaves a number. Gains are in the controller's units. */
AFSPM_API int afspm_set_feedback(const afspm_client *client, int on, double proportional_gain, double integral_gain,
                                 double setpoint);
AFSPM_API int afspm_move_probe(const afspm_client *client, double x_m, double y_m, double timeout_s);
AFSPM_API int afspm_set_scan_region(const afspm_client *client, double x_m, double y_m, double width_m, double height_m,
                                    double angle_rad, int rows, int columns, double timeout_s);
AFSPM_API int afspm_action(const afspm_client *client, const char *name);
AFSPM_API int afspm_supports(const afspm_client *client, const char *action, int *yes);

/* --- telling --- */

AFSPM_API int afspm_progress(const afspm_client *client, int64_t done, int64_t of);
/* A remark on the scan that was finished at `scan_ns`; INT64_MIN: on now. */
AFSPM_API int afspm_note(const afspm_client *client, const char *text, int64_t scan_ns);

/* Any request of docs/reference/wire.md, by its number. AFSPM_REFUSED for every response but success. */
AFSPM_API int afspm_request(const afspm_client *client, int number, const uint8_t *object, int64_t size,
                            uint8_t *answer, int64_t capacity, int64_t *answer_size);

/* --- packets: `index` counts from 0 --- */

AFSPM_API void afspm_packets_free(afspm_packets *packets);
AFSPM_API int afspm_count(const afspm_packets *packets);
AFSPM_API int afspm_interruptions(const afspm_packets *packets); /* how often it was begun anew */
AFSPM_API int afspm_interruption(const afspm_packets *packets, int index, char *text, int capacity);
AFSPM_API int afspm_envelope(const afspm_packets *packets, int index, char *text, int capacity);
AFSPM_API int afspm_message(const afspm_packets *packets, int index, char *text, int capacity); /* such as "Scan2d" */
AFSPM_API int afspm_time_ns(const afspm_packets *packets, int index, int64_t *time_ns);         /* when published */
AFSPM_API int afspm_finished_ns(const afspm_packets *packets, int index, int64_t *time_ns);     /* for afspm_note() */
AFSPM_API int afspm_channel(const afspm_packets *packets, int index, char *text, int capacity); /* of a spectrum: kind */
AFSPM_API int afspm_unit(const afspm_packets *packets, int index, char *text, int capacity);
AFSPM_API int afspm_shape(const afspm_packets *packets, int index, int *rows, int *columns); /* points, variables */
AFSPM_API int afspm_first_row(const afspm_packets *packets, int index, int *row);            /* of rows of a scan */
/* Row after row, without a copy: valid until afspm_packets_free(). Returns how many there are. */
AFSPM_API int64_t afspm_values(const afspm_packets *packets, int index, const double **values);
/* The same, copied, for languages without pointers. */
AFSPM_API int afspm_copy_values(const afspm_packets *packets, int index, double *values, int64_t capacity);
AFSPM_API int afspm_is_view(const afspm_packets *packets, int index); /* 1: read in the buffer that ZeroMQ received */
AFSPM_API int afspm_region(const afspm_packets *packets, int index, double *five); /* x, y, width, height, angle */
AFSPM_API int afspm_pixel(const afspm_packets *packets, int index, int row, int column, double *x_m, double *y_m);
AFSPM_API int afspm_position(const afspm_packets *packets, int index, double *x_m, double *y_m); /* of a spectrum */
AFSPM_API int afspm_column_name(const afspm_packets *packets, int index, int column, char *text, int capacity);
AFSPM_API int afspm_column_unit(const afspm_packets *packets, int index, int column, char *text, int capacity);
/* A message that is neither measurement nor state, in bytes, for afspm_to_json(). Returns their number. */
AFSPM_API int64_t afspm_bytes(const afspm_packets *packets, int index, const uint8_t **bytes);

/* --- messages without an experiment --- */

/* Read a packet's bytes by its envelope. */
AFSPM_API int afspm_decode(const char *envelope, const uint8_t *message, int64_t size, afspm_packets **packet);
/* A message by its name to and from protobuf's JSON. `length` and `size` are told also with AFSPM_TOO_SMALL. */
AFSPM_API int afspm_to_json(const char *message, const uint8_t *bytes, int64_t size, char *json, int capacity,
                            int *length);
AFSPM_API int afspm_from_json(const char *message, const char *json, uint8_t *bytes, int64_t capacity, int64_t *size);

#ifdef __cplusplus
}
#endif
#endif
