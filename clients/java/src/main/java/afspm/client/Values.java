package afspm.client;

import java.io.ByteArrayOutputStream;
import java.nio.ByteBuffer;
import java.nio.ByteOrder;
import java.nio.DoubleBuffer;
import java.util.ArrayList;
import java.util.List;

/**
 * Extracts the numbers of a message from its bytes: a packed {@code repeated double} is tag, length, then little-endian
 * float64 values, which become a buffer without a copy; only the small rest is parsed.
 */
final class Values {
    private static final int VARINT = 0;
    private static final int FIXED64 = 1;
    private static final int LENGTH_DELIMITED = 2;
    private static final int FIXED32 = 5;

    /** The message without the field. */
    final ByteBuffer rest;
    /** The contents of the field, in their order: usually one. */
    final List<ByteBuffer> chunks = new ArrayList<>();

    /** Split a serialised message into its top-level field number {@code field} and the rest. */
    Values(ByteBuffer message, int field) {
        ByteBuffer at = message.duplicate();
        ByteArrayOutputStream kept = new ByteArrayOutputStream();
        int keptFrom = at.position();
        while (at.hasRemaining()) {
            int start = at.position();
            long tag = varint(at);
            int kind = (int) (tag & 7);
            int length = lengthOf(kind, at, start);
            if (length < 0 || length > at.remaining()) {
                throw new WireException("the message breaks off in the field at byte " + start);
            }
            int end = at.position() + length;
            if (tag >>> 3 == field && (kind == LENGTH_DELIMITED || kind == FIXED64)) {
                chunks.add(part(message, at.position(), end));
                append(kept, message, keptFrom, start);
                keptFrom = end;
            }
            at.position(end);
        }
        if (!chunks.isEmpty()) {
            append(kept, message, keptFrom, message.limit());
        }
        rest = chunks.isEmpty() ? message.duplicate() : ByteBuffer.wrap(kept.toByteArray());
    }

    /** Return the numbers: a read-only view of a single piece, otherwise a copy. */
    DoubleBuffer doubles() {
        ByteBuffer bytes = chunks.size() == 1 ? chunks.get(0) : joined();
        if (bytes.remaining() % Double.BYTES != 0) {
            throw new WireException("values of " + bytes.remaining() + " bytes are no float64 numbers");
        }
        return bytes.asReadOnlyBuffer().order(ByteOrder.LITTLE_ENDIAN).asDoubleBuffer();
    }

    private ByteBuffer joined() {
        ByteBuffer all = ByteBuffer.allocate(chunks.stream().mapToInt(ByteBuffer::remaining).sum());
        chunks.forEach(chunk -> all.put(chunk.duplicate()));
        all.flip();
        return all;
    }

    private static int lengthOf(int kind, ByteBuffer at, int start) {
        switch (kind) {
            case LENGTH_DELIMITED:
                return (int) Math.min(varint(at), Integer.MAX_VALUE);
            case VARINT:
                varint(at);
                return 0;
            case FIXED64:
                return Long.BYTES;
            case FIXED32:
                return Integer.BYTES;
            default:
                throw new WireException("byte " + start + " begins a field of the unknown kind " + kind);
        }
    }

    private static long varint(ByteBuffer at) {
        long value = 0;
        for (int shift = 0; at.hasRemaining() && shift < Long.SIZE; shift += 7) {
            byte next = at.get();
            value |= (next & 0x7fL) << shift;
            if (next >= 0) {
                return value;
            }
        }
        throw new WireException("the message breaks off in a number");
    }

    private static ByteBuffer part(ByteBuffer message, int from, int to) {
        ByteBuffer part = message.duplicate();
        part.position(from).limit(to);
        return part.slice();
    }

    private static void append(ByteArrayOutputStream out, ByteBuffer message, int from, int to) {
        byte[] bytes = new byte[to - from];
        part(message, from, to).get(bytes);
        out.write(bytes, 0, bytes.length);
    }
}
