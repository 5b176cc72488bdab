package afspm.client;

import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.Collections;
import java.util.HashMap;
import java.util.List;
import java.util.Map;
import org.zeromq.SocketType;
import org.zeromq.ZContext;
import org.zeromq.ZMQ;

/**
 * Receives the packets of one publisher: each once, and missed packets before newer ones. Unlike SUB, XSUB
 * sends the marker of a replay unchanged. Used by one thread.
 */
final class Subscription {
    private static final byte[] KILL = utf8("KILL");
    private static final int LONGEST_PACKET = 256 * 1024 * 1024;
    private static final byte SUBSCRIBE = 1;
    private static final byte UNSUBSCRIBE = 0;

    /** Events of a subscription. */
    interface Listener {
        void onPacket(Packet packet);

        void onCaughtUp();

        void onKill();

        void onDropped(String why);
    }

    final ZMQ.Socket socket;
    final Sockets.Monitor monitor;
    private final String name;
    private final String address;
    private final List<String> prefixes = new ArrayList<>();
    private final Listener listener;
    private final Map<String, Long> newestOf = new HashMap<>();
    private long newestNs = -1;
    private int connections;
    private byte[] topic = {};
    private byte[] marker;

    /** @param prefixes of the wanted envelopes; null: all. The signal KILL is always included. */
    Subscription(ZContext context, Launch launch, String address, List<String> prefixes, Listener listener) {
        this.name = launch.name;
        this.address = address;
        this.prefixes.addAll(prefixes == null ? Collections.singletonList("") : prefixes);
        if (this.prefixes.stream().noneMatch("KILL"::startsWith)) {
            this.prefixes.add("KILL");
        }
        this.listener = listener;
        socket = Sockets.open(context, SocketType.XSUB);
        socket.setMaxMsgSize(LONGEST_PACKET);
        monitor = new Sockets.Monitor(context, socket);
        Sockets.encrypt(socket, launch.keys, address);
        this.prefixes.forEach(prefix -> send(SUBSCRIBE, utf8(prefix)));
        socket.connect(address);
    }

    /** Request packets newer than the newest received one, after each connection. */
    void follow() {
        for (Boolean isThere = monitor.next(); isThere != null; isThere = monitor.next()) {
            if (isThere) {
                forgetMarker();
                topic = utf8("\0replay/" + name + "/" + connections++);
                marker = utf8("\0replay/" + name + "/" + (connections - 1) + "\0" + newestNs + "\0" + String.join("\0", prefixes));
                send(SUBSCRIBE, marker);
            }
        }
    }

    void receive() {
        for (List<byte[]> frames = Sockets.receive(socket); !frames.isEmpty(); frames = Sockets.receive(socket)) {
            try {
                take(frames);
            } catch (WireException | InvalidValueException error) {
                listener.onDropped("dropped a packet from " + address + ": " + error.getMessage());
            }
        }
    }

    /** Unsubscribe: otherwise the socket would repeat the request at its next connection. */
    private void forgetMarker() {
        if (marker != null) {
            send(UNSUBSCRIBE, marker);
        }
        marker = null;
    }

    private void send(byte kind, byte[] subject) {
        byte[] frame = new byte[subject.length + 1];
        frame[0] = kind;
        System.arraycopy(subject, 0, frame, 1, subject.length);
        socket.send(frame, ZMQ.DONTWAIT);
    }

    private void take(List<byte[]> frames) {
        byte[] first = frames.get(0);
        if (first.length > 0 && first[0] == 0) {
            if (marker == null || !Arrays.equals(first, topic)) {
                return; // of an earlier connection or another subscriber
            }
            if (frames.size() == 1) {
                forgetMarker();
                listener.onCaughtUp();
                return;
            }
            frames = frames.subList(1, frames.size());
        } else if (frames.size() == 1 && Arrays.equals(first, KILL)) {
            listener.onKill();
            return;
        }
        Packet packet = Packet.decode(frames);
        if (isNew(packet)) {
            listener.onPacket(packet);
        }
    }

    private boolean isNew(Packet packet) {
        if (prefixes.stream().noneMatch(packet.envelope()::startsWith)) {
            return false;
        }
        if (packet.timeNs() == 0) {
            return true;
        }
        if (packet.timeNs() <= newestOf.getOrDefault(packet.envelope(), -1L)) {
            return false;
        }
        newestOf.put(packet.envelope(), packet.timeNs());
        newestNs = Math.max(newestNs, packet.timeNs());
        return true;
    }

    private static byte[] utf8(String text) {
        return text.getBytes(StandardCharsets.UTF_8);
    }
}
