package afspm.client;

import com.google.protobuf.InvalidProtocolBufferException;
import com.google.protobuf.Timestamp;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.List;

/** A published message with its envelope. */
public final class Packet {
    private static final int LONGEST_ENVELOPE = 1000;

    private final String envelope;
    private final byte[] payload;
    private final long timeNs;
    private final Object value;

    Packet(String envelope, byte[] payload, long timeNs) {
        this.envelope = envelope;
        this.payload = payload;
        this.timeNs = timeNs;
        try {
            value = Wire.decode(this);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no " + message() + ": " + error.getMessage());
        }
    }

    /** Decode two or three frames. */
    static Packet decode(List<byte[]> frames) {
        if (frames.size() < 2 || frames.size() > 3 || frames.get(0).length > LONGEST_ENVELOPE) {
            throw new WireException("a packet of " + frames.size() + " frames instead of two or three");
        }
        try {
            long timeNs = frames.size() < 3 || frames.get(2).length == 0 ? 0 : Time.ns(Timestamp.parseFrom(frames.get(2)));
            return new Packet(new String(frames.get(0), StandardCharsets.UTF_8), frames.get(1), timeNs);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no time: " + error.getMessage());
        }
    }

    static List<byte[]> encode(String envelope, byte[] payload, long timeNs) {
        List<byte[]> frames = new ArrayList<>();
        frames.add(envelope.getBytes(StandardCharsets.UTF_8));
        frames.add(payload);
        if (timeNs != 0) {
            frames.add(Time.timestamp(timeNs).toByteArray());
        }
        return frames;
    }

    public String envelope() {
        return envelope;
    }

    /** Return the name of the message: the envelope up to the first underscore. */
    public String message() {
        int end = envelope.indexOf('_');
        return end < 0 ? envelope : envelope.substring(0, end);
    }

    /** Return the serialised message. */
    public byte[] payload() {
        return payload;
    }

    /** Return the time of its first publication, ns since the Unix epoch; 0 if unknown. */
    public long timeNs() {
        return timeNs;
    }

    /**
     * Return a {@link Scan}, {@link Spectrum}, {@link ScanLines}, {@link ScanParameters}, {@link ControlState}, a place
     * of the probe as {x, y}, a {@code ScopeState} or {@code ZCtrlParameters}; null for other messages.
     */
    public Object value() {
        return value;
    }

    /** Return the scan in this packet; null if it contains none. */
    public Scan scan() {
        return value instanceof Scan ? (Scan) value : null;
    }

    /** Return the spectrum in this packet; null if it contains none. */
    public Spectrum spectrum() {
        return value instanceof Spectrum ? (Spectrum) value : null;
    }
}
