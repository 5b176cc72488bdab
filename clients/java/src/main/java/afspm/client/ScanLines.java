package afspm.client;

import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.ByteBuffer;
import java.nio.DoubleBuffer;

/** Neighbouring rows of one channel of a running scan. */
public final class ScanLines {
    private static final int VALUES = 4;

    private final ScanParameters parameters;
    private final String channel;
    private final String unit;
    private final DoubleBuffer values;
    private final int firstRow;
    private final long timeNs;

    ScanLines(byte[] message) {
        Values split = new Values(ByteBuffer.wrap(message), VALUES);
        afspm.Lines.ScanLines lines;
        try {
            lines = afspm.Lines.ScanLines.parseFrom(split.rest);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no ScanLines: " + error.getMessage());
        }
        parameters = ScanParameters.of(lines.getParams());
        channel = lines.getChannel();
        unit = lines.getParams().getData().getUnits();
        values = split.doubles();
        firstRow = lines.getFirstRow();
        timeNs = lines.hasTimestamp() ? Time.ns(lines.getTimestamp()) : 0;
        if (parameters.columns() == 0 || values.remaining() % parameters.columns() != 0) {
            throw new WireException("lines of " + parameters.columns() + " pixels with " + values.remaining() + " values");
        }
    }

    /** Return region and shape of the whole scan. */
    public ScanParameters parameters() {
        return parameters;
    }

    /** Return the number of rows in this message. */
    public int rows() {
        return values.remaining() / parameters.columns();
    }

    /** Return the index of the first row within the whole scan. */
    public int firstRow() {
        return firstRow;
    }

    public String channel() {
        return channel;
    }

    public String unit() {
        return unit;
    }

    /** Return the values, row after row: a read-only view of the received bytes. */
    public DoubleBuffer values() {
        return values.duplicate();
    }

    /** Return the start of the scan, ns since the Unix epoch: equal for all its lines. */
    public long timeNs() {
        return timeNs;
    }
}
