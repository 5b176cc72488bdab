package afspm.client;

import java.util.ArrayDeque;
import java.util.Queue;
import java.util.function.BiConsumer;

/** Packets published from its creation until it is closed, oldest first. */
public final class PacketQueue implements AutoCloseable {
    private final Link link;
    private final Queue<Packet> packets = new ArrayDeque<>();
    private final BiConsumer<Packet, Boolean> listener;

    PacketQueue(Link link, String prefix) {
        this.link = link;
        listener = (packet, isScheduler) -> {
            if (packet.envelope().startsWith(prefix) && link.isListenedTo(packet.envelope())) {
                packets.add(packet);
            }
        };
        link.listeners.add(listener);
    }

    /** Wait for the next packet and return it; throws ExperimentEndedException at the end of the experiment. */
    public Packet take() {
        return poll(Double.POSITIVE_INFINITY);
    }

    /** Return the next packet; null if none arrives within the timeout, in s. */
    public Packet poll(double timeoutS) {
        synchronized (link) {
            return !packets.isEmpty() || link.await(() -> !packets.isEmpty(), Time.deadline(timeoutS)) ? packets.poll() : null;
        }
    }

    /** Remove and return the oldest packet with this prefix; null if there is none. */
    public Packet pollBeginningWith(String prefix) {
        synchronized (link) {
            Packet found = packets.stream().filter(packet -> packet.envelope().startsWith(prefix)).findFirst().orElse(null);
            packets.remove(found);
            return found;
        }
    }

    @Override
    public void close() {
        link.listeners.remove(listener);
    }
}
