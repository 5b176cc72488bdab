package afspm.client;

import afspm.Control.ScopeState;
import afspm.Feedback.ZCtrlParameters;
import java.io.IOException;
import java.nio.ByteBuffer;
import java.nio.channels.Pipe;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.HashMap;
import java.util.HashSet;
import java.util.List;
import java.util.Map;
import java.util.Queue;
import java.util.Set;
import java.util.concurrent.ConcurrentLinkedQueue;
import java.util.concurrent.CopyOnWriteArrayList;
import java.util.function.BiConsumer;
import java.util.function.BooleanSupplier;
import java.util.function.Consumer;
import java.util.logging.Level;
import java.util.logging.Logger;
import org.zeromq.ZContext;
import org.zeromq.ZMQ;

/**
 * A component's connections to its experiment, and the newest of each published state. One thread owns the
 * sockets; this object's monitor guards everything it receives, and other threads wait on it.
 */
final class Link implements AutoCloseable {
    static final Logger LOG = Logger.getLogger("afspm");
    private static final List<String> STATES =
            Arrays.asList("ScopeStateMsg", "ControlState", "ScanParameters2d", "ZCtrlParameters", "ProbePosition");

    final Launch launch;
    final List<BiConsumer<Packet, Boolean>> listeners = new CopyOnWriteArrayList<>();
    final Requests requests;
    private final ZContext context = new ZContext();
    private final Pipe wakeUp;
    private final Queue<Runnable> tasks = new ConcurrentLinkedQueue<>();
    private final List<Subscription> subscriptions = new ArrayList<>();
    private final Map<String, Object> newest = new HashMap<>();
    private final Map<String, Integer> counts = new HashMap<>();
    private final Set<String> caughtUp = new HashSet<>();
    private final ControlSocket control;
    private final Thread thread;
    private long newestNs = -1;
    private RuntimeException over;
    private int waiting;
    private long busySince = System.nanoTime();
    private volatile boolean isClosed;
    private volatile Consumer<RuntimeException> beforeFailure = reason -> { };

    Link(Launch launch) {
        this.launch = launch;
        try {
            wakeUp = Pipe.open();
            wakeUp.source().configureBlocking(false);
        } catch (IOException error) {
            throw new AfspmException("no pipe can be opened", error);
        }
        requests = new Requests(this);
        context.setLinger(Sockets.LINGER_MS);
        control = launch.sockets.control == null ? null
                : new ControlSocket(context, launch, requests::onConnected, requests::onResponse);
        List<String> wanted = wanted();
        for (String address : launch.sockets.subscribe) {
            subscriptions.add(new Subscription(context, launch, address, wanted, listener(address)));
        }
        thread = new Thread(this::run, "afspm");
        thread.setDaemon(true);
    }

    /** Begin to receive; call it after all listeners were added. */
    void start() {
        thread.start();
    }

    // --- waiting ---

    /** Wait until a condition holds, tested after each arrival; return false if the deadline comes first. */
    synchronized boolean await(BooleanSupplier condition, long deadline) {
        waiting += 1;
        try {
            while (true) {
                if (over != null) {
                    throw over;
                }
                if (condition.getAsBoolean()) {
                    return true;
                }
                long leftNs = deadline == Long.MAX_VALUE ? Long.MAX_VALUE : deadline - System.nanoTime();
                if (leftNs <= 0) {
                    return false;
                }
                wait(Math.min(leftNs / 1_000_000 + 1, 3_600_000));
            }
        } catch (InterruptedException error) {
            Thread.currentThread().interrupt();
            throw new StopRequestedException("this thread was interrupted");
        } finally {
            waiting -= 1;
            busySince = System.nanoTime();
        }
    }

    /** Wait without limit while the scheduler is away, otherwise for at most {@code withinS}. */
    boolean awaitConnected(BooleanSupplier done, double withinS, long deadline) {
        while (!holds(done)) {
            if (!await(() -> requests.isConnected() || done.getAsBoolean(), deadline)) {
                return false;
            }
            int connections = requests.connections();
            if (!await(() -> done.getAsBoolean() || requests.isChangedSince(connections), Time.earlier(withinS, deadline))) {
                return false;
            }
        }
        return true;
    }

    /** Wait until all packets of the scheduler's cache have arrived. */
    void awaitCaughtUp(long deadline) {
        if (launch.sockets.subscribe.isEmpty()) {
            return;
        }
        if (!await(() -> caughtUp.contains(launch.sockets.subscribe.get(0)), deadline)) {
            throw new NoResponseException("joining", "the scheduler does not answer; is the experiment running?", Response.NOT_SENT);
        }
    }

    synchronized boolean holds(BooleanSupplier condition) {
        return condition.getAsBoolean();
    }

    /** Change the state and wake all waiting threads. */
    synchronized void change(Runnable what) {
        what.run();
        notifyAll();
    }

    /** Call {@code action} with the reason before a waiting call throws it. */
    void onFail(Consumer<RuntimeException> action) {
        beforeFailure = action;
    }

