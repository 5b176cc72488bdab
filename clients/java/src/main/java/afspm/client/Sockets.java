package afspm.client;

import java.util.ArrayList;
import java.util.List;
import org.zeromq.SocketType;
import org.zeromq.ZContext;
import org.zeromq.ZEvent;
import org.zeromq.ZMQ;
import org.zeromq.ZMonitor;

/** Creates sockets with afspm's options: a lost peer is noticed within seconds, and reconnected at once. */
final class Sockets {
    static final int LINGER_MS = 200;
    private static final int ALIVE_S = 2;

    private Sockets() {
    }

    static ZMQ.Socket open(ZContext context, SocketType type) {
        ZMQ.Socket socket = context.createSocket(type);
        socket.setLinger(LINGER_MS);
        socket.setHWM(0);
        socket.setTCPKeepAlive(1);
        socket.setTCPKeepAliveIdle(ALIVE_S);
        socket.setTCPKeepAliveInterval(ALIVE_S);
        socket.setTCPKeepAliveCount(3);
        socket.setReconnectIVL(20);
        socket.setReconnectIVLMax(200);
        socket.setHandshakeIvl(5000);
        return socket;
    }

    /** Set the keys for a connection to {@code address} if it is encrypted. */
    static void encrypt(ZMQ.Socket socket, Launch.Keys keys, String address) {
        String serverKey = keys == null ? null : keys.serverKey(address);
        if (serverKey != null) {
            socket.setCurveServerKey(ZMQ.Curve.z85Decode(serverKey));
            socket.setCurvePublicKey(ZMQ.Curve.z85Decode(keys.publicKey));
            socket.setCurveSecretKey(ZMQ.Curve.z85Decode(keys.secret));
        }
    }

    /** Return the frames of the next message; empty if there is none. */
    static List<byte[]> receive(ZMQ.Socket socket) {
        List<byte[]> frames = new ArrayList<>();
        byte[] frame = socket.recv(ZMQ.DONTWAIT);
        while (frame != null) {
            frames.add(frame);
            frame = socket.hasReceiveMore() ? socket.recv() : null;
        }
        return frames;
    }

    /** Send a whole message; return false if no peer is connected. */
    static boolean send(ZMQ.Socket socket, List<byte[]> frames) {
        for (int i = 0; i < frames.size(); i++) {
            if (!socket.send(frames.get(i), ZMQ.DONTWAIT | (i < frames.size() - 1 ? ZMQ.SNDMORE : 0))) {
                return false;
            }
        }
        return true;
    }

    /** The connection events of one socket, in the order in which they happened. */
    static final class Monitor {
        /** JeroMQ 0.6 has no event for the end of the handshake; messages sent before it wait for it. */
        private static final ZMonitor.Event BEGUN = ZMonitor.Event.HANDSHAKE_PROTOCOL;
        final ZMQ.Socket socket;

        Monitor(ZContext context, ZMQ.Socket watched) {
            String address = "inproc://monitor-" + System.identityHashCode(watched);
            watched.monitor(address, zmq.ZMQ.ZMQ_EVENT_HANDSHAKE_PROTOCOL | zmq.ZMQ.ZMQ_EVENT_DISCONNECTED);
            socket = context.createSocket(SocketType.PAIR);
            socket.setLinger(0);
            socket.connect(address);
        }

        /** Return whether the next event is a connection (false: a disconnection); null if there is no event. */
        Boolean next() {
            ZEvent event = ZEvent.recv(socket, ZMQ.DONTWAIT);
            return event == null ? null : (Boolean) (event.getEvent() == BEGUN);
        }
    }
}
