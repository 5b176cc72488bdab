package afspm.client;

import afspm.Control.ActionMsg;
import afspm.Control.ParameterMsg;
import afspm.Control.ScopeStateMsg;
import afspm.Feedback.ZCtrlParameters;
import afspm.Geometry.Point2d;
import afspm.Scan.ScanParameters2d;
import afspm.Spectroscopy.ProbePosition;
import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.List;

/** Messages and requests as bytes. */
final class Wire {
    static final int CLOCK_REQUEST = 101;
    static final int RELAY_REQUEST = 102;
    static final int OTHER_RUN_RESPONSE = 100;
    private static final int LONGEST_ID = 200;

    private Wire() {
    }

    static List<byte[]> request(int number, byte[] object, String id) {
        byte[] idBytes = id.getBytes(StandardCharsets.UTF_8);
        if (idBytes.length > LONGEST_ID) {
            throw new InvalidValueException("a request id of " + idBytes.length + " bytes: at most " + LONGEST_ID);
        }
        List<byte[]> frames = new ArrayList<>();
        frames.add(new byte[] {(byte) number});
        if (object.length > 0 || idBytes.length > 0) {
            frames.add(object);
        }
        if (idBytes.length > 0) {
            frames.add(idBytes);
        }
        return frames;
    }

    static byte[] action(String name) {
        return ActionMsg.newBuilder().setAction(name).build().toByteArray();
    }

    static byte[] parameter(String name, String value, String unit) {
        ParameterMsg.Builder message = ParameterMsg.newBuilder().setParameter(name);
        if (value != null) {
            message.setValue(value);
        }
        if (unit != null) {
            message.setUnits(unit);
        }
        return message.build().toByteArray();
    }

    static byte[] place(double xM, double yM) {
        if (Double.isNaN(xM + yM) || Double.isInfinite(xM + yM)) {
            throw new InvalidValueException("(" + xM + ", " + yM + ") is no place");
        }
        return ProbePosition.newBuilder().setPoint(Point2d.newBuilder().setX(xM).setY(yM)).setUnits("m").build().toByteArray();
    }

    static double[] place(ProbePosition position) {
        if (!position.getPoint().hasX() || !position.getPoint().hasY()) {
            return null;
        }
        String unit = position.getUnits().isEmpty() ? "m" : position.getUnits();
        return new double[] {Units.convert(position.getPoint().getX(), unit, "m"), Units.convert(position.getPoint().getY(), unit, "m")};
    }

    /** Decode a message that this client uses; null for all others. */
    static Object decode(Packet packet) throws InvalidProtocolBufferException {
        byte[] payload = packet.payload();
        switch (packet.message()) {
            case "Scan2d":
                return new Scan(packet);
            case "Spec1d":
                return new Spectrum(packet);
            case "ScanLines":
                return new ScanLines(payload);
            case "ScopeStateMsg":
                return ScopeStateMsg.parseFrom(payload).getScopeState();
            case "ControlState":
                return new ControlState(afspm.Control.ControlState.parseFrom(payload));
            case "ScanParameters2d":
                return ScanParameters.of(ScanParameters2d.parseFrom(payload));
            case "ZCtrlParameters":
                return ZCtrlParameters.parseFrom(payload);
            case "ProbePosition":
                return place(ProbePosition.parseFrom(payload));
            default:
                return null;
        }
    }
}
