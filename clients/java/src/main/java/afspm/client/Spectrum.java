package afspm.client;

import afspm.Spectroscopy.Spec1d;
import afspm.Spectroscopy.SpecData;
import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.ByteBuffer;
import java.nio.DoubleBuffer;
import java.util.Collections;
import java.util.List;

/** Several variables measured together, point by point. */
public final class Spectrum {
    private static final int DATA = 4;
    private static final int VALUES = 5;

    private final Packet packet;
    private final double[] positionM;
    private final String kind;
    private final List<String> names;
    private final List<String> units;
    private final DoubleBuffer values;
    private final long timeNs;
    private final String filename;

    /** Decode a {@code Spec1d}; its bytes become part of this object. */
    Spectrum(Packet packet) {
        Values outer = new Values(ByteBuffer.wrap(packet.payload()), DATA);
        ByteBuffer data = outer.chunks.isEmpty() ? ByteBuffer.allocate(0) : outer.chunks.get(outer.chunks.size() - 1);
        Values inner = new Values(data, VALUES);
        Spec1d spectrum;
        SpecData rest;
        try {
            spectrum = Spec1d.parseFrom(outer.rest);
            rest = SpecData.parseFrom(inner.rest);
        } catch (InvalidProtocolBufferException error) {
            throw new WireException("no Spec1d: " + error.getMessage());
        }
        this.packet = packet;
        positionM = Wire.place(spectrum.getPosition());
        kind = spectrum.getType();
        names = Collections.unmodifiableList(rest.getNamesList());
        units = Collections.unmodifiableList(rest.getUnitsList());
        values = inner.doubles();
        timeNs = spectrum.hasTimestamp() ? Time.ns(spectrum.getTimestamp()) : 0;
        filename = spectrum.getFilename();
        if (names.size() != units.size() || values.remaining() % Math.max(1, names.size()) != 0) {
            throw new WireException("a spectrum of " + names.size() + " names, " + units.size() + " units and " + values.remaining() + " values");
        }
    }

    /** Return the position of the probe in metres, as {x, y}; null if unknown. */
    public double[] positionM() {
        return positionM == null ? null : positionM.clone();
    }

    /** Return the kind of spectroscopy, such as "IV" or "force". */
    public String kind() {
        return kind;
    }

    public List<String> names() {
        return names;
    }

    public List<String> units() {
        return units;
    }

    public int points() {
        return values.remaining() / Math.max(1, names.size());
    }

    /** Return all variables of the first point, then of the second: a read-only view of the received bytes. */
    public DoubleBuffer values() {
        return values.duplicate();
    }

    /** Return a copy of one variable, a value for each point. */
    public double[] variable(String name) {
        int index = names.indexOf(name);
        if (index < 0) {
            throw new InvalidValueException("no variable " + name + "; there are " + String.join(", ", names));
        }
        double[] column = new double[points()];
        for (int point = 0; point < column.length; point++) {
            column[point] = values.get(point * names.size() + index);
        }
        return column;
    }

    /** Return the time of measurement, ns since the Unix epoch; 0 if unknown. */
    public long timeNs() {
        return timeNs;
    }

    public String filename() {
        return filename;
    }

    /** Return the packet that contained it. */
    public Packet packet() {
        return packet;
    }
}
