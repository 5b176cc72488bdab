package afspm.client;

import afspm.Control.ControlResponse;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.List;

/** The answer to a request. */
public final class Response {
    /** Details for programs, beside the code. */
    public static final int NOT_SENT = 1;
    public static final int OUTCOME_UNKNOWN = 2;
    public static final int EXPERIMENT_ENDED = 3;

    private static final byte[] NOTHING = {};

    private final int code;
    private final byte[] object;
    private final String reason;
    private final String id;
    private final int detail;

    Response(int code, byte[] object, String reason, String id, int detail) {
        this.code = code;
        this.object = object;
        this.reason = reason;
        this.id = id;
        this.detail = detail;
    }

    /** Decode one to five frames; frames appended by a newer peer are ignored. */
    static Response decode(List<byte[]> frames) {
        if (frames.isEmpty() || frames.get(0).length != 1) {
            throw new WireException("a response whose first frame is not one byte");
        }
        byte[] detail = frame(frames, 4);
        return new Response(frames.get(0)[0] & 0xff, frame(frames, 1), text(frame(frames, 2)), text(frame(frames, 3)),
                detail.length == 0 ? 0 : detail[0] & 0xff);
    }

    /** Return the frames [code, object, reason, id, detail], without empty frames at the end. */
    List<byte[]> encode() {
        List<byte[]> frames = new ArrayList<>();
        frames.add(new byte[] {(byte) code});
        frames.add(object);
        frames.add(reason.getBytes(StandardCharsets.UTF_8));
        frames.add(id.getBytes(StandardCharsets.UTF_8));
        frames.add(detail == 0 ? NOTHING : new byte[] {(byte) detail});
        while (frames.size() > 1 && frames.get(frames.size() - 1).length == 0) {
            frames.remove(frames.size() - 1);
        }
        return frames;
    }

    /** Return a copy with another code. */
    Response as(int other) {
        return new Response(other, object, reason, id, detail);
    }

    /** Return the number of a {@code ControlResponse}. */
    public int code() {
        return code;
    }

    /** Return the object in bytes, such as the {@code ParameterMsg} in force; empty for most responses. */
    public byte[] object() {
        return object;
    }

    /** Return the reason of a failure, for a person. */
    public String reason() {
        return reason;
    }

    /** Return the id of the answered request; empty if the request had none. */
    public String id() {
        return id;
    }

    public int detail() {
        return detail;
    }

    public boolean ok() {
        return code == ControlResponse.REP_SUCCESS_VALUE;
    }

    /** Whether the outcome of the request is unknown. */
    boolean isUnanswered() {
        return code == ControlResponse.REP_NO_RESPONSE_VALUE || detail == NOT_SENT || detail == OUTCOME_UNKNOWN;
    }

    /** Whether the request was refused because the client is not in control. */
    boolean isNotInControl() {
        return code == ControlResponse.REP_NOT_IN_CONTROL_VALUE || code == ControlResponse.REP_WRONG_CONTROL_MODE_VALUE;
    }

    /** Return the name of a response, such as "REP_PARAM_ERROR", or its number if it has none. */
    public static String name(int code) {
        ControlResponse known = ControlResponse.forNumber(code);
        return known == null ? String.valueOf(code) : known.name();
    }

    private static byte[] frame(List<byte[]> frames, int index) {
        return index < frames.size() ? frames.get(index) : NOTHING;
    }

    private static String text(byte[] bytes) {
        return new String(bytes, StandardCharsets.UTF_8);
    }
}