    /** End all waiting, with a reason. */
    void fail(RuntimeException reason) {
        beforeFailure.accept(reason);
        change(() -> over = over == null ? reason : over);
    }

    /** Return the reason why waiting has ended; null while it may go on. */
    synchronized RuntimeException over() {
        return over;
    }

    /** Return the time since the last wait, in s. */
    synchronized double stepAgeS() {
        return waiting > 0 ? 0 : (System.nanoTime() - busySince) * 1e-9;
    }

    // --- what was published ---

    synchronized ScopeState state() {
        return (ScopeState) newest.getOrDefault("ScopeStateMsg", ScopeState.SS_UNDEFINED);
    }

    synchronized ControlState control() {
        return (ControlState) newest.get("ControlState");
    }

    synchronized ScanParameters scanParameters() {
        return (ScanParameters) newest.get("ScanParameters2d");
    }

    synchronized ZCtrlParameters feedback() {
        return (ZCtrlParameters) newest.get("ZCtrlParameters");
    }

    synchronized double[] probePositionM() {
        return (double[]) newest.get("ProbePosition");
    }

    /** Return the number of received packets of a message. */
    synchronized int count(String message) {
        return counts.getOrDefault(message, 0);
    }

    /** Return when the newest packet of the scheduler was published. */
    synchronized long newestNs() {
        return newestNs;
    }

    /** Whether the experiment file lists an envelope for this component. */
    boolean isListenedTo(String envelope) {
        return launch.envelopes == null || launch.envelopes.stream().anyMatch(envelope::startsWith);
    }

    // --- the thread of the sockets ---

    void send(List<byte[]> frames) {
        post(() -> control.send(frames));
    }

    void reconnect() {
        post(control::reconnect);
    }

    /** Send the waiting requests, and close. */
    @Override
    public void close() {
        isClosed = true;
        post(() -> { });
        try {
            thread.join(1000);
        } catch (InterruptedException error) {
            Thread.currentThread().interrupt();
        }
    }

    private void post(Runnable task) {
        tasks.add(task);
        try {
            wakeUp.sink().write(ByteBuffer.allocate(1));
        } catch (IOException error) {
            LOG.log(Level.FINE, "closed already", error);
        }
    }

    private void run() {
        try (ZMQ.Poller poller = context.createPoller(8)) {
            poller.register(wakeUp.source(), ZMQ.Poller.POLLIN);
            if (control != null) {
                poller.register(control.socket, ZMQ.Poller.POLLIN);
                poller.register(control.monitor.socket, ZMQ.Poller.POLLIN);
            }
            for (Subscription subscription : subscriptions) {
                poller.register(subscription.socket, ZMQ.Poller.POLLIN);
                poller.register(subscription.monitor.socket, ZMQ.Poller.POLLIN);
            }
            while (!isClosed) {
                poller.poll();
                turn();
            }
            turn();
        } catch (RuntimeException | IOException error) {
            fail(new AfspmException("the connection failed: " + error, error));
        } finally {
            context.close();
        }
    }

    /** Carry out pending tasks, and process all received frames. */
    private void turn() throws IOException {
        ByteBuffer wakes = ByteBuffer.allocate(256);
        while (wakeUp.source().read(wakes) > 0) {
            wakes.position(0);
        }
        if (control != null) {
            control.follow();
        }
        for (Runnable task = tasks.poll(); task != null; task = tasks.poll()) {
            task.run();
        }
        if (control != null) {
            control.receive();
        }
        for (Subscription subscription : subscriptions) {
            subscription.follow();
            subscription.receive();
        }
    }

    /** Return the prefixes to subscribe to: those of the experiment file, and those that commands and measurements need. */
    private List<String> wanted() {
        if (launch.envelopes == null || launch.sockets.control == null) {
            return launch.envelopes;
        }
        List<String> wanted = new ArrayList<>(launch.envelopes);
        List<String> followed = new ArrayList<>(STATES);
        followed.addAll(Arrays.asList("Scan2d", "Spec1d"));
        followed.removeIf(this::isListenedTo);
        wanted.addAll(followed);
        return wanted;
    }

    private Subscription.Listener listener(String address) {
        boolean isScheduler = address.equals(launch.sockets.subscribe.get(0));
        return new Subscription.Listener() {
            @Override
            public void onPacket(Packet packet) {
                change(() -> take(packet, isScheduler));
            }

            @Override
            public void onCaughtUp() {
                change(() -> caughtUp.add(address));
            }

            @Override
            public void onKill() {
                fail(new ExperimentEndedException("the experiment has ended"));
            }

            @Override
            public void onDropped(String why) {
                LOG.warning(why);
            }
        };
    }

    private void take(Packet packet, boolean isScheduler) {
        if (isScheduler) {
            newestNs = Math.max(newestNs, packet.timeNs());
            counts.merge(packet.message(), 1, Integer::sum);
            if (STATES.contains(packet.message())) {
                newest.put(packet.message(), packet.value());
            }
        }
        listeners.forEach(listener -> listener.accept(packet, isScheduler));
    }
}
