"""Join a running experiment by the C library alone, as MATLAB's loadlibrary or LabVIEW would.

    python3 join.py libafspm.so RUN_FOLDER

It uses nothing of afspm, and of the C interface only what such hosts can: plain arguments, texts copied into a buffer.
"""

import ctypes
import sys
from ctypes import byref, c_char_p, c_double, c_int, c_int64, c_void_p, create_string_buffer

ROOM = 4096
library = ctypes.CDLL(sys.argv[1])
library.afspm_values.restype = c_int64
for name in ("free", "packets_free"):
    getattr(library, f"afspm_{name}").restype = None
library.afspm_scan.argtypes = [
    c_void_p, *[c_double] * 5, c_int, c_int, c_char_p, c_double, ctypes.POINTER(c_void_p)
]  # fmt: skip


def text(function, *arguments):
    buffer = create_string_buffer(ROOM)
    getattr(library, f"afspm_{function}")(*arguments, buffer, ROOM)
    return buffer.value.decode()


def check(code):
    if code:
        sys.exit(f"code {code}: {text('error_message', client)}")


client = c_void_p()
check(library.afspm_join(sys.argv[2].encode(), b"matlab", byref(client)))
value, unit = create_string_buffer(ROOM), create_string_buffer(ROOM)
check(library.afspm_get(client, b"scan-speed", value, ROOM, unit, ROOM))
sys.stdout.write(f"scan-speed {value.value.decode()} {unit.value.decode()}\n")

packets = c_void_p()
check(library.afspm_scan(client, 0.0, 0.0, 1e-6, 1e-6, 0.0, 32, 64, None, 60.0, byref(packets)))
for index in range(library.afspm_count(packets)):
    pointer, rows, columns = ctypes.POINTER(c_double)(), c_int(), c_int()
    count = library.afspm_values(packets, index, byref(pointer))
    check(library.afspm_shape(packets, index, byref(rows), byref(columns)))
    copied = (c_double * count)()
    check(library.afspm_copy_values(packets, index, copied, c_int64(count)))
    same = all(pointer[i] == copied[i] for i in range(count))
    if not same:
        sys.exit("a copy has other values")
    channel, measured_in = text("channel", packets, index), text("unit", packets, index)
    sys.stdout.write(f"{channel}: {rows.value} x {columns.value} values in {measured_in}\n")
library.afspm_packets_free(packets)
library.afspm_free(client)
