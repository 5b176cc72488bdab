package afspm.client;

import java.util.ArrayDeque;
import java.util.Queue;
import java.util.function.BiConsumer;

/** What is published from now on, oldest first, until this is closed. */
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

    /** Return the next packet, as soon as there is one; throws ExperimentEndedException when there will be none. */
    public Packet take() {
        return poll(Double.POSITIVE_INFINITY);
    }

    /** Return the next packet; null if none comes within so many seconds. */
    public Packet poll(double timeoutS) {
        synchronized (link) {
            return !packets.isEmpty() || link.await(() -> !packets.isEmpty(), Time.deadline(timeoutS)) ? packets.poll() : null;
        }
    }

    /** Return the oldest packet that is there and begins so, and remove it; null if there is none. */
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
