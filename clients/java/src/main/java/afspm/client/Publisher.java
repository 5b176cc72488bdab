package afspm.client;

import java.nio.charset.StandardCharsets;
import java.util.Arrays;
import java.util.List;
import org.zeromq.SocketType;
import org.zeromq.ZContext;
import org.zeromq.ZMQ;

/** Publishes this component's own messages, with times that increase strictly. */
final class Publisher implements AutoCloseable {
    private final ZContext context = new ZContext();
    private final ZMQ.Socket socket;
    private long newestNs;

    Publisher(String address, Launch.Keys keys) {
        context.setLinger(Sockets.LINGER_MS);
        socket = Sockets.open(context, SocketType.PUB);
        if (keys != null && keys.everywhere) {
            letInPeers(keys);
            socket.setCurveServer(true);
            socket.setCurveSecretKey(ZMQ.Curve.z85Decode(keys.secret));
            socket.setZapDomain("afspm".getBytes(StandardCharsets.UTF_8));
        }
        socket.bind(address);
    }

    synchronized void publish(String envelope, byte[] message, long nowNs) {
        newestNs = Math.max(nowNs, newestNs + 1);
        Sockets.send(socket, Packet.encode(envelope, message, newestNs));
    }

    @Override
    public synchronized void close() {
        context.close();
    }

    /** Answer ZeroMQ's authentication requests (RFC 27): accept the keys of the launch line. */
    private void letInPeers(Launch.Keys keys) {
        ZMQ.Socket guard = context.createSocket(SocketType.REP);
        guard.setLinger(0);
        guard.bind("inproc://zeromq.zap.01");
        Thread thread = new Thread(() -> {
            try {
                while (!Thread.currentThread().isInterrupted()) {
                    List<byte[]> question = Sockets.receive(guard);
                    if (question.isEmpty()) {
                        question = rest(guard);
                    }
                    String key = question.size() > 6 && question.get(6).length == 32 ? ZMQ.Curve.z85Encode(question.get(6)) : "";
                    String owner = keys.peers.get(key);
                    Sockets.send(guard, Arrays.asList(question.get(0), question.get(1), utf8(owner == null ? "400" : "200"),
                            utf8(owner == null ? "this key is not known" : ""), utf8(owner == null ? "" : owner), utf8("")));
                }
            } catch (RuntimeException closed) {
                Link.LOG.fine("no more connections are accepted: " + closed);
            }
        }, "guard");
        thread.setDaemon(true);
        thread.start();
    }

    private static List<byte[]> rest(ZMQ.Socket guard) {
        byte[] first = guard.recv();
        List<byte[]> frames = Sockets.receive(guard);
        frames.add(0, first);
        return frames;
    }

    private static byte[] utf8(String text) {
        return text.getBytes(StandardCharsets.UTF_8);
    }
}
