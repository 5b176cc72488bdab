"""The first process of a host: `python host_init.py NAME ADDRESS HOSTS_FILE BOOT_ID_FILE SOCKET`, in new namespaces.

It makes the network device, hands its descriptor over by the socket, and stays until the other end of that is closed.
When it ends, the kernel kills all other processes of the host at once, as in a power cut.
"""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import struct
import subprocess
import sys

_TUNSETIFF, _TUN_WITHOUT_HEADER = 0x400454CA, 0x1001
DEVICE = "up0"


def main(name: str, address: str, hosts_file: str, boot_id_file: str, descriptor: str) -> None:
    """Set up the host, and stay."""
    for source, target in ((hosts_file, "/etc/hosts"), (boot_id_file, "/proc/sys/kernel/random/boot_id")):
        subprocess.run(["mount", "--bind", source, target], check=True)
    socket.sethostname(name)
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", DEVICE.encode(), _TUN_WITHOUT_HEADER))
    for command in (
        "ip link set lo up",
        f"ip address add {address}/24 dev {DEVICE}",
        f"ip link set {DEVICE} up",
    ):
        subprocess.run(command.split(), check=True)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # so that the kernel forgets orphans that have ended
    with socket.socket(fileno=int(descriptor)) as parent:
        socket.send_fds(parent, [b"ready"], [device])
        os.close(device)
        parent.recv(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
