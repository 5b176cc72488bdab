package afspm.client;

import static org.junit.jupiter.api.Assertions.assertArrayEquals;
import static org.junit.jupiter.api.Assertions.assertEquals;
import static org.junit.jupiter.api.Assertions.assertThrows;

import afspm.Scan.Scan2d;
import com.google.protobuf.InvalidProtocolBufferException;
import java.nio.ByteBuffer;
import java.util.Arrays;
import org.junit.jupiter.api.Test;

class ValuesTest {
    private static final byte[] MESSAGE = Scan2d.newBuilder().setChannel("Height").addAllValues(Arrays.asList(1.0, -2.5, 3e-9))
            .setFilename("a.ibw").build().toByteArray();

    @Test
    void valuesAreAViewOfTheMessageAndTheRestIsParsed() throws InvalidProtocolBufferException {
        byte[] message = MESSAGE.clone();
        Values values = new Values(ByteBuffer.wrap(message), 4);
        assertEquals(-2.5, values.doubles().get(1));
        Scan2d rest = Scan2d.parseFrom(values.rest);
        assertEquals(0, rest.getValuesCount());
        assertEquals("Height", rest.getChannel());
        assertEquals("a.ibw", rest.getFilename());
        Arrays.fill(message, (byte) 0);
        assertEquals(0.0, values.doubles().get(1), "a copy would have kept what was there");
    }

    @Test
    void valuesInTwoPiecesAreJoined() {
        byte[] twice = Arrays.copyOf(MESSAGE, 2 * MESSAGE.length);
        System.arraycopy(MESSAGE, 0, twice, MESSAGE.length, MESSAGE.length);
        double[] found = new double[6];
        new Values(ByteBuffer.wrap(twice), 4).doubles().get(found);
        assertArrayEquals(new double[] {1, -2.5, 3e-9, 1, -2.5, 3e-9}, found);
    }

    @Test
    void aMessageThatBreaksOffIsRefused() {
        for (int length : new int[] {1, 7, 9, 12, MESSAGE.length - 1}) {
            ByteBuffer part = ByteBuffer.wrap(Arrays.copyOf(MESSAGE, length));
            assertThrows(WireException.class, () -> new Values(part, 4));
        }
    }

    @Test
    void unitsAreConvertedExactlyAndRefusedWhereTheyDifferInKind() {
        assertEquals(2e-6, Units.convert(2, "um/s", "m/s"));
        assertEquals(4e-7, Units.convert(400, "nm", "m"));
        assertEquals(3e-10, Units.convert(3, "\u00c5", "m"));
        assertEquals(Math.PI / 2, Units.convert(90, "deg", "rad"));
        assertThrows(InvalidValueException.class, () -> Units.convert(1, "V", "m"));
        assertThrows(InvalidValueException.class, () -> Units.convert(1, "furlong", "m"));
    }
}
