/* [values, unit, region] = afspm_scan(run_folder, name, [x y width height angle], [rows columns], channel)
 *
 * Join a running experiment, take a scan, and return one channel of it: a function for MATLAB and GNU Octave. Lengths are in m,
 * angles in rad. `values` is rows by columns, y upwards. */

#include <string.h>

#include "afspm.h"
#include "mex.h"

static void check(int code, afspm_client *client) {
  char message[500];
  if (code == AFSPM_OK) return;
  afspm_error_message(client, message, sizeof message);
  afspm_free(client);
  mexErrMsgIdAndTxt("afspm:call", "%s (code %d)", message, code);
}

/* MATLAB stores columns, the library rows. */
static mxArray *matrix(const afspm_packets *scans, int index) {
  const double *values;
  int rows, columns;
  afspm_values(scans, index, &values);
  afspm_shape(scans, index, &rows, &columns);
  mxArray *found = mxCreateDoubleMatrix((mwSize)rows, (mwSize)columns, mxREAL);
  for (int row = 0; row < rows; row++)
    for (int column = 0; column < columns; column++) mxGetPr(found)[column * rows + row] = values[row * columns + column];
  return found;
}

void mexFunction(int outputs, mxArray *out[], int inputs, const mxArray *in[]) {
  afspm_client *client;
  afspm_packets *scans;
  char run[1000], name[100], channel[100], found[100] = "";
  if (inputs != 5 || mxGetNumberOfElements(in[2]) != 5 || mxGetNumberOfElements(in[3]) != 2 || mxGetString(in[0], run, sizeof run) ||
      mxGetString(in[1], name, sizeof name) || mxGetString(in[4], channel, sizeof channel))
    mexErrMsgIdAndTxt("afspm:usage", "afspm_scan(run_folder, name, [x y width height angle], [rows columns], channel)");
  const double *at = mxGetPr(in[2]), *shape = mxGetPr(in[3]);
  check(afspm_join(run, name, &client), client);
  check(afspm_scan(client, at[0], at[1], at[2], at[3], at[4], (int)shape[0], (int)shape[1], NULL, -1, &scans), client);
  int index = 0;
  while (index < afspm_count(scans) && (afspm_channel(scans, index, found, sizeof found), strcmp(found, channel))) index++;
  if (index == afspm_count(scans)) {
    afspm_packets_free(scans);
    afspm_free(client);
    mexErrMsgIdAndTxt("afspm:channel", "the scan has no channel %s", channel);
  }
  out[0] = matrix(scans, index);
  if (outputs > 1) afspm_unit(scans, index, found, sizeof found), out[1] = mxCreateString(found);
  if (outputs > 2) out[2] = mxCreateDoubleMatrix(1, 5, mxREAL), afspm_region(scans, index, mxGetPr(out[2]));
  afspm_packets_free(scans);
  afspm_free(client);
}
