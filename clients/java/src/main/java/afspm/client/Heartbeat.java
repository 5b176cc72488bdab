package afspm.client;

import java.nio.charset.StandardCharsets;
import java.util.Arrays;
import java.util.Locale;
import java.util.concurrent.CountDownLatch;
import java.util.concurrent.TimeUnit;
import java.util.function.DoubleSupplier;
import org.zeromq.SocketType;
import org.zeromq.ZContext;
import org.zeromq.ZMQ;

/** Heartbeats: a separate thread reports that this process is alive, and the age of its current step. */
final class Heartbeat implements AutoCloseable {
    private static final byte ALIVE = 0;
    private static final byte CLOSING = 1;

    private final CountDownLatch closing = new CountDownLatch(1);
    private final Launch launch;
    private final DoubleSupplier stepAgeS;
    private final double longestStepS;
    private final Thread thread;

    /**
     * @param stepAgeS age of the current step, in s; 0 when idle
     * @param longestStepS longest step, in s; a process in a longer step counts as frozen
     */
    Heartbeat(Launch launch, DoubleSupplier stepAgeS, double longestStepS) {
        this.launch = launch;
        this.stepAgeS = stepAgeS;
        this.longestStepS = longestStepS;
        thread = new Thread(this::run, "heartbeat");
        thread.setDaemon(true);
        thread.start();
    }

    /** Send the closing beat: the process ends on purpose. */
    @Override
    public void close() {
        closing.countDown();
        try {
            thread.join(2L * Sockets.LINGER_MS);
        } catch (InterruptedException error) {
            Thread.currentThread().interrupt();
        }
    }

    private void run() {
        try (ZContext context = new ZContext()) {
            context.setLinger(Sockets.LINGER_MS);
            // XPUB, since it sees the listener subscribe: a beat sent before that would be lost
            ZMQ.Socket socket = Sockets.open(context, SocketType.XPUB);
            if (launch.keys != null && launch.keys.servers.containsKey(launch.sockets.heartbeat)) {
                Sockets.encrypt(socket, launch.keys, launch.sockets.heartbeat);
            }
            socket.connect(launch.sockets.heartbeat);
            socket.setReceiveTimeOut((int) (launch.beatPeriodS * 1000));
            socket.recv();
            socket.setReceiveTimeOut(0);
            do {
                beat(socket, ALIVE);
                socket.recv();
            } while (!closing.await((long) (launch.beatPeriodS * 1000), TimeUnit.MILLISECONDS));
            beat(socket, CLOSING);
        } catch (InterruptedException error) {
            Thread.currentThread().interrupt();
        }
    }

    private void beat(ZMQ.Socket socket, byte kind) {
        Sockets.send(socket, Arrays.asList(new byte[] {kind}, seconds(stepAgeS.getAsDouble()), seconds(longestStepS),
                launch.beatToken.getBytes(StandardCharsets.UTF_8)));
    }

    private static byte[] seconds(double seconds) {
        return String.format(Locale.ROOT, "%.3f", seconds).getBytes(StandardCharsets.US_ASCII);
    }
}
