"""What a component in any language does: launch line, subscription, heartbeats, the end. It uses nothing of afspm."""

import json
import sys
import threading
import time

import zmq

launch = json.loads(sys.stdin.readline())
sockets = launch["sockets"]
context = zmq.Context()

# to be stopped: standard input ends when the parent wants that, or is dead
stopped = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), stopped.set()), daemon=True).start()

subscriber = context.socket(zmq.SUB)
for envelope in [*(launch["envelopes"] or [""]), "KILL"]:
    subscriber.subscribe(envelope.encode())
for address in sockets["subscribe"]:
    subscriber.connect(address)

heartbeat = context.socket(zmq.PUB)
heartbeat.linger = 200
if sockets["heartbeat"]:
    heartbeat.connect(sockets["heartbeat"])

sys.stdout.write(f"INFO {launch['settings']['greeting']} from {launch['name']}\n")
sys.stdout.flush()
received, ended, next_beat = 0, False, 0.0
while not (ended or stopped.is_set()):
    if time.monotonic() >= next_beat:
        heartbeat.send(b"\0")
        next_beat = time.monotonic() + launch["beat_period_s"] / 2
    if subscriber.poll(100):
        frames = subscriber.recv_multipart()
        ended = frames == [b"KILL"]
        if len(frames) >= 2:
            received += 1
            sys.stdout.write(f"INFO packet {received}: {frames[0].decode()}, {len(frames[1])} bytes\n")
            sys.stdout.flush()

heartbeat.send(b"\1")
context.destroy()
sys.exit(80 if ended else 0)  # 80: the experiment ended
