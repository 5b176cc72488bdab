package afspm.client;

import java.util.ArrayList;
import java.util.Arrays;
import java.util.List;
import java.util.function.Consumer;
import org.zeromq.SocketType;
import org.zeromq.ZContext;
import org.zeromq.ZMQ;

/** The connection to the scheduler: a DEALER with the identity of this component. Used by one thread. */
final class ControlSocket {
    private static final int LONGEST_RESPONSE = 1024 * 1024;
    private static final int ALIVE_MS = 2000;
    private static final byte[] DELIMITER = {};

    final ZMQ.Socket socket;
    final Sockets.Monitor monitor;
    private final String address;
    private final Consumer<Boolean> onConnected;
    private final Consumer<Response> onResponse;

    ControlSocket(ZContext context, Launch launch, Consumer<Boolean> onConnected, Consumer<Response> onResponse) {
        this.address = launch.sockets.control;
        this.onConnected = onConnected;
        this.onResponse = onResponse;
        socket = Sockets.open(context, SocketType.DEALER);
        socket.setIdentity(launch.routingId());
        socket.setMaxMsgSize(LONGEST_RESPONSE);
        socket.setHeartbeatIvl(ALIVE_MS);
        socket.setHeartbeatTimeout(4 * ALIVE_MS);
        socket.setHeartbeatTtl(4 * ALIVE_MS);
        monitor = new Sockets.Monitor(context, socket);
        Sockets.encrypt(socket, launch.keys, address);
        socket.connect(address);
    }

    void send(List<byte[]> frames) {
        List<byte[]> message = new ArrayList<>();
        message.add(DELIMITER);
        message.addAll(frames);
        Sockets.send(socket, message); // dropped if the socket is full: the request is repeated
    }

    /** Replace a connection that is established but without answers: it would never recover. */
    void reconnect() {
        onConnected.accept(false);
        socket.disconnect(address);
        socket.connect(address);
    }

    void follow() {
        for (Boolean isThere = monitor.next(); isThere != null; isThere = monitor.next()) {
            onConnected.accept(isThere);
        }
    }

    void receive() {
        for (List<byte[]> frames = Sockets.receive(socket); !frames.isEmpty(); frames = Sockets.receive(socket)) {
            if (frames.size() < 2 || !Arrays.equals(frames.get(0), DELIMITER)) {
                continue; // empty: the scheduler probes whether this client is alive
            }
            try {
                onResponse.accept(Response.decode(frames.subList(1, frames.size())));
            } catch (WireException error) {
                continue; // not an answer; the request is repeated
            }
        }
    }
}
