package afspm.client;

import afspm.Scan.Scan2d;
import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.ByteBuffer;
import java.nio.DoubleBuffer;

/** One channel of a scan. */
public final class Scan {
    private static final int VALUES = 4;

    private final Packet packet;
    private final Region region;
    private final int rows;
    private final int columns;
    private final String channel;
    private final String unit;
    private final DoubleBuffer values;
    private final long timeNs;
    private final String filename;

    /** Decode a {@code Scan2d}; its bytes become part of this object. */
    Scan(Packet packet) {
        Values split = new Values(ByteBuffer.wrap(packet.payload()), VALUES);
        Scan2d scan;
        try {
            scan = Scan2d.parseFrom(split.rest);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no Scan2d: " + error.getMessage());
        }
        ScanParameters parameters = ScanParameters.of(scan.getParams());
        this.packet = packet;
        this.region = parameters.region();
        this.rows = parameters.rows();
        this.columns = parameters.columns();
        this.channel = scan.getChannel();
        this.unit = scan.getParams().getData().getUnits();
        this.values = split.doubles();
        this.timeNs = scan.hasTimestamp() ? Time.ns(scan.getTimestamp()) : 0;
        this.filename = scan.getFilename();
        if (region == null) {
            throw new WireException("a scan without a region");
        }
        if (values.hasRemaining() && values.remaining() != (long) rows * columns) {
            throw new WireException("a scan of " + rows + " x " + columns + " pixels with " + values.remaining() + " values");
        }
    }

    /** Return the region of the scan. */
    public Region region() {
        return region;
    }

    public int rows() {
        return rows;
    }

    public int columns() {
        return columns;
    }

    /** Return the name of the channel, such as "Height Retrace". */
    public String channel() {
        return channel;
    }

    /** Return the unit of the values. */
    public String unit() {
        return unit;
    }

    /** Return the values, row after row, x and y ascending: a read-only view of the received bytes. */
    public DoubleBuffer values() {
        return values.duplicate();
    }

    /** Return the value of a pixel; rows and columns count from 0. */
    public double at(int row, int column) {
        if (row < 0 || column < 0 || row >= rows || column >= columns) {
            throw new InvalidValueException("no pixel (" + row + ", " + column + ")");
        }
        return values.get(row * columns + column);
    }

    /** Return a copy of the values, row after row. */
    public double[] toArray() {
        double[] copy = new double[values.remaining()];
        values().get(copy);
        return copy;
    }

    /** Return a copy of the values as [row][column], a matrix in MATLAB. */
    public double[][] toMatrix() {
        double[][] matrix = new double[values.hasRemaining() ? rows : 0][columns];
        DoubleBuffer from = values();
        for (double[] row : matrix) {
            from.get(row);
        }
        return matrix;
    }

    /** Return the position of a pixel in metres, as {x, y}; fractions are positions between pixels. */
    public double[] placeM(double row, double column) {
        return region.placeM(column / Math.max(1, columns - 1) - 0.5, row / Math.max(1, rows - 1) - 0.5);
    }

    /** Return the time at the end of the scan, ns since the Unix epoch; 0 if unknown. */
    public long timeNs() {
        return timeNs;
    }

    /** Return the controller's own file; empty if there is none. */
    public String filename() {
        return filename;
    }

    /** Return the packet that contained it. */
    public Packet packet() {
        return packet;
    }
}
